"""Processor time from nothing to a policy of a stated quality: one training, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from baselines.runs.provenance import installed_versions
from tlf_env.common.errors import install_command

TRAINING = "scratch"  # from nothing, in minutes: docs/training.md
GOOD_MM = 1.0  # score of the evaluation that counts as trained: position RMS of the worst robot, nominal ∞
LEARNERS = ("stable-baselines3", "torch")


def trained_row(config: str = TRAINING, good_mm: float = GOOD_MM) -> dict[str, Any]:
    """Train with seed 0, and say when an evaluation first lost no run and had a score of at most ``good_mm``.

    Raises
    ------
    ValueError
        without stable-baselines3.
    OSError
        if the training fails, with its message.
    """
    if find_spec("stable_baselines3") is None:
        raise ValueError(f"--training needs stable_baselines3 ({install_command('train')})")
    with tempfile.TemporaryDirectory() as folder:
        words = ["train", config, "--seeds", "0", "--out", folder, "--json"]
        code = "import sys; sys.argv[0] = 'tlf'; from baselines.cli import main; main()"
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
        if done.returncode:
            raise OSError(f"tlf train {config}: {done.stderr.strip().splitlines()[-1]}")
        (curve,) = Path(folder).rglob("curve.json")
        return row_of(config, good_mm, json.loads(curve.read_text(encoding="utf-8")))


def row_of(config: str, good_mm: float, curve: Mapping[str, Any]) -> dict[str, Any]:
    """What the course of a training says; ``trained_s`` and ``robot_steps`` are None if it never got so far.

    Times are processor times of all threads from the making of its environments on, s, evaluations included.
    """
    when = zip(curve["evaluations"], curve["evaluated_at_s"], strict=True)
    good = [
        (one["robot_steps"], seconds)
        for one, seconds in when
        if one["failed"] == 0 and one["score_mm"] <= good_mm
    ]
    steps, seconds = good[0] if good else (None, None)
    last = curve["evaluations"][-1]
    return {
        "training": config,
        "good_mm": good_mm,
        "trained_s": None if seconds is None else round(seconds, 1),
        "robot_steps": steps,
        "whole_s": round(curve["processor_time_s"], 1),
        "whole_wall_s": round(curve["wall_time_s"], 1),
        "whole_robot_steps": last["robot_steps"],
        "last_mm": round(last["score_mm"], 3),
        "versions": installed_versions(LEARNERS),
    }
