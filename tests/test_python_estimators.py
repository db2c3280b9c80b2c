"""The estimators in Python: limits in which a Kalman filter is exact, their consistency, and odd readings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import tlf_env
from baselines.policies.estimators.moving_horizon import (
    Links,
    MovingHorizonEstimator,
    eliminated,
    solved,
)
from baselines.policies.estimators.reckoning import (
    BIAS,
    PULL,
    SCALE,
    SLIP,
    SPEED,
    STATES,
    Interval,
    Noise,
    in_world,
    moved,
    rolling_slope,
    rolling_speed,
    slopes,
)
from baselines.policies.estimators.unscented import UnscentedEstimator
from baselines.runs.consistency import estimator_consistency, normalised_errors
from tlf_env.onboard.parts import Estimated, Readings, checked_estimate
from tlf_env.physics.vehicle import RobotParameters

DT_S = 0.001
ROBOT = RobotParameters()
NOTHING = np.zeros(2)
ESTIMATORS = [UnscentedEstimator, MovingHorizonEstimator]
both = pytest.mark.parametrize("estimator", ESTIMATORS)
seeds = st.integers(0, 2**32 - 1)
# Of a gyro that is known to be exact
EXACT_GYRO = {"scale": 1e-6, "bias_rad_s": 1e-6, "start_scale": 1e-6, "start_bias_rad_s": 1e-6}


class Moment(NamedTuple):
    """Readings, and the true pose at their time."""

    readings: Readings
    pose: np.ndarray


def drive(
    seconds: float,
    seed: int = 0,
    *,
    noise: Noise | None = None,
    fix_every: int = 10,
    delay: int = 0,
    outliers: float = 0.0,
    turning: bool = True,
) -> Iterator[Moment]:
    """A robot that moves as the model does, with its noise; torques accelerate it along a wavy path."""
    noise, rng = noise or Noise(), np.random.default_rng(seed)
    white = np.sqrt(noise.variances(DT_S))
    x = y = theta = speed = slip = pull = 0.0
    scale, bias = rng.normal(size=2) * (noise.start_scale, noise.start_bias_rad_s)
    rolling, past = 0.0, [np.zeros(2)]
    mass_mm = ROBOT.mass_kg * ROBOT.wheel_radius_mm
    wheels = 2.0 * ROBOT.wheel_inertia_kg_mm2 / (mass_mm * ROBOT.wheel_radius_mm)
    for k in range(1, round(seconds / DT_S) + 1):
        drawn = rng.normal(size=STATES) * white
        acceleration = 300.0 * math.cos(2.0 * k * DT_S)
        yaw_rate = 0.8 * math.sin(1.5 * k * DT_S) if turning else 0.0
        gained = acceleration * DT_S + drawn[SPEED]
        ahead = (speed + 0.5 * gained) * DT_S + drawn[0]
        middle = theta + 0.5 * yaw_rate * DT_S
        x += -ahead * math.sin(middle) + drawn[1] * math.cos(middle)
        y += ahead * math.cos(middle) + drawn[1] * math.sin(middle)
        theta += yaw_rate * DT_S + drawn[2]
        speed += gained
        slip = slip * math.exp(-DT_S / noise.slip_time_s) + drawn[SLIP]
        pull = pull * math.exp(-DT_S / noise.pull_time_s) + drawn[PULL]
        scale, bias = scale + drawn[SCALE], bias + drawn[BIAS]
        # What the sensors read, and the torques for this motion
        gyro = (yaw_rate + bias) / (1.0 - scale)
        rolled = (speed - 0.5 * gained - slip) * DT_S
        rolled += rng.normal() * noise.rolled_mm / math.sqrt(20)
        without = acceleration - pull + ROBOT.com_offset_mm * gyro**2
        without += wheels * (rolled / DT_S - rolling) / DT_S
        rolling = rolled / DT_S
        torque = without * mass_mm / 1000.0
        spun = yaw_rate * DT_S * ROBOT.axle_width_mm / 2.0
        past.append(np.array([x, y]))
        fix, taken = None, None
        if k % fix_every == 0 and k > delay:
            fix = past[k - delay] + rng.normal(size=2) * math.sqrt(noise.fix_variance_mm2)
            taken = (k - delay) * DT_S
            if rng.random() < outliers:
                fix = fix + rng.normal(size=2) * 100.0
        yield Moment(
            Readings(
                t_s=k * DT_S,
                steps_rad=np.array([rolled - spun, rolled + spun]) / ROBOT.wheel_radius_mm,
                fix_mm=fix,
                fix_t_s=taken,
                gyro_rad_s=gyro,
                wanted_rad_s=NOTHING,
                torques_Nmm=np.full(2, torque / 2.0),
            ),
            np.array([x, y, theta]),
        )


def made(estimator: Any, **parameters: Any) -> Any:
    """An estimator of the paper's robot, started at the origin."""
    part = estimator(ROBOT, DT_S, **parameters)
    part.reset(np.zeros(3))
    return part


def off(answer: Estimated, moment: Moment) -> float:
    """Distance of the estimated to the true position, mm."""
    return float(np.hypot(*(answer.pose - moment.pose)[:2]))


# The model


@untimed
@given(seeds)
def test_the_slopes_are_the_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise, past = Noise(), Interval(0.02, *rng.normal(size=4))
    state = rng.normal(size=STATES) * (100, 100, 3, 300, 30, 100, 0.02, 0.1)
    by_step = np.empty((STATES, STATES))
    for i, step in enumerate(np.diag([1e-3, 1e-3, 1e-5, 1e-2, 1e-2, 1e-2, 1e-5, 1e-5])):
        ends = moved(state + step, past, noise) - moved(state - step, past, noise)
        by_step[:, i] = ends / (2.0 * step[i])
        rolling = rolling_speed(state + step, past) - rolling_speed(state - step, past)
        assert rolling / (2.0 * step[i]) == pytest.approx(rolling_slope(past)[i], abs=1e-6)
    np.testing.assert_allclose(slopes(state, past, noise), by_step, rtol=1e-5, atol=1e-5)


def test_an_interval_is_its_halves() -> None:
    """Straight on, at constant readings, two steps of the model are one of twice the time."""
    state = np.array([1.0, 2.0, 0.3, 200.0, 0.0, 0.0, 0.0, 0.0])
    half, whole = Interval(0.01, 0.0, 3.0, 0.015, 0.0), Interval(0.02, 0.0, 6.0, 0.06, 0.0)
    twice = moved(moved(state, half, Noise()), half, Noise())
    np.testing.assert_allclose(twice, moved(state, whole, Noise()), rtol=1e-12)


# Where a Kalman filter is exact


@untimed
@given(seeds, st.integers(1, 5), st.integers(1, 6))
def test_a_window_of_a_linear_system_ends_with_the_kalman_filters_state(
    seed: int, n: int, window: int
) -> None:
    """Whatever the window: what is eliminated is kept in the arrival cost."""
    rng = np.random.default_rng(seed)

    def spread(size: int) -> np.ndarray:
        root = rng.normal(size=(size, size))
        return root @ root.T + 0.5 * np.eye(size)

    x, P = rng.normal(size=n), spread(n)
    mean, arrival = x.copy(), np.linalg.inv(P)
    systems: list[tuple[np.ndarray, ...]] = []
    for _ in range(10):
        A, Q, H, R = rng.normal(size=(n, n)), spread(n), rng.normal(size=(2, n)), spread(2)
        b, z = rng.normal(size=n), rng.normal(size=2)
        systems.append((A, np.linalg.inv(Q), b, H, np.linalg.inv(R), z))
        x, P = A @ x + b, A @ P @ A.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (z - H @ x), P - K @ H @ P
        # The window, about states of 0
        information = np.zeros((len(systems) + 1, n, n))
        gradient = np.zeros((len(systems) + 1, n))
        information[0], gradient[0] = arrival, -arrival @ mean
        for k, (_, _, _, H, W, z) in enumerate(systems, 1):
            information[k], gradient[k] = H.T @ W @ H, -H.T @ W @ z
        links = Links(
            np.array([one[0] for one in systems]),
            np.array([one[1] for one in systems]),
            -np.array([one[2] for one in systems]),
        )
        states, covariance = solved(information, gradient, links)
        np.testing.assert_allclose(states[-1], x, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(covariance, P, rtol=1e-6, atol=1e-7 * np.abs(P).max())
        if len(systems) == window:
            left, slope = eliminated(
                information[0], gradient[0], Links(*(part[0] for part in links))
            )
            _, _, _, H, W, z = systems.pop(0)
            # The measurement of the node that is now the oldest is part of its prior.
            arrival = left + H.T @ W @ H
            mean = np.linalg.solve(arrival, H.T @ W @ z - slope)


@both
def test_straight_on_both_are_the_kalman_filter_of_their_model(estimator: Any) -> None:
    """With an exact gyro, a straight path and a constant variance of the fixes the model is linear."""
    noise = Noise(**EXACT_GYRO, heading_rad=1e-5, fix_variance_time_s=1e12)
    part = made(estimator, noise=noise, interval_s=0.02)
    if estimator is MovingHorizonEstimator:
        part = made(estimator, noise=noise, window_s=0.1, huber=1e6)
    x, P = np.zeros(STATES), np.diag(noise.start())
    Q = in_world(noise.variances(0.02), 0.0)
    H = np.zeros((3, STATES))
    H[1, 0] = H[2, 1] = 1.0
    turned = gained = reached = rolled = 0.0
    last = rolling = 0.0
    mass_mm = ROBOT.mass_kg * ROBOT.wheel_radius_mm
    wheels = 2.0 * ROBOT.wheel_inertia_kg_mm2 / (mass_mm * ROBOT.wheel_radius_mm)
    for moment in drive(1.0, 3, noise=noise, fix_every=20, turning=False):
        part.update(moment.readings)
        step = float(ROBOT.wheel_radius_mm * moment.readings.steps_rad.mean())
        rolling, last = step / DT_S, rolling
        gain = 1000.0 * DT_S * moment.readings.torques_Nmm.sum() / mass_mm
        gain -= wheels * (rolling - last)
        reached += (gained + 0.5 * gain) * DT_S
        gained, rolled = gained + gain, rolled + step
        turned += moment.readings.gyro_rad_s * DT_S
        if moment.readings.fix_mm is None:
            continue
        past = Interval(0.02, turned, gained, reached, rolled)
        A = slopes(x, past, noise)
        x, P = moved(x, past, noise), A @ P @ A.T + Q
        H[0] = rolling_slope(past)
        expected = np.array([rolling_speed(x, past), x[0], x[1]])
        R = np.diag([(noise.rolled_mm / 0.02) ** 2, *2 * [noise.fix_variance_mm2]])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        z = np.array([rolled / 0.02, *moment.readings.fix_mm])
        x, P = x + K @ (z - expected), P - K @ H @ P
        turned = gained = reached = rolled = 0.0
        scales = np.sqrt(P.diagonal())
        np.testing.assert_allclose(part.state / scales, x / scales, atol=1e-3)
        np.testing.assert_allclose(part.covariance.diagonal(), P.diagonal(), rtol=0.01, atol=1e-9)


# Consistency


@both
def test_they_know_how_wrong_they_are(estimator: Any) -> None:
    """The sum of independent NEES has a χ² distribution; so has, about, that of NIS."""
    runs, nees, innovations = 8, [], []
    for seed in range(runs):
        part = made(estimator)
        for moment in drive(1.2, 100 + seed):
            answer = part.update(moment.readings)
            if moment.readings.fix_mm is not None:
                innovations.append(answer.nis)
        nees.append(normalised_errors(answer.pose - moment.pose, answer.covariance))
    low, high = stats.chi2.ppf([0.001, 0.999], 3 * runs)
    assert low < np.sum(nees) < high
    assert np.mean(innovations) == pytest.approx(2.0, abs=0.3)


def test_the_normalised_error_of_gaussian_draws_has_as_many_degrees_of_freedom_as_states() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    draws = rng.normal(size=(4000, 3)) @ root.T
    squares = normalised_errors(draws, np.broadcast_to(root @ root.T, (4000, 3, 3)))
    assert stats.kstest(squares, stats.chi2(3).cdf).pvalue > 0.01
    assert np.isnan(normalised_errors(np.zeros(3), np.zeros((3, 3))))


# Odd readings


@both
def test_outliers_count_little(estimator: Any) -> None:
    errors, squares = {}, []
    for share in (0.0, 0.1):
        part = made(estimator)
        far = []
        for moment in drive(2.0, 7, outliers=share):
            answer = part.update(moment.readings)
            far.append(off(answer, moment))
            squares.append(answer.nis)
        errors[share] = np.sqrt(np.mean(np.square(far)))
    assert max(squares) > 100.0 * part.GATE
    assert errors[0.1] < 2.0 * errors[0.0] + 0.1


@both
def test_late_fixes_count_at_their_time(estimator: Any) -> None:
    part = made(estimator)
    far = [off(part.update(moment.readings), moment) for moment in drive(2.0, 5, delay=60)]
    assert np.sqrt(np.mean(np.square(far))) < 1.5  # the robot moves up to 10 mm in the delay


@both
def test_without_fixes_the_uncertainty_grows_and_fixes_end_it(estimator: Any) -> None:
    part, spread = made(estimator), {}
    for k, moment in enumerate(drive(2.5, 6), 1):
        hidden = 1000 < k <= 2000
        readings = moment.readings
        if hidden:
            readings = readings._replace(fix_mm=None, fix_t_s=None)
        answer = part.update(readings)
        spread[k] = math.sqrt(answer.covariance[0, 0] + answer.covariance[1, 1])
    assert spread[2000] > 3.0 * spread[1000]
    assert spread[2500] < 1.2 * spread[1000]
    assert off(answer, moment) < 1.5


@both
def test_fixes_that_all_disagree_are_believed_after_a_second(estimator: Any) -> None:
    part = made(estimator)
    for moment in drive(4.0, 8):
        readings = moment.readings
        if readings.fix_mm is not None and readings.t_s > 0.5:
            readings = readings._replace(fix_mm=readings.fix_mm + np.array([30.0, 0.0]))
        answer = part.update(readings)
        if readings.t_s < 0.6:
            assert off(answer, moment) < 10.0
    assert off(answer, moment) == pytest.approx(30.0, abs=5.0)


def test_the_slip_of_the_window_keeps_its_bound() -> None:
    """Wheels that spin at 400 mm/s while the body stands, with a bound of 50 mm/s."""
    part = made(MovingHorizonEstimator, slip_bound_mm_s=50.0)
    spinning = np.full(2, 0.4 / ROBOT.wheel_radius_mm)
    sizes = []
    for k in range(1, 401):
        readings = Readings(k * DT_S, spinning, NOTHING, k * DT_S, 0.0, NOTHING, np.full(2, 1.0))
        part.update(readings)
        sizes.append(abs(part.state[SLIP]))
    assert max(sizes) == 50.0


def test_without_torques_the_encoders_accelerate_the_robot() -> None:
    """As on the kinematic plant."""
    part = made(UnscentedEstimator)
    for k in range(1, 101):
        rolled = np.full(2, min(3.0 * k, 150.0) * DT_S / ROBOT.wheel_radius_mm)
        answer = part.update(Readings(k * DT_S, rolled, None, None, 0.0, NOTHING, NOTHING))
    assert answer.twist[0] == pytest.approx(150.0, abs=0.5)


@both
def test_a_part_repeats_itself_bit_for_bit_and_forgets_at_a_reset(estimator: Any) -> None:
    def answers(part: Any) -> bytes:
        part.reset(np.zeros(3))
        found = [part.update(moment.readings) for moment in drive(0.8, 2, outliers=0.05)]
        return b"".join(np.concatenate([np.ravel(x) for x in one]).tobytes() for one in found)

    part = estimator(ROBOT, DT_S)
    first = answers(part)
    assert answers(part) == first
    assert answers(estimator(ROBOT, DT_S)) == first


# Bad input


@pytest.mark.parametrize(
    ("estimator", "given", "said"),
    [
        (UnscentedEstimator, {"period_s": 0.0}, "period_s 0.0 must be a positive number of"),
        (UnscentedEstimator, {"interval_s": math.nan}, "interval_s nan must be a positive"),
        (MovingHorizonEstimator, {"window_s": 0.01}, "window_s 0.01 must be .* at least 0.02"),
        (MovingHorizonEstimator, {"huber": 0.0}, "huber 0.0 must be positive"),
        (MovingHorizonEstimator, {"slip_bound_mm_s": -1.0}, "slip_bound_mm_s -1.0 must be"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(
    estimator: Any, given: dict[str, float], said: str
) -> None:
    with pytest.raises(ValueError, match=rf"^{said}[^\n]*$"):
        estimator(ROBOT, **{"period_s": DT_S, **given})


@pytest.mark.parametrize("nis", [-1.0, math.nan, math.inf, "2", True, [1.0]])
def test_a_part_must_return_an_innovation_squared_of_at_least_0(nis: Any) -> None:
    answer = Estimated(np.zeros(3), nis=nis)
    with pytest.raises(ValueError, match=r"^robot_0 must return a normalised .* at least 0, got"):
        checked_estimate(answer, "robot_0")


# In a formation


def test_the_innovations_squared_of_a_part_reach_the_infos() -> None:
    class Two:
        def __init__(self, robot: RobotParameters, period_s: float) -> None:
            pass

        def reset(self, pose: np.ndarray) -> None:
            self.pose = pose

        def update(self, readings: Readings) -> Estimated:
            return Estimated(self.pose, nis=None if readings.fix_mm is None else 2.5)

    env = tlf_env.parallel_env(
        "infinity", estimator=Two, disturbance={"position": {"period_s": 0.005}}
    )
    env.reset(seed=0)
    for _ in range(2):
        *_, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
        assert [one["innovation_nis"] for one in infos.values()] == pytest.approx(3 * [2.5])


@pytest.mark.parametrize("name", ["ukf", "moving-horizon"])
def test_in_a_formation_they_are_precise_and_not_too_sure(name: str) -> None:
    from baselines.policies.registry import fit_policy

    scenario = tlf_env.load_scenario("infinity", disturbance="slip", horizon_s=2.0, robots=1)
    fitted = fit_policy(f"feedback_linearisation:bounded+{name}+body", scenario)
    found = estimator_consistency(fitted.scenario, fitted.policy, 10_000)
    assert found.position_mm < 0.3
    assert found.heading_rad < 3e-3
    assert found.nees is not None
    assert found.nees < 6.0
    assert found.nis == pytest.approx(2.0, abs=0.4)
