"""Tiles of single precision: positions and wheel angles relative to those at the beginning of a control step.

So their steps are not lost in the rounding of large numbers. In a tile of double precision nothing is relative.
"""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import Effects
from tlf_env.engine.layout import STATES_IN_TILE, Sample, Traction, in_array
from tlf_env.engine.tile_rows import COLUMN, SAMPLE, body_at, body_of, motion_of
from tlf_env.numerics.compiled import law, law_in_double
from tlf_env.numerics.memory import DOUBLE_BYTES, like
from tlf_env.numerics.rows import doubling, replacing
from tlf_env.physics.vehicle import Body, Contact, Motion, Push

# In single precision, what positions and wheel angles in a tile are relative to, and the rows that are.
BASE_X, BASE_Y, BASES = 0, 1, 4
OF_BASE = np.array([in_array("motion", name) for name in ("x", "y", "angle_l", "angle_r")])
RELATIVE = np.array(
    [
        *OF_BASE,
        *(in_array("estimate", name) for name in ("x", "y")),
        *(in_array("sensors", name) for name in ("encoder_l", "encoder_r")),
        *(in_array("observed_speed", name) for name in ("angle_l", "angle_r")),
    ]
)
BASE_OF = np.array([0, 1, 2, 3, 0, 1, 2, 3, 2, 3])
OFFS = np.array(
    [in_array("trace", name) for name in ("off_x", "off_y")]
)  # sums of fixes' positions
FIXES = in_array("trace", "fixes")
LAST_FIX = np.array([Sample._fields.index("fix_x"), Sample._fields.index("fix_y")])
with_place = replacing(Motion, "x", "y")
double_body, double_motion, double_contact = doubling(Body), doubling(Motion), doubling(Contact)
double_effects, double_traction, double_push = doubling(Effects), doubling(Traction), doubling(Push)


@law
def is_single(tile: np.ndarray) -> bool:
    """Whether a tile is of single precision; the compiler knows."""
    return tile.itemsize < DOUBLE_BYTES


@law
def absolute(tile: np.ndarray, base: np.ndarray, k: int, i: int, value: float) -> float:
    """A value in the tile as it is outside."""
    return base[k, i] + value if is_single(tile) else like(value, base[k, i])


@law
def relative(tile: np.ndarray, base: np.ndarray, k: int, i: int, value: float) -> float:
    """A value from outside as it is in the tile."""
    return like(value - base[k, i] if is_single(tile) else value, tile[0, i])


@law
def placed(tile: np.ndarray, base: np.ndarray, i: int) -> Motion:
    """A robot's motion at its place in the world."""
    motion = double_motion(motion_of(tile, i))
    x = absolute(tile, base, BASE_X, i, motion.x)
    return with_place(motion, x, absolute(tile, base, BASE_Y, i, motion.y))


@law
def take_base(tile: np.ndarray, base: np.ndarray, states: np.ndarray, columns: np.ndarray) -> None:
    """In single precision, have positions and wheel angles relative to those of this moment.

    So their steps are not lost in the rounding of large numbers.
    """
    if is_single(tile):
        for k in range(BASES):
            for i in range(tile.shape[1]):
                base[k, i] = states[OF_BASE[k], columns[i]]
        for f in range(RELATIVE.shape[0]):
            for i in range(tile.shape[1]):
                value = states[RELATIVE[f], columns[i]] - base[BASE_OF[f], i]
                tile[STATES_IN_TILE + RELATIVE[f], i] = value
        for k in range(OFFS.shape[0]):
            for i in range(tile.shape[1]):
                sums = states[OFFS[k], columns[i]] - states[FIXES, columns[i]] * base[k, i]
                tile[STATES_IN_TILE + OFFS[k], i] = sums


@law
def put_back(
    tile: np.ndarray, base: np.ndarray, states: np.ndarray, columns: np.ndarray, count: int
) -> None:
    """The inverse of :func:`take_base`."""
    if is_single(tile):
        for f in range(RELATIVE.shape[0]):
            for i in range(count):
                value = base[BASE_OF[f], i] + tile[STATES_IN_TILE + RELATIVE[f], i]
                states[RELATIVE[f], columns[i]] = value
        for k in range(OFFS.shape[0]):
            for i in range(count):
                sums = tile[STATES_IN_TILE + OFFS[k], i] + states[FIXES, columns[i]] * base[k, i]
                states[OFFS[k], columns[i]] = sums


@law
def place_samples(
    samples: np.ndarray, tile: np.ndarray, base: np.ndarray, columns: np.ndarray, count: int
) -> None:
    """In single precision, the last fixes of a substep at their places in the world."""
    if is_single(tile):
        for k in range(LAST_FIX.shape[0]):
            for i in range(count):
                samples[LAST_FIX[k], columns[i]] = base[k, i] + tile[SAMPLE + LAST_FIX[k], i]


@law_in_double
def exact_body(tile: np.ndarray, numbers: np.ndarray, constants: np.ndarray, i: int) -> Body:
    """A robot's body in double precision.

    Rounded, a mass times its inverse is not 1, and sweeps with such numbers never come to their tolerance.
    """
    if is_single(tile):
        return body_at(constants, numbers[COLUMN, i])
    return double_body(body_of(tile, i))
