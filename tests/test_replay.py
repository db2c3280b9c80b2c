"""Replay pages: they hold the recorded columns, stay small and self-contained, and any text stays text."""

from __future__ import annotations

import base64
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import Aborted

from baselines import cli
from baselines.commands.compare import names_of
from baselines.commands.run import Wanted, run_command
from baselines.pages.differences import differences
from baselines.pages.page import text
from baselines.pages.replay import (
    CODES,
    EXACT,
    ROUNDED,
    replay_page,
    rounded,
    run_data,
    thinning,
    write_replay,
)
from baselines.policies.reference import ReferencePolicy
from baselines.runs.files import arrays, read_record
from baselines.runs.run import Record, run_policy
from tlf_env.task.scenario import load_scenario

HOSTILE = "</script><script>alert(1)</script>"


def made(task: str = "infinity", **fields) -> Record:
    scenario = load_scenario(task, **({"horizon_s": 4.0} | fields))
    return run_policy(scenario, ReferencePolicy(), 3, name="reference")


@pytest.fixture(scope="module")
def record() -> Record:
    return made(disturbance="ice")


def held(source: str) -> dict:
    """The data of a page."""
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', source, re.S)
    return json.loads(found)


def values(column: dict, robots: int) -> np.ndarray:
    """A column of a page, decoded independently of the page's own script."""
    raw = base64.b64decode(column["bytes"])
    if "low" not in column:
        return np.frombuffer(raw, "<f4").reshape(-1, robots)
    codes = np.frombuffer(raw, "<u2").reshape(-1, robots)
    decoded = np.array(column["low"]) + np.array(column["step"]) * codes
    return np.where(codes == 65535, np.nan, decoded)


def test_a_page_holds_the_recorded_columns(record):
    (run,) = held(replay_page([record]))["runs"]
    assert set(run["columns"]) == {*EXACT, *ROUNDED}
    for name, column in run["columns"].items():
        found, wanted = values(column, record.robots), record[name]
        assert found.shape == wanted.shape
        room = 1e-6 * np.abs(wanted) if name in EXACT else np.ptp(wanted, axis=0) / CODES
        assert np.all(np.abs(found - wanted) <= room + 1e-9), name
    assert np.allclose(values(run["t_s"], 1)[:, 0], record.t_s)
    assert np.allclose(values(run["leader_mm"], 2), record.leader, rtol=1e-6)


def test_missing_values_stay_missing():
    given = np.array([[np.nan, 1.0, np.nan], [2.0, 1.0, np.nan], [5.0, 1.0, np.inf]])
    found = values(rounded(given), 3)
    assert np.array_equal(found, np.where(np.isfinite(given), given, np.nan), equal_nan=True)


def test_a_long_run_of_five_robots_stays_below_three_megabytes(record):
    rows, robots = 5001, 5
    big = replace(
        record,
        scenario=load_scenario("flower", horizon_s=100.0),
        t_s=np.arange(rows) * 0.02,
        leader=np.zeros((rows, 2)),
        columns={
            name: np.random.default_rng(0).normal(size=(rows, robots)) for name in record.columns
        },
        signals={
            name: np.random.default_rng(1).normal(size=(rows, robots)) for name in record.signals
        },
        lost_at_s=np.full(robots, np.inf),
        touched_at_s=np.full(robots, np.inf),
        touched_by=np.zeros(robots, dtype=np.int8),
    )
    assert thinning([big]) == 1
    assert len(replay_page([big]).encode()) < 3e6
    assert thinning([big] * 4) > 1
    source = replay_page([big] * 4)
    assert len(source.encode()) < 3e6
    assert "one in" in source
    run = held(source)["runs"][0]
    assert values(run["t_s"], 1)[-1, 0] == pytest.approx(100.0)


def test_a_page_names_its_run_and_its_texts_stay_text(record):
    source = replay_page([record])
    assert "<title>infinity, policy reference, disturbance ice, seed 3</title>" in source
    hostile = replay_page([replace(record, policy=HOSTILE)])
    assert HOSTILE not in hostile
    assert text(HOSTILE) in hostile
    assert held(hostile)["runs"][0]["policy"] == HOSTILE
    both = replay_page([record, replace(record, policy=HOSTILE)])
    assert HOSTILE not in both


def test_a_page_has_the_world():
    record = made(
        disturbance={
            "tyre": {"patches": [{"x_mm": 1, "y_mm": 2, "radius_mm": 30, "friction_scale": 0.5}]}
        },
        world={
            "obstacles": [
                {"x_mm": 5000, "y_mm": 5000, "shape": {"type": "circle", "radius_mm": 100}}
            ],
            "pushables": [
                {
                    "x_mm": 6000,
                    "y_mm": 6000,
                    "mass_kg": 1,
                    "shape": {"type": "box", "width_mm": 60, "length_mm": 40},
                }
            ],
        },
        horizon_s=0.4,
    )
    run = run_data(record, "a run")
    assert run["patches"] == [{"x_mm": 1.0, "y_mm": 2.0, "radius_mm": 30.0, "scale": 0.5}]
    assert len(run["walls"]) == 1
    (thing,) = run["things"]
    assert thing["kind"] == "crate"
    assert np.ptp(np.array(thing["points"]), axis=0).tolist() == [60.0, 40.0]
    poses = values(run["objects"], 3)
    assert poses[0].tolist() == [6000.0, 6000.0, 0.0]


def test_an_aborted_run_has_a_page_of_what_was_simulated(tmp_path, monkeypatch):
    record = run_policy(
        load_scenario("infinity", horizon_s=4.0),
        Aborted(),
        0,
        name="aborted",
        keep_interrupted=True,
    )
    source = write_replay(record, tmp_path / "replay.html").read_text(encoding="utf-8")
    assert held(source)["runs"][0]["rows"] == 51
    assert "interrupted after 1 s of 4 s" in source


def test_a_run_is_read_back_as_it_was_written(record, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    chosen = load_scenario("infinity", disturbance="ice", horizon_s=4.0)
    wanted = Wanted(out=tmp_path / "run", figures=False)
    assert run_command(chosen, "reference", 3, {}, wanted, trust=False)
    back = read_record(tmp_path / "run")
    for name, one in arrays(record).items():
        assert np.array_equal(arrays(back)[name], one, equal_nan=True), name
    assert back.scenario == record.scenario
    assert (back.seed, back.policy, back.interrupted) == (3, "reference", False)
    assert [one._asdict() for one in back.metrics()] == [one._asdict() for one in record.metrics()]
    assert (tmp_path / "run" / "replay.html").read_text(encoding="utf-8") == replay_page([back])
    (tmp_path / "run" / "trajectory.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(ValueError, match="broken"):
        read_record(tmp_path / "run")
    (tmp_path / "run" / "trajectory.npz").unlink()
    with pytest.raises(ValueError, match=r"there is no trajectory\.npz"):
        read_record(tmp_path / "run")
    with pytest.raises(ValueError, match=r"holds no run: there is no summary\.json"):
        read_record(tmp_path)


def test_an_earlier_version_is_said_so(record, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_command(
        load_scenario("infinity", horizon_s=0.2),
        "reference",
        3,
        {},
        Wanted(tmp_path / "run", figures=False),
        trust=False,
    )
    path = tmp_path / "run" / "trajectory.npz"
    with np.load(path) as file:
        kept = {name: file[name] for name in file.files if name != "lost_at_s"}
    np.savez(path, **kept)
    with pytest.raises(ValueError, match=r"'lost_at_s' is missing or wrong; run it again"):
        read_record(tmp_path / "run")


def compared(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["tlf", "compare", *words])
    cli.main()


def test_runs_are_compared(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for policy, gap in (("reference", 5.0), ("reference:consistent", 4.0)):
        chosen = load_scenario("infinity", disturbance="slip", horizon_s=2.0, time_gap_s=gap)
        out = Wanted(out=Path(policy.replace(":", "_")), figures=False)
        run_command(chosen, policy, 0, {}, out, trust=False)
    compared(monkeypatch, "reference", "reference_consistent", "--out", "page.html")
    printed = capsys.readouterr().out
    assert "time_gap_s" in printed
    assert "A: reference" in printed
    source = Path("page.html").read_text(encoding="utf-8")
    assert "<td>time_gap_s</td><td>5.0</td><td>4.0</td>" in source
    assert [run["policy"] for run in held(source)["runs"]] == ["reference", "reference:consistent"]
    assert "<title>2 runs: infinity, disturbance slip, seed 0</title>" in source


@pytest.mark.parametrize(
    ("folders", "says"),
    [
        (["one"], "two runs or more"),
        (["one", "none"], "none holds no run"),
        (
            ["one", "other_task"],
            "different tasks cannot be compared: infinity in one, circle in other_task",
        ),
        (["one", "other_seed"], "different seeds cannot be compared: 0 in one, 1 in other_seed"),
        (["one"] * 9, "1 to 8 runs, not 9"),
    ],
)
def test_what_cannot_be_compared_is_refused(folders, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for out, task, seed in (
        ("one", "infinity", 0),
        ("other_task", "circle", 0),
        ("other_seed", "infinity", 1),
    ):
        chosen = load_scenario(task, horizon_s=0.1)
        run_command(chosen, "reference", seed, {}, Wanted(Path(out), figures=False), trust=False)
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        compared(monkeypatch, *folders)
    assert ended.value.code == cli.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
    assert not Path("results/compare.html").exists()


def test_names_say_what_differs(record):
    slip = replace(
        record, scenario=load_scenario("infinity", disturbance={"base": "slip", "level": 0.5})
    )
    other = replace(slip, policy="residual")
    assert names_of([record, replace(record, policy="residual")]) == ["reference", "residual"]
    assert names_of([record, slip]) == ["ice", "slip × 0.5"]
    assert names_of([record, other]) == ["reference, ice", "residual, slip × 0.5"]


def test_differences_are_those_of_the_fields_and_results(record):
    half = replace(record, scenario=load_scenario("infinity", disturbance="ice", horizon_s=8.0))
    rows = dict(differences([record, half]))
    assert rows["horizon_s"] == ["4.0", "8.0"]
    assert "time_gap_s" not in rows
    worst = max(one.position_max_mm for one in record.metrics())
    assert rows["largest position error, mm"][0] == f"{worst:.1f}"
