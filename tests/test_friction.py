from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize

from tlf_env.physics.friction import coefficient, disc
from tlf_env.physics.parameters import FrictionCurve

untimed = settings(deadline=None)  # the first call compiles

MU_S, MU_D, V_S, V_D = 0.073, 0.055, 2.0, 3.0
speeds = st.floats(-50, 50)
velocities = st.floats(-1e3, 1e3)


def mu(speed: float) -> float:
    return coefficient(speed, MU_S, MU_D, V_S, V_D)


@untimed
@given(speeds)
def test_coefficient_is_static_below_and_dynamic_above_its_step(speed):
    if abs(speed) <= V_S:
        assert mu(speed) == MU_S
    elif abs(speed) >= V_D:
        assert mu(speed) == pytest.approx(MU_D, rel=1e-15)
    else:
        assert MU_D <= mu(speed) <= MU_S


def test_coefficient_is_a_cubic_step_between():
    x = np.linspace(0, 1, 11)
    expected = MU_S + (MU_D - MU_S) * x**2 * (3 - 2 * x)
    assert [mu(V_S + (V_D - V_S) * one) for one in x] == pytest.approx(expected, rel=1e-14)
    assert mu(0.5 * (V_S + V_D)) == pytest.approx(0.5 * (MU_S + MU_D))


@untimed
@given(speeds, speeds)
def test_coefficient_never_rises_with_speed(a, b):
    slow, fast = sorted((abs(a), abs(b)))
    assert mu(slow) >= mu(fast)


@untimed
@given(speeds, st.floats(0, 0.1))
def test_coefficient_has_no_jump(speed, step):
    steepest = 1.5 * (MU_S - MU_D) / (V_D - V_S)
    assert abs(mu(speed + step) - mu(speed)) <= steepest * step + 1e-15


@untimed
@given(speeds)
def test_coefficient_is_even(speed):
    assert mu(speed) == mu(-speed)


@untimed
@given(speeds)
def test_coefficient_without_friction_is_zero(speed):
    assert coefficient(speed, 0.0, 0.0, V_S, V_D) == 0.0


@st.composite
def inverse_masses(draw: st.DrawFn) -> np.ndarray:
    """A random symmetric positive definite matrix."""
    a, b = 10 ** draw(st.floats(-3, 3)), 10 ** draw(st.floats(-3, 3))
    angle = draw(st.floats(0, math.pi))
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return turn @ np.diag([a, b]) @ turn.T


def solve(W: np.ndarray, b: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    p_e, p_f, lam = disc(W[0, 0], W[1, 1], W[0, 1], b[0], b[1], radius)
    return np.array([p_e, p_f]), lam


@untimed
@given(inverse_masses(), velocities, velocities, st.floats(-6, 6).map(lambda x: 10.0**x))
def test_disc_either_sticks_or_opposes_its_slip(W, b_e, b_f, radius):
    b = np.array([b_e, b_f])
    p, lam = solve(W, b, radius)
    slip = b + W @ p
    rounding = 1e-12 * (np.linalg.norm(b) + np.linalg.norm(W) * np.linalg.norm(p))
    assert lam >= 0
    assert np.linalg.norm(p) <= radius * (1 + 1e-12)
    if lam > 0:
        assert np.linalg.norm(p) == pytest.approx(radius, rel=1e-12)
    assert np.linalg.norm(slip + lam * p) <= max(rounding, 1e-12 * lam * radius) * np.linalg.cond(W)


@untimed
@given(inverse_masses(), velocities, velocities)
def test_disc_without_grip_gives_no_impulse(W, b_e, b_f):
    p, lam = solve(W, np.array([b_e, b_f]), 0.0)
    assert p.tolist() == [0.0, 0.0]
    assert lam == math.inf


@untimed
@given(inverse_masses(), st.floats(0, 10))
def test_disc_at_rest_stays_at_rest(W, radius):
    p, _ = solve(W, np.zeros(2), radius)
    assert not p.any()


@untimed
@given(inverse_masses(), velocities, velocities, st.floats(0.01, 100), st.floats(0.1, 10))
def test_disc_is_homogeneous(W, b_e, b_f, radius, factor):
    b = np.array([b_e, b_f])
    p, _ = solve(W, b, radius)
    q, _ = solve(W, factor * b, factor * radius)
    assert q == pytest.approx(factor * p, rel=1e-9, abs=1e-9 * factor * radius)


def by_bracketing(W: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """The sliding impulse, λ by SciPy's bracketing."""

    def impulse(lam: float) -> np.ndarray:
        return -np.linalg.solve(W + lam * np.eye(2), b)

    highest = np.linalg.norm(b) / radius
    lam = brentq(lambda x: np.linalg.norm(impulse(x)) - radius, 0, highest, xtol=1e-14 * highest)
    return impulse(lam)


@untimed
@given(inverse_masses(), velocities, velocities, st.floats(0.01, 0.95))
def test_disc_agrees_with_bracketing(W, b_e, b_f, share):
    b = np.array([b_e, b_f])
    assume(np.linalg.norm(b) > 1e-3)
    radius = share * np.linalg.norm(np.linalg.solve(W, b))
    p, lam = solve(W, b, radius)
    assert lam > 0
    assert p == pytest.approx(by_bracketing(W, b, radius), abs=1e-7 * radius)


@pytest.mark.parametrize("seed", range(10))
def test_disc_minimises_the_energy_within_the_circle(seed):
    """Where μ is frozen, Coulomb's law is the minimum of ½ pᵀWp + bᵀp over |p| ≤ radius."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    W, b, radius = root @ root.T + 0.1 * np.eye(2), rng.normal(size=2), 10 ** rng.uniform(-1, 1)

    def energy(p: np.ndarray) -> float:
        return 0.5 * p @ W @ p + b @ p

    best = minimize(
        energy,
        np.zeros(2),
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda p: radius**2 - p @ p},
        options={"ftol": 1e-14},
    )
    p, _ = solve(W, b, radius)
    assert energy(p) == pytest.approx(best.fun, rel=1e-7)
    assert p == pytest.approx(best.x, abs=1e-4 * radius)


def test_a_curve_has_at_most_its_static_coefficient_above_a_higher_speed():
    fields = {
        "mu_static": 0.5,
        "mu_dynamic": 0.5,
        "stiction_speed_mm_s": 2.0,
        "dynamic_speed_mm_s": 2.5,
    }
    assert FrictionCurve(**fields).mu_dynamic == 0.5
    with pytest.raises(ValueError, match=r"mu_dynamic 0.51 must be at most mu_static 0.5"):
        FrictionCurve(**fields | {"mu_dynamic": 0.51})
    for speed in (1.9, 2.0):
        with pytest.raises(ValueError, match=rf"dynamic_speed_mm_s {speed} must be above .* 2.0"):
            FrictionCurve(**fields | {"dynamic_speed_mm_s": speed})
