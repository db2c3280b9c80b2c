"""The substeps of a control step, many robots at once.

Robots do not act on each other within a control step unless they touch, so all robots of all lanes are
alike here. Eight of them at a time are copied into a *tile*, an array with a row for each number and a
column for each robot, small enough for the processor's nearest cache. Each law then runs over the columns
in a loop of its own. The compiler knows the tile's shape and inlines the law, so it turns the loop into
vector instructions: eight robots at once where registers are wide enough. Work that needs branches of its
own (sweeps, changing channels, patches, dead time) is done robot by robot.

A vector and a single number go through the same additions and multiplications, so a formation's bits do
not depend on what else is in its tile. A last tile that is not full repeats its last robot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import Effects, effects_of_group
from tlf_env.disturbances.model import wheel_factors
from tlf_env.engine.arrays import (
    Arrays,
    read_command,
    read_wanted_before,
    write_floor,
    write_push,
    write_traction,
)
from tlf_env.engine.effects import OF_SUBSTEPS, delays, fix_timing, refresh
from tlf_env.engine.layout import (
    CONSTANTS_IN_TILE,
    EFFECTS_IN_TILE,
    STATE_FIELDS,
    STATES_IN_TILE,
    TILE_ROWS,
    WHOLE_ROWS,
    WITHOUT_GYRO,
    Draw,
    Fix,
    Innovation,
    Order,
    Reading,
    Sample,
    Sensors,
    Traction,
    WheelPair,
    YawRate,
    in_array,
    in_tile,
    tile_access,
    tile_reader,
    tile_writer,
)
from tlf_env.engine.sensors import (
    ENCODER_EFFECTS,
    FIX_NUMBERS,
    GYRO_EFFECTS,
    NOMINAL_ENCODERS,
    NOMINAL_FIXES,
    NOMINAL_GYRO,
    account_robot,
    correct_robot,
    correct_without_fix,
    disturbed_encoders,
    first_times,
    gyro_reading,
    measured_fix,
    missing,
    next_times,
    odometry_of,
    predict_robot,
    sense_with_gyro,
    with_outlier,
)
from tlf_env.engine.settings import Settings
from tlf_env.engine.substeps import (
    commanded_torques,
    floor_under,
    motor_torque,
    push_on,
    trace_drive,
    undisturbed,
    wanted,
    with_delivered,
    with_grip,
)
from tlf_env.numerics.compiled import by_number, law, law_in_double, view
from tlf_env.numerics.memory import (
    DOUBLE_BYTES,
    doubles_beside,
    integers_beside,
    like,
    prefetch,
    table,
    table_of,
)
from tlf_env.numerics.rows import choosing, doubling, replacing, row_reader
from tlf_env.onboard.kinds import EKF, EKF_GYRO, EKF_SLIP
from tlf_env.onboard.speed_observer import observed_speeds
from tlf_env.physics.vehicle import (
    SLIDE_COLUMNS,
    SLIDE_ROWS,
    Body,
    Contact,
    Motion,
    Push,
    advance_pose,
    begin_slide,
    end_slide,
    follow_wheels,
    roll,
    slide,
    sweep_together,
)
from tlf_env.task.actions import EXTERNAL_TORQUE, TORQUE

# Robots in a tile: as many as numbers in the widest vectors there are, 8 doubles or 16 of single precision.
WIDTH = 8
# Places of the effects that pull at a robot, or limit its motors, and their values where they do not.
PULLING = np.array(
    [in_tile("effects", name) for name in [*effects_of_group("push"), "floor_slope_rad"]]
)
LIMITING = np.array(
    [
        in_tile("effects", f"actuator_{name}")
        for name in ("back_emf_s_rad", "dead_band_Nmm", "current_limit", "stall_torque")
    ]
)
NOT_PULLING = np.zeros(len(PULLING))
NOT_LIMITING = np.array([0.0, 0.0, 1.0, 1.0])

MOST_ALONE = 2  # sliding robots of eight that are faster one by one than side by side

SPEED_OBSERVERS = np.array([in_tile("speed_observer", "angle")])
NO_SPEED_OBSERVER = np.zeros(1)

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
increments_of, set_increments = tile_access("increments")
innovation_of, set_innovation = tile_access("innovation")
draw_of, set_draw = tile_access("draw")  # of the tile as whole numbers
chosen_motion, chosen_contact = choosing(Motion), choosing(Contact)
with_place = replacing(Motion, "x", "y")
double_body, double_motion, double_contact = doubling(Body), doubling(Motion), doubling(Contact)
double_effects, double_traction, double_push = doubling(Effects), doubling(Traction), doubling(Push)
with_speeds = replacing(Sensors, "speed_l", "speed_r")
TICK = in_tile("draw", "tick")
ROLLS = in_tile("rolls", "all")
COLUMN = in_tile("column", "place")
FIX_X, FIX_Y, HERE, WAY_X, WAY_Y = (
    Fix._fields.index(name) for name in ("x", "y", "here", "way_x", "way_y")
)
SAMPLE, SAMPLE_FIELDS = in_tile("sample"), len(Sample._fields)
LAST_X, LAST_Y = in_tile("sample", "fix_x"), in_tile("sample", "fix_y")
LAST_FIX = np.array([Sample._fields.index("fix_x"), Sample._fields.index("fix_y")])
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


@view
def columns_of(numbers: np.ndarray) -> np.ndarray:
    """The row of columns; unsigned, so that no index can count from an array's end."""
    return numbers.view(np.uint64)[COLUMN]


@view
def flat(array: np.ndarray) -> np.ndarray:
    """An array (field, robot, lane) as (field, column)."""
    return array.reshape((array.shape[0], array.shape[1] * array.shape[2]))


@law
def load(tile: np.ndarray, first: int, array: np.ndarray, fields: int, columns: np.ndarray) -> None:
    """Copy the first fields of a flat array into the tile's rows from ``first`` on."""
    for f in range(fields):
        for i in range(tile.shape[1]):
            tile[first + f, i] = array[f, columns[i]]


@law
def store(
    tile: np.ndarray, first: int, array: np.ndarray, fields: int, columns: np.ndarray, count: int
) -> None:
    """Copy the tile's rows from ``first`` on back, for its first ``count`` robots."""
    for f in range(fields):
        for i in range(count):
            array[f, columns[i]] = tile[first + f, i]


@law
def columns_after(
    lanes: np.ndarray, lanes_in_all: int, item: int, items: int, width: int
) -> tuple[int, int]:
    """First and last column of the tile that begins with an item; after the last, of the lanes that follow.

    Where the next call takes other lanes, nothing is lost but a little time.
    """
    number = lanes.shape[0]
    if item < items:
        last = min(item + width, items) - 1
        return (
            item // number * lanes_in_all + lanes[item % number],
            last // number * lanes_in_all + lanes[last % number],
        )
    following = lanes[number - 1] + 1
    return min(following, lanes_in_all - 1), min(following + width, lanes_in_all) - 1


@law
def ask_for(
    constants: np.ndarray,
    states: np.ndarray,
    used: tuple[int, int],
    columns: tuple[int, int],
    row: int,
    rows: int,
) -> None:
    """Have so many rows from ``row`` on, of constants and then states, brought to the cache for later.

    ``used`` is how many of both are used.
    """
    for k in range(row, min(row + rows, used[0] + used[1])):
        for column in columns:
            if k < used[0]:
                prefetch(constants, k, column)
            else:
                prefetch(states, k - used[0], column)


@law
def load_effects(tile: np.ndarray, applied: np.ndarray, columns: np.ndarray) -> None:
    """Copy the values of the channels of every substep into the tile."""
    for f in range(OF_SUBSTEPS.shape[0]):
        for i in range(tile.shape[1]):
            tile[EFFECTS_IN_TILE + f, i] = applied[OF_SUBSTEPS[f], columns[i]]


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
def assign(
    arrays: Arrays,
    tile: np.ndarray,
    numbers: np.ndarray,
    lanes: np.ndarray,
    item: int,
    count: int,
    settings: Settings,
) -> None:
    """Write the columns, random numbers' keys and commands of ``count`` robots, from ``item`` on.

    Robots 0 of the given lanes come first, then robots 1, and so on.
    """
    for i in range(tile.shape[1]):
        j = item + min(i, count - 1)
        robot, lane = j // lanes.shape[0], lanes[j % lanes.shape[0]]
        numbers[COLUMN, i] = robot * arrays.states.shape[2] + lane
        set_draw(
            numbers,
            i,
            Draw(arrays.seeds[lane], robot, arrays.clock[lane, 2], arrays.clock[lane, 0]),
        )
        kind = arrays.kinds[robot, lane]
        dead, hold = delays(arrays, lane, robot, settings.dt)
        every, late = fix_timing(arrays, lane, robot, settings.dt)
        if settings.external_wheel_loop and kind != TORQUE:
            kind, hold = EXTERNAL_TORQUE, 0
        command = read_command(arrays.states, robot, lane)
        before = read_wanted_before(arrays.states, robot, lane)
        order = Order(
            kind=kind,
            wanted_l=command.left,
            wanted_r=command.right,
            before_l=before.left,
            before_r=before.right,
            hold=hold,
            dead=dead,
            fix_every=every,
            fix_delay=late,
            measured=0.0,
            arrived=0.0,
        )
        set_order(tile, i, first_times(order, arrays.clock[lane, 0]))


@law_in_double
def change_effects(
    arrays: Arrays, tile: np.ndarray, numbers: np.ndarray, count: int, settings: Settings
) -> None:
    """Evaluate the channels that may change in every substep."""
    lanes = arrays.states.shape[2]
    changed = False
    for i in range(count):
        draw, column = draw_of(numbers, i), numbers[COLUMN, i]
        lane, robot = column % lanes, draw.robot
        changed |= refresh(arrays, lane, robot, arrays.changing, draw.tick, 1, settings)
    if changed:
        load_effects(tile, flat(arrays.applied), columns_of(numbers))


@law
def delay_torques(torques: np.ndarray, tile: np.ndarray, numbers: np.ndarray, count: int) -> None:
    """Deliver the torques commanded one dead time ago; ``torques`` is their ring."""
    slots, lanes = torques.shape[1], torques.shape[3]
    for i in range(count):
        draw, column = draw_of(numbers, i), numbers[COLUMN, i]
        traction, effects = traction_of(tile, i), effects_of(tile, i)
        tick, dead = draw.tick + 1, int(order_of(tile, i).dead)
        ring = torques[:, :, draw.robot, column % lanes]
        ring[0, tick % slots], ring[1, tick % slots] = traction.commanded_l, traction.commanded_r
        delivered_l = delivered_r = 0.0
        if tick > dead:
            delivered_l, delivered_r = (
                ring[0, (tick - dead) % slots],
                ring[1, (tick - dead) % slots],
            )
        delivered_l *= effects.actuator_torque_gain_l
        delivered_r *= effects.actuator_torque_gain_r
        set_traction(tile, i, with_delivered(traction, delivered_l, delivered_r))


@law_in_double
def meet_patches(
    patches: np.ndarray,
    variants: np.ndarray,
    lanes: int,
    tile: np.ndarray,
    numbers: np.ndarray,
    base: np.ndarray,
    count: int,
) -> None:
    """Scale the friction of the tyres that are on a patch."""
    for i in range(count):
        traction, lane = traction_of(tile, i), numbers[COLUMN, i] % lanes
        on_l, on_r, on_c = wheel_factors(
            patches[variants[lane]], body_of(tile, i), placed(tile, base, i)
        )
        set_traction(
            tile,
            i,
            with_grip(
                traction, traction.grip_l * on_l, traction.grip_r * on_r, traction.grip_c * on_c
            ),
        )


@law
def differ(tile: np.ndarray, rows: np.ndarray, values: np.ndarray) -> bool:
    """Whether one of some rows of the tile has another value than given, for some robot."""
    found = False
    for f in range(rows.shape[0]):
        for i in range(tile.shape[1]):
            found |= tile[rows[f], i] != values[f]
    return found


@law
def differs(tile: np.ndarray, i: int, rows: np.ndarray, values: np.ndarray) -> bool:
    """Whether one of some rows has another value than given, for the robot in column ``i``."""
    found = False
    for f in range(rows.shape[0]):
        found |= tile[rows[f], i] != values[f]
    return found


@law
def limit_motors(tile: np.ndarray, count: int) -> None:
    """Deliver what the motors can.

    A gain may deliver more than the limit of the command. So a robot whose own channels limit nothing is
    left as it is, as in a tile in which none do.
    """
    for i in range(count):
        if not differs(tile, i, LIMITING, NOT_LIMITING):
            continue
        body, effects, traction = body_of(tile, i), effects_of(tile, i), traction_of(tile, i)
        motion = motion_of(tile, i)
        delivered_l = motor_torque(traction.delivered_l, motion.omega_l, body.torque_limit, effects)
        delivered_r = motor_torque(traction.delivered_r, motion.omega_r, body.torque_limit, effects)
        set_traction(tile, i, with_delivered(traction, delivered_l, delivered_r))


@law
def pull(tile: np.ndarray, count: int) -> None:
    """Pushes and slopes; on a slope, the floor carries less."""
    for i in range(count):
        effects, traction = effects_of(tile, i), traction_of(tile, i)
        set_push(tile, i, push_on(body_of(tile, i), effects))
        share = math.cos(effects.floor_slope_rad)
        set_traction(
            tile,
            i,
            with_grip(
                traction, traction.grip_l * share, traction.grip_r * share, traction.grip_c * share
            ),
        )


@law
def follow(tile: np.ndarray, substep: int, dt: float) -> None:
    """The ``kinematic`` plant."""
    for i in range(tile.shape[1]):
        effects = effects_of(tile, i)
        wanted_l, wanted_r = wanted(order_of(tile, i), substep)
        motion = follow_wheels(
            body_of(tile, i),
            motion_of(tile, i),
            wanted_l,
            wanted_r,
            effects.slip_delta_1_mm_s + 0.5 * (effects.slip_left_mm_s + effects.slip_right_mm_s),
            effects.slip_delta_2_rad_s
            + (effects.slip_right_mm_s - effects.slip_left_mm_s) / (2.0 * body_of(tile, i).h),
            dt,
        )
        set_motion(tile, i, motion)


@law
def ask(tile: np.ndarray, substep: int) -> None:
    """Wheel loops, up to the torques."""
    for i in range(tile.shape[1]):
        commanded_l, commanded_r, held = commanded_torques(
            body_of(tile, i),
            loop_of(tile, i),
            order_of(tile, i),
            held_of(tile, i),
            sensors_of(tile, i),
            substep,
        )
        set_held(tile, i, held)
        set_commanded(tile, i, WheelPair(commanded_l, commanded_r))
        set_traction(tile, i, undisturbed(commanded_l, commanded_r, effects_of(tile, i)))


@law
def hand_over(
    inputs: np.ndarray, lanes: int, tile: np.ndarray, numbers: np.ndarray, count: int
) -> None:
    """Write what a plant in Python needs for the substep."""
    for i in range(count):
        column, traction = numbers[COLUMN, i], traction_of(tile, i)
        robot, lane = column // lanes, column % lanes
        write_traction(inputs, robot, lane, traction)
        write_floor(
            inputs, robot, lane, floor_under(body_of(tile, i), effects_of(tile, i), traction)
        )
        write_push(inputs, robot, lane, push_of(tile, i))


@law_in_double
def exact_body(tile: np.ndarray, numbers: np.ndarray, constants: np.ndarray, i: int) -> Body:
    """A robot's body in double precision.

    Rounded, a mass times its inverse is not 1, and sweeps with such numbers never come to their tolerance.
    """
    if is_single(tile):
        return body_at(constants, numbers[COLUMN, i])
    return double_body(body_of(tile, i))


@law_in_double
def slide_alone(
    tile: np.ndarray,
    numbers: np.ndarray,
    constants: np.ndarray,
    first: int,
    last: int,
    dt: float,
) -> None:
    """By sweeps, robot by robot, those from ``first`` to before ``last`` whose wheels do not all roll.

    In double precision, as the sweeps stop at a tolerance that single precision does not reach.
    """
    for i in range(first, last):
        if tile[ROLLS, i] == 0.0:
            body, traction = (
                exact_body(tile, numbers, constants, i),
                double_traction(traction_of(tile, i)),
            )
            motion, impulses = slide(
                body,
                double_motion(motion_of(tile, i)),
                double_contact(contact_of(tile, i)),
                floor_under(body, double_effects(effects_of(tile, i)), traction),
                double_push(push_of(tile, i)),
                traction.delivered_l,
                traction.delivered_r,
                like(dt, 1.0),
            )
            set_moved(tile, i, motion)
            set_impulses(tile, i, impulses)


@law_in_double
def slide_together(
    tile: np.ndarray, numbers: np.ndarray, constants: np.ndarray, first: int, dt: float
) -> None:
    """By sweeps, side by side, those of eight robots from ``first`` on whose wheels do not all roll."""
    sweeps = table(SLIDE_ROWS, SLIDE_COLUMNS)
    for k in range(SLIDE_COLUMNS):
        i = first + k
        body, traction = (
            exact_body(tile, numbers, constants, i),
            double_traction(traction_of(tile, i)),
        )
        begin_slide(
            sweeps,
            k,
            tile[ROLLS, i] == 0.0,
            body,
            double_motion(motion_of(tile, i)),
            double_contact(contact_of(tile, i)),
            floor_under(body, double_effects(effects_of(tile, i)), traction),
            double_push(push_of(tile, i)),
            traction.delivered_l,
            traction.delivered_r,
            like(dt, 1.0),
        )
    sweep_together(sweeps)
    for k in range(SLIDE_COLUMNS):
        i = first + k
        slides = tile[ROLLS, i] == 0.0
        motion, impulses = end_slide(sweeps, k, double_motion(motion_of(tile, i)), like(dt, 1.0))
        set_moved(tile, i, chosen_motion(slides, motion, moved_of(tile, i)))
        set_impulses(tile, i, chosen_contact(slides, impulses, impulses_of(tile, i)))


@law
def move(
    tile: np.ndarray, numbers: np.ndarray, constants: np.ndarray, count: int, dt: float
) -> None:
    """The plant: all in closed form, then by sweeps those whose wheels do not all roll."""
    for i in range(tile.shape[1]):
        body, traction = body_of(tile, i), traction_of(tile, i)
        rolls, motion, impulses = roll(
            body,
            motion_of(tile, i),
            contact_of(tile, i),
            floor_under(body, effects_of(tile, i), traction),
            push_of(tile, i),
            traction.delivered_l,
            traction.delivered_r,
            dt,
        )
        set_moved(tile, i, motion)
        set_impulses(tile, i, impulses)
        tile[ROLLS, i] = 1.0 if rolls else 0.0
    for first in range(0, tile.shape[1], SLIDE_COLUMNS):
        last = min(first + SLIDE_COLUMNS, count)
        sliding = 0
        for i in range(first, last):
            if tile[ROLLS, i] == 0.0:
                sliding += 1
        if sliding > MOST_ALONE:
            slide_together(tile, numbers, constants, first, dt)
        elif sliding > 0:
            slide_alone(tile, numbers, constants, first, last, dt)
    for i in range(tile.shape[1]):
        motion, impulses = moved_of(tile, i), impulses_of(tile, i)
        limit = body_of(tile, i).torque_limit
        set_trace(
            tile,
            i,
            trace_drive(trace_of(tile, i), limit, traction_of(tile, i), motion, impulses, dt),
        )
        set_motion(tile, i, advance_pose(motion, dt))
        set_contact(tile, i, impulses)


class Needs(NamedTuple):
    """Which of the parts that are left out of a nominal substep some robot of a tile needs."""

    motors: bool
    pull: bool
    encoders: bool
    gyro: bool
    fixes: bool
    observers: bool


@law
def needs_of(tile: np.ndarray) -> Needs:
    """What the robots of a tile need."""
    return Needs(
        motors=differ(tile, LIMITING, NOT_LIMITING),
        pull=differ(tile, PULLING, NOT_PULLING),
        encoders=differ(tile, ENCODER_EFFECTS, NOMINAL_ENCODERS),
        gyro=differ(tile, GYRO_EFFECTS, NOMINAL_GYRO),
        fixes=differ(tile, FIX_NUMBERS, NOMINAL_FIXES),
        observers=differ(tile, SPEED_OBSERVERS, NO_SPEED_OBSERVER),
    )


class DueFixes(NamedTuple):
    """Whether a fix is due to be measured, or to come, for some robot of a tile."""

    measured: bool
    come: bool


@law
def count_to_fixes(tile: np.ndarray) -> DueFixes:
    """Go on to the next substep in the robots' times since fixes were due."""
    measured = come = False
    for i in range(tile.shape[1]):
        order = next_times(order_of(tile, i))
        set_order(tile, i, order)
        measured |= order.measured == 0.0
        come |= order.arrived == 0.0
    return DueFixes(measured, come)


@law
def measure_fixes(tile: np.ndarray, numbers: np.ndarray) -> None:
    """A position fix of every robot, at once."""
    for i in range(tile.shape[1]):
        motion, effects = motion_of(tile, i), effects_of(tile, i)
        set_fix(tile, i, measured_fix(body_of(tile, i), motion, effects, draw_of(numbers, i)))


@law
def repeat_fixes(tile: np.ndarray, dt: float) -> None:
    """No fix for any robot; the last one is repeated."""
    for i in range(tile.shape[1]):
        age = order_of(tile, i).fix_delay * dt
        x, y = tile[LAST_X, i], tile[LAST_Y, i]
        set_fix(tile, i, Fix(x=x, y=y, here=0.0, age=age, way_x=0.0, way_y=0.0))


@law
def deliver_fixes(
    ring: np.ndarray,
    tile: np.ndarray,
    numbers: np.ndarray,
    base: np.ndarray,
    count: int,
    settings: Settings,
) -> None:
    """Position fixes that come seldom, late, never or far off; ``ring`` (Fix, slot, column) keeps them."""
    slots = ring.shape[1]
    for i in range(count):
        draw, column = draw_of(numbers, i), numbers[COLUMN, i]
        order, effects, fix = order_of(tile, i), effects_of(tile, i), fix_of(tile, i)
        delay = int(order.fix_delay)
        here = 0.0 if missing(effects, order, draw) else 1.0
        if here > 0.0:
            fix = with_outlier(fix, effects, draw)
        x, y, way_x, way_y = fix.x, fix.y, 0.0, 0.0
        if delay > 0:
            if order.measured == 0.0:
                now = draw.tick % slots
                ring[FIX_X, now, column] = absolute(tile, base, BASE_X, i, x)
                ring[FIX_Y, now, column] = absolute(tile, base, BASE_Y, i, y)
                ring[HERE, now, column] = here
            here = 0.0
            if order.arrived == 0.0 and draw.tick > delay:
                then = (draw.tick - delay) % slots
                x = relative(tile, base, BASE_X, i, ring[FIX_X, then, column])
                y = relative(tile, base, BASE_Y, i, ring[FIX_Y, then, column])
                here = ring[HERE, then, column]
                way_x, way_y = ring[WAY_X, then, column], ring[WAY_Y, then, column]
        if here == 0.0:
            x, y = tile[LAST_X, i], tile[LAST_Y, i]
        set_fix(
            tile,
            i,
            Fix(x=x, y=y, here=here, age=delay * settings.dt, way_x=way_x, way_y=way_y),
        )


@law
def keep_ways(ring: np.ndarray, tile: np.ndarray, numbers: np.ndarray, count: int) -> None:
    """Keep the estimators' ways with the fixes that are measured now."""
    slots = ring.shape[1]
    for i in range(count):
        tick, column, sensors = numbers[TICK, i], numbers[COLUMN, i], sensors_of(tile, i)
        ring[WAY_X, tick % slots, column] = sensors.way_x
        ring[WAY_Y, tick % slots, column] = sensors.way_y


@law
def measure(tile: np.ndarray, numbers: np.ndarray, needs: Needs, dt: float) -> None:
    """Encoders and gyro, one tick on."""
    for i in range(tile.shape[1]):
        numbers[TICK, i] += 1
    if needs.encoders:
        for i in range(tile.shape[1]):
            reading = disturbed_encoders(
                motion_of(tile, i), effects_of(tile, i), draw_of(numbers, i)
            )
            set_reading(tile, i, reading)
    else:
        for i in range(tile.shape[1]):
            motion = motion_of(tile, i)
            set_reading(tile, i, Reading(motion.angle_l, motion.angle_r))
    if needs.gyro:
        for i in range(tile.shape[1]):
            motion, effects = motion_of(tile, i), effects_of(tile, i)
            rate = gyro_reading(motion, effects, draw_of(numbers, i), dt)
            set_yaw_rate(tile, i, YawRate(rate))
    else:
        for i in range(tile.shape[1]):
            set_yaw_rate(tile, i, YawRate(motion_of(tile, i).w))


@law
def correct_tile(tile: np.ndarray, estimator: int) -> None:
    """The estimators' corrections by the fixes."""
    for i in range(tile.shape[1]):
        estimate, slip, innovation = correct_robot(
            ekf_of(tile, i),
            slip_ekf_of(tile, i),
            fix_of(tile, i),
            sensors_of(tile, i),
            estimate_of(tile, i),
            slip_of(tile, i),
            estimator,
        )
        set_estimate(tile, i, estimate)
        if estimator == EKF_SLIP:
            set_slip(tile, i, slip)
        set_innovation(tile, i, innovation)


@law
def sense_tile(tile: np.ndarray, substep: int, estimator: int, fixes: bool, dt: float) -> None:
    """Wheel speeds and estimators; without ``fixes`` none has come to any robot."""
    if estimator == EKF_GYRO:
        for i in range(tile.shape[1]):
            sensors, estimate, slip, found, trace, sample = sense_with_gyro(
                body_of(tile, i),
                belief_of(tile, i),
                gyro_ekf_of(tile, i),
                reading_of(tile, i),
                fix_of(tile, i),
                yaw_rate_of(tile, i),
                commanded_of(tile, i),
                sensors_of(tile, i),
                estimate_of(tile, i),
                slip_of(tile, i),
                gyro_of(tile, i),
                trace_of(tile, i),
                dt,
            )
            set_sensors(tile, i, sensors)
            set_estimate(tile, i, estimate)
            set_slip(tile, i, slip)
            set_gyro(tile, i, found)
            set_trace(tile, i, trace)
            set_sample(tile, i, sample)
        return
    for i in range(tile.shape[1]):
        body, belief = body_of(tile, i), belief_of(tile, i)
        increments = odometry_of(body, belief, reading_of(tile, i), sensors_of(tile, i))
        set_increments(tile, i, increments)
        sensors, estimate, slip = predict_robot(
            body,
            belief,
            ekf_of(tile, i),
            slip_ekf_of(tile, i),
            motion_of(tile, i),
            increments,
            sensors_of(tile, i),
            estimate_of(tile, i),
            slip_of(tile, i),
            order_of(tile, i),
            substep,
            estimator,
            dt,
        )
        set_sensors(tile, i, sensors)
        set_estimate(tile, i, estimate)
        set_slip(tile, i, slip)
    # A loop for each estimator: with both in one, the loop does not become vectors.
    if fixes and estimator == EKF_SLIP:
        correct_tile(tile, EKF_SLIP)
    elif fixes and estimator == EKF:
        correct_tile(tile, EKF)
    else:
        for i in range(tile.shape[1]):
            set_slip(
                tile, i, correct_without_fix(slip_of(tile, i), slip_ekf_of(tile, i), estimator)
            )
            set_innovation(tile, i, Innovation(0.0, 0.0, 0.0))
    for i in range(tile.shape[1]):
        sensors, trace, sample = account_robot(
            reading_of(tile, i),
            fix_of(tile, i),
            yaw_rate_of(tile, i),
            commanded_of(tile, i),
            increments_of(tile, i),
            sensors_of(tile, i),
            estimate_of(tile, i),
            slip_of(tile, i),
            trace_of(tile, i),
            innovation_of(tile, i),
            dt,
        )
        set_sensors(tile, i, sensors)
        set_trace(tile, i, trace)
        set_sample(tile, i, sample)


@law
def observe_wheels(tile: np.ndarray, dt: float) -> None:
    """Wheel speeds by the velocity observers of the robots that have one."""
    for i in range(tile.shape[1]):
        row, reading, commanded = (
            speed_observer_of(tile, i),
            reading_of(tile, i),
            commanded_of(tile, i),
        )
        state = observed_speeds(
            observed_of(tile, i),
            reading.left,
            reading.right,
            commanded.left,
            commanded.right,
            row,
            dt,
        )
        if row.angle > 0.0:
            set_observed(tile, i, state)
            set_sensors(tile, i, with_speeds(sensors_of(tile, i), state.speed_l, state.speed_r))


@by_number
def advance(
    number: float,
    arrays: Arrays,
    lanes: np.ndarray,
    begin: int,
    end: int,
    actuates: bool,
    senses: bool,
    settings: Settings,
) -> None:
    """:func:`advance_in` a tile of its own, in the precision of a number."""
    tile = table_of(number, TILE_ROWS)
    numbers, base = integers_beside(number, WHOLE_ROWS), doubles_beside(number, BASES)
    dt = like(settings.dt, number)
    advance_in(tile, numbers, base, arrays, lanes, begin, end, actuates, senses, dt, settings)


@law
def advance_in(
    tile: np.ndarray,
    numbers: np.ndarray,
    base: np.ndarray,
    arrays: Arrays,
    lanes: np.ndarray,
    begin: int,
    end: int,
    actuates: bool,
    senses: bool,
    dt: float,
    settings: Settings,
) -> None:
    """Run the substeps ``begin`` to before ``end`` of a control step of some lanes, without contact.

    Without ``senses`` each stops after the plant's new velocities and poses, and without ``actuates`` it
    begins there.
    """
    constants, states, applied = flat(arrays.constants), flat(arrays.states), flat(arrays.applied)
    robots, lanes_in_all = arrays.states.shape[1], arrays.states.shape[2]
    samples = arrays.samples.reshape((*arrays.samples.shape[:2], robots * lanes_in_all))
    torques, patches, variants = arrays.torques, arrays.patches, arrays.variants
    fixes = arrays.fixes.reshape((*arrays.fixes.shape[:2], robots * lanes_in_all))
    # All samples of a control step are kept for those who read them, otherwise only the last.
    keeps = settings.has_parts or arrays.sensor_observations.shape[2] > 0
    columns = columns_of(numbers)
    used = WITHOUT_GYRO
    if settings.estimator == EKF_GYRO:
        used = constants.shape[0], STATE_FIELDS
    items, ahead = lanes.shape[0] * robots, used[0] + used[1]
    for item in range(0, items, tile.shape[1]):
        count = min(tile.shape[1], items - item)
        assign(arrays, tile, numbers, lanes, item, count, settings)
        load(tile, CONSTANTS_IN_TILE, constants, used[0], columns)
        load(tile, STATES_IN_TILE, states, used[1], columns)
        take_base(tile, base, states, columns)
        load_effects(tile, applied, columns)
        needs = needs_of(tile)
        if needs.fixes or settings.changing:  # the last fix of every robot
            for f in range(LAST_FIX.shape[0]):
                for i in range(tile.shape[1]):
                    last = samples[begin - 1, LAST_FIX[f], columns[i]]
                    tile[SAMPLE + LAST_FIX[f], i] = relative(tile, base, BASE_X + f, i, last)
        next_columns = columns_after(
            lanes, lanes_in_all, item + tile.shape[1], items, tile.shape[1]
        )
        for substep in range(begin, end):
            if end - begin > 1:
                share = ahead // (end - begin) + 1
                ask_for(constants, states, used, next_columns, (substep - begin) * share, share)
            if actuates:
                if settings.changing:
                    change_effects(arrays, tile, numbers, count, settings)
                    needs = needs_of(tile)
                if settings.kinematic:
                    follow(tile, substep, dt)
                else:
                    ask(tile, substep)
                    if torques.shape[1] > 1:
                        delay_torques(torques, tile, numbers, count)
                    if needs.motors:
                        limit_motors(tile, count)
                    if patches.shape[1] > 0:
                        meet_patches(patches, variants, lanes_in_all, tile, numbers, base, count)
                    for i in range(tile.shape[1]):
                        set_push(tile, i, Push(0.0, 0.0, 0.0))
                    if needs.pull:
                        pull(tile, count)
                    if settings.by_chipmunk:
                        hand_over(arrays.inputs, lanes_in_all, tile, numbers, count)
                    else:
                        move(tile, numbers, constants, count, dt)
            if senses:
                measure(tile, numbers, needs, dt)
                due = count_to_fixes(tile) if needs.fixes else DueFixes(True, True)
                if due.measured:
                    measure_fixes(tile, numbers)
                if needs.fixes:
                    if due.measured or due.come:
                        deliver_fixes(fixes, tile, numbers, base, count, settings)
                    else:
                        repeat_fixes(tile, dt)
                sense_tile(tile, substep, settings.estimator, due.measured or due.come, dt)
                if needs.observers:
                    observe_wheels(tile, dt)
                if needs.fixes and due.measured:
                    keep_ways(fixes, tile, numbers, count)
                if keeps or substep == end - 1:
                    for f in range(SAMPLE_FIELDS):
                        for i in range(count):
                            samples[substep, f, columns[i]] = tile[SAMPLE + f, i]
                    place_samples(samples[substep], tile, base, columns, count)
        store(tile, STATES_IN_TILE, states, used[1], columns, count)
        put_back(tile, base, states, columns, count)
    if senses:
        for i in range(lanes.shape[0]):
            arrays.clock[lanes[i], 0] += end - begin
