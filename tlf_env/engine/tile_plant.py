"""A substep of the robots in a tile, up to the plant: channels, wheel loops, motors, floor, and motion."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.disturbances.model import wheel_factors
from tlf_env.engine.arrays import Arrays, write_floor, write_push, write_traction
from tlf_env.engine.effects import OF_SUBSTEPS, refresh
from tlf_env.engine.layout import EFFECTS_IN_TILE, WheelPair, in_tile
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
from tlf_env.engine.tile_places import (
    double_contact,
    double_effects,
    double_motion,
    double_push,
    double_traction,
    exact_body,
    placed,
)
from tlf_env.engine.tile_rows import (
    COLUMN,
    LIMITING,
    NOT_LIMITING,
    are_neighbours,
    body_of,
    columns_of,
    contact_of,
    differs,
    draw_of,
    effects_of,
    flat,
    held_of,
    impulses_of,
    loop_of,
    motion_of,
    moved_of,
    order_of,
    push_of,
    sensors_of,
    set_commanded,
    set_contact,
    set_held,
    set_impulses,
    set_motion,
    set_moved,
    set_push,
    set_trace,
    set_traction,
    trace_of,
    traction_of,
)
from tlf_env.numerics.compiled import law, law_in_double
from tlf_env.numerics.memory import copy_line, like, table
from tlf_env.numerics.rows import choosing
from tlf_env.physics.vehicle import (
    SLIDE_COLUMNS,
    SLIDE_ROWS,
    Body,
    Contact,
    Floor,
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

MOST_ALONE = 2  # sliding robots of eight that are faster one by one than side by side
ROLLS = in_tile("rolls", "all")
chosen_motion, chosen_contact = choosing(Motion), choosing(Contact)


@law
def load_effects(
    tile: np.ndarray, applied: np.ndarray, columns: np.ndarray, neighbours: bool
) -> None:
    """Copy the values of the channels of every substep into the tile; ``neighbours`` as for :func:`load`."""
    if neighbours:
        begin = int(columns[0])
        for f in range(OF_SUBSTEPS.shape[0]):
            copy_line(tile, EFFECTS_IN_TILE + f, 0, applied, OF_SUBSTEPS[f], begin)
        return
    for f in range(OF_SUBSTEPS.shape[0]):
        for i in range(tile.shape[1]):
            tile[EFFECTS_IN_TILE + f, i] = applied[OF_SUBSTEPS[f], columns[i]]


@law_in_double
def change_effects(
    arrays: Arrays, tile: np.ndarray, numbers: np.ndarray, count: int, settings: Settings
) -> bool:
    """Evaluate the channels that may change in every substep; return whether any may have."""
    lanes = arrays.states.shape[2]
    changed = False
    for i in range(count):
        draw, column = draw_of(numbers, i), numbers[COLUMN, i]
        lane, robot = column % lanes, draw.robot
        changed |= refresh(arrays, lane, robot, arrays.changing, draw.tick, 1, settings)
    if changed:
        columns = columns_of(numbers)
        load_effects(tile, flat(arrays.applied), columns, are_neighbours(columns, count))
    return changed


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
def sliding_robot(
    tile: np.ndarray, numbers: np.ndarray, constants: np.ndarray, i: int
) -> tuple[Body, Motion, Contact, Floor, Push, float, float]:
    """What sweeps need of a robot, with the torques that its motors deliver; in double precision.

    Sweeps stop at a tolerance that single precision does not reach.
    """
    body, traction = exact_body(tile, numbers, constants, i), double_traction(traction_of(tile, i))
    return (
        body,
        double_motion(motion_of(tile, i)),
        double_contact(contact_of(tile, i)),
        floor_under(body, double_effects(effects_of(tile, i)), traction),
        double_push(push_of(tile, i)),
        traction.delivered_l,
        traction.delivered_r,
    )


@law_in_double
def slide_alone(
    tile: np.ndarray,
    numbers: np.ndarray,
    constants: np.ndarray,
    first: int,
    last: int,
    dt: float,
) -> None:
    """By sweeps, robot by robot, those from ``first`` to before ``last`` whose wheels do not all roll."""
    for i in range(first, last):
        if tile[ROLLS, i] == 0.0:
            motion, impulses = slide(*sliding_robot(tile, numbers, constants, i), like(dt, 1.0))
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
        robot = sliding_robot(tile, numbers, constants, i)
        begin_slide(sweeps, k, tile[ROLLS, i] == 0.0, *robot, like(dt, 1.0))
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
        for k in range(SLIDE_COLUMNS):  # of a number that the compiler knows, in one vector
            if tile[ROLLS, first + k] == 0.0 and first + k < last:
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
