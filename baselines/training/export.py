"""Export of a stable-baselines3 model as a policy that runs without it. Only the export needs torch."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from baselines.policies.card import WEIGHTS, Card, write_policy
from baselines.policies.learned import LearnedPolicy, load_policy
from baselines.policies.network import Head, Network
from baselines.runs.provenance import installed_versions, versions
from baselines.training.history import ModelPolicy, history_of
from baselines.training.sensor_policy import SensorPolicy
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import Scenario

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

TRAINERS = ("torch", "stable-baselines3", "sb3-contrib")
ALGORITHMS = ("PPO", "SAC", "RecurrentPPO", "TD3", "TD3BC")
HEADS: dict[str, Head] = {
    "SAC": "squashed_gaussian",
    "TD3": "tanh",
    "TD3BC": "tanh",
}  # of the others: gaussian
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
        SB3's PPO, SAC or TD3, :class:`~baselines.training.offline.TD3BC`, or sb3-contrib's
        RecurrentPPO with an ``MlpPolicy`` (``MlpLstmPolicy``, one layer): tanh or ReLU, no gSDE, actions
        in [−1, 1]². The statistics of a ``VecNormalize`` that normalises observations are exported, too,
        and the history of a :class:`~baselines.training.history.HistoryVecEnv`.
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
    if algorithm not in ALGORITHMS:
        raise ValueError(f"a {algorithm} model cannot be exported; {', '.join(ALGORITHMS)} can")
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
    if type(model).__name__ == "SAC":
        actor = model.policy.actor
        hidden, mean = actor.latent_pi, actor.mu
        tensors = _dense("log_std", actor.log_std)
    elif HEADS.get(type(model).__name__) == "tanh":
        *hidden, mean, _ = model.policy.actor.mu
        tensors = {}
    else:
        hidden, mean = model.policy.mlp_extractor.policy_net, model.policy.action_net
        tensors = {"log_std": _array(model.policy.log_std)}
    lstm = getattr(model.policy, "lstm_actor", None)
    if lstm is not None:
        if lstm.num_layers != 1:
            raise ValueError(
                f"an LSTM of {lstm.num_layers} layers cannot be exported; 1 layer is supported"
            )
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            tensors[f"lstm.{name}"] = _array(getattr(lstm, f"{name}_l0"))
    layers, activations = list(hidden)[::2], {type(one).__name__ for one in list(hidden)[1::2]}
    plain = model.policy.plain_layers() if isinstance(model.policy, SensorPolicy) else None
    linear = all(type(layer).__name__ == "Linear" for layer in layers)
    if not linear or len(hidden) % 2 or activations not in (set(), {"Tanh"}, {"ReLU"}):
        raise ValueError(
            f"hidden layers must be linear with tanh or with ReLU, got {' '.join(str(hidden).split())}"
        )
    if plain is not None:
        *inner, last = plain
        for name, dense in [*((f"hidden.{i}", one) for i, one in enumerate(inner)), ("mean", last)]:
            tensors |= {f"{name}.weight": dense.weight, f"{name}.bias": dense.bias}
    else:
        for i, layer in enumerate(layers):
            tensors |= _dense(f"hidden.{i}", layer)
        tensors |= _dense("mean", mean)
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
            len(tensors[f"hidden.{i}.bias"]) for i in range(len(plain[:-1] if plain else layers))
        ),
        activation="relu" if "ReLU" in activations else "tanh",
        history=history,
        lstm=None if lstm is None else lstm.hidden_size,
        head=HEADS.get(type(model).__name__, "gaussian"),
        normalised=normalised,
    )
    return network, tensors


def _dense(name: str, layer: Any) -> dict[str, np.ndarray]:
    return {f"{name}.weight": _array(layer.weight), f"{name}.bias": _array(layer.bias)}


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
