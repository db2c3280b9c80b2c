"""The files of one run: summary, table and arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from baselines.runs.provenance import versions
from baselines.runs.run import RECORDED, Record
from tlf_env.common.files import atomic


def summary(record: Record) -> dict[str, Any]:
    """What ``summary.json`` holds."""
    return {
        "scenario": record.scenario.model_dump(mode="json"),
        "seed": record.seed,
        "reset_options": record.options,
        "policy": record.policy,
        "privileged": record.scenario.privileged,
        "settle_s": record.scenario.settle_s,
        "versions": versions(),
        "string": record.string()._asdict(),
        "robots": {f"robot_{i}": metrics._asdict() for i, metrics in enumerate(record.metrics())},
    }


def arrays(record: Record) -> dict[str, np.ndarray]:
    """What ``trajectory.npz`` and ``trajectory.mat`` hold.

    ``t_s`` (time,), ``leader_reference_mm`` (time, 2), and each column (time, robot). If the world has things
    to push or moving obstacles, also ``objects`` (time, object, 3): their x and y (mm) and angle (rad), the
    pushables first, each kind in the order of the scenario.
    """
    out = {"t_s": record.t_s, "leader_reference_mm": record.leader, **record.columns}
    return out if record.objects is None else {**out, "objects": record.objects}


def write_record(record: Record, folder: Path) -> list[Path]:
    """Write ``summary.json``, ``trajectory.npz`` and ``trajectory.csv``, each atomically.

    The table has a row for each time and robot, and the columns of a record.
    """
    paths = [folder / name for name in ("summary.json", "trajectory.npz", "trajectory.csv")]
    with atomic(paths[0], encoding="utf-8") as file:
        json.dump(summary(record), file, indent=2, allow_nan=False)
        file.write("\n")
    with atomic(paths[1], "wb") as file:
        columns: dict[str, Any] = arrays(record)
        np.savez_compressed(file, **columns)
    table = np.stack([record[name] for name in RECORDED], axis=-1).reshape(-1, len(RECORDED))
    times = np.repeat(record.t_s, record.robots)
    numbers = np.tile(np.arange(record.robots), len(record.t_s))
    with atomic(paths[2], encoding="utf-8") as file:
        file.write(",".join(("t_s", "robot", *RECORDED)) + "\n")
        rows = np.column_stack([times, numbers, table])
        np.savetxt(file, rows, fmt=["%.6g", "%d", *["%.9g"] * len(RECORDED)], delimiter=",")
    return paths


def write_mat(record: Record, folder: Path) -> Path:
    """Write ``trajectory.mat`` (MATLAB 5 format): the :func:`arrays` of the run."""
    from scipy.io import savemat

    path = folder / "trajectory.mat"
    with atomic(path, "wb") as file:
        savemat(file, arrays(record))
    return path
