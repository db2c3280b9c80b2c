"""Which robots are near each other or a wall, and which touch: outlines are circles."""

from __future__ import annotations

import math

from tlf_env.engine.arrays import Arrays, read_motion
from tlf_env.engine.layout import in_array
from tlf_env.numerics.compiled import law
from tlf_env.physics.reach import CLOSE_MARGIN_MM, FASTEST_CHANGE_MM_S2, compiled_time_for
from tlf_env.physics.world import gap_to_walls
from tlf_env.task.info import ROBOT, WALL
from tlf_env.task.measures import ROUNDING_MM, distance

MOST_CALM_STEPS = 1000
BODY_OUTLINE = in_array("body", "outline_radius")
BODY_AHEAD = in_array("body", "outline_ahead")
BODY_BEHIND = in_array("body", "outline_behind")
MOTION_X, MOTION_Y = in_array("motion", "x"), in_array("motion", "y")


@law
def outline_centre(arrays: Arrays, lane: int, robot: int) -> tuple[float, float]:
    """Centre of the outline's circle, mm."""
    motion = read_motion(arrays.states, robot, lane)
    ahead = arrays.constants[BODY_AHEAD, robot, lane]
    return motion.x - ahead * math.sin(motion.theta), motion.y + ahead * math.cos(motion.theta)


@law
def radii(arrays: Arrays, lane: int, robot: int, other: int) -> float:
    """Sum of two robots' outline radii, mm."""
    return arrays.constants[BODY_OUTLINE, robot, lane] + arrays.constants[BODY_OUTLINE, other, lane]


@law
def surely_apart(arrays: Arrays, lane: int, robot: int, other: int, room: float) -> bool:
    """Whether two outlines' centres are farther apart than ``room`` mm at any headings of the robots."""
    states, constants = arrays.states, arrays.constants
    between = distance(
        states[MOTION_X, robot, lane],
        states[MOTION_Y, robot, lane],
        states[MOTION_X, other, lane],
        states[MOTION_Y, other, lane],
    )
    ahead = abs(constants[BODY_AHEAD, robot, lane]) + abs(constants[BODY_AHEAD, other, lane])
    return between > room + ahead + ROUNDING_MM


@law
def room_to_move(arrays: Arrays, lane: int, duration: float) -> bool:
    """Whether no two outlines (circles) can meet, or nearly so, during ``duration`` s."""
    robots = arrays.states.shape[1]
    for i in range(robots):
        speed_i = outline_speed(arrays, lane, i)
        for j in range(i):
            room = radii(arrays, lane, i, j)
            speed_j = outline_speed(arrays, lane, j)
            closing = speed_i + speed_j + 2.0 * FASTEST_CHANGE_MM_S2 * duration
            if surely_apart(arrays, lane, i, j, room + CLOSE_MARGIN_MM + closing * duration):
                continue
            x_i, y_i = outline_centre(arrays, lane, i)
            x_j, y_j = outline_centre(arrays, lane, j)
            if distance(x_i, y_i, x_j, y_j) - room <= CLOSE_MARGIN_MM + closing * duration:
                return False
    return True


@law
def away_from_walls(arrays: Arrays, lane: int, duration: float) -> bool:
    """Whether no outline can meet a wall, or nearly so, during ``duration`` s.

    From the distance follows for how many control steps that holds; until then nothing is computed.
    """
    walls, step = arrays.walls, arrays.clock[lane, 1]
    if walls.shape[0] == 0 or step < arrays.calm[lane]:
        return True
    calm = MOST_CALM_STEPS
    for robot in range(arrays.states.shape[1]):
        room = room_to_walls(arrays, lane, robot) - CLOSE_MARGIN_MM
        speed = outline_speed(arrays, lane, robot)
        if room <= (speed + FASTEST_CHANGE_MM_S2 * duration) * duration:
            return False
        steps = compiled_time_for(speed, room) / duration
        calm = min(calm, int(min(steps, MOST_CALM_STEPS)))
    arrays.calm[lane] = step + calm
    return True


@law
def room_to_walls(arrays: Arrays, lane: int, robot: int) -> float:
    """Distance of a robot's outline from the nearest wall, mm; negative if they overlap."""
    x, y = outline_centre(arrays, lane, robot)
    return gap_to_walls(arrays.walls, x, y) - arrays.constants[BODY_OUTLINE, robot, lane]


@law
def outline_speed(arrays: Arrays, lane: int, robot: int) -> float:
    """A bound on the speed of the outline's centre, mm/s."""
    motion = read_motion(arrays.states, robot, lane)
    swing = abs(motion.w * arrays.constants[BODY_AHEAD, robot, lane])
    return math.sqrt(motion.v_x * motion.v_x + motion.v_y * motion.v_y) + swing


@law
def touch(arrays: Arrays, lane: int, robot: int, thing: int) -> None:
    """Record that a robot touched another, or a thing: a ``TouchedBy``."""
    if not arrays.touched[lane, robot]:
        arrays.touched[lane, robot] = arrays.touched_now[lane, robot] = True
        arrays.touched_by[lane, robot] = thing


@law
def mark_touched(arrays: Arrays, lane: int) -> None:
    """Set ``touched`` for robots whose outlines meet, or meet a wall."""
    robots = arrays.states.shape[1]
    for i in range(robots):
        if arrays.walls.shape[0] > 0 and room_to_walls(arrays, lane, i) <= 0.0:
            touch(arrays, lane, i, WALL)
        for j in range(i):
            room = radii(arrays, lane, i, j)
            if surely_apart(arrays, lane, i, j, room):
                continue
            x_i, y_i = outline_centre(arrays, lane, i)
            x_j, y_j = outline_centre(arrays, lane, j)
            if distance(x_i, y_i, x_j, y_j) <= room:
                touch(arrays, lane, i, ROBOT)
                touch(arrays, lane, j, ROBOT)
