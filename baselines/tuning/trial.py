"""One trial of a search: its runs on the batch plant, and their cost."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.runs.outcome import failed
from baselines.runs.run import Record, run_seeds, seed_blocks
from baselines.tuning.config import CAPS, TuneConfig
from tlf_env.onboard.controllers import ControllerFile


class TrialJob(NamedTuple):
    """A trial to be run."""

    number: int
    values: dict[str, float]  # by path
    seeds: list[int]
    # Failed runs at which the trial stops, counted up to each "task, disturbance".
    too_many: dict[str, int]


class Outcome(NamedTuple):
    """Result of a trial."""

    number: int
    score: float  # mean over the strata of the mean cost over seeds; less is better
    failed: int  # runs in which a robot was lost or touched another
    runs: int
    stopped: bool  # before all strata were run
    strata: dict[str, dict[str, float]]  # by "task, disturbance": cost, failed, medians of measures


def run_trial(config: TuneConfig, job: TrialJob) -> Outcome:
    """Run a trial through all tasks and disturbances, a block of seeds at once."""
    made = config.built(job.values)
    strata: dict[str, dict[str, float]] = {}
    fails = 0
    scenarios = config.scenarios(made.ekf_slip if isinstance(made, ControllerFile) else None)
    for place, scenario in scenarios.items():
        policy = config.policy(made, scenario)
        rows = [
            measured(record)
            for seeds in seed_blocks(job.seeds)
            for record in run_seeds(scenario, policy, seeds)
        ]
        here = sum(fail for _, fail in rows)
        fails += here
        strata[place] = {
            "cost": float(np.mean([config.objective.cost(*row) for row in rows])),
            "failed": here,
            **{name: float(np.median([m[name] for m, _ in rows])) for name in CAPS},
        }
        if fails >= job.too_many.get(place, math.inf):
            break
    return Outcome(
        number=job.number,
        score=float(np.mean([row["cost"] for row in strata.values()])),
        failed=fails,
        runs=len(strata) * len(job.seeds),
        stopped=len(strata) < len(scenarios),
        strata=strata,
    )


def measured(record: Record) -> tuple[dict[str, float], bool]:
    """A run's measures by name, each at most its cap, and whether the run failed."""
    robots = record.metrics()

    def of(name: str) -> np.ndarray:
        values = [getattr(robot, name) for robot in robots]
        return np.array([CAPS[name] if v is None else min(v, CAPS[name]) for v in values])

    return {
        "position_rmse_mm": float(of("position_rmse_mm").max()),
        "settled_formation_rmse_mm": float(of("settled_formation_rmse_mm").max()),
        "error_capped_mean_mm": float(of("error_capped_mean_mm").mean()),
        "torque_rms_Nmm": float(np.sqrt(np.mean(of("torque_rms_Nmm") ** 2))),
    }, failed(robots)
