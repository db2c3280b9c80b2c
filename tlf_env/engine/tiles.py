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

import numpy as np

from tlf_env.engine.arrays import DOUBLES_PER_CACHE_LINE, Arrays, read_command, read_wanted_before
from tlf_env.engine.effects import OF_SUBSTEPS, delays, fix_timing
from tlf_env.engine.layout import (
    CONSTANTS_IN_TILE,
    STATE_FIELDS,
    STATES_IN_TILE,
    TILE_ROWS,
    WHOLE_ROWS,
    WITHOUT_GYRO,
    Draw,
    Order,
)
from tlf_env.engine.sensors import (
    first_times,
)
from tlf_env.engine.settings import Settings
from tlf_env.engine.tile_fixes import (
    DueFixes,
    count_to_fixes,
    deliver_fixes,
    keep_ways,
    measure_fixes,
    repeat_fixes,
)
from tlf_env.engine.tile_needs import needs_of
from tlf_env.engine.tile_places import (
    BASE_X,
    BASES,
    LAST_FIX,
    place_samples,
    put_back,
    relative,
    take_base,
)
from tlf_env.engine.tile_plant import (
    ask,
    change_effects,
    delay_torques,
    follow,
    hand_over,
    limit_motors,
    load_effects,
    meet_patches,
    move,
    pull,
)
from tlf_env.engine.tile_rows import (
    COLUMN,
    SAMPLE,
    SAMPLE_FIELDS,
    are_neighbours,
    columns_of,
    flat,
    load,
    set_draw,
    set_order,
    set_push,
    store,
)
from tlf_env.engine.tile_sensing import measure, observe_wheels, sense_tile
from tlf_env.numerics.compiled import by_number, law, law_in_double
from tlf_env.numerics.indices import natural
from tlf_env.numerics.memory import doubles_beside, integers_beside, like, prefetch, table_of
from tlf_env.onboard.kinds import EKF_GYRO
from tlf_env.physics.vehicle import Push
from tlf_env.task.actions import EXTERNAL_TORQUE, TORQUE

# Robots in a tile: as many as numbers in the widest vectors there are, 8 doubles or 16 of single precision.
WIDTH = 8


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
    applied: np.ndarray,
    used: tuple[int, int],
    columns: tuple[int, int],
    row: int,
    rows: int,
) -> None:
    """Have so many rows from ``row`` on, of constants, states and channels, brought to the cache for later.

    ``used`` is how many of constants and states are used.
    """
    first, last = columns
    is_one_line = first // DOUBLES_PER_CACHE_LINE == last // DOUBLES_PER_CACHE_LINE
    all_used = used[0] + used[1]
    for k in range(row, min(row + rows, all_used + OF_SUBSTEPS.shape[0])):
        if k < used[0]:
            array, field = constants, k
        elif k < all_used:
            array, field = states, k - used[0]
        else:
            array, field = applied, OF_SUBSTEPS[k - all_used]
        prefetch(array, field, first)
        if not is_one_line:
            prefetch(array, field, last)


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
        j, number = natural(item + min(i, count - 1)), natural(lanes.shape[0])
        robot, lane = j // number, natural(lanes[j % number])
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
    items, ahead = lanes.shape[0] * robots, used[0] + used[1] + OF_SUBSTEPS.shape[0]
    for item in range(0, items, tile.shape[1]):
        count = min(tile.shape[1], items - item)
        assign(arrays, tile, numbers, lanes, item, count, settings)
        neighbours = are_neighbours(columns, count)
        load(tile, CONSTANTS_IN_TILE, constants, used[0], columns, neighbours)
        load(tile, STATES_IN_TILE, states, used[1], columns, neighbours)
        take_base(tile, base, states, columns)
        load_effects(tile, applied, columns, neighbours)
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
                row = (substep - begin) * share
                ask_for(constants, states, applied, used, next_columns, row, share)
            if actuates:
                if settings.changing and change_effects(arrays, tile, numbers, count, settings):
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
                measure(tile, numbers, needs.encoders, needs.gyro, dt)
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
        store(tile, STATES_IN_TILE, states, used[1], columns, count, neighbours)
        put_back(tile, base, states, columns, count)
    if senses:
        for i in range(lanes.shape[0]):
            arrays.clock[lanes[i], 0] += end - begin
