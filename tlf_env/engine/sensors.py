"""The laws of a substep after the plant: encoders, position fixes and estimators, and their sums."""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import (
    ENCODER_NOISE,
    POSITION_NOISE,
    Effects,
    effects_of_group,
    nominal_effects,
)
from tlf_env.engine.layout import (
    Draw,
    Order,
    Reading,
    Sample,
    Sensors,
    Trace,
    in_tile,
)
from tlf_env.engine.substeps import EXTERNAL_TORQUE, wanted
from tlf_env.numerics.compiled import law
from tlf_env.numerics.philox import normal_pair
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.estimator import Ekf, Estimate, correct, predict
from tlf_env.onboard.kinds import EKF, EKF_SLIP, TRUTH
from tlf_env.onboard.slip_estimator import (
    SlipEkf,
    SlipEstimate,
    correct_with_slip,
    predict_with_slip,
)
from tlf_env.onboard.tracking import body_errors
from tlf_env.physics.vehicle import Body, Motion, axle_midpoint, forward_and_yaw, odometry
from tlf_env.task.actions import TORQUE

# Encoders are exact while all of their channels are at their nominal values.
ENCODER_EFFECTS = np.array([in_tile("effects", name) for name in effects_of_group("encoder")])
NOMINAL_ENCODERS = np.array(
    [getattr(nominal_effects(), name) for name in effects_of_group("encoder")]
)

NO_SLIP = SlipEstimate(*(0.0 for _ in SlipEstimate._fields))
with_slip = replacing(SlipEstimate, "delta_1", "delta_2")
with_sensor_sums = replacing(
    Trace,
    "distance",
    "turn",
    "moved",
    "turned",
    "innovation_forward",
    "innovation_right",
    "nis",
)


@law
def disturbed_reading(angle: float, noise: float, effects: Effects) -> float:
    """An encoder's reading (rad) with noise (standard normal) and resolution."""
    if effects.encoder_noise_std_rad > 0.0:
        angle += effects.encoder_noise_std_rad * noise
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
def commanded_increments(
    order: Order, body: Body, slip: SlipEstimate, substep: int, dt: float
) -> tuple[float, float]:
    """Commanded distance (mm) and turn (rad) of the wheels in a substep; the last ones with torques."""
    if order.kind == TORQUE or order.kind == EXTERNAL_TORQUE:
        return slip.u_1, slip.u_2
    wanted_l, wanted_r = wanted(order, substep)
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
    substep: int,
    kind: int,
    dt: float,
) -> tuple[Sensors, Estimate, SlipEstimate, Trace, Sample]:
    """Position fix and estimator (of the ``kind``) of one robot after a substep."""
    step_l, step_r = reading.left - sensors.encoder_l, reading.right - sensors.encoder_r
    u_1, u_2 = odometry(step_l, step_r, body.R, body.h)
    true_x, true_y = axle_midpoint(motion, body.d)
    x, y = true_x + effects.position_bias_x_mm, true_y + effects.position_bias_y_mm
    if effects.position_noise_std_mm > 0.0:
        noise_x, noise_y = normal_pair(
            draw.seed, POSITION_NOISE, draw.robot, draw.episode, draw.tick
        )
        x += effects.position_noise_std_mm * noise_x
        y += effects.position_noise_std_mm * noise_y
    d_x = d_y = nis = 0.0
    if kind == EKF:
        estimate, d_x, d_y, nis = correct(predict(estimate, ekf, u_1, u_2), ekf, x, y)
    elif kind == EKF_SLIP:
        commanded_1, commanded_2 = commanded_increments(order, body, slip, substep, dt)
        estimate, slip = predict_with_slip(
            estimate, slip, slip_ekf, u_1, u_2, commanded_1, commanded_2, dt
        )
        estimate, slip, d_x, d_y, nis = correct_with_slip(estimate, slip, slip_ekf, x, y)
    elif kind == TRUTH:
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
    forward, right = body_errors(d_x, d_y, estimate.theta)
    return (
        Sensors(reading.left, reading.right, step_l / dt, step_r / dt),
        estimate,
        slip,
        with_sensor_sums(
            trace,
            trace.distance + u_1,
            trace.turn + u_2,
            trace.moved + u_1 - slip.spin_1 + slip.delta_1 * dt,
            trace.turned + u_2 - slip.spin_2 + slip.delta_2 * dt,
            trace.innovation_forward + forward,
            trace.innovation_right + right,
            trace.nis + nis,
        ),
        Sample(x, y, step_l, step_r),
    )
