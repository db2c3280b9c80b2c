"""The laws of a substep around the plant: torques, disturbances, encoders, position fix, and their sums.

Wheel loop → torques → disturbances → plant → sensors → EKF; :mod:`tlf_env.engine.tiles` runs them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import (
    CHANNELS,
    COMPUTING_DELAY,
    DEAD_TIME,
    ENCODER_NOISE,
    FIRST_CHANNEL_STREAM,
    POSITION_NOISE,
)
from tlf_env.disturbances.model import Effects
from tlf_env.disturbances.signals import SignalRow, is_due, signal_value
from tlf_env.engine.layout import Arrays, Sample, Sensors, Trace
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.philox import normal_pair
from tlf_env.onboard.estimator import Ekf, Estimate, correct, predict
from tlf_env.onboard.kinds import EKF, EKF_SLIP, TRUTH
from tlf_env.onboard.slip_estimator import (
    SlipEkf,
    SlipEstimate,
    correct_with_slip,
    predict_with_slip,
)
from tlf_env.onboard.tracking import body_errors
from tlf_env.onboard.wheel_loop import WheelLoopRow, WheelLoopState, wheel_torque
from tlf_env.physics.vehicle import (
    Body,
    Contact,
    Floor,
    Motion,
    axle_midpoint,
    conveyor,
    forward_and_yaw,
    odometry,
)
from tlf_env.task.actions import TORQUE

CERTAIN = (0.0,) * (len(SlipEstimate._fields) - 2)  # what the true slip leaves to be estimated
EXTERNAL_TORQUE = 4  # stands for the kind of a robot whose wheel loop is an object outside
NOMINALS = np.array([channel.nominal for channel in CHANNELS])
LOWS = np.array([channel.low for channel in CHANNELS])
HIGHS = np.array([channel.high for channel in CHANNELS])


class Order(NamedTuple):
    """What one robot is asked for during a control step: rad/s, or mN·mm for torques."""

    kind: float  # of action
    wanted_l: float
    wanted_r: float
    before_l: float  # what holds during the first ``hold`` substeps
    before_r: float
    hold: float
    dead: float  # dead time of the torques, substeps


class Drive(NamedTuple):
    """Torques of one substep (mN·mm), and the factors on the tyres' friction."""

    asked_l: float  # by the wheel loop or the action, within the motor's limit
    asked_r: float
    given_l: float  # delivered
    given_r: float
    grip_l: float
    grip_r: float
    grip_c: float


class Reading(NamedTuple):
    """What the encoders show, rad."""

    left: float
    right: float


class Draw(NamedTuple):
    """Whose random number it is, and when; see :func:`tlf_env.numerics.philox.words`."""

    seed: int
    robot: int
    episode: int
    tick: int


@law
def wanted(order: Order, k: int) -> tuple[float, float]:
    """What holds in substep ``k`` of the control step."""
    early = k < order.hold
    return (
        order.before_l if early else order.wanted_l,
        order.before_r if early else order.wanted_r,
    )


@law
def asked_torques(
    body: Body, loop: WheelLoopRow, order: Order, held: WheelLoopState, sensors: Sensors, k: int
) -> tuple[float, float, WheelLoopState]:
    """Torques asked for in substep ``k``, within the motors' limit, and what the wheel loops hold then."""
    limit = body.torque_limit
    wanted_l, wanted_r = wanted(order, k)
    if order.kind == TORQUE or order.kind == EXTERNAL_TORQUE:
        return min(max(wanted_l, -limit), limit), min(max(wanted_r, -limit), limit), held
    torque_l, integral_l, lag_l = wheel_torque(
        wanted_l - sensors.speed_l, held.integral_l, held.lag_l, loop, limit
    )
    torque_r, integral_r, lag_r = wheel_torque(
        wanted_r - sensors.speed_r, held.integral_r, held.lag_r, loop, limit
    )
    return torque_l, torque_r, WheelLoopState(integral_l, lag_l, integral_r, lag_r)


@law
def undisturbed(asked_l: float, asked_r: float, effects: Effects) -> Drive:
    """Torques delivered without dead time, on a floor without patches."""
    return Drive(
        asked_l,
        asked_r,
        asked_l * effects.gain_l,
        asked_r * effects.gain_r,
        effects.grip,
        effects.grip,
        effects.grip,
    )


@law
def floor_under(body: Body, effects: Effects, drive: Drive) -> Floor:
    """What the floor does to a robot during one substep."""
    belt_l, belt_r = conveyor(effects.delta_1, effects.delta_2, body.h)
    return Floor(belt_l, belt_r, drive.grip_l, drive.grip_r, drive.grip_c)


@law
def trace_drive(
    trace: Trace, limit: float, drive: Drive, motion: Motion, contact: Contact, dt: float
) -> Trace:
    """Sums and extremes of torque and slip, one substep on."""
    at_limit = abs(drive.asked_l) >= limit or abs(drive.asked_r) >= limit
    given_l, given_r = drive.given_l, drive.given_r
    return Trace(
        trace.distance,
        trace.turn,
        trace.moved,
        trace.turned,
        trace.innovation_forward,
        trace.innovation_right,
        trace.nis,
        trace.torque_l + given_l,
        trace.torque_r + given_r,
        trace.saturated + (1.0 if at_limit else 0.0),
        max(trace.slip, max(contact.slip_l, contact.slip_r)),
        trace.slid + 0.5 * (contact.slip_l + contact.slip_r) * dt,
        trace.torque_2 + given_l * given_l + given_r * given_r,
        trace.work + (max(given_l * motion.omega_l, 0.0) + max(given_r * motion.omega_r, 0.0)) * dt,
    )


@law
def disturbed_reading(angle: float, noise: float, effects: Effects) -> float:
    """An encoder's reading (rad) with noise (standard normal) and resolution."""
    if effects.encoder_std > 0.0:
        angle += effects.encoder_std * noise
    if effects.quantum > 0.0:
        angle = effects.quantum * np.floor(angle / effects.quantum)
    return angle


@law
def disturbed_encoders(motion: Motion, effects: Effects, draw: Draw) -> Reading:
    """Both encoders with noise and resolution."""
    noise_l, noise_r = normal_pair(draw.seed, ENCODER_NOISE, draw.robot, draw.episode, draw.tick)
    return Reading(
        disturbed_reading(motion.angle_l, noise_l, effects),
        disturbed_reading(motion.angle_r, noise_r, effects),
    )


@law
def asked_increments(
    order: Order, body: Body, slip: SlipEstimate, k: int, dt: float
) -> tuple[float, float]:
    """Way (mm) and turn (rad) asked of the wheels in substep ``k``; the last ones if torques were."""
    if order.kind == TORQUE or order.kind == EXTERNAL_TORQUE:
        return slip.u_1, slip.u_2
    wanted_l, wanted_r = wanted(order, k)
    return odometry(wanted_l * dt, wanted_r * dt, body.R, body.h)


@law
def sense_robot(
    body: Body,
    ekf: Ekf,
    slip_ekf: SlipEkf,
    effects: Effects,
    motion: Motion,
    reading: Reading,
    sensors: Sensors,
    estimate: Estimate,
    slip: SlipEstimate,
    trace: Trace,
    draw: Draw,
    order: Order,
    k: int,
    kind: int,
    dt: float,
) -> tuple[Sensors, Estimate, SlipEstimate, Trace, Sample]:
    """Position fix and estimator (of the ``kind``) after substep ``k`` of one robot."""
    step_l, step_r = reading.left - sensors.encoder_l, reading.right - sensors.encoder_r
    u_1, u_2 = odometry(step_l, step_r, body.R, body.h)
    true_x, true_y = axle_midpoint(motion, body.d)
    x, y = true_x + effects.bias_x, true_y + effects.bias_y
    if effects.fix_std > 0.0:
        noise_x, noise_y = normal_pair(
            draw.seed, POSITION_NOISE, draw.robot, draw.episode, draw.tick
        )
        x += effects.fix_std * noise_x
        y += effects.fix_std * noise_y
    d_x = d_y = nis = 0.0
    if kind == EKF:
        estimate, d_x, d_y, nis = correct(predict(estimate, ekf, u_1, u_2), ekf, x, y)
    elif kind == EKF_SLIP:
        asked_1, asked_2 = asked_increments(order, body, slip, k, dt)
        estimate, slip = predict_with_slip(estimate, slip, slip_ekf, u_1, u_2, asked_1, asked_2, dt)
        estimate, slip, d_x, d_y, nis = correct_with_slip(estimate, slip, slip_ekf, x, y)
    elif kind == TRUTH:
        ahead, yaw = forward_and_yaw(motion)
        rolled, spun = odometry(motion.omega_l, motion.omega_r, body.R, body.h)
        slip = SlipEstimate(ahead - rolled, yaw - spun, *CERTAIN)
        estimate = Estimate(true_x, true_y, motion.theta, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    forward, right = body_errors(d_x, d_y, estimate.theta)
    return (
        Sensors(reading.left, reading.right, step_l / dt, step_r / dt),
        estimate,
        slip,
        Trace(
            trace.distance + u_1,
            trace.turn + u_2,
            trace.moved + u_1 - slip.spin_1 + slip.delta_1 * dt,
            trace.turned + u_2 - slip.spin_2 + slip.delta_2 * dt,
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


@law
def refresh(
    a: Arrays, lane: int, r: int, first: int, last: int, tick: int, ticks: int, s: Settings
) -> bool:
    """Evaluate those channels that may have changed since ``ticks`` ago; whether there were any."""
    found = False
    for c in range(first, last):
        row = a.signals[a.variants[lane], c]
        if s.adversary or is_due(row[0], row[4], tick, ticks):
            evaluate(a, lane, r, c, c + 1, tick, s)
            found = True
    return found


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
