"""The unscented Kalman filter: its linear limit, and what the example achieves with it on robots that slip."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st

import tlf_env
from baselines import ReferencePolicy
from baselines.policies.estimators.unscented import UnscentedKalmanFilter, scaled_weights
from tlf_env.onboard.parts import Estimated, Readings
from tlf_env.physics.parameters import RobotParameters

PLACE = Path(__file__).resolve().parents[1] / "examples" / "ukf_estimator.py"
SECONDS, SETTLED_S = 8.0, 3.0
SEED = 2000

seeds = st.integers(0, 2**32 - 1)


def load(path: Path) -> ModuleType:
    """The script, imported."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


ukf: Any = load(PLACE)


def random_covariance(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


# The filter


@pytest.mark.parametrize("states", [1, 3, 6])
@pytest.mark.parametrize(
    ("alpha", "beta", "kappa"), [(1.0, 2.0, 0.0), (0.5, 2.0, 0.0), (1.0, 0.0, 1.0)]
)
def test_the_weights_are_those_of_the_scaled_transform(
    states: int, alpha: float, beta: float, kappa: float
) -> None:
    """Weights of the mean sum to 1, those of the covariance to 2 − α² + β, and the points have P."""
    weights = scaled_weights(states, alpha, beta, kappa)
    assert weights.mean.sum() == pytest.approx(1.0)
    assert weights.covariance.sum() == pytest.approx(2.0 - alpha**2 + beta)
    assert 2.0 * weights.mean[1] * weights.distance**2 == pytest.approx(1.0)


@untimed
@given(seeds, st.integers(1, 6))
def test_a_linear_model_gives_the_kalman_filter(seed: int, states: int) -> None:
    rng = np.random.default_rng(seed)
    P, x = random_covariance(rng, states), rng.normal(size=states)
    mine = UnscentedKalmanFilter(x, P)
    for _ in range(4):
        A, Q = rng.normal(size=(states, states)), random_covariance(rng, states)
        H, R = rng.normal(size=(2, states)), random_covariance(rng, 2)
        b, c, z = rng.normal(size=states), rng.normal(size=2), rng.normal(size=2)
        mine.predict(lambda points, A=A, b=b: points @ A.T + b, Q)
        mine.correct(lambda points, H=H, c=c: points @ H.T + c, z, R)
        x, P = A @ x + b, A @ P @ A.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (z - H @ x - c), P - K @ H @ P
        np.testing.assert_allclose(mine.mean, x, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(mine.covariance, P, rtol=1e-6, atol=1e-6 * np.abs(P).max())


@untimed
@given(seeds)
def test_the_mean_of_a_quadratic_function_is_exact(seed: int) -> None:
    """E[xᵀBx] = mᵀBm + tr(BP), which an extended Kalman filter takes for mᵀBm."""
    rng = np.random.default_rng(seed)
    m, P, B = rng.normal(size=3), random_covariance(rng, 3), rng.normal(size=(3, 3))
    mine = UnscentedKalmanFilter(m, P)
    mine.predict(lambda points: np.einsum("ki,ij,kj->k", points, B, points)[:, None], np.eye(1))
    assert mine.mean[0] == pytest.approx(m @ B @ m + np.trace(B @ P), rel=1e-9, abs=1e-9)


def test_a_robot_at_rest_keeps_its_pose_and_learns_the_gyros_bias() -> None:
    robot, pose = RobotParameters(), np.array([100.0, -50.0, 0.4])
    part = ukf.SlipUkf(robot, 0.001)
    part.reset(pose)
    nothing = np.zeros(2)
    for k in range(1, 4001):
        fix = (pose[:2].copy(), 0.001 * k) if k % 10 == 0 else (None, None)
        result = part.update(Readings(0.001 * k, nothing, *fix, 0.01, nothing, nothing))
    np.testing.assert_allclose(result.pose[:2], pose[:2], atol=0.02)
    assert result.slip[0] == pytest.approx(0.0, abs=0.1)
    # At rest the fixes contain no information on yaw, so slip and bias share what the gyro measures.
    assert result.slip[1] + part._filter.mean[5] == pytest.approx(0.01, abs=1e-3)


# On robots that slip


class Drive(NamedTuple):
    """A run, a row per control step and then a column per robot."""

    position_mm: np.ndarray  # (step, robot) error
    off: np.ndarray  # (step, 3, robot): estimated minus true pose
    covariance: np.ndarray  # (step, robot, 3, 3)
    slip: np.ndarray  # (step, 2, robot) estimated
    injected: np.ndarray  # (step, 2, robot)
    messages: np.ndarray  # (step, 2, robot): twists that were broadcast
    lost: np.ndarray  # (robot,)
    parts: list[Any]


class Watched(ukf.SlipUkf):  # type: ignore[misc]  # loaded from a file at run time
    """Keeps what it returns, and the pose by odometry alone."""

    def reset(self, pose: np.ndarray) -> None:
        super().reset(pose)
        self.returned: list[Estimated] = []
        self.odometry = pose.copy()

    def update(self, readings: Readings) -> Estimated:
        self.returned.append(super().update(readings))
        left, right = self._radius * readings.steps_rad
        turn, middle = (right - left) / self._width, self.odometry[2]
        middle += 0.5 * turn
        ahead = 0.5 * (left + right)
        self.odometry += [-ahead * np.sin(middle), ahead * np.cos(middle), turn]
        return self.returned[-1]


def drive(estimator: Any, gains: str = "tuned", **channels: Any) -> Drive:
    """Drive the ∞ under slip as smooth noise."""
    parts: list[Any] = []

    def made(robot: RobotParameters, period_s: float) -> Any:
        parts.append(estimator(robot, period_s))
        return parts[-1]

    slip = tlf_env.load_scenario("infinity", disturbance="slip-noise").disturbance.slip
    env = tlf_env.parallel_env(
        "infinity",
        disturbance={"slip": slip.model_dump(), **channels},
        estimator=estimator if isinstance(estimator, str) else made,
        start_ramp_s=4.0,
        horizon_s=SECONDS,
        end_on=(),
        dtype="float64",
    )
    policy, rows = ReferencePolicy(gains), []
    seen, _ = env.reset(seed=SEED)
    formation = env.formation
    while env.agents:
        actions = policy.predict(np.stack(list(seen.values())))[0]
        seen, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        info, estimate, slip_row = (
            formation.info(),
            formation.named("estimate"),
            formation.named("slip"),
        )
        covariance = np.zeros((3, 3, 3))
        upper = np.triu_indices(3)
        covariance[:, upper[0], upper[1]] = covariance[:, upper[1], upper[0]] = np.array(estimate)[
            3:
        ].T
        message = formation.arrays.slot(formation.arrays.messages, formation.step_count)[3:, :, 0]
        rows.append(
            (
                info.position_error_mm.copy(),
                np.array(
                    [
                        estimate.x - info.x_mm,
                        estimate.y - info.y_mm,
                        estimate.theta - info.theta_rad,
                    ]
                ),
                covariance,
                np.array([slip_row.delta_1, slip_row.delta_2]),
                np.array(
                    [
                        [one["slip_delta_1_mm_s"], one["slip_delta_2_rad_s"]]
                        for one in infos.values()
                    ]
                ).T,
                message.copy(),
            )
        )
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Drive(*columns, np.array([one["lost"] for one in infos.values()]), parts)


@pytest.fixture(scope="module")
def run() -> Drive:
    """Fixes at 100 Hz, 20 ms late, and a gyro with bias and noise."""
    return drive(
        Watched,
        position={"period_s": 0.01, "delay_s": 0.02},
        gyro={"noise_rad_s_sqrt_hz": 1e-4, "bias_rad_s": 0.01},
    )


def settled(rows: np.ndarray) -> np.ndarray:
    return rows[round(SETTLED_S / 0.02) :]


def rms(rows: np.ndarray) -> np.ndarray:
    """RMS of each robot over the settled time."""
    return np.sqrt((settled(rows) ** 2).mean(axis=0))


def pose_error(run: Drive) -> np.ndarray:
    """RMS error of each robot's estimated position, mm."""
    return rms(np.hypot(run.off[:, 0], run.off[:, 1]))


def test_it_drives_the_reference_under_slip_and_loses_no_robot(run: Drive) -> None:
    assert not run.lost.any()
    assert rms(run.position_mm).max() < 10.0


def test_its_pose_is_better_than_the_papers_filter_and_than_odometry(run: Drive) -> None:
    """The paper's filter has ideal sensors here, with a fix every millisecond."""
    assert pose_error(run).max() < 1.0
    assert pose_error(run).max() < 0.5 * pose_error(drive("ekf")).min()
    truth = np.array([part.returned[-1].pose for part in run.parts]).T - run.off[-1]
    by_odometry = np.array([part.odometry for part in run.parts]).T - truth
    assert np.hypot(*by_odometry[:2]).min() > 20.0 * pose_error(run).max()


def test_its_slip_follows_the_injected_slip(run: Drive) -> None:
    left = rms(run.slip - run.injected)
    there = rms(run.injected)
    assert (there.T > [10.0, 0.05]).all()
    assert (left < 0.35 * there).all()
    for i in range(2):
        pairs = zip(settled(run.slip[:, i]).T, settled(run.injected[:, i]).T, strict=True)
        assert all(np.corrcoef(*pair)[0, 1] > 0.95 for pair in pairs)


def test_its_twist_is_what_followers_receive(run: Drive) -> None:
    for robot, part in enumerate(run.parts):
        twists = np.array([one.twist for one in part.returned]).reshape(-1, 20, 2)
        np.testing.assert_allclose(
            run.messages[:, :, robot], twists.mean(axis=1), rtol=1e-9, atol=1e-12
        )


def test_its_covariance_reaches_the_rows_and_explains_its_errors(run: Drive) -> None:
    """The normalised estimation error squared of three states has the mean 3 in a consistent filter."""
    for robot, part in enumerate(run.parts):
        np.testing.assert_allclose(
            run.covariance[-1, robot], part.returned[-1].covariance, rtol=1e-12
        )
    off = settled(run.off).transpose(0, 2, 1)[..., None]
    squared = (off.swapaxes(2, 3) @ np.linalg.solve(settled(run.covariance), off)).mean(axis=0)
    assert (squared > 1.0).all()
    assert (squared < 6.0).all()


def test_with_the_gyro_the_covariance_of_the_heading_is_small(run: Drive) -> None:
    assert np.sqrt(settled(run.covariance)[:, :, 2, 2]).max() < 0.01
