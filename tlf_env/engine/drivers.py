"""The step drivers: functions that Python calls for a control step or a part of one.

One control step runs, for every robot and substep, wheel loop → torques → disturbances → plant →
sensors → EKF, and then once per robot radio → observer → observation, reward, errors. Robots do not
act on each other within a control step unless they touch, so the substeps of all run side by side; the
pymunk plant calls :func:`actuate` and :func:`sense` one substep at a time while robots are close.
"""

from __future__ import annotations

import math

import numpy as np

from tlf_env.engine.arrays import (
    Arrays,
    Variants,
    read_belief,
    read_body,
    read_contact,
    read_motion,
    read_rejection,
    read_trace,
    read_traction,
    read_wanted,
    write_command,
    write_rejection,
    write_trace,
    write_wanted,
    write_wanted_before,
)
from tlf_env.engine.effects import OF_STEPS, OF_SUBSTEPS, delays, evaluate, refresh
from tlf_env.engine.excerpt import Excerpt, write_excerpt
from tlf_env.engine.judging import (
    CLIPPED,
    end_lane,
    judge_robot,
    observe_robot,
    observe_sensors,
    record_truth,
)
from tlf_env.engine.layout import Trace, WheelPair, in_array
from tlf_env.engine.outlines import away_from_walls, mark_touched, room_to_move, touch
from tlf_env.engine.radio import broadcast, delayed_message, next_reference
from tlf_env.engine.rays import capsule_at, cast_rays, is_reading, meet, report_rays
from tlf_env.engine.settings import Settings
from tlf_env.engine.smoothing import smooth
from tlf_env.engine.starting import STARTED, start_lane
from tlf_env.engine.substeps import trace_drive
from tlf_env.engine.tiles import advance
from tlf_env.numerics.compiled import allocating, block, driver, fetch_add, law
from tlf_env.numerics.indices import natural
from tlf_env.numerics.philox import unit, words
from tlf_env.onboard.calibration import believed_odometry
from tlf_env.onboard.kinds import TRUTH
from tlf_env.onboard.observer import Message
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.task.actions import (
    FULL_SPEED_MM_S,
    FULL_TORQUE_NMM,
    FULL_YAW_RATE_RAD_S,
    LIMITED_OUTSIDE_RESIDUAL,
    LIMITED_TWIST,
    OUTSIDE_RESIDUAL,
    REFERENCE,
    RESIDUAL,
    TORQUE,
    TRACKING_TWIST,
    TWIST,
    WHEEL_SPEED,
    allowed_twist,
    clipped_action,
    led_reference,
    reference_action,
    residual_share,
    twist_action,
    wanted_twist,
    wheel_command,
)
from tlf_env.task.info import RUNNING

# Parts of a control step, for `control_step`.
WHOLE = 0
ACTUATE = (
    1  # the first half of a substep: all up to the plant's new velocities and poses, or its inputs
)
SENSE = 2  # the second half: sensors and estimator, and which outlines meet
TRANSMIT = 3  # broadcasts, and the next references of some robots
LOOK = 4  # errors, rewards and observations
LOOK_AT_START = 5  # the same of an episode that begins

TRACE = in_array("trace")
TRACE_END = TRACE + len(Trace._fields)
DONE, MUST_COLLIDE, MUST_SUBSTEP = -1, -2, -3
LANES_AT_ONCE = 16  # few enough that their numbers stay in the processor's cache during a step
SHARES = 4  # a thread takes the remaining lanes / (threads · SHARES) at a time


@law
def command(arrays: Arrays, lane: int, robot: int, settings: Settings) -> tuple[float, float]:
    """The command of a robot's clipped action: wheel speeds (rad/s), or torques (mN·mm)."""
    a_0, a_1 = arrays.actions[lane, robot, 0], arrays.actions[lane, robot, 1]
    kind = arrays.kinds[robot, lane]
    if kind == TORQUE:
        full = FULL_TORQUE_NMM * MILLINEWTON_PER_NEWTON
        return a_0 * full, a_1 * full
    body = read_body(arrays.constants, robot, lane)
    belief = read_belief(arrays.constants, robot, lane)
    if kind == RESIDUAL:
        seen, given = arrays.observations[lane, robot], arrays.twists[lane, robot]
        memory = read_rejection(arrays.states, robot, lane)
        u_1, u_2, memory = wanted_twist(seen, arrays.scales, settings.base, memory)
        write_rejection(arrays.states, robot, lane, memory)
        share = residual_share(seen, arrays.scales, settings.residual_fade, settings.residual_reach)
        u_1 += share * a_0 * settings.full_1
        u_2 += share * a_1 * settings.full_2
        given[0], given[1] = twist_action(seen, arrays.scales, settings.base, u_1, u_2)
        return wheel_command(given[0], given[1], TWIST, body, belief)
    if kind in (TWIST, WHEEL_SPEED, REFERENCE):
        return wheel_command(a_0, a_1, kind, body, belief)
    seen, given = arrays.observations[lane, robot], arrays.twists[lane, robot]
    if kind in (OUTSIDE_RESIDUAL, LIMITED_OUTSIDE_RESIDUAL):  # `given` is the policy's action
        share = residual_share(seen, arrays.scales, settings.residual_fade, settings.residual_reach)
        given[0] = clipped_action(given[0] + share * a_0 * settings.full_1 / FULL_SPEED_MM_S)
        given[1] = clipped_action(given[1] + share * a_1 * settings.full_2 / FULL_YAW_RATE_RAD_S)
        if kind == OUTSIDE_RESIDUAL:
            return wheel_command(given[0], given[1], TWIST, body, belief)
        u_1, u_2 = given[0] * FULL_SPEED_MM_S, given[1] * FULL_YAW_RATE_RAD_S
    elif kind == TRACKING_TWIST:
        u_1, u_2 = led_reference(seen, arrays.scales, settings.limits.lead)
        share = residual_share(seen, arrays.scales, settings.tracking_fade, math.inf)
        u_1, u_2 = u_1 + share * a_0 * settings.full_1, u_2 + share * a_1 * settings.full_2
    elif kind == LIMITED_TWIST:
        u_1, u_2 = a_0 * FULL_SPEED_MM_S, a_1 * FULL_YAW_RATE_RAD_S
    else:
        left, right = wheel_command(a_0, a_1, WHEEL_SPEED, body, belief)
        u_1, u_2 = believed_odometry(left, right, body, belief)
    u_1, u_2 = allowed_twist(seen, arrays.scales, settings.limits, settings.supervisor, u_1, u_2)
    given[0], given[1] = twist_action(seen, arrays.scales, settings.limits, u_1, u_2)
    return wheel_command(given[0], given[1], TWIST, body, belief)


@block
def first_bad_action(arrays: Arrays, first: int, last: int) -> int:
    """``DONE``, or lane · robots + robot of the first action that is not finite."""
    robots = arrays.actions.shape[1]
    for lane in range(first, last):
        for robot in range(robots):
            if not (
                np.isfinite(arrays.actions[lane, robot, 0])
                and np.isfinite(arrays.actions[lane, robot, 1])
            ):
                return lane * robots + robot
    return DONE


@law
def take_actions(arrays: Arrays, lane: int, settings: Settings) -> None:
    """Clip the actions of a lane and turn them into commands."""
    for robot in range(arrays.actions.shape[1]):
        if arrays.kinds[robot, lane] == REFERENCE:
            given = arrays.twists[lane, robot]
            memory = read_rejection(arrays.states, robot, lane)
            given[0], given[1], memory = reference_action(
                arrays.observations[lane, robot], arrays.scales, settings.base, memory
            )
            write_rejection(arrays.states, robot, lane, memory)
            arrays.actions[lane, robot, 0], arrays.actions[lane, robot, 1] = given[0], given[1]
        a_0, a_1 = (
            clipped_action(arrays.actions[lane, robot, 0]),
            clipped_action(arrays.actions[lane, robot, 1]),
        )
        clipped = a_0 != arrays.actions[lane, robot, 0] or a_1 != arrays.actions[lane, robot, 1]
        if clipped:
            arrays.infos[lane, robot, CLIPPED] += 1.0
        arrays.actions[lane, robot, 0], arrays.actions[lane, robot, 1] = a_0, a_1
        write_wanted_before(arrays.states, robot, lane, read_wanted(arrays.states, robot, lane))
        wanted_l, wanted_r = command(arrays, lane, robot, settings)
        write_wanted(arrays.states, robot, lane, WheelPair(wanted_l, wanted_r))
        write_command(arrays.states, robot, lane, WheelPair(wanted_l, wanted_r))
        tick = arrays.clock[lane, 0]
        refresh(arrays, lane, robot, OF_STEPS, tick, settings.substeps, settings)
        if settings.adversary and not settings.changing:
            for i in range(OF_SUBSTEPS.shape[0]):
                evaluate(arrays, lane, robot, OF_SUBSTEPS[i], tick, settings)
        arrays.lost_now[lane, robot] = arrays.touched_now[lane, robot] = False


@block
def take_all_actions(arrays: Arrays, first: int, last: int, settings: Settings) -> None:
    """:func:`take_actions` of the lanes from ``first`` to before ``last``, and clear their traces."""
    for lane in range(first, last):
        take_actions(arrays, natural(lane), settings)
    for i in range(TRACE, TRACE_END):
        for robot in range(arrays.states.shape[1]):
            trace = arrays.states[i, robot, first:last]
            for k in range(trace.shape[0]):
                trace[k] = 0.0


@law
def transmit_lane(arrays: Arrays, lane: int, settings: Settings) -> None:
    """Count the control step, and broadcast from all robots."""
    step = natural(arrays.clock[lane, 1]) + 1
    arrays.clock[lane, 1] = step
    for robot in range(arrays.states.shape[1]):
        broadcast(arrays, lane, robot, step, settings)
        if settings.half_window > 0 and settings.estimator != TRUTH:
            smooth(arrays, lane, robot, step, settings)
        record_truth(arrays, lane, robot, step)


@law
def look_lane(arrays: Arrays, lane: int, settings: Settings) -> None:
    """Errors, rewards and observations of a lane at the present step."""
    robots = arrays.states.shape[1]
    step = natural(arrays.clock[lane, 1])
    for robot in range(robots):
        judge_robot(arrays, lane, robot, step, settings)
        observe_robot(arrays, lane, robot, step, settings)
        if arrays.sensor_observations.shape[2] > 0:
            observe_sensors(arrays, lane, robot, step, settings)
    if is_reading(arrays, lane, settings):
        for robot in range(robots):
            cast_rays(arrays, lane, robot, settings)
            report_rays(arrays, lane, robot, settings)
    if settings.cooperative:
        total = 0.0
        for robot in range(robots):
            total += arrays.rewards[lane, robot]
        for robot in range(robots):
            arrays.rewards[lane, robot] = total / robots
    end_lane(arrays, lane, settings)


@block
def transmit_all(arrays: Arrays, first: int, last: int, referred: int, settings: Settings) -> None:
    """:func:`transmit_lane` of the lanes from ``first`` to before ``last``.

    Then the next references of the first robots, ``referred`` of each.
    """
    for lane in range(first, last):
        transmit_lane(arrays, natural(lane), settings)
        for robot in range(referred):
            next_reference(
                arrays,
                natural(lane),
                robot,
                natural(arrays.clock[lane, 1] + settings.lookahead),
                settings,
            )


@block
def look_all(arrays: Arrays, first: int, last: int, settings: Settings) -> None:
    """:func:`look_lane` of the lanes from ``first`` to before ``last``."""
    for lane in range(first, last):
        look_lane(arrays, natural(lane), settings)


@driver
def excerpt_of(arrays: Arrays, mask: np.ndarray, out: Excerpt) -> None:
    """Write the excerpt of the lanes of the mask."""
    for lane in range(mask.shape[0]):
        if mask[lane]:
            write_excerpt(arrays, lane, lane + 1, out)


@driver
def delayed_message_of(
    arrays: Arrays, lane: int, robot: int, step: int, settings: Settings
) -> Message:
    """:func:`delayed_message`, for observers outside."""
    return delayed_message(arrays, lane, robot, step, settings)


@driver
def mark(arrays: Arrays, lane: int, robot: int, thing: int) -> None:
    """:func:`touch`, for what the space finds."""
    touch(arrays, lane, robot, thing)


@driver
def uniform(seed: int, stream: int, number: int, episode: int) -> float:
    """A random number in [0, 1), for draws outside."""
    word, _, _, _ = words(seed, stream, number, episode, 0)
    return unit(word)


@driver
def cast_at(
    arrays: Arrays, lane: int, capsules: np.ndarray, owners: np.ndarray, settings: Settings
) -> None:
    """Let the rays of a lane's last reading meet other capsules, too, ``(number, Capsule)``.

    ``owners`` (number,) are the robots that do not see them, or −1.
    """
    for robot in range(arrays.states.shape[1]):
        for number in range(capsules.shape[0]):
            if owners[number] != robot:
                meet(arrays, lane, robot, capsule_at(capsules, number), settings)
        report_rays(arrays, lane, robot, settings)


@driver
def delays_of(arrays: Arrays, lane: int, robot: int, dt: float) -> tuple[int, int]:
    """:func:`delays`, for wheel loops outside."""
    return delays(arrays, lane, robot, dt)


@driver
def start(
    arrays: Arrays, of: Variants, mask: np.ndarray, poses: np.ndarray, settings: Settings
) -> tuple[int, int, int]:
    """:func:`start_lane` of every lane of the mask, up to the first that fails; :func:`look` is next.

    Returns its result and the lane.
    """
    for lane in range(mask.shape[0]):
        if mask[lane]:
            result, robot = start_lane(arrays, of, lane, poses, settings)
            if result != STARTED:
                return result, robot, lane
    return STARTED, 0, 0


@block
def forget_losses(arrays: Arrays, lane: int) -> None:
    """A robot that starts lost counts as lost in the first step."""
    for robot in range(arrays.ends.shape[1]):
        arrays.lost[lane, robot] = arrays.lost_now[lane, robot] = False
        arrays.ends[lane, robot] = RUNNING


@block
def find_near(arrays: Arrays, first: int, last: int, near: np.ndarray, settings: Settings) -> None:
    """Mark the lanes from ``first`` on whose outlines could meet, or a wall, within the control step.

    Without torques only its end counts.
    """
    for lane in range(first, last):
        k = natural(lane)
        near[lane - first] = not settings.kinematic and not (
            away_from_walls(arrays, k, settings.period) and room_to_move(arrays, k, settings.period)
        )


@driver
def account(arrays: Arrays, lane: int, settings: Settings) -> None:
    """The sums of torque and slip of a substep that the plant ``chipmunk`` has made."""
    for robot in range(arrays.states.shape[1]):
        trace = trace_drive(
            read_trace(arrays.states, robot, lane),
            read_body(arrays.constants, robot, lane).torque_limit,
            read_traction(arrays.inputs, robot, lane),
            read_motion(arrays.states, robot, lane),
            read_contact(arrays.states, robot, lane),
            settings.dt,
        )
        write_trace(arrays.states, robot, lane, trace)


@block
def mark_all_touched(arrays: Arrays, lanes: np.ndarray) -> None:
    """:func:`mark_touched` of some lanes."""
    for i in range(lanes.shape[0]):
        mark_touched(arrays, lanes[i])


def lanes_to_step(first: int, last: int, threads: int = 1) -> np.ndarray:
    """The lanes from ``first`` to before ``last``, for as many calls with :data:`WHOLE` at once."""
    return np.array([first, last, threads])


@law
def take_lanes(left: np.ndarray) -> tuple[int, int]:
    """Lanes for this thread alone: many at first, few in the end, so that all threads end together."""
    share = (left[1] - left[0]) // (SHARES * left[2])
    count = LANES_AT_ONCE * max(1, share // LANES_AT_ONCE)
    begin = fetch_add(left, count)
    return begin, min(begin + count, left[1])


@allocating
def whole_step(arrays: Arrays, left: np.ndarray, out: Excerpt, settings: Settings) -> int:
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
        bad = first_bad_action(arrays, first, last)
        if bad != DONE:
            return bad
        for begin in range(first, last, LANES_AT_ONCE):
            end = min(begin + LANES_AT_ONCE, last)
            take_all_actions(arrays, begin, end, settings)
            find_near(arrays, begin, end, near, settings)
            apart = close = 0
            for lane in range(begin, end):
                if near[lane - begin] and settings.collides:
                    return MUST_COLLIDE
                if settings.has_parts:
                    return MUST_SUBSTEP
                if near[lane - begin]:
                    close_lanes[close], close = lane, close + 1
                else:
                    apart_lanes[apart], apart = lane, apart + 1
            lanes = apart_lanes[:apart]
            advance(settings.number, arrays, lanes, 0, settings.substeps, True, True, settings)
            if settings.kinematic:
                mark_all_touched(arrays, lanes)
            # Robots pass through each other here. While they are close, each substep asks which
            # outlines meet, so that the first touch is marked where a plant with contact marks it.
            lanes = close_lanes[:close]
            for substep in range(settings.substeps if close > 0 else 0):
                advance(settings.number, arrays, lanes, substep, substep + 1, True, True, settings)
                mark_all_touched(arrays, lanes)
            transmit_all(arrays, begin, end, arrays.states.shape[1], settings)
            look_all(arrays, begin, end, settings)
            write_excerpt(arrays, begin, end, out)
        first, last = take_lanes(left)
    return DONE


@driver
def control_step(
    arrays: Arrays, lanes: np.ndarray, out: Excerpt, part: int, number: int, settings: Settings
) -> int:
    """A control step, or a part of one, in one driver: what its parts share is compiled once.

    Parameters
    ----------
    lanes
        As :func:`lanes_to_step` gives them for :data:`WHOLE`, otherwise the numbers of some lanes.
    out
        Where :data:`WHOLE` writes an excerpt.
    part
        One of the parts above.
    number
        The substep of :data:`ACTUATE` and :data:`SENSE`; how many robots of each lane get their next
        reference in :data:`TRANSMIT`.

    Returns
    -------
    What :func:`whole_step` returns; ``DONE`` after another part.
    """
    if part == WHOLE:
        return whole_step(arrays, lanes, out, settings)
    if part in (ACTUATE, SENSE):
        advance(
            settings.number,
            arrays,
            lanes,
            number,
            number + 1,
            part == ACTUATE,
            part == SENSE,
            settings,
        )
        if part == SENSE and settings.round_outlines:
            mark_all_touched(arrays, lanes)
        return DONE
    for i in range(lanes.shape[0]):
        if part == TRANSMIT:
            transmit_all(arrays, lanes[i], lanes[i] + 1, number, settings)
        else:
            look_all(arrays, lanes[i], lanes[i] + 1, settings)
        if part == LOOK_AT_START:
            forget_losses(arrays, lanes[i])
    return DONE
