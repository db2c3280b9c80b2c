"""The whole state of a training in one safetensors file; a resumed training ends with the same result.

Nothing is pickled: a checkpoint holds numbers and JSON, and reading it runs no code.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from baselines.sb3 import FormationVecEnv
from baselines.training.checkpoint_checks import (
    BUFFERED,
    check_counts,
    check_memory,
    check_notes,
    check_parameters,
    checked_generators,
    checked_numbers,
    learns_offline,
    put_back,
)
from baselines.training.history import HistoryVecEnv
from baselines.training.offline import DataBuffer
from tlf_env.common.files import atomic

TENSOR = "tensor:"  # marks a tensor's name in the tree of plain values


def write_checkpoint(path: Path, model: Any, envs: FormationVecEnv, notes: dict[str, Any]) -> None:
    """Write a model of SB3, its environments and all random generators, atomically.

    Parameters
    ----------
    model
        PPO, SAC, RecurrentPPO or TD3BC between two calls of ``learn``.
    notes
        The fields of :class:`~baselines.training.curve.TrainingProgress`; :func:`read_checkpoint` returns
        them.
    """
    tensors: dict[str, torch.Tensor] = {"torch_generator": torch.get_rng_state()}
    # SB3 shuffles its samples with NumPy's global generator, so a resumed training needs its state.
    kind, keys, place, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - SB3 draws from it
    tensors["numpy_generator"] = torch.from_numpy(np.asarray(keys).copy())
    plain = {
        "notes": notes,
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "numpy_generator": [kind, place, has_gauss, gauss],
        "action_generator": model.action_space.np_random.bit_generator.state,
        "parameters": _without_tensors(model.get_parameters(), "model", tensors),
        "memory": _without_tensors(_memory(model), "memory", tensors),
        "last_ends": list(envs.last_ends),
    }
    if not learns_offline(model):  # else no episode runs
        for i, plant in enumerate(envs.plants):
            for name, array in plant.get_state().numbers.items():
                tensors[f"plant_{i}/{name}"] = torch.from_numpy(array.copy())
    if isinstance(envs, HistoryVecEnv):
        tensors["history"] = torch.from_numpy(envs.memory)
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    data = save(contiguous, metadata={"state": json.dumps(plain)})
    with atomic(path, "wb") as file:
        file.write(data)


def read_checkpoint(path: Path, model: Any, envs: FormationVecEnv) -> dict[str, Any]:
    """Restore the state of a checkpoint in a new model and new environments; returns its notes.

    Raises
    ------
    ValueError
        in one line, if the file is damaged, belongs to a training with other settings, or holds a number
        that no training has. Then nothing has changed.
    """
    try:
        with safe_open(path, "pt") as file:
            names = list(file.keys())  # safetensors' file cannot be iterated
            tensors = {name: file.get_tensor(name) for name in names}
            plain = json.loads(file.metadata()["state"])
        parameters = _with_tensors(plain["parameters"], tensors)
        memory = _with_tensors(plain["memory"], tensors)
        check_parameters(parameters, model)
        check_memory(memory, model, envs)
        check_counts(plain, model)
        check_notes(plain["notes"])
        generators = checked_generators(plain, tensors)
        history = None
        if isinstance(envs, HistoryVecEnv):
            layout = {"history": (envs.memory.dtype, envs.memory.shape)}
            history = checked_numbers("", {"history": tensors["history"]}, layout)["history"]
        used = {"torch_generator", "numpy_generator", "history"}
        unknown = sorted(
            name
            for name in {*tensors} - used
            if not name.startswith(("model.", "memory.", "plant_"))
        )
        if unknown:
            raise ValueError(f"it has {unknown[0]!r}, which no training has")
        if not learns_offline(model):
            put_back(envs.plants, tensors)
    except (
        SafetensorError,
        AttributeError,
        KeyError,
        IndexError,
        ValueError,
        TypeError,
        RuntimeError,
        OverflowError,
    ) as error:
        said = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"cannot resume from {path}: {' '.join(said.split())}") from error
    model.set_parameters(parameters, exact_match=True)
    _remember(model, memory)
    if history is not None:
        envs.memory[...] = history
    envs.last_ends.clear()
    envs.last_ends.extend(plain["last_ends"])
    np.random.set_state(generators.numpy)  # noqa: NPY002 - SB3 draws from it
    model.action_space.np_random.bit_generator.state = generators.actions
    torch.set_rng_state(generators.torch)
    model.num_timesteps, model._n_updates = plain["steps"], plain["updates"]
    notes: dict[str, Any] = plain["notes"]
    return notes


def _memory(model: Any) -> dict[str, Any]:
    """State of a model between two calls of ``learn``, in addition to its parameters."""
    kept: dict[str, Any] = {}
    if model._last_obs is not None:  # offline no episode runs
        kept["last_observations"] = torch.from_numpy(model._last_obs)
        kept["starts"] = torch.from_numpy(np.asarray(model._last_episode_starts))
    for name in model._get_torch_save_params()[1]:  # SAC's temperature is not among the parameters
        kept[name] = getattr(model, name)
    states = getattr(model, "_last_lstm_states", None)
    if states is not None:
        kept["lstm"] = [list(states.pi), list(states.vf)]
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None and not isinstance(buffer, DataBuffer):
        rows = buffer.buffer_size if buffer.full else buffer.pos
        kept |= {"place": buffer.pos, "full": bool(buffer.full)}
        kept |= {name: torch.from_numpy(getattr(buffer, name)[:rows]) for name in BUFFERED}
    return kept


def _remember(model: Any, kept: dict[str, Any]) -> None:
    if "last_observations" in kept:
        model._last_obs = kept["last_observations"].numpy().copy()
        model._last_episode_starts = kept["starts"].numpy().copy()
    for name in model._get_torch_save_params()[1]:
        getattr(model, name).data.copy_(kept[name])  # in place: the optimizer refers to it
    if "lstm" in kept:
        policy, critic = (tuple(pair) for pair in kept["lstm"])
        model._last_lstm_states = type(model._last_lstm_states)(policy, critic)
    if "place" in kept:
        buffer = model.replay_buffer
        buffer.pos, buffer.full = kept["place"], kept["full"]
        for name in BUFFERED:
            rows = kept[name].numpy()
            getattr(buffer, name)[: len(rows)] = rows


def _without_tensors(tree: Any, place: str, tensors: dict[str, torch.Tensor]) -> Any:
    """The tree as JSON values; its tensors are moved to ``tensors``, named by their places."""
    if isinstance(tree, torch.Tensor):
        tensors[place] = tree
        return TENSOR + place
    if isinstance(tree, dict):  # a list of pairs: the keys of an optimizer's state are numbers
        pairs = [[k, _without_tensors(v, f"{place}.{k}", tensors)] for k, v in tree.items()]
        return {"pairs": pairs}
    if isinstance(tree, list | tuple):
        return [_without_tensors(v, f"{place}.{i}", tensors) for i, v in enumerate(tree)]
    return tree


def _with_tensors(tree: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(tree, str) and tree.startswith(TENSOR):
        return tensors[tree.removeprefix(TENSOR)]
    if isinstance(tree, dict):
        return {k: _with_tensors(v, tensors) for k, v in tree["pairs"]}
    if isinstance(tree, list):
        return [_with_tensors(v, tensors) for v in tree]
    return tree
