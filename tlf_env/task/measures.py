"""True errors of one robot."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.numerics.compiled import law
from tlf_env.numerics.indices import natural, slot_of

TIME_GAP_WINDOW_S = 2.0
ROUNDING_MM = 1e-6  # above the rounding error of a distance, and of a way
STEPS_TO_TRY = (
    8  # steps to leave out are tried less by this share of them, until they are few enough
)
FEW_SEGMENTS = 8  # so many are looked at one by one


@law
def distance(x_a: float, y_a: float, x_b: float, y_b: float) -> float:
    """Distance between two points, mm."""
    return math.sqrt((x_a - x_b) ** 2 + (y_a - y_b) ** 2)


@law
def nearest_on_segment(
    x: float, y: float, x_a: float, y_a: float, x_b: float, y_b: float
) -> tuple[float, float]:
    """The point of the segment a–b nearest to (x, y): fraction along the segment, and squared distance."""
    d_x, d_y = x_b - x_a, y_b - y_a
    length_2 = d_x * d_x + d_y * d_y
    along = (x - x_a) * d_x + (y - y_a) * d_y
    fraction = min(max(along / length_2, 0.0), 1.0) if length_2 > 0.0 else 0.0
    r_x, r_y = x_a + fraction * d_x - x, y_a + fraction * d_y - y
    return fraction, r_x * r_x + r_y * r_y


@law
def steps_within(ways: np.ndarray, at: int, most: int, direction: int, room: float) -> int:
    """How many steps from slot ``at`` of a ring surely take less way than ``room``, mm; at most ``most``.

    ``ways[slot]`` is the way so far. ``direction`` is 1 for later steps and −1 for earlier ones. The
    number is not always the largest one.
    """
    slots = ways.shape[0]
    steps = most if room > 0.0 else 0
    while steps > 0:
        there = at + direction * steps
        there += slots if there < 0 else (-slots if there >= slots else 0)
        if direction * (ways[natural(there)] - ways[at]) < room:
            break
        steps -= steps // STEPS_TO_TRY + 1
    return steps


@law
def time_gap_error(
    x: float,
    y: float,
    path: np.ndarray,
    step: int,
    gap_steps: int,
    window_steps: int,
    period_s: float,
) -> float:
    """Time since the predecessor passed the follower's position, minus the time gap, s.

    ``path[field, slot]`` is a ring of the predecessor's true positions and its way so far (mm), one for
    each control step; the nearest point within ±``window_steps`` of one gap ago is used. Positive: the
    follower is late. 0 until one gap has passed.

    No point of the path is farther from another than the way between them. So points whose distance from
    the follower exceeds the smallest one known, by more than the way to other points, exclude these.
    """
    if step < gap_steps:
        return 0.0
    slots = path.shape[1]
    first = max(step - gap_steps - window_steps, 0)
    last = min(step - gap_steps + window_steps, step)
    if first >= last:
        return 0.0
    likely = max(min(step - gap_steps, last - 1), first)
    a = slot_of(likely, slots)
    b = a + 1 if a + 1 < slots else 0
    _, squared = nearest_on_segment(x, y, path[0, a], path[1, a], path[0, b], path[1, b])
    within = math.sqrt(squared) + ROUNDING_MM  # upper bound on the smallest distance
    # From both ends towards there, as far as all points are surely farther away.
    low, high = first, last
    while low < likely:
        a = slot_of(low, slots)
        room = distance(x, y, path[0, a], path[1, a]) - within
        steps = steps_within(path[2], a, likely - low, 1, room)
        if steps == 0:
            break
        low += steps
    while high > likely + 1:
        a = slot_of(high, slots)
        room = distance(x, y, path[0, a], path[1, a]) - within
        steps = steps_within(path[2], a, high - likely - 1, -1, room)
        if steps == 0:
            break
        high -= steps
    best, best_step = math.inf, 0.0
    while low < high:
        a = slot_of(low, slots)
        b = a + 1 if a + 1 < slots else 0
        fraction, squared = nearest_on_segment(x, y, path[0, a], path[1, a], path[0, b], path[1, b])
        if squared < best:
            best, best_step = squared, low + fraction
            within = min(within, math.sqrt(squared) + ROUNDING_MM)
        low += 1
        if high - low > FEW_SEGMENTS:
            room = distance(x, y, path[0, b], path[1, b]) - within
            low += steps_within(path[2], b, high - low, 1, room)
    if math.isinf(best):
        return 0.0
    return (step - best_step - gap_steps) * period_s
