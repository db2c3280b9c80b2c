"""Friction laws: the curve of the coefficient, and the exact solution of Coulomb friction in a plane."""

from __future__ import annotations

import math
from typing import NamedTuple

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


class Circle(NamedTuple):
    """A tyre and its friction circle.

    ``W = [[w_ee, w_ef], [w_ef, w_ff]]`` is the contact's inverse mass and ``b`` its slip velocity without the
    tyre's impulse.
    """

    w_ee: float
    w_ff: float
    w_ef: float
    b_e: float
    b_f: float
    radius: float  # largest impulse


class Found(NamedTuple):
    """What is known of a tyre's impulse p with slip = −λ p: the impulse, λ, and |p| before it is scaled."""

    p_e: float
    p_f: float
    lam: float
    norm: float


@law
def sticking(circle: Circle) -> Found:
    """The impulse that leaves no slip, however large it is."""
    w_ee, w_ff, w_ef = circle.w_ee, circle.w_ff, circle.w_ef
    # Divided by det, not multiplied by 1/det: at rest the difference shows in the last digit.
    det = w_ee * w_ff - w_ef * w_ef
    return Found(
        p_e=(w_ef * circle.b_f - w_ff * circle.b_e) / det,
        p_f=(w_ef * circle.b_e - w_ee * circle.b_f) / det,
        lam=0.0,
        norm=circle.radius,
    )


@law
def is_inside(found: Found, radius: float) -> bool:
    """Whether an impulse lies in the friction circle."""
    return found.p_e * found.p_e + found.p_f * found.p_f <= radius * radius


@law
def first_lambda(circle: Circle) -> float:
    """λ after the first step of Newton's method (see :func:`next_found`), which is that from λ = ∞."""
    b_e, b_f = circle.b_e, circle.b_f
    inverse_radius = 1.0 / circle.radius
    size = b_e * b_e + b_f * b_f
    weighted = circle.w_ee * b_e * b_e + 2.0 * circle.w_ef * b_e * b_f + circle.w_ff * b_f * b_f
    return max(0.0, math.sqrt(size) * inverse_radius - weighted / size)


@law
def next_found(circle: Circle, lam: float) -> tuple[bool, Found]:
    """One step of Newton's method for λ: whether this λ was the solution, its impulse, and the next λ.

    Sought is λ with |(W + λ1)⁻¹ b| = radius. The method is applied to 1/|p|, which is concave in λ, so that λ
    increases to the root from the second step on.
    """
    b_e, b_f, w_ef = circle.b_e, circle.b_f, circle.w_ef
    inverse_radius = 1.0 / circle.radius
    a, c = circle.w_ee + lam, circle.w_ff + lam
    inverse = 1.0 / (a * c - w_ef * w_ef)
    p_e = (w_ef * b_f - c * b_e) * inverse
    p_f = (w_ef * b_e - a * b_f) * inverse
    square = p_e * p_e + p_f * p_f
    norm = math.sqrt(square)
    excess = norm * inverse_radius - 1.0
    if abs(excess) <= CIRCLE_TOLERANCE:
        return True, Found(p_e, p_f, lam, norm)
    curvature = (c * p_e * p_e - 2.0 * w_ef * p_e * p_f + a * p_f * p_f) * inverse
    return False, Found(p_e, p_f, max(0.0, lam + square / curvature * excess), norm)


@law
def on_circle(found: Found, radius: float) -> Found:
    """The impulse of a solution λ, scaled to the circle."""
    scale = radius / found.norm
    return Found(found.p_e * scale, found.p_f * scale, found.lam, found.norm)


@law
def disc(
    w_ee: float, w_ff: float, w_ef: float, b_e: float, b_f: float, radius: float
) -> tuple[float, float, float]:
    """Impulse of one tyre within its friction circle; see :class:`Circle` for the arguments.

    Returns ``(p_e, p_f, λ)`` with slip = b + W p: either slip = 0 and |p| ≤ radius (λ = 0), or |p| = radius
    and slip = −λ p, exactly opposite to the impulse. :mod:`tlf_env.physics.sliding` does the same for many.
    """
    if radius <= 0.0:
        return 0.0, 0.0, math.inf
    circle = Circle(w_ee, w_ff, w_ef, b_e, b_f, radius)
    found = sticking(circle)
    if is_inside(found, radius):
        return found.p_e, found.p_f, 0.0
    found = Found(found.p_e, found.p_f, first_lambda(circle), radius)
    for _ in range(NEWTON_STEPS):
        solved, found = next_found(circle, found.lam)
        if solved:
            break
    found = on_circle(found, radius)
    return found.p_e, found.p_f, found.lam
