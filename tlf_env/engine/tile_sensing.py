"""Encoders, gyro and estimators of the robots in a tile, in every substep."""

from __future__ import annotations

import numpy as np

from tlf_env.engine.layout import Innovation, Reading, Sensors, YawRate, in_tile
from tlf_env.engine.sensors import (
    account_robot,
    correct_robot,
    correct_without_fix,
    disturbed_encoders,
    gyro_reading,
    odometry_of,
    predict_robot,
    sense_with_gyro,
)
from tlf_env.engine.tile_rows import (
    belief_of,
    body_of,
    commanded_of,
    draw_of,
    effects_of,
    ekf_of,
    estimate_of,
    fix_of,
    gyro_ekf_of,
    gyro_of,
    motion_of,
    observed_of,
    order_of,
    reading_of,
    sensors_of,
    set_estimate,
    set_gyro,
    set_observed,
    set_reading,
    set_sample,
    set_sensors,
    set_slip,
    set_trace,
    set_yaw_rate,
    slip_ekf_of,
    slip_of,
    speed_observer_of,
    trace_of,
    yaw_rate_of,
)
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.kinds import EKF, EKF_GYRO, EKF_SLIP
from tlf_env.onboard.speed_observer import observed_speeds

TICK = in_tile("draw", "tick")
with_speeds = replacing(Sensors, "speed_l", "speed_r")


@law
def measure(tile: np.ndarray, numbers: np.ndarray, disturbed: bool, gyro: bool, dt: float) -> None:
    """Encoders, disturbed for some robot or for none, and gyro, if some robot's errs; one tick on."""
    for i in range(tile.shape[1]):
        numbers[TICK, i] += 1
    if disturbed:
        for i in range(tile.shape[1]):
            reading = disturbed_encoders(
                motion_of(tile, i), effects_of(tile, i), draw_of(numbers, i)
            )
            set_reading(tile, i, reading)
    else:
        for i in range(tile.shape[1]):
            motion = motion_of(tile, i)
            set_reading(tile, i, Reading(motion.angle_l, motion.angle_r))
    if gyro:
        for i in range(tile.shape[1]):
            motion, effects = motion_of(tile, i), effects_of(tile, i)
            rate = gyro_reading(motion, effects, draw_of(numbers, i), dt)
            set_yaw_rate(tile, i, YawRate(rate))
    else:
        for i in range(tile.shape[1]):
            set_yaw_rate(tile, i, YawRate(motion_of(tile, i).w))


@law
def estimate_tile(tile: np.ndarray, substep: int, estimator: int, fixes: bool, dt: float) -> None:
    """Prediction and correction of the filters, and what is kept of the substep."""
    for i in range(tile.shape[1]):
        body, belief, slip_ekf, fix = (
            body_of(tile, i),
            belief_of(tile, i),
            slip_ekf_of(tile, i),
            fix_of(tile, i),
        )
        increments = odometry_of(body, belief, reading_of(tile, i), sensors_of(tile, i))
        sensors, estimate, slip = predict_robot(
            body,
            belief,
            ekf_of(tile, i),
            slip_ekf,
            motion_of(tile, i),
            increments,
            sensors_of(tile, i),
            estimate_of(tile, i),
            slip_of(tile, i),
            order_of(tile, i),
            substep,
            estimator,
            dt,
        )
        if fixes:
            estimate, slip, innovation = correct_robot(
                ekf_of(tile, i), slip_ekf, fix, sensors, estimate, slip, estimator
            )
        else:
            slip = correct_without_fix(slip, slip_ekf, estimator)
            innovation = Innovation(0.0, 0.0, 0.0)
        sensors, trace, sample = account_robot(
            reading_of(tile, i),
            fix,
            yaw_rate_of(tile, i),
            commanded_of(tile, i),
            increments,
            sensors,
            estimate,
            slip,
            trace_of(tile, i),
            innovation,
            dt,
        )
        set_sensors(tile, i, sensors)
        set_estimate(tile, i, estimate)
        set_slip(tile, i, slip)
        set_trace(tile, i, trace)
        set_sample(tile, i, sample)


@law
def sense_tile(tile: np.ndarray, substep: int, estimator: int, fixes: bool, dt: float) -> None:
    """Wheel speeds and estimators; without ``fixes`` none has come to any robot."""
    if estimator == EKF_GYRO:
        for i in range(tile.shape[1]):
            sensors, estimate, slip, found, trace, sample = sense_with_gyro(
                body_of(tile, i),
                belief_of(tile, i),
                gyro_ekf_of(tile, i),
                reading_of(tile, i),
                fix_of(tile, i),
                yaw_rate_of(tile, i),
                commanded_of(tile, i),
                sensors_of(tile, i),
                estimate_of(tile, i),
                slip_of(tile, i),
                gyro_of(tile, i),
                trace_of(tile, i),
                dt,
            )
            set_sensors(tile, i, sensors)
            set_estimate(tile, i, estimate)
            set_slip(tile, i, slip)
            set_gyro(tile, i, found)
            set_trace(tile, i, trace)
            set_sample(tile, i, sample)
        return
    # A loop for each estimator: with several in one, it does not become vectors.
    if fixes and estimator == EKF_SLIP:
        estimate_tile(tile, substep, EKF_SLIP, True, dt)
    elif fixes and estimator == EKF:
        estimate_tile(tile, substep, EKF, True, dt)
    elif estimator == EKF_SLIP:
        estimate_tile(tile, substep, EKF_SLIP, False, dt)
    else:
        estimate_tile(tile, substep, estimator, False, dt)


@law
def observe_wheels(tile: np.ndarray, dt: float) -> None:
    """Wheel speeds by the velocity observers of the robots that have one."""
    for i in range(tile.shape[1]):
        row, reading, commanded = (
            speed_observer_of(tile, i),
            reading_of(tile, i),
            commanded_of(tile, i),
        )
        state = observed_speeds(
            observed_of(tile, i),
            reading.left,
            reading.right,
            commanded.left,
            commanded.right,
            row,
            dt,
        )
        if row.angle > 0.0:
            set_observed(tile, i, state)
            set_sensors(tile, i, with_speeds(sensors_of(tile, i), state.speed_l, state.speed_r))
