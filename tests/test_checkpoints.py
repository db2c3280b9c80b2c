"""Checkpoints of trainings that are forged: refused in one line, and nothing is half restored."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import torch
from safetensors import safe_open
from safetensors.numpy import save_file

from baselines.training.checkpoint import read_checkpoint, write_checkpoint
from baselines.training.config import load_config
from baselines.training.curve import TrainingProgress
from baselines.training.model import make_envs, make_model, rollout_steps, spread_out

CONFIG = {
    "algorithm": "PPO",
    "robot_steps": 240,
    "formations": 3,
    "scenario": {"action": "residual", "horizon_s": 2.0, "time_gap_s": 0.5, "preview_s": [0.5]},
    "tasks": {"infinity": {"robots": 2}},
    "disturbances": {"nominal": 1, "slip": 2},
    "network": {"hidden": [8]},
    "settings": {"n_steps": 10, "batch_size": 20, "n_epochs": 1},
    "checkpoint_every": 120,
    "evaluation": {
        "every": 120,
        "seeds": [10_000, 10_002],
        "disturbances": ["slip"],
        "horizon_s": 2.0,
    },
}
KINDS: dict[str, dict[str, Any]] = {
    "PPO": {},
    "SAC": {
        "algorithm": "SAC",
        "settings": {"buffer_size": 600, "learning_starts": 20, "batch_size": 16},
    },
    "RecurrentPPO": {
        "algorithm": "RecurrentPPO",
        "network": {"hidden": [8], "lstm": 4},
    },
}


def made(kind: str, seed: int = 0) -> tuple[Any, Any]:
    config = load_config({**CONFIG, **KINDS[kind]})
    envs = make_envs(config, 1)
    model = make_model(config, envs, seed)
    spread_out(model, envs, seed)
    return model, envs


@pytest.fixture(scope="module")
def written(request, tmp_path_factory):
    """A kind, and its checkpoint after two rollouts."""
    model, envs = made(request.param)
    for _ in range(2):
        model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
    path = tmp_path_factory.mktemp("written") / "checkpoint.safetensors"
    write_checkpoint(path, model, envs, vars(TrainingProgress()))
    return request.param, path


class Parts:
    """A checkpoint's numbers and plain values, to be changed."""

    def __init__(self, path: Any) -> None:
        with safe_open(path, "np") as file:
            self.numbers = {name: file.get_tensor(name) for name in list(file.keys())}
            self.plain = json.loads(file.metadata()["state"])

    def named(self, end: str) -> str:
        return next(name for name in sorted(self.numbers) if name.endswith(end))

    def save(self, path: Any) -> None:
        save_file(self.numbers, path, {"state": json.dumps(self.plain)})


def whole(model: Any, envs: Any) -> list[bytes]:
    """Everything that a checkpoint restores."""
    parameters = [
        value.numpy().tobytes()
        for part in model.get_parameters().values()
        for value in part.values()
        if isinstance(value, torch.Tensor)
    ]
    arrays = [array.tobytes() for plant in envs.plants for array in plant.arrays]
    generators = [
        torch.get_rng_state().numpy().tobytes(),
        np.random.get_state()[1].tobytes(),  # noqa: NPY002 - SB3 draws from it
        json.dumps(model.action_space.np_random.bit_generator.state).encode(),
    ]
    counts = json.dumps([model.num_timesteps, model._n_updates, list(envs.last_ends)]).encode()
    return [*parameters, *arrays, *generators, np.asarray(model._last_obs).tobytes(), counts]


def in_numbers(end: str, change: Any) -> Any:
    """A change of an array whose name ends so."""

    def forge(parts: Parts) -> None:
        name = parts.named(end)
        parts.numbers[name] = np.ascontiguousarray(change(parts.numbers[name].copy()))

    return forge


def in_plain(name: str, value: Any) -> Any:
    """Another plain value."""

    def forge(parts: Parts) -> None:
        parts.plain[name] = value

    return forge


def at(place: Any, value: Any) -> Any:
    """A change of one number."""

    def change(array: np.ndarray) -> np.ndarray:
        array[place] = value
        return array

    return change


def generator(parts: Parts) -> None:
    parts.plain["numpy_generator"][1] = 10**6


def another_tensor(parts: Parts) -> None:
    parts.numbers["more"] = np.zeros(3)


def without_bodies(parts: Parts) -> None:
    del parts.numbers[parts.named("/arrays/states")]


def optimizers(parts: Parts) -> None:
    text = json.dumps(parts.plain["parameters"])
    assert '["eps", 1e-0' in text
    parts.plain["parameters"] = json.loads(
        text.replace('["eps", 1e-0', '["eps", 1e300], ["was", 1e-0')
    )


FORGED: dict[str, tuple[Any, str]] = {
    "a state that is not finite": (
        in_numbers("/arrays/states", at((0, 0, 0), np.nan)),
        "arrays/states has a number that is not finite",
    ),
    "a state of 1e30": (
        in_numbers("/arrays/states", at((0, 0, 0), 1e30)),
        "arrays/states has a number beyond",
    ),
    "other constants": (
        in_numbers("/arrays/constants", lambda array: -array),
        "constants of another scenario",
    ),
    "a step after the end": (
        in_numbers("/arrays/clock", at((0, 1), 10**6)),
        "a step, seed or number out of range",
    ),
    "fewer states": (in_numbers("/arrays/states", lambda a: a[..., :1]), "states has the shape"),
    "no states": (without_bodies, "arrays/states is missing"),
    "an unknown array": (another_tensor, "more"),
    "weights that are not finite": (
        in_numbers(".weight", at((0, 0), np.inf)),
        "a number that is not finite",
    ),
    "fewer weights": (in_numbers(".weight", lambda a: a[:1]), "has the shape"),
    "weights in double precision": (
        in_numbers(".weight", lambda a: a.astype(np.float64)),
        "has the type float64",
    ),
    "an optimizer's numbers of another form": (
        in_numbers(".exp_avg", lambda a: a.ravel()[:1]),
        "has the shape",
    ),
    "other settings of the optimizer": (optimizers, "other settings"),
    "observations of fewer robots": (
        in_numbers("last_observations", lambda a: a[:2]),
        "last_observations has the shape",
    ),
    "a generator beyond its end": (generator, "random generator"),
    "torch's generator cut": (in_numbers("torch_generator", lambda a: a[:10]), "torch_generator"),
    "a negative number of steps": (in_plain("steps", -1), "its number of steps"),
    "a number of updates that is none": (in_plain("updates", "x"), "its number of steps"),
    "an end that there is not": (in_plain("last_ends", [99]), "its last ends"),
    "a record of something else": (in_plain("notes", {"levels": 3}), "its record"),
    "a level that is no number": (
        in_plain("notes", {**vars(TrainingProgress()), "level_count": "x"}),
        "its record",
    ),
}


OF_EVERY_KIND = (
    "a state that is not finite",
    "weights that are not finite",
    "an optimizer's numbers of another form",
    "observations of fewer robots",
)


@pytest.mark.parametrize(
    ("written", "what"),
    [(kind, what) for kind in KINDS for what in (FORGED if kind == "PPO" else OF_EVERY_KIND)],
    indirect=["written"],
)
def test_a_forged_checkpoint_is_refused_and_nothing_changes(what, written, tmp_path):
    kind, path = written
    forge, said = FORGED[what]
    parts = Parts(path)
    forge(parts)
    parts.save(tmp_path / "forged.safetensors")
    model, envs = made(kind, 5)
    before = whole(model, envs)
    with pytest.raises(ValueError, match=rf"cannot resume from .*{said}") as error:
        read_checkpoint(tmp_path / "forged.safetensors", model, envs)
    assert "\n" not in str(error.value)
    assert whole(model, envs) == before


@pytest.mark.parametrize("value", [-1, 10**9, 0.5])
def test_a_replay_buffer_ends_within_itself(value, tmp_path):
    model, envs = made("SAC")
    model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(path, model, envs, vars(TrainingProgress()))
    parts = Parts(path)
    for pair in parts.plain["memory"]["pairs"]:
        if pair[0] == "place":
            pair[1] = value
    parts.save(path)
    model, envs = made("SAC", 5)
    before = whole(model, envs)
    with pytest.raises(ValueError, match=r"cannot resume from .*replay buffer"):
        read_checkpoint(path, model, envs)
    assert whole(model, envs) == before


@pytest.mark.parametrize("written", KINDS, indirect=True)
def test_a_checkpoint_restores_all(written):
    """The same numbers, and the same ones after the next rollout."""
    kind, path = written
    found = []
    for seed in (5, 6):
        model, envs = made(kind, seed)
        notes = read_checkpoint(path, model, envs)
        assert notes == vars(TrainingProgress())
        restored = whole(model, envs)
        model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
        found.append((restored, whole(model, envs)))
    assert found[0] == found[1]
