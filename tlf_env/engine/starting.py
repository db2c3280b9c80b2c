"""The start of an episode in a lane: its variant, draws, payloads, start poses, first messages."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.disturbances.channels import (
    MIXTURE,
    PAYLOAD_BEHIND,
    PAYLOAD_INERTIA,
    PAYLOAD_MASS,
    RADIUS_LEFT,
    RADIUS_RIGHT,
    START_HEADING,
    START_POSE,
    START_POSITION,
    TRACK,
)
from tlf_env.engine.arrays import (
    Arrays,
    Variants,
    read_belief,
    read_body,
    read_estimate,
    read_gyro_ekf,
    read_motion,
    read_slip_ekf,
    read_start,
    write_belief,
    write_estimate,
    write_gyro_ekf,
    write_motion,
    write_observer,
    write_slip_ekf,
    write_start,
)
from tlf_env.engine.effects import evaluate_all, fix_timing
from tlf_env.engine.judging import BODY_D, CLIPPED, record_truth
from tlf_env.engine.layout import Pose, Sample, in_array
from tlf_env.engine.outlines import BODY_BEHIND, BODY_OUTLINE, radii
from tlf_env.engine.radio import broadcast, next_reference
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.philox import normal_pair, unit, words
from tlf_env.numerics.rows import replacing, writer
from tlf_env.onboard.calibration import Belief
from tlf_env.onboard.estimator import Estimate
from tlf_env.onboard.gyro_estimator import gyro_for_fixes
from tlf_env.onboard.slip_estimator import for_fixes
from tlf_env.physics.vehicle import Mass, Motion, laden
from tlf_env.physics.world import gap_to_walls
from tlf_env.task.info import NOTHING
from tlf_env.task.measures import distance
from tlf_env.task.scenario import START_MARGIN_MM

FIX_X, FIX_Y = Sample._fields.index("fix_x"), Sample._fields.index("fix_y")
STARTED, OFF_BASE, NO_ROOM, IN_WALL = range(4)
START_ATTEMPTS = 1000

at_pose = replacing(Motion, "x", "y", "theta", "psi")
estimated_at = replacing(Estimate, "x", "y", "theta")
write_mass = writer(Mass, in_array("body"))  # the first fields of a Body


@block
def clear(array: np.ndarray, lane: int, first: int, last: int) -> None:
    """Set the fields from ``first`` to before ``last`` of a lane of ``(field, robot, lane)`` to 0."""
    for i in range(first, last):
        for robot in range(array.shape[1]):
            array[i, robot, lane] = 0.0


@block
def clear_lane(arrays: Arrays, lane: int) -> None:
    """Clear a lane for a new episode; arrays that are not cleared here are written before they are read."""
    clear(arrays.states, lane, 0, arrays.states.shape[0])
    clear(arrays.processes, lane, 0, arrays.processes.shape[0])
    for robot in range(arrays.states.shape[1]):
        for i in range(arrays.imposed.shape[0]):
            arrays.imposed[i, robot, lane] = np.nan
        for slot in range(arrays.dropped.shape[0]):
            arrays.dropped[slot, robot, lane] = False
        for i in range(arrays.actions.shape[2]):
            arrays.actions[lane, robot, i] = arrays.last_actions[lane, robot, i] = 0.0
        arrays.infos[lane, robot, CLIPPED] = 0.0
        arrays.lost[lane, robot] = arrays.lost_now[lane, robot] = False
        arrays.touched[lane, robot] = arrays.touched_now[lane, robot] = False
        arrays.touched_by[lane, robot] = NOTHING
    for wheel in range(arrays.torques.shape[0]):
        clear(arrays.torques[wheel], lane, 0, arrays.torques.shape[1])
    for substep in range(arrays.samples.shape[0]):
        clear(arrays.samples[substep], lane, 0, arrays.samples.shape[1])
    arrays.clock[lane, 0] = arrays.clock[lane, 1] = arrays.calm[lane] = 0


@block
def take_variant(arrays: Arrays, of: Variants, lane: int) -> None:
    """The lane's scenario in this episode, drawn if there is a mixture, and its constants."""
    if of.mixture.shape[0] > 0:
        word, _, _, _ = words(arrays.seeds[lane], MIXTURE, 0, arrays.clock[lane, 2], 0)
        v = 0
        while v < of.mixture.shape[0] - 1 and unit(word) >= of.mixture[v]:
            v += 1
        arrays.variants[lane] = v
    v = arrays.variants[lane]
    for i in range(arrays.constants.shape[0]):
        for robot in range(arrays.constants.shape[1]):
            arrays.constants[i, robot, lane] = of.constants[i, robot, v]
    arrays.levels[lane] = of.levels[v]


@block
def load_robot(arrays: Arrays, lane: int, robot: int) -> bool:
    """Add the payload; return whether the wheels can carry it."""
    mass = arrays.applied[PAYLOAD_MASS, robot, lane]
    if mass <= 0.0:
        return True
    empty = read_body(arrays.constants, robot, lane)
    behind, inertia = (
        arrays.applied[PAYLOAD_BEHIND, robot, lane],
        arrays.applied[PAYLOAD_INERTIA, robot, lane],
    )
    loaded = laden(empty, mass, behind, inertia)
    write_mass(arrays.constants, robot, lane, loaded)
    return 0.0 <= loaded.d < empty.pivot + empty.T


@law
def equip(arrays: Arrays, lane: int, robot: int, settings: Settings) -> None:
    """What the computer believes of the wheels, and its filter for the rate of the fixes."""
    applied = arrays.applied
    belief = read_belief(arrays.constants, robot, lane)
    believed = Belief(
        belief.radius_l * applied[RADIUS_LEFT, robot, lane],
        belief.radius_r * applied[RADIUS_RIGHT, robot, lane],
        belief.h * applied[TRACK, robot, lane],
    )
    write_belief(arrays.constants, robot, lane, believed)
    every, _ = fix_timing(arrays, lane, robot, settings.dt)
    ekf = read_slip_ekf(arrays.constants, robot, lane)
    write_slip_ekf(arrays.constants, robot, lane, for_fixes(ekf, every))
    gyro_ekf = read_gyro_ekf(arrays.constants, robot, lane)
    write_gyro_ekf(arrays.constants, robot, lane, gyro_for_fixes(gyro_ekf, every))


@law
def outlines_apart(arrays: Arrays, lane: int, robot: int, other: int) -> bool:
    """Whether two robots' outlines are apart at their start poses."""
    behind = arrays.constants[BODY_BEHIND, robot, lane]
    behind_other = arrays.constants[BODY_BEHIND, other, lane]
    start = read_start(arrays.states, robot, lane)
    start_other = read_start(arrays.states, other, lane)
    between = distance(
        start.x + behind * math.sin(start.theta),
        start.y - behind * math.cos(start.theta),
        start_other.x + behind_other * math.sin(start_other.theta),
        start_other.y - behind_other * math.cos(start_other.theta),
    )
    return between > radii(arrays, lane, robot, other) + START_MARGIN_MM


@law
def clear_of_walls(arrays: Arrays, lane: int, robot: int) -> bool:
    """Whether a robot's outline is apart from all walls at its start pose."""
    behind = arrays.constants[BODY_BEHIND, robot, lane]
    start = read_start(arrays.states, robot, lane)
    x = start.x + behind * math.sin(start.theta)
    y = start.y - behind * math.cos(start.theta)
    return gap_to_walls(arrays.walls, x, y) > arrays.constants[BODY_OUTLINE, robot, lane]


@block
def line_up(arrays: Arrays, lane: int, settings: Settings) -> None:
    """Start poses of c: the leader on its reference, the others behind it on its tangent."""
    route = arrays.routes[lane]
    x, y = arrays.tables[route, 0, 0], arrays.tables[route, 0, 1]
    theta = arrays.tables[route, 0, 2]
    for robot in range(arrays.states.shape[1]):
        behind = settings.spacing * robot
        pose = Pose(x + behind * math.sin(theta), y - behind * math.cos(theta), theta)
        write_start(arrays.states, robot, lane, pose)


@block
def scatter(arrays: Arrays, lane: int) -> int:
    """Scatter the start poses, each robot redrawn while its outline overlaps another's or a wall.

    Returns the first robot without room, or −1.
    """
    robots = arrays.states.shape[1]
    scattered = False
    for robot in range(robots):
        scattered |= arrays.applied[START_POSITION, robot, lane] != 0.0
        scattered |= arrays.applied[START_HEADING, robot, lane] != 0.0
    if not scattered:
        return -1
    for robot in range(robots):
        line = read_start(arrays.states, robot, lane)
        away = arrays.applied[START_POSITION, robot, lane]
        turned = arrays.applied[START_HEADING, robot, lane]
        apart = False
        for attempt in range(START_ATTEMPTS):
            if not apart:
                d_x, d_y = draw(arrays, lane, robot, 2 * attempt)
                turn, _ = draw(arrays, lane, robot, 2 * attempt + 1)
                pose = Pose(line.x + away * d_x, line.y + away * d_y, line.theta + turned * turn)
                write_start(arrays.states, robot, lane, pose)
                apart = clear_of_walls(arrays, lane, robot)
                for other in range(robot):
                    apart &= outlines_apart(arrays, lane, robot, other)
        if not apart:
            return robot
    return -1


@block
def draw(arrays: Arrays, lane: int, robot: int, index: int) -> tuple[float, float]:
    """Two standard normal numbers for a start pose."""
    return normal_pair(arrays.seeds[lane], START_POSE, robot, arrays.clock[lane, 2], index)


@block
def place_robot(arrays: Arrays, lane: int, robot: int) -> None:
    """Put a robot at its start pose, at rest, and its estimate and observer with it."""
    start = read_start(arrays.states, robot, lane)
    d = arrays.constants[BODY_D, robot, lane]
    motion = read_motion(arrays.states, robot, lane)
    x, y = start.x + d * math.sin(start.theta), start.y - d * math.cos(start.theta)
    write_motion(arrays.states, robot, lane, at_pose(motion, x, y, start.theta, start.theta))
    estimate = read_estimate(arrays.states, robot, lane)
    write_estimate(
        arrays.states, robot, lane, estimated_at(estimate, start.x, start.y, start.theta)
    )
    write_observer(arrays.states, robot, lane, start)
    # Until the first fix comes, the start pose stands for the last one.
    last = arrays.samples.shape[0] - 1
    arrays.samples[last, FIX_X, robot, lane] = start.x
    arrays.samples[last, FIX_Y, robot, lane] = start.y


@block
def begin(arrays: Arrays, lane: int, settings: Settings) -> None:
    """After the robots are placed: first messages, and references up to the preview."""
    robots = arrays.states.shape[1]
    for robot in range(robots):
        broadcast(arrays, lane, robot, 0, settings)
        record_truth(arrays, lane, robot, 0)
    for robot in range(robots):
        if robot == 0 or not settings.external_observer:
            for step in range(settings.lookahead + 1):
                next_reference(arrays, lane, robot, step, settings)


@block
def start_lane(
    arrays: Arrays, of: Variants, lane: int, poses: np.ndarray, settings: Settings
) -> tuple[int, int]:
    """Start the episode of a lane's seed and number.

    ``poses`` ``(lane, robot, 3)``, NaN in lanes whose poses are drawn; without rows if they all are.
    Returns ``STARTED``, or ``OFF_BASE``, ``NO_ROOM`` or ``IN_WALL`` and the robot.
    """
    clear_lane(arrays, lane)
    take_variant(arrays, of, lane)
    robots = arrays.states.shape[1]
    for robot in range(robots):
        evaluate_all(arrays, lane, robot, settings)
        equip(arrays, lane, robot, settings)
    for robot in range(robots):
        if not load_robot(arrays, lane, robot):
            return OFF_BASE, robot
    if poses.shape[0] > 0 and not math.isnan(poses[lane, 0, 0]):
        for robot in range(robots):
            pose = Pose(poses[lane, robot, 0], poses[lane, robot, 1], poses[lane, robot, 2])
            write_start(arrays.states, robot, lane, pose)
    else:
        line_up(arrays, lane, settings)
        crowded = scatter(arrays, lane)
        if crowded >= 0:
            return NO_ROOM, crowded
    for robot in range(robots):
        if not clear_of_walls(arrays, lane, robot):
            return IN_WALL, robot
        place_robot(arrays, lane, robot)
    begin(arrays, lane, settings)
    return STARTED, 0
