"""Consistency of estimators: their errors against what they expect of themselves (NEES and NIS).

Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and Navigation*, Wiley 2001,
section 5.4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tlf_env.engine.formation import Formation
from tlf_env.numerics.angles import wrap
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import Policy, predicted
from tlf_env.task.scenario import Scenario

UPPER = np.triu_indices(3)


class Consistency(NamedTuple):
    """Errors of a run's estimates from settling on; RMS of the worst robot, means over robots and steps."""

    position_mm: float  # estimated to true position
    heading_rad: float
    nees: float | None  # normalised estimation error squared of the pose; None without a covariance
    nis: float | None  # normalised innovation squared of the fixes; None if it is not computed
    failed: bool  # a robot is lost, or touched something


def normalised_errors(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Normalised estimation error squared ``off ᵀ covariance⁻¹ off``.

    Of a consistent estimator with Gaussian errors it has a χ² distribution with as many degrees of freedom
    as there are states, and so the mean n.

    Parameters
    ----------
    off
        Errors ``(…, n)``.
    covariance
        Covariances ``(…, n, n)`` that the estimator gives.

    Returns
    -------
    numpy.ndarray
        ``(…)``; NaN where the covariance is 0.
    """
    unknown = np.asarray(~covariance.any(axis=(-2, -1)))
    given = np.where(unknown[..., None, None], np.eye(off.shape[-1]), covariance)
    squares = (off * np.linalg.solve(given, off[..., None])[..., 0]).sum(axis=-1)
    return np.where(unknown, np.nan, squares)


def estimator_consistency(scenario: Scenario, policy: Policy, seed: int = 0) -> Consistency:
    """Drive a policy over the whole horizon, and compare the estimates with the true poses.

    Errors are taken at the ends of control steps from ``scenario.settle_s`` on.

    Raises
    ------
    ValueError
        as :func:`baselines.runs.run.run_policy`.
    """
    formation = Formation(scenario.model_copy(update={"end_on": ()}))
    formation.reset(checked_seed(seed))
    arrays, robots = formation.arrays, scenario.robot_count
    state, start, failed = None, np.ones(robots, dtype=np.bool_), False
    offs, covariances, innovations = [], [], []
    for k in range(1, scenario.horizon_steps + 1):
        rows = arrays.observations.reshape(robots, -1).copy()
        answer = policy.predict(rows, state, start, True)
        actions, state = predicted(answer, arrays.actions.shape[1:], "policy")
        arrays.actions[0], start = actions, np.zeros_like(start)
        formation.step()
        failed = failed or bool(arrays.lost_now.any() or arrays.touched_now.any())
        if k * scenario.control_period_s < scenario.settle_s:
            continue
        info, estimate = formation.info(), np.array(formation.named("estimate"))
        turn = [wrap(one) for one in (estimate[2] - info.theta_rad).tolist()]
        offs.append(np.stack([estimate[0] - info.x_mm, estimate[1] - info.y_mm, turn], axis=-1))
        covariance = np.zeros((robots, 3, 3))
        covariance[:, UPPER[0], UPPER[1]] = covariance[:, UPPER[1], UPPER[0]] = estimate[3:].T
        covariances.append(covariance)
        innovations.append(info.innovation_nis.copy())
    off, nis = np.array(offs), np.array(innovations)
    nees = float(np.mean(normalised_errors(off, np.array(covariances))))
    return Consistency(
        position_mm=float(np.sqrt((off[..., :2] ** 2).sum(axis=-1).mean(axis=0)).max()),
        heading_rad=float(np.sqrt((off[..., 2] ** 2).mean(axis=0)).max()),
        nees=None if math.isnan(nees) else nees,
        nis=float(nis[nis > 0.0].mean()) if (nis > 0.0).any() else None,
        failed=failed,
    )
