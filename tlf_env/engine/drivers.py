"""The step drivers: what Python calls, a control step or a part of one at a time.

One control step runs, for every robot and substep, wheel loop → torques → disturbances → plant →
sensors → EKF, and then once per robot radio → observer → observation, reward, errors. Robots do not
act on each other within a control step unless they touch, so the substeps of all run side by side; the
pymunk plant calls :func:`actuate` and :func:`sense` one substep at a time while robots are close.
"""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import STEP_CHANNELS, SUBSTEP_CHANNELS
from tlf_env.engine.excerpt import Excerpt, write_excerpt
from tlf_env.engine.judging import (
    CLIPPED,
    end_lane,
    judge_robot,
    observe_robot,
    observe_sensors,
    record_truth,
)
from tlf_env.engine.layout import Arrays, Variants
from tlf_env.engine.outlines import mark_touched, room_to_move
from tlf_env.engine.radio import broadcast, delayed_message, next_reference
from tlf_env.engine.settings import Settings
from tlf_env.engine.starting import STARTED, fill, start_lane
from tlf_env.engine.substeps import delays, evaluate, refresh
from tlf_env.engine.tiles import advance
from tlf_env.numerics.compiled import block, driver, fetch_add, law
from tlf_env.onboard.observer import Message
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import read_body
from tlf_env.task.actions import (
    FULL_RESIDUAL_MM_S,
    FULL_RESIDUAL_RAD_S,
    FULL_TORQUE_NMM,
    REFERENCE,
    RESIDUAL,
    TORQUE,
    TWIST,
    clipped_action,
    reference_action,
    residual_share,
    twist_action,
    wanted_twist,
    wheel_command,
)
from tlf_env.task.info import RUNNING

DONE, MUST_COLLIDE, MUST_SUBSTEP = -1, -2, -3
LANES_AT_ONCE = 16  # whose arrays stay in the processor's cache during a step
SHARES = 4  # of what is left, divided by the threads: how much a thread takes at a time


@law
def command(a: Arrays, lane: int, r: int, s: Settings) -> tuple[float, float]:
    """What robot ``r``'s clipped action asks for: wheel speeds (rad/s), or torques (mN·mm)."""
    a_0, a_1 = a.actions[lane, r, 0], a.actions[lane, r, 1]
    kind = a.kinds[r, lane]
    if kind == TORQUE:
        full = FULL_TORQUE_NMM * MILLINEWTON_PER_NEWTON
        return a_0 * full, a_1 * full
    body = read_body(a.bodies, r, lane)
    if kind == RESIDUAL:
        seen, given = a.observations[lane, r], a.twists[lane, r]
        u_1, u_2 = wanted_twist(seen, a.scales, s.base)
        share = residual_share(seen, a.scales, s.residual_fade, s.residual_reach)
        u_1 += share * a_0 * FULL_RESIDUAL_MM_S
        u_2 += share * a_1 * FULL_RESIDUAL_RAD_S
        given[0], given[1] = twist_action(seen, a.scales, s.base, u_1, u_2)
        return wheel_command(given[0], given[1], TWIST, body)
    return wheel_command(a_0, a_1, kind, body)


@block
def first_bad_action(a: Arrays, first: int, last: int) -> int:
    """``DONE``, or lane · robots + robot of the first action that is not finite."""
    robots = a.actions.shape[1]
    for lane in range(first, last):
        for r in range(robots):
            if not (np.isfinite(a.actions[lane, r, 0]) and np.isfinite(a.actions[lane, r, 1])):
                return lane * robots + r
    return DONE


@law
def take_actions(a: Arrays, lane: int, s: Settings) -> None:
    """Clip the actions of a lane and turn them into commands; clears the traces."""
    for r in range(a.actions.shape[1]):
        if a.kinds[r, lane] == REFERENCE:
            given = a.twists[lane, r]
            given[0], given[1] = reference_action(a.observations[lane, r], a.scales, s.base)
            a.actions[lane, r, 0], a.actions[lane, r, 1] = given[0], given[1]
        a_0, a_1 = clipped_action(a.actions[lane, r, 0]), clipped_action(a.actions[lane, r, 1])
        clipped = a_0 != a.actions[lane, r, 0] or a_1 != a.actions[lane, r, 1]
        if clipped:
            a.infos[lane, r, CLIPPED] += 1.0
        a.actions[lane, r, 0], a.actions[lane, r, 1] = a_0, a_1
        a.wanted_before[0, r, lane] = a.wanted[0, r, lane]
        a.wanted_before[1, r, lane] = a.wanted[1, r, lane]
        a.wanted[0, r, lane], a.wanted[1, r, lane] = command(a, lane, r, s)
        a.commands[0, r, lane] = a.wanted[0, r, lane]
        a.commands[1, r, lane] = a.wanted[1, r, lane]
        tick = a.clock[lane, 0]
        refresh(a, lane, r, SUBSTEP_CHANNELS, STEP_CHANNELS, tick, s.substeps, s)
        if s.adversary and not s.changing:
            evaluate(a, lane, r, 0, SUBSTEP_CHANNELS, tick, s)
        a.lost_now[lane, r] = a.touched_now[lane, r] = False
    fill(a.traces, lane, 0.0)


@block
def take_all_actions(a: Arrays, first: int, last: int, s: Settings) -> None:
    """:func:`take_actions` of the lanes from ``first`` to before ``last``."""
    for lane in range(first, last):
        take_actions(a, lane, s)


@law
def transmit_lane(a: Arrays, lane: int, s: Settings) -> None:
    """Count the control step; everybody broadcasts."""
    step = a.clock[lane, 1] + 1
    a.clock[lane, 1] = step
    for r in range(a.motions.shape[1]):
        broadcast(a, lane, r, step, s)
        record_truth(a, lane, r, step)


@law
def look_lane(a: Arrays, lane: int, s: Settings) -> None:
    """Errors, rewards and observations of a lane as it stands."""
    robots = a.motions.shape[1]
    step = a.clock[lane, 1]
    for r in range(robots):
        judge_robot(a, lane, r, step, s)
        observe_robot(a, lane, r, step, s)
        if a.sensor_observations.shape[2] > 0:
            observe_sensors(a, lane, r, step, s)
    if s.cooperative:
        total = 0.0
        for r in range(robots):
            total += a.rewards[lane, r]
        for r in range(robots):
            a.rewards[lane, r] = total / robots
    end_lane(a, lane, s)


@block
def transmit_all(a: Arrays, first: int, last: int, s: Settings) -> None:
    """:func:`transmit_lane` of the lanes from ``first`` to before ``last``, and their next references."""
    for lane in range(first, last):
        transmit_lane(a, lane, s)
        for r in range(a.motions.shape[1]):
            next_reference(a, lane, r, a.clock[lane, 1] + s.lookahead, s)


@block
def look_all(a: Arrays, first: int, last: int, s: Settings) -> None:
    """:func:`look_lane` of the lanes from ``first`` to before ``last``."""
    for lane in range(first, last):
        look_lane(a, lane, s)


@driver
def excerpt_of(a: Arrays, mask: np.ndarray, out: Excerpt) -> None:
    """Write the excerpt of the lanes of the mask."""
    for lane in range(mask.shape[0]):
        if mask[lane]:
            write_excerpt(a, lane, lane + 1, out)


@driver
def delayed_message_of(a: Arrays, lane: int, r: int, step: int, s: Settings) -> Message:
    """:func:`delayed_message`, for observers outside."""
    return delayed_message(a, lane, r, step, s)


@driver
def delays_of(a: Arrays, lane: int, r: int, dt: float) -> tuple[int, int]:
    """:func:`delays`, for wheel loops outside."""
    return delays(a, lane, r, dt)


@driver
def start(
    a: Arrays, of: Variants, mask: np.ndarray, poses: np.ndarray, s: Settings
) -> tuple[int, int, int]:
    """:func:`start_lane` of every lane of the mask, up to the first that fails; :func:`look` is next.

    Returns its result and the lane.
    """
    for lane in range(mask.shape[0]):
        if mask[lane]:
            result, robot = start_lane(a, of, lane, poses, s)
            if result != STARTED:
                return result, robot, lane
    return STARTED, 0, 0


@driver
def look(a: Arrays, mask: np.ndarray, at_start: bool, s: Settings) -> None:
    """:func:`look_lane` of the lanes of the mask; who starts lost is lost in the first step."""
    for lane in range(mask.shape[0]):
        if mask[lane]:
            look_all(a, lane, lane + 1, s)
            if at_start:
                for r in range(a.ends.shape[1]):
                    a.lost[lane, r] = a.lost_now[lane, r] = False
                    a.ends[lane, r] = RUNNING


@driver
def transmit(a: Arrays, lane: int, s: Settings) -> None:
    """:func:`transmit_lane`."""
    transmit_lane(a, lane, s)


@driver
def refer(a: Arrays, lane: int, first: int, last: int, s: Settings) -> None:
    """The next references of the robots from ``first`` to before ``last``."""
    for r in range(first, last):
        next_reference(a, lane, r, a.clock[lane, 1] + s.lookahead, s)


@block
def find_near(a: Arrays, first: int, last: int, near: np.ndarray, s: Settings) -> None:
    """Mark the lanes from ``first`` on whose outlines could meet within the control step.

    Without torques only its end counts.
    """
    for lane in range(first, last):
        near[lane - first] = not s.kinematic and not room_to_move(a, lane, s.period)


@driver
def actuate(a: Arrays, lane: int, k: int, s: Settings) -> None:
    """The first half of substep ``k`` of a lane: everything up to the plant's new velocities and poses."""
    advance(a, np.full(1, lane), k, k + 1, True, False, s)


@driver
def sense(a: Arrays, lane: int, k: int, s: Settings) -> None:
    """The second half of substep ``k`` of a lane: sensors and estimator, and which outlines meet."""
    advance(a, np.full(1, lane), k, k + 1, False, True, s)
    mark_touched(a, lane)


@block
def mark_all_touched(a: Arrays, lanes: np.ndarray) -> None:
    """:func:`mark_touched` of some lanes."""
    for i in range(lanes.shape[0]):
        mark_touched(a, lanes[i])


def lanes_to_step(first: int, last: int, threads: int = 1) -> np.ndarray:
    """The lanes from ``first`` to before ``last``, for as many calls of :func:`control_step` at once."""
    return np.array([first, last, threads])


@law
def take_lanes(left: np.ndarray) -> tuple[int, int]:
    """Some lanes that no other thread takes: many at first, few in the end, so that all end together."""
    share = (left[1] - left[0]) // (SHARES * left[2])
    count = LANES_AT_ONCE * max(1, share // LANES_AT_ONCE)
    begin = fetch_add(left, count)
    return begin, min(begin + count, left[1])


@driver
def control_step(a: Arrays, left: np.ndarray, out: Excerpt, s: Settings) -> int:
    """A whole control step of lanes (see :func:`lanes_to_step`) until none is left, and their excerpt.

    Returns ``DONE``; or the number of the first robot whose action is not finite (see
    :func:`first_bad_action`), and nothing has changed for it. For a single lane also ``MUST_COLLIDE`` or
    ``MUST_SUBSTEP``: actions are taken, and the substeps are left to the plant's space, because robots
    are close, or to Python, because there are parts that live there.
    """
    apart_lanes = np.empty(LANES_AT_ONCE, dtype=np.int64)
    close_lanes = np.empty(LANES_AT_ONCE, dtype=np.int64)
    near = np.empty(LANES_AT_ONCE, dtype=np.bool_)
    first, last = take_lanes(left)
    while first < last:
        bad = first_bad_action(a, first, last)
        if bad != DONE:
            return bad
        for begin in range(first, last, LANES_AT_ONCE):
            end = min(begin + LANES_AT_ONCE, last)
            take_all_actions(a, begin, end, s)
            find_near(a, begin, end, near, s)
            apart = close = 0
            for lane in range(begin, end):
                if near[lane - begin] and s.collides:
                    return MUST_COLLIDE
                if s.has_parts:
                    return MUST_SUBSTEP
                if near[lane - begin]:
                    close_lanes[close], close = lane, close + 1
                else:
                    apart_lanes[apart], apart = lane, apart + 1
            lanes = apart_lanes[:apart]
            advance(a, lanes, 0, s.substeps, True, True, s)
            if s.kinematic:
                mark_all_touched(a, lanes)
            # Robots pass through each other here. While they are close, each substep asks which
            # outlines meet, so that the first touch is marked where a plant with contact marks it.
            lanes = close_lanes[:close]
            for k in range(s.substeps if close > 0 else 0):
                advance(a, lanes, k, k + 1, True, True, s)
                mark_all_touched(a, lanes)
            transmit_all(a, begin, end, s)
            look_all(a, begin, end, s)
            write_excerpt(a, begin, end, out)
        first, last = take_lanes(left)
    return DONE
