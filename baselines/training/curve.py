"""The course of a training: rollouts, evaluations and time, kept in ``curve.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from baselines.runs.provenance import versions
from baselines.training.config import TrainConfig
from tlf_env.common.files import atomic

CURVE_FILE = "curve.json"


@dataclass
class TrainingProgress:
    """Time, rollouts and evaluations of a training so far; part of every checkpoint."""

    wall_time_s: float = 0.0
    processor_time_s: float = 0.0  # of all threads; other work on the machine does not count
    evaluated_at_s: list[float] = field(
        default_factory=list
    )  # processor time after each evaluation
    rollouts: list[dict[str, float]] = field(default_factory=list)
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    level_count: int = 1  # levels of the curriculum reached so far, the first of them included


def write_curve(
    folder: Path, config: TrainConfig, seed: int, progress: TrainingProgress
) -> dict[str, Any]:
    """Write ``curve.json``; returns its content."""
    curve = {
        "config": config.recorded,
        "seed": seed,
        "versions": versions(),
        **vars(progress),
    }
    with atomic(folder / CURVE_FILE, encoding="utf-8") as file:
        json.dump(curve, file, indent=1, allow_nan=False)
        file.write("\n")
    return curve


def kept_evaluation(curve: Mapping[str, Any]) -> dict[str, Any]:
    """The evaluation of the policy that was kept: the one with the smallest score."""
    kept: dict[str, Any] = min(curve["evaluations"], key=lambda one: one["score_mm"])
    return kept
