"""The extended Kalman filter, eqs (28)–(41)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import PAPERS, untimed
from hypothesis import given
from hypothesis import strategies as st
from page_tables import numbers_in, rows_of
from scipy import stats

import tlf_env
from baselines import ReferencePolicy
from tlf_env.onboard.estimator import (
    Ekf,
    EkfParameters,
    Estimate,
    correct,
    ekf_constants,
    predict,
)
from tlf_env.onboard.tracking import body_errors
from tlf_env.physics.vehicle import odometry
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking

PRINTED = ekf_constants(EkfParameters())
SIGMA_2 = 0.2  # mm², σ_m² of eq. (37)
LAGS = 20
CONFIDENCE = 0.95

small = st.floats(-0.5, 0.5)
headings = st.floats(-10, 10)


class MatrixEkf:
    """Eqs (28)–(41) as the paper writes them, with matrices; θᵢ of (28) is the midpoint."""

    def __init__(self, pose, alphas=(2e-3, 1e-2, 1e-2, 1e-3), variance: float = SIGMA_2) -> None:
        self.x = np.array(pose, dtype=float)
        self.P = np.zeros((3, 3))
        self.alphas = alphas
        self.R = variance * np.eye(2)

    def predict(self, u_1: float, u_2: float) -> None:
        middle = self.x[2] + u_2 / 2
        sin, cos = math.sin(middle), math.cos(middle)
        F = np.array([[1, 0, -u_1 * cos], [0, 1, -u_1 * sin], [0, 0, 1]])
        G = np.array([[-sin, -u_1 * cos / 2], [cos, -u_1 * sin / 2], [0, 1]])
        a_1, a_2, a_3, a_4 = self.alphas
        Q = np.diag([a_1 * abs(u_1) + a_2 * abs(u_2), a_3 * abs(u_1) + a_4 * abs(u_2)]) ** 2
        self.x = self.x + np.array([-u_1 * sin, u_1 * cos, u_2])
        self.P = F @ self.P @ F.T + G @ Q @ G.T

    def correct(self, fix) -> tuple[np.ndarray, float]:
        H = np.eye(2, 3)
        S = H @ self.P @ H.T + self.R
        gain = self.P @ H.T @ np.linalg.inv(S)
        innovation = np.asarray(fix) - H @ self.x
        self.x = self.x + gain @ innovation
        self.P = (np.eye(3) - gain @ H) @ self.P
        return innovation, float(innovation @ np.linalg.solve(S, innovation))


def covariance(e: Estimate) -> np.ndarray:
    return np.array([[e.p_xx, e.p_xy, e.p_xt], [e.p_xy, e.p_yy, e.p_yt], [e.p_xt, e.p_yt, e.p_tt]])


def at(pose, P: np.ndarray | None = None) -> Estimate:
    P = np.zeros((3, 3)) if P is None else P
    return Estimate(*map(float, pose), *P[np.triu_indices(3)].tolist())


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(3, 3)) * np.array([1.0, 1.0, 0.05])[:, None]
    return root @ root.T


# The law against matrices


@pytest.mark.parametrize("seed", range(5))
def test_filter_is_the_matrix_filter(seed):
    """To 1e-12 in the pose; an innovation is a difference of positions of metres."""
    rng = np.random.default_rng(seed)
    pose = [*rng.uniform(-3000, 3000, 2), rng.uniform(-4, 4)]
    law, matrix = at(pose), MatrixEkf(pose)
    for _ in range(500):
        u_1, u_2 = rng.uniform(-0.6, 0.6), rng.uniform(-0.005, 0.005)
        fix = matrix.x[:2] + rng.normal(0, 0.5, 2)
        law = predict(law, PRINTED, u_1, u_2)
        matrix.predict(u_1, u_2)
        law, d_x, d_y, nis = correct(law, PRINTED, *fix)
        innovation, matrix_nis = matrix.correct(fix)
        np.testing.assert_allclose(law[:3], matrix.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(covariance(law), matrix.P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose((d_x, d_y), innovation, rtol=1e-9, atol=1e-11)
        assert nis == pytest.approx(matrix_nis, rel=1e-9, abs=1e-12)


def test_single_steps_are_those_of_the_matrix_filter_to_rounding():
    rng = np.random.default_rng(10)
    for _ in range(300):
        pose = [*rng.uniform(-3000, 3000, 2), rng.uniform(-4, 4)]
        P, fix = random_covariance(rng), pose[:2] + rng.normal(0, 2, 2)
        u_1, u_2 = rng.uniform(-10, 10), rng.uniform(-0.2, 0.2)
        matrix = MatrixEkf(pose)
        matrix.P = P
        matrix.predict(u_1, u_2)
        law = predict(at(pose, P), PRINTED, u_1, u_2)
        np.testing.assert_allclose(law[:3], matrix.x, rtol=1e-12)
        np.testing.assert_allclose(covariance(law), matrix.P, rtol=1e-12, atol=1e-12)
        matrix.correct(fix)
        law, *_ = correct(law, PRINTED, *fix)
        np.testing.assert_allclose(law[:3], matrix.x, rtol=1e-12)
        np.testing.assert_allclose(covariance(law), matrix.P, rtol=1e-12, atol=1e-12)


@untimed
@given(st.lists(st.tuples(small, small, small, small), min_size=1, max_size=60), headings)
def test_covariance_stays_positive_semidefinite(steps, theta):
    estimate = at((0.0, 0.0, theta))
    for u_1, u_2, d_x, d_y in steps:
        estimate = predict(estimate, PRINTED, u_1, u_2)
        estimate, *_ = correct(estimate, PRINTED, estimate.x + d_x, estimate.y + d_y)
        eigenvalues = np.linalg.eigvalsh(covariance(estimate))
        assert eigenvalues.min() >= -1e-12 * max(eigenvalues.max(), 1e-12)


def test_a_fix_never_raises_the_variance():
    rng = np.random.default_rng(11)
    for _ in range(200):
        P = random_covariance(rng)
        after, *_ = correct(at((0.0, 0.0, 0.0), P), PRINTED, 1.0, -1.0)
        assert np.linalg.eigvalsh(P - covariance(after)).min() >= -1e-12


def test_a_filter_that_is_certain_ignores_fixes_and_standing_still_adds_no_doubt():
    start = at((10.0, 20.0, 0.3))
    after, d_x, d_y, nis = correct(predict(start, PRINTED, 0.0, 0.0), PRINTED, 13.0, 16.0)
    assert after == start
    assert (d_x, d_y) == (3.0, -4.0)
    assert nis == pytest.approx(25 / SIGMA_2)


# Jacobians: read out of the covariance, against differences of the motion


@untimed
@given(headings, st.floats(-20, 20), st.floats(-0.5, 0.5))
def test_state_jacobian_is_the_derivative_of_the_motion(theta, u_1, u_2):
    """Without process noise P' = F P Fᵀ; with P = e_θ e_θᵀ that is the last column of F, squared."""
    silent = Ekf(0.0, 0.0, 0.0, 0.0, SIGMA_2)
    heading_only = np.diag([0.0, 0.0, 1.0])
    column = covariance(predict(at((0.0, 0.0, theta), heading_only), silent, u_1, u_2))[:, 2]
    step = 1e-5
    ahead = np.array(predict(at((0.0, 0.0, theta + step)), silent, u_1, u_2)[:3])
    behind = np.array(predict(at((0.0, 0.0, theta - step)), silent, u_1, u_2)[:3])
    np.testing.assert_allclose(column, (ahead - behind) / (2 * step), atol=1e-7)
    P = np.diag([2.0, 3.0, 0.0])
    moved = covariance(predict(at((0.0, 0.0, theta), P), silent, u_1, u_2))
    np.testing.assert_allclose(moved, P, atol=1e-15)


@untimed
@given(headings, st.floats(0.5, 20), st.floats(0.05, 0.5))
def test_input_jacobian_is_the_derivative_of_the_motion(theta, u_1, u_2):
    """From P = 0 one noise of unit variance leaves P' = g gᵀ, g a column of G."""
    start, step = at((0.0, 0.0, theta)), 1e-5
    for noise, shift in (
        (Ekf(1 / u_1, 0.0, 0.0, 0.0, SIGMA_2), (step, 0.0)),
        (Ekf(0.0, 0.0, 0.0, 1 / u_2, SIGMA_2), (0.0, step)),
    ):
        ahead = np.array(predict(start, noise, u_1 + shift[0], u_2 + shift[1])[:3])
        behind = np.array(predict(start, noise, u_1 - shift[0], u_2 - shift[1])[:3])
        g = (ahead - behind) / (2 * step)
        measured = covariance(predict(start, noise, u_1, u_2))
        np.testing.assert_allclose(measured, np.outer(g, g), atol=1e-6)


def test_process_noise_is_eq_36():
    ekf = Ekf(0.2, 0.3, 0.5, 0.7, SIGMA_2)
    P = covariance(predict(at((0.0, 0.0, 0.0)), ekf, -2.0, 1e-9))  # heading +y, straight back
    assert P[1, 1] == pytest.approx((0.2 * 2) ** 2, rel=1e-6)
    assert P[2, 2] == pytest.approx((0.5 * 2) ** 2, rel=1e-6)
    P = covariance(predict(at((0.0, 0.0, 0.0)), ekf, 0.0, -0.4))
    assert P[2, 2] == pytest.approx((0.7 * 0.4) ** 2, rel=1e-12)
    assert P[0, 0] + P[1, 1] == pytest.approx((0.3 * 0.4) ** 2, rel=1e-12)


@given(headings, headings)
def test_odometry_is_eq_29(angle_l, angle_r):
    distance, turn = odometry(angle_l, angle_r, 50.0, 78.0)
    assert distance == pytest.approx(50 * (angle_r + angle_l) / 2, rel=1e-12, abs=1e-12)
    assert turn == pytest.approx(50 * (angle_r - angle_l) / 156, rel=1e-12, abs=1e-12)


# Consistency where the filter's own model holds


def white_bound(samples: int, tests: int) -> float:
    """Largest autocorrelation of ``tests`` that white noise passes with the confidence in all."""
    return float(stats.norm.ppf(1 - (1 - CONFIDENCE) / (2 * tests)) / math.sqrt(samples))


def autocorrelation(values: np.ndarray) -> np.ndarray:
    """Lags 1 to :data:`LAGS`."""
    power = np.sum(values**2)
    return np.array([np.sum(values[k:] * values[:-k]) for k in range(1, LAGS + 1)]) / power


def nis_interval(samples: int) -> tuple[float, float]:
    """Where the mean of ``samples`` normalised innovations squared (two degrees of freedom) lies."""
    low, high = stats.chi2.interval(CONFIDENCE, 2 * samples)
    return low / samples, high / samples


def unicycle_innovations(
    u: np.ndarray, ekf: Ekf, noise: Ekf, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Innovations (forward, right; mm) and NIS of a filter on a robot that moves by eq. (28).

    ``u`` holds the odometry's increments; ``noise`` says by eq. (36) how far the robot departs from them.
    """
    truth, estimate = np.zeros(3), at((0.0, 0.0, 0.0))
    innovations, nis = np.empty((len(u), 2)), np.empty(len(u))
    for k, (u_1, u_2) in enumerate(u):
        sd_1 = noise.alpha_1 * abs(u_1) + noise.alpha_2 * abs(u_2)
        sd_2 = noise.alpha_3 * abs(u_1) + noise.alpha_4 * abs(u_2)
        done_1, done_2 = u_1 + sd_1 * rng.normal(), u_2 + sd_2 * rng.normal()
        middle = truth[2] + done_2 / 2
        truth += (-done_1 * math.sin(middle), done_1 * math.cos(middle), done_2)
        fix = truth[:2] + math.sqrt(SIGMA_2) * rng.normal(size=2)
        estimate = predict(estimate, ekf, u_1, u_2)
        heading = estimate.theta
        estimate, d_x, d_y, nis[k] = correct(estimate, ekf, *fix)
        innovations[k] = body_errors(d_x, d_y, heading)
    return innovations, nis


def test_innovations_are_white_and_nis_is_2_where_the_model_holds():
    """A robot whose odometry errs with the variance (36) and whose fixes err with that of (37).

    α₁ is ten times the printed one: with that, what the linearised filter leaves out (a heading error e
    shortens the way by e²/2) is large enough against the noise to show.
    """
    samples = 60_000
    u = np.stack([np.full(samples, 0.4), 8e-4 * np.sin(np.arange(samples) / 4000)], axis=-1)
    ekf = PRINTED._replace(alpha_1=2e-2)
    innovations, nis = unicycle_innovations(u, ekf, noise=ekf, rng=np.random.default_rng(12))
    low, high = nis_interval(samples)
    assert low < nis.mean() < high
    for along in innovations.T:
        assert np.abs(autocorrelation(along)).max() < white_bound(samples, 2 * LAGS)


# On the nominal ∞. The leader skids for the first seconds, while it catches up from rest.

CAUGHT_UP_S = 10.0


class Signals:
    """What the leader's filter did in each millisecond of a run."""

    def __init__(self, seed: int, **overrides: object) -> None:
        env = tlf_env.parallel_env(
            "infinity", robots=1, control_period_s=0.001, end_on=(), **PAPERS | overrides
        )
        policy = ReferencePolicy("consistent")
        observation = env.reset(seed=seed)[0]["robot_0"]
        steps = env.scenario.horizon_steps
        axes = [Tracking._fields.index(f"innovation_{axis}") for axis in ("forward", "right")]
        scales = [TRACKING_ENTRIES[Tracking._fields[axis]].scale for axis in axes]
        self.innovations = np.empty((steps, 2))  # forward and right, mm
        self.nis = np.empty(steps)
        self.heading_error = np.empty(steps)
        self.heading_variance = np.empty(steps)
        for k in range(steps):
            if k % 20 == 0:
                action, _ = policy.predict(observation)
            observations, *_, infos = env.step({"robot_0": action})
            observation, info = observations["robot_0"], infos["robot_0"]
            self.innovations[k] = observation[axes] * scales
            self.nis[k] = info["innovation_nis"]
            estimate = env.formation.arrays.rows("estimate")[:, 0, 0]
            self.heading_error[k] = estimate[2] - info["theta_rad"]
            self.heading_variance[k] = estimate[8]
        self.settled = slice(round(CAUGHT_UP_S / 0.001), None)


@pytest.fixture(scope="module")
def nominal():
    return Signals(seed=0)


def test_heading_error_on_the_nominal_infinity(nominal):
    rms = np.sqrt(np.mean(nominal.heading_error**2))
    assert 0.006 < rms < 0.02


def test_heading_variance_is_larger_than_the_squared_error(nominal):
    errors, variances = nominal.heading_error, nominal.heading_variance
    assert np.mean(errors[nominal.settled] ** 2) < np.mean(variances[nominal.settled])


# What the filter misses there is a row of the page: the printed α₃ = 1e-2 rad/mm of eq. (36) is far above the
# error of noiseless encoders, so that the filter over-corrects its heading.
CONSISTENCY = rows_of("controller/paper.md", "consistency")


def consistency(name: str) -> tuple[list[float], float]:
    """What the page wants of a filter, one bound or two, and what it says that was measured."""
    wanted, measured, holds = CONSISTENCY[name]
    (value,) = numbers_in(measured)
    bounds = numbers_in(wanted)
    low, high = bounds if len(bounds) == 2 else (-math.inf, *bounds)
    assert holds == ("holds" if low < value < high else "missed")
    return bounds, value


@pytest.mark.parametrize(("axis", "name"), [(0, "forward"), (1, "lateral")])
def test_autocorrelation_of_the_innovations_on_the_nominal_infinity(nominal, axis, name):
    """White forward, which the filter should be, and not quite white sideways."""
    along = nominal.innovations[nominal.settled, axis]
    (bound,), stated = consistency(f"largest autocorrelation, {name} innovations")
    assert bound == pytest.approx(white_bound(len(along), LAGS), abs=5e-5)
    assert np.abs(autocorrelation(along)).max() == pytest.approx(stated, abs=0.003)


def test_mean_nis_on_the_nominal_infinity(nominal):
    """A little below 2, and below where a consistent filter's mean lies."""
    nis = nominal.nis[nominal.settled]
    interval, stated = consistency("mean NIS")
    assert interval == pytest.approx(nis_interval(len(nis)), abs=5e-4)
    assert nis.mean() == pytest.approx(stated, abs=0.005)


def test_skid_at_the_start_shows_in_the_nis(nominal):
    nis = nominal.nis[: nominal.settled.start]
    assert nis.mean() > nis_interval(len(nis))[1]


def on_infinity_without_slip(ekf: Ekf) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and NIS of a filter on a robot that follows ∞ by eq. (28), with noiseless encoders."""
    t_s = np.arange(0, 100, 0.001) + 0.0005
    v_x, v_y = 250 * np.cos(t_s / 8), 500 * np.cos(t_s / 4)  # eq. (52)
    a_x, a_y = -250 / 8 * np.sin(t_s / 8), -125 * np.sin(t_s / 4)
    speed = np.hypot(v_x, v_y)
    u = 0.001 * np.stack([speed, (v_x * a_y - v_y * a_x) / speed**2], axis=-1)
    exact = Ekf(0.0, 0.0, 0.0, 0.0, SIGMA_2)
    return unicycle_innovations(u, ekf, exact, np.random.default_rng(13))


def test_without_heading_noise_per_distance_the_filter_is_consistent_on_infinity():
    """So that α₃ is the cause of what is missed: with 0 in its place nothing is."""
    innovations, nis = on_infinity_without_slip(PRINTED._replace(alpha_3=0.0))
    low, high = nis_interval(len(nis))
    assert low < nis.mean() < high
    for along in innovations.T:
        assert np.abs(autocorrelation(along)).max() < white_bound(len(nis), 2 * LAGS)


def test_nominal_innovations_are_those_of_a_robot_that_never_slips(nominal):
    """So what is not white is not the plant's: the same filter on eq. (28) without noise of the inputs."""
    innovations, nis = on_infinity_without_slip(PRINTED)
    samples = len(nominal.nis[nominal.settled])
    for here, there in zip(
        nominal.innovations[nominal.settled].T, innovations[nominal.settled].T, strict=True
    ):
        spread = math.sqrt(2 / (LAGS * samples))  # of the difference of two means over the lags
        difference = autocorrelation(here).mean() - autocorrelation(there).mean()
        assert abs(difference) < 4 * spread
        assert np.var(here) == pytest.approx(np.var(there), rel=4 * math.sqrt(4 / samples))
    spread = math.sqrt(2 * 4 / samples)
    assert abs(nominal.nis[nominal.settled].mean() - nis[nominal.settled].mean()) < 4 * spread


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_heading_error_and_forward_whiteness_for_other_seeds(seed):
    signals = Signals(seed)
    assert 0.006 < np.sqrt(np.mean(signals.heading_error**2)) < 0.02
    forward = signals.innovations[signals.settled, 0]
    assert np.abs(autocorrelation(forward)).max() < white_bound(len(forward), 4 * LAGS)
