"""``tlf train``: the trainings, what they show as they learn, and what to do with the policy."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from baselines.commands.compile import compile_before_first_run
from baselines.console import (
    notes,
    progress_bar,
    screen,
    warn_of_scenarios,
    writable_folder,
)
from baselines.runs.provenance import command_line
from baselines.tables import training_table
from baselines.training.config import TrainConfig
from baselines.training.curve import kept_evaluation
from baselines.training.scoring import overall_mm, score_default
from baselines.training.search import FOUND_FILE, Trained, run_search, search_of
from baselines.training.train import POLICY_FILE
from baselines.training.train_seeds import train_seeds
from tlf_env.common.files import atomic, read_json
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER

DEFAULT_FILE = "default.json"  # score of the default system in the evaluation of the training


def train_command(
    config: TrainConfig,
    name: str,
    seeds: Sequence[int],
    *,
    out: Path | None,
    processes: int,
    ray: str | None,
    as_json: bool,
) -> None:
    """Train with several seeds, and print each evaluation, the table, and what comes next.

    Raises
    ------
    ValueError
        as :func:`~baselines.training.train_seeds.train_seeds`.
    """
    folder = writable_folder(out or Path("results/train") / name)
    warn_of_scenarios(config.named_scenarios())
    compile_before_first_run()
    rival = default_score(config, folder)
    notes.print(
        f"The default system in the same evaluation: {said(rival)}. Less is better; a failed run counts as "
        "1000 mm.",
        soft_wrap=True,
    )

    def evaluated(seed: int, one: dict[str, Any]) -> None:
        steps = f"{one['robot_steps'] / 1e6:.2f} M robot steps"
        notes.print(
            f"seed {seed}, {steps}: {said(one)} (default: {rival['score_mm']:.2f} mm)",
            soft_wrap=True,
        )

    with progress_bar(f"train {name}") as update:
        curves = train_seeds(
            config,
            seeds,
            folder,
            processes=min(processes, len(seeds)),
            ray_address=ray,
            command=command_line(sys.argv[1:]),
            progress=update,
            evaluated=evaluated,
        )
    if as_json:
        rows = [
            {
                "seed": curve["seed"],
                "start": curve["evaluations"][0],
                "kept": kept_evaluation(curve),
            }
            for curve in curves
        ]
        typer.echo(json.dumps(rows, indent=1, allow_nan=False))
        return
    screen.print(training_table(curves))
    screen.print(
        f"In {folder}: policy.safetensors and policy.json of the best seed, seed_N of each seed"
    )
    for line in next_commands(config, folder):
        screen.print(line, soft_wrap=True)


def search_command(
    config: TrainConfig,
    name: str,
    *,
    out: Path | None,
    processes: int,
    ray: str | None,
    as_json: bool,
) -> None:
    """Search for better numbers of a training, and print each trial, the finalists and what comes next.

    Raises
    ------
    ValueError
        as :func:`~baselines.training.search.run_search`.
    """
    search = search_of(config)
    folder = writable_folder(out or Path("results/search") / name)
    warn_of_scenarios(config.named_scenarios())
    compile_before_first_run()

    def finished(outcome: Trained, values: Mapping[str, Any]) -> None:
        state = "stopped at " if outcome.stopped else ""
        notes.print(
            f"trial {outcome.number}: {state}{outcome.score_mm:.2f} mm ({worded(values)})",
            soft_wrap=True,
        )

    with progress_bar(f"search {name}") as update:
        found = run_search(
            config,
            folder,
            processes=processes,
            ray_address=ray,
            command=command_line(sys.argv[1:]),
            progress=update,
            finished=finished,
        )
    if as_json:
        typer.echo(json.dumps(found, indent=1, allow_nan=False))
        return
    seeds = ", ".join(map(str, search.choose_seeds))
    screen.print(f"Trials: {found['trials']}, of which {found['stopped']} were stopped. Finalists:")
    for one in found["finalists"]:
        start = " (the file itself)" if one["trial"] == 0 else ""
        screen.print(
            f"  trial {one['trial']}{start}: {one['choose_mm']:.2f} mm with the training seeds {seeds}, "
            f"{one['search_mm']:.2f} mm in the search; {worded(one['values'])}",
            soft_wrap=True,
        )
    screen.print(f"In {folder}: {FOUND_FILE}; train with it:")
    screen.print(
        f"  tlf train {shlex.quote(str(folder / FOUND_FILE))} --seeds 0,1,2", soft_wrap=True
    )


def worded(values: Mapping[str, Any]) -> str:
    """Values by path, in one line."""
    return ", ".join(f"{path} {value}" for path, value in values.items())


def default_score(config: TrainConfig, folder: Path) -> dict[str, Any]:
    """Score and failures of the default system, from the folder if they are known there."""
    path = folder / DEFAULT_FILE
    asked = config.evaluation.model_dump(mode="json")
    if path.exists():
        try:
            found = dict(read_json(path))
        except (ValueError, TypeError):
            found = {}
        if found.get("evaluation") == asked:
            return found
    scores = score_default(config)
    found = {
        "evaluation": asked,
        "score_mm": overall_mm(scores),
        "failed": sum(one.failed for one in scores.values()),
        "runs": sum(one.runs for one in scores.values()),
    }
    with atomic(path, encoding="utf-8") as file:
        json.dump(found, file, indent=1)
    return found


def said(one: dict[str, Any]) -> str:
    """A score with its failed runs, in words."""
    runs = one.get("runs") or sum(cell["runs"] for cell in one["cells"].values())
    return f"{one['score_mm']:.2f} mm, {one['failed']} of {runs} runs failed"


def next_commands(config: TrainConfig, folder: Path) -> list[str]:
    """How to drive the policy, to compare it with the default, and to see its curves."""
    policy = shlex.quote(str(folder / POLICY_FILE))
    task = next((name for name, own in config.tasks.items() if "base" not in own), "infinity")
    rival = f"reference:{DEFAULT_CONTROLLER}"
    return [
        "Drive it, compare it with the default, see its curves:",
        f"  tlf run {task} --policy {policy}",
        f"  tlf bench --policies {rival},{policy} --tasks {task} --disturbances nominal,slip,slip-noise,ice "
        "--horizon-s 60 --plant batch",
        f"  tensorboard --logdir {shlex.quote(str(folder))}",
    ]
