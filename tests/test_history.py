"""Histories: what a network sees of the past, in a training and from its file."""

from __future__ import annotations

import importlib
import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file
from test_learned import NOTES, random_tensors
from test_train import ALGORITHMS, CONFIG

from baselines import load_policy
from baselines.policies.card import write_policy
from baselines.policies.history import History, Past
from baselines.policies.network import Network
from baselines.runs.run import run_policy, run_seeds
from baselines.training.config import load_config
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import load_scenario
from tlf_env.task.warn import without_warnings

NAMES = ["a", "b", "c"]
TWIST = load_scenario(horizon_s=0.6)
ENTRIES = list(tracking_entries(TWIST.preview_s))
DOCS = Path(__file__).resolve().parents[1] / "docs"
KEPT = ("e_1_fine", "torque_l", "last_action_0")


def histories() -> st.SearchStrategy[History]:
    return st.builds(
        History,
        observations=st.integers(0, 4),
        mean_of=st.integers(1, 5),
        entries=st.sampled_from([None, ("b",), ("c", "a")]),
    )


def rows_of(seed: int, steps: int, rows: int, entries: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(steps, rows, entries)).astype(np.float32)


def from_definition(history: History, seen: np.ndarray, step: int, began: int) -> np.ndarray:
    """What the network sees of one robot in a step of an episode that began at ``began``."""
    places = [NAMES.index(name) for name in history.entries or NAMES]
    parts = [seen[step]]
    finished = (step - began) // history.mean_of
    for i in range(history.observations):
        end = began + (finished - i) * history.mean_of
        stretch = seen[end - history.mean_of : end, places].astype(np.float64)
        there = finished - i > 0
        parts.append(stretch.mean(axis=0) if there else np.zeros(len(places)))
    return np.concatenate(parts)


@given(histories(), st.integers(1, 20), st.integers(0, 9))
def test_the_network_sees_the_means_of_finished_stretches(history, steps, seed):
    """Of this episode only, and of this robot only, whatever the others do."""
    rng, rows = np.random.default_rng(seed), 4
    seen, starts = rows_of(seed, steps, rows), rng.random((steps, rows)) < 0.2
    past, state, began = Past(history, NAMES), None, np.zeros(rows, dtype=int)
    for k in range(steps):
        began[starts[k]] = k
        memory = past.memory(state, rows, starts[k])
        found = past.joined(seen[k], memory)
        assert found.shape == (rows, 3 + history.size(3))
        assert found.dtype == np.float32
        for row in range(rows):
            wanted = from_definition(history, seen[:, row], k, began[row])
            np.testing.assert_allclose(found[row], wanted, atol=1e-6)
        before = memory.copy()
        state = past.after(memory, seen[k])
        np.testing.assert_array_equal(memory, before)


@pytest.mark.parametrize(
    ("history", "said"),
    [
        ({"observations": -1}, "observations: Input should be greater than or equal to 0, got -1"),
        ({"observations": 65}, "observations: Input should be less than or equal to 64, got 65"),
        ({"observations": 2.5}, "observations: Input should be a whole number, got 2.5"),
        ({"observations": 4, "mean_of": 0}, "mean_of: Input should be greater than or equal to 1"),
        ({"observations": 4, "every": 5}, "every: unknown key"),
        ({"observations": 4, "entries": []}, "entries: must have at least 1 entry, got 0"),
        (
            {"observations": 4, "entries": ["torque"]},
            "network.history.entries: the observation lacks the entry 'torque'",
        ),
        (
            {"observations": 4, "entries": ["e_1", "e_1"]},
            "network.history.entries has 'e_1' twice",
        ),
    ],
)
def test_a_wrong_history_is_reported_in_one_line(history: dict, said: str):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        load_config({**CONFIG, "network": {"history": history}})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"algorithm": "RecurrentPPO", "network": {"lstm": 8, "history": {"observations": 2}}},
            "network.history and network.lstm exclude each other; both are given",
        ),
        (
            {"network": {"history": {"observations": 2}}, "imitation": {}},
            "imitation needs a network without history",
        ),
    ],
)
def test_what_goes_without_a_history_is_reported_in_one_line(changes: dict, said: str):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        load_config({**CONFIG, **changes})
    assert "\n" not in str(error.value)


def written(folder, history: History, **changes):
    network = Network(hidden=(16,), activation="tanh", head="gaussian", history=history, **changes)
    path = folder / "policy.safetensors"
    tensors = random_tensors(network, len(ENTRIES))
    write_policy(path, network, tensors, TWIST, **NOTES)
    return load_policy(path), tensors


@pytest.mark.parametrize("normalised", [False, True])
def test_a_file_gives_the_actions_of_its_network(normalised, tmp_path):
    history = History(observations=3, mean_of=2, entries=KEPT)
    policy, tensors = written(tmp_path, history, normalised=normalised)
    past, state, memory = Past(history, ENTRIES), None, None
    for k, seen in enumerate(rows_of(3, 12, 5, len(ENTRIES))):
        start = np.arange(5) == k - 7
        memory = past.memory(memory, 5, start)
        x = past.joined(seen, memory).astype(np.float64)
        memory = past.after(memory, seen)
        if normalised:
            spread = np.sqrt(tensors["normalise.var"] + tensors["normalise.epsilon"])
            clip = tensors["normalise.clip"]
            x = np.clip((x - tensors["normalise.mean"]) / spread, -clip, clip)
        x = np.tanh(x @ tensors["hidden.0.weight"].T + tensors["hidden.0.bias"])
        wanted = np.clip(x @ tensors["mean.weight"].T + tensors["mean.bias"], -1, 1)
        action, state = policy.predict(seen, state, start)
        np.testing.assert_allclose(action, wanted, atol=2e-6)


def test_a_row_has_the_same_bits_alone_and_in_any_batch(tmp_path):
    policy, _ = written(tmp_path, History(observations=2, mean_of=3, entries=KEPT))
    whole, alone, state, own = [], [], None, None
    for k, seen in enumerate(rows_of(5, 20, 6, len(ENTRIES))):
        start = np.arange(6) * 3 == k
        action, state = policy.predict(seen, state, start)
        whole.append(action[2])
        action, own = policy.predict(seen[2], own, start[2:3])
        alone.append(action)
    np.testing.assert_array_equal(whole, alone)


def test_a_state_of_other_rows_is_reported(tmp_path):
    policy, _ = written(tmp_path, History(observations=2, entries=KEPT))
    _, state = policy.predict(np.zeros((4, len(ENTRIES))))
    with pytest.raises(
        ValueError, match=r"the state must be of the shape \(3, 10\), got \(4, 10\)"
    ):
        policy.predict(np.zeros((3, len(ENTRIES))), state)


def test_seeds_side_by_side_are_the_seeds_alone(tmp_path):
    """A policy with a history drives the same run alone and in a batch."""
    policy, _ = written(tmp_path, History(observations=4, mean_of=5))
    scenario = load_scenario(TWIST, **policy.overrides_for(TWIST))
    for seed, record in zip((4, 5), run_seeds(scenario, policy, [4, 5]), strict=True):
        alone = run_policy(scenario, policy, seed)
        np.testing.assert_array_equal(alone["x_mm"], record["x_mm"])


class TestTraining:
    """What needs stable-baselines3 and torch."""

    @pytest.fixture(autouse=True)
    def _packages(self):
        pytest.importorskip("stable_baselines3")

    def test_no_earlier_observation_is_the_training_without_history(self, tmp_path):
        from baselines.training.train import CHECKPOINT_FILE, POLICY_FILE, train

        network = {"hidden": [16]}
        plain = train(load_config({**CONFIG, "network": network}), 3, tmp_path / "plain")
        none = {**network, "history": {"observations": 0}}
        empty = train(load_config({**CONFIG, "network": none}), 3, tmp_path / "empty")
        assert plain["evaluations"] == empty["evaluations"]
        assert plain["rollouts"] == empty["rollouts"]
        for name in (POLICY_FILE, CHECKPOINT_FILE):
            mine, theirs = (load_file(tmp_path / one / name) for one in ("empty", "plain"))
            for key, tensor in theirs.items():
                assert mine[key].tobytes() == tensor.tobytes(), key

    def test_an_environment_shows_the_past_of_this_episode(self):
        """At every step, at the last one of an episode, and after a start out of turn."""
        from baselines.sb3 import FormationVecEnv
        from baselines.training.history import HistoryVecEnv

        history = History(observations=2, mean_of=3, entries=KEPT)
        fields = {"formations": 4, "infos": False, "seed": 3, "horizon_s": 0.3, "staggered": True}
        fields |= {"time_gap_s": 0.1, "preview_s": (0.02,)}
        with without_warnings():  # of robots that are too close, with so short a gap
            plain = FormationVecEnv("infinity", **fields)
            envs = HistoryVecEnv("infinity", history=history, **fields)
        names = list(tracking_entries((0.02,)))
        past, memory = Past(history, names), None
        rng, begun = np.random.default_rng(0), np.ones(envs.num_envs, dtype=bool)
        seen, found = plain.reset(), envs.reset()
        assert found.shape == (envs.num_envs, *envs.observation_space.shape)
        ended = 0
        for k in range(40):
            memory = past.memory(memory, envs.num_envs, begun)
            np.testing.assert_array_equal(found, past.joined(seen, memory))
            np.testing.assert_array_equal(found, envs.observations())
            memory = past.after(memory, seen)
            actions = rng.uniform(-1, 1, (envs.num_envs, 2)).astype(np.float32)
            seen, _, begun, infos = plain.step(actions)
            found, _, dones, own = envs.step(actions)
            assert (begun == dones).all()
            for i in np.flatnonzero(dones):
                last = past.joined(infos[i]["terminal_observation"][np.newaxis], memory[i : i + 1])
                np.testing.assert_array_equal(own[i]["terminal_observation"], last[0])
                ended += 1
            if k == 20:
                mask = np.array([False, True, False, False])
                for one in (plain, envs):
                    one.begin_next(0, mask)
                seen, found = plain.observations(), envs.observations()
                begun = dones | np.repeat(mask, 3)
        assert ended > 20
        with pytest.raises(ValueError, match="actions must be"):
            envs.step(np.full((envs.num_envs, 2), np.nan))
        np.testing.assert_array_equal(found, envs.observations())

    @pytest.mark.parametrize("algorithm", ["PPO", "SAC", "CrossQ"])
    def test_an_interrupted_training_continues_to_the_same_policy(self, algorithm, tmp_path):
        from baselines.training.train import CHECKPOINT_FILE, POLICY_FILE, train

        history = {"observations": 3, "mean_of": 4, "entries": list(KEPT)}
        config = load_config(
            {**CONFIG, **ALGORITHMS[algorithm], "network": {"hidden": [16], "history": history}}
        )
        train(config, 3, tmp_path / "whole")
        stops = []

        def interrupt(done: int, total: int) -> None:
            stops.append(done)
            if len(stops) == 2:
                signal.raise_signal(signal.SIGINT)

        with pytest.raises(KeyboardInterrupt):
            train(config, 3, tmp_path / "parts", progress=interrupt)
        train(config, 3, tmp_path / "parts")
        for name in (POLICY_FILE, CHECKPOINT_FILE):
            mine, theirs = (tmp_path / one / name for one in ("parts", "whole"))
            if name == POLICY_FILE:
                assert mine.read_bytes() == theirs.read_bytes()
                continue
            for key, tensor in load_file(theirs).items():
                assert load_file(mine)[key].tobytes() == tensor.tobytes(), key

    def test_the_file_drives_as_the_model_does(self, tmp_path):
        """Step by step, with resets in between."""
        from baselines.training.export import export_policy
        from baselines.training.model import make_envs, make_model

        history = {"observations": 3, "mean_of": 4, "entries": list(KEPT)}
        network = {"hidden": [16], "history": history, "action_gain": 1.0}
        config = load_config({**CONFIG, "network": network})
        envs = make_envs(config, 1)
        model = make_model(config, envs, 0)
        scenario = config.mixture()[0]["infinity"][0]
        path = tmp_path / "policy.safetensors"
        card = export_policy(model, path, scenario, training={}, seeds={"learner": [0]})
        assert card.network.history == History(**history)
        policy, state = load_policy(path), None
        envs.seed(0)
        found, start, ended = envs.reset(), np.ones(envs.num_envs, dtype=bool), 0
        for _ in range(120):
            wanted, _ = model.predict(found, deterministic=True)
            action, state = policy.predict(found[:, : len(card.entries)], state, start)
            np.testing.assert_allclose(action, wanted, atol=1e-5)
            found, _, start, _ = envs.step(wanted)
            ended += int(start.sum())
        assert ended > 0

    def test_the_page_has_the_tables_of_the_measured_runs(self, monkeypatch):
        monkeypatch.syspath_prepend(str(DOCS / "figures"))
        make_memory = importlib.import_module("make_memory")
        page = (DOCS / "learning.md").read_text("utf-8")
        kept = json.loads((DOCS / "learning" / "memory.json").read_text("utf-8"))
        for name, table in (
            ("probe", make_memory.probed_table(kept["probe"])),
            ("memory", make_memory.judged_table(kept["judged"])),
        ):
            assert f"<!-- {name} -->\n{table}\n<!-- end of {name} -->" in page
