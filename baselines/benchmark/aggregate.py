"""Tables from finished episodes: rates, medians and interquartile means, each with an interval.

The statistics follow Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice", NeurIPS 2021: interquartile means, stratified bootstrap (seeds are resampled within each
task and disturbance), performance profiles, and the probability of improvement.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from arch.bootstrap import IIDBootstrap, IndependentSamplesBootstrap
from scipy.stats import binomtest

from baselines.benchmark.bench import Results
from baselines.policies.registry import overrides_told, policy_names
from tlf_env.common.files import atomic
from tlf_env.disturbances.channels import CHANNELS

REPEATS = 2000
LEVEL = 0.95
BOOTSTRAP_SEED = 20_000
PROFILE_SCORES = np.linspace(0, 100, 101)
REFERENCES = ("reference:consistent", "reference")  # the same policy
LOSSES = (0.05, 0.5)
COMPARED = {  # metric: how a policy is compared with its rival, both at the run's worst robot
    "position_rmse_mm": "difference",
    "error_capped_mean_mm": "difference",
    "torque_rms_Nmm": "ratio",
}

Stratum = tuple[str, str, float | None]  # task, disturbance, value of the swept knob


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half: SciPy's ``trim_mean(values, 0.25)``, which takes many times as long."""
    ordered = np.sort(values, axis=None)
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def interval(values: np.ndarray, statistic: Callable[..., Any]) -> list[float] | None:
    """Bootstrap interval of a statistic of one sample, None of fewer than two values."""
    if len(values) < 2:
        return None
    bootstrap = IIDBootstrap(values, seed=BOOTSTRAP_SEED)
    found = bootstrap.conf_int(statistic, REPEATS, method="percentile", size=LEVEL)
    return [float(found[0, 0]), float(found[1, 0])]


def stratified_interval(
    strata: Sequence[np.ndarray], statistic: Callable[..., Any]
) -> list[float] | None:
    """Bootstrap interval of a statistic of several samples, each resampled by itself."""
    if not strata or min(len(values) for values in strata) < 2:
        return None
    bootstrap = IndependentSamplesBootstrap(*strata, seed=BOOTSTRAP_SEED)
    found = bootstrap.conf_int(statistic, REPEATS, method="percentile", size=LEVEL)
    return [float(found[0, 0]), float(found[1, 0])]


def rate(events: int, runs: int) -> dict[str, Any]:
    """A share with its Wilson interval."""
    ends = binomtest(events, runs).proportion_ci(LEVEL, method="wilson")
    return {
        "count": events,
        "share": events / runs,
        "interval": [float(ends.low), float(ends.high)],
    }


def worst(line: dict[str, Any], metric: str) -> float | None:
    """A run's value of a metric at its worst robot; None if undefined for all."""
    values = [robot[metric] for robot in line["robots"] if robot[metric] is not None]
    return max(values, default=None)


def failed(line: dict[str, Any]) -> bool:
    """Whether a robot is lost or touches another."""
    return any(robot["lost"] or robot["touched"] for robot in line["robots"])


def median(values: Sequence[float | None]) -> dict[str, Any]:
    """Median of what is defined, with its interval; None if nothing is."""
    defined = np.array([value for value in values if value is not None])
    if not defined.size:
        return {"median": None, "interval": None}
    return {"median": _median(defined), "interval": interval(defined, _median)}


def run_score(line: dict[str, Any]) -> float:
    """A run's score: the mean over its robots, 0 to 100."""
    return float(np.mean([robot["score"] for robot in line["robots"]]))


def cell_table(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Summary of the runs of one policy in one stratum."""
    runs = len(lines)
    lost = sum(any(robot["lost"] for robot in line["robots"]) for line in lines)
    touched = sum(any(robot["touched"] for robot in line["robots"]) for line in lines)
    failures = sum(map(failed, lines))
    table: dict[str, Any] = {
        "runs": runs,
        "lost": rate(lost, runs),
        "touched": rate(touched, runs),
        "success": rate(runs - failures, runs),
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


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def stratum_of(line: dict[str, Any]) -> Stratum:
    """Task, disturbance and swept value of a line."""
    return line["task"], line["disturbance"], line["sweep"]


def leaderboard(results: Results, command: str = "") -> dict[str, Any]:
    """Everything that the tables and figures show, from the finished lines in the plan's order.

    Parameters
    ----------
    command
        What made the results, for the tables' first line.

    Raises
    ------
    ValueError
        if policies that are compared have not run the same seeds.
    """
    groups: dict[str, dict[Stratum, list[dict[str, Any]]]] = {}
    for line in results.ordered():
        groups.setdefault(line["policy"], {}).setdefault(stratum_of(line), []).append(line)
    reference = next((name for name in (*REFERENCES, *groups) if name in groups), None)
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
        "plan": json.loads((results.folder / "plan.json").read_text(encoding="utf-8")),
        "policies": policies,
        "cells": cells,
        "profiles": {policy: profile(strata) for policy, strata in groups.items()},
        "comparisons": comparisons(groups, [row["policy"] for row in policies]),
        "breaking_points": breaking_points(results, cells),
    }


def policy_table(
    policy: str,
    strata: dict[Stratum, list[dict[str, Any]]],
    reference: dict[Stratum, list[dict[str, Any]]],
) -> dict[str, Any]:
    """One policy over all strata."""
    scores = [np.array([run_score(line) for line in lines]) for lines in strata.values()]
    theirs = [np.array([run_score(line) for line in lines]) for lines in reference.values()]
    base = pooled_iqm(*theirs) if theirs else math.nan
    better = [
        improvement(mine, other)
        for mine, other in zip(scores, theirs, strict=False)
        if len(mine) == len(other)
    ]
    failures = [failed(line) for lines in strata.values() for line in lines]
    own = pooled_iqm(*scores)
    return {
        "policy": policy,
        "privileged": any(line["privileged"] for lines in strata.values() for line in lines),
        "overrides": {
            field: value
            for lines in strata.values()
            for line in lines
            for field, value in line.get("overrides", {}).items()
        },
        "runs": len(failures),
        "failed": sum(failures),
        "score": {"iqm": own, "interval": stratified_interval(scores, pooled_iqm)},
        "normalised_score": own / base if base else None,
        "probability_of_improvement": float(np.mean(better)) if better else None,
    }


def comparisons(
    groups: dict[str, dict[Stratum, list[dict[str, Any]]]], ranked: Sequence[str]
) -> list[dict[str, Any]]:
    """Entries against the best of the others, stratum by stratum, on the same seeds.

    Entries are the policies that do not come with the package by name, learned ones for example;
    where there is none, the first of ``ranked``. Their rival in a stratum is whichever of the
    others fails least there, and of those with as few failures the one whose median position RMS is
    least. It is chosen by what is compared, which favours the rival. A privileged policy is no
    rival.

    Raises
    ------
    ValueError
        if an entry and its rival have not run the same seeds.
    """
    known = ("reference", *policy_names())
    entries = [policy for policy in groups if policy not in known] or list(ranked[:1])
    others = [
        policy
        for policy, strata in groups.items()
        if policy not in entries
        and not any(line["privileged"] for lines in strata.values() for line in lines)
    ]
    rows = []
    for entry in entries:
        for stratum, lines in groups[entry].items():
            rivals = {name: groups[name][stratum] for name in others if stratum in groups[name]}
            if rivals:
                rival = min(rivals, key=lambda name: standing(rivals[name]))
                rows.append(comparison(lines, rivals[rival]))
    return rows


def standing(lines: Sequence[dict[str, Any]]) -> tuple[int, float]:
    """What ranks policies in a stratum, less being better: failures, then the median position RMS."""
    values = [worst(line, "position_rmse_mm") for line in lines]
    defined = [value for value in values if value is not None]
    return sum(map(failed, lines)), float(np.median(defined)) if defined else math.inf


def comparison(mine: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How a policy differs from a rival in one stratum.

    Raises
    ------
    ValueError
        if they have not run the same seeds.
    """
    other = {line["seed"]: line for line in theirs}
    if sorted(other) != sorted(line["seed"] for line in mine):
        place = ", ".join(str(part) for part in stratum_of(mine[0]) if part is not None)
        raise ValueError(
            f"{mine[0]['policy']} and {theirs[0]['policy']} have not run the same seeds of {place}"
        )
    pairs = [(line, other[line["seed"]]) for line in mine]
    task, disturbance, swept = stratum_of(mine[0])
    return {
        "policy": mine[0]["policy"],
        "rival": theirs[0]["policy"],
        "task": task,
        "disturbance": disturbance,
        "sweep": swept,
        "runs": len(pairs),
        "failed": [sum(map(failed, lines)) for lines in (mine, theirs)],
        **{
            metric: paired([(worst(a, metric), worst(b, metric)) for a, b in pairs], how)
            for metric, how in COMPARED.items()
        },
    }


def paired(values: Sequence[tuple[float | None, float | None]], how: str) -> dict[str, Any]:
    """Difference or ratio of two medians; its interval resamples pairs.

    None if no pair is defined, and for a ratio to what is 0.
    """
    whole = np.array([pair for pair in values if None not in pair], dtype=np.float64)
    if not whole.size or (how == "ratio" and not np.all(whole[:, 1] > 0)):
        return {how: None, "interval": None}
    statistic = {"difference": _median_difference, "ratio": _median_ratio}[how]
    return {how: statistic(whole), "interval": interval(whole, statistic)}


def _median_difference(pairs: np.ndarray) -> float:
    mine, theirs = np.median(pairs, axis=0)
    return float(mine - theirs)


def _median_ratio(pairs: np.ndarray) -> float:
    mine, theirs = np.median(pairs, axis=0)
    return float(mine / theirs)


def pooled_iqm(*strata: np.ndarray) -> float:
    """Interquartile mean of all values together."""
    return interquartile_mean(np.concatenate(strata))


def improvement(mine: np.ndarray, theirs: np.ndarray) -> float:
    """Probability that a run of mine scores higher than one of theirs; ties count half."""
    difference = mine[:, None] - theirs[None, :]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def profile(strata: dict[Stratum, list[dict[str, Any]]]) -> list[float]:
    """Share of runs above each of :data:`PROFILE_SCORES`, every stratum weighing the same."""
    shares = [
        [(np.array([run_score(line) for line in lines]) > level).mean() for level in PROFILE_SCORES]
        for lines in strata.values()
    ]
    return np.mean(shares, axis=0).tolist()


def breaking_points(results: Results, cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Where along a sweep a policy loses 5 % and 50 % of its runs, interpolated; None if it does not.

    A sweep is walked from the value nearest to the knob's nominal one outwards.
    """
    if results.plan.sweep is None:
        return []
    nominals = {channel.path: channel.nominal for channel in CHANNELS}
    nominal = nominals.get(results.plan.sweep, 0.0)
    out = []
    for policy in results.plan.policies:
        for task in results.plan.tasks:
            for disturbance in results.plan.disturbances:
                mine = [
                    cell
                    for cell in cells
                    if (cell["policy"], cell["task"], cell["disturbance"])
                    == (policy, task, disturbance)
                ]
                mine.sort(key=lambda cell: abs(cell["sweep"] - nominal))
                failed = [1 - cell["success"]["share"] for cell in mine]
                values = [cell["sweep"] for cell in mine]
                row: dict[str, Any] = {"policy": policy, "task": task, "disturbance": disturbance}
                for share in LOSSES:
                    row[f"loses_{100 * share:g}_percent_at"] = crossing(values, failed, share)
                out.append(row)
    return out


def crossing(values: Sequence[float], shares: Sequence[float], level: float) -> float | None:
    """The first value at which a share reaches a level, interpolated between neighbours."""
    for i, share in enumerate(shares):
        if share >= level:
            if i == 0:
                return float(values[0])
            part = (level - shares[i - 1]) / (share - shares[i - 1])
            return float(values[i - 1] + part * (values[i] - values[i - 1]))
    return None


def write_leaderboard(
    results: Results,
    folder: Path,
    command: str,
    draw: Callable[[dict[str, Any], Path], Sequence[Path]] | None = None,
) -> dict[str, Any]:
    """Write ``leaderboard.json`` and ``leaderboard.md``; returns what the first holds.

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
    with atomic(folder / "leaderboard.json", encoding="utf-8") as file:
        json.dump(board, file, indent=1, allow_nan=False)
        file.write("\n")
    figures = [path.name for path in draw(board, folder)] if draw else []
    with atomic(folder / "leaderboard.md", encoding="utf-8") as file:
        file.write(markdown(board, figures))
    return board


def markdown(board: dict[str, Any], figures: Sequence[str] = ()) -> str:
    """The tables as Markdown, and links to figures."""
    plan = board["plan"]["plan"]
    first, end = plan["seeds"]
    parts = [
        "# Leaderboard\n",
        f"Made by `{board['command']}`: seeds {first} to {end - 1}, the same draws for every policy. "
        "Intervals are 95 %, by stratified bootstrap (shares: Wilson). A run fails if a robot is lost or "
        "touches another. Definitions: `docs/metrics.md`, `docs/benchmark.md`.\n",
        "## Over all tasks and disturbances\n",
        "| policy | score (IQM) | interval | normalised | better than the reference | failed |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    parts += [
        f"| {title(row)} | {row['score']['iqm']:.1f} | {span(row['score']['interval'], 1)} | "
        f"{number(row['normalised_score'], 2)} | {number(row['probability_of_improvement'], 2)} | "
        f"{row['failed']} of {row['runs']} |"
        for row in board["policies"]
    ]
    parts.append("")
    parts += comparison_tables(board)
    tasks = dict.fromkeys(cell["task"] for cell in board["cells"])
    for task in tasks:
        parts += task_tables(board, task)
    if board["breaking_points"]:
        parts += [
            "## Where policies break\n",
            f"Value of `{plan['sweep']}` at which a policy fails in 5 % and in 50 % of its runs.\n",
            "| policy | task | disturbance | 5 % | 50 % |",
            "|---|---|---|---:|---:|",
        ]
        parts += [
            f"| {row['policy']} | {row['task']} | {row['disturbance']} | "
            f"{number(row['loses_5_percent_at'], 3)} | {number(row['loses_50_percent_at'], 3)} |"
            for row in board["breaking_points"]
        ]
        parts.append("")
    if figures:
        parts.append("## Figures\n")
        parts += [f"![{figure_title(name)}]({name})\n" for name in figures]
    return "\n".join(parts)


def figure_title(name: str) -> str:
    """What a figure shows, from its file's name: ``leaderboard/scores.png`` → ``Scores``."""
    return Path(name).stem.replace("_", " ").capitalize()


def comparison_tables(board: dict[str, Any]) -> list[str]:
    """Every entry against the best of the others: a sentence, and a row per task and disturbance."""
    parts = []
    for policy in dict.fromkeys(row["policy"] for row in board["comparisons"]):
        rows = [row for row in board["comparisons"] if row["policy"] == policy]
        parts += [
            f"## {policy} against the best of the others\n",
            "In each row against whichever of the others fails least there, then by its position RMS. "
            "Differences of medians over seeds (the entry's minus the rival's, worst robot; "
            "torque: their ratio); intervals resample seeds, of both policies together. "
            "**Bold**: the interval excludes no difference.\n",
            f"Position RMS: {verdict(rows)}.\n",
            "| task | disturbance | rival | failed | rival failed | position RMS, difference mm | "
            "capped mean, difference mm | torque RMS, ratio |",
            "|---|---|---|---:|---:|---:|---:|---:|",
        ]
        parts += [
            f"| {row['task']} | {stratum_name(row)} | {row['rival']} | {row['failed'][0]} of {row['runs']} | "
            f"{row['failed'][1]} of {row['runs']} | {compared(row['position_rmse_mm'], 2)} | "
            f"{compared(row['error_capped_mean_mm'], 2)} | {compared(row['torque_rms_Nmm'], 3)} |"
            for row in rows
        ]
        parts.append("")
    return parts


def stratum_name(row: dict[str, Any]) -> str:
    """A disturbance, with the value of a swept knob."""
    return row["disturbance"] + ("" if row["sweep"] is None else f" = {row['sweep']:g}")


def sign(found: dict[str, Any], equal: float) -> int:
    """Whether an interval lies below (-1) or above (1) what stands for no difference; else 0."""
    ends = found["interval"]
    if ends is None:
        return 0
    return int(ends[0] > equal) - int(ends[1] < equal)


def verdict(rows: Sequence[dict[str, Any]]) -> str:
    """In how many strata the position RMS is smaller, larger, or not told apart."""
    signs = [sign(row["position_rmse_mm"], 0.0) for row in rows]
    return (
        f"smaller in {signs.count(-1)} of {len(rows)} rows, larger in {signs.count(1)}, "
        f"not told apart in {signs.count(0)}"
    )


def compared(found: dict[str, Any], digits: int) -> str:
    """A difference or a ratio with its interval, bold if that excludes no difference."""
    ratio = "ratio" in found
    value = found["ratio" if ratio else "difference"]
    text = number(value, digits)
    if value is not None and value > 0 and not ratio:
        text = f"+{text}"
    if sign(found, 1.0 if ratio else 0.0):
        text = f"**{text}**"
    return f"{text} {span(found['interval'], digits)}".strip()


def task_tables(board: dict[str, Any], task: str) -> list[str]:
    """A table of one task: a row per disturbance and policy."""
    parts = [
        f"## {task}\n",
        "RMS: worst robot from 40 % of the horizon on, median over seeds; capped: mean of "
        "min(error, 500 mm) over the whole run.\n",
        "| disturbance | policy | lost | touched | position RMS mm | formation RMS mm | capped mean mm | "
        "torque RMS N·mm | score |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for cell in board["cells"]:
        if cell["task"] != task:
            continue
        figures = [
            f"{number(cell[metric]['median'], digits)} {span(cell[metric]['interval'], digits)}"
            for metric, digits in (
                ("position_rmse_mm", 1),
                ("settled_formation_rmse_mm", 1),
                ("error_capped_mean_mm", 1),
            )
        ]
        parts.append(
            f"| {stratum_name(cell)} | {title(cell)} | {cell['lost']['count']} of {cell['runs']} "
            f"{span([100 * x for x in cell['lost']['interval']], 0)} % | {cell['touched']['count']} | "
            f"{' | '.join(figures)} | {number(cell['torque_rms_Nmm']['median'], 1)} | "
            f"{cell['score']['iqm']:.1f} {span(cell['score']['interval'], 1)} |"
        )
    return [*parts, ""]


def title(row: dict[str, Any]) -> str:
    """A policy's name, with what it has otherwise than the scenario, and marked if given the truth."""
    marks = overrides_told(row.get("overrides", {}))
    marks += ["privileged"] if row["privileged"] else []
    return row["policy"] + (f" ({'; '.join(marks)})" if marks else "")


def span(ends: Sequence[float] | None, digits: int) -> str:
    """An interval in brackets."""
    return "" if ends is None else f"[{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def number(value: float | None, digits: int) -> str:
    """A number, or a dash."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
