"""``tlf run``: a folder for each run, what is in it, and a run that is interrupted."""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from baselines import ReferencePolicy, cli
from baselines.pages.runs import write_index
from baselines.policies.registry import fit_policy
from baselines.runs import run as runs
from baselines.runs.files import read_record
from baselines.runs.folders import FIGURES, RUN_FILES, Identity, check_room, replaced
from baselines.runs.run import RECORDED, run_policy
from baselines.runs.signals import ACTIONS, OBSERVATION, SIGNALS
from tlf_env import parallel_env
from tlf_env.common.presets import read_preset_or_file, yaml_text
from tlf_env.task.reward import RewardTerms
from tlf_env.task.scenario import load_scenario

SHORT = ["--horizon-s", "2", "--no-figures"]


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def tlf(monkeypatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    cli.main()


def folders() -> list[str]:
    return sorted(path.name for path in Path("results").iterdir() if path.is_dir())


def refused(monkeypatch, capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        tlf(monkeypatch, *words)
    assert stopped.value.code == cli.BAD_INPUT
    return capsys.readouterr().err.splitlines()[-1]


# --- folders


def test_presets_alone_give_a_folder_without_digits(monkeypatch):
    tlf(monkeypatch, "run", "circle", "--no-figures", "--disturbance", "ice", "--seed", "3")
    assert folders() == ["circle-linearised-ice-3"]
    assert {path.name for path in Path("results/circle-linearised-ice-3").iterdir()} == {
        "summary.json",
        "trajectory.csv",
        "trajectory.npz",
        "replay.html",
    }


def test_every_different_run_has_a_folder_of_its_own(monkeypatch):
    variants = (
        [],
        ["--set", "time_gap_s=4"],
        ["--seed", "1"],
        ["--disturbance", "slip"],
        ["--disturbance", "slip", "--level", "0.5"],
        ["--policy", "kanayama:searched+ekf-gyro-smoothed+grip"],
        ["--phase-s", "3"],
        ["--estimator", "ekf-slip"],
    )
    for words in variants:
        tlf(monkeypatch, "run", "circle", *SHORT, *words)
    names = folders()
    assert len(names) == len(variants)
    assert any(name.startswith("circle-kanayama_searched+ekf-gyro") for name in names)
    page = Path("results/index.html").read_text(encoding="utf-8")
    assert all(f'href="./{quote(name)}/replay.html"' in page for name in names)
    tlf(monkeypatch, "run", "circle", *SHORT)  # again: in its place
    assert folders() == names


def test_an_own_controllers_content_belongs_to_the_folder(monkeypatch):
    own = read_preset_or_file("controller", "consistent")
    for gain in (2.0, 3.0):
        Path("own.yaml").write_text(
            yaml_text(
                own | {"controller": own["controller"] | {"limits": {"yaw_rate_rad_s": gain}}}
            ),
            encoding="utf-8",
        )
        tlf(monkeypatch, "run", "circle", *SHORT, "--gains", "own.yaml")
    assert len(folders()) == 2


def test_another_run_is_not_mixed_with_an_earlier_one(monkeypatch, capsys):
    tlf(monkeypatch, "run", "circle", *SHORT, "--out", "here")
    Path("here/mine.txt").write_text("kept", encoding="utf-8")
    Path("here/overview.png").write_bytes(b"not of this run")
    before = Path("here/summary.json").read_text(encoding="utf-8")
    line = refused(monkeypatch, capsys, "run", "circle", *SHORT, "--out", "here", "--seed", "1")
    assert "here holds another run (reference:linearised, seed 0; different: seed)" in line
    assert "--overwrite" in line
    assert Path("here/summary.json").read_text(encoding="utf-8") == before
    tlf(monkeypatch, "run", "circle", *SHORT, "--out", "here", "--mat")  # the same run
    assert Path("here/trajectory.mat").exists()
    tlf(monkeypatch, "run", "circle", *SHORT, "--out", "here", "--seed", "1", "--overwrite")
    assert not Path("here/trajectory.mat").exists()  # of the run before
    assert Path("here/mine.txt").exists()
    assert json.loads(Path("here/summary.json").read_text(encoding="utf-8"))["seed"] == 1


def test_what_a_killed_run_left_behind_does_not_stay(monkeypatch):
    """It has no summary yet, but may have arrays, tables and figures."""
    figures = pytest.importorskip("baselines.runs.figures")
    assert set(FIGURES) == set(figures.FIGURES)
    Path("here").mkdir()
    for name in (*RUN_FILES, "mine.png"):
        Path("here", name).write_text("of a killed run", encoding="utf-8")
    tlf(monkeypatch, "run", "circle", *SHORT, "--out", "here")
    assert {path.name for path in Path("here").iterdir()} == {
        "summary.json",
        "trajectory.csv",
        "trajectory.npz",
        "replay.html",
        "mine.png",
    }
    assert "of a killed run" not in Path("here/trajectory.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize("text", ["", "[]", '{"seed": 1}', '{"identity": 3, "files": ["../x"]}'])
def test_a_damaged_summary_is_no_run_to_go_on_from(text, monkeypatch, capsys):
    Path("here").mkdir()
    again = ("run", "circle", *SHORT, "--out", "here")
    Path("x").write_text("kept", encoding="utf-8")
    Path("here/summary.json").write_text(text, encoding="utf-8")
    assert "of an older version" in refused(monkeypatch, capsys, *again)
    tlf(monkeypatch, "run", "circle", *SHORT, "--out", "here", "--overwrite")
    assert Path("x").exists()


def test_the_page_leaves_out_what_it_cannot_read(monkeypatch):
    Path("results/odd").mkdir(parents=True)
    Path("results/odd/summary.json").write_text('{"robots": 3}', encoding="utf-8")
    tlf(monkeypatch, "run", "circle", *SHORT)
    page = Path("results/index.html").read_text(encoding="utf-8")
    assert "odd" not in page
    assert "circle-linearised" in page


# --- what is in a folder


def test_a_record_has_what_one_wants_to_plot(monkeypatch):
    """Against what the parallel environment returns in the same steps."""
    tlf(monkeypatch, "run", "circle", "--disturbance", "combined-hard", *SHORT, "--out", "here")
    with np.load("here/trajectory.npz") as file:
        found = dict(file)
    assert {*RECORDED, *SIGNALS} <= set(found)
    env = parallel_env("circle", disturbance="combined-hard", horizon_s=2.0, end_on=())
    observations, _ = env.reset(seed=0)
    names = [name for name in found if name.startswith(OBSERVATION)]
    assert len(names) == len(observations["robot_0"])
    policy = ReferencePolicy()
    for k in range(env.scenario.horizon_steps):
        rows = np.stack(list(observations.values()))
        for j, name in enumerate(names):
            assert np.array_equal(found[name][k].astype(np.float32), rows[:, j])
        actions, _ = policy.predict(rows)
        agents = list(env.agents)
        observations, rewards, _, _, infos = env.step(dict(zip(agents, actions, strict=True)))
        for i, agent in enumerate(agents):
            assert found["reward"][k + 1, i] == pytest.approx(rewards[agent], rel=1e-6)
            assert found["reward_fine"][k + 1, i] == infos[agent]["reward_fine"]
            assert found["slip_delta_1_mm_s"][k + 1, i] == infos[agent]["slip_delta_1_mm_s"]
            for j, name in enumerate(ACTIONS):
                assert found[name][k + 1, i] == pytest.approx(actions[i, j], rel=1e-6)
    assert np.isnan(found["action_0"][0]).all()


def test_the_true_slip_is_that_of_the_floor_while_no_tyre_slides():
    scenario = load_scenario(
        "circle", disturbance={"slip": {"delta_1_mm_s": 20.0, "delta_2_rad_s": 0.1}}, horizon_s=20.0
    )
    fitted = fit_policy("reference:linearised", scenario)
    record = run_policy(fitted.scenario, fitted.policy)
    rolling = record["slip_mm_s"][500:] < 30.0  # the floor's own slip, and no more
    assert rolling.mean() > 0.9
    slip_1, slip_2 = record["slip_1_mm_s"][500:], record["slip_2_rad_s"][500:]
    assert np.median(slip_1[rolling]) == pytest.approx(20.0, abs=0.5)
    assert np.median(slip_2[rolling]) == pytest.approx(0.1, abs=0.01)
    estimated = record["estimated_slip_1_mm_s"][500:]
    assert np.median(estimated) == pytest.approx(20.0, abs=1.0)


def test_the_estimate_is_within_its_covariance():
    fitted = fit_policy("reference:linearised", load_scenario("circle", horizon_s=20.0))
    record = run_policy(fitted.scenario, fitted.policy)
    error = (record["estimated_x_mm"] - record["x_mm"])[100:]
    std = np.sqrt(record["covariance_xx_mm2"])[100:]
    assert 0.3 < np.sqrt(np.mean((error / std) ** 2)) < 3.0
    sent = record["message_x_mm"][100:] - record["estimated_x_mm"][100:]
    assert np.abs(sent).max() < 1.0


def test_the_friction_under_each_wheel(monkeypatch):
    """A patch under the left wheel of a robot at rest, times the factors of the tyres."""
    patch = {"x_mm": 78.0, "y_mm": 0.0, "radius_mm": 30.0, "friction_scale": 0.4}
    scenario = load_scenario(
        {"trajectory": {"type": "circle", "radius_mm": 2000, "speed_mm_s": 100}},
        robots=1,
        horizon_s=0.02,
        time_gap_s=0.02,
        preview_s=(),
        disturbance={"tyre": {"friction_scale": 0.5, "friction_right": 0.8, "patches": [patch]}},
    )
    poses = [[0.0, 0.0, math.pi]]
    record = run_policy(scenario, ReferencePolicy(preview_s=()), options={"poses": poses})
    # Heading π points along −y, so that the left wheel is at +x.
    assert record["friction_left"][0, 0] == pytest.approx(0.5 * 0.4)
    assert record["friction_right"][0, 0] == pytest.approx(0.5 * 0.8)
    assert record["friction_castor"][0, 0] == pytest.approx(0.5)


@pytest.mark.parametrize("observation", ["tracking", "sensor"])
def test_every_kind_of_observation_is_recorded(observation):
    class Still:
        def predict(self, rows, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(rows), 2)), state

    fields = {"horizon_s": 0.1, "time_gap_s": 0.1, "preview_s": ()}
    scenario = load_scenario("circle", observation=observation, **fields)
    record = run_policy(scenario, Still())
    width = parallel_env(scenario).observation_space("robot_0").shape[0]
    assert sum(name.startswith(OBSERVATION) for name in record.signals) == width


def test_the_table_has_all_columns_but_the_observations(monkeypatch):
    tlf(monkeypatch, "run", "circle", "--disturbance", "slip", *SHORT, "--out", "here")
    with Path("here/trajectory.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    with np.load("here/trajectory.npz") as found:
        names = {name for name in found if found[name].shape == found["x_mm"].shape}
        wanted = {name for name in names if not name.startswith(OBSERVATION)}
        assert set(rows[0]) == {"t_s", "robot", *wanted}
        assert [row["robot"] for row in rows[:4]] == ["0", "1", "2", "0"]
        for name in ("reward", "estimated_theta_rad", "covariance_yy_mm2"):
            printed = np.array([float(row[name]) for row in rows])
            np.testing.assert_allclose(printed, found[name].ravel(), rtol=1e-8, atol=1e-12)


def test_the_page_names_every_column():
    page = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text(encoding="utf-8")
    terms = {f"reward_{term}" for term in RewardTerms._fields}
    missing = [name for name in (*RECORDED, *SIGNALS) if f"`{name}`" not in page]
    assert set(missing) == terms  # named as `reward_TERM`


def test_parquet_has_the_same_columns(monkeypatch, capsys):
    words = ["run", "circle", *SHORT, "--out", "here", "--parquet"]
    try:
        import pyarrow.parquet as pq
    except ModuleNotFoundError:
        assert "--parquet needs pyarrow" in refused(monkeypatch, capsys, *words)
        return
    tlf(monkeypatch, *words)
    found = pq.read_table("here/trajectory.parquet").to_pydict()
    with np.load("here/trajectory.npz") as arrays:
        for name, values in arrays.items():
            if values.shape == arrays["x_mm"].shape:
                np.testing.assert_array_equal(found[name], values.ravel())


# --- an interrupted run


class Interrupts:
    """The reference, until Ctrl-C is pressed."""

    def __init__(self, after: int) -> None:
        self.left, self.reference = after, ReferencePolicy()

    def predict(self, rows, state=None, episode_start=None, deterministic=True):
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return self.reference.predict(rows, state, episode_start, deterministic)


def test_an_interrupted_record_has_what_was_simulated():
    scenario = load_scenario("circle", horizon_s=6.0)
    whole = run_policy(scenario, ReferencePolicy())
    part = run_policy(scenario, Interrupts(200), keep_interrupted=True)
    assert (whole.interrupted, part.interrupted) == (False, True)
    assert part.t_s[-1] == pytest.approx(4.0)
    for name in (*RECORDED, *SIGNALS):
        np.testing.assert_array_equal(part[name], whole[name][:201], err_msg=name)
    assert part.leader.shape == (201, 2)
    assert len(part.metrics()) == 3
    part.string()
    with pytest.raises(KeyboardInterrupt):
        run_policy(scenario, Interrupts(0), keep_interrupted=True)


def test_ctrl_c_keeps_and_marks_what_was_simulated(monkeypatch, capsys):
    original = runs.PolicyDriver.act
    steps = iter(range(10_000))

    def act(self):
        if next(steps) == 150:
            raise KeyboardInterrupt
        return original(self)

    monkeypatch.setattr(runs.PolicyDriver, "act", act)
    with pytest.raises(SystemExit) as stopped:
        tlf(monkeypatch, "run", "circle", "--no-figures", "--out", "here")
    assert stopped.value.code == cli.INTERRUPTED
    assert "interrupted after 3 s of 100 s" in " ".join(capsys.readouterr().err.split())
    summary = json.loads(Path("here/summary.json").read_text(encoding="utf-8"))
    assert (summary["interrupted"], summary["simulated_s"]) == (True, 3.0)
    assert summary["robots"]["robot_0"]["position_rmse_mm"] is None
    with np.load("here/trajectory.npz") as found:
        assert len(found["t_s"]) == 151
    monkeypatch.setattr(runs.PolicyDriver, "act", original)
    tlf(monkeypatch, "run", "circle", "--no-figures", "--out", "here")  # the same run, whole
    assert json.loads(Path("here/summary.json").read_text(encoding="utf-8"))["simulated_s"] == 100.0


NAMES = [
    "javascript:alert(1)",
    "a#b?c%20d",
    "<img src=x onerror=alert(2)>",
    "\"'&",
    b"\xff".decode("utf-8", "surrogateescape"),
]


def written_run(name: str, errors: Iterable[Any] = (1.0,), text: str = "a") -> None:
    """A folder with the summary of a run, whose texts are all the same."""
    robots = [{"position_rmse_mm": error, "lost": 0, "touched": 0} for error in errors]
    about = {
        "seed": 1,
        "policy": text,
        "robots": {f"robot_{i}": robot for i, robot in enumerate(robots)},
        "scenario": {"name": text, "disturbance": {"name": text}},
    }
    Path(name).mkdir()
    Path(name, "summary.json").write_text(json.dumps(about), encoding="utf-8")


def test_the_page_of_runs_is_safe_with_any_name_of_a_folder():
    for name, text in zip(NAMES, ["</td><script>alert(3)</script>", "\ud800", *"abc"], strict=True):
        written_run(name, text=text)
    source = write_index(Path()).read_text(encoding="utf-8")
    body = source[source.index("<body>") :]
    links = re.findall(r'href="([^"]*)"', body)
    assert sorted(links) == sorted(f"./{quote(os.fsencode(name))}/" for name in NAMES)
    assert "<script" not in body
    assert "<img" not in body
    assert body.count("&lt;script&gt;") == 3


@pytest.mark.parametrize("wrong", [[10**400], ["x"], [[1]], [{}], [None], [math.nan], []])
def test_a_summary_with_odd_numbers_does_not_stop_the_page_of_runs(wrong):
    written_run("odd", wrong)
    written_run("good")
    assert "./good/" in write_index(Path()).read_text(encoding="utf-8")


@pytest.mark.parametrize("written", [3, "x", None, {"a": 1}, ["../x", 3, "trajectory.npz"]])
def test_a_damaged_list_of_files_does_not_stop_a_run(written, tmp_path):
    Path("here").mkdir()
    Path("x").touch()
    identity = Identity("0", "a", None, 0, "{}")
    Path("here/summary.json").write_text(json.dumps({"identity": list(identity), "files": written}))
    check_room(Path("here"), identity, overwrite=False)
    with replaced(Path("here")) as made:
        (made / "summary.json").write_text("{}")
    assert Path("x").exists()
    assert Path("here/summary.json").read_text() == "{}"


def test_a_run_whose_scenario_is_wrong_is_refused_in_one_line(monkeypatch):
    tlf(monkeypatch, "run", "circle", *SHORT, "--out", "here")
    about = json.loads(Path("here/summary.json").read_text(encoding="utf-8"))
    about["scenario"] |= {"robots": "x", "time_gap_s": -1}
    Path("here/summary.json").write_text(json.dumps(about), encoding="utf-8")
    with pytest.raises(ValueError, match=r"^here: a file of the run is broken: scenario\.[^\n]*$"):
        read_record(Path("here"))
