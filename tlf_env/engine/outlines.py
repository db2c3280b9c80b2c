"""Which robots are near, and which touch: outlines are circles."""

from __future__ import annotations

import math

from tlf_env.engine.layout import Arrays
from tlf_env.numerics.compiled import law
from tlf_env.physics.vehicle import Body, read_motion
from tlf_env.task.measures import ROUNDING_MM, distance

# Outlines that could come closer than this within a control step are stepped through the space.
CLOSE_MARGIN_MM = 10.0
FASTEST_CHANGE_MM_S2 = 1500.0  # above what all three tyres can do at twice the paper's friction
BODY_OUTLINE = Body._fields.index("outline_radius")
BODY_AHEAD = Body._fields.index("outline_ahead")
BODY_BEHIND = Body._fields.index("outline_behind")


@law
def outline_centre(a: Arrays, lane: int, r: int) -> tuple[float, float]:
    """Centre of the outline's circle, mm."""
    motion = read_motion(a.motions, r, lane)
    ahead = a.bodies[BODY_AHEAD, r, lane]
    return motion.x - ahead * math.sin(motion.theta), motion.y + ahead * math.cos(motion.theta)


@law
def surely_apart(a: Arrays, lane: int, i: int, j: int, room: float) -> bool:
    """Whether two outlines' centres are farther apart than ``room`` mm wherever the robots head."""
    between = distance(
        a.motions[0, i, lane], a.motions[1, i, lane], a.motions[0, j, lane], a.motions[1, j, lane]
    )
    ahead = abs(a.bodies[BODY_AHEAD, i, lane]) + abs(a.bodies[BODY_AHEAD, j, lane])
    return between > room + ahead + ROUNDING_MM


@law
def room_to_move(a: Arrays, lane: int, duration: float) -> bool:
    """Whether no two outlines (circles) can meet, or nearly so, during ``duration`` s."""
    robots = a.motions.shape[1]
    for i in range(robots):
        speed_i = outline_speed(a, lane, i)
        for j in range(i):
            room = a.bodies[BODY_OUTLINE, i, lane] + a.bodies[BODY_OUTLINE, j, lane]
            closing = speed_i + outline_speed(a, lane, j) + 2.0 * FASTEST_CHANGE_MM_S2 * duration
            if surely_apart(a, lane, i, j, room + CLOSE_MARGIN_MM + closing * duration):
                continue
            x_i, y_i = outline_centre(a, lane, i)
            x_j, y_j = outline_centre(a, lane, j)
            if distance(x_i, y_i, x_j, y_j) - room <= CLOSE_MARGIN_MM + closing * duration:
                return False
    return True


@law
def outline_speed(a: Arrays, lane: int, r: int) -> float:
    """A bound on the speed of the outline's centre, mm/s."""
    motion = read_motion(a.motions, r, lane)
    swing = abs(motion.w * a.bodies[BODY_AHEAD, r, lane])
    return math.sqrt(motion.v_x * motion.v_x + motion.v_y * motion.v_y) + swing


@law
def touch(a: Arrays, lane: int, r: int) -> None:
    """Remember that robot ``r`` touched another."""
    if not a.touched[lane, r]:
        a.touched[lane, r] = a.touched_now[lane, r] = True


@law
def mark_touched(a: Arrays, lane: int) -> None:
    """Set ``touched`` for robots whose outlines meet."""
    robots = a.motions.shape[1]
    for i in range(robots):
        for j in range(i):
            room = a.bodies[BODY_OUTLINE, i, lane] + a.bodies[BODY_OUTLINE, j, lane]
            if surely_apart(a, lane, i, j, room):
                continue
            x_i, y_i = outline_centre(a, lane, i)
            x_j, y_j = outline_centre(a, lane, j)
            if distance(x_i, y_i, x_j, y_j) <= room:
                touch(a, lane, i)
                touch(a, lane, j)
