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
from baselines.training.history import HistoryVecEnv
from baselines.training.offline import DataBuffer
from tlf_env.common.files import atomic

TENSOR = "tensor:"  # marks a tensor's name in the tree of plain values
BUFFERED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def write_checkpoint(path: Path, model: Any, envs: FormationVecEnv, notes: dict[str, Any]) -> None:
    """Write a model of SB3, its environments and all random generators, atomically.

    Parameters
    ----------
    model
        PPO, SAC, RecurrentPPO or TD3BC between two calls of ``learn``.
    notes
        Any JSON values; :func:`read_checkpoint` returns them.
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
    for i, plant in enumerate(envs.plants):
        for name, array in plant.arrays._asdict().items():
            tensors[f"plant.{i}.{name}"] = torch.from_numpy(array)
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
        if the file is damaged, or belongs to a training with other settings.
    """
    try:
        with safe_open(path, "pt") as file:
            names = list(file.keys())  # safetensors' file cannot be iterated
            tensors = {name: file.get_tensor(name) for name in names}
            plain = json.loads(file.metadata()["state"])
        model.set_parameters(_with_tensors(plain["parameters"], tensors), exact_match=True)
        _remember(model, _with_tensors(plain["memory"], tensors))
        for i, plant in enumerate(envs.plants):
            for name, array in plant.arrays._asdict().items():
                array[...] = tensors[f"plant.{i}.{name}"].numpy()
            plant._seeded[:] = True
        if isinstance(envs, HistoryVecEnv):
            envs.memory[...] = tensors["history"].numpy()
        envs.last_ends.extend(plain["last_ends"])
        kind, *rest = plain["numpy_generator"]
        keys = tensors["numpy_generator"].numpy()
        np.random.set_state((kind, keys, *rest))  # noqa: NPY002 - SB3 draws from it
        model.action_space.np_random.bit_generator.state = plain["action_generator"]
        torch.set_rng_state(tensors["torch_generator"])
    except (SafetensorError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"cannot resume from {path}: {' '.join(str(error).split())}") from error
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
        model._last_obs = kept["last_observations"].numpy()
        model._last_episode_starts = kept["starts"].numpy()
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
