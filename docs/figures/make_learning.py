"""Write the table of trainings and the learning curves of ``docs/learning.md``.

First run ``tlf train NAME --seeds 0,1,2``, then
``python docs/figures/make_learning.py results/train/residual results/train/direct``. This needs the extra
``figures``. The curves are copied to ``docs/learning/``; without folders the script uses these copies.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib
from make_figures import BLUE, FOLDER, GREEN, GREY, ORANGE, STYLE
from make_speed import table
from matplotlib.figure import Figure

from baselines.training.curve import kept_evaluation
from tlf_env.common.files import atomic

DOCS = FOLDER.parent
KEPT = DOCS / "learning"
BEGIN, END = "<!-- trainings -->", "<!-- end of trainings -->"
COLOURS = {"residual": BLUE, "direct": ORANGE}
MILLION = 1e6
TICKS_MM = (2, 3, 5, 10, 20, 50)

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


def trainings(curves: dict[str, list[Curve]]) -> str:
    """The table of trainings: one row per seed."""
    head = ["training", "seed", "score at the start", "kept", "failed", "at robot steps", "minutes"]
    rows = []
    for name, seeds in curves.items():
        for curve in seeds:
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


def draw(curves: dict[str, list[Curve]], path: Path) -> None:
    """Draw the score on the validation seeds and the mean reward of the training against robot steps."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        for name, seeds in curves.items():
            colour = COLOURS.get(name, GREEN)
            for i, curve in enumerate(seeds):
                count = "1 seed" if len(seeds) == 1 else f"{len(seeds)} seeds"
                label = f"{name}, {count}" if i == 0 else None
                rows = curve["evaluations"]
                steps = [row["robot_steps"] / MILLION for row in rows]
                left.plot(steps, [row["score_mm"] for row in rows], ".-", color=colour, label=label)
                rows = curve["rollouts"]
                steps = [row["robot_steps"] / MILLION for row in rows]
                right.plot(steps, [row["mean_reward"] for row in rows], color=colour, label=label)
        start = next(iter(curves.get("residual", [])), None)
        if start is not None:
            left.axhline(
                start["evaluations"][0]["score_mm"], color=GREY, ls="--", label="tuned reference"
            )
        left.set(
            xlabel="robot steps, millions", ylabel="score on validation seeds, mm", yscale="log"
        )
        right.set(xlabel="robot steps, millions", ylabel="mean reward of a robot and step")
        left.set_yticks(TICKS_MM, [f"{tick:g}" for tick in TICKS_MM])
        left.minorticks_off()
        left.legend()
        figure.savefig(path)


def main(folders: list[str]) -> None:
    """Copy the curves of the folders, then write table and figure from all copies."""
    for folder in folders:
        keep(Path(folder))
    curves = kept_curves()
    draw(curves, KEPT / "curves.png")
    page = DOCS / "learning.md"
    text = page.read_text("utf-8")
    if BEGIN not in text or END not in text:
        raise ValueError(f"{page} lacks {BEGIN} or {END}")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    with atomic(page, encoding="utf-8") as file:
        file.write(f"{before}{BEGIN}\n{trainings(curves)}\n{END}{after}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except ValueError as error:
        sys.exit(str(error))
