"""Friction laws: the curve of the coefficient, and the exact solution of Coulomb friction in a plane."""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import law

NEWTON_STEPS = 60
CIRCLE_TOLERANCE = 1e-12  # relative


@law
def coefficient(
    speed: float, mu_static: float, mu_dynamic: float, stiction_speed: float, dynamic_speed: float
) -> float:
    """μ(|v|) of Fig. 3(b): static up to v_s, dynamic above v_d, a cubic step between. Speeds in mm/s."""
    x = (abs(speed) - stiction_speed) / (dynamic_speed - stiction_speed)
    x = min(max(x, 0.0), 1.0)
    return mu_static + (mu_dynamic - mu_static) * x * x * (3.0 - 2.0 * x)


@law
def disc(
    w_ee: float, w_ff: float, w_ef: float, b_e: float, b_f: float, radius: float
) -> tuple[float, float, float]:
    """Impulse of one tyre within its friction circle.

    ``W = [[w_ee, w_ef], [w_ef, w_ff]]`` is the contact's inverse mass and ``b`` its slip velocity
    without the impulse. Returns ``(p_e, p_f, λ)`` with slip = b + W p: either slip = 0 and |p| ≤ radius
    (λ = 0), or |p| = radius and slip = −λ p, exactly opposite to the impulse.
    """
    if radius <= 0.0:
        return 0.0, 0.0, math.inf
    # Divided by det, not multiplied by 1/det: at rest the difference shows in the last digit.
    det = w_ee * w_ff - w_ef * w_ef
    p_e = (w_ef * b_f - w_ff * b_e) / det
    p_f = (w_ef * b_e - w_ee * b_f) / det
    square = p_e * p_e + p_f * p_f
    if square <= radius * radius:
        return p_e, p_f, 0.0
    # Find λ with |(W + λ1)⁻¹ b| = radius: Newton's method on 1/|p|, which is concave in λ, so that λ
    # increases to the root from the second step on. The first step is that from λ = ∞.
    inverse_radius = 1.0 / radius
    size = b_e * b_e + b_f * b_f
    weighted = w_ee * b_e * b_e + 2.0 * w_ef * b_e * b_f + w_ff * b_f * b_f
    lam = max(0.0, math.sqrt(size) * inverse_radius - weighted / size)
    norm = radius
    for _ in range(NEWTON_STEPS):
        a, c = w_ee + lam, w_ff + lam
        inverse = 1.0 / (a * c - w_ef * w_ef)
        p_e = (w_ef * b_f - c * b_e) * inverse
        p_f = (w_ef * b_e - a * b_f) * inverse
        square = p_e * p_e + p_f * p_f
        norm = math.sqrt(square)
        excess = norm * inverse_radius - 1.0
        if abs(excess) <= CIRCLE_TOLERANCE:
            break
        curvature = (c * p_e * p_e - 2.0 * w_ef * p_e * p_f + a * p_f * p_f) * inverse
        lam = max(0.0, lam + square / curvature * excess)
    scale = radius / norm
    return p_e * scale, p_f * scale, lam
