"""The substeps of a control step: wheel loop → torques → disturbances → plant → sensors → EKF.

Robots do not act on each other within a control step unless they touch, so each runs its substeps by
itself, everything in registers.
"""

from __future__ import annotations

import math

import numpy as np

from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.philox import normal_pair
from tlf_env.onboard.estimator import (
    Ekf,
    Estimate,
    correct,
    odometry,
    predict,
    read_ekf,
    read_estimate,
    write_estimate,
)
from tlf_env.onboard.slip_estimator import (
    SlipEkf,
    SlipEstimate,
    correct_with_slip,
    predict_with_slip,
    read_slip_ekf,
    read_slip_estimate,
    write_slip_estimate,
)
from tlf_env.onboard.tracking import body_errors
from tlf_env.onboard.wheel_loop import (
    WheelLoop,
    WheelLoopState,
    read_loop_state,
    read_wheel_loop,
    wheel_torque,
    write_loop_state,
)
from tlf_env.physics.kernel import substep
from tlf_env.physics.kinematics import follow_wheels
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Push,
    advance_pose,
    axle_midpoint,
    conveyor,
    forward_and_yaw,
    read_body,
    read_contact,
    read_motion,
    write_contact,
    write_motion,
)
from tlf_env.task.actions import TORQUE
from tlf_env.task.arrays import (
    Arrays,
    Sample,
    Sensors,
    Trace,
    read_effects,
    read_sensors,
    read_trace,
    write_sample,
    write_sensors,
    write_trace,
)
from tlf_env.task.channels import (
    CHANNELS,
    COMPUTING_DELAY,
    DEAD_TIME,
    ENCODER_NOISE,
    FIRST_CHANNEL_STREAM,
    POSITION_NOISE,
    SUBSTEP_CHANNELS,
)
from tlf_env.task.disturbance import Effects, wheel_factors
from tlf_env.task.outlines import mark_touched
from tlf_env.task.settings import EKF, EKF_SLIP, TRUTH, Settings
from tlf_env.task.signals import SignalRow, signal_value

EXTERNAL_TORQUE = 4  # stands for the kind of a robot whose wheel loop is an object outside
NOMINALS = np.array([channel.nominal for channel in CHANNELS])
LOWS = np.array([channel.low for channel in CHANNELS])
HIGHS = np.array([channel.high for channel in CHANNELS])
NO_PUSH = Push(0.0, 0.0, 0.0)


@law
def actuate_robot(
    body: Body,
    loop: WheelLoop,
    effects: Effects,
    motion: Motion,
    contact: Contact,
    held: WheelLoopState,
    sensors: Sensors,
    trace: Trace,
    kind: int,
    wanted_l: float,
    wanted_r: float,
    patches: np.ndarray,
    delayed: np.ndarray,
    dead: int,
    tick: int,
    kinematic: bool,
    dt: float,
) -> tuple[Motion, Contact, WheelLoopState, Trace]:
    """Wheel loop, torques, disturbances and plant for one substep of one robot."""
    if kinematic:
        moved = follow_wheels(
            body, motion, wanted_l, wanted_r, effects.delta_1, effects.delta_2, dt
        )
        return moved, contact, held, trace
    limit = body.torque_limit
    if kind in (TORQUE, EXTERNAL_TORQUE):
        torque_l = min(max(wanted_l, -limit), limit)
        torque_r = min(max(wanted_r, -limit), limit)
    else:
        torque_l, integral_l, lag_l = wheel_torque(
            wanted_l - sensors.speed_l, held.integral_l, held.lag_l, loop, limit
        )
        torque_r, integral_r, lag_r = wheel_torque(
            wanted_r - sensors.speed_r, held.integral_r, held.lag_r, loop, limit
        )
        held = WheelLoopState(integral_l, lag_l, integral_r, lag_r)
    belt_l, belt_r = conveyor(effects.delta_1, effects.delta_2, body.h)
    floor = Floor(belt_l, belt_r, effects.grip, effects.grip, effects.grip)
    if patches.shape[0] > 0:
        on_l, on_r, on_c = wheel_factors(patches, body, motion)
        floor = Floor(belt_l, belt_r, effects.grip * on_l, effects.grip * on_r, effects.grip * on_c)
    given_l, given_r = torque_l, torque_r
    slots = delayed.shape[1]
    if slots > 1:
        delayed[0, tick % slots], delayed[1, tick % slots] = torque_l, torque_r
        given_l, given_r = 0.0, 0.0
        if tick > dead:
            given_l, given_r = delayed[0, (tick - dead) % slots], delayed[1, (tick - dead) % slots]
    given_l *= effects.gain_l
    given_r *= effects.gain_r
    motion, contact = substep(body, motion, contact, floor, NO_PUSH, given_l, given_r, dt)
    at_limit = abs(torque_l) >= limit or abs(torque_r) >= limit
    return (
        advance_pose(motion, dt),
        contact,
        held,
        Trace(
            trace.distance,
            trace.turn,
            trace.innovation_forward,
            trace.innovation_right,
            trace.nis,
            trace.torque_l + given_l,
            trace.torque_r + given_r,
            trace.saturated + (1.0 if at_limit else 0.0),
            max(trace.slip, max(contact.slip_l, contact.slip_r)),
            trace.slid + 0.5 * (contact.slip_l + contact.slip_r) * dt,
            trace.torque_2 + given_l * given_l + given_r * given_r,
            trace.work
            + (max(given_l * motion.omega_l, 0.0) + max(given_r * motion.omega_r, 0.0)) * dt,
        ),
    )


@law
def sense_robot(
    body: Body,
    ekf: Ekf,
    slip_ekf: SlipEkf,
    effects: Effects,
    motion: Motion,
    sensors: Sensors,
    estimate: Estimate,
    slip: SlipEstimate,
    trace: Trace,
    seed: int,
    episode: int,
    robot: int,
    tick: int,
    kind: int,
    dt: float,
) -> tuple[Sensors, Estimate, SlipEstimate, Trace, Sample]:
    """Encoders, position fix and estimator (of the ``kind``) after substep ``tick`` of one robot."""
    read_l, read_r = motion.angle_l, motion.angle_r
    if effects.encoder_std > 0.0:
        noise_l, noise_r = normal_pair(seed, ENCODER_NOISE, robot, episode, tick)
        read_l += effects.encoder_std * noise_l
        read_r += effects.encoder_std * noise_r
    if effects.quantum > 0.0:
        read_l = effects.quantum * math.floor(read_l / effects.quantum)
        read_r = effects.quantum * math.floor(read_r / effects.quantum)
    step_l, step_r = read_l - sensors.encoder_l, read_r - sensors.encoder_r
    u_1, u_2 = odometry(step_l, step_r, body.R, body.h)
    x, y = axle_midpoint(motion, body.d)
    x += effects.bias_x
    y += effects.bias_y
    if effects.fix_std > 0.0:
        noise_x, noise_y = normal_pair(seed, POSITION_NOISE, robot, episode, tick)
        x += effects.fix_std * noise_x
        y += effects.fix_std * noise_y
    d_x = d_y = nis = 0.0
    if kind == EKF:
        estimate, d_x, d_y, nis = correct(predict(estimate, ekf, u_1, u_2), ekf, x, y)
    elif kind == EKF_SLIP:
        estimate, slip = predict_with_slip(estimate, slip, slip_ekf, u_1, u_2, dt)
        estimate, slip, d_x, d_y, nis = correct_with_slip(estimate, slip, slip_ekf, x, y)
    elif kind == TRUTH:
        true_x, true_y = axle_midpoint(motion, body.d)
        ahead, yaw = forward_and_yaw(motion)
        rolled, spun = odometry(motion.omega_l, motion.omega_r, body.R, body.h)
        certain = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        slip = SlipEstimate(ahead - rolled, yaw - spun, *certain)
        estimate = Estimate(true_x, true_y, motion.theta, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    forward, right = body_errors(d_x, d_y, estimate.theta)
    return (
        Sensors(read_l, read_r, step_l / dt, step_r / dt),
        estimate,
        slip,
        Trace(
            trace.distance + u_1,
            trace.turn + u_2,
            trace.innovation_forward + forward,
            trace.innovation_right + right,
            trace.nis + nis,
            trace.torque_l,
            trace.torque_r,
            trace.saturated,
            trace.slip,
            trace.slid,
            trace.torque_2,
            trace.work,
        ),
        Sample(x, y, step_l, step_r),
    )


@law
def delays(a: Arrays, lane: int, r: int, dt: float) -> tuple[int, int]:
    """Dead time of the torques, and for how long the last action still holds, in ticks."""
    dead = round(a.applied[DEAD_TIME, r, lane] / dt)
    return dead, round(a.applied[COMPUTING_DELAY, r, lane] / dt)


@block
def evaluate(a: Arrays, lane: int, r: int, first: int, last: int, tick: int, s: Settings) -> None:
    """Evaluate the channels from ``first`` to before ``last`` for one robot at a tick."""
    signals = a.signals[a.variants[lane]]
    for c in range(first, last):
        row = SignalRow(signals[c, 0], signals[c, 1], signals[c, 2], signals[c, 3], signals[c, 4])
        value, a.processes[c, r, lane] = signal_value(
            row,
            tick,
            s.dt,
            a.seeds[lane],
            FIRST_CHANNEL_STREAM + c,
            r,
            a.clock[lane, 2],
            a.processes[c, r, lane],
        )
        value = NOMINALS[c] + a.levels[lane] * (value - NOMINALS[c])
        value = min(max(value, LOWS[c]), HIGHS[c])
        if s.adversary and not np.isnan(a.imposed[c, r, lane]):
            value = a.imposed[c, r, lane]
        a.applied[c, r, lane] = value


@block
def advance(a: Arrays, lane: int, begin: int, end: int, s: Settings) -> None:
    """Run the substeps ``begin`` to before ``end`` of every robot of a lane, each by itself."""
    dt = s.dt
    seed, episode, first = a.seeds[lane], a.clock[lane, 2], a.clock[lane, 0] - begin
    patches = a.patches[a.variants[lane]]
    for r in range(a.motions.shape[1]):
        body = read_body(a.bodies, r, lane)
        loop = read_wheel_loop(a.wheel_loops, r, lane)
        ekf = read_ekf(a.ekfs, r, lane)
        slip_ekf = read_slip_ekf(a.slip_ekfs, r, lane)
        effects = read_effects(a.applied, r, lane)
        motion = read_motion(a.motions, r, lane)
        contact = read_contact(a.contacts, r, lane)
        held = read_loop_state(a.loop_states, r, lane)
        sensors = read_sensors(a.sensors, r, lane)
        estimate = read_estimate(a.estimates, r, lane)
        slip = read_slip_estimate(a.slip_estimates, r, lane)
        trace = read_trace(a.traces, r, lane)
        kind = a.kinds[r, lane]
        wanted_l, wanted_r = a.commands[0, r, lane], a.commands[1, r, lane]
        dead, hold = delays(a, lane, r, dt)
        if begin < hold:
            wanted_l, wanted_r = a.wanted_before[0, r, lane], a.wanted_before[1, r, lane]
        delayed = a.torques[:, :, r, lane]
        for k in range(begin, end):
            if s.changing:
                evaluate(a, lane, r, 0, SUBSTEP_CHANNELS, first + k, s)
                effects = read_effects(a.applied, r, lane)
            if k == hold:
                wanted_l, wanted_r = a.commands[0, r, lane], a.commands[1, r, lane]
            motion, contact, held, trace = actuate_robot(
                body,
                loop,
                effects,
                motion,
                contact,
                held,
                sensors,
                trace,
                kind,
                wanted_l,
                wanted_r,
                patches,
                delayed,
                dead,
                first + k + 1,
                s.kinematic,
                dt,
            )
            sensors, estimate, slip, trace, sample = sense_robot(
                body,
                ekf,
                slip_ekf,
                effects,
                motion,
                sensors,
                estimate,
                slip,
                trace,
                seed,
                episode,
                r,
                first + k + 1,
                s.estimator,
                dt,
            )
            write_sample(a.samples[k], r, lane, sample)
        write_motion(a.motions, r, lane, motion)
        write_contact(a.contacts, r, lane, contact)
        write_loop_state(a.loop_states, r, lane, held)
        write_sensors(a.sensors, r, lane, sensors)
        write_estimate(a.estimates, r, lane, estimate)
        write_slip_estimate(a.slip_estimates, r, lane, slip)
        write_trace(a.traces, r, lane, trace)
    a.clock[lane, 0] = first + end


@block
def move_lane(a: Arrays, lane: int, near: bool, s: Settings) -> None:
    """Run the substeps of a control step of a lane without contact: robots pass through each other.

    While they are ``near``, each substep asks which outlines meet, so that the first touch is marked
    where a plant with contact marks it.
    """
    at_once = 1 if near else s.substeps
    for begin in range(0, s.substeps, at_once):
        advance(a, lane, begin, begin + at_once, s)
        if near or s.kinematic:
            mark_touched(a, lane)
