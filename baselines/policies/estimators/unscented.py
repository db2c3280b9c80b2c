"""Unscented Kalman filter of pose, speed, slip and the gyro's errors.

S. Julier, J. Uhlmann, *A New Extension of the Kalman Filter to Nonlinear Systems*, AeroSense 1997; the weights
are those of the scaled transform of R. van der Merwe, *Sigma-Point Kalman Filters*, thesis, Oregon Health &
Science University, 2004, section 3.2.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from baselines.policies.estimators.reckoning import (
    THETA,
    Fix,
    Interval,
    Noise,
    Reckoning,
    in_world,
    moved,
    rolling_speed,
)
from tlf_env.physics.vehicle import RobotParameters

INTERVAL_S = 0.01

Function = Callable[[np.ndarray], np.ndarray]  # of rows (point, state), row by row


class Weights(NamedTuple):
    """Weights of the sigma points for mean and covariance, and their distance in standard deviations."""

    mean: np.ndarray  # (point,)
    covariance: np.ndarray
    distance: float


def scaled_weights(
    states: int, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0
) -> Weights:
    """Weights of the scaled unscented transform, for a number of states."""
    spread = alpha**2 * (states + kappa)  # n + λ
    mean = np.full(2 * states + 1, 0.5 / spread)
    covariance = mean.copy()
    mean[0] = 1.0 - states / spread
    covariance[0] = mean[0] + 1.0 - alpha**2 + beta
    return Weights(mean, covariance, math.sqrt(spread))


class UnscentedKalmanFilter:
    """Mean ``(n,)`` and covariance ``(n, n)`` of a state whose noise is additive."""

    def __init__(self, mean: np.ndarray, covariance: np.ndarray) -> None:
        self.mean, self.covariance = mean, covariance
        self._weights = scaled_weights(len(mean))

    def _points(self) -> np.ndarray:
        """Sigma points ``(2n + 1, n)``."""
        steps = self._weights.distance * np.linalg.cholesky(self.covariance).T
        return np.concatenate([self.mean[None], self.mean + steps, self.mean - steps])

    def predict(self, move: Function, noise: np.ndarray) -> None:
        """Move the state; ``noise`` is the covariance of the process noise."""
        moved = move(self._points())
        self.mean = self._weights.mean @ moved
        off = moved - self.mean
        self.covariance = off.T @ (self._weights.covariance[:, None] * off) + noise

    def correct(self, measure: Function, measured: np.ndarray, noise: np.ndarray) -> None:
        """Update with a measurement; ``noise`` is its covariance."""
        points = self._points()
        expected = measure(points)
        mean = self._weights.mean @ expected
        off = self._weights.covariance[:, None] * (expected - mean)
        spread = (expected - mean).T @ off + noise
        gain = np.linalg.solve(spread, off.T @ (points - self.mean)).T
        self.mean = self.mean + gain @ (measured - mean)
        covariance = self.covariance - gain @ spread @ gain.T
        self.covariance = 0.5 * (covariance + covariance.T)


class UnscentedEstimator(Reckoning):
    """The model of :mod:`~baselines.policies.estimators.reckoning` in an unscented Kalman filter.

    A fix whose normalised innovation squared is beyond the gate is left out.

    Parameters and errors are those of :class:`Reckoning`.
    """

    def __init__(
        self,
        robot: RobotParameters,
        period_s: float,
        interval_s: float = INTERVAL_S,
        noise: Noise | None = None,
    ) -> None:
        super().__init__(robot, period_s, interval_s, noise or Noise())

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose ``(x mm, y mm, θ rad)``, at rest."""
        self._fixes, self._sum_x, self._sum_y = 0, 0.0, 0.0
        super().reset(pose)

    def _take(self, fix: Fix) -> None:
        if fix.nis <= self.GATE:
            self._fixes += 1
            self._sum_x += fix.x - fix.way_x
            self._sum_y += fix.y - fix.way_y

    def _correct(self, t_s: float, past: Interval) -> None:
        """One step of the filter; the fixes of the interval are moved on to its end and averaged."""

        def measure(points: np.ndarray) -> np.ndarray:
            rolling = rolling_speed(points, past)
            return np.column_stack([rolling, points[:, :2]])[:, : 3 if self._fixes else 1]

        ukf = UnscentedKalmanFilter(self.state, self.covariance)
        middle = float(self.state[THETA]) + 0.5 * past.turned
        ukf.predict(
            lambda points: moved(points, past, self.noise), in_world(self._variances, middle)
        )
        measured = [past.rolled / past.time_s]
        variances = [(self.noise.rolled_mm / past.time_s) ** 2]
        if self._fixes:
            measured += [
                self._sum_x / self._fixes + self._way[0],
                self._sum_y / self._fixes + self._way[1],
            ]
            variances += 2 * [self.fix_variance / self._fixes]
        ukf.correct(measure, np.array(measured), np.diag(variances))
        self.state, self.covariance = ukf.mean, ukf.covariance
        self._fixes, self._sum_x, self._sum_y = 0, 0.0, 0.0
