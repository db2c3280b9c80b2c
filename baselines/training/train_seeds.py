"""Several training seeds at once, on this machine or on a Ray cluster."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from baselines.policies.card import CARD
from baselines.runs.jobs import spread
from baselines.runs.jsonl import append_line
from baselines.training.config import TrainConfig
from baselines.training.curve import kept_evaluation
from baselines.training.train import POLICY_FILE, check_folder, train
from tlf_env.common.files import atomic

STEPS_FILE = "robot_steps"  # holds the robot steps that a training has done
EVALUATIONS_FILE = "evaluations.jsonl"  # a line for each evaluation of a training, as it learns


class SharedByAllSeeds(NamedTuple):
    """Settings that the trainings of all seeds share."""

    config: TrainConfig
    folder: Path
    command: str
    threads: int


def train_seeds(
    config: TrainConfig,
    seeds: Sequence[int],
    folder: Path,
    *,
    processes: int = 1,
    ray_address: str | None = None,
    command: str = "",
    progress: Callable[[int, int], None] | None = None,
    evaluated: Callable[[int, dict[str, Any]], None] | None = None,
) -> list[dict[str, Any]]:
    """Train with several seeds, each in ``folder/seed_N``; the best policy goes to ``folder``.

    Parameters
    ----------
    processes
        Seeds at a time on this machine; they share its cores.
    progress
        Called with the robot steps done over all seeds, and their total.
    evaluated
        Called with a seed and each of its evaluations, as it learns.

    Returns
    -------
    list
        What :func:`baselines.training.train.train` returns, in the order of the seeds.

    Raises
    ------
    ValueError
        as :func:`baselines.training.train.train` does; if no Ray cluster is at the address.
    KeyboardInterrupt
        after an interrupt, once all trainings have written their checkpoints.
    """
    places = {seed: folder / f"seed_{seed}" for seed in seeds}
    for seed, place in places.items():  # before any training starts
        check_folder(config, seed, place)
    total = config.robot_steps * len(places)

    seen = {seed: len(_evaluations(place)) for seed, place in places.items()}  # of earlier calls

    def report() -> None:
        if progress is not None:
            progress(sum(_steps_done(place) for place in places.values()), total)
        for seed, place in places.items():
            for one in _evaluations(place)[seen[seed] :]:
                seen[seed] += 1
                if evaluated is not None:
                    evaluated(seed, one)

    def train_and_report(shared: SharedByAllSeeds, seed: int) -> dict[str, Any]:
        return _train_one(shared, seed, report)

    elsewhere = ray_address is not None or processes > 1
    threads = 1 if ray_address else max(1, (os.cpu_count() or 1) // processes)
    curves = {}
    for curve in spread(
        _train_one if elsewhere else train_and_report,
        SharedByAllSeeds(config, folder, command, threads),
        list(places),
        processes=processes,
        ray_address=ray_address,
        meanwhile=report,
    ):
        curves[curve["seed"]] = curve
    report()
    best = min(curves, key=lambda seed: kept_evaluation(curves[seed])["score_mm"])
    for name in (POLICY_FILE, str(Path(POLICY_FILE).with_suffix(CARD))):
        with atomic(folder / name, "wb") as file:
            file.write((places[best] / name).read_bytes())
    return [curves[seed] for seed in seeds]


def _train_one(
    shared: SharedByAllSeeds, seed: int, report: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """One seed; its progress is kept in a file, which other processes and machines can read."""
    folder = shared.folder / f"seed_{seed}"

    def progress(done: int, total: int) -> None:
        with atomic(folder / STEPS_FILE, durable=False) as file:
            file.write(f"{done}\n")
        report()

    def evaluated(one: dict[str, Any]) -> None:
        append_line(folder / EVALUATIONS_FILE, one)
        report()

    return train(
        shared.config,
        seed,
        folder,
        command=shared.command,
        threads=shared.threads,
        progress=progress,
        evaluated=evaluated,
    )


def _evaluations(place: Path) -> list[dict[str, Any]]:
    """The evaluations of a training so far; of a line that is being written nothing."""
    try:
        text = (place / EVALUATIONS_FILE).read_text(encoding="utf-8")
    except OSError:
        return []
    whole = map(json.loads, text[: text.rfind("\n") + 1].splitlines())
    # An evaluation after the last checkpoint is repeated when the training goes on.
    return list({one["robot_steps"]: one for one in whole}.values())


def _steps_done(folder: Path) -> int:
    try:
        return int((folder / STEPS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return 0
