"""The results on the test set as a Markdown page and as files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from baselines.benchmark.page import number, policy_label, span, time_table
from baselines.benchmark.results import BOARD_FILE, PAGE_FILE, Results
from baselines.benchmark.testset_score import CAP_MM, LEAST_MM, board_of_test
from tlf_env.common.files import atomic


def write_test_board(results: Results, folder: Path, command: str = "") -> dict[str, Any]:
    """Write ``leaderboard.json`` and ``leaderboard.md`` of the test set; returns the content of the first."""
    board = board_of_test(results, command)
    with atomic(folder / BOARD_FILE, encoding="utf-8") as file:
        json.dump(board, file, indent=1, allow_nan=False)
        file.write("\n")
    with atomic(folder / PAGE_FILE, encoding="utf-8") as file:
        file.write(markdown(board))
    return board


def markdown(board: dict[str, Any]) -> str:
    """The tables as Markdown."""
    first, end = board["cases"]
    which = (
        "the published cases"
        if board["published"]
        else f"cases of a test seed of its own, fingerprint `{board['fingerprint']}`"
    )
    parts = [
        "# Test set\n",
        f"Made by `{board['command']}`: test set version {board['version']}, {which}, {first} to {end - 1}. "
        "This version is frozen. Intervals are 95 % (shares: Wilson; the others: bootstrap over cases).\n",
        "## Score\n",
        "Geometric mean over the cases of the formation RMS of the worst robot, "
        f"{LEAST_MM:g} to {CAP_MM:g} mm, with {CAP_MM:g} mm for a failed run: less is better. The last four "
        "columns are medians over all cases: of the worst robot, energy of all robots together.\n",
        "| entry | score mm | interval | held | interval % | position RMS mm | time gap RMS s | "
        "torque RMS N·mm | energy J |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    parts += [
        f"| {policy_label(row)} | {row['score']['mm']:.2f} | {span(row['score']['interval'], 2)} | "
        f"{row['held']['count']} of {row['cases']} | {span([100 * x for x in row['held']['interval']], 0)} | "
        f"{number(row['position_rmse_mm']['median'], 1)} | {number(row['time_gap_rmse_s']['median'], 4)} | "
        f"{number(row['torque_rms_Nmm']['median'], 1)} | {number(row['energy_J']['median'], 1)} |"
        for row in board["entries"]
    ]
    parts += [
        "",
        "## Held by severity\n",
        "| entry | easiest third | middle third | hardest third |",
        "|---|---:|---:|---:|",
    ]
    parts += [
        f"| {policy_label(row)} | {' | '.join(_share(one) for one in row['held_by_severity'])} |"
        for row in board["entries"]
    ]
    parts += ["", *time_table(board["entries"]), *_differences(board), *_looks(board)]
    return "\n".join(parts)


def _share(found: dict[str, Any] | None) -> str:
    if found is None:
        return "–"
    ends = span([100 * x for x in found["interval"]], 0)
    return f"{100 * found['share']:.0f} % {ends}"


def _differences(board: dict[str, Any]) -> list[str]:
    """A row for each pair of entries."""
    if not board["differences"]:
        return []
    parts = [
        "## Differences, case by case\n",
        "Median of the differences of the errors of a case (first minus second), with the p-value of "
        "Wilcoxon's signed-rank test; cases that only one of both holds, with the p-value of the exact "
        "sign test. The p-values are not corrected for the number of rows.\n",
        "| first | second | difference mm | interval | p | held by the first only | by the second only | p |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in board["differences"]:
        error, held = row["error_mm"], row["held"]
        parts.append(
            f"| {row['policy']} | {row['other']} | {number(error['median'], 2)} | "
            f"{span(error['interval'], 2)} | {error['p']:.2g} | "
            f"{held['only'][0]} | {held['only'][1]} | {held['p']:.2g} |"
        )
    return [*parts, ""]


def _looks(board: dict[str, Any]) -> list[str]:
    """The looks at the published cases from this folder."""
    if not board["published"]:
        return []
    parts = [
        "## Looks\n",
        "Each run of the command on the published cases, from this folder.\n",
        "| date | version | cases | entries | simulation | revision |",
        "|---|---:|---|---|---|---|",
    ]
    parts += [
        f"| {look['date']} | {look['version']} | {look['cases'][0]} to {look['cases'][1] - 1} | "
        f"{', '.join(look['policies'])} | `{look['simulation']}` | {look['git_revision'] or '–'} |"
        for look in board["looks"]
    ]
    return [*parts, ""]
