"""Compare learning algorithms on one task: the table and the figure of *Algorithms* in ``docs/learning.md``.

First train, for example ``tlf train scratch --seeds 0,1,2``; then ``python docs/figures/make_algorithms.py``.
It needs the extra ``figures``. Every policy of :data:`ENTRIES` that is found in ``results/train`` drives
:data:`CELLS` on seeds that nothing was tuned on. What is found is kept in ``docs/learning/algorithms.json``
by the digest of the policy's file, so that a policy is driven only once; with more ``--runs`` only the others
are driven. An entry that was trained on another machine keeps its rows, and one without any training is left
out. Table and figure are made from that file alone (``--kept``).

To add an algorithm: a folder ``results/train/NAME/seed_N`` with ``policy.safetensors``, its card and
``curve.json`` for each training seed, and a line in :data:`ENTRIES`. Of the curve these are read: ``seed``;
``evaluations`` with ``robot_steps``, ``score_mm`` and ``failed``; ``wall_time_s``, or, if it is there,
``evaluated_at_s`` (:class:`baselines.training.curve.TrainingProgress`).
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from make_board import DOCS
from make_figures import BLUE, GREY, ORANGE, STYLE
from make_parts import put
from make_speed import table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario

PAGE, RESULTS, PICTURE = (
    DOCS / "learning.md",
    DOCS / "learning" / "algorithms.json",
    DOCS / "learning" / "algorithms.png",
)
TRAINED = Path("results/train")
POLICY_FILE, CARD_FILE, CURVE_FILE = "policy.safetensors", "policy.json", "curve.json"
DEFAULT = "reference:linearised"
HORIZON_S, RUNS = 60.0, 100
MILLION = 1e6


class Entry(NamedTuple):
    """A training of the comparison, by the name of its folder, and how it is drawn."""

    name: str
    label: str
    colour: str = GREY
    line: str = "-"


# The order of the rows. Those that were not trained are left out.
ENTRIES = (
    Entry("scratch", "PPO, `scratch`", BLUE, "-"),
    Entry("sac-scratch", "SAC, `sac-scratch`", ORANGE, "--"),
)
CELLS = {  # head of the column: task and disturbance
    "∞, nominal": ("infinity", "nominal"),
    "`slip`": ("infinity", "slip"),
    "`start`": ("infinity", "start"),
    "`ice`": ("infinity", "ice"),
    "`combined-hard`": ("infinity", "combined-hard"),
    "flower, nominal": ("flower", "nominal"),
}

Row = dict[str, Any]


def drive(policy: str, task: str, disturbance: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Position RMS of the worst robot, mm, of every run, and the seeds of the runs that failed."""
    scenario = load_scenario(task, disturbance=disturbance, horizon_s=HORIZON_S)
    fitted = fit_policy(policy, scenario)
    runs = [record.metrics() for record in run_seeds(fitted.scenario, fitted.policy, seeds)]
    return {
        "rms_mm": [round(max(robot.position_rmse_mm for robot in robots), 4) for robots in runs],
        "failed": [seed for seed, robots in zip(seeds, runs, strict=True) if failed(robots)],
    }


def judge(policy: str, seeds: range) -> dict[str, dict[str, Any]]:
    """The runs of a policy in all cells with some seeds."""
    found = {}
    for name, (task, disturbance) in CELLS.items():
        print(f"  {name}, seeds {seeds.start} to {seeds.stop - 1}", flush=True)
        found[name] = drive(policy, task, disturbance, seeds)
    return found


def about_training(curve: Mapping[str, Any]) -> Row:
    """Robot steps and minutes of a whole training, and its course: robot steps, score in mm, failed, minutes.

    The minutes are those of the processor, from the first evaluation on, so without the environments' making;
    if the curve has none, those of the clock, and none within the course.
    """
    evaluations = curve["evaluations"]
    times_s = curve.get("evaluated_at_s", [])
    if len(times_s) == len(evaluations):
        minutes = [round((time_s - times_s[0]) / 60, 3) for time_s in times_s]
        total = minutes[-1]
    else:
        minutes = [None] * len(evaluations)
        total = round(curve["wall_time_s"] / 60, 3)
    course = [
        [one["robot_steps"], round(one["score_mm"], 4), one["failed"], at]
        for one, at in zip(evaluations, minutes, strict=True)
    ]
    return {"robot_steps": evaluations[-1]["robot_steps"], "minutes": total, "course": course}


def finished(curve: Mapping[str, Any]) -> bool:
    """Whether a training has come to the robot steps of its configuration, if it has one."""
    wanted = curve.get("config", {}).get("robot_steps", 0)
    return bool(curve["evaluations"][-1]["robot_steps"] >= wanted)


def judged_anew(
    kept: Sequence[Row],
    trained: Path,
    runs: int,
    judge: Callable[[str, range], dict[str, dict[str, Any]]] = judge,
) -> list[Row]:
    """The rows of all entries, a row for each training seed; what was driven before is not driven again.

    A policy with fewer runs than asked for drives the others; its runs do not depend on one another.
    """
    before = {(row["name"], row["seed"]): row for row in kept}

    def judged(name: str, seed: int, policy: str, digest: str) -> Row:
        old = before.get((name, seed))
        cells: dict[str, dict[str, Any]] = {cell: {"rms_mm": [], "failed": []} for cell in CELLS}
        done = 0
        if old is not None and old["digest"] == digest:
            cells, done = old["cells"], old["runs"]
        if done < runs:
            print(policy, flush=True)
            more = judge(policy, range(FIRST_TABLE_SEED + done, FIRST_TABLE_SEED + runs))
            cells = {
                cell: {what: cells[cell][what] + more[cell][what] for what in cells[cell]}
                for cell in CELLS
            }
        return {
            "name": name,
            "seed": seed,
            "digest": digest,
            "runs": max(done, runs),
            "cells": cells,
        }

    rows = [judged(DEFAULT, 0, DEFAULT, DEFAULT)]
    for entry in ENTRIES:
        found = {seed: row for (name, seed), row in before.items() if name == entry.name}
        for path in (trained / entry.name).glob(f"seed_*/{POLICY_FILE}"):
            curve = json.loads((path.parent / CURVE_FILE).read_text("utf-8"))
            if not finished(curve):
                print(f"{path.parent}: the training is not finished, and is left out", flush=True)
                continue
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            card = json.loads((path.parent / CARD_FILE).read_text("utf-8"))
            about = {"algorithm": card["algorithm"], **about_training(curve)}
            seed = curve["seed"]
            found[seed] = judged(entry.name, seed, str(path), digest) | about
        rows += [found[seed] for seed in sorted(found)]
    return rows


def rows_of(rows: Sequence[Row], name: str) -> list[Row]:
    """The rows of an entry, one for each training seed."""
    return [row for row in rows if row["name"] == name]


def held_mm(row: Row, cell: str) -> list[float]:
    """Position RMS of the runs that did not fail, mm."""
    lost = set(row["cells"][cell]["failed"])
    return [
        rms
        for seed, rms in enumerate(row["cells"][cell]["rms_mm"], FIRST_TABLE_SEED)
        if seed not in lost
    ]


def median_mm(rows: Sequence[Row], cell: str) -> float:
    """Median over all rows' runs that did not fail, mm; not a number without any."""
    held = [rms for row in rows for rms in held_mm(row, cell)]
    return float(np.median(held)) if held else float("nan")


def failures(rows: Sequence[Row], cells: Sequence[str] = tuple(CELLS)) -> int:
    """How many runs of these cells failed."""
    return sum(len(row["cells"][cell]["failed"]) for row in rows for cell in cells)


def shown(rows: Sequence[Row], cell: str) -> str:
    """Text of a cell: the median, the range of the training seeds' medians, the failed runs in brackets."""
    lost = failures(rows, [cell])
    if 2 * lost >= sum(row["runs"] for row in rows):
        return f"({lost})"
    text = f"{median_mm(rows, cell):.2f}"
    if len(rows) > 1:
        each = [median_mm([row], cell) for row in rows]
        text += f" [{np.nanmin(each):.2f}–{np.nanmax(each):.2f}]"
    return f"{text} ({lost})" if lost else text


def judged_table(rows: Sequence[Row]) -> str:
    """A row for each entry: robot steps and minutes of a training, every cell, and all failures."""
    head = ["algorithm", "seeds", "robot steps", "minutes", *CELLS, "failed, all"]
    lines = []
    for name, label in ((DEFAULT, f"no learning: `{DEFAULT}`"), *(one[:2] for one in ENTRIES)):
        mine = rows_of(rows, name)
        if not mine:
            continue
        spent = ["–", "–", "–"]
        if "course" in mine[0]:
            steps = np.median([row["robot_steps"] for row in mine]) / MILLION
            spent = [
                str(len(mine)),
                f"{steps:.2g} M",
                f"{np.median([row['minutes'] for row in mine]):.1f}",
            ]
        runs = sum(row["runs"] for row in mine) * len(CELLS)
        all_failed = f"{failures(mine)} of {runs}"
        lines.append([label, *spent, *(shown(mine, cell) for cell in CELLS), all_failed])
    return table(head, lines)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the score against robot steps and against minutes: median and range of the training seeds."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.4), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for entry in ENTRIES:
            mine = rows_of(rows, entry.name)
            if not mine:
                continue
            count = min(len(row["course"]) for row in mine)
            course = np.array([row["course"][:count] for row in mine], dtype=np.float64)
            steps, scores, _, minutes = np.moveaxis(course, 2, 0)
            for panel, along in ((left, steps / MILLION), (right, minutes)):
                if np.isfinite(along).all():
                    draw_scores(panel, np.median(along, axis=0), scores, entry)
        left.set(
            xlabel="robot steps, millions", ylabel="score on validation seeds, mm", yscale="log"
        )
        right.set(xlabel="minutes of a core")
        left.legend(fontsize="small")
        figure.savefig(path, dpi=110)


def draw_scores(
    panel: Axes, along: np.ndarray, scores: np.ndarray, entry: Entry, marker: str = "."
) -> None:
    """Draw the scores of an entry's training seeds ``(seed, evaluation)``: median and range."""
    label = f"{entry.label.replace('`', '')}, {len(scores)} seed{'s' * (len(scores) > 1)}"
    panel.plot(
        along, np.median(scores, axis=0), entry.line, color=entry.colour, label=label, marker=marker
    )
    panel.fill_between(
        along, scores.min(axis=0), scores.max(axis=0), color=entry.colour, alpha=0.2, lw=0
    )


def main() -> None:
    """Judge what is new, and write the table and the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trained", type=Path, default=TRAINED, help="folder of the trainings")
    parser.add_argument("--runs", type=int, default=RUNS, help="of each cell and policy")
    parser.add_argument("--kept", action="store_true", help="drive nothing")
    given = parser.parse_args()
    rows = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else []
    if not given.kept:
        rows = judged_anew(rows, given.trained, given.runs)
        with atomic(RESULTS, encoding="utf-8") as file:
            json.dump(rows, file, separators=(",", ":"))
            file.write("\n")
    put(PAGE, judged_table(rows), "algorithms")
    draw(rows, PICTURE)


if __name__ == "__main__":
    main()
