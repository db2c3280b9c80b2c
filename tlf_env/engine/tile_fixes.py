"""Position fixes of the robots in a tile: when they are measured, come late, seldom or never."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.engine.layout import Fix
from tlf_env.engine.sensors import measured_fix, missing, next_times, with_outlier
from tlf_env.engine.settings import Settings
from tlf_env.engine.tile_places import BASE_X, BASE_Y, absolute, relative
from tlf_env.engine.tile_rows import (
    COLUMN,
    LAST_X,
    LAST_Y,
    body_of,
    draw_of,
    effects_of,
    fix_of,
    motion_of,
    order_of,
    sensors_of,
    set_fix,
    set_order,
)
from tlf_env.numerics.compiled import law

FIX_X, FIX_Y, HERE, WAY_X, WAY_Y = (
    Fix._fields.index(name) for name in ("x", "y", "here", "way_x", "way_y")
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
        tick, column, sensors = draw_of(numbers, i).tick, numbers[COLUMN, i], sensors_of(tile, i)
        ring[WAY_X, tick % slots, column] = sensors.way_x
        ring[WAY_Y, tick % slots, column] = sensors.way_y
