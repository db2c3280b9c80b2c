"""Extended Kalman filter of pose and slip: the paper's filter with two more states, δ₁ and δ₂ of eq. (14).

The encoders measure how far the wheels rolled; slip adds δ₁ forward and δ₂ in yaw. Both are modelled as
random walks and estimated from the position fixes. The process noise is a variance per second, so that
the filter is the same at every sampling rate.

The filter adapts in three ways:

- The variance of the fixes is estimated from the differences of successive innovations, which depend
  little on other errors.
- Innovation test (``surprise``): after a change of slip the mean innovation is no longer zero. While it
  exceeds what the noise of the fixes explains, process noise is added.
- Steps of slip: for some tens of milliseconds the light wheels follow the floor and the robot does not.
  Wheel speeds that change faster than the motors allow are taken at once as slip, or as spin of a wheel
  that has lost grip. Steady slip and slip that ramps within 0.2 s do not show in the wheel speeds.
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

ROUGHNESS_TIME_S = 0.5  # averaging time of the encoders' roughness (mean square of usual changes)
POSE_AND_SLIP = ("p_x1", "p_y1", "p_t1", "p_x2", "p_y2", "p_t2")  # covariances of pose and slip
JUMP_NOISE = 4.0  # smaller changes, in standard deviations of encoder noise, are no jumps


class SlipEkfParameters(Frozen):
    """Noise of the filter, and bounds of its slip estimates."""

    forward_noise_mm2_s: NonNegative = 35.0  # of the position along the heading
    sideways_noise_mm2_s: NonNegative = 0.09
    heading_noise_rad2_s: NonNegative = 9.0e-6
    delta_1_walk_mm2_s3: NonNegative = 440.0
    delta_2_walk_rad2_s3: NonNegative = 0.0185
    fix_variance_mm2: Positive = 0.2  # of each coordinate, at the start
    fix_variance_time_s: Positive | None = 0.5  # averaging time of its adaptation; None: constant
    least_fix_variance_mm2: Positive = 0.05
    fix_variance_factor: Positive = 18.0  # on the adapted variance, for errors outside the model
    delta_1_bound_mm_s: NonNegative = 60.0
    delta_2_bound_rad_s: NonNegative = 0.415
    # Surprise: how far the mean innovation exceeds what the fixes' noise explains (an innovation test). The
    # innovations are averaged over surprise_time_s; the square of the mean is divided by the variance that
    # the fixes alone explain. Surprise is 0 up to the threshold (None: always) and grows by 1 per further
    # threshold, up to most_surprise. It multiplies the process noise below. Below surprise_speed_mm_s it
    # decreases with the square of the speed: at rest the fixes contain no information on yaw.
    surprise_time_s: Positive = 0.05
    surprise_threshold: Positive | None = 6.2
    most_surprise: NonNegative = 5.0
    surprise_speed_mm_s: Positive = 300.0
    heading_surprise_rad2_s: NonNegative = 3.4e-4
    delta_1_surprise_mm2_s3: NonNegative = 8000.0
    delta_2_surprise_rad2_s3: NonNegative = 0.18
    # Largest accelerations by the motors while the wheels roll. Wheels whose speed changes faster were moved
    # by the floor (slip) or have lost grip (spin). None: the wheel speeds are not tested.
    most_acceleration_mm_s2: Positive | None = 650.0
    most_yaw_acceleration_rad_s2: Positive | None = 4.4
    grip_mm_s2: NonNegative = 850.0  # acceleration with which a robot follows spinning wheels
    yaw_grip_rad_s2: NonNegative = 5.0
    jump_uncertainty: NonNegative = 0.1  # standard deviation of such a jump of slip, relative to it


class SlipEkf(NamedTuple):
    """Constants of the filter; process noise as variance per sample."""

    forward: float
    sideways: float
    heading: float
    walk_1: float
    walk_2: float
    variance: float
    bound_1: float
    bound_2: float
    variance_weight: float  # weight of a sample in the variance of the fixes
    least_variance: float
    variance_factor: float
    mean_weight: float  # weight of a sample in the mean innovation
    threshold: float  # of the squared mean innovation, relative to the variance of a fix
    most_surprise: float
    surprise_speed: float  # mm per sample; surprise is reduced below
    surprise_heading: float
    surprise_1: float
    surprise_2: float
    change_1: float  # mm per sample squared
    change_2: float  # rad per sample squared
    grip_1: float  # mm per sample squared
    grip_2: float  # rad per sample squared
    jump_variance: float  # variance of slip per square of a jump of increments, 1/s²
    roughness_weight: float  # weight of a sample in the roughness


class SlipEstimate(NamedTuple):
    """Estimated δ₁ (mm/s), δ₂ (rad/s), their part of the covariance's upper triangle, and adapted values."""

    delta_1: float
    delta_2: float
    p_x1: float
    p_y1: float
    p_t1: float
    p_x2: float
    p_y2: float
    p_t2: float
    p_11: float
    p_12: float
    p_22: float
    variance: float  # of a fix, minus its value at the start, mm²
    d_x: float  # last innovation, world axes, mm
    d_y: float
    mean_forward: float  # mean innovation, forward and right, mm
    mean_right: float
    u_1: float  # last increments of the wheels, mm and rad
    u_2: float
    spin_1: float  # part of them that is spin, mm and rad
    spin_2: float
    roughness_1: float  # mean square of their usual changes, mostly encoder noise
    roughness_2: float


def sample_weight(dt_s: float, time_s: float) -> float:
    """Weight of one sample in an exponential mean over ``time_s``."""
    return -math.expm1(-dt_s / time_s)


def slip_ekf_constants(parameters: SlipEkfParameters, dt_s: float) -> SlipEkf:
    """Constants of the filter for a sampling period of ``dt_s`` s."""
    mean_weight = sample_weight(dt_s, parameters.surprise_time_s)
    return SlipEkf(
        forward=parameters.forward_noise_mm2_s * dt_s,
        sideways=parameters.sideways_noise_mm2_s * dt_s,
        heading=parameters.heading_noise_rad2_s * dt_s,
        walk_1=parameters.delta_1_walk_mm2_s3 * dt_s,
        walk_2=parameters.delta_2_walk_rad2_s3 * dt_s,
        variance=parameters.fix_variance_mm2,
        bound_1=parameters.delta_1_bound_mm_s,
        bound_2=parameters.delta_2_bound_rad_s,
        variance_weight=0.0
        if parameters.fix_variance_time_s is None
        else sample_weight(dt_s, parameters.fix_variance_time_s),
        least_variance=parameters.least_fix_variance_mm2,
        variance_factor=parameters.fix_variance_factor,
        mean_weight=mean_weight,
        threshold=math.inf
        if parameters.surprise_threshold is None
        else parameters.surprise_threshold * mean_weight / (2.0 - mean_weight),
        most_surprise=parameters.most_surprise,
        surprise_speed=parameters.surprise_speed_mm_s * dt_s,
        surprise_heading=parameters.heading_surprise_rad2_s * dt_s,
        surprise_1=parameters.delta_1_surprise_mm2_s3 * dt_s,
        surprise_2=parameters.delta_2_surprise_rad2_s3 * dt_s,
        change_1=infinite_if_none(parameters.most_acceleration_mm_s2, dt_s**2),
        change_2=infinite_if_none(parameters.most_yaw_acceleration_rad_s2, dt_s**2),
        grip_1=parameters.grip_mm_s2 * dt_s**2,
        grip_2=parameters.yaw_grip_rad_s2 * dt_s**2,
        jump_variance=(parameters.jump_uncertainty / dt_s) ** 2,
        roughness_weight=sample_weight(dt_s, ROUGHNESS_TIME_S),
    )


with_fix_weights = replacing(SlipEkf, "variance_weight", "mean_weight", "threshold")


@law
def for_fixes(ekf: SlipEkf, every: int) -> SlipEkf:
    """The filter's constants if a fix comes once in ``every`` samples: its means over time stay the same."""
    if every == 1:
        return ekf
    mean_weight = 1.0 - (1.0 - ekf.mean_weight) ** every
    share = mean_weight / (2.0 - mean_weight)
    return with_fix_weights(
        ekf,
        variance_weight=1.0 - (1.0 - ekf.variance_weight) ** every,
        mean_weight=mean_weight,
        threshold=ekf.threshold * share * (2.0 - ekf.mean_weight) / ekf.mean_weight,
    )


@law
def surprise(mean: float, variance: float, ekf: SlipEkf) -> float:
    """How far a mean innovation (mm) exceeds what fixes of this variance (mm²) explain; 0 if not.

    For white innovations of variance V the exponential mean with weight a has the variance V·a/(2 − a).
    """
    return min(max(mean * mean / (ekf.threshold * variance) - 1.0, 0.0), ekf.most_surprise)


@law
def clamped_from_zero(value: float, end: float) -> float:
    """``value`` clipped to the range between 0 and ``end``, which may be negative."""
    return min(max(value, min(end, 0.0)), max(end, 0.0))


@law
def split_change(
    change: float, beyond: float, spin: float, most: float, rough: float, grip: float
) -> tuple[float, float, float]:
    """Split a change of the wheels' increment: usual part, part due to the floor, and new spin.

    The usual part is at most what motors (``most``) and encoder noise can cause in a rolling robot. The rest
    has one of two causes. If it is directed away from the commanded increment, which the wheels now exceed
    by ``beyond``, the floor moved, or a spinning wheel regained grip. If it is directed towards it, the
    wheels lost grip: they spin, faster than the robot moves by the spin, and the robot follows with ``grip``.
    """
    most += JUMP_NOISE * math.sqrt(rough)
    usual = min(max(change, -most), most)
    away = clamped_from_zero(change - usual, beyond)
    spun = spin + (change - usual - away)
    regained = clamped_from_zero(away, -spun)
    spun += regained
    return usual, away - regained, spun - clamped_from_zero(spun, math.copysign(grip, spun))


predicted_slip = replacing(
    SlipEstimate,
    *("delta_1", "delta_2", *POSE_AND_SLIP, "p_11", "p_22"),
    *("u_1", "u_2", "spin_1", "spin_2", "roughness_1", "roughness_2"),
)


@law
def predict_with_slip(
    estimate: Estimate,
    slip: SlipEstimate,
    ekf: SlipEkf,
    u_1: float,
    u_2: float,
    commanded_1: float,
    commanded_2: float,
    dt: float,
) -> tuple[Estimate, SlipEstimate]:
    """Pose, slip and covariance after one sample.

    The wheels' increments are u₁ (mm) and u₂ (rad); ``commanded`` the commanded ones, or the last ones
    if there is no command.
    """
    change_1, change_2 = u_1 - slip.u_1, u_2 - slip.u_2
    usual_1, jump_1, spin_1 = split_change(
        change_1, u_1 - commanded_1, slip.spin_1, ekf.change_1, slip.roughness_1, ekf.grip_1
    )
    usual_2, jump_2, spin_2 = split_change(
        change_2, u_2 - commanded_2, slip.spin_2, ekf.change_2, slip.roughness_2, ekf.grip_2
    )
    delta_1, delta_2 = slip.delta_1 - jump_1 / dt, slip.delta_2 - jump_2 / dt
    moved, turned = u_1 - spin_1 + delta_1 * dt, u_2 - spin_2 + delta_2 * dt
    middle = estimate.theta + 0.5 * turned
    noise = max(ekf.variance + slip.variance, ekf.least_variance)
    speed = min(abs(u_1) / ekf.surprise_speed, 1.0)
    forward = speed * speed * surprise(slip.mean_forward, noise, ekf)
    sideways = speed * speed * surprise(slip.mean_right, noise, ekf)
    sin, cos = sincos(middle)
    # F = I but for ∂(x, y)/∂θ = f, ∂(x, y)/∂δ₁ = h, ∂(x, y)/∂δ₂ = g, ∂θ/∂δ₂ = dt.
    f_x, f_y = -moved * cos, -moved * sin
    h_x, h_y = -sin * dt, cos * dt
    g_x, g_y = 0.5 * dt * f_x, 0.5 * dt * f_y
    # M = F P, then F P Fᵀ + Q.
    m_xx = estimate.p_xx + f_x * estimate.p_xt + h_x * slip.p_x1 + g_x * slip.p_x2
    m_xy = estimate.p_xy + f_x * estimate.p_yt + h_x * slip.p_y1 + g_x * slip.p_y2
    m_xt = estimate.p_xt + f_x * estimate.p_tt + h_x * slip.p_t1 + g_x * slip.p_t2
    m_x1 = slip.p_x1 + f_x * slip.p_t1 + h_x * slip.p_11 + g_x * slip.p_12
    m_x2 = slip.p_x2 + f_x * slip.p_t2 + h_x * slip.p_12 + g_x * slip.p_22
    m_yy = estimate.p_yy + f_y * estimate.p_yt + h_y * slip.p_y1 + g_y * slip.p_y2
    m_yt = estimate.p_yt + f_y * estimate.p_tt + h_y * slip.p_t1 + g_y * slip.p_t2
    m_y1 = slip.p_y1 + f_y * slip.p_t1 + h_y * slip.p_11 + g_y * slip.p_12
    m_y2 = slip.p_y2 + f_y * slip.p_t2 + h_y * slip.p_12 + g_y * slip.p_22
    m_tt = estimate.p_tt + dt * slip.p_t2
    m_t1 = slip.p_t1 + dt * slip.p_12
    m_t2 = slip.p_t2 + dt * slip.p_22
    return (
        Estimate(
            x=estimate.x - moved * sin,
            y=estimate.y + moved * cos,
            theta=estimate.theta + turned,
            p_xx=m_xx
            + (f_x * m_xt + h_x * m_x1 + g_x * m_x2)
            + (sin * sin * ekf.forward + cos * cos * ekf.sideways),
            p_xy=m_xy
            + (f_y * m_xt + h_y * m_x1 + g_y * m_x2)
            + sin * cos * (ekf.sideways - ekf.forward),
            p_xt=m_xt + dt * m_x2,
            p_yy=m_yy
            + (f_y * m_yt + h_y * m_y1 + g_y * m_y2)
            + (cos * cos * ekf.forward + sin * sin * ekf.sideways),
            p_yt=m_yt + dt * m_y2,
            p_tt=m_tt + dt * m_t2 + ekf.heading + ekf.surprise_heading * sideways,
        ),
        predicted_slip(
            slip,
            delta_1=delta_1,
            delta_2=delta_2,
            p_x1=m_x1,
            p_y1=m_y1,
            p_t1=m_t1,
            p_x2=m_x2,
            p_y2=m_y2,
            p_t2=m_t2,
            p_11=slip.p_11
            + ekf.walk_1
            + ekf.surprise_1 * forward
            + ekf.jump_variance * jump_1 * jump_1,
            p_22=slip.p_22
            + ekf.walk_2
            + ekf.surprise_2 * sideways
            + ekf.jump_variance * jump_2 * jump_2,
            u_1=u_1,
            u_2=u_2,
            spin_1=spin_1,
            spin_2=spin_2,
            roughness_1=slip.roughness_1
            + ekf.roughness_weight * (usual_1 * usual_1 - slip.roughness_1),
            roughness_2=slip.roughness_2
            + ekf.roughness_weight * (usual_2 * usual_2 - slip.roughness_2),
        ),
    )


corrected_slip = replacing(
    SlipEstimate,
    *("delta_1", "delta_2", *POSE_AND_SLIP, "p_11", "p_12", "p_22"),
    *("variance", "d_x", "d_y", "mean_forward", "mean_right"),
)


with_slip = replacing(SlipEstimate, "delta_1", "delta_2")


@law
def within_bounds(slip: SlipEstimate, ekf: SlipEkf) -> SlipEstimate:
    """The slip estimates clipped to their bounds: all that :func:`correct_with_slip` changes without a fix."""
    return with_slip(
        slip,
        min(max(slip.delta_1, -ekf.bound_1), ekf.bound_1),
        min(max(slip.delta_2, -ekf.bound_2), ekf.bound_2),
    )


@law
def correct_with_slip(
    estimate: Estimate, slip: SlipEstimate, ekf: SlipEkf, x: float, y: float, here: float = 1.0
) -> tuple[Estimate, SlipEstimate, float, float, float]:
    """Update with a position fix (mm); the slip estimates are clipped to their bounds.

    ``here`` is 1, or 0 without a fix: then all gains are 0.
    Returns the estimates, the innovation in world axes (mm), and its normalised square (NIS).
    """
    known = ekf.variance + slip.variance
    i_xx, i_xy, i_yy = inverse_innovation_covariance(
        estimate, max(ekf.variance_factor * known, ekf.least_variance)
    )
    i_xx, i_xy, i_yy = here * i_xx, here * i_xy, here * i_yy
    d_x, d_y = x - estimate.x, y - estimate.y
    # Differences of successive innovations have twice the variance of a fix; slow errors cancel.
    step_x, step_y = d_x - slip.d_x, d_y - slip.d_y
    sin, cos = sincos(estimate.theta)
    forward, right = cos * d_y - sin * d_x, cos * d_x + sin * d_y
    # The gain's rows x, y, θ, and those of δ₁ and δ₂.
    gain = pose_gain(estimate, i_xx, i_xy, i_yy)
    l_1x, l_1y = slip.p_x1 * i_xx + slip.p_y1 * i_xy, slip.p_x1 * i_xy + slip.p_y1 * i_yy
    l_2x, l_2y = slip.p_x2 * i_xx + slip.p_y2 * i_xy, slip.p_x2 * i_xy + slip.p_y2 * i_yy
    delta_1 = slip.delta_1 + l_1x * d_x + l_1y * d_y
    delta_2 = slip.delta_2 + l_2x * d_x + l_2y * d_y
    step_2 = step_x * step_x + step_y * step_y
    last_x, last_y = (d_x, d_y) if here > 0.0 else (slip.d_x, slip.d_y)
    return (
        corrected_pose(estimate, gain, d_x, d_y),
        within_bounds(
            corrected_slip(
                slip,
                delta_1=delta_1,
                delta_2=delta_2,
                p_x1=slip.p_x1 - gain.xx * slip.p_x1 - gain.xy * slip.p_y1,
                p_y1=slip.p_y1 - gain.yx * slip.p_x1 - gain.yy * slip.p_y1,
                p_t1=slip.p_t1 - gain.tx * slip.p_x1 - gain.ty * slip.p_y1,
                p_x2=slip.p_x2 - gain.xx * slip.p_x2 - gain.xy * slip.p_y2,
                p_y2=slip.p_y2 - gain.yx * slip.p_x2 - gain.yy * slip.p_y2,
                p_t2=slip.p_t2 - gain.tx * slip.p_x2 - gain.ty * slip.p_y2,
                p_11=slip.p_11 - l_1x * slip.p_x1 - l_1y * slip.p_y1,
                p_12=slip.p_12 - l_1x * slip.p_x2 - l_1y * slip.p_y2,
                p_22=slip.p_22 - l_2x * slip.p_x2 - l_2y * slip.p_y2,
                variance=slip.variance + here * ekf.variance_weight * (0.25 * step_2 - known),
                d_x=last_x,
                d_y=last_y,
                mean_forward=slip.mean_forward
                + here * ekf.mean_weight * (forward - slip.mean_forward),
                mean_right=slip.mean_right + here * ekf.mean_weight * (right - slip.mean_right),
            ),
            ekf,
        ),
        d_x,
        d_y,
        normalised_square(d_x, d_y, i_xx, i_xy, i_yy),
    )
