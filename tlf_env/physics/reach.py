"""How far things may come within a time: what is out of reach, and for how long."""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import law

CLOSE_MARGIN_MM = 10.0  # what could come closer to an outline than this is within reach
FASTEST_CHANGE_MM_S2 = (
    1500.0  # of a robot's velocity: above all tyres at twice the paper's friction
)
# With this, time is counted in which things stay out of reach: far above the former, so that a floor that
# moves under the wheels, or much friction, is included.
CALM_CHANGE_MM_S2 = 6000.0


def way(speed: float, time_s: float) -> float:
    """How far something may come in a time, mm, that may change its speed by ``CALM_CHANGE_MM_S2``."""
    return (speed + CALM_CHANGE_MM_S2 / 2.0 * time_s) * time_s


def time_for(speed: float, way_mm: float) -> float:
    """In what time :func:`way` is ``way_mm``, at least 0, s."""
    change = CALM_CHANGE_MM_S2
    return (math.sqrt(speed * speed + 2.0 * change * max(way_mm, 0.0)) - speed) / change


compiled_time_for = law(time_for)
