"""The leaderboard: everything that the tables and figures show, made from finished episodes.

Statistics: :mod:`baselines.benchmark.statistics`. Here they are applied to policies, tasks and
disturbances; performance profiles (Agarwal et al., NeurIPS 2021) and breaking points are added.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.benchmark.comparisons import comparisons
from baselines.benchmark.lines import (
    Line,
    Strata,
    failures,
    grouped,
    run_score,
    step_times,
    worst,
)
from baselines.benchmark.page import PAIRED, markdown
from baselines.benchmark.results import BOARD_FILE, PAGE_FILE, PLAN_FILE, Results
from baselines.benchmark.statistics import (
    crossing,
    improvement,
    interquartile_mean,
    interval,
    median,
    pooled_iqm,
    rate,
    stratified_interval,
)
from tlf_env.common.files import atomic
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER

PROFILE_SCORES = np.linspace(0, 100, 101)
# What the others are compared with: the default controller by both its names, or else the paper's, alone or in
# the first system with it.
REFERENCES = (f"reference:{DEFAULT_CONTROLLER}", "reference", "reference:consistent")
LOSSES = (0.05, 0.5)


def reference_of(policies: Sequence[str]) -> str | None:
    """What the others are compared with: the first of :data:`REFERENCES`, or else the first policy."""
    for name in REFERENCES:
        for policy in policies:
            if policy == name or policy.startswith(f"{name}+"):
                return policy
    return next(iter(policies), None)


def leaderboard(results: Results, command: str = "") -> dict[str, Any]:
    """Everything that the tables and figures show, from the finished lines in the plan's order.

    Parameters
    ----------
    command
        The command that made the results, for the first line of the page.

    Raises
    ------
    ValueError
        if policies that are compared have not run the same seeds.
    """
    groups = grouped(results.ordered())
    reference = reference_of(list(groups))
    cells = [
        {
            "policy": policy,
            "task": stratum[0],
            "disturbance": stratum[1],
            "sweep": stratum[2],
            "privileged": lines[0]["privileged"],
            "overrides": lines[0].get("overrides", {}),
            **cell_table(lines),
        }
        for policy, strata in groups.items()
        for stratum, lines in strata.items()
    ]
    policies = [
        policy_table(policy, groups[policy], groups[reference] if reference else {})
        for policy in groups
    ]
    policies.sort(key=lambda row: -row["score"]["iqm"])
    return {
        "command": command,
        "reference": reference,
        "plan": json.loads((results.folder / PLAN_FILE).read_text(encoding="utf-8")),
        "policies": policies,
        "cells": cells,
        "profiles": {policy: profile(strata) for policy, strata in groups.items()},
        "comparisons": comparisons(groups, [row["policy"] for row in policies]),
        "compared_by": PAIRED,
        "breaking_points": breaking_points(results, cells),
    }


def cell_table(lines: list[Line]) -> dict[str, Any]:
    """Summary of the runs of one policy in one stratum."""
    runs = len(lines)
    lost = sum(any(robot["lost"] for robot in line["robots"]) for line in lines)
    touched = sum(any(robot["touched"] for robot in line["robots"]) for line in lines)
    table: dict[str, Any] = {
        "runs": runs,
        "lost": rate(lost, runs),
        "touched": rate(touched, runs),
        "success": rate(runs - failures(lines), runs),
    }
    for metric in (
        "position_rmse_mm",
        "settled_formation_rmse_mm",
        "error_capped_mean_mm",
        "torque_rms_Nmm",
    ):
        table[metric] = median([worst(line, metric) for line in lines])
    scores = np.array([run_score(line) for line in lines])
    table["score"] = {
        "iqm": interquartile_mean(scores),
        "interval": interval(scores, interquartile_mean),
    }
    gains = [
        line["string"]["time_gain"] for line in lines if line["string"]["time_gain"] is not None
    ]
    table["string_time_gain"] = float(np.median(gains)) if gains else None
    return table


def policy_table(
    policy: str,
    strata: Strata,
    reference: Strata,
) -> dict[str, Any]:
    """One policy over all strata."""
    scores = [np.array([run_score(line) for line in group]) for group in strata.values()]
    theirs = [np.array([run_score(line) for line in group]) for group in reference.values()]
    base = pooled_iqm(*theirs) if theirs else math.nan
    better = [
        improvement(mine, other)
        for mine, other in zip(scores, theirs, strict=False)
        if len(mine) == len(other)
    ]
    lines = [line for group in strata.values() for line in group]
    own = pooled_iqm(*scores)
    return {
        "policy": policy,
        "privileged": any(line["privileged"] for line in lines),
        "overrides": {
            field: value for line in lines for field, value in line.get("overrides", {}).items()
        },
        "runs": len(lines),
        "failed": failures(lines),
        "score": {"iqm": own, "interval": stratified_interval(scores, pooled_iqm)},
        "normalised_score": own / base if base else None,
        "probability_of_improvement": float(np.mean(better)) if better else None,
        **({"step_ms": times} if (times := step_times(lines)) else {}),
    }


def profile(strata: Strata) -> list[float]:
    """Share of runs above each of :data:`PROFILE_SCORES`; every stratum has the same weight."""
    shares = [
        [(np.array([run_score(line) for line in lines]) > level).mean() for level in PROFILE_SCORES]
        for lines in strata.values()
    ]
    return np.mean(shares, axis=0).tolist()


def breaking_points(results: Results, cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Values of the swept knob at which a policy fails in 5 % and in 50 % of its runs; None if never.

    The values are visited outwards from the one nearest to the knob's nominal value, and interpolated.
    """
    if results.plan.sweep is None:
        return []
    nominals = {channel.path: channel.nominal for channel in CHANNELS}
    nominal = nominals.get(results.plan.sweep, 0.0)
    out = []
    for policy in results.plan.policies:
        for task, disturbance in results.plan.places:
            mine = [
                cell
                for cell in cells
                if (cell["policy"], cell["task"], cell["disturbance"])
                == (policy, task, disturbance)
            ]
            mine.sort(key=lambda cell: abs(cell["sweep"] - nominal))
            shares = [1 - cell["success"]["share"] for cell in mine]
            values = [cell["sweep"] for cell in mine]
            row: dict[str, Any] = {"policy": policy, "task": task, "disturbance": disturbance}
            for loss in LOSSES:
                row[f"loses_{100 * loss:g}_percent_at"] = crossing(values, shares, loss)
            out.append(row)
    return out


def write_leaderboard(
    results: Results,
    folder: Path,
    command: str,
    draw: Callable[[dict[str, Any], Path], Sequence[Path]] | None = None,
) -> dict[str, Any]:
    """Write ``leaderboard.json`` and ``leaderboard.md``; returns the content of the first.

    Parameters
    ----------
    draw
        Writes figures into the folder and returns their paths; the page shows them.

    Raises
    ------
    ValueError
        as :func:`leaderboard` does.
    """
    board = leaderboard(results, command)
    with atomic(folder / BOARD_FILE, encoding="utf-8") as file:
        json.dump(board, file, indent=1, allow_nan=False)
        file.write("\n")
    figures = [path.name for path in draw(board, folder)] if draw else []
    with atomic(folder / PAGE_FILE, encoding="utf-8") as file:
        file.write(markdown(board, figures))
    return board
