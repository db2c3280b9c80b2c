"""Extended Kalman filter of pose and slip that also uses the gyro and the motors' torques.

Encoders do not show slip: the filter of :mod:`tlf_env.onboard.slip_estimator` finds it from position fixes
alone, some tenths of a second late. Two measurements of the body's motion are independent of the floor:

- The gyro measures the yaw rate. Its reading takes the place of the encoders' yaw increment.
- The torques accelerate the body, whatever the floor does: m v̇ = (τ_l + τ_r)/R − (J/R²)(v̇_l + v̇_r) for
  the wheels' inertia J and their speeds v_l, v_r at the rim. This holds over short times. Over longer ones
  friction, payload and slopes count, so the speed returns to that of the encoders with the time constant
  ``torque_time_s`` (a complementary filter).

The filter's fourth and fifth state are the errors of these two sources, random walks that the fixes correct,
and its laws are those of the slip filter. δ₁ and δ₂ of eq. (14) are the corrected speed and yaw rate minus the
encoders'. No test for jumps of the wheel speeds is needed.
"""

from __future__ import annotations

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.estimator import Estimate
from tlf_env.onboard.slip_estimator import (
    SlipEkf,
    SlipEkfParameters,
    SlipEstimate,
    correct_with_slip,
    predict_with_slip,
    sample_weight,
    slip_ekf_constants,
)
from tlf_env.physics.vehicle import Body


class GyroEkfParameters(Frozen):
    """Noise of the filter, and bounds of its slip estimates."""

    forward_noise_mm2_s: NonNegative = 5.0  # of the position along the heading
    sideways_noise_mm2_s: NonNegative = 0.3
    heading_noise_rad2_s: NonNegative = 1.0e-6  # of the gyro
    gyro_walk_rad2_s3: NonNegative = (
        1.0e-3  # of its error: bias, and a scale while the yaw rate changes
    )
    gyro_error_bound_rad_s: NonNegative = 0.2
    torque_time_s: Positive | None = 0.3  # None: the speed is that of the encoders
    speed_walk_mm2_s3: NonNegative = 4000.0  # of the speed's error
    speed_error_bound_mm_s: NonNegative = 150.0
    fix_variance_mm2: Positive = 0.2  # of each coordinate, at the start
    fix_variance_time_s: Positive | None = 0.5  # averaging time of its adaptation; None: constant
    least_fix_variance_mm2: Positive = 0.05
    fix_variance_factor: Positive = 4.0  # on the adapted variance, for errors outside the model
    slip_time_s: Positive = 0.02  # averaging time of δ₁ and δ₂, against the encoders' noise
    delta_1_bound_mm_s: NonNegative = 60.0
    delta_2_bound_rad_s: NonNegative = 0.415


def gyro_ekf_constants(parameters: GyroEkfParameters, robot: Body, dt_s: float) -> SlipEkf:
    """Constants of the filter for a sampling period of ``dt_s`` s, and a robot without payload."""
    by_torque = parameters.torque_time_s is not None
    # The slip filter's constants for the errors in place of the slips, without surprise and jumps.
    shared = SlipEkfParameters(
        forward_noise_mm2_s=parameters.forward_noise_mm2_s,
        sideways_noise_mm2_s=parameters.sideways_noise_mm2_s,
        heading_noise_rad2_s=parameters.heading_noise_rad2_s,
        delta_1_walk_mm2_s3=parameters.speed_walk_mm2_s3,
        delta_2_walk_rad2_s3=parameters.gyro_walk_rad2_s3,
        fix_variance_mm2=parameters.fix_variance_mm2,
        fix_variance_time_s=parameters.fix_variance_time_s,
        least_fix_variance_mm2=parameters.least_fix_variance_mm2,
        fix_variance_factor=parameters.fix_variance_factor,
        delta_1_bound_mm_s=parameters.speed_error_bound_mm_s,
        delta_2_bound_rad_s=parameters.gyro_error_bound_rad_s,
        surprise_threshold=None,
        most_surprise=0.0,
        most_acceleration_mm_s2=None,
        most_yaw_acceleration_rad_s2=None,
    )
    return slip_ekf_constants(shared, dt_s)._replace(
        slip_weight=sample_weight(dt_s, parameters.slip_time_s),
        reported_1=parameters.delta_1_bound_mm_s,
        reported_2=parameters.delta_2_bound_rad_s,
        by_torque=dt_s**2 * robot.inverse_m / robot.R if by_torque else 0.0,
        by_wheels=2.0 * robot.spin_mass_drive * robot.inverse_m if by_torque else 0.0,
        to_encoders=1.0
        if parameters.torque_time_s is None
        else sample_weight(dt_s, parameters.torque_time_s),
    )


with_errors = replacing(SlipEstimate, "delta_1", "delta_2", "rolled", "advance")
with_found = replacing(
    SlipEstimate, "delta_1", "delta_2", "speed_error", "gyro_error", "slip_1", "slip_2"
)


@law
def predict_with_gyro(
    estimate: Estimate,
    slip: SlipEstimate,
    ekf: SlipEkf,
    u_1: float,
    rate: float,
    torque: float,
    dt: float,
) -> tuple[Estimate, SlipEstimate]:
    """Pose, slip and covariance after one sample.

    u₁ is the encoders' increment (mm), ``rate`` the gyro's reading (rad/s), ``torque`` the sum of both motors'
    torques (mN·mm). In what is returned the slips are the errors of speed and gyro, for
    :func:`correct_with_gyro`.
    """
    advance = slip.advance + ekf.by_torque * torque - ekf.by_wheels * (u_1 - slip.rolled)
    advance += ekf.to_encoders * (u_1 - advance)
    turn = rate * dt
    before = with_errors(slip, slip.speed_error, slip.gyro_error, u_1, advance)
    return predict_with_slip(estimate, before, ekf, advance, turn, advance, turn, dt)


@law
def correct_with_gyro(
    estimate: Estimate,
    slip: SlipEstimate,
    ekf: SlipEkf,
    x: float,
    y: float,
    here: float,
    u_2: float,
    rate: float,
    dt: float,
) -> tuple[Estimate, SlipEstimate, float, float, float]:
    """Update with a position fix, and both slips; u₂ is the encoders' yaw increment (rad).

    ``here`` and what is returned are those of :func:`correct_with_slip`.
    """
    estimate, after, d_x, d_y, nis = correct_with_slip(estimate, slip, ekf, x, y, here)
    speed_error, gyro_error = after.delta_1, after.delta_2
    new_1 = (slip.advance - slip.rolled) / dt + speed_error
    new_2 = rate + gyro_error - u_2 / dt
    slip_1 = slip.slip_1 + ekf.slip_weight * (new_1 - slip.slip_1)
    slip_2 = slip.slip_2 + ekf.slip_weight * (new_2 - slip.slip_2)
    found = with_found(
        after,
        min(max(slip_1, -ekf.reported_1), ekf.reported_1),
        min(max(slip_2, -ekf.reported_2), ekf.reported_2),
        speed_error,
        gyro_error,
        slip_1,
        slip_2,
    )
    return estimate, found, d_x, d_y, nis
