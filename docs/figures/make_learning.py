"""Write the tables of trainings and the learning curves of ``docs/learning.md``.

First run ``tlf train NAME --seeds 0,1,2`` of the shipped policies and ``tlf train NAME`` of the ladder, then
``python docs/figures/make_learning.py results/train/*``. This needs the extra ``figures``. The curves are
copied to ``docs/learning/``; without folders the script uses these copies. What the board says of the shipped
policies is read from ``docs/leaderboard/leaderboard.json``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
from make_board import METRIC, Board, failures, plan_of
from make_figures import BLUE, FOLDER, ORANGE, STYLE
from make_parts import put
from make_speed import table
from matplotlib.figure import Figure

from baselines.training.curve import kept_evaluation
from tlf_env.common.files import atomic

DOCS = FOLDER.parent
KEPT = DOCS / "learning"
SHIPPED = {"residual": BLUE, "from-nothing": ORANGE}  # and their colours
LADDER = (
    "ladder-1-point",
    "scratch",
    "ladder-3-slip",
    "ladder-4-start",
    "ladder-5-combined",
    "curriculum",
    "ladder-6-ice",
)
RIVALS = {
    "residual": "reference:linearised",  # its base
    "from-nothing": "adrc:searched+ekf-gyro-smoothed+grip",  # the fewest failures without learning
}
MILLION = 1e6

Curve = dict[str, Any]


def keep(folder: Path) -> None:
    """Copy the curves of all seeds of a training to ``docs/learning/``.

    Raises
    ------
    ValueError
        if the folder has no curves.
    """
    found = sorted(folder.glob("seed_*/curve.json"))
    if not found:
        raise ValueError(f"{folder} has no seed_N/curve.json; run tlf train first")
    for path in found:
        curve = json.loads(path.read_text("utf-8"))
        every = max(1, len(curve["rollouts"]) // 100)
        curve["rollouts"] = curve["rollouts"][every - 1 :: every]
        KEPT.mkdir(exist_ok=True)
        with atomic(KEPT / f"{folder.name}-{curve['seed']}.json", encoding="utf-8") as file:
            json.dump(curve, file, indent=None, separators=(",", ":"))
            file.write("\n")


def kept_curves() -> dict[str, list[Curve]]:
    """All copied curves by the name of their training."""
    curves: dict[str, list[Curve]] = {}
    for path in sorted(KEPT.glob("*-*.json")):
        name = path.stem.rpartition("-")[0]
        curves.setdefault(name, []).append(json.loads(path.read_text("utf-8")))
    return curves


def trainings(curves: dict[str, list[Curve]], names: Iterable[str]) -> str:
    """A table of trainings: one row per seed."""
    head = ["training", "seed", "score at the start", "kept", "failed", "at robot steps", "minutes"]
    rows = []
    for name in names:
        for curve in curves.get(name, []):
            first, last = curve["evaluations"][0], kept_evaluation(curve)
            runs = sum(cell["runs"] for cell in last["cells"].values())
            rows.append(
                [
                    f"`{name}`",
                    str(curve["seed"]),
                    f"{first['score_mm']:.2f} mm, {first['failed']} failed",
                    f"{last['score_mm']:.2f} mm",
                    f"{last['failed']} of {runs}",
                    f"{last['robot_steps'] / MILLION:.1f} M",
                    f"{curve['wall_time_s'] / 60:.1f}",
                ]
            )
    return table(head, rows)


def points(rows: list[dict[str, float]], name: str) -> tuple[list[float], list[float]]:
    """The robot steps of a curve's rows, in millions, and one of their numbers."""
    return [row["robot_steps"] / MILLION for row in rows], [row[name] for row in rows]


def draw_shipped(curves: dict[str, list[Curve]], path: Path) -> None:
    """Draw score and mean reward of the shipped policies' trainings against robot steps."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        for name, colour in SHIPPED.items():
            seeds = curves.get(name, [])
            for i, curve in enumerate(seeds):
                label = f"{name}, {len(seeds)} seeds" if i == 0 else None
                found = points(curve["evaluations"], "score_mm")
                left.plot(*found, ".-", color=colour, label=label)
                found = points(curve["rollouts"], "mean_reward")
                right.plot(*found, color=colour, label=label)
        left.set(
            xlabel="robot steps, millions", ylabel="score on validation seeds, mm", yscale="log"
        )
        right.set(xlabel="robot steps, millions", ylabel="mean reward of a robot and step")
        left.legend()
        figure.savefig(path)


def draw_ladder(curves: dict[str, list[Curve]], path: Path) -> None:
    """Draw the score of every rung of the ladder against robot steps, a panel for each."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.8), layout="constrained")
        panels = figure.subplots(2, 4, sharex=True, sharey=True).ravel()
        for name, panel in zip(LADDER, panels, strict=False):
            for curve in curves.get(name, []):
                panel.plot(*points(curve["evaluations"], "score_mm"), ".-", color=BLUE)
            panel.set(title=name, yscale="log")
        panels[-1].set_axis_off()
        panels[-5].tick_params(labelbottom=True)  # the panel above it
        figure.supxlabel("robot steps, millions", fontsize="medium")
        figure.supylabel("score on validation seeds, mm", fontsize="medium")
        figure.savefig(path)


def verdicts(board: Board) -> str:
    """A table of each shipped policy against its rival, over all pairs of the board."""
    cells = {(cell["policy"], cell["task"], cell["disturbance"]): cell for cell in board["cells"]}
    places = plan_of(board).places
    columns = []
    for policy, rival in RIVALS.items():
        pairs = {place: (cells[policy, *place], cells[rival, *place]) for place in places}
        more = {place: failures(mine) - failures(other) for place, (mine, other) in pairs.items()}
        worse = [f"{', '.join(place)}: {n}" for place, n in more.items() if n > 0]
        medians = [[cell[METRIC]["median"] for cell in pair] for pair in pairs.values()]
        columns.append(
            [
                f"`{policy}`",
                f"`{rival}`",
                *(str(sum(failures(pair[k]) for pair in pairs.values())) for k in (0, 1)),
                f"{sum(n < 0 for n in more.values())} of {len(places)}",
                "; ".join(worse) or "none",
                f"{sum(mine < other for mine, other in medians)} of {len(places)}",
            ]
        )
    names = (
        "policy",
        "rival",
        "failed runs of the policy",
        "of the rival",
        "fewer failed runs in",
        "more failed runs in",
        "smaller median error in",
    )
    head, *rows = [list(row) for row in zip(names, *columns, strict=True)]
    return table(head, rows)


def main(folders: list[str]) -> None:
    """Copy the curves of the folders, then write tables and figures from all copies."""
    for folder in folders:
        keep(Path(folder))
    curves = kept_curves()
    draw_shipped(curves, KEPT / "curves.png")
    draw_ladder(curves, KEPT / "ladder.png")
    page = DOCS / "learning.md"
    put(page, trainings(curves, SHIPPED), "trainings")
    put(page, trainings(curves, LADDER), "ladder")
    board = json.loads((DOCS / "leaderboard" / "leaderboard.json").read_text("utf-8"))
    put(page, verdicts(board), "verdicts")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except ValueError as error:
        sys.exit(str(error))
