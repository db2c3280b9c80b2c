"""What the numbers of a checkpoint must be before a training goes on; the checks are those of a snapshot."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.save_util import recursive_getattr

from baselines.sb3 import FormationVecEnv
from baselines.training.curve import TrainingProgress
from baselines.training.offline import DataBuffer
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.snapshot import Layout, Snapshot
from tlf_env.task.info import EndReason

BUFFERED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
MERSENNE_TWISTER = 624  # numbers of NumPy's global generator, whose place is at most their count


class Generators(NamedTuple):
    """States of the random generators."""

    numpy: tuple[Any, ...]
    actions: dict[str, Any]
    torch: torch.Tensor


def learns_offline(model: Any) -> bool:
    """Whether a model learns from data alone; then no episode runs."""
    return isinstance(getattr(model, "replay_buffer", None), DataBuffer)


def checked_numbers(
    name: str, found: Mapping[str, torch.Tensor], layout: Layout
) -> dict[str, np.ndarray]:
    """Tensors as arrays, if they are those of a layout, and finite.

    Raises
    ------
    ValueError
        as :meth:`tlf_env.engine.snapshot.Snapshot.part` does, and for one too many.
    """
    more = sorted(map(str, {*found} - {*layout}))
    if more:
        raise ValueError(f"{name}/{more[0]} is in no training")
    numbers = {f"{name}/{key}": _array(f"{name}/{key}", one) for key, one in found.items()}
    return Snapshot("training", {}, {}, numbers).part(name, layout)


def _array(place: str, value: Any) -> np.ndarray:
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{place} is no array of numbers")
    return value.numpy().copy()


def _layout(tensors: Mapping[str, torch.Tensor]) -> dict[str, tuple[Any, tuple[int, ...]]]:
    """Types and shapes of some tensors."""
    arrays = {name: one.detach().cpu().numpy() for name, one in tensors.items()}
    return {name: (one.dtype, one.shape) for name, one in arrays.items()}


def check_parameters(found: Any, model: Any) -> None:
    """Check weights and the state of the optimizers against a model.

    Raises
    ------
    ValueError
        in one line that names the first difference.
    """
    here = model.get_parameters()
    if {*found} != {*here}:
        raise ValueError(f"it has the parts {sorted(found)}, not {sorted(here)}")
    for name, value in here.items():
        part = recursive_getattr(model, name)
        if isinstance(part, torch.optim.Optimizer):
            _check_optimizer(name, found[name], part)
        else:
            checked_numbers(name, found[name], _layout(value))


def _check_optimizer(name: str, found: Any, optimizer: torch.optim.Optimizer) -> None:
    here = optimizer.state_dict()
    if _settings(found) != _settings(here):
        raise ValueError(f"{name} has other settings than this training")
    parameters = [one for group in optimizer.param_groups for one in group["params"]]
    for number, fields in found["state"].items():
        if type(number) is not int or not 0 <= number < len(parameters):
            raise ValueError(f"{name} has no parameter {number!r}")
        layout = _layout(dict.fromkeys(fields, parameters[number]))
        if "step" in layout:
            layout["step"] = (np.float32, ())
        checked_numbers(f"{name}.{number}", fields, layout)


def _settings(state: Mapping[str, Any]) -> Any:
    """Settings of an optimizer; the training itself sets the rate before every rollout."""
    groups = [
        {key: value for key, value in group.items() if key != "lr"}
        for group in state["param_groups"]
    ]
    return json.loads(json.dumps(groups))  # pairs of numbers as lists


def check_memory(found: Any, model: Any, envs: FormationVecEnv) -> None:
    """Check what a model remembers beside its parameters.

    Raises
    ------
    ValueError
        in one line that names the first difference.
    """
    names = model._get_torch_save_params()[1]
    tensors = {name: getattr(model, name) for name in names}
    layout: dict[str, tuple[Any, tuple[int | None, ...]]] = {**_layout(tensors)}
    buffer = getattr(model, "replay_buffer", None)
    if not learns_offline(model):
        space, robots = envs.observation_space, envs.num_envs
        layout["last_observations"] = (space.dtype, (robots, *(space.shape or ())))
        layout["starts"] = (np.bool_, (robots,))
        if buffer is not None:
            rows = _check_place(found, buffer.buffer_size)
            for name in BUFFERED:
                array = getattr(buffer, name)
                layout[name] = (array.dtype, (rows, *array.shape[1:]))
    states = getattr(model, "_last_lstm_states", None)
    others = {"place", "full"} if buffer is not None and not learns_offline(model) else set()
    if states is not None:
        others.add("lstm")
        pairs = (states.pi, states.vf)
        for i, pair in enumerate(pairs):
            for k, state in enumerate(pair):
                one = {f"{i}.{k}": found["lstm"][i][k]}
                checked_numbers("memory/lstm", one, _layout({f"{i}.{k}": state}))
        if [len(one) for one in found["lstm"]] != [len(pair) for pair in pairs]:
            raise ValueError("memory/lstm has another form")
    checked_numbers("memory", {key: found[key] for key in {*found} - others}, layout)


def _check_place(found: Mapping[str, Any], size: int) -> int:
    """How many rows of a replay buffer are filled."""
    place, full = found["place"], found["full"]
    if type(place) is not int or type(full) is not bool or not 0 <= place <= size:
        raise ValueError(f"its replay buffer of {size} rows ends at {place!r}")
    return size if full else place


def check_counts(plain: Mapping[str, Any], model: Any) -> None:
    """Check how far a training is, and how its last episodes ended.

    Raises
    ------
    ValueError
        in one line.
    """
    counts = plain["steps"], plain["updates"]
    if any(type(one) is not int or one < 0 for one in counts):
        raise ValueError(f"its number of steps and of updates must be at least 0, got {counts}")
    ends = plain["last_ends"]
    known = {int(end) for end in EndReason}
    if not isinstance(ends, list) or any(type(one) is not int or one not in known for one in ends):
        raise ValueError("its last ends are none of an episode")


def check_notes(notes: Any) -> None:
    """Check the record of a training: the fields and types of a new one.

    Raises
    ------
    ValueError
        in one line.
    """
    usual = {
        one.name: getattr(TrainingProgress(), one.name)
        for one in dataclasses.fields(TrainingProgress)
    }
    if not isinstance(notes, dict) or {*notes} != {*usual}:
        raise ValueError(f"its record must have the fields {', '.join(usual)}")
    for name, value in usual.items():
        if type(notes[name]) is not type(value):
            raise ValueError(f"its record has the {name} {str(notes[name])[:40]!r}")


def checked_generators(plain: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> Generators:
    """States of all random generators.

    Raises
    ------
    ValueError
        in one line, for a state that a generator refuses, or should refuse.
    """
    kind, place, has_gauss, gauss = plain["numpy_generator"]
    keys = tensors["numpy_generator"].numpy()
    usual: Any = np.random.RandomState(0).get_state()
    fits = kind == usual[0] and keys.dtype == usual[1].dtype and keys.shape == usual[1].shape
    if not fits or type(place) is not int or not 0 <= place <= MERSENNE_TWISTER:
        raise ValueError("its state of NumPy's random generator is none")
    np.random.RandomState(0).set_state((kind, keys, place, has_gauss, gauss))
    np.random.default_rng(0).bit_generator.state = plain["action_generator"]
    own = torch.get_rng_state()
    given = tensors["torch_generator"]
    if given.dtype != own.dtype or given.shape != own.shape:
        raise ValueError("its torch_generator is no state of torch's random generator")
    torch.Generator().set_state(given)
    return Generators((kind, keys, place, has_gauss, gauss), plain["action_generator"], given)


def put_back(plants: Sequence[BatchPlant], tensors: Mapping[str, torch.Tensor]) -> None:
    """Put plants back to the states of a checkpoint: all, or none.

    Raises
    ------
    ValueError
        in one line, for a state that :meth:`tlf_env.engine.batch.BatchPlant.set_state` refuses.
    """
    before = [_state_of(plant) for plant in plants]
    states = []
    for i, here in enumerate(before):
        start = f"plant_{i}/"
        numbers = {
            name.removeprefix(start): one.numpy().copy()
            for name, one in tensors.items()
            if name.startswith(start)
        }
        missing = [name for name in here.numbers if name not in numbers]
        more = [name for name in numbers if name not in here.numbers]
        for name in missing:
            raise ValueError(f"{start}{name} is missing")
        for name in more:
            raise ValueError(f"{start}{name} is in no training")
        states.append(here.within(here.kind, {}, {}, {}, numbers))
    try:
        for plant, state in zip(plants, states, strict=True):
            plant.set_state(state)
    except ValueError:
        for plant, state in zip(plants, before, strict=True):
            plant.set_state(state)
        raise


def _state_of(plant: BatchPlant) -> Snapshot:
    """The state of a plant; one that is new begins its episodes."""
    try:
        return plant.get_state()
    except RuntimeError:
        plant.reset(0)
        return plant.get_state()
