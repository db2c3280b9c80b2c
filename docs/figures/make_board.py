"""Write ``docs/leaderboard.md``, ``docs/leaderboard/`` and the README's tables from a benchmark's results.

``tlf bench --plan board --out results/board`` runs it; then call this as
``python docs/figures/make_board.py results/board``. It needs the extras ``bench`` and ``figures``.
The same results give the same files, byte for byte.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from baselines.benchmark.figures import write_bench_figures
from baselines.benchmark.page import markdown, number
from baselines.benchmark.plan import Episode, Plan
from baselines.benchmark.results import BOARD_FILE, PLAN_FILE, RUNS_FILE
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TELLING = ("nominal", "noise", "slip", "ice", "start", "combined-hard")  # shown in the README
TASK_NAMES = {"infinity": "∞", "flower": "Flower"}
BEGIN, END = "<!-- board -->", "<!-- end of board -->"
METRIC = "position_rmse_mm"

Board = dict[str, Any]
Line = dict[str, Any]


def read_results(folder: Path) -> tuple[Board, list[Line]]:
    """What ``tlf bench`` has written: the tables' numbers, and a line for each episode of the plan.

    Raises
    ------
    ValueError
        if a file is missing, episodes are missing, or the tables are of another plan.
    """
    hint = f"tlf bench --plan board --out {folder}"
    for name in (PLAN_FILE, RUNS_FILE, BOARD_FILE):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} has no {name}; run: {hint}")
    board = json.loads((folder / BOARD_FILE).read_text("utf-8"))
    made = json.loads((folder / PLAN_FILE).read_text("utf-8"))
    if board["plan"] != made or "comparisons" not in board:
        raise ValueError(f"{folder}/{BOARD_FILE} is not that of {PLAN_FILE}; run again: {hint}")
    texts = (folder / RUNS_FILE).read_text("utf-8").splitlines()
    lines = {Episode.of_line(line): line for line in map(json.loads, texts)}
    wanted = plan_of(board).episodes()
    missing = [episode for episode in wanted if episode not in lines]
    if missing:
        first = ", ".join(str(part) for part in missing[0] if part is not None)
        raise ValueError(
            f"{folder}: {len(missing)} of {len(wanted)} episodes are missing, the first {first}; "
            f"run again: {hint}"
        )
    return board, [lines[episode] for episode in wanted]


def plan_of(board: Board) -> Plan:
    """The plan that a leaderboard is of.

    Raises
    ------
    ValueError
        if a knob was swept.
    """
    told = board["plan"]["plan"]
    if told["sweep"] is not None:
        raise ValueError(f"a sweep of {told['sweep']} makes no leaderboard")
    return Plan(
        **{name: tuple(told[name]) for name in ("policies", "tasks", "disturbances", "seeds")},
        level=told["level"],
        overrides=tuple(tuple(pair) for pair in told["overrides"]),
    )


def slice_of(board: Board, lines: list[Line]) -> list[Line]:
    """An episode for each policy and task, at the first seed, over as many disturbances as there are.

    Tests run these again.
    """
    plan = plan_of(board)
    first = {
        (line["policy"], line["task"], line["disturbance"]): line
        for line in lines
        if line["seed"] == plan.seeds[0]
    }
    places = [(policy, task) for task in plan.tasks for policy in plan.policies]
    return [
        first[policy, task, plan.disturbances[k * len(plan.disturbances) // len(places)]]
        for k, (policy, task) in enumerate(places)
    ]


def failures(cell: dict[str, Any]) -> int:
    """Runs of a cell that fail."""
    return int(cell["runs"] - cell["success"]["count"])


def standing(cell: dict[str, Any]) -> tuple[int, float]:
    """What ranks policies in a cell, as shown: failures, then the error to a tenth of a millimetre."""
    error = cell[METRIC]["median"]
    return failures(cell), math.inf if error is None else round(error, 1)


def shown(cell: dict[str, Any], best: tuple[int, float]) -> str:
    """A cell of the README's table."""
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
    """Policies by score, against the disturbances that tell most."""
    plan = board["plan"]["plan"]
    columns = [name for name in TELLING if name in plan["disturbances"]]
    columns = columns or plan["disturbances"][: len(TELLING)]
    cells = {
        (cell["policy"], cell["disturbance"]): cell
        for cell in board["cells"]
        if cell["task"] == task
    }
    names = [row["policy"] for row in board["policies"]]
    best = {column: min(standing(cells[name, column]) for name in names) for column in columns}
    out = [
        f"| {TASK_NAMES.get(task, task)}, {load_scenario(task).robot_count} robots | "
        + " | ".join(columns)
        + " | score, all tasks |",
        "|---|" + "---:|" * (len(columns) + 1),
    ]
    for row in board["policies"]:
        name = row["policy"]
        told = [shown(cells[name, column], best[column]) for column in columns]
        out.append(f"| `{name}` | {' | '.join(told)} | {row['score']['iqm']:.1f} |")
    return "\n".join(out)


def readme_part(board: Board) -> str:
    """Everything between the README's markers."""
    plan = board["plan"]["plan"]
    first, end = plan["seeds"]
    horizon = dict(map(tuple, plan["overrides"])).get("horizon_s")
    length = "" if horizon is None else f" of {horizon:g} s"
    tables = "\n\n".join(readme_table(board, task) for task in plan["tasks"])
    return (
        f"The worst robot's position RMS in mm, median over {end - first} runs{length}; in brackets how "
        "many of them *fail* (a robot is lost or touches another), alone where half do. **Bold**: the "
        "fewest failures, then the smallest error. The score goes over all tasks and "
        f"{len(plan['disturbances'])} disturbances.\n\n"
        f"{tables}\n\n"
        "All disturbances, intervals, and the command that makes it: "
        "[docs/leaderboard.md](docs/leaderboard.md)."
    )


def with_part(
    text: str, part: str, begin: str = BEGIN, end: str = END, page: str = "README.md"
) -> str:
    """A page with what is between its markers made anew.

    Raises
    ------
    ValueError
        if it has not one of each marker, in their order.
    """
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(end) < text.index(begin):
        raise ValueError(f"{page} must have one line {begin!r} and, after it, one {end!r}")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{part}\n{end}{rest.split(end)[1]}"


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    with atomic(path, "wb") as file:
        file.write(text.encode())


def write_board(results: Path, root: Path = ROOT) -> None:
    """Write everything under ``root``, the checkout.

    Raises
    ------
    ValueError
        as :func:`read_results` and :func:`with_part` do, before anything is written.
    """
    board, lines = read_results(results)
    readme = with_part((root / "README.md").read_text("utf-8"), readme_part(board))
    folder = root / "docs" / "leaderboard"
    folder.mkdir(parents=True, exist_ok=True)
    figures = [f"leaderboard/{path.name}" for path in write_bench_figures(board, folder)]
    write_text(folder / BOARD_FILE, json.dumps(board, indent=1, allow_nan=False) + "\n")
    write_text(
        folder / "slice.jsonl", "".join(json.dumps(line) + "\n" for line in slice_of(board, lines))
    )
    write_text(folder.with_suffix(".md"), markdown(board, figures))
    write_text(root / "README.md", readme)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", type=Path, help="the folder that tlf bench has written")
    parser.add_argument("--root", type=Path, default=ROOT, help="write there instead")
    asked = parser.parse_args()
    try:
        write_board(asked.results, asked.root)
    except ValueError as error:
        sys.exit(f"make_board: {error}")


if __name__ == "__main__":
    main()
