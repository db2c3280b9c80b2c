"""The files of one run: summary, table and arrays."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from pydantic import ValidationError

from baselines.runs.folders import IDENTITY, INTERRUPTED, SUMMARY, WRITTEN, Identity
from baselines.runs.provenance import versions
from baselines.runs.run import RECORDED, Record
from baselines.runs.signals import OBSERVATION
from tlf_env.common.errors import install_command, one_line
from tlf_env.common.files import atomic, read_json
from tlf_env.task.scenario import Scenario

TRAJECTORY = "trajectory.npz"
# What NumPy and the reader of archives raise for a file that is none, or damaged.
BROKEN = (OSError, ValueError, EOFError, RuntimeError, BadZipFile, zlib.error)
ENDS = ("lost_at_s", "touched_at_s", "touched_by")  # arrays of a record, (robot,)


def summary(record: Record) -> dict[str, Any]:
    """What ``summary.json`` holds, besides its run's identity and files."""
    return {
        "scenario": record.scenario.model_dump(mode="json"),
        "seed": record.seed,
        "reset_options": record.options,
        "policy": record.policy,
        "privileged": record.scenario.privileged,
        "settle_s": record.scenario.settle_s,
        "simulated_s": float(record.t_s[-1]),
        INTERRUPTED: record.interrupted,
        "versions": versions(),
        "string": record.string()._asdict(),
        "robots": {f"robot_{i}": metrics._asdict() for i, metrics in enumerate(record.metrics())},
    }


def arrays(record: Record) -> dict[str, np.ndarray]:
    """What ``trajectory.npz`` and ``trajectory.mat`` hold.

    ``t_s`` (time,), ``leader_reference_mm`` (time, 2), and each column (time, robot). If the world has things
    to push or moving obstacles, also ``objects`` (time, object, 3): their x and y (mm) and angle (rad), the
    pushables first, each kind in the order of the scenario. ``lost_at_s``, ``touched_at_s`` (infinite if
    never) and ``touched_by``, a :class:`~tlf_env.TouchedBy`, are ``(robot,)``.
    """
    out = {
        "t_s": record.t_s,
        "leader_reference_mm": record.leader,
        **record.columns,
        **record.signals,
        **{name: getattr(record, name) for name in ENDS},
    }
    return out if record.objects is None else {**out, "objects": record.objects}


def table(record: Record, *, observations: bool) -> dict[str, np.ndarray]:
    """The columns of a run as one table with a row for each time and robot, each ``(time · robot,)``.

    Parameters
    ----------
    observations
        Whether the entries of the observations are among the columns.
    """
    columns = {
        name: values.ravel()
        for name, values in (record.columns | dict(record.signals)).items()
        if observations or not name.startswith(OBSERVATION)
    }
    return {
        "t_s": np.repeat(record.t_s, record.robots),
        "robot": np.tile(np.arange(record.robots), len(record.t_s)),
        **columns,
    }


def write_record(record: Record, folder: Path) -> list[Path]:
    """Write ``trajectory.npz`` and ``trajectory.csv``, each atomically.

    The CSV file has a row for each time and robot, and all columns but the observations.
    """
    paths = [folder / name for name in (TRAJECTORY, "trajectory.csv")]
    with atomic(paths[0], "wb") as file:
        columns: dict[str, Any] = arrays(record)
        np.savez_compressed(file, **columns)
    rows = table(record, observations=False)
    with atomic(paths[1], encoding="utf-8") as file:
        file.write(",".join(rows) + "\n")
        formats = ["%.6g", "%d", *["%.9g"] * (len(rows) - 2)]
        np.savetxt(file, np.column_stack(list(rows.values())), fmt=formats, delimiter=",")
    return paths


def read_record(folder: Path) -> Record:
    """The record of a finished run, from the files of its folder.

    Raises
    ------
    ValueError
        naming folder or file, if it is no folder of a run, or a file is broken or of an earlier version.
    """
    about = folder / SUMMARY
    if not about.is_file():
        raise ValueError(f"{folder} holds no run: there is no {SUMMARY} in it")
    written = read_json(about)
    path = folder / TRAJECTORY
    try:
        scenario = Scenario.model_validate(written["scenario"])
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
        ends = {name: found.pop(name) for name in ENDS}
        record = Record(
            scenario=scenario,
            seed=int(written["seed"]),
            policy=str(written["policy"]),
            t_s=found.pop("t_s"),
            leader=found.pop("leader_reference_mm"),
            objects=found.pop("objects", None),
            columns={name: found.pop(name) for name in RECORDED},
            signals=found,
            options=_options(written["reset_options"]),
            interrupted=bool(written[INTERRUPTED]),
            **ends,
        )
    except FileNotFoundError:
        raise ValueError(f"{folder} holds no run: there is no {TRAJECTORY} in it") from None
    except ValidationError as error:
        why = one_line(error, Scenario)
        raise ValueError(f"{folder}: a file of the run is broken: scenario.{why}") from None
    except (KeyError, TypeError, OverflowError) as error:
        raise ValueError(
            f"{folder}: {error} is missing or wrong; run it again with this version"
        ) from None
    except BROKEN as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{folder}: a file of the run is broken: {why}") from None
    _check_arrays(record, path)
    return record


def _options(found: Any) -> dict[str, Any] | None:
    if not isinstance(found, dict | None):
        raise TypeError("reset_options")
    return found


def _check_arrays(record: Record, path: Path) -> None:
    """Check types and shapes of a record's arrays.

    Raises
    ------
    ValueError
        naming the file and the arrays that do not fit.
    """
    times, robots = np.size(record.t_s), len(record.scenario.robot_models)
    wanted: dict[str, tuple[np.ndarray, tuple[int, ...]]] = {
        "t_s": (record.t_s, (times,)),
        "leader_reference_mm": (record.leader, (times, 2)),
        **{name: (getattr(record, name), (robots,)) for name in ENDS},
        **{name: (one, (times, robots)) for name, one in record.columns.items()},
        **{name: (one, (times, robots)) for name, one in record.signals.items()},
    }
    if record.objects is not None:
        things = len(record.scenario.world.pushables) + len(record.scenario.world.moving)
        wanted["objects"] = (record.objects, (times, things, 3))
    wrong = [
        name
        for name, (one, shape) in wanted.items()
        if one.shape != shape or one.dtype.kind not in "biuf"
    ]
    if wrong or not times:
        raise ValueError(
            f"{path}: {', '.join(wrong) or 'robots'}: not numbers of {times} times and {robots} robots"
        )


def write_summary(record: Record, folder: Path, identity: Identity, written: list[Path]) -> Path:
    """Write ``summary.json``, after all other files: with it the run's folder is complete."""
    path = folder / SUMMARY
    names = sorted({*(one.name for one in written), SUMMARY})
    with atomic(path, encoding="utf-8") as file:
        data = {**summary(record), IDENTITY: list(identity), WRITTEN: names}
        json.dump(data, file, indent=2, allow_nan=False)
        file.write("\n")
    return path


def write_parquet(record: Record, folder: Path) -> Path:
    """Write ``trajectory.parquet``: a row for each time and robot, all columns.

    Raises
    ------
    ValueError
        without pyarrow.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError as error:
        raise ValueError(f"--parquet needs {error.name} ({install_command('data')})") from error
    path = folder / "trajectory.parquet"
    with atomic(path, "wb") as file:
        pq.write_table(pa.table(table(record, observations=True)), file)
    return path


def write_mat(record: Record, folder: Path) -> Path:
    """Write ``trajectory.mat`` (MATLAB 5 format): the :func:`arrays` of the run."""
    from scipy.io import savemat

    path = folder / "trajectory.mat"
    with atomic(path, "wb") as file:
        # A name in MATLAB has no dot.
        savemat(file, {name.replace(".", "_"): one for name, one in arrays(record).items()})
    return path
