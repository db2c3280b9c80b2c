"""``tlf export``: runs as a data set, in Parquet and in Minari's form; imitation learns from it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from baselines import ReferencePolicy, cli
from baselines.data.episodes import entry_names, robots_of, together
from tlf_env import parallel_env
from tlf_env.task.scenario import load_scenario

FIELDS = {"horizon_s": 2.0, "disturbance": "slip"}


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def tlf(monkeypatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["tlf", "export", *words])
    cli.main()


def refused(monkeypatch, capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        tlf(monkeypatch, *words)
    assert stopped.value.code == cli.BAD_INPUT
    (line,) = [one for one in capsys.readouterr().err.splitlines() if one.startswith("tlf: ")]
    return line


def test_an_episode_is_what_the_environment_returns():
    scenario = load_scenario("circle", **FIELDS)
    policy = ReferencePolicy()
    episodes = robots_of(scenario, policy, 4)
    env = parallel_env(scenario)
    seen, _ = env.reset(seed=4)
    for k in range(100):
        rows = np.stack(list(seen.values()))
        actions, _ = policy.predict(rows)
        for i, one in enumerate(episodes):
            np.testing.assert_array_equal(one.observations[k], rows[i])
            np.testing.assert_array_equal(one.actions[k], actions[i].astype(np.float32))
        seen, rewards, terminated, truncated, _ = env.step(
            dict(zip(list(env.agents), actions, strict=True))
        )
        assert [one.rewards[k] for one in episodes] == list(rewards.values())
    assert all(len(one.actions) == 100 and len(one.observations) == 101 for one in episodes)
    assert [one.terminated for one in episodes] == list(terminated.values()) == [False] * 3
    assert [one.truncated for one in episodes] == list(truncated.values()) == [True] * 3


def test_noise_is_on_the_actions_of_the_data_and_drives_the_robots():
    scenario = load_scenario("circle", horizon_s=0.4)
    plain, noisy, again = (
        robots_of(scenario, ReferencePolicy(), 4, noise=noise) for noise in (0.0, 0.02, 0.02)
    )
    first = np.array([one.actions[0] for one in noisy]) - [one.actions[0] for one in plain]
    drawn = 0.02 * np.random.default_rng(4).standard_normal(first.shape)
    np.testing.assert_allclose(first, drawn, atol=1e-6)
    for mine, theirs in zip(noisy, again, strict=True):
        np.testing.assert_array_equal(mine.actions, theirs.actions)
    assert np.abs(noisy[0].observations[2:] - plain[0].observations[2:]).max() > 0.001


def test_a_robot_that_is_lost_ends_every_episode():
    class Away:
        def predict(self, rows, state=None, episode_start=None, deterministic=True):
            return np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]), state

    scenario = load_scenario("infinity", lost_beyond_mm=300.0)
    episodes = robots_of(scenario, Away(), 0)
    assert [one.terminated for one in episodes] == [True, False, False]
    assert [one.truncated for one in episodes] == [False, True, True]
    joint = together(episodes)
    assert (joint.terminated, joint.truncated, joint.robot) == (True, False, None)
    assert joint.observations.shape == (len(joint.actions) + 1, 3, len(entry_names(scenario)))
    np.testing.assert_allclose(joint.rewards, np.mean([one.rewards for one in episodes], axis=0))


class TestFiles:
    """What needs pyarrow and Minari."""

    @pytest.fixture(autouse=True)
    def _packages(self):
        pytest.importorskip("pyarrow")
        pytest.importorskip("minari")

    @pytest.mark.parametrize("joint", [False, True])
    def test_parquet_comes_back(self, joint, monkeypatch, capsys):
        import pyarrow.parquet as pq

        from baselines.data.files import read_rows

        words = ["circle", "--disturbances", "nominal,slip", "--seeds", "3:5", "--horizon-s", "2"]
        tlf(monkeypatch, *words, *["--joint"] * joint)
        out = capsys.readouterr().out
        assert f"dataset.parquet: {4 if joint else 12} episodes" in out
        rows = read_rows(Path("results/data/dataset.parquet"))
        assert rows.about.policy == "reference:linearised"
        assert (rows.about.action, len(rows.actions)) == ("twist", 1200)
        assert rows.last.sum() == 12
        table = pq.read_table("results/data/dataset.parquet").to_pydict()
        scenario = load_scenario("circle", horizon_s=2.0, disturbance="slip")
        wanted = robots_of(scenario, ReferencePolicy(), 4)[1]
        mine = [
            k
            for k in range(len(table["step"]))
            if (table["disturbance"][k], table["seed"][k], table["robot"][k]) == ("slip", 4, 1)
        ]
        assert [table["step"][k] for k in mine] == list(range(101))
        for i, name in enumerate(entry_names(scenario)):
            found = [table[f"observation_{name}"][k] for k in mine]
            np.testing.assert_array_equal(found, wanted.observations[:, i])
        for i in (0, 1):
            found = [table[f"action_{i}"][k] for k in mine]
            np.testing.assert_array_equal(found[:-1], wanted.actions[:, i])
            assert np.isnan(found[-1])
        assert [table["truncated"][k] for k in mine[-3:]] == [False, True, False]

    @pytest.mark.parametrize("joint", [False, True])
    def test_minari_reads_it_back(self, joint, monkeypatch):
        import minari

        words = [
            "circle",
            "--seeds",
            "0:2",
            "--horizon-s",
            "2",
            "--form",
            "minari",
            "--name",
            "own",
        ]
        tlf(monkeypatch, *words, *["--joint"] * joint)
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(Path("results/data").resolve()))
        data = minari.load_dataset("tlf_env/own-v0")
        scenario = load_scenario("circle", horizon_s=2.0)
        robots = [one for seed in (0, 1) for one in robots_of(scenario, ReferencePolicy(), seed)]
        wanted = [together(robots[:3]), together(robots[3:])] if joint else robots
        episodes = list(data.iterate_episodes())
        assert data.total_episodes == len(episodes) == len(wanted)
        assert data.total_steps == 100 * len(wanted)
        space = parallel_env(scenario).observation_space("robot_0")
        assert data.spec.observation_space.shape == ((3, *space.shape) if joint else space.shape)
        for episode, one in zip(episodes, wanted, strict=True):
            np.testing.assert_array_equal(episode.observations, one.observations)
            np.testing.assert_array_equal(episode.actions, one.actions)
            np.testing.assert_allclose(episode.rewards, one.rewards)
            assert list(episode.truncations[-2:]) == [False, True]
            assert not any(episode.terminations)

    def test_a_data_set_is_not_overwritten_by_minari(self, monkeypatch, capsys):
        words = ["circle", "--seeds", "0:1", "--horizon-s", "0.2", "--form", "minari"]
        tlf(monkeypatch, *words)
        assert "exists already" in refused(monkeypatch, capsys, *words)

    @pytest.mark.parametrize("content", [b"", b"no table", None])
    def test_a_file_that_is_no_data_set_is_refused(self, content, tmp_path):
        import pyarrow as pa
        import pyarrow.parquet as pq

        from baselines.data.files import read_rows

        path = tmp_path / "x.parquet"
        if content is None:
            pq.write_table(pa.table({"a": [1]}), path)
        else:
            path.write_bytes(content)
        with pytest.raises(ValueError, match=r"x\.parquet"):
            read_rows(path)
        with pytest.raises(ValueError, match="cannot read"):
            read_rows(tmp_path / "nowhere.parquet")

    def test_imitation_learns_from_it(self, monkeypatch, tmp_path):
        """The network's actions come nearer to the data's; data of another action are refused."""
        pytest.importorskip("stable_baselines3")
        import torch

        from baselines.data.files import read_rows
        from baselines.training.config import load_config
        from baselines.training.imitation import imitate
        from baselines.training.model import make_envs, make_model

        tlf(monkeypatch, "circle", "--seeds", "0:2", "--horizon-s", "4")
        path = tmp_path / "results/data/dataset.parquet"
        config = {
            "algorithm": "PPO",
            "robot_steps": 600,
            "formations": 2,
            "scenario": {"action": "twist", "horizon_s": 4.0},
            "tasks": {"circle": {}},
            "disturbances": {"nominal": 1},
            "imitation": {"data": str(path), "epochs": 60},
            "settings": {"n_steps": 10, "batch_size": 40},
            "evaluation": {"every": 600, "disturbances": ["nominal"], "seeds": [10_000, 10_001]},
        }
        loaded = load_config(config)
        envs = make_envs(loaded, 1)
        model = make_model(loaded, envs, 0)
        rows = read_rows(path)

        def error() -> float:
            actions, _ = model.predict(rows.observations, deterministic=True)
            return float(np.square(actions - rows.actions).mean())

        before = error()
        torch.set_num_threads(1)
        imitate(model, envs, loaded)
        assert error() < 0.1 * before
        other = load_config({**config, "scenario": {"action": "tracking_twist"}})
        envs = make_envs(other, 1)
        with pytest.raises(ValueError, match="'twist' actions; the scenario has 41 of 'tracking'"):
            imitate(make_model(other, envs, 0), envs, other)


def test_without_the_packages_the_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    line = refused(monkeypatch, capsys, "circle", "--seeds", "0:1", "--horizon-s", "0.2")
    assert "pip install 'tlf-env[data]'" in line


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["circle", "--form", "csv"], "--form 'csv' must be one of parquet, minari"),
        (["circle", "--seeds", "3"], "3"),
        (["circle", "--noise", "-1"], "--noise -1 must be a finite number from 0 on"),
        (["circle", "--noise", "nan"], "--noise nan must be a finite number from 0 on"),
        (["circl"], "did you mean 'circle'?"),
        (["circle,flower", "--joint"], "--joint needs tasks with the same number of robots"),
    ],
)
def test_what_cannot_be_exported_is_refused(words, named, monkeypatch, capsys):
    assert named in refused(monkeypatch, capsys, *words)


def test_data_are_imitated_in_one_round():
    from baselines.training.config import ImitationConfig, load_config
    from tlf_env.common.presets import read_preset_or_file

    config = read_preset_or_file("training", "direct")
    config["imitation"] = {"data": "x.parquet", "rounds": 2}
    with pytest.raises(ValueError, match=r"imitation\.rounds needs a reference that drives"):
        load_config(config)
    assert ImitationConfig().data is None
