"""Score of a policy on choosing seeds: one number for each task and disturbance, and one for all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.training.config import TrainConfig
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER
from tlf_env.onboard.parts import Policy
from tlf_env.task.scenario import Scenario

FAILED_MM = 1000.0  # position RMS that a failed run counts as
SMALLEST_MM = 0.1
MEASURED = ("position_rmse_mm", "error_capped_mean_mm", "torque_rms_Nmm")


class ScenarioScore(NamedTuple):
    """One task under one disturbance, over the seeds: medians of the worst robot, and failures."""

    position_rmse_mm: float
    error_capped_mean_mm: float
    torque_rms_Nmm: float
    failed: int  # runs in which a robot was lost or touched another
    runs: int
    score_mm: float  # geometric mean of the position RMS, FAILED_MM for a failed run


def score_policy(
    policy: Policy, scenarios: Mapping[tuple[str, str], Scenario], seeds: range
) -> dict[str, ScenarioScore]:
    """Score of a policy for every task and disturbance, by ``"task, disturbance"``."""
    return {
        f"{task}, {disturbance}": score_scenario(policy, scenario, seeds)
        for (task, disturbance), scenario in scenarios.items()
    }


def score_default(config: TrainConfig) -> dict[str, ScenarioScore]:
    """Score of the default system in the evaluation of a training: what a policy is to be compared with."""
    name = f"reference:{DEFAULT_CONTROLLER}"
    seeds = range(*config.evaluation.seeds)
    found = {}
    for place, scenario in config.task_scenarios().items():
        fitted = fit_policy(name, scenario)
        found[", ".join(place)] = score_scenario(fitted.policy, fitted.scenario, seeds)
    return found


def overall_mm(scores: Mapping[str, ScenarioScore]) -> float:
    """Geometric mean of all scores, mm; less is better."""
    return math.exp(float(np.mean([math.log(one.score_mm) for one in scores.values()])))


def score_scenario(policy: Policy, scenario: Scenario, seeds: range) -> ScenarioScore:
    """Score of a policy in one scenario over the seeds."""
    worst, fails = [], []
    for record in run_seeds(scenario, policy, seeds):
        robots = record.metrics()
        worst.append([max(getattr(robot, name) for robot in robots) for name in MEASURED])
        fails.append(failed(robots))
    table = np.array(worst)
    counted = np.where(fails, FAILED_MM, np.clip(table[:, 0], SMALLEST_MM, FAILED_MM))
    return ScenarioScore(
        **dict(zip(MEASURED, np.median(table, axis=0).tolist(), strict=True)),
        failed=sum(fails),
        runs=len(fails),
        score_mm=float(np.exp(np.log(counted).mean())),
    )
