"""Export of a stable-baselines3 model as a policy that runs without it. Only the export needs torch."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from baselines.policies.card import WEIGHTS, Card, write_policy
from baselines.policies.learned import LearnedPolicy, load_policy
from baselines.policies.network import Head, Network
from baselines.runs.provenance import installed_versions, versions
from baselines.training.config import ALGORITHMS
from baselines.training.history import ModelPolicy, history_of
from baselines.training.sensor_policy import SensorPolicy
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import Scenario

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

TRAINERS = ("torch", "stable-baselines3", "sb3-contrib")
NORMALISING = "BatchRenorm1d"  # the layer of CrossQ before each dense one
EXPORTABLE = (*ALGORITHMS, "TD3")
AGREEMENT = 1e-5  # largest difference between an action of the model and of its copy
CHECKED_ROWS, CHECKED_STEPS = 32, 4


def export_policy(
    model: BaseAlgorithm,
    path: str | Path,
    scenario: Scenario,
    *,
    training: Mapping[str, Any],
    seeds: Mapping[str, Iterable[int]],
    scores: Mapping[str, Any] | None = None,
    command: str = "",
) -> Card:
    """Write a trained model as ``NAME.safetensors`` and ``NAME.json``, atomically.

    Before anything is written to ``path``, a copy is loaded and its actions are compared with the model's
    on random observations. A model with parts that the export does not support is refused.

    Parameters
    ----------
    model
        SB3's PPO, SAC or TD3, :class:`~baselines.training.offline.TD3BC`, or sb3-contrib's TQC, CrossQ or
        RecurrentPPO with an ``MlpPolicy`` (``MlpLstmPolicy``, one layer): tanh or ReLU, no gSDE, actions
        in [−1, 1]². The statistics of a ``VecNormalize`` that normalises observations are exported, too,
        and the history of a :class:`~baselines.training.history.HistoryVecEnv`. CrossQ's normalisation
        within the network becomes part of the layers behind it.
    path
        Ends in ``.safetensors``.
    scenario
        The scenario of the training.
    training
        Settings of the algorithm, environment steps, wall time: any JSON values, for the card.
    seeds
        The seeds of everything that was seeded: ``{"learner": [0], "episodes": range(64)}``.
    scores
        The scores that the policy reached, for the card.
    command
        The command that made it.

    Raises
    ------
    ValueError
        for an unsupported model, or one that does not fit the scenario.
    """
    path = Path(path)
    if path.suffix.lower() != WEIGHTS:
        raise ValueError(f"{path}: the name of a policy must end in {WEIGHTS}")
    algorithm = type(model).__name__
    if algorithm not in EXPORTABLE:
        raise ValueError(f"a {algorithm} model cannot be exported; {', '.join(EXPORTABLE)} can")
    network, tensors = _network_of(model)
    card: dict[str, Any] = {
        "algorithm": algorithm,
        "training": training,
        "seeds": {name: tuple(values) for name, values in seeds.items()},
        "versions": versions() | installed_versions(TRAINERS),
        "scores": scores or {},
        "command": command,
    }
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / path.name
        write_policy(trial, network, tensors, scenario, **card)
        _check_agreement(model, load_policy(trial))
    return write_policy(path, network, tensors, scenario, **card)


def _network_of(model: BaseAlgorithm) -> tuple[Network, dict[str, np.ndarray]]:
    """The network of a model, and its tensors by name."""
    box = model.action_space
    if box.shape != (ACTION_SIZE,) or (box.low != -1).any() or (box.high != 1).any():
        raise ValueError(f"the model's actions must be a Box of [−1, 1]², got {box}")
    if getattr(model, "use_sde", False):
        raise ValueError("a model with gSDE cannot be exported")
    actor = actor_of(model)
    tensors: dict[str, np.ndarray] = {}
    if actor.head == "gaussian":
        tensors["log_std"] = _array(actor.log_std)
    lstm = getattr(model.policy, "lstm_actor", None)
    if lstm is not None:
        if lstm.num_layers != 1:
            raise ValueError(
                f"an LSTM of {lstm.num_layers} layers cannot be exported; 1 layer is supported"
            )
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            tensors[f"lstm.{name}"] = _array(getattr(lstm, f"{name}_l0"))
    chain = [one for one in actor.hidden if type(one).__name__ != NORMALISING]
    layers, activations = chain[::2], {type(one).__name__ for one in chain[1::2]}
    linear = all(type(layer).__name__ == "Linear" for layer in layers)
    if not linear or len(chain) % 2 or activations not in (set(), {"Tanh"}, {"ReLU"}):
        hidden = " ".join(str(one) for one in actor.hidden)
        raise ValueError(f"hidden layers must be linear with tanh or with ReLU, got {hidden}")
    tensors |= _plain(model.policy) if isinstance(model.policy, SensorPolicy) else _folded(actor)
    history = history_of(model)
    if history is not None and lstm is not None:
        raise ValueError("a model with an LSTM and a history cannot be exported")
    normaliser = model.get_vec_normalize_env()
    normalised = normaliser is not None and normaliser.norm_obs
    if normalised:
        tensors |= {
            "normalise.mean": normaliser.obs_rms.mean,
            "normalise.var": normaliser.obs_rms.var,
            "normalise.epsilon": np.array(normaliser.epsilon),
            "normalise.clip": np.array(normaliser.clip_obs),
        }
    network = Network(
        hidden=tuple(
            len(tensors[name]) for name in tensors if re.match(r"hidden\.\d+\.bias", name)
        ),
        activation="relu" if "ReLU" in activations else "tanh",
        history=history,
        lstm=None if lstm is None else lstm.hidden_size,
        head=actor.head,
        normalised=normalised,
    )
    return network, tensors


class Actor(NamedTuple):
    """What acts in a model: its hidden layers and activations, and the layers behind them."""

    hidden: list[Any]
    mean: Any  # the last layer, before a tanh
    log_std: Any  # numbers, or a layer beside the last one; None if nothing is drawn
    head: Head


def actor_of(model: Any) -> Actor:
    """The actor of a model of SB3 or sb3-contrib."""
    policy = model.policy
    actor = getattr(policy, "actor", None)
    if actor is None:
        hidden = list(policy.mlp_extractor.policy_net)
        return Actor(hidden, policy.action_net, policy.log_std, "gaussian")
    if hasattr(actor, "log_std"):
        return Actor(list(actor.latent_pi), actor.mu, actor.log_std, "squashed_gaussian")
    *hidden, mean, _ = actor.mu
    return Actor(hidden, mean, None, "tanh")


def _plain(policy: SensorPolicy) -> dict[str, np.ndarray]:
    """Tensors of a sensor policy as plain layers."""
    *inner, last = policy.plain_layers()
    named = {f"hidden.{i}": one for i, one in enumerate(inner)} | {"mean": last}
    return {
        f"{name}.{part}": getattr(layer, part)
        for name, layer in named.items()
        for part in ("weight", "bias")
    }


def _folded(actor: Actor) -> dict[str, np.ndarray]:
    """Tensors of the hidden layers and the heads, with the normalisation before each of them in it.

    Once a network is trained, its normalisation is y = a·x + b for each unit, so that W·y + c is
    (W·a)·x + (W·b + c): one layer.
    """
    tensors: dict[str, np.ndarray] = {}
    scale: Any = 1.0
    shift: Any = 0.0

    def keep(name: str, layer: Any) -> None:
        weight = _array(layer.weight).astype(np.float64)
        bias = _array(layer.bias) + weight @ np.broadcast_to(shift, weight.shape[1])
        tensors[f"{name}.weight"] = (weight * scale).astype(np.float32)
        tensors[f"{name}.bias"] = bias.astype(np.float32)

    layers = 0
    for one in actor.hidden:
        kind = type(one).__name__
        if kind == NORMALISING:
            mean, var = (_array(part).astype(np.float64) for part in (one.ra_mean, one.ra_var))
            scale = _array(one.scale) / np.sqrt(var + one.eps)
            shift = _array(one.bias) - scale * mean
        elif kind == "Linear":
            keep(f"hidden.{layers}", one)
            layers, scale, shift = layers + 1, 1.0, 0.0
    keep("mean", actor.mean)
    if actor.head == "squashed_gaussian":
        keep("log_std", actor.log_std)
    return tensors


def _array(tensor: Any) -> np.ndarray:
    array: np.ndarray = tensor.detach().cpu().numpy()
    return array


def _check_agreement(model: BaseAlgorithm, policy: LearnedPolicy) -> None:
    """Compare the actions of a few steps, a whole history at least; some rows start anew in between.

    Raises
    ------
    ValueError
        if they differ by more than :data:`AGREEMENT`.
    """
    model_policy = ModelPolicy(model)
    history = policy.card.network.history
    remembered = 0 if history is None else history.observations * history.mean_of
    generator = np.random.default_rng(0)
    shape = (CHECKED_ROWS, len(policy.card.entries))
    state, theirs = None, None
    for step in range(CHECKED_STEPS + remembered):
        seen = np.clip(generator.normal(size=shape), -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
        seen = seen.astype(np.float32)
        start = generator.random(CHECKED_ROWS) < (1.0 if step == 0 else 0.3 / (1 + remembered))
        action, state = policy.predict(seen, state, start, True)
        wanted, theirs = model_policy.predict(seen, theirs, start, deterministic=True)
        apart = float(np.abs(action - wanted).max())
        if not apart <= AGREEMENT:
            raise ValueError(
                f"the model cannot be exported: actions of its copy differ from its own by {apart:.2g}"
            )
