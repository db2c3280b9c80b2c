"""Supervisor: a robot slows down for a robot that it hears besides its predecessor, waits, and goes on.

From both twists follows how near the two outlines will come (their closest point of approach). If that is too
near, the robot takes another speed along its own path, the largest lower one that avoids it; where none does,
as in the middle of a crossing, a higher one that clears the way. Velocity obstacles choose among velocities
likewise (Fiorini and Shiller, "Motion planning in dynamic environments using velocity obstacles",
International Journal of Robotics Research 17(7), 1998, pages 760 to 772). Otherwise the twist is not changed,
bit for bit. This is not part of the paper.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from pydantic import Field

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.numerics.compiled import law
from tlf_env.onboard.observer import Message, dead_reckoned

MOST_RANGE_MM = 5000.0  # beyond it the entries of the observation are clipped
INSTANTS = 15  # at which predicted places are compared; in between, the motion counts as straight
SPEEDS = 8  # lower and higher ones that are tried, evenly down to rest and up to clearing_mm_s
HALVINGS = 5  # of the interval between the largest lower speed that is allowed and the next above
# Way on which a robot corrects its errors; after it, its path bends as that of its reference.
CORRECTION_MM = 300.0
SLOW_MM_S = 50.0  # below it, a curvature is counted as at this speed


class Neighbour(Frozen):
    """A robot's reception beyond its predecessor: it hears the nearest robot within ``range_mm``.

    Only robots with smaller numbers count, except the predecessor, which a robot hears anyway: they go first.
    """

    range_mm: Annotated[Positive, Field(le=MOST_RANGE_MM)] = 2000.0


class Supervisor(Frozen):
    """Parameters of the supervisor.

    The centres of the outlines, which are circles, have to stay ``distance_mm`` apart over the next
    ``horizon_s``, if the robot changes its speed by ``braking_mm_s2``. Where slowing down would not keep it,
    the robot clears the way, straight ahead at up to ``clearing_mm_s``; 0: it only slows down.
    """

    distance_mm: Positive = 265.0
    braking_mm_s2: Positive = 100.0
    horizon_s: Positive = 3.0
    clearing_mm_s: NonNegative = 500.0
    outline_offset_mm: Positive = 30.0  # centre of the outline, behind c


class Path(NamedTuple):
    """The path that a robot will take: two arcs, with curvatures in 1/mm, positive counter-clockwise."""

    bend: float  # of the first CORRECTION_MM
    later_bend: float


class SupervisorRow(NamedTuple):
    """The parameters for the compiled laws."""

    distance: float
    braking: float
    horizon: float
    clearing: float
    behind: float
    place: int  # of the neighbour's first entry in the observation; −1 means no supervisor


def supervisor_row(supervisor: Supervisor | None, place: int = -1) -> SupervisorRow:
    """The parameters for the compiled laws, with the place of the neighbour's first entry."""
    known = Supervisor() if supervisor is None else supervisor
    return SupervisorRow(
        known.distance_mm,
        known.braking_mm_s2,
        known.horizon_s,
        known.clearing_mm_s,
        known.outline_offset_mm,
        -1 if supervisor is None else place,
    )


@law
def ramped_way(now: float, then: float, rate: float, duration: float) -> float:
    """Way (mm) in ``duration`` s of a robot that changes its speed ``now`` to ``then`` at a constant rate."""
    change = abs(then - now) / rate
    if duration < change:
        return now * duration + 0.5 * math.copysign(rate, then - now) * duration * duration
    return 0.5 * (now + then) * change + then * (duration - change)


@law
def outline_of(message: Message, behind: float) -> tuple[float, float]:
    """Centre of a robot's outline (mm)."""
    return message.x + behind * math.sin(message.theta), message.y - behind * math.cos(
        message.theta
    )


@law
def straight_approach(x: float, y: float, d_x: float, d_y: float) -> float:
    """Least distance from the origin of a point that moves from (x, y) straight by (d_x, d_y)."""
    length_2 = d_x * d_x + d_y * d_y
    share = 0.0
    if length_2 > 0.0:
        share = min(max(-(x * d_x + y * d_y) / length_2, 0.0), 1.0)
    return math.hypot(x + share * d_x, y + share * d_y)


@law
def along(way: float, path: Path) -> Message:
    """The robot after a way (mm) along its path, from the origin with heading 0."""
    first = min(way, CORRECTION_MM)
    corner = dead_reckoned(Message(0.0, 0.0, 0.0, first, path.bend * first), 1.0)
    rest = way - first
    return dead_reckoned(
        Message(corner.x, corner.y, corner.theta, rest, path.later_bend * rest), 1.0
    )


@law
def least_distance(
    speed: float, now: float, path: Path, other: Message, row: SupervisorRow
) -> float:
    """Least distance (mm) of the outlines' centres over the horizon, if the robot changes to a speed.

    The first of the :data:`INSTANTS` is the earliest: what comes before it no command can change.

    Parameters
    ----------
    speed, now
        The speed that the robot changes to, and its present one, mm/s.
    path
        Its path.
    other
        The other robot as it would be in a world in which this one is at the origin with heading 0.
    """
    least = math.inf
    x = y = 0.0
    for i in range(INSTANTS):
        time = row.horizon * (i + 1) / INSTANTS
        way = ramped_way(now, speed, row.braking, time)
        own_x, own_y = outline_of(along(way, path), row.behind)
        other_x, other_y = outline_of(dead_reckoned(other, time), row.behind)
        next_x, next_y = other_x - own_x, other_y - own_y
        if i == 0:
            x, y = next_x, next_y
        least = min(least, straight_approach(x, y, next_x - x, next_y - y))
        x, y = next_x, next_y
    return least


@law
def lower_speed(
    u_1: float, now: float, path: Path, other: Message, row: SupervisorRow
) -> tuple[float, float]:
    """The largest speed (mm/s) below ``u_1`` that keeps the distance, and its least distance (mm).

    If none keeps it, ``u_1`` or the lower speed that keeps most.
    """
    best, most = u_1, least_distance(u_1, now, path, other, row)
    for i in range(1, SPEEDS + 1 if u_1 > 0.0 else 0):
        speed = u_1 * (SPEEDS - i) / SPEEDS
        least = least_distance(speed, now, path, other, row)
        if least > most:
            best, most = speed, least
        if most >= row.distance:
            high = u_1 * (SPEEDS - i + 1) / SPEEDS
            for _ in range(HALVINGS):
                middle = 0.5 * (best + high)
                least = least_distance(middle, now, path, other, row)
                if least >= row.distance:
                    best, most = middle, least
                else:
                    high = middle
            return best, most
    return best, most


@law
def clearing_speed(
    u_1: float, now: float, other: Message, ahead: Message, row: SupervisorRow
) -> tuple[float, float]:
    """The smallest speed (mm/s) above ``u_1``, straight ahead, that keeps the distance, likewise.

    The distance to the predecessor ``ahead`` counts, too. If none keeps it, the one that keeps most; 0 and a
    least distance of −1 if ``u_1`` is the fastest.
    """
    best, most = 0.0, -1.0
    start = max(u_1, 0.0)
    for i in range(1, SPEEDS + 1 if row.clearing > start else 0):
        speed = start + (row.clearing - start) * i / SPEEDS
        least = min(
            least_distance(speed, now, Path(0.0, 0.0), other, row),
            least_distance(speed, now, Path(0.0, 0.0), ahead, row),
        )
        if least > most:
            best, most = speed, least
        if most >= row.distance:
            return best, most
    return best, most


@law
def curvature(u_1: float, u_2: float) -> float:
    """Curvature (1/mm) of a path with this twist (mm/s, rad/s), bounded for slow motion."""
    return u_2 / max(abs(u_1), SLOW_MM_S)


@law
def supervised_twist(
    u_1: float,
    u_2: float,
    now: float,
    later_bend: float,
    other: Message,
    ahead: Message,
    row: SupervisorRow,
) -> tuple[float, float]:
    """The twist (mm/s, rad/s) closest to ``u`` that keeps the distance, for the present speed ``now`` (mm/s).

    A lower speed on the same path, with both parts reduced alike; if none is low enough, a higher one straight
    ahead, if that keeps more. ``later_bend`` (1/mm) is the curvature of the reference's path.
    """
    path = Path(curvature(max(u_1, now), u_2), later_bend)
    if least_distance(u_1, now, path, other, row) >= row.distance:
        return u_1, u_2
    lower, most = lower_speed(u_1, now, path, other, row)
    if most < row.distance:
        higher, least = clearing_speed(u_1, now, other, ahead, row)
        if least > most:
            return higher, 0.0
    if lower == u_1:
        return u_1, u_2
    return lower, u_2 * (lower / u_1)
