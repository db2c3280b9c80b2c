"""Extended Kalman filter of pose and slip that also uses the gyro and the motors' torques.

Encoders do not show slip: the filter of :mod:`tlf_env.onboard.slip_estimator` finds it from position fixes
alone, some tenths of a second late. Two measurements of the body's motion are independent of the floor:

- The gyro measures the yaw rate. Its reading takes the place of the encoders' yaw increment.
- The torques accelerate the body, whatever the floor does: m v̇ = (τ_l + τ_r)/R − (J/R²)(v̇_l + v̇_r) − m a for
  the wheels' inertia J, their speeds v_l, v_r at the rim, and the deceleration a by the Coulomb friction of the
  joints under the empty robot's load. Over longer times payload, slopes and other friction count, so the speed
  returns to that of the encoders with the time constant ``torque_time_s`` (a complementary filter).

The filter has three states besides the pose, which the fixes correct: the errors of the speed and of the gyro,
both random walks, and the error of the gyro's scale, a constant. δ₁ and δ₂ of eq. (14) are the corrected speed
and yaw rate minus the encoders'. The variance of the fixes is adapted as in the slip filter. The weight of a
fix whose normalised innovation is large is reduced, so that outliers count little (bounded influence:
Huber, Robust Estimation of a Location Parameter, Annals of Mathematical Statistics, 1964).

A tyre that transmits force slips, too. A controller that subtracts this slip turns the wheel faster, and on a
floor with little grip the wheel then spins. So slip is reported only after slip was seen while the body hardly
accelerated, when the tyres transmit little: then it is the floor's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, NonNegative, Positive, infinite_if_none
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.numerics.trig import sincos
from tlf_env.onboard.estimator import (
    Estimate,
    corrected_pose,
    inverse_innovation_covariance,
    normalised_square,
    pose_gain,
)
from tlf_env.onboard.slip_estimator import sample_weight
from tlf_env.physics.vehicle import Body

LEAST_KNOWN_MM2 = 1e-9  # of the adapted variance
ACCELERATION_TIME_S = 0.08  # averaging time of the body's acceleration
CRAWL_MM_S = 5.0  # below, the wheels may be held by their joints: the torques say little


class GyroEkfParameters(Frozen):
    """Noise of the filter, and bounds of its slip estimates."""

    forward_noise_mm2_s: NonNegative = 1.0  # of the position along the heading
    sideways_noise_mm2_s: NonNegative = 0.05
    heading_noise_rad2_s: NonNegative = 1.0e-6  # of the gyro
    gyro_walk_rad2_s3: NonNegative = 1.0e-5  # of its error: bias
    gyro_error_bound_rad_s: NonNegative = 0.2
    gyro_scale_std: NonNegative = 0.03  # of the error of its scale, at the start
    gyro_scale_bound: NonNegative = 0.1
    torque_time_s: Positive | None = 1.0  # None: the speed is that of the encoders
    speed_walk_mm2_s3: NonNegative = 1000.0  # of the speed's error
    speed_error_bound_mm_s: NonNegative = 200.0
    fix_variance_mm2: Positive = 0.2  # of each coordinate, at the start
    fix_variance_time_s: Positive | None = 0.5  # averaging time of its adaptation; None: constant
    least_fix_variance_mm2: Positive = 0.05
    fix_variance_factor: Positive = 4.0  # on the adapted variance, for errors outside the model
    # Normalised innovation squared above which the weight of a fix is reduced; None: never.
    outlier_threshold: Positive | None = 30.0
    slip_time_s: Positive = 0.02  # averaging time of δ₁ and δ₂, against the encoders' noise
    delta_1_bound_mm_s: NonNegative = 60.0
    delta_2_bound_rad_s: NonNegative = 0.415
    # Slip is reported as the floor's where its average over samples with little acceleration is above
    # floor_slip_mm_s or floor_slip_rad_s, and in full from twice that on. A sample counts fully below half of
    # this acceleration, and not at all above it. None: all slip is reported.
    floor_slip_acceleration_mm_s2: Positive | None = 100.0
    floor_slip_mm_s: Positive = 10.0
    floor_slip_rad_s: Positive = 0.08
    floor_slip_rise_s: Positive = 0.3  # averaging time of slip that grows
    floor_slip_decay_s: Positive = 20.0  # of slip that shrinks


class GyroEkf(NamedTuple):
    """Constants of the filter; process noise as variance per sample."""

    forward: float
    sideways: float
    heading: float
    walk_1: float
    walk_2: float
    scale: float  # variance of the scale's error at the start
    variance: float
    bound_1: float
    bound_2: float
    bound_3: float
    variance_weight: float  # weight of a sample in the variance of the fixes
    least_variance: float
    variance_factor: float
    threshold: float  # of the normalised innovation squared
    slip_weight: float  # weight of a sample in δ₁ and δ₂
    reported_1: float  # bounds of δ₁ (mm/s) and δ₂ (rad/s)
    reported_2: float
    by_torque: float  # change of the motion in a sample, mm per mN·mm
    by_wheels: float  # share of a change of the wheels' motion
    drag: float  # change of the motion in a sample by the joints' friction, mm
    crawl: float  # mm per sample
    to_encoders: float  # share by which the motion returns to that of the encoders
    motion_weight: float  # weight of a sample in the smoothed twist
    arm: float  # mm: force at a wheel by yaw acceleration, as an acceleration of the body
    most_quiet: float  # mm/s²: above, the slip of a sample does not count as the floor's
    rise: float  # weights of a sample in the average slip of the floor
    decay: float
    floor_1: float  # mm/s and rad/s: above, the average counts as slip of the floor
    floor_2: float
    all_slip: float  # 1 if all slip is reported, else 0


class GyroEstimate(NamedTuple):
    """Errors of speed (1), gyro (2) and scale (3), their part of the covariance's upper triangle, and more."""

    speed_error: float  # what the speed from the torques is too small, mm/s
    gyro_error: float  # what the gyro reads too little, rad/s
    scale_error: float  # share of its reading, beside that
    p_x1: float
    p_y1: float
    p_t1: float
    p_x2: float
    p_y2: float
    p_t2: float
    p_x3: float
    p_y3: float
    p_t3: float
    p_11: float
    p_12: float
    p_13: float
    p_22: float
    p_23: float
    p_33: float  # minus its value at the start
    variance: float  # of a fix, minus its value at the start, mm²
    d_x: float  # last innovation, world axes, mm
    d_y: float
    slip_1: float  # δ₁ and δ₂ before their bounds, mm/s and rad/s
    slip_2: float
    rolled: float  # last increment of the encoders, mm
    advance: float  # last increment from the torques, mm
    speed: float  # smoothed twist of the body, mm/s and rad/s
    yaw_rate: float
    floor_1: float  # average of |δ₁| and |δ₂| while the body hardly accelerates, mm/s and rad/s
    floor_2: float


def gyro_ekf_constants(parameters: GyroEkfParameters, robot: Body, dt_s: float) -> GyroEkf:
    """Constants of the filter for a sampling period of ``dt_s`` s, and a robot without payload."""
    by_torque = parameters.torque_time_s is not None
    return GyroEkf(
        forward=parameters.forward_noise_mm2_s * dt_s,
        sideways=parameters.sideways_noise_mm2_s * dt_s,
        heading=parameters.heading_noise_rad2_s * dt_s,
        walk_1=parameters.speed_walk_mm2_s3 * dt_s,
        walk_2=parameters.gyro_walk_rad2_s3 * dt_s,
        scale=parameters.gyro_scale_std**2,
        variance=parameters.fix_variance_mm2,
        bound_1=parameters.speed_error_bound_mm_s,
        bound_2=parameters.gyro_error_bound_rad_s,
        bound_3=parameters.gyro_scale_bound,
        variance_weight=0.0
        if parameters.fix_variance_time_s is None
        else sample_weight(dt_s, parameters.fix_variance_time_s),
        least_variance=parameters.least_fix_variance_mm2,
        variance_factor=parameters.fix_variance_factor,
        threshold=infinite_if_none(parameters.outlier_threshold),
        slip_weight=sample_weight(dt_s, parameters.slip_time_s),
        reported_1=parameters.delta_1_bound_mm_s,
        reported_2=parameters.delta_2_bound_rad_s,
        by_torque=dt_s**2 * robot.inverse_m / robot.R if by_torque else 0.0,
        by_wheels=2.0 * robot.spin_mass_drive * robot.inverse_m if by_torque else 0.0,
        drag=drag_mm_s2(robot) * dt_s**2 if by_torque else 0.0,
        crawl=CRAWL_MM_S * dt_s,
        to_encoders=1.0
        if parameters.torque_time_s is None
        else sample_weight(dt_s, parameters.torque_time_s),
        motion_weight=sample_weight(dt_s, ACCELERATION_TIME_S),
        arm=robot.I * robot.inverse_m / robot.h,
        most_quiet=infinite_if_none(parameters.floor_slip_acceleration_mm_s2),
        rise=sample_weight(dt_s, parameters.floor_slip_rise_s),
        decay=sample_weight(dt_s, parameters.floor_slip_decay_s),
        floor_1=parameters.floor_slip_mm_s,
        floor_2=parameters.floor_slip_rad_s,
        all_slip=0.0 if parameters.floor_slip_acceleration_mm_s2 is not None else 1.0,
    )


def drag_mm_s2(robot: Body) -> float:
    """Deceleration (mm/s²) of a robot that rolls straight ahead by the friction (5) of its wheels' joints."""
    drive = robot.drive_radial * robot.load_drive + robot.drive_preload
    castor = robot.axle_radial * robot.load_castor + robot.axle_preload
    force = 2.0 * robot.drive_mu_dynamic * drive / robot.R
    return (force + robot.axle_mu_dynamic * castor / robot.R_c) * robot.inverse_m


with_fix_weight = replacing(GyroEkf, "variance_weight")


@law
def gyro_for_fixes(ekf: GyroEkf, every: int) -> GyroEkf:
    """The filter's constants if a fix comes once in ``every`` samples: its mean over time stays the same."""
    if every == 1:
        return ekf
    return with_fix_weight(ekf, 1.0 - (1.0 - ekf.variance_weight) ** every)


@law
def advanced_by_torque(found: GyroEstimate, ekf: GyroEkf, u_1: float, torque: float) -> float:
    """Increment (mm) of the body in a sample from the torques, for the encoders' increment u₁ (mm)."""
    rolls = min(max(u_1 / ekf.crawl, -1.0), 1.0)
    advance = found.advance + ekf.by_torque * torque - ekf.by_wheels * (u_1 - found.rolled)
    advance -= ekf.drag * rolls
    # Wheels that stand may be held by their joints' friction, which takes up an unknown part of the torque.
    to_encoders = 1.0 - rolls * rolls * (1.0 - ekf.to_encoders)
    return advance + to_encoders * (u_1 - advance)


predicted_errors = replacing(
    GyroEstimate,
    *("p_x1", "p_y1", "p_t1", "p_x2", "p_y2", "p_t2", "p_x3", "p_y3", "p_t3", "p_11", "p_22"),
    *("rolled", "advance"),
)


@law
def predict_with_gyro(
    estimate: Estimate,
    found: GyroEstimate,
    ekf: GyroEkf,
    u_1: float,
    rate: float,
    torque: float,
    dt: float,
) -> tuple[Estimate, GyroEstimate]:
    """Pose, errors and covariance after one sample.

    u₁ is the encoders' increment (mm), ``rate`` the gyro's reading (rad/s), ``torque`` the sum of both motors'
    torques (mN·mm).
    """
    advance = advanced_by_torque(found, ekf, u_1, torque)
    turn = rate * dt
    moved = advance + found.speed_error * dt
    turned = turn + found.gyro_error * dt + found.scale_error * turn
    sin, cos = sincos(estimate.theta + 0.5 * turned)
    # F = I but for ∂(x, y)/∂θ = f, ∂(x, y)/∂e₁ = h, and ∂θ/∂e₂ = dt, ∂θ/∂e₃ = turn, half of which counts in f.
    f_x, f_y = -moved * cos, -moved * sin
    h_x, h_y = -sin * dt, cos * dt
    p_33 = found.p_33 + ekf.scale
    # Heading in the middle of the sample, its covariance with every state.
    q_x = estimate.p_xt + 0.5 * (dt * found.p_x2 + turn * found.p_x3)
    q_y = estimate.p_yt + 0.5 * (dt * found.p_y2 + turn * found.p_y3)
    q_t = estimate.p_tt + 0.5 * (dt * found.p_t2 + turn * found.p_t3)
    q_1 = found.p_t1 + 0.5 * (dt * found.p_12 + turn * found.p_13)
    q_2 = found.p_t2 + 0.5 * (dt * found.p_22 + turn * found.p_23)
    q_3 = found.p_t3 + 0.5 * (dt * found.p_23 + turn * p_33)
    # M = F P, then F P Fᵀ + Q.
    m_xx = estimate.p_xx + f_x * q_x + h_x * found.p_x1
    m_xy = estimate.p_xy + f_x * q_y + h_x * found.p_y1
    m_xt = estimate.p_xt + f_x * q_t + h_x * found.p_t1
    m_x1 = found.p_x1 + f_x * q_1 + h_x * found.p_11
    m_x2 = found.p_x2 + f_x * q_2 + h_x * found.p_12
    m_x3 = found.p_x3 + f_x * q_3 + h_x * found.p_13
    m_yy = estimate.p_yy + f_y * q_y + h_y * found.p_y1
    m_yt = estimate.p_yt + f_y * q_t + h_y * found.p_t1
    m_y1 = found.p_y1 + f_y * q_1 + h_y * found.p_11
    m_y2 = found.p_y2 + f_y * q_2 + h_y * found.p_12
    m_y3 = found.p_y3 + f_y * q_3 + h_y * found.p_13
    m_tt = estimate.p_tt + dt * found.p_t2 + turn * found.p_t3
    m_t1 = found.p_t1 + dt * found.p_12 + turn * found.p_13
    m_t2 = found.p_t2 + dt * found.p_22 + turn * found.p_23
    m_t3 = found.p_t3 + dt * found.p_23 + turn * p_33
    n_x = m_xt + 0.5 * (dt * m_x2 + turn * m_x3)
    n_y = m_yt + 0.5 * (dt * m_y2 + turn * m_y3)
    return (
        Estimate(
            x=estimate.x - moved * sin,
            y=estimate.y + moved * cos,
            theta=estimate.theta + turned,
            p_xx=m_xx
            + (f_x * n_x + h_x * m_x1)
            + (sin * sin * ekf.forward + cos * cos * ekf.sideways),
            p_xy=m_xy + (f_y * n_x + h_y * m_x1) + sin * cos * (ekf.sideways - ekf.forward),
            p_xt=m_xt + dt * m_x2 + turn * m_x3,
            p_yy=m_yy
            + (f_y * n_y + h_y * m_y1)
            + (cos * cos * ekf.forward + sin * sin * ekf.sideways),
            p_yt=m_yt + dt * m_y2 + turn * m_y3,
            p_tt=m_tt + dt * m_t2 + turn * m_t3 + ekf.heading,
        ),
        predicted_errors(
            found,
            p_x1=m_x1,
            p_y1=m_y1,
            p_t1=m_t1,
            p_x2=m_x2,
            p_y2=m_y2,
            p_t2=m_t2,
            p_x3=m_x3,
            p_y3=m_y3,
            p_t3=m_t3,
            p_11=found.p_11 + ekf.walk_1,
            p_22=found.p_22 + ekf.walk_2,
            rolled=u_1,
            advance=advance,
        ),
    )


corrected_errors = replacing(
    GyroEstimate,
    *("speed_error", "gyro_error", "scale_error"),
    *("p_x1", "p_y1", "p_t1", "p_x2", "p_y2", "p_t2", "p_x3", "p_y3", "p_t3"),
    *("p_11", "p_12", "p_13", "p_22", "p_23", "p_33"),
    *("variance", "d_x", "d_y", "slip_1", "slip_2", "speed", "yaw_rate", "floor_1", "floor_2"),
)


@law
def quietness(found: GyroEstimate, ekf: GyroEkf, speed: float, yaw_rate: float) -> float:
    """How little force the tyres transmit, 0 to 1, from the acceleration of the body per tyre."""
    forward = abs(speed - found.speed) + ekf.arm * abs(yaw_rate - found.yaw_rate)
    forward = forward / ACCELERATION_TIME_S
    sideways = speed * yaw_rate
    share = math.sqrt(forward * forward + sideways * sideways) / ekf.most_quiet
    return min(max(2.0 - 2.0 * share, 0.0), 1.0)


@law
def averaged_floor(average: float, slip: float, quiet: float, ekf: GyroEkf) -> float:
    """The average of |slip| after a sample; it follows growing slip faster."""
    more = abs(slip) - average
    return average + quiet * (ekf.rise * max(more, 0.0) + ekf.decay * min(more, 0.0))


@law
def correct_with_gyro(
    estimate: Estimate,
    found: GyroEstimate,
    ekf: GyroEkf,
    x: float,
    y: float,
    here: float,
    u_2: float,
    rate: float,
    dt: float,
) -> tuple[Estimate, GyroEstimate, float, float, float]:
    """Update with a position fix (mm), and both slips; u₂ is the encoders' yaw increment (rad).

    ``here`` is 1, or 0 without a fix: then all gains are 0. The errors are clipped to their bounds.
    Returns the estimates, the innovation in world axes (mm), and its normalised square (NIS).
    """
    known = max(ekf.variance + found.variance, LEAST_KNOWN_MM2)
    i_xx, i_xy, i_yy = inverse_innovation_covariance(
        estimate, max(ekf.variance_factor * known, ekf.least_variance)
    )
    d_x, d_y = x - estimate.x, y - estimate.y
    nis = here * normalised_square(d_x, d_y, i_xx, i_xy, i_yy)
    weight = here * min(1.0, ekf.threshold / max(nis, LEAST_KNOWN_MM2))
    i_xx, i_xy, i_yy = weight * i_xx, weight * i_xy, weight * i_yy
    gain = pose_gain(estimate, i_xx, i_xy, i_yy)
    l_1x = found.p_x1 * i_xx + found.p_y1 * i_xy
    l_1y = found.p_x1 * i_xy + found.p_y1 * i_yy
    l_2x = found.p_x2 * i_xx + found.p_y2 * i_xy
    l_2y = found.p_x2 * i_xy + found.p_y2 * i_yy
    l_3x = found.p_x3 * i_xx + found.p_y3 * i_xy
    l_3y = found.p_x3 * i_xy + found.p_y3 * i_yy
    speed_error = found.speed_error + l_1x * d_x + l_1y * d_y
    gyro_error = found.gyro_error + l_2x * d_x + l_2y * d_y
    scale_error = found.scale_error + l_3x * d_x + l_3y * d_y
    speed_error = min(max(speed_error, -ekf.bound_1), ekf.bound_1)
    gyro_error = min(max(gyro_error, -ekf.bound_2), ekf.bound_2)
    scale_error = min(max(scale_error, -ekf.bound_3), ekf.bound_3)
    speed = found.advance / dt + speed_error
    yaw_rate = rate + gyro_error + scale_error * rate
    slip_1 = found.slip_1 + ekf.slip_weight * (speed - found.rolled / dt - found.slip_1)
    slip_2 = found.slip_2 + ekf.slip_weight * (yaw_rate - u_2 / dt - found.slip_2)
    quiet = quietness(found, ekf, speed, yaw_rate)
    # Differences of successive innovations have twice the variance of a fix; slow errors cancel.
    step_x, step_y = d_x - found.d_x, d_y - found.d_y
    last_x, last_y = (d_x, d_y) if here > 0.0 else (found.d_x, found.d_y)
    square = min(0.25 * (step_x * step_x + step_y * step_y), ekf.threshold * known)
    return (
        corrected_pose(estimate, gain, d_x, d_y),
        corrected_errors(
            found,
            speed_error=speed_error,
            gyro_error=gyro_error,
            scale_error=scale_error,
            p_x1=found.p_x1 - gain.xx * found.p_x1 - gain.xy * found.p_y1,
            p_y1=found.p_y1 - gain.yx * found.p_x1 - gain.yy * found.p_y1,
            p_t1=found.p_t1 - gain.tx * found.p_x1 - gain.ty * found.p_y1,
            p_x2=found.p_x2 - gain.xx * found.p_x2 - gain.xy * found.p_y2,
            p_y2=found.p_y2 - gain.yx * found.p_x2 - gain.yy * found.p_y2,
            p_t2=found.p_t2 - gain.tx * found.p_x2 - gain.ty * found.p_y2,
            p_x3=found.p_x3 - gain.xx * found.p_x3 - gain.xy * found.p_y3,
            p_y3=found.p_y3 - gain.yx * found.p_x3 - gain.yy * found.p_y3,
            p_t3=found.p_t3 - gain.tx * found.p_x3 - gain.ty * found.p_y3,
            p_11=found.p_11 - l_1x * found.p_x1 - l_1y * found.p_y1,
            p_12=found.p_12 - l_1x * found.p_x2 - l_1y * found.p_y2,
            p_13=found.p_13 - l_1x * found.p_x3 - l_1y * found.p_y3,
            p_22=found.p_22 - l_2x * found.p_x2 - l_2y * found.p_y2,
            p_23=found.p_23 - l_2x * found.p_x3 - l_2y * found.p_y3,
            p_33=found.p_33 - l_3x * found.p_x3 - l_3y * found.p_y3,
            variance=found.variance + here * ekf.variance_weight * (square - known),
            d_x=last_x,
            d_y=last_y,
            slip_1=slip_1,
            slip_2=slip_2,
            speed=found.speed + ekf.motion_weight * (speed - found.speed),
            yaw_rate=found.yaw_rate + ekf.motion_weight * (yaw_rate - found.yaw_rate),
            floor_1=averaged_floor(found.floor_1, slip_1, quiet, ekf),
            floor_2=averaged_floor(found.floor_2, slip_2, quiet, ekf),
        ),
        d_x,
        d_y,
        nis,
    )


@law
def reported_slip(found: GyroEstimate, ekf: GyroEkf) -> tuple[float, float]:
    """δ₁ (mm/s) and δ₂ (rad/s) of the floor, within their bounds; 0 while none was seen."""
    seen = max(found.floor_1 / ekf.floor_1, found.floor_2 / ekf.floor_2) - 1.0
    share = min(max(seen, ekf.all_slip, 0.0), 1.0)
    return (
        share * min(max(found.slip_1, -ekf.reported_1), ekf.reported_1),
        share * min(max(found.slip_2, -ekf.reported_2), ekf.reported_2),
    )
