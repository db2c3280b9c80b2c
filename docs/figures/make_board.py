"""Write the pages of a leaderboard from benchmark results: whole systems, or controllers alone.

First run ``tlf bench --plan board --out results/board``, then
``python docs/figures/make_board.py results/board``: ``docs/leaderboard.md``, ``docs/leaderboard/``, the
README's tables and what ``tlf bench --check`` compares with. With ``controllers`` in place of ``board`` (and
``--board controllers``): ``docs/leaderboard-controllers.md`` and its folder. This needs the extras ``bench``
and ``figures``. The same results give the same files, byte for byte.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from baselines.benchmark.check import PUBLISHED
from baselines.benchmark.figures import write_bench_figures
from baselines.benchmark.page import markdown, number
from baselines.benchmark.plan import Episode, Plan
from baselines.benchmark.results import BOARD_FILE, PLAN_FILE, RUNS_FILE
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
README_TASKS = ("infinity", "flower")
README_DISTURBANCES = (
    "nominal",
    "noise",
    "slip",
    "slip-ramps",
    "slip-noise",
    "ice",
    "start",
    "combined-hard",
    "swell",
)
TASK_NAMES = {"infinity": "∞", "flower": "Flower"}
BOARDS = {"board": "leaderboard", "controllers": "leaderboard-controllers"}  # plan: page
BEGIN, END = "<!-- board -->", "<!-- end of board -->"
METRIC = "position_rmse_mm"

Board = dict[str, Any]
Line = dict[str, Any]


def read_results(folder: Path, plan: str = "board") -> tuple[Board, list[Line]]:
    """Read the output of ``tlf bench``: the leaderboard, and one line per episode of the plan.

    Raises
    ------
    ValueError
        if a file or an episode is missing, or the leaderboard belongs to another plan.
    """
    hint = f"tlf bench --plan {plan} --out {folder}"
    for name in (PLAN_FILE, RUNS_FILE, BOARD_FILE):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} has no {name}; run: {hint}")
    board = json.loads((folder / BOARD_FILE).read_text("utf-8"))
    made = json.loads((folder / PLAN_FILE).read_text("utf-8"))
    if board["plan"] != made or "comparisons" not in board:
        raise ValueError(f"{folder}/{BOARD_FILE} does not belong to {PLAN_FILE}; run again: {hint}")
    texts = (folder / RUNS_FILE).read_text("utf-8").splitlines()
    lines = {Episode.of_line(line): line for line in map(json.loads, texts)}
    wanted = plan_of(board).episodes()
    missing = [episode for episode in wanted if episode not in lines]
    if missing:
        first = ", ".join(str(part) for part in missing[0] if part is not None)
        raise ValueError(
            f"{folder}: {len(missing)} of {len(wanted)} episodes are missing, the first is {first}; "
            f"run again: {hint}"
        )
    return board, [lines[episode] for episode in wanted]


def plan_of(board: Board) -> Plan:
    """The plan of a leaderboard.

    Raises
    ------
    ValueError
        if the plan has a sweep.
    """
    plan = board["plan"]["plan"]
    if plan["sweep"] is not None:
        raise ValueError(f"sweep {plan['sweep']}: a leaderboard needs a plan without a sweep")
    return Plan(
        **{name: tuple(plan[name]) for name in ("policies", "tasks", "disturbances", "seeds")},
        level=plan["level"],
        also=tuple(tuple(pair) for pair in plan.get("also", ())),
        overrides=tuple(tuple(pair) for pair in plan["overrides"]),
    )


def slice_of(board: Board, lines: list[Line]) -> list[Line]:
    """One episode per policy and task, at the first seed, spread over the disturbances.

    Tests run these again.
    """
    plan = plan_of(board)
    first = {
        (line["policy"], line["task"], line["disturbance"]): line
        for line in lines
        if line["seed"] == plan.seeds[0]
    }
    rows = [(policy, task) for task in plan.tasks for policy in plan.policies]
    found = [
        first[policy, task, plan.disturbances[k * len(plan.disturbances) // len(rows)]]
        for k, (policy, task) in enumerate(rows)
    ]
    others = [
        first[plan.policies[k % len(plan.policies)], task, disturbance]
        for k, (task, disturbance) in enumerate(plan.also)
    ]
    return found + others


def failures(cell: dict[str, Any]) -> int:
    """Number of failed runs of a cell."""
    return int(cell["runs"] - cell["success"]["count"])


def standing(cell: dict[str, Any]) -> tuple[int, float]:
    """Sort key of a cell: failures, then the error rounded to 0.1 mm, as displayed."""
    error = cell[METRIC]["median"]
    return failures(cell), math.inf if error is None else round(error, 1)


def shown(cell: dict[str, Any], best: tuple[int, float]) -> str:
    """Text of a cell of the README's table."""
    failed, runs = failures(cell), cell["runs"]
    error = number(cell[METRIC]["median"], 1)
    if not failed:
        text = error
    elif 2 * failed < runs:
        text = f"{error} ({failed})"
    else:
        text = f"({failed})"
    return f"**{text}**" if standing(cell) == best and failed < runs else text


def readme_table(board: Board, task: str) -> str:
    """The README's table of a task: policies by failed runs, then by score, and selected disturbances."""
    plan = board["plan"]["plan"]
    columns = [name for name in README_DISTURBANCES if name in plan["disturbances"]]
    columns = columns or plan["disturbances"][: len(README_DISTURBANCES)]
    cells = {
        (cell["policy"], cell["disturbance"]): cell
        for cell in board["cells"]
        if cell["task"] == task
    }
    failed = {row["policy"]: 0 for row in board["policies"]}
    for cell in board["cells"]:
        failed[cell["policy"]] += failures(cell)
    names = list(failed)
    best = {column: min(standing(cells[name, column]) for name in names) for column in columns}
    out = [
        f"| {TASK_NAMES.get(task, task)}, {load_scenario(task).robot_count} robots | "
        + " | ".join(columns)
        + " | failed, all | score, all |",
        "|---|" + "---:|" * (len(columns) + 2),
    ]
    for row in sorted(board["policies"], key=lambda one: failed[one["policy"]]):  # stable
        name = row["policy"]
        texts = [shown(cells[name, column], best[column]) for column in columns]
        ends = f"{failed[name]} | {row['score']['iqm']:.1f}"
        out.append(f"| `{name}` | {' | '.join(texts)} | {ends} |")
    return "\n".join(out)


def readme_part(board: Board) -> str:
    """The text between the README's markers."""
    plan = board["plan"]["plan"]
    first, end = plan["seeds"]
    places = len(plan_of(board).places)
    horizon = dict(map(tuple, plan["overrides"])).get("horizon_s")
    length = "" if horizon is None else f" of {horizon:g} s"
    tasks = [task for task in README_TASKS if task in plan["tasks"]] or plan["tasks"]
    tables = "\n\n".join(readme_table(board, task) for task in tasks)
    return (
        f"Position RMS of the worst robot in mm, median over {end - first} runs{length}. In brackets: the "
        "number of *failed* runs (a robot is lost or touches another); if at least half fail, only this "
        f"number is given. **Bold**: fewest failures, then smallest error. *All*: the {places} pairs of task "
        f"and disturbance, {places * (end - first)} runs; the score is an interquartile mean from 0 to "
        "100, which hides failures. Rows: fewest failed runs first.\n\n"
        f"{tables}\n\n"
        "All disturbances, intervals, and the command that reproduces them: "
        "[docs/leaderboard.md](docs/leaderboard.md)."
    )


def with_part(
    text: str, part: str, begin: str = BEGIN, end: str = END, page: str = "README.md"
) -> str:
    """A page with the text between its markers replaced.

    Raises
    ------
    ValueError
        if the page does not contain each marker once, in order.
    """
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(end) < text.index(begin):
        raise ValueError(f"{page} must have one line {begin!r} and, after it, one {end!r}")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{part}\n{end}{rest.split(end)[1]}"


def write_text(path: Path, text: str) -> None:
    """Write a file atomically."""
    with atomic(path, "wb") as file:
        file.write(text.encode())


def write_board(results: Path, root: Path = ROOT, name: str = "board") -> None:
    """Write all pages of one of :data:`BOARDS` under ``root``, the checkout.

    Raises
    ------
    ValueError
        as in :func:`read_results` and :func:`with_part`, before any file is written.
    """
    board, lines = read_results(results, name)
    readme = (root / "README.md").read_text("utf-8")
    if name == "board":
        readme = with_part(readme, readme_part(board))
    folder = root / "docs" / BOARDS[name]
    folder.mkdir(parents=True, exist_ok=True)
    figures = [f"{folder.name}/{path.name}" for path in write_bench_figures(board, folder)]
    write_text(folder / BOARD_FILE, json.dumps(board, indent=1, allow_nan=False) + "\n")
    write_text(
        folder / "slice.jsonl", "".join(json.dumps(line) + "\n" for line in slice_of(board, lines))
    )
    write_text(folder.with_suffix(".md"), markdown(board, figures))
    if name == "board":
        write_text(root / "README.md", readme)
        write_text(root / PUBLISHED.relative_to(ROOT), published_part(board))


def published_part(board: Board) -> str:
    """What ``tlf bench --check`` compares with; it ships with the package."""
    part = {"plan": board["plan"]["plan"], "cells": board["cells"]}
    return json.dumps(part, separators=(",", ":"), allow_nan=False) + "\n"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", type=Path, help="output folder of tlf bench")
    parser.add_argument("--board", choices=BOARDS, default="board", help="which board")
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout to write to")
    options = parser.parse_args()
    try:
        write_board(options.results, options.root, options.board)
    except ValueError as error:
        sys.exit(f"make_board: {error}")


if __name__ == "__main__":
    main()
