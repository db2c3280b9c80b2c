"""What commands have written: runs, lines and data sets."""

from __future__ import annotations

import functools
import io
import json
from typing import Any

import numpy as np
from campaign.fuzzing.cases import changed, damaged
from campaign.fuzzing.checks import REFUSED, finite, refused, working_folder
from campaign.fuzzing.registry import target
from campaign.fuzzing.scenarios import SHORT
from hypothesis import strategies as st

from baselines.policies.registry import make_policy
from baselines.runs.files import read_record
from baselines.runs.folders import Identity, check_room
from baselines.runs.jsonl import read_lines
from baselines.runs.run import run_policy
from tlf_env.task.scenario import load_scenario


@functools.cache
def run_files() -> tuple[Any, bytes]:
    from baselines.runs.files import summary, write_record

    scenario = load_scenario("infinity", **{**SHORT, "horizon_s": 0.4})
    record = run_policy(scenario, make_policy("reference", scenario), name="reference")
    with working_folder() as folder:
        write_record(record, folder)
        data = (folder / "trajectory.npz").read_bytes()
    return json.loads(json.dumps(summary(record))), data


@target(
    st.one_of(changed(lambda: [run_files()[0]], most=2), damaged(lambda: [run_files()[1]])),
    share=0.7,
)
def results(case: Any) -> None:
    """Folders of runs: their summaries and arrays."""
    about, data = run_files()
    if isinstance(case, bytes):
        data = case
    else:
        about = case
    with working_folder() as folder:
        (folder / "summary.json").write_text(json.dumps(about))
        (folder / "trajectory.npz").write_bytes(data)
        found = refused(lambda: read_record(folder))
        if found is not REFUSED:
            finite("times of a record", found.t_s)
        identity = Identity("0" * 12, "reference", None, 0, "{}")
        refused(lambda: check_room(folder, identity, overwrite=False))


@functools.cache
def array_files() -> list[dict[str, Any]]:
    with np.load(io.BytesIO(run_files()[1])) as file:
        return [{name: list(file[name].shape) for name in file.files}]


@target(
    st.tuples(
        st.integers(0, 60),
        st.sampled_from(["nan", "shape", "dtype", "text", "object", "missing", "long"]),
    ),
    share=0.1,
)
def result_arrays(case: Any) -> None:
    """Arrays of a run with another type, shape or number, shown on a page."""
    from baselines.pages.replay import write_replay

    which, what = case
    with np.load(io.BytesIO(run_files()[1])) as file:
        found = {name: file[name] for name in file.files}
    name = sorted(found)[which % len(found)]
    old = found[name]
    if what == "missing":
        del found[name]
    elif what == "nan":
        found[name] = np.full(old.shape, np.nan)
    elif what == "shape":
        found[name] = old[..., None]
    elif what == "dtype":
        found[name] = old.astype(np.complex64)
    elif what == "text":
        found[name] = old.astype("U5")
    elif what == "object":
        found[name] = np.array([object()], dtype=object)
    else:
        found[name] = np.concatenate([old, old])
    with working_folder() as folder:
        (folder / "summary.json").write_text(json.dumps(run_files()[0]))
        with (folder / "trajectory.npz").open("wb") as file:
            np.savez(file, **found)
        record = refused(lambda: read_record(folder))
        if record is not REFUSED:
            refused(lambda: write_replay(record, folder / "replay.html"))
            refused(record.metrics)


@target(damaged(lambda: [b'{"seed": 1, "policy": "a"}\n{"seed": 2, "policy": "b"}\n']), share=2.0)
def result_lines(case: bytes) -> None:
    """Files of a line for each finished piece of work."""
    with working_folder() as folder:
        (folder / "runs.jsonl").write_bytes(case)
        refused(lambda: read_lines(folder / "runs.jsonl", lambda line: line["seed"]))


@functools.cache
def data_sets() -> list[bytes]:
    from baselines.data.episodes import entry_names, robots_of
    from baselines.data.files import About, write_parquet

    scenario = load_scenario("infinity", **{**SHORT, "horizon_s": 0.2})
    robots_ = robots_of(scenario, make_policy("reference", scenario), 0)
    about = About(
        policy="reference",
        action=scenario.action,
        observation=scenario.observation,
        entries=entry_names(scenario),
        control_period_s=scenario.control_period_s,
        scenario=str(scenario),
        versions={},
        noise=0.0,
    )
    with working_folder() as folder:
        write_parquet(robots_, about, folder / "own.parquet")
        return [(folder / "own.parquet").read_bytes()]


@st.composite
def damaged_set(draw: Any) -> bytes:
    data = bytearray(data_sets()[0])
    for _ in range(draw(st.integers(1, 6))):
        place = draw(st.integers(0, len(data) - 1))
        data[place] = draw(st.integers(0, 255))
    return bytes(data)


@target(damaged_set(), share=0.5)
def datasets(case: bytes) -> None:
    """Data sets for offline learning."""
    from baselines.data.files import fitting_rows

    with working_folder() as folder:
        (folder / "own.parquet").write_bytes(case)
        refused(lambda: fitting_rows(folder / "own.parquet", load_scenario("infinity", **SHORT)))
