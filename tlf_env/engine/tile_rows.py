"""What lies in a tile: its rows by name, and copying from arrays and back.

A *tile* holds some robots side by side: a row for each number, a column for each robot; see :mod:`tiles`.
"""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import effects_of_group
from tlf_env.engine.layout import (
    Sample,
    in_array,
    in_tile,
    tile_access,
    tile_reader,
    tile_writer,
)
from tlf_env.numerics.compiled import law, view
from tlf_env.numerics.memory import copy_line
from tlf_env.numerics.rows import row_reader
from tlf_env.physics.vehicle import Body

body_of = tile_reader("body")
body_at = row_reader(Body, in_array("body"))  # of flat constants
belief_of = tile_reader("belief")
speed_observer_of = tile_reader("speed_observer")
loop_of = tile_reader("wheel_loop")
ekf_of = tile_reader("ekf")
slip_ekf_of = tile_reader("slip_ekf")
gyro_ekf_of = tile_reader("gyro_ekf")
effects_of = tile_reader("effects")
motion_of, set_motion = tile_access("motion")
contact_of, set_contact = tile_access("contact")
held_of, set_held = tile_access("loop_state")
sensors_of, set_sensors = tile_access("sensors")
observed_of, set_observed = tile_access("observed_speed")
commanded_of, set_commanded = tile_access("commanded")
fix_of, set_fix = tile_access("fix")
yaw_rate_of, set_yaw_rate = tile_access("yaw_rate")
estimate_of, set_estimate = tile_access("estimate")
slip_of, set_slip = tile_access("slip")
gyro_of, set_gyro = tile_access("gyro")
trace_of, set_trace = tile_access("trace")
set_sample = tile_writer("sample")
order_of, set_order = tile_access("order")
traction_of, set_traction = tile_access("traction")
push_of, set_push = tile_access("push")
reading_of, set_reading = tile_access("reading")
moved_of, set_moved = tile_access("moved")
impulses_of, set_impulses = tile_access("impulses")
draw_of, set_draw = tile_access("draw")  # of the tile as whole numbers
COLUMN = in_tile("column", "place")
SAMPLE, SAMPLE_FIELDS = in_tile("sample"), len(Sample._fields)
LAST_X, LAST_Y = in_tile("sample", "fix_x"), in_tile("sample", "fix_y")
# Places of the effects that pull at a robot, and their values where they do not.
PULLING = np.array(
    [in_tile("effects", name) for name in [*effects_of_group("push"), "floor_slope_rad"]]
)
NOT_PULLING = np.zeros(len(PULLING))
# Places of the effects that limit a robot's motors, and their values where they do not.
LIMITING = np.array(
    [
        in_tile("effects", f"actuator_{name}")
        for name in ("back_emf_s_rad", "dead_band_Nmm", "current_limit", "stall_torque")
    ]
)
NOT_LIMITING = np.array([0.0, 0.0, 1.0, 1.0])


@view
def columns_of(numbers: np.ndarray) -> np.ndarray:
    """The row of columns; unsigned, so that no index can count from an array's end."""
    return numbers.view(np.uint64)[COLUMN]


@view
def flat(array: np.ndarray) -> np.ndarray:
    """An array (field, robot, lane) as (field, column)."""
    return array.reshape((array.shape[0], array.shape[1] * array.shape[2]))


@law
def are_neighbours(columns: np.ndarray, count: int) -> bool:
    """Whether the tile is full and its columns, which grow, follow each other in the arrays."""
    last = columns.shape[0] - 1
    return count > last and columns[last] - columns[0] == last


@law
def load(
    tile: np.ndarray,
    first: int,
    array: np.ndarray,
    fields: int,
    columns: np.ndarray,
    neighbours: bool,
) -> None:
    """Copy the first fields of a flat array into the tile's rows from ``first`` on.

    Robots that are ``neighbours`` in the array are one vector, which is copied as such.
    """
    if neighbours:
        begin = int(columns[0])
        for f in range(fields):
            copy_line(tile, first + f, 0, array, f, begin)
        return
    for f in range(fields):
        for i in range(tile.shape[1]):
            tile[first + f, i] = array[f, columns[i]]


@law
def store(
    tile: np.ndarray,
    first: int,
    array: np.ndarray,
    fields: int,
    columns: np.ndarray,
    count: int,
    neighbours: bool,
) -> None:
    """Copy the tile's rows from ``first`` on back, for its first ``count`` robots; as :func:`load`."""
    if neighbours:
        begin = int(columns[0])
        for f in range(fields):
            copy_line(array, f, begin, tile, first + f, 0)
        return
    for f in range(fields):
        for i in range(count):
            array[f, columns[i]] = tile[first + f, i]


@law
def differs(tile: np.ndarray, i: int, rows: np.ndarray, values: np.ndarray) -> bool:
    """Whether one of some rows has another value than given, for the robot in column ``i``."""
    found = False
    for f in range(rows.shape[0]):
        found |= tile[rows[f], i] != values[f]
    return found


@law
def differ(tile: np.ndarray, rows: np.ndarray, values: np.ndarray) -> bool:
    """Whether one of some rows of the tile has another value than given, for some robot."""
    found = False
    for i in range(tile.shape[1]):
        found |= differs(tile, i, rows, values)
    return found
