"""The laws of a substep after the plant: encoders, gyro, position fixes and estimators, and their sums."""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import (
    ENCODER_NOISE,
    GYRO_NOISE,
    POSITION_NOISE,
    POSITION_OUTAGE,
    POSITION_OUTLIER,
    Effects,
    effects_of_group,
    nominal_effects,
)
from tlf_env.engine.layout import (
    Draw,
    Fix,
    Increments,
    Innovation,
    Order,
    Reading,
    Sample,
    Sensors,
    Trace,
    WheelPair,
    YawRate,
    in_tile,
)
from tlf_env.engine.substeps import wanted
from tlf_env.numerics.compiled import law
from tlf_env.numerics.memory import like
from tlf_env.numerics.philox import normal_pair, unit, words
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.calibration import Belief, believed_odometry
from tlf_env.onboard.estimator import Ekf, Estimate, correct, predict
from tlf_env.onboard.gyro_estimator import (
    GyroEkf,
    GyroEstimate,
    correct_with_gyro,
    predict_with_gyro,
    reported_slip,
)
from tlf_env.onboard.kinds import EKF, EKF_SLIP, TRUTH
from tlf_env.onboard.slip_estimator import (
    SlipEkf,
    SlipEstimate,
    correct_with_slip,
    predict_with_slip,
    with_slip,
    within_bounds,
)
from tlf_env.onboard.tracking import body_errors
from tlf_env.physics.vehicle import Body, Motion, axle_midpoint, forward_and_yaw, odometry
from tlf_env.task.actions import EXTERNAL_TORQUE, TORQUE


def of_group(group: str) -> tuple[np.ndarray, np.ndarray]:
    """Places in a tile of a group's effects, and their nominal values."""
    names = effects_of_group(group)
    return (
        np.array([in_tile("effects", name) for name in names]),
        np.array([getattr(nominal_effects(), name) for name in names]),
    )


# Encoders and gyro are exact while all of their channels are at their nominal values, and every substep has a
# position fix at once while all of these are.
ENCODER_EFFECTS, NOMINAL_ENCODERS = of_group("encoder")
GYRO_EFFECTS, NOMINAL_GYRO = of_group("gyro")
FIX_NUMBERS = np.array(
    [in_tile("order", "fix_every"), in_tile("order", "fix_delay")]
    + [in_tile("effects", f"position_{name}") for name in ("outage", "outlier_share")]
)
NOMINAL_FIXES = np.array([1.0, 0.0, 0.0, 0.0])

NO_SLIP = SlipEstimate(*(0.0 for _ in SlipEstimate._fields))
with_position = replacing(Fix, "x", "y")
with_way = replacing(Sensors, "way_x", "way_y")
with_times = replacing(Order, "measured", "arrived")
with_sensor_sums = replacing(
    Trace,
    "distance",
    "turn",
    "moved",
    "turned",
    "innovation_forward",
    "innovation_right",
    "nis",
    "fixes",
    "off_x",
    "off_y",
)


@law
def disturbed_reading(angle: float, noise: float, effects: Effects) -> float:
    """An encoder's reading (rad) with noise (standard normal) and resolution."""
    if effects.encoder_noise_std_rad > 0.0:
        angle += effects.encoder_noise_std_rad * like(noise, angle)
    if effects.encoder_quantum_rad > 0.0:
        angle = effects.encoder_quantum_rad * np.floor(angle / effects.encoder_quantum_rad)
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
def gyro_reading(motion: Motion, effects: Effects, draw: Draw, dt: float) -> float:
    """Measured yaw rate (rad/s); white noise of density n has the standard deviation n/√dt."""
    reading = effects.gyro_scale * motion.w + effects.gyro_bias_rad_s
    if effects.gyro_noise_rad_s_sqrt_hz > 0.0:
        noise, _ = normal_pair(draw.seed, GYRO_NOISE, draw.robot, draw.episode, draw.tick)
        reading += effects.gyro_noise_rad_s_sqrt_hz / np.sqrt(dt) * like(noise, reading)
    return reading


@law
def measured_fix(body: Body, motion: Motion, effects: Effects, draw: Draw) -> Fix:
    """A position fix with bias and noise, at once."""
    true_x, true_y = axle_midpoint(motion, body.d)
    x, y = true_x + effects.position_bias_x_mm, true_y + effects.position_bias_y_mm
    if effects.position_noise_std_mm > 0.0:
        noise_x, noise_y = normal_pair(
            draw.seed, POSITION_NOISE, draw.robot, draw.episode, draw.tick
        )
        x += effects.position_noise_std_mm * like(noise_x, x)
        y += effects.position_noise_std_mm * like(noise_y, y)
    return Fix(x=x, y=y, here=1.0, age=0.0, way_x=0.0, way_y=0.0)


@law
def first_times(order: Order, tick: int) -> Order:
    """The order at a tick with the times since fixes were due; see :func:`next_times`."""
    every, delay = int(order.fix_every), int(order.fix_delay)
    if every == 1:
        return with_times(order, 0.0, 0.0)
    return with_times(order, float(tick % every), float((tick - delay) % every))


@law
def next_times(order: Order) -> Order:
    """The order one substep later. A fix is due at every tick that is a multiple of ``fix_every``."""
    measured, arrived = order.measured + 1.0, order.arrived + 1.0
    return with_times(
        order,
        0.0 if measured >= order.fix_every else measured,
        0.0 if arrived >= order.fix_every else arrived,
    )


@law
def missing(effects: Effects, order: Order, draw: Draw) -> bool:
    """Whether no position is measured at a tick."""
    if order.measured > 0.0:
        return True
    if not effects.position_outage > 0.0:
        return False
    word, _, _, _ = words(draw.seed, POSITION_OUTAGE, draw.robot, draw.episode, draw.tick)
    return unit(word) < effects.position_outage


@law
def with_outlier(fix: Fix, effects: Effects, draw: Draw) -> Fix:
    """A position fix that may be an outlier."""
    if not effects.position_outlier_share > 0.0:
        return fix
    chance, _, _, _ = words(draw.seed, POSITION_OUTLIER, draw.robot, draw.episode, 2 * draw.tick)
    if unit(chance) >= effects.position_outlier_share:
        return fix
    far_x, far_y = normal_pair(
        draw.seed, POSITION_OUTLIER, draw.robot, draw.episode, 2 * draw.tick + 1
    )
    std = effects.position_outlier_std_mm
    return with_position(fix, fix.x + std * like(far_x, fix.x), fix.y + std * like(far_y, fix.y))


@law
def commanded_increments(
    order: Order, body: Body, belief: Belief, slip: SlipEstimate, substep: int, dt: float
) -> tuple[float, float]:
    """Commanded distance (mm) and turn (rad) of the wheels in a substep; the last ones with torques."""
    if order.kind == TORQUE or order.kind == EXTERNAL_TORQUE:
        return slip.u_1, slip.u_2
    wanted_l, wanted_r = wanted(order, substep)
    return believed_odometry(wanted_l * dt, wanted_r * dt, body, belief)


@law
def sensed(
    reading: Reading,
    fix: Fix,
    yaw_rate: YawRate,
    commanded: WheelPair,
    increments: Increments,
    sensors: Sensors,
    trace: Trace,
    innovation: Innovation,
    theta: float,
    moved: float,
    turned: float,
    dt: float,
) -> tuple[Sensors, Trace, Sample]:
    """What is kept of a substep: encoders and way, sums over the control step, and the sample.

    ``sensors`` has the estimator's way (mm) after the substep, ``theta`` is its heading, ``moved`` and
    ``turned`` are the sums of its motions.
    """
    way_x, way_y = sensors.way_x, sensors.way_y
    from_x, from_y = (fix.way_x, fix.way_y) if fix.age > 0.0 else (way_x, way_y)
    forward, right = body_errors(innovation.d_x, innovation.d_y, theta)
    return (
        Sensors(
            encoder_l=reading.left,
            encoder_r=reading.right,
            speed_l=increments.step_l / dt,
            speed_r=increments.step_r / dt,
            way_x=way_x,
            way_y=way_y,
        ),
        with_sensor_sums(
            trace,
            trace.distance + increments.u_1,
            trace.turn + increments.u_2,
            moved,
            turned,
            trace.innovation_forward + fix.here * forward,
            trace.innovation_right + fix.here * right,
            trace.nis + innovation.nis,
            trace.fixes + fix.here,
            trace.off_x + fix.here * (fix.x - from_x),
            trace.off_y + fix.here * (fix.y - from_y),
        ),
        Sample(
            fix_x=fix.x,
            fix_y=fix.y,
            step_l=increments.step_l,
            step_r=increments.step_r,
            has_fix=fix.here,
            fix_age=fix.age,
            gyro=yaw_rate.reading,
            torque_l=commanded.left,
            torque_r=commanded.right,
        ),
    )


@law
def odometry_of(body: Body, belief: Belief, reading: Reading, sensors: Sensors) -> Increments:
    """Motion by the encoders since the last substep."""
    step_l, step_r = reading.left - sensors.encoder_l, reading.right - sensors.encoder_r
    u_1, u_2 = believed_odometry(step_l, step_r, body, belief)
    return Increments(step_l, step_r, u_1, u_2)


@law
def predict_robot(
    body: Body,
    belief: Belief,
    ekf: Ekf,
    slip_ekf: SlipEkf,
    motion: Motion,
    increments: Increments,
    sensors: Sensors,
    estimate: Estimate,
    slip: SlipEstimate,
    order: Order,
    substep: int,
    kind: int,
    dt: float,
) -> tuple[Sensors, Estimate, SlipEstimate]:
    """The estimator (of the ``kind``) of one robot after a substep, without a fix; and its way."""
    u_1, u_2 = increments.u_1, increments.u_2
    before_x, before_y = estimate.x, estimate.y
    if kind == EKF:
        estimate = predict(estimate, ekf, u_1, u_2)
    elif kind == EKF_SLIP:
        commanded_1, commanded_2 = commanded_increments(order, body, belief, slip, substep, dt)
        estimate, slip = predict_with_slip(
            estimate, slip, slip_ekf, u_1, u_2, commanded_1, commanded_2, dt
        )
    elif kind == TRUTH:
        true_x, true_y = axle_midpoint(motion, body.d)
        ahead, yaw = forward_and_yaw(motion)
        rolled, spun = odometry(motion.omega_l, motion.omega_r, body.R, body.h)
        slip = with_slip(NO_SLIP, ahead - rolled, yaw - spun)
        estimate = Estimate(
            x=true_x,
            y=true_y,
            theta=motion.theta,
            p_xx=0.0,
            p_xy=0.0,
            p_xt=0.0,
            p_yy=0.0,
            p_yt=0.0,
            p_tt=0.0,
        )
    if kind in (EKF, EKF_SLIP):
        way_x = sensors.way_x + (estimate.x - before_x)
        way_y = sensors.way_y + (estimate.y - before_y)
        sensors = with_way(sensors, way_x, way_y)
    return sensors, estimate, slip


@law
def correct_robot(
    ekf: Ekf,
    slip_ekf: SlipEkf,
    fix: Fix,
    sensors: Sensors,
    estimate: Estimate,
    slip: SlipEstimate,
    kind: int,
) -> tuple[Estimate, SlipEstimate, Innovation]:
    """The estimator of one robot after a position fix, if there is one.

    A fix that comes late is moved on by as much as the estimator moved its position since then.
    """
    d_x = d_y = nis = 0.0
    x = fix.x + (sensors.way_x - fix.way_x) if fix.age > 0.0 else fix.x
    y = fix.y + (sensors.way_y - fix.way_y) if fix.age > 0.0 else fix.y
    if kind == EKF:
        estimate, d_x, d_y, nis = correct(estimate, ekf, x, y, fix.here)
    elif kind == EKF_SLIP:
        estimate, slip, d_x, d_y, nis = correct_with_slip(estimate, slip, slip_ekf, x, y, fix.here)
    return estimate, slip, Innovation(d_x, d_y, nis)


@law
def correct_without_fix(slip: SlipEstimate, slip_ekf: SlipEkf, kind: int) -> SlipEstimate:
    """What :func:`correct_robot` changes where no fix has come."""
    return within_bounds(slip, slip_ekf) if kind == EKF_SLIP else slip


@law
def account_robot(
    reading: Reading,
    fix: Fix,
    yaw_rate: YawRate,
    commanded: WheelPair,
    increments: Increments,
    sensors: Sensors,
    estimate: Estimate,
    slip: SlipEstimate,
    trace: Trace,
    innovation: Innovation,
    dt: float,
) -> tuple[Sensors, Trace, Sample]:
    """:func:`sensed` with what the estimators of :func:`predict_robot` take as the robot's motion."""
    return sensed(
        reading,
        fix,
        yaw_rate,
        commanded,
        increments,
        sensors,
        trace,
        innovation,
        estimate.theta,
        trace.moved + increments.u_1 - slip.spin_1 + slip.delta_1 * dt,
        trace.turned + increments.u_2 - slip.spin_2 + slip.delta_2 * dt,
        dt,
    )


@law
def sense_with_gyro(
    body: Body,
    belief: Belief,
    ekf: GyroEkf,
    reading: Reading,
    fix: Fix,
    yaw_rate: YawRate,
    commanded: WheelPair,
    sensors: Sensors,
    estimate: Estimate,
    slip: SlipEstimate,
    found: GyroEstimate,
    trace: Trace,
    dt: float,
) -> tuple[Sensors, Estimate, SlipEstimate, GyroEstimate, Trace, Sample]:
    """Wheel speeds, and the estimator that uses the gyro and the torques, of one robot after a substep."""
    increments = odometry_of(body, belief, reading, sensors)
    before_x, before_y = estimate.x, estimate.y
    torque = commanded.left + commanded.right
    estimate, found = predict_with_gyro(
        estimate, found, ekf, increments.u_1, yaw_rate.reading, torque, dt
    )
    way_x = sensors.way_x + (estimate.x - before_x)
    way_y = sensors.way_y + (estimate.y - before_y)
    x = fix.x + (way_x - fix.way_x) if fix.age > 0.0 else fix.x
    y = fix.y + (way_y - fix.way_y) if fix.age > 0.0 else fix.y
    estimate, found, d_x, d_y, nis = correct_with_gyro(
        estimate, found, ekf, x, y, fix.here, increments.u_2, yaw_rate.reading, dt
    )
    delta_1, delta_2 = reported_slip(found, ekf)
    turned = (yaw_rate.reading * (1.0 + found.scale_error) + found.gyro_error) * dt
    sensors, trace, sample = sensed(
        reading,
        fix,
        yaw_rate,
        commanded,
        increments,
        with_way(sensors, way_x, way_y),
        trace,
        Innovation(d_x, d_y, nis),
        estimate.theta,
        trace.moved + found.advance + found.speed_error * dt,
        trace.turned + turned,
        dt,
    )
    return sensors, estimate, with_slip(slip, delta_1, delta_2), found, trace, sample
