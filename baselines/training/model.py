"""Environments and models of a training, from its configuration."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecEnv

from baselines.sb3 import FormationVecEnv
from baselines.training.config import TrainConfig
from baselines.training.export import actor_of
from baselines.training.history import HistoryVecEnv
from baselines.training.offline import TD3BC, UPDATES_PER_CALL, read_data, standardised
from baselines.training.sensor_policy import SensorPolicy, SensorVecEnv
from tlf_env.common.errors import install_command
from tlf_env.task.warn import without_warnings

OFF_POLICY_STEPS = 64


def make_envs(config: TrainConfig, threads: int) -> FormationVecEnv:
    """All formations; every episode draws its disturbance from the config's. Gives no warning.

    With a history in the network, their observations contain it. Offline there is one formation of each task,
    which is never stepped.

    Raises
    ------
    ValueError
        if there are fewer seeds than formations.
    """
    tasks, shares = config.mixture()
    history = config.network.history
    formations = config.formations if config.offline is None else len(tasks)
    given: dict[str, Any] = {
        "mixture": shares,
        "threads": threads,
        "precision": config.precision,
        "infos": False,
    }
    with without_warnings():
        if history is None:
            envs = FormationVecEnv(tasks, formations, **given)
        else:
            kind = SensorVecEnv if config.network.input == "sensor" else HistoryVecEnv
            envs = kind(tasks, formations, history=history, **given)
    first, end = config.seeds
    if end - first < formations:
        raise ValueError(f"formations {formations} need as many seeds; there are {end - first}")
    return envs


def make_model(config: TrainConfig, envs: FormationVecEnv, seed: int) -> Any:
    """A new model of SB3; offline with its data.

    Raises
    ------
    ValueError
        for settings that the algorithm does not have, values that it refuses, or data that do not fit.
    """
    network, offline = config.network, config.offline
    layers = list(network.hidden)
    policy: dict[str, Any] = {
        "net_arch": layers,
        "activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[network.activation],
        "log_std_init": network.initial_log_std,  # only PPO's has an effect
    }
    if config.algorithm == "TD3BC":
        del policy["log_std_init"]  # it draws nothing
    kind: Any
    make, kind = algorithm(config)
    if isinstance(envs, SensorVecEnv):
        kind, policy["layer"] = SensorPolicy, envs.layer
    if network.lstm is not None:
        policy |= {"lstm_hidden_size": network.lstm}
    known = set(inspect.signature(make).parameters) - {"policy", "env", "seed", "data", "alpha"}
    for name in config.settings:
        if name not in known:
            raise ValueError(f"settings.{name} is not one of {', '.join(sorted(known))}")
    given: dict[str, Any] = dict(config.settings)
    seen: VecEnv = envs
    if offline is not None:
        data = read_data(offline.files, envs.plants[0].scenario)
        given |= {"data": data, "alpha": offline.alpha}
        seen = standardised(envs, data) if offline.normalise else envs
    try:
        model = make(kind, seen, policy_kwargs=policy, seed=seed, device="cpu", **given)
    except (TypeError, AssertionError) as error:
        raise ValueError(f"settings: {config.algorithm} refuses them: {error}") from error
    actor = actor_of(model)
    with torch.no_grad():
        actor.mean.weight.mul_(network.action_gain)
        actor.mean.bias.mul_(network.action_gain)
        if actor.head == "squashed_gaussian":  # its deviation is the output of a layer, too
            actor.log_std.weight.mul_(network.action_gain)
            actor.log_std.bias.fill_(network.initial_log_std)
    if isinstance(model.policy, SensorPolicy):
        model.policy.begin_at_reference()
    if config.algorithm == "TD3BC":
        model.actor_target.load_state_dict(model.actor.state_dict())
    return model


def algorithm(config: TrainConfig) -> tuple[Callable[..., Any], str]:
    """The class of the algorithm, and SB3's name for its kind of policy.

    Raises
    ------
    ValueError
        if its package is missing.
    """
    name = config.algorithm
    own: dict[str, Callable[..., Any]] = {"PPO": PPO, "SAC": SAC, "TD3BC": TD3BC}
    if name in own:
        return own[name], "MlpPolicy"
    try:
        import sb3_contrib
    except ModuleNotFoundError as error:
        raise ValueError(f"{name} needs sb3-contrib ({install_command('train')})") from error
    return getattr(sb3_contrib, name), "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy"


def spread_out(model: Any, envs: FormationVecEnv, first_seed: int) -> None:
    """Bring the formations to different moments of their episodes, as they are later in a training.

    Otherwise all of them would start at once, and the first rollouts would contain starts only.
    """
    envs.seed(first_seed)
    seen = envs.reset()
    longest = max(plant.scenario.horizon_steps for plant in envs.plants)
    begin = [
        longest - (np.arange(plant.formations) * plant.scenario.horizon_steps) // plant.formations
        for plant in envs.plants
    ]
    state, starts = None, np.ones(envs.num_envs, dtype=np.bool_)
    for step in range(longest):
        actions, state = model.predict(seen, state, starts, deterministic=True)
        seen, _, starts, _ = envs.step(actions)
        for plant, moments in enumerate(begin):
            if (moments == step).any():
                envs.begin_next(plant, moments == step)
    envs.clear_statistics()
    model._last_obs = envs.observations()
    model._last_episode_starts = np.ones(envs.num_envs, dtype=np.bool_)


def rollout_steps(model: Any) -> int:
    """Robot steps of one call of ``learn``: PPO's rollout; the others update many times during the call."""
    if isinstance(model, TD3BC):
        return UPDATES_PER_CALL * int(model.batch_size)
    steps = OFF_POLICY_STEPS if hasattr(model, "replay_buffer") else model.n_steps
    return int(steps) * int(model.n_envs)


def set_learning_rate(model: Any, config: TrainConfig) -> None:
    """Let the learning rate fall linearly; SB3's own schedule covers one call of ``learn`` only."""
    first = config.settings.get("learning_rate", 3e-4)
    share = 1.0 - (1.0 - config.final_learning_rate_share) * min(
        model.num_timesteps / config.robot_steps, 1.0
    )
    model.lr_schedule = lambda _: first * share
