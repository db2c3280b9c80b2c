"""The substeps of a control step, many robots at once.

Robots do not act on each other within a control step unless they touch, so robots and lanes are all
alike here: items. Some items at a time are copied into a *tile*, an array with a row for each quantity
and a column for each item, small enough for the processor's nearest cache. Each law then runs over the
columns in a loop of its own. The compiler knows the tile's shape and inlines the law, so that it turns the
loop into vector instructions: eight items at once where registers are wide enough. What needs branches
of its own (sweeps, changing channels, patches, dead time) is done item by item.

A vector and a single item go through the same additions and multiplications, so a formation's bits do
not depend on what else is in its tile. A last tile that is not full repeats its last item.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from tlf_env.disturbances.channels import SUBSTEP_CHANNELS
from tlf_env.disturbances.model import Effects, wheel_factors
from tlf_env.engine.layout import Arrays, Sample, Sensors, Trace
from tlf_env.engine.settings import Settings
from tlf_env.engine.substeps import (
    EXTERNAL_TORQUE,
    Draw,
    Drive,
    Order,
    Reading,
    asked_torques,
    delays,
    disturbed_encoders,
    floor_under,
    refresh,
    sense_robot,
    trace_drive,
    undisturbed,
    wanted,
)
from tlf_env.numerics.compiled import allocating, block, law, row_reader, row_writer, view
from tlf_env.onboard.estimator import Ekf, Estimate
from tlf_env.onboard.slip_estimator import SlipEkf, SlipEstimate
from tlf_env.onboard.wheel_loop import WheelLoopRow, WheelLoopState
from tlf_env.physics.vehicle import (
    Body,
    Contact,
    Motion,
    Push,
    advance_pose,
    follow_wheels,
    roll,
    slide,
)
from tlf_env.task.actions import TORQUE

WIDTH = 8  # items in a tile: doubles in the widest vectors there are
NO_PUSH = Push(0.0, 0.0, 0.0)

# Rows of a tile: named tuples one after the other, then whether all wheels roll, and the column.


def _first_rows(rows: tuple[type[Any], ...]) -> list[int]:
    """Where each named tuple begins, and then where the last one ends."""
    return [0, *itertools.accumulate(len(row._fields) for row in rows)]


(
    BODY,
    LOOP,
    EKF_ROW,
    SLIP_EKF,
    EFFECTS,
    MOTION,
    CONTACT,
    HELD,
    SENSORS,
    ESTIMATE,
    SLIP,
    TRACE,
    SAMPLE,
    ORDER,
    DRIVE,
    READING,
    MOVED,  # the motion as the plant leaves it, before the pose is advanced
    IMPULSES,  # the contact, likewise
    DRAW,
    ROLLS,
) = _first_rows(
    (
        Body,
        WheelLoopRow,
        Ekf,
        SlipEkf,
        Effects,
        Motion,
        Contact,
        WheelLoopState,
        Sensors,
        Estimate,
        SlipEstimate,
        Trace,
        Sample,
        Order,
        Drive,
        Reading,
        Motion,
        Contact,
        Draw,
    )
)
COLUMN = ROLLS + 1  # robot · lanes + lane: the item's column in the arrays
ROWS = COLUMN + 1

body_of = row_reader(Body, BODY)
loop_of = row_reader(WheelLoopRow, LOOP)
ekf_of = row_reader(Ekf, EKF_ROW)
slip_ekf_of = row_reader(SlipEkf, SLIP_EKF)
effects_of = row_reader(Effects, EFFECTS)
motion_of, set_motion = row_reader(Motion, MOTION), row_writer(Motion, MOTION)
contact_of, set_contact = row_reader(Contact, CONTACT), row_writer(Contact, CONTACT)
held_of, set_held = row_reader(WheelLoopState, HELD), row_writer(WheelLoopState, HELD)
sensors_of, set_sensors = row_reader(Sensors, SENSORS), row_writer(Sensors, SENSORS)
estimate_of, set_estimate = row_reader(Estimate, ESTIMATE), row_writer(Estimate, ESTIMATE)
slip_of, set_slip = row_reader(SlipEstimate, SLIP), row_writer(SlipEstimate, SLIP)
trace_of, set_trace = row_reader(Trace, TRACE), row_writer(Trace, TRACE)
set_sample = row_writer(Sample, SAMPLE)
order_of, set_order = row_reader(Order, ORDER), row_writer(Order, ORDER)
drive_of, set_drive = row_reader(Drive, DRIVE), row_writer(Drive, DRIVE)
reading_of, set_reading = row_reader(Reading, READING), row_writer(Reading, READING)
moved_of, set_moved = row_reader(Motion, MOVED), row_writer(Motion, MOVED)
impulses_of, set_impulses = row_reader(Contact, IMPULSES), row_writer(Contact, IMPULSES)
draw_of, set_draw = row_reader(Draw, DRAW), row_writer(Draw, DRAW)  # of the tile as whole numbers
TICK = DRAW + Draw._fields.index("tick")
ENCODER_STD = EFFECTS + Effects._fields.index("encoder_std")
QUANTUM = EFFECTS + Effects._fields.index("quantum")


@view
def whole(tile: np.ndarray) -> np.ndarray:
    """The tile as whole numbers, for the rows that hold such."""
    return tile.view(np.int64)


@view
def columns_of(tile: np.ndarray) -> np.ndarray:
    """The row of columns; unsigned, so that no index can count from an array's end."""
    return tile.view(np.uint64)[COLUMN]


@view
def flat(array: np.ndarray) -> np.ndarray:
    """An array (field, robot, lane) as (field, column)."""
    return array.reshape((array.shape[0], array.shape[1] * array.shape[2]))


@law
def load(tile: np.ndarray, first: int, array: np.ndarray, columns: np.ndarray) -> None:
    """Copy a flat array's fields into the tile's rows from ``first`` on."""
    for f in range(array.shape[0]):
        for i in range(WIDTH):
            tile[first + f, i] = array[f, columns[i]]


@law
def store(tile: np.ndarray, first: int, array: np.ndarray, columns: np.ndarray, count: int) -> None:
    """Copy the tile's rows from ``first`` on back, for its first ``count`` items."""
    for f in range(array.shape[0]):
        for i in range(count):
            array[f, columns[i]] = tile[first + f, i]


@law
def assign(
    a: Arrays, tile: np.ndarray, lanes: np.ndarray, item: int, count: int, s: Settings
) -> None:
    """Write who a tile's items are and what they are asked for: ``count`` of them, from ``item`` on.

    Items are the robots 0 of the given lanes, then the robots 1, and so on.
    """
    numbers = whole(tile)
    for i in range(WIDTH):
        j = item + min(i, count - 1)
        r, lane = j // lanes.shape[0], lanes[j % lanes.shape[0]]
        numbers[COLUMN, i] = r * a.motions.shape[2] + lane
        set_draw(numbers, i, Draw(a.seeds[lane], r, a.clock[lane, 2], a.clock[lane, 0]))
        kind = a.kinds[r, lane]
        dead, hold = delays(a, lane, r, s.dt)
        if s.external_wheel_loop and kind != TORQUE:
            kind, hold = EXTERNAL_TORQUE, 0
        order = Order(
            kind,
            a.commands[0, r, lane],
            a.commands[1, r, lane],
            a.wanted_before[0, r, lane],
            a.wanted_before[1, r, lane],
            hold,
            dead,
        )
        set_order(tile, i, order)


@block
def change_effects(a: Arrays, tile: np.ndarray, count: int, s: Settings) -> None:
    """Evaluate the channels that may change in every substep."""
    lanes = a.motions.shape[2]
    changed = False
    for i in range(count):
        draw, column = draw_of(whole(tile), i), whole(tile)[COLUMN, i]
        changed |= refresh(a, column % lanes, draw.robot, 0, SUBSTEP_CHANNELS, draw.tick, 1, s)
    if changed:
        load(tile, EFFECTS, flat(a.applied[:SUBSTEP_CHANNELS]), columns_of(tile))


@block
def delay_torques(torques: np.ndarray, tile: np.ndarray, count: int) -> None:
    """Deliver the torques asked for one dead time ago; ``torques`` is their ring."""
    slots, lanes = torques.shape[1], torques.shape[3]
    for i in range(count):
        draw, column = draw_of(whole(tile), i), whole(tile)[COLUMN, i]
        drive, effects = drive_of(tile, i), effects_of(tile, i)
        tick, dead = draw.tick + 1, int(order_of(tile, i).dead)
        ring = torques[:, :, draw.robot, column % lanes]
        ring[0, tick % slots], ring[1, tick % slots] = drive.asked_l, drive.asked_r
        given_l = given_r = 0.0
        if tick > dead:
            given_l, given_r = ring[0, (tick - dead) % slots], ring[1, (tick - dead) % slots]
        given_l *= effects.gain_l
        given_r *= effects.gain_r
        set_drive(
            tile,
            i,
            Drive(
                drive.asked_l,
                drive.asked_r,
                given_l,
                given_r,
                drive.grip_l,
                drive.grip_r,
                drive.grip_c,
            ),
        )


@block
def meet_patches(
    patches: np.ndarray, variants: np.ndarray, lanes: int, tile: np.ndarray, count: int
) -> None:
    """Scale the friction of the tyres that stand on a patch."""
    for i in range(count):
        drive, lane = drive_of(tile, i), whole(tile)[COLUMN, i] % lanes
        on_l, on_r, on_c = wheel_factors(
            patches[variants[lane]], body_of(tile, i), motion_of(tile, i)
        )
        set_drive(
            tile,
            i,
            Drive(
                drive.asked_l,
                drive.asked_r,
                drive.given_l,
                drive.given_r,
                drive.grip_l * on_l,
                drive.grip_r * on_r,
                drive.grip_c * on_c,
            ),
        )


@law
def follow(tile: np.ndarray, k: int, dt: float) -> None:
    """The ``kinematic`` plant."""
    for i in range(WIDTH):
        effects = effects_of(tile, i)
        wanted_l, wanted_r = wanted(order_of(tile, i), k)
        motion = follow_wheels(
            body_of(tile, i),
            motion_of(tile, i),
            wanted_l,
            wanted_r,
            effects.delta_1,
            effects.delta_2,
            dt,
        )
        set_motion(tile, i, motion)


@law
def ask(tile: np.ndarray, k: int) -> None:
    """Wheel loops, up to the torques."""
    for i in range(WIDTH):
        asked_l, asked_r, held = asked_torques(
            body_of(tile, i),
            loop_of(tile, i),
            order_of(tile, i),
            held_of(tile, i),
            sensors_of(tile, i),
            k,
        )
        set_held(tile, i, held)
        set_drive(tile, i, undisturbed(asked_l, asked_r, effects_of(tile, i)))


@law
def move(tile: np.ndarray, count: int, dt: float) -> None:
    """The plant: all in closed form, then by sweeps those whose wheels do not all roll."""
    for i in range(WIDTH):
        body, drive = body_of(tile, i), drive_of(tile, i)
        rolls, motion, impulses = roll(
            body,
            motion_of(tile, i),
            contact_of(tile, i),
            floor_under(body, effects_of(tile, i), drive),
            NO_PUSH,
            drive.given_l,
            drive.given_r,
            dt,
        )
        set_moved(tile, i, motion)
        set_impulses(tile, i, impulses)
        tile[ROLLS, i] = 1.0 if rolls else 0.0
    for i in range(count):
        if tile[ROLLS, i] == 0.0:
            body, drive = body_of(tile, i), drive_of(tile, i)
            motion, impulses = slide(
                body,
                motion_of(tile, i),
                contact_of(tile, i),
                floor_under(body, effects_of(tile, i), drive),
                NO_PUSH,
                drive.given_l,
                drive.given_r,
                dt,
            )
            set_moved(tile, i, motion)
            set_impulses(tile, i, impulses)
    for i in range(WIDTH):
        motion, impulses = moved_of(tile, i), impulses_of(tile, i)
        limit = body_of(tile, i).torque_limit
        set_trace(
            tile, i, trace_drive(trace_of(tile, i), limit, drive_of(tile, i), motion, impulses, dt)
        )
        set_motion(tile, i, advance_pose(motion, dt))
        set_contact(tile, i, impulses)


@law
def any_positive(tile: np.ndarray, row: int) -> bool:
    """Whether some item has more than 0 in a row."""
    found = False
    for i in range(WIDTH):
        found |= tile[row, i] > 0.0
    return found


@law
def sense_tile(tile: np.ndarray, k: int, estimator: int, dt: float) -> None:
    """Encoders, position fixes and estimators, one tick on."""
    numbers = whole(tile)
    for i in range(WIDTH):
        numbers[TICK, i] += 1
    if any_positive(tile, ENCODER_STD) or any_positive(tile, QUANTUM):
        for i in range(WIDTH):
            reading = disturbed_encoders(
                motion_of(tile, i), effects_of(tile, i), draw_of(numbers, i)
            )
            set_reading(tile, i, reading)
    else:
        for i in range(WIDTH):
            motion = motion_of(tile, i)
            set_reading(tile, i, Reading(motion.angle_l, motion.angle_r))
    for i in range(WIDTH):
        sensors, estimate, slip, trace, sample = sense_robot(
            body_of(tile, i),
            ekf_of(tile, i),
            slip_ekf_of(tile, i),
            effects_of(tile, i),
            motion_of(tile, i),
            reading_of(tile, i),
            sensors_of(tile, i),
            estimate_of(tile, i),
            slip_of(tile, i),
            trace_of(tile, i),
            draw_of(numbers, i),
            order_of(tile, i),
            k,
            estimator,
            dt,
        )
        set_sensors(tile, i, sensors)
        set_estimate(tile, i, estimate)
        set_slip(tile, i, slip)
        set_trace(tile, i, trace)
        set_sample(tile, i, sample)


@allocating
def advance(
    a: Arrays, lanes: np.ndarray, begin: int, end: int, actuates: bool, senses: bool, s: Settings
) -> None:
    """:func:`advance_in` a tile of its own."""
    advance_in(np.empty((ROWS, WIDTH)), a, lanes, begin, end, actuates, senses, s)


@block
def advance_in(
    tile: np.ndarray,
    a: Arrays,
    lanes: np.ndarray,
    begin: int,
    end: int,
    actuates: bool,
    senses: bool,
    s: Settings,
) -> None:
    """Run the substeps ``begin`` to before ``end`` of a control step of some lanes, without contact.

    Without ``senses`` each stops after the plant's new velocities and poses, and without ``actuates`` it
    begins there.
    """
    bodies, loops, ekfs = flat(a.bodies), flat(a.wheel_loops), flat(a.ekfs)
    applied = flat(a.applied[:SUBSTEP_CHANNELS])
    motions, contacts, traces = flat(a.motions), flat(a.contacts), flat(a.traces)
    held, sensors, estimates = flat(a.loop_states), flat(a.sensors), flat(a.estimates)
    slip_ekfs, slips = flat(a.slip_ekfs), flat(a.slip_estimates)
    samples = a.samples.reshape((*a.samples.shape[:2], a.motions.shape[1] * a.motions.shape[2]))
    torques, patches, variants = a.torques, a.patches, a.variants
    columns = columns_of(tile)
    items = lanes.shape[0] * a.motions.shape[1]
    for item in range(0, items, WIDTH):
        count = min(WIDTH, items - item)
        assign(a, tile, lanes, item, count, s)
        load(tile, BODY, bodies, columns)
        load(tile, LOOP, loops, columns)
        load(tile, EKF_ROW, ekfs, columns)
        load(tile, SLIP_EKF, slip_ekfs, columns)
        load(tile, EFFECTS, applied, columns)
        load(tile, MOTION, motions, columns)
        load(tile, CONTACT, contacts, columns)
        load(tile, HELD, held, columns)
        load(tile, SENSORS, sensors, columns)
        load(tile, ESTIMATE, estimates, columns)
        load(tile, SLIP, slips, columns)
        load(tile, TRACE, traces, columns)
        for k in range(begin, end):
            if actuates:
                if s.changing:
                    change_effects(a, tile, count, s)
                if s.kinematic:
                    follow(tile, k, s.dt)
                else:
                    ask(tile, k)
                    if torques.shape[1] > 1:
                        delay_torques(torques, tile, count)
                    if patches.shape[1] > 0:
                        meet_patches(patches, variants, a.motions.shape[2], tile, count)
                    move(tile, count, s.dt)
            if senses:
                sense_tile(tile, k, s.estimator, s.dt)
                for f in range(samples.shape[1]):
                    for i in range(count):
                        samples[k, f, columns[i]] = tile[SAMPLE + f, i]
        store(tile, MOTION, motions, columns, count)
        store(tile, CONTACT, contacts, columns, count)
        store(tile, HELD, held, columns, count)
        store(tile, SENSORS, sensors, columns, count)
        store(tile, ESTIMATE, estimates, columns, count)
        store(tile, SLIP, slips, columns, count)
        store(tile, TRACE, traces, columns, count)
    if senses:
        for i in range(lanes.shape[0]):
            a.clock[lanes[i], 0] += end - begin
