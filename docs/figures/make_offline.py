"""Offline learning from the data of a good and a mediocre controller, against both and against imitation.

Writes ``docs/learning/offline.json``, and tables and figure of the section *Offline learning* of
``docs/learning.md``. It needs the extras ``train`` and ``data``. ``python docs/figures/make_offline.py`` makes
tables and figure from the file. Before that, in this order:

``data`` trains the mediocre controller and drives both, with noise on the actions of the mediocre one.

``train ARM`` trains the preset ``offline`` with some seeds: as it is (``offline``), or with α = 0, which is
imitation of the same data (``imitation``).

``judge`` runs the controllers and what was trained on seeds that nothing was tuned on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from make_algorithms import MILLION, Entry, draw_scores
from make_board import DOCS
from make_figures import BLUE, ORANGE, STYLE
from make_memory import difference, held_mm
from make_parts import put
from make_speed import table
from matplotlib.figure import Figure

from baselines.commands.export import export_command
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.training.config import TrainConfig, load_config
from baselines.training.curve import CURVE_FILE, kept_evaluation
from baselines.training.train import POLICY_FILE, train
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario

PAGE, RESULTS = DOCS / "learning.md", DOCS / "learning" / "offline.json"
PICTURE = DOCS / "learning" / "offline.png"
MADE = Path("results/offline")
GOOD, MEDIOCRE = "from-nothing", "mediocre"
MEDIOCRE_STEPS = 1_000_000  # of the training `from-nothing`, in place of 7.5 M
DISTURBANCES = "nominal,slip,start,ice,combined-hard"
DATA_TASKS, DATA_SEEDS, DATA_HORIZON_S = "infinity", "0:4", 60.0
NOISE = 0.3  # on the actions of the mediocre controller
DRAWN = (Entry("imitation", "imitation", ORANGE, "--"), Entry("offline", "TD3+BC", BLUE, "-"))
ARMS = {"imitation": 0.0, "offline": None}  # α; None: the preset's
HORIZON_S = 60.0
CELLS = (
    ("infinity", "nominal"),
    ("infinity", "slip"),
    ("infinity", "combined-hard"),
    ("flower", "nominal"),
    ("infinity", "start"),
    ("infinity", "ice"),
)


def make_data() -> None:
    """Train the mediocre controller, and drive both."""
    steps = {"robot_steps": MEDIOCRE_STEPS}
    train(load_config("from-nothing", **steps), 0, MADE / MEDIOCRE)
    for name, policy, noise in (
        ("good", GOOD, 0.0),
        ("mediocre", str(MADE / MEDIOCRE / POLICY_FILE), NOISE),
    ):
        export_command(
            DATA_TASKS,
            DISTURBANCES,
            policy,
            DATA_SEEDS,
            horizon_s=DATA_HORIZON_S,
            noise=noise,
            form="parquet",
            joint=False,
            name=name,
            out=MADE / "data",
            trust=False,
        )


def config_of(arm: str) -> TrainConfig:
    """The training of an arm."""
    config = load_config("offline")
    alpha = ARMS[arm]
    return config if alpha is None else config.with_values({"offline.alpha": alpha})


def judge(runs: int, rows: list[dict[str, Any]]) -> None:
    """Position RMS of the worst robot, mm, and failures, of every run of every policy; kept after each cell.

    Cells of which ``rows`` has as many runs already are not run again.
    """
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + runs)
    known = {row["cell"] for row in rows if len(row["rms_mm"]) == runs}
    rows = [row for row in rows if row["cell"] in known]
    arms = {GOOD: [GOOD], MEDIOCRE: [str(MADE / MEDIOCRE / POLICY_FILE)]}
    for arm in ARMS:
        arms[arm] = [str(one) for one in sorted((MADE / arm).glob(f"seed_*/{POLICY_FILE}"))]
    for task, disturbance in CELLS:
        print(task, disturbance, flush=True)
        if f"{task}, {disturbance}" in known:
            continue
        scenario = load_scenario(task, disturbance=disturbance, horizon_s=HORIZON_S, plant="batch")
        for arm, policies in arms.items():
            for number, name in enumerate(policies):
                policy, fitted, _ = fit_policy(name, scenario)
                records = [record.metrics() for record in run_seeds(fitted, policy, seeds)]
                worst = [max(one.position_rmse_mm for one in robots) for robots in records]
                rows.append(
                    {
                        "cell": f"{task}, {disturbance}",
                        "arm": arm,
                        "seed": number,
                        "rms_mm": [round(one, 4) for one in worst],
                        "failed": [bool(failed(robots)) for robots in records],
                    }
                )
        keep({"trainings": trainings(), "judged": rows})


def keep(found: dict[str, Any]) -> None:
    """Write what was found."""
    with atomic(RESULTS, encoding="utf-8") as file:
        json.dump(found, file, separators=(",", ":"))
        file.write("\n")


def trainings() -> list[dict[str, Any]]:
    """What each training kept, and how long it took."""
    rows = []
    for arm in ARMS:
        for number, path in enumerate(sorted((MADE / arm).glob(f"seed_*/{CURVE_FILE}"))):
            curve = json.loads(path.read_text("utf-8"))
            kept = kept_evaluation(curve)
            rows.append(
                {
                    "arm": arm,
                    "seed": number,
                    "minutes": round(curve["wall_time_s"] / 60, 1),
                    "score_mm": [round(one["score_mm"], 3) for one in curve["evaluations"]],
                    "kept_at": kept["robot_steps"],
                    "failed": kept["failed"],
                }
            )
    return rows


def judged_table(rows: list[dict[str, Any]]) -> str:
    """A row for each cell that was driven: medians and failed runs of the arms, and differences of the last."""
    out = []
    arms = (GOOD, MEDIOCRE, *ARMS)
    driven = {row["cell"] for row in rows}
    for task, disturbance in CELLS:
        if f"{task}, {disturbance}" not in driven:
            continue
        held = {arm: held_mm(rows, f"{task}, {disturbance}", arm) for arm in arms}
        line = [f"{'∞' if task == 'infinity' else task}, `{disturbance}`"]
        for arm in arms:
            lost = int(np.isnan(held[arm]).sum())
            shown = f"{np.nanmedian(held[arm]):.2f}" if lost < held[arm].size else "–"
            line.append(f"{shown} ({lost})" if lost else shown)
        for other in ("imitation", GOOD):
            found = difference(held["offline"], held[other])
            shown = f"{found.median:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"
            line.append(shown.replace("-", "−") if np.isfinite(found.median) else "–")
        out.append(line)
    head = ["", "good", "mediocre", "imitation", "TD3+BC", "TD3+BC − imitation", "TD3+BC − good"]
    return table(head, out)


def trained_table(rows: list[dict[str, Any]]) -> str:
    """A row for each training: score on the validation seeds, and time."""
    out = [
        [
            "TD3+BC" if row["arm"] == "offline" else "imitation",
            str(row["seed"]),
            f"{min(row['score_mm']):.2f} mm",
            str(row["failed"]),
            f"{row['kept_at'] / 1e6:.1f} M",
            f"{row['minutes']:.1f}",
        ]
        for row in rows
    ]
    return table(["training", "seed", "kept", "failed", "at steps drawn", "minutes"], out)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the score of each arm against the steps drawn: median and range of the training seeds."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.2), layout="constrained")
        panel = figure.subplots()
        every = config_of("offline").evaluation.every
        for entry in DRAWN:
            scores = np.array([row["score_mm"] for row in rows if row["arm"] == entry.name])
            draw_scores(panel, np.arange(scores.shape[1]) * every / MILLION, scores, entry)
        panel.set(
            xlabel="robot steps drawn from the data, millions",
            ylabel="score on validation seeds, mm",
            yscale="log",
        )
        panel.legend(fontsize="small")
        figure.savefig(path, dpi=110)


def train_arm(arm: str, seeds: Sequence[int]) -> None:
    """Train an arm with some seeds, one after another."""
    for seed in seeds:
        train(config_of(arm), seed, MADE / arm / f"seed_{seed}", evaluated=shown)


def shown(one: dict[str, Any]) -> None:
    """Print an evaluation."""
    print(one["robot_steps"], round(one["score_mm"], 3), one["failed"], flush=True)


def main() -> None:
    """Make what is asked for, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", help="data; train ARM; judge; nothing: the tables alone")
    parser.add_argument("--seeds", default="0,1,2", help="of the trainings")
    parser.add_argument("--runs", type=int, default=100, help="of each cell")
    parser.add_argument(
        "--more", action="store_true", help="go on with the cells that are not kept"
    )
    given = parser.parse_args()
    kept = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    match given.what:
        case ["data"]:
            make_data()
            return
        case ["train", arm] if arm in ARMS:
            train_arm(arm, [int(seed) for seed in given.seeds.split(",")])
            return
        case ["judge"]:
            judge(given.runs, kept.get("judged", []) if given.more else [])
            kept = json.loads(RESULTS.read_text("utf-8"))
        case []:
            pass
        case _:
            parser.error(f"{' '.join(given.what)!r} is none of data, train ARM, judge")
    put(PAGE, trained_table(kept["trainings"]), "offline trainings")
    put(PAGE, judged_table(kept["judged"]), "offline")
    draw(kept["trainings"], PICTURE)


if __name__ == "__main__":
    main()
