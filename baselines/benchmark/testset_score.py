"""The published score of the test set, and how entries differ in it, case by case.

A case counts with the error ``settled_formation_rmse_mm`` of its worst robot, between 0.1 mm and 500 mm;
a failed run counts with 500 mm. The score is the geometric mean over the cases, in mm: less is better.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest, wilcoxon

from baselines.benchmark.lines import BESIDE, Line, beside, step_times, worst
from baselines.benchmark.results import Results
from baselines.benchmark.statistics import interval, median, rate
from baselines.benchmark.testset import severity_of
from baselines.benchmark.testset_plan import TestPlan, looks_of
from baselines.runs.outcome import failed

CAP_MM = 500.0  # also the error of a failed run
LEAST_MM = 0.1
SEVERITIES = ((0.0, 1 / 3), (1 / 3, 2 / 3), (2 / 3, 1.0))


def case_error_mm(line: Line) -> float:
    """The error with which a run counts, mm."""
    error = worst(line, "settled_formation_rmse_mm")
    if error is None or failed(line["robots"]):
        return CAP_MM
    return min(max(error, LEAST_MM), CAP_MM)


def geometric_mean(values: np.ndarray) -> float:
    """The exponential of the mean logarithm."""
    return math.exp(float(np.log(values).mean()))


def board_of_test(results: Results, command: str = "") -> dict[str, Any]:
    """Everything that the page of the test set shows, from the finished lines.

    Raises
    ------
    TypeError
        if the results are not those of a test plan.
    """
    plan = results.plan
    if not isinstance(plan, TestPlan):
        raise TypeError("the results are not those of the test set")
    groups: dict[str, list[Line]] = {}
    for line in results.ordered():
        groups.setdefault(line["policy"], []).append(line)
    severities = {seed: severity_of(seed, plan.key) for seed in range(*plan.seeds)}
    entries = [entry_table(name, lines, severities) for name, lines in groups.items()]
    entries.sort(key=lambda row: row["score"]["mm"])
    return {
        "command": command,
        "version": plan.version,
        "fingerprint": plan.fingerprint,
        "cases": list(plan.seeds),
        "published": plan.published,
        "entries": entries,
        "differences": [
            difference(groups[better["policy"]], groups[other["policy"]])
            for better, other in itertools.combinations(entries, 2)
        ],
        "looks": looks_of(results.folder),
    }


def entry_table(policy: str, lines: Sequence[Line], severities: dict[int, float]) -> dict[str, Any]:
    """One entry over all cases."""
    errors = np.array([case_error_mm(line) for line in lines])
    held = [not failed(line["robots"]) for line in lines]
    by_severity = []
    for low, high in SEVERITIES:
        inside = [
            h for h, line in zip(held, lines, strict=True) if low <= severities[line["seed"]] < high
        ]
        by_severity.append(rate(sum(inside), len(inside)) if inside else None)
    return {
        "policy": policy,
        "privileged": any(line["privileged"] for line in lines),
        "overrides": lines[0].get("overrides", {}),
        "cases": len(lines),
        "held": rate(sum(held), len(held)),
        "held_by_severity": by_severity,
        "score": {"mm": geometric_mean(errors), "interval": interval(errors, geometric_mean)},
        **{metric: median([beside(line["robots"], metric) for line in lines]) for metric in BESIDE},
        **({"step_ms": times} if (times := step_times(lines)) else {}),
    }


def difference(mine: Sequence[Line], theirs: Sequence[Line]) -> dict[str, Any]:
    """How one entry differs from another on the cases that both have run.

    ``error_mm`` is the median of the paired differences of the cases' errors (below 0: the first is better)
    with its interval, and the p-value of Wilcoxon's signed-rank test; ``held`` are the cases that only the
    first and only the second holds, and the p-value of the exact sign test of these (McNemar's).
    """
    other = {line["seed"]: line for line in theirs}
    pairs = [(line, other[line["seed"]]) for line in mine if line["seed"] in other]
    gaps = np.array([case_error_mm(a) - case_error_mm(b) for a, b in pairs])
    won = sum(not failed(a["robots"]) and failed(b["robots"]) for a, b in pairs)
    lost = sum(failed(a["robots"]) and not failed(b["robots"]) for a, b in pairs)
    return {
        "policy": mine[0]["policy"],
        "other": theirs[0]["policy"],
        "cases": len(pairs),
        "error_mm": {
            "median": float(np.median(gaps)) if len(gaps) else None,
            "interval": interval(gaps, lambda values: float(np.median(values))),
            "p": float(wilcoxon(gaps).pvalue) if np.any(gaps != 0.0) else 1.0,
        },
        "held": {
            "only": [won, lost],
            "p": float(binomtest(won, won + lost).pvalue) if won + lost else 1.0,
        },
    }
