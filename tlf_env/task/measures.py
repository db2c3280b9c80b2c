"""True errors of one robot."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.numerics.compiled import law

TIME_GAP_WINDOW_S = 2.0
ROUNDING_MM = 1e-6  # above the rounding error of a distance


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
def time_gap_error(
    x: float,
    y: float,
    path: np.ndarray,
    step: int,
    gap_steps: int,
    window_steps: int,
    period_s: float,
    longest: float,
) -> float:
    """Time since the predecessor passed the follower's position, minus the time gap, s.

    ``path[axis, slot]`` is a ring of the predecessor's true positions, one per control step; the nearest
    point within ±``window_steps`` of one gap ago is used. Positive: the follower is late. 0 until one gap
    has passed. ``longest`` is an upper bound on the distance between neighbours in the ring, mm; it allows
    skipping points that are too far away to be the nearest.
    """
    if step < gap_steps:
        return 0.0
    slots = path.shape[1]
    first = max(step - gap_steps - window_steps, 0)
    last = min(step - gap_steps + window_steps, step)
    if first >= last:
        return 0.0
    a = max(min(step - gap_steps, last - 1), first) % slots
    b = a + 1 if a + 1 < slots else 0
    _, squared = nearest_on_segment(x, y, path[0, a], path[1, a], path[0, b], path[1, b])
    within = math.sqrt(squared) + ROUNDING_MM  # upper bound on the smallest distance
    best, best_step = math.inf, 0.0
    k, a = first, first % slots
    while k < last:
        spare = distance(x, y, path[0, a], path[1, a]) - within
        if spare > longest:  # the next segments are farther away
            passed = int(min(spare / longest, 1.0 * (last - k))) if longest > 0.0 else last - k
            k, a = k + passed, a + passed
            a = a - slots if a >= slots else a  # the ring holds more than the window
        else:
            b = a + 1 if a + 1 < slots else 0
            fraction, squared = nearest_on_segment(
                x, y, path[0, a], path[1, a], path[0, b], path[1, b]
            )
            if squared < best:
                best, best_step = squared, k + fraction
                within = min(within, math.sqrt(squared) + ROUNDING_MM)
            k, a = k + 1, b
    if math.isinf(best):
        return 0.0
    return (step - best_step - gap_steps) * period_s
