"""Distance that a robot keeps from its predecessor, by what it last heard of it.

Robots are circles for this purpose, as their outlines are. Where a twist would bring the two centres
together faster than their distance allows, the centre's velocity loses the excess. Farther away the
twist is left as it is, bit for bit. It is not the paper's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, Positive
from tlf_env.numerics.compiled import law


class Spacing(Frozen):
    """How a robot keeps its distance.

    Near ``distance_mm`` between the centres, the speed at which they may approach is ``gain_per_s`` times
    the distance beyond it (nearer, they have to part); farther away it is the speed that
    ``braking_mm_s2`` can stop.
    """

    distance_mm: Positive = 265.0
    gain_per_s: Positive = 2.0
    braking_mm_s2: Positive = 100.0
    outline_offset_mm: Positive = 30.0  # centre of the outline, behind c


class SpacingRow(NamedTuple):
    """The same numbers as the compiled law takes them; no distance is kept if it is 0."""

    distance: float
    gain: float
    braking: float
    behind: float


class Predecessor(NamedTuple):
    """A predecessor in the robot's estimated body frame: place (mm), turn, and twist (mm/s, rad/s)."""

    forward: float
    right: float
    sin_turn: float
    cos_turn: float
    u_1: float
    u_2: float


def spacing_row(spacing: Spacing | None) -> SpacingRow:
    """The numbers as the compiled law takes them."""
    if spacing is None:
        return SpacingRow(0.0, 1.0, 1.0, 1.0)
    return SpacingRow(
        spacing.distance_mm,
        spacing.gain_per_s,
        spacing.braking_mm_s2,
        spacing.outline_offset_mm,
    )


@law
def approach_speed(room: float, leaving: float, row: SpacingRow) -> float:
    """Speed (mm/s) towards another centre that has ``room`` (mm) left and itself leaves at ``leaving``.

    What leaves may stop, and needs its way for it; what comes closer is met that much slower. Linear
    near 0 and the root of a constant deceleration beyond, with one slope where they meet.
    """
    if leaving > 0.0:
        room += 0.5 * leaving * leaving / row.braking
        leaving = 0.0
    linear = row.braking / (row.gain * row.gain)
    if room <= linear:
        return leaving + row.gain * room
    return leaving + math.sqrt(row.braking * (2.0 * room - linear))


@law
def spaced_twist(
    u_1: float, u_2: float, predecessor: Predecessor, row: SpacingRow
) -> tuple[float, float]:
    """The twist (mm/s, rad/s) nearest to ``u`` that keeps the distance from a predecessor."""
    behind = row.behind
    d_forward = predecessor.forward + behind - behind * predecessor.cos_turn
    d_right = predecessor.right + behind * predecessor.sin_turn
    distance = math.sqrt(d_forward * d_forward + d_right * d_right)
    if not distance > 0.0:
        return u_1, u_2
    n_forward, n_right = d_forward / distance, d_right / distance
    swing = behind * predecessor.u_2
    leaving = n_forward * (
        predecessor.u_1 * predecessor.cos_turn + swing * predecessor.sin_turn
    ) + n_right * (swing * predecessor.cos_turn - predecessor.u_1 * predecessor.sin_turn)
    approach = approach_speed(distance - row.distance, leaving, row)
    excess = n_forward * u_1 + n_right * behind * u_2 - approach
    if excess <= 0.0:
        return u_1, u_2
    return u_1 - excess * n_forward, u_2 - excess * n_right / behind
