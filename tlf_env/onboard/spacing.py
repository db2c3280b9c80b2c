"""Distance that a robot keeps from its predecessor, from the last message of the predecessor.

Robots are treated as circles, as their outlines are. If a twist would let the two centres approach
faster than their distance allows, the excess is removed from the centre's velocity. Otherwise the twist is
not changed, bit for bit. This is not part of the paper.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, Positive
from tlf_env.numerics.compiled import law


class Spacing(Frozen):
    """Parameters of the distance keeping.

    Near ``distance_mm`` between the centres, their largest approach speed is ``gain_per_s`` times the
    distance beyond it (negative when closer: they have to separate). Farther away it is the speed that
    ``braking_mm_s2`` can stop.
    """

    distance_mm: Positive = 265.0
    gain_per_s: Positive = 2.0
    braking_mm_s2: Positive = 100.0
    outline_offset_mm: Positive = 30.0  # centre of the outline, behind c


class SpacingRow(NamedTuple):
    """The parameters for the compiled laws; distance 0 means no distance keeping."""

    distance: float
    gain: float
    braking: float
    behind: float


class Predecessor(NamedTuple):
    """The predecessor in the robot's estimated body frame: position (mm), turn, twist (mm/s, rad/s)."""

    forward: float
    right: float
    sin_turn: float
    cos_turn: float
    u_1: float
    u_2: float


def spacing_row(spacing: Spacing | None) -> SpacingRow:
    """The parameters for the compiled laws."""
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
    """Largest speed (mm/s) towards another centre, ``room`` (mm) before the distance to keep.

    The other centre moves away at ``leaving`` (mm/s). If it does, its own stopping distance is added to the
    room; if it comes closer, its speed is subtracted. Linear in the room near 0, and beyond by the square
    root for a constant deceleration, with a continuous slope.
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
    """The twist (mm/s, rad/s) closest to ``u`` that keeps the distance to a predecessor."""
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
