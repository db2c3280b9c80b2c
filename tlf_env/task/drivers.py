"""The step drivers: what Python calls, a control step or a part of one at a time.

One control step runs, for every robot and substep, wheel loop → torques → disturbances → plant →
sensors → EKF, and then once per robot radio → observer → observation, reward, errors. Robots do not
act on each other within a control step unless they touch, so each runs its substeps by itself; the
pymunk plant calls :func:`actuate` and :func:`sense` one substep at a time while robots are close.
"""

from __future__ import annotations

import numpy as np

from tlf_env.numerics.compiled import block, driver, law
from tlf_env.onboard.estimator import read_ekf, read_estimate, write_estimate
from tlf_env.onboard.wheel_loop import read_loop_state, read_wheel_loop, write_loop_state
from tlf_env.physics.parameters import MILLINEWTON_PER_NEWTON
from tlf_env.physics.state import read_body, read_contact, read_motion, write_contact, write_motion
from tlf_env.task.actions import (
    FULL_RESIDUAL_MM_S,
    FULL_RESIDUAL_RAD_S,
    FULL_SPEED_MM_S,
    FULL_TORQUE_NMM,
    FULL_YAW_RATE_RAD_S,
    REFERENCE,
    RESIDUAL,
    TORQUE,
    TWIST,
    limited,
    reference_action,
    wheel_command,
)
from tlf_env.task.arrays import (
    RUNNING,
    Arrays,
    Variants,
    read_effects,
    read_sensors,
    read_trace,
    write_sample,
    write_sensors,
    write_trace,
)
from tlf_env.task.channels import STEP_CHANNELS, SUBSTEP_CHANNELS
from tlf_env.task.judging import (
    CLIPPED,
    end_lane,
    judge_robot,
    observe_robot,
    observe_sensors,
    record_truth,
)
from tlf_env.task.outlines import mark_touched, room_to_move
from tlf_env.task.radio import broadcast, message_slot, next_reference
from tlf_env.task.settings import Settings
from tlf_env.task.starting import STARTED, fill, start_lane
from tlf_env.task.substeps import (
    EXTERNAL_TORQUE,
    actuate_robot,
    delays,
    evaluate,
    move_lane,
    sense_robot,
)

DONE, MUST_COLLIDE, MUST_SUBSTEP = -1, -2, -3
LANES_AT_ONCE = 16  # whose arrays stay in the processor's cache during a step


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
        base = a.base_actions[lane, r]
        base[0], base[1] = reference_action(a.observations[lane, r], a.scales, s.base)
        b_0 = base[0] + a_0 * FULL_RESIDUAL_MM_S / FULL_SPEED_MM_S
        b_1 = base[1] + a_1 * FULL_RESIDUAL_RAD_S / FULL_YAW_RATE_RAD_S
        return wheel_command(limited(b_0), limited(b_1), TWIST, body)
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


@block
def take_actions(a: Arrays, lane: int, s: Settings) -> None:
    """Clip the actions of a lane and turn them into commands; clears the traces."""
    for r in range(a.actions.shape[1]):
        if a.kinds[r, lane] == REFERENCE:
            base = a.base_actions[lane, r]
            base[0], base[1] = reference_action(a.observations[lane, r], a.scales, s.base)
            a.actions[lane, r, 0], a.actions[lane, r, 1] = limited(base[0]), limited(base[1])
        a_0, a_1 = limited(a.actions[lane, r, 0]), limited(a.actions[lane, r, 1])
        clipped = a_0 != a.actions[lane, r, 0] or a_1 != a.actions[lane, r, 1]
        if clipped:
            a.infos[lane, r, CLIPPED] += 1.0
        a.actions[lane, r, 0], a.actions[lane, r, 1] = a_0, a_1
        a.wanted_before[0, r, lane] = a.wanted[0, r, lane]
        a.wanted_before[1, r, lane] = a.wanted[1, r, lane]
        a.wanted[0, r, lane], a.wanted[1, r, lane] = command(a, lane, r, s)
        a.commands[0, r, lane] = a.wanted[0, r, lane]
        a.commands[1, r, lane] = a.wanted[1, r, lane]
        evaluate(a, lane, r, SUBSTEP_CHANNELS, STEP_CHANNELS, a.clock[lane, 0], s)
        if s.adversary and not s.changing:
            evaluate(a, lane, r, 0, SUBSTEP_CHANNELS, a.clock[lane, 0], s)
        a.lost_now[lane, r] = a.touched_now[lane, r] = False
    fill(a.traces, lane, 0.0)


@block
def transmit_lane(a: Arrays, lane: int, s: Settings) -> None:
    """Count the control step; everybody broadcasts."""
    step = a.clock[lane, 1] + 1
    a.clock[lane, 1] = step
    for r in range(a.motions.shape[1]):
        broadcast(a, lane, r, step, s.period)
        record_truth(a, lane, r, step)


@block
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
        mean = a.rewards[lane].mean()
        a.rewards[lane, :] = mean
    end_lane(a, lane, s)


@block
def conclude_lane(a: Arrays, lane: int, s: Settings) -> None:
    """After the substeps of a control step: radio, observers, errors, rewards and observations."""
    transmit_lane(a, lane, s)
    for r in range(a.motions.shape[1]):
        next_reference(a, lane, r, a.clock[lane, 1] + s.lookahead, s)
    look_lane(a, lane, s)


@driver
def message_slot_of(a: Arrays, lane: int, r: int, step: int, s: Settings) -> int:
    """:func:`message_slot`, for observers outside."""
    return message_slot(a, lane, r, step, s)


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
            look_lane(a, lane, s)
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
def are_near(a: Arrays, lane: int, s: Settings) -> bool:
    """Whether outlines could meet within the control step; without torques only its end counts."""
    return not s.kinematic and not room_to_move(a, lane, s.period)


@driver
def actuate(a: Arrays, lane: int, k: int, s: Settings) -> None:
    """The first half of substep ``k`` of a lane: everything up to the plant's new velocities and poses."""
    tick = a.clock[lane, 0]
    for r in range(a.motions.shape[1]):
        kind = a.kinds[r, lane]
        if s.external_wheel_loop and kind != TORQUE:
            kind = EXTERNAL_TORQUE
        if s.changing:
            evaluate(a, lane, r, 0, SUBSTEP_CHANNELS, tick, s)
        dead, hold = delays(a, lane, r, s.dt)
        wanted_l, wanted_r = a.commands[0, r, lane], a.commands[1, r, lane]
        if k < hold and kind != EXTERNAL_TORQUE:
            wanted_l, wanted_r = a.wanted_before[0, r, lane], a.wanted_before[1, r, lane]
        motion, contact, held, trace = actuate_robot(
            read_body(a.bodies, r, lane),
            read_wheel_loop(a.wheel_loops, r, lane),
            read_effects(a.applied, r, lane),
            read_motion(a.motions, r, lane),
            read_contact(a.contacts, r, lane),
            read_loop_state(a.loop_states, r, lane),
            read_sensors(a.sensors, r, lane),
            read_trace(a.traces, r, lane),
            kind,
            wanted_l,
            wanted_r,
            a.patches[a.variants[lane]],
            a.torques[:, :, r, lane],
            dead,
            tick + 1,
            s.kinematic,
            s.dt,
        )
        write_motion(a.motions, r, lane, motion)
        write_contact(a.contacts, r, lane, contact)
        write_loop_state(a.loop_states, r, lane, held)
        write_trace(a.traces, r, lane, trace)


@driver
def sense(a: Arrays, lane: int, k: int, s: Settings) -> None:
    """The second half of substep ``k`` of a lane: sensors and estimator, and which outlines meet."""
    tick = a.clock[lane, 0] + 1
    for r in range(a.motions.shape[1]):
        sensors, estimate, trace, sample = sense_robot(
            read_body(a.bodies, r, lane),
            read_ekf(a.ekfs, r, lane),
            read_effects(a.applied, r, lane),
            read_motion(a.motions, r, lane),
            read_sensors(a.sensors, r, lane),
            read_estimate(a.estimates, r, lane),
            read_trace(a.traces, r, lane),
            a.seeds[lane],
            a.clock[lane, 2],
            r,
            tick,
            s.estimator,
            s.dt,
        )
        write_sample(a.samples[k], r, lane, sample)
        write_sensors(a.sensors, r, lane, sensors)
        write_estimate(a.estimates, r, lane, estimate)
        write_trace(a.traces, r, lane, trace)
    a.clock[lane, 0] = tick
    mark_touched(a, lane)


@driver
def control_step(a: Arrays, first: int, last: int, s: Settings) -> int:
    """A whole control step of the lanes from ``first`` to before ``last``.

    Returns ``DONE``; or the number of the first robot whose action is not finite (see
    :func:`first_bad_action`), and nothing has changed. For a single lane also ``MUST_COLLIDE`` or
    ``MUST_SUBSTEP``: actions are taken, and the substeps are left to the plant's space, because robots
    are close, or to Python, because there are parts that live there.
    """
    bad = first_bad_action(a, first, last)
    if bad != DONE:
        return bad
    for begin in range(first, last, LANES_AT_ONCE):
        end = min(begin + LANES_AT_ONCE, last)
        for lane in range(begin, end):
            take_actions(a, lane, s)
        for lane in range(begin, end):
            near = are_near(a, lane, s)
            if near and s.collides:
                return MUST_COLLIDE
            if s.has_parts:
                return MUST_SUBSTEP
            move_lane(a, lane, near, s)
        for lane in range(begin, end):
            conclude_lane(a, lane, s)
    return DONE
