"""Policies from raw sensors to wheel speeds: table and figure of *Raw sensors* in ``docs/learning.md``.

``python docs/figures/make_sensors.py`` drives every policy of ``results/train/sensors`` (made by
``tlf train sensors --seeds 0,1,2``) on seeds that nothing was tuned on, keeps what it finds in
``docs/learning/sensors.json`` by the digest of the policy's file, and makes table and figure; ``--kept`` makes
them from that file alone. The nominal ∞ has 100 runs, the other columns 30.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from make_algorithms import CELLS, MILLION, Entry, draw_scores, drive
from make_board import DOCS
from make_figures import BLUE, STYLE
from make_parts import put
from make_speed import table
from matplotlib.figure import Figure

from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.files import atomic

PAGE, RESULTS = DOCS / "learning.md", DOCS / "learning" / "sensors.json"
PICTURE = DOCS / "learning" / "sensors.png"
TRAINED = Path("results/train/sensors")
BOARD, ON_BOARD = Path("results/board-sensors/leaderboard.json"), "seed_0"  # and whose it is
DEFAULT = "reference:linearised"
NOMINAL, NOMINAL_RUNS, RUNS = "∞, nominal", 100, 30


def judged(policy: str) -> dict[str, Any]:
    """What :func:`make_algorithms.drive` finds in every column."""
    found = {}
    for head, (task, disturbance) in CELLS.items():
        count = NOMINAL_RUNS if head == NOMINAL else RUNS
        seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + count)
        found[head] = drive(policy, task, disturbance, seeds) | {"runs": count}
        print(policy, head, shown(found[head]), flush=True)
    return found


def of_training(folder: Path) -> dict[str, Any]:
    """Scores after the imitation and at the end, and the cost, from a training's curve."""
    curve = json.loads((folder / "curve.json").read_text(encoding="utf-8"))
    first, *_, last = curve["evaluations"]
    kept = min(curve["evaluations"], key=lambda one: one["score_mm"])
    return {
        "imitated_mm": first["score_mm"],
        "ended_mm": last["score_mm"],
        "course": [[one["robot_steps"], one["score_mm"]] for one in curve["evaluations"]],
        "kept_mm": kept["score_mm"],
        "kept_at": kept["robot_steps"],
        "minutes": curve["wall_time_s"] / 60,
    }


def on_board(leaderboard: dict[str, Any]) -> dict[str, Any]:
    """Score and failures of the policy on the benchmark's plan ``board``."""
    (mine,) = leaderboard["policies"]
    lost = {
        f"{one['task']}, {one['disturbance']}": one["lost"]["count"] for one in leaderboard["cells"]
    }
    return {"score": mine["score"], "runs": mine["runs"], "failed": mine["failed"], "lost": lost}


def shown(cell: dict[str, Any]) -> str:
    """Median of the runs that were held, and the failed ones in brackets."""
    first = FIRST_TABLE_SEED
    held = [mm for k, mm in enumerate(cell["rms_mm"], first) if k not in cell["failed"]]
    lost = len(cell["failed"])
    median = f"{np.median(held):.2f}" if held else "–"
    return f"{median} ({lost})" if lost else median


def keep(found: dict[str, Any]) -> None:
    """Write what was found."""
    with atomic(RESULTS, encoding="utf-8") as file:
        json.dump(found, file)


def judged_table(kept: dict[str, Any]) -> str:
    """A row for the default and one for each training seed."""
    rows = [["default", *(shown(kept[DEFAULT]["cells"][head]) for head in CELLS), "", "", ""]]
    for name, one in sorted(kept.items()):
        if name == DEFAULT:
            continue
        of = one["training"]
        rows.append(
            [
                name.replace("_", " "),
                *(shown(one["cells"][head]) for head in CELLS),
                f"{of['imitated_mm']:.1f}",
                f"{of['kept_mm']:.1f}",
                f"{of['minutes']:.0f}",
            ]
        )
    return table(["", *CELLS, "imitation", "kept", "minutes"], rows)


def draw(kept: dict[str, Any], path: Path) -> None:
    """Draw the score while PPO goes on after the imitation: median and range of the training seeds."""
    courses = np.array([one["training"]["course"] for one in kept.values() if "training" in one])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.2), layout="constrained")
        panel = figure.subplots()
        steps, scores = courses[0, :, 0], courses[:, :, 1]
        draw_scores(panel, steps / MILLION, scores, Entry("sensors", "PPO, `sensors`", BLUE))
        panel.set(
            xlabel="robot steps of PPO after the imitation, millions",
            ylabel="score on validation seeds, mm",
        )
        panel.set_ylim(bottom=0.0)
        panel.legend(fontsize="small")
        figure.savefig(path, dpi=110)


def main() -> None:
    """Drive what is new, and make the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--kept", action="store_true", help="make the table from the kept runs alone"
    )
    options = parser.parse_args()
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
    if not options.kept:
        if DEFAULT not in kept:
            kept[DEFAULT] = {"digest": "", "cells": judged(DEFAULT)}
        for folder in sorted(TRAINED.glob("seed_*")):
            path = folder / "policy.safetensors"
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            if kept.get(folder.name, {}).get("digest") != digest:
                kept[folder.name] = {"digest": digest, "cells": judged(str(path))}
            kept[folder.name]["training"] = of_training(folder)
            keep(kept)
        if BOARD.is_file():
            kept[ON_BOARD]["board"] = on_board(json.loads(BOARD.read_text(encoding="utf-8")))
            keep(kept)
    put(PAGE, judged_table(kept), "sensors")
    draw(kept, PICTURE)


if __name__ == "__main__":
    main()
