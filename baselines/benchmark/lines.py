"""Values of the lines of ``runs.jsonl`` that the tables are made from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from baselines.runs.outcome import failed

Line = dict[str, Any]
# A stratum, for which runs over seeds are compared: task, disturbance, value of the swept knob.
Stratum = tuple[str, str, float | None]
Strata = dict[Stratum, list[Line]]  # runs of one policy
# What is shown beside a score: the worst robot's value, and the energy of all robots together.
BESIDE: dict[str, Callable[[list[float]], float]] = {
    "position_rmse_mm": max,
    "time_gap_rmse_s": max,
    "torque_rms_Nmm": max,
    "energy_J": sum,
}


def failures(lines: Sequence[Line]) -> int:
    """Number of failed runs."""
    return sum(failed(line["robots"]) for line in lines)


def worst(line: Line, metric: str) -> float | None:
    """A run's value of a metric at its worst robot; None if undefined for all robots."""
    values = [robot[metric] for robot in line["robots"] if robot[metric] is not None]
    return max(values, default=None)


def beside(robots: Sequence[Mapping[str, Any]], metric: str) -> float | None:
    """A run's value of a metric of :data:`BESIDE`; None if undefined for all robots."""
    values = [robot[metric] for robot in robots if robot[metric] is not None]
    return BESIDE[metric](values) if values else None


def run_score(line: Line) -> float:
    """A run's score: the mean over its robots, 0 to 100."""
    return float(np.mean([robot["score"] for robot in line["robots"]]))


def stratum_of(line: Line) -> Stratum:
    """Task, disturbance and swept value of a line."""
    return line["task"], line["disturbance"], line["sweep"]


def grouped(lines: Iterable[Line]) -> dict[str, Strata]:
    """The lines of each policy and stratum, in their order."""
    groups: dict[str, Strata] = {}
    for line in lines:
        groups.setdefault(line["policy"], {}).setdefault(stratum_of(line), []).append(line)
    return groups


def step_times(lines: Sequence[Line]) -> dict[str, float] | None:
    """Times of a step, ms: medians over the runs of their median and 99 % quantile, and the largest.

    ``late`` is the share of all steps that took longer than a control period. None for policies whose time is
    not measured.
    """
    times = [line["step_ms"] for line in lines if "step_ms" in line]
    if not times:
        return None
    return {
        "median": float(np.median([one["median"] for one in times])),
        "p99": float(np.median([one["p99"] for one in times])),
        "largest": max(one["largest"] for one in times),
        "late": float(np.mean([one["late"] for one in times])),
    }
