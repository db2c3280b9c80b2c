"""The start of an episode in a lane: its variant, draws, payloads, start poses, first messages."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.disturbances.channels import (
    MIXTURE,
    PAYLOAD_BEHIND,
    PAYLOAD_INERTIA,
    PAYLOAD_MASS,
    START_HEADING,
    START_POSE,
    START_POSITION,
)
from tlf_env.engine.judging import BODY_D, CLIPPED, record_truth
from tlf_env.engine.layout import Arrays, Variants
from tlf_env.engine.outlines import BODY_BEHIND, BODY_OUTLINE
from tlf_env.engine.radio import broadcast, next_reference
from tlf_env.engine.settings import Settings
from tlf_env.engine.substeps import evaluate
from tlf_env.numerics.compiled import block, law, writer
from tlf_env.numerics.philox import normal_pair, unit, words
from tlf_env.physics.vehicle import Mass, laden, read_body
from tlf_env.task.measures import distance
from tlf_env.task.scenario import START_MARGIN_MM

STARTED, OFF_BASE, NO_ROOM = range(3)
START_ATTEMPTS = 1000

write_mass = writer(Mass)


@block
def fill(array: np.ndarray, lane: int, value: float) -> None:
    """Set a lane of an array ``(field, robot, lane)``."""
    for i in range(array.shape[0]):
        for r in range(array.shape[1]):
            array[i, r, lane] = value


@block
def copy(array: np.ndarray, lane: int, source: np.ndarray, v: int) -> None:
    """Set a lane of an array ``(field, robot, lane)`` to another's."""
    for i in range(array.shape[0]):
        for r in range(array.shape[1]):
            array[i, r, lane] = source[i, r, v]


@block
def clear_lane(a: Arrays, lane: int) -> None:
    """Forget the last episode; what is not cleared here is written before it is read."""
    for state in (a.motions, a.contacts, a.loop_states, a.sensors, a.estimates, a.traces):
        fill(state, lane, 0.0)
    for state in (a.slip_estimates, a.processes, a.wanted, a.wanted_before):
        fill(state, lane, 0.0)
    fill(a.imposed, lane, np.nan)
    for wheel in range(a.torques.shape[0]):
        fill(a.torques[wheel], lane, 0.0)
    for k in range(a.samples.shape[0]):
        fill(a.samples[k], lane, 0.0)
    a.clock[lane, 0] = a.clock[lane, 1] = 0
    for r in range(a.motions.shape[1]):
        for slot in range(a.dropped.shape[0]):
            a.dropped[slot, r, lane] = False
        for i in range(a.actions.shape[2]):
            a.actions[lane, r, i] = a.last_actions[lane, r, i] = 0.0
        a.infos[lane, r, CLIPPED] = 0.0
        a.lost[lane, r] = a.lost_now[lane, r] = False
        a.touched[lane, r] = a.touched_now[lane, r] = False


@block
def take_variant(a: Arrays, of: Variants, lane: int) -> None:
    """The lane's scenario in this episode, drawn if there is a mixture, and its constants."""
    if of.mixture.shape[0] > 0:
        word, _, _, _ = words(a.seeds[lane], MIXTURE, 0, a.clock[lane, 2], 0)
        v = 0
        while v < of.mixture.shape[0] - 1 and unit(word) >= of.mixture[v]:
            v += 1
        a.variants[lane] = v
    v = a.variants[lane]
    copy(a.bodies, lane, of.bodies, v)
    copy(a.wheel_loops, lane, of.wheel_loops, v)
    copy(a.ekfs, lane, of.ekfs, v)
    copy(a.slip_ekfs, lane, of.slip_ekfs, v)
    a.levels[lane] = of.levels[v]


@block
def load_robot(a: Arrays, lane: int, r: int) -> bool:
    """Put the payload on; whether the wheels can carry it."""
    mass = a.applied[PAYLOAD_MASS, r, lane]
    if mass <= 0.0:
        return True
    empty = read_body(a.bodies, r, lane)
    behind, inertia = a.applied[PAYLOAD_BEHIND, r, lane], a.applied[PAYLOAD_INERTIA, r, lane]
    loaded = laden(empty, mass, behind, inertia)
    write_mass(a.bodies, r, lane, loaded)
    return 0.0 <= loaded.d < empty.pivot + empty.T


@law
def outlines_apart(a: Arrays, lane: int, i: int, j: int) -> bool:
    """Whether two robots' outlines are apart at their start poses."""
    behind_i, behind_j = a.bodies[BODY_BEHIND, i, lane], a.bodies[BODY_BEHIND, j, lane]
    theta_i, theta_j = a.starts[2, i, lane], a.starts[2, j, lane]
    between = distance(
        a.starts[0, i, lane] + behind_i * math.sin(theta_i),
        a.starts[1, i, lane] - behind_i * math.cos(theta_i),
        a.starts[0, j, lane] + behind_j * math.sin(theta_j),
        a.starts[1, j, lane] - behind_j * math.cos(theta_j),
    )
    room = a.bodies[BODY_OUTLINE, i, lane] + a.bodies[BODY_OUTLINE, j, lane]
    return between > room + START_MARGIN_MM


@block
def line_up(a: Arrays, lane: int, s: Settings) -> None:
    """Start poses of c: the leader on its reference, the others behind it on its tangent."""
    x, y, theta = a.table[0, 0], a.table[0, 1], a.table[0, 2]
    for r in range(a.starts.shape[1]):
        behind = s.spacing * r
        a.starts[0, r, lane] = x + behind * math.sin(theta)
        a.starts[1, r, lane] = y - behind * math.cos(theta)
        a.starts[2, r, lane] = theta


@block
def scatter(a: Arrays, lane: int) -> int:
    """Scatter the start poses, each robot redrawn while its outline overlaps another's.

    Returns the robot that found no room, or −1.
    """
    robots = a.starts.shape[1]
    asked = False
    for r in range(robots):
        asked |= a.applied[START_POSITION, r, lane] != 0.0 or a.applied[START_HEADING, r, lane] != 0
    if not asked:
        return -1
    for r in range(robots):
        x, y, theta = a.starts[0, r, lane], a.starts[1, r, lane], a.starts[2, r, lane]
        away, turned = a.applied[START_POSITION, r, lane], a.applied[START_HEADING, r, lane]
        apart = False
        for attempt in range(START_ATTEMPTS):
            if not apart:
                d_x, d_y = draw(a, lane, r, 2 * attempt)
                turn, _ = draw(a, lane, r, 2 * attempt + 1)
                a.starts[0, r, lane] = x + away * d_x
                a.starts[1, r, lane] = y + away * d_y
                a.starts[2, r, lane] = theta + turned * turn
                apart = True
                for other in range(r):
                    apart &= outlines_apart(a, lane, r, other)
        if not apart:
            return r
    return -1


@block
def draw(a: Arrays, lane: int, r: int, index: int) -> tuple[float, float]:
    """Two standard normal numbers for a start pose."""
    return normal_pair(a.seeds[lane], START_POSE, r, a.clock[lane, 2], index)


@block
def place_robot(a: Arrays, lane: int, r: int) -> None:
    """Put a robot at its start pose, at rest, and tell it where it is."""
    x, y, theta = a.starts[0, r, lane], a.starts[1, r, lane], a.starts[2, r, lane]
    d = a.bodies[BODY_D, r, lane]
    a.motions[0, r, lane] = x + d * math.sin(theta)
    a.motions[1, r, lane] = y - d * math.cos(theta)
    a.motions[2, r, lane] = a.motions[3, r, lane] = theta
    for i in range(3):
        a.estimates[i, r, lane] = a.observers[i, r, lane] = a.starts[i, r, lane]


@block
def begin(a: Arrays, lane: int, s: Settings) -> None:
    """After the robots are placed: first messages, and references up to the preview."""
    robots = a.motions.shape[1]
    for r in range(robots):
        broadcast(a, lane, r, 0, s)
        record_truth(a, lane, r, 0)
    for r in range(robots):
        if r == 0 or not s.external_observer:
            for m in range(s.lookahead + 1):
                next_reference(a, lane, r, m, s)


@block
def start_lane(
    a: Arrays, of: Variants, lane: int, poses: np.ndarray, s: Settings
) -> tuple[int, int]:
    """Start the episode of a lane's seed and number; ``poses`` (robot, 3) if given, else without rows.

    Returns ``STARTED``, or ``OFF_BASE`` or ``NO_ROOM`` and the robot.
    """
    clear_lane(a, lane)
    take_variant(a, of, lane)
    robots = a.motions.shape[1]
    for r in range(robots):
        evaluate(a, lane, r, 0, a.signals.shape[1], 0, s)
    for r in range(robots):
        if not load_robot(a, lane, r):
            return OFF_BASE, r
    if poses.shape[0] > 0:
        for r in range(robots):
            for i in range(3):
                a.starts[i, r, lane] = poses[r, i]
    else:
        line_up(a, lane, s)
        crowded = scatter(a, lane)
        if crowded >= 0:
            return NO_ROOM, crowded
    for r in range(robots):
        place_robot(a, lane, r)
    begin(a, lane, s)
    return STARTED, 0
