"""The leaderboard as a Markdown page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from baselines.policies.registry import describe_overrides
from baselines.policies.systems import ESTIMATORS, parse_system

MOST_LATE = 0.01  # share of late steps of an entry in real time
# How `comparisons` are made; a leaderboard.json without the key `compared_by` has the second.
PAIRED, OF_MEDIANS = "Medians of the differences", "Differences of medians"

# In full in docs/benchmark.md and docs/metrics.md, which are not beside a user's results.
DEFINITIONS = (
    "## Definitions\n",
    "- Position RMS: root mean square of a robot's distance to its own reference, after the first 40 % of "
    "the run. Formation RMS: of its distance to the leader's path, one time gap later for each robot. "
    "Both of the worst robot of a run; median over seeds.",
    "- Capped mean: mean of the first distance over the whole run, counted as at most 500 mm, so that it "
    "is finite for a lost run.",
    "- Lost: the distance exceeded `lost_beyond_mm`, or was above 100 mm (RMS) in the last 30 % of the run.",
    "- Score of a robot: 100 times the mean over time of 1/(1 + formation error/10 mm), which counts as 0 "
    "once the robot is lost or has touched something. 100 is perfect; a constant error of 10 mm gives 50. "
    "The score of a run is the mean over its robots.",
    "- IQM: the mean of the middle half of the runs. Normalised: the IQM divided by that of the reference. "
    "Better than the reference: probability that a run scores higher than one of the reference; ties count "
    "half.\n",
)


def markdown(board: dict[str, Any], figures: Sequence[str] = ()) -> str:
    """The tables as Markdown, with links to the figures."""
    plan = board["plan"]["plan"]
    first, end = plan["seeds"]
    parts = [
        "# Leaderboard\n",
        f"Made by `{board['command']}`: seeds {first} to {end - 1}, the same draws for every policy. "
        "Intervals are 95 %, by stratified bootstrap (shares: Wilson). A run fails if a robot is lost or "
        "touches another.\n",
        "## Over all tasks and disturbances\n",
        "| policy | score (IQM) | interval | normalised | better than the reference | failed |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    parts += [
        f"| {policy_label(row)} | {row['score']['iqm']:.1f} | {span(row['score']['interval'], 1)} | "
        f"{number(row['normalised_score'], 2)} | {number(row['probability_of_improvement'], 2)} | "
        f"{row['failed']} of {row['runs']} |"
        for row in board["policies"]
    ]
    parts.append("")
    parts += time_table(board["policies"])
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
    parts += DEFINITIONS
    return "\n".join(parts)


def time_table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Time of a step of the entries that are processes of their own; nothing if there is none."""
    timed = [row for row in rows if "step_ms" in row]
    if not timed:
        return []
    return [
        "## Time per step\n",
        "From observations to actions, all robots of the row together, in ms: median over the runs of the "
        "median and of the 99 % quantile, and the largest of all. Real time: at most 1 % of the steps take "
        "longer than a control period.\n",
        "| policy | median | 99 % | largest | late % | real time |",
        "|---|---:|---:|---:|---:|---|",
        *(
            f"| {row['policy']} | {row['step_ms']['median']:.2f} | {row['step_ms']['p99']:.2f} | "
            f"{row['step_ms']['largest']:.1f} | {100 * row['step_ms']['late']:.2f} | "
            f"{'yes' if row['step_ms']['late'] <= MOST_LATE else 'no'} |"
            for row in timed
        ),
        "",
    ]


def figure_title(name: str) -> str:
    """A figure's title from its file name: ``leaderboard/scores.png`` → ``Scores``."""
    return Path(name).stem.replace("_", " ").capitalize()


def comparison_tables(board: dict[str, Any]) -> list[str]:
    """Each entry against the best other policy: a sentence, and a row per task and disturbance."""
    parts = []
    compared_by = board.get("compared_by", OF_MEDIANS)
    for policy in dict.fromkeys(row["policy"] for row in board["comparisons"]):
        rows = [row for row in board["comparisons"] if row["policy"] == policy]
        parts += [
            f"## {policy} against the best other policy\n",
            "The rival in each row is the other policy with the fewest failed runs there; among equals, the "
            f"one with the smallest median position RMS. {compared_by} over seeds (entry minus "
            "rival, worst robot; torque: ratio); intervals resample seeds, for both policies together. "
            "**Bold**: significant difference (the interval excludes 0, or a ratio of 1).\n",
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
    """-1 or 1 if the interval lies below or above the value ``equal`` (no difference); else 0."""
    ends = found["interval"]
    if ends is None:
        return 0
    return int(ends[0] > equal) - int(ends[1] < equal)


def verdict(rows: Sequence[dict[str, Any]]) -> str:
    """In how many strata the position RMS is smaller, larger, or not significantly different."""
    signs = [sign(row["position_rmse_mm"], 0.0) for row in rows]
    return (
        f"smaller in {signs.count(-1)} of {len(rows)} rows, larger in {signs.count(1)}, "
        f"no significant difference in {signs.count(0)}"
    )


def compared(found: dict[str, Any], digits: int) -> str:
    """A difference or a ratio with its interval, bold if the difference is significant."""
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
            f"| {stratum_name(cell)} | {policy_label(cell)} | {cell['lost']['count']} of {cell['runs']} "
            f"{span([100 * x for x in cell['lost']['interval']], 0)} % | {cell['touched']['count']} | "
            f"{' | '.join(figures)} | {number(cell['torque_rms_Nmm']['median'], 1)} | "
            f"{cell['score']['iqm']:.1f} {span(cell['score']['interval'], 1)} |"
        )
    return [*parts, ""]


def policy_label(row: dict[str, Any]) -> str:
    """A policy's name and the scenario fields that it sets; marked if privileged (uses the true state).

    What the estimator of a system sets is in its name.
    """
    system = parse_system(row["policy"])
    named = () if system is None else tuple(ESTIMATORS[system.estimator])
    overrides = row.get("overrides", {})
    marks = describe_overrides({key: overrides[key] for key in overrides if key not in named})
    marks += ["privileged"] if row["privileged"] else []
    return row["policy"] + (f" ({'; '.join(marks)})" if marks else "")


def span(ends: Sequence[float] | None, digits: int) -> str:
    """An interval in brackets."""
    return "" if ends is None else f"[{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def number(value: float | None, digits: int) -> str:
    """A number, or a dash."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
