"""Extended Kalman filter of the pose, eqs (28)–(41), from encoder increments and position fixes.

Eq. (28) writes θᵢ on its right-hand side; here it is the midpoint θᵢ₋₁ + u₂/2, with Jacobians to match.
The filter assumes wheels that do not slip.
"""

from __future__ import annotations

from typing import NamedTuple

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.numerics.compiled import law, reader, writer
from tlf_env.numerics.trig import sincos


class EkfParameters(Frozen):
    """Noise of eqs (36) and (37). The αs multiply increments per sample (mm and rad)."""

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


read_ekf = reader(Ekf)
read_estimate = reader(Estimate)
write_estimate = writer(Estimate)


def ekf_constants(p: EkfParameters) -> Ekf:
    """The filter's numbers as the compiled law takes them."""
    return Ekf(p.alpha_1, p.alpha_2, p.alpha_3, p.alpha_4, p.fix_variance_mm2)


@law
def predict(e: Estimate, ekf: Ekf, u_1: float, u_2: float) -> Estimate:
    """Eqs (28), (36), (38): pose and covariance one sample on, for increments u₁ (mm), u₂ (rad)."""
    sin, cos = sincos(e.theta + 0.5 * u_2)
    sd_1 = ekf.alpha_1 * abs(u_1) + ekf.alpha_2 * abs(u_2)
    sd_2 = ekf.alpha_3 * abs(u_1) + ekf.alpha_4 * abs(u_2)
    var_1, var_2 = sd_1 * sd_1, sd_2 * sd_2
    # F = [[1, 0, f_x], [0, 1, f_y], [0, 0, 1]],  G = [[−sin, f_x/2], [cos, f_y/2], [0, 1]]
    f_x, f_y = -u_1 * cos, -u_1 * sin
    g_x, g_y = 0.5 * f_x, 0.5 * f_y
    p_xt = e.p_xt + f_x * e.p_tt
    p_yt = e.p_yt + f_y * e.p_tt
    return Estimate(
        e.x - u_1 * sin,
        e.y + u_1 * cos,
        e.theta + u_2,
        e.p_xx + f_x * (e.p_xt + p_xt) + sin * sin * var_1 + g_x * g_x * var_2,
        e.p_xy + f_x * e.p_yt + f_y * p_xt - sin * cos * var_1 + g_x * g_y * var_2,
        p_xt + g_x * var_2,
        e.p_yy + f_y * (e.p_yt + p_yt) + cos * cos * var_1 + g_y * g_y * var_2,
        p_yt + g_y * var_2,
        e.p_tt + var_2,
    )


@law
def certainty(e: Estimate, variance: float) -> tuple[float, float, float]:
    """S⁻¹ of eq. (39), upper triangle in mm⁻²: how sure the filter is of the next fix."""
    s_xx, s_xy, s_yy = e.p_xx + variance, e.p_xy, e.p_yy + variance
    det = s_xx * s_yy - s_xy * s_xy
    return s_yy / det, -s_xy / det, s_xx / det


@law
def correct(e: Estimate, ekf: Ekf, x: float, y: float) -> tuple[Estimate, float, float, float]:
    """Eqs (31), (39)–(41) with a position fix (mm).

    Returns the estimate, the innovation in world axes (mm), and its normalised square (NIS).
    """
    i_xx, i_xy, i_yy = certainty(e, ekf.variance)
    d_x, d_y = x - e.x, y - e.y
    # Gain l = P Hᵀ S⁻¹, rows x, y, θ.
    l_xx, l_xy = e.p_xx * i_xx + e.p_xy * i_xy, e.p_xx * i_xy + e.p_xy * i_yy
    l_yx, l_yy = e.p_xy * i_xx + e.p_yy * i_xy, e.p_xy * i_xy + e.p_yy * i_yy
    l_tx, l_ty = e.p_xt * i_xx + e.p_yt * i_xy, e.p_xt * i_xy + e.p_yt * i_yy
    after = Estimate(
        e.x + l_xx * d_x + l_xy * d_y,
        e.y + l_yx * d_x + l_yy * d_y,
        e.theta + l_tx * d_x + l_ty * d_y,
        e.p_xx - l_xx * e.p_xx - l_xy * e.p_xy,
        e.p_xy - l_xx * e.p_xy - l_xy * e.p_yy,
        e.p_xt - l_xx * e.p_xt - l_xy * e.p_yt,
        e.p_yy - l_yx * e.p_xy - l_yy * e.p_yy,
        e.p_yt - l_yx * e.p_xt - l_yy * e.p_yt,
        e.p_tt - l_tx * e.p_xt - l_ty * e.p_yt,
    )
    nis = d_x * (i_xx * d_x + i_xy * d_y) + d_y * (i_xy * d_x + i_yy * d_y)
    return after, d_x, d_y, nis
