"""Extended Kalman filter of the pose, eqs (28)–(41), from encoder increments and position fixes.

In place of θᵢ on the right-hand side of eq. (28) the midpoint θᵢ₋₁ + u₂/2 is used, with the Jacobians
that follow from it. The filter assumes wheels without slip.
"""

from __future__ import annotations

from typing import NamedTuple

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.numerics.compiled import law
from tlf_env.numerics.trig import sincos


class EkfParameters(Frozen):
    """Noise of eqs (36) and (37). The coefficients α multiply increments per sample (mm and rad)."""

    alpha_1: NonNegative = 2e-3  # mm per mm
    alpha_2: NonNegative = 1e-2  # mm per rad
    alpha_3: NonNegative = 1e-2  # rad per mm
    alpha_4: NonNegative = 1e-3  # rad per rad
    fix_variance_mm2: Positive = 0.2  # σ_m²


class Ekf(NamedTuple):
    """Constants of the filter."""

    alpha_1: float
    alpha_2: float
    alpha_3: float
    alpha_4: float
    variance: float


class Estimate(NamedTuple):
    """Estimated pose of c (mm, rad, heading not wrapped) and the upper triangle of its covariance."""

    x: float
    y: float
    theta: float
    p_xx: float
    p_xy: float
    p_xt: float
    p_yy: float
    p_yt: float
    p_tt: float


class PoseGain(NamedTuple):
    """Kalman gain of a position fix: rows x, y, θ, columns x, y."""

    xx: float
    xy: float
    yx: float
    yy: float
    tx: float
    ty: float


def ekf_constants(parameters: EkfParameters) -> Ekf:
    """Constants of the filter for the compiled laws."""
    return Ekf(
        alpha_1=parameters.alpha_1,
        alpha_2=parameters.alpha_2,
        alpha_3=parameters.alpha_3,
        alpha_4=parameters.alpha_4,
        variance=parameters.fix_variance_mm2,
    )


@law
def predict(estimate: Estimate, ekf: Ekf, u_1: float, u_2: float) -> Estimate:
    """Eqs (28), (36), (38): pose and covariance after one sample with increments u₁ (mm), u₂ (rad)."""
    sin, cos = sincos(estimate.theta + 0.5 * u_2)
    sd_1 = ekf.alpha_1 * abs(u_1) + ekf.alpha_2 * abs(u_2)
    sd_2 = ekf.alpha_3 * abs(u_1) + ekf.alpha_4 * abs(u_2)
    var_1, var_2 = sd_1 * sd_1, sd_2 * sd_2
    # F = [[1, 0, f_x], [0, 1, f_y], [0, 0, 1]],  G = [[−sin, f_x/2], [cos, f_y/2], [0, 1]]
    f_x, f_y = -u_1 * cos, -u_1 * sin
    g_x, g_y = 0.5 * f_x, 0.5 * f_y
    p_xx, p_xy, p_yy = estimate.p_xx, estimate.p_xy, estimate.p_yy
    p_xt = estimate.p_xt + f_x * estimate.p_tt
    p_yt = estimate.p_yt + f_y * estimate.p_tt
    return Estimate(
        x=estimate.x - u_1 * sin,
        y=estimate.y + u_1 * cos,
        theta=estimate.theta + u_2,
        p_xx=p_xx + f_x * (estimate.p_xt + p_xt) + sin * sin * var_1 + g_x * g_x * var_2,
        p_xy=p_xy + f_x * estimate.p_yt + f_y * p_xt - sin * cos * var_1 + g_x * g_y * var_2,
        p_xt=p_xt + g_x * var_2,
        p_yy=p_yy + f_y * (estimate.p_yt + p_yt) + cos * cos * var_1 + g_y * g_y * var_2,
        p_yt=p_yt + g_y * var_2,
        p_tt=estimate.p_tt + var_2,
    )


@law
def inverse_innovation_covariance(
    estimate: Estimate, variance: float
) -> tuple[float, float, float]:
    """S⁻¹ of eq. (39), upper triangle in mm⁻², for fixes of this variance (mm²)."""
    s_xx, s_xy, s_yy = estimate.p_xx + variance, estimate.p_xy, estimate.p_yy + variance
    det = s_xx * s_yy - s_xy * s_xy
    return s_yy / det, -s_xy / det, s_xx / det


@law
def pose_gain(estimate: Estimate, i_xx: float, i_xy: float, i_yy: float) -> PoseGain:
    """Eq. (40): P Hᵀ S⁻¹ for the inverse ``i`` of S."""
    return PoseGain(
        xx=estimate.p_xx * i_xx + estimate.p_xy * i_xy,
        xy=estimate.p_xx * i_xy + estimate.p_xy * i_yy,
        yx=estimate.p_xy * i_xx + estimate.p_yy * i_xy,
        yy=estimate.p_xy * i_xy + estimate.p_yy * i_yy,
        tx=estimate.p_xt * i_xx + estimate.p_yt * i_xy,
        ty=estimate.p_xt * i_xy + estimate.p_yt * i_yy,
    )


@law
def corrected_pose(estimate: Estimate, gain: PoseGain, d_x: float, d_y: float) -> Estimate:
    """Eqs (31) and (41): pose and covariance after an innovation in world axes (mm)."""
    return Estimate(
        x=estimate.x + gain.xx * d_x + gain.xy * d_y,
        y=estimate.y + gain.yx * d_x + gain.yy * d_y,
        theta=estimate.theta + gain.tx * d_x + gain.ty * d_y,
        p_xx=estimate.p_xx - gain.xx * estimate.p_xx - gain.xy * estimate.p_xy,
        p_xy=estimate.p_xy - gain.xx * estimate.p_xy - gain.xy * estimate.p_yy,
        p_xt=estimate.p_xt - gain.xx * estimate.p_xt - gain.xy * estimate.p_yt,
        p_yy=estimate.p_yy - gain.yx * estimate.p_xy - gain.yy * estimate.p_yy,
        p_yt=estimate.p_yt - gain.yx * estimate.p_xt - gain.yy * estimate.p_yt,
        p_tt=estimate.p_tt - gain.tx * estimate.p_xt - gain.ty * estimate.p_yt,
    )


@law
def normalised_square(d_x: float, d_y: float, i_xx: float, i_xy: float, i_yy: float) -> float:
    """Normalised innovation squared (NIS), dᵀ S⁻¹ d, for the inverse ``i`` of S."""
    return d_x * (i_xx * d_x + i_xy * d_y) + d_y * (i_xy * d_x + i_yy * d_y)


@law
def correct(
    estimate: Estimate, ekf: Ekf, x: float, y: float, here: float = 1.0
) -> tuple[Estimate, float, float, float]:
    """Eqs (31), (39)–(41) with a position fix (mm); ``here`` is 1, or 0 without a fix: then all gains are 0.

    Returns the estimate, the innovation in world axes (mm), and its normalised square (NIS).
    """
    i_xx, i_xy, i_yy = inverse_innovation_covariance(estimate, ekf.variance)
    i_xx, i_xy, i_yy = here * i_xx, here * i_xy, here * i_yy
    d_x, d_y = x - estimate.x, y - estimate.y
    after = corrected_pose(estimate, pose_gain(estimate, i_xx, i_xy, i_yy), d_x, d_y)
    return after, d_x, d_y, normalised_square(d_x, d_y, i_xx, i_xy, i_yy)
