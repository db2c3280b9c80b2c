"""Training on the batch plant: one policy for all robots, judged on seeds held apart, resumable.

    tlf train residual --seeds 0,1,2

One call of :func:`train` is one seed: environments and a model are made, the formations are spread over
their episodes, and then rollouts and updates alternate. Every so often the policy is judged on choosing
seeds; the best one so far stands in ``policy.safetensors``. ``curve.json`` tells how it went.
"""

from __future__ import annotations

import inspect
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from baselines.runs.jobs import alone_in, claim
from baselines.runs.run import versions
from baselines.sb3 import FormationVecEnv
from baselines.training.checkpoint import read_checkpoint, write_checkpoint
from baselines.training.config import TrainConfig
from baselines.training.evaluate import evaluate, overall_mm
from baselines.training.export import export_policy
from baselines.training.imitation import imitate
from tlf_env.common.files import atomic
from tlf_env.numerics.compiled import sources_digest

POLICY, CHECKPOINT, CURVE, PLAN, STEPS = (
    "policy.safetensors",
    "checkpoint.safetensors",
    "curve.json",
    "plan.json",
    "robot_steps",
)
OFF_POLICY_STEPS = 64


@dataclass
class Progress:
    """What is told of a training so far; part of every checkpoint."""

    wall_time_s: float = 0.0
    rollouts: list[dict[str, float]] = field(default_factory=list)
    evaluations: list[dict[str, Any]] = field(default_factory=list)


def train(
    config: TrainConfig,
    seed: int,
    folder: Path,
    *,
    command: str = "",
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Train with one seed, from where the folder's checkpoint stands, and keep the best policy.

    After an interrupt (SIGINT) the present rollout and its update are finished, and a checkpoint is
    written; the next call goes on to the same result, bit for bit, as if nothing had happened.

    Parameters
    ----------
    seed
        Of the network, of the draws of actions and of the order of samples. The episodes are the
        same for every seed: formation k begins with the first of ``config.seeds`` + k.
    folder
        Gets ``policy.safetensors`` with its card, ``checkpoint.safetensors``, ``curve.json`` and
        TensorBoard's files.
    threads
        That step the formations; their number changes no result.
    progress
        Called with the robot steps done and those in all.

    Returns
    -------
    dict
        What ``curve.json`` holds.

    Raises
    ------
    ValueError
        if the folder holds another training, or a setting does not fit the algorithm.
    KeyboardInterrupt
        after an interrupt, once the checkpoint is written.
    """
    torch.set_num_threads(1)  # small networks: more threads would only wait for each other
    check_folder(config, seed, folder)
    with alone_in(folder):
        return _train(config, seed, folder, command, threads, progress)


def _train(
    config: TrainConfig,
    seed: int,
    folder: Path,
    command: str,
    threads: int,
    progress: Callable[[int, int], None] | None,
) -> dict[str, Any]:
    started = time.perf_counter()
    envs = make_envs(config, threads)
    model = make_model(config, envs, seed)
    model.set_logger(Logger(str(folder), tensorboard(folder)))
    if (folder / CHECKPOINT).exists():
        done = Progress(**read_checkpoint(folder / CHECKPOINT, model, envs))
    else:
        done = Progress()
        spread_out(model, envs, config.seeds[0])
        if config.imitation is not None:
            imitate(model, envs, config)
        judge(model, config, seed, folder, done, command)
    began = started - done.wall_time_s
    with interrupts() as stop:
        while model.num_timesteps < config.robot_steps:
            before = model.num_timesteps
            set_learning_rate(model, config)
            model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
            now, last = model.num_timesteps, model.num_timesteps >= config.robot_steps
            note(model, done)
            if last or passed(config.evaluation.every, before, now):
                judge(model, config, seed, folder, done, command)
            done.wall_time_s = time.perf_counter() - began
            if progress is not None:
                progress(min(now, config.robot_steps), config.robot_steps)
            stopping = bool(stop)
            if last or stopping or passed(config.checkpoint_every, before, now):
                write_checkpoint(folder / CHECKPOINT, model, envs, vars(done))
                write_curve(folder, config, seed, done)
            if stopping and not last:
                raise KeyboardInterrupt
    return write_curve(folder, config, seed, done)


def make_envs(config: TrainConfig, threads: int) -> FormationVecEnv:
    """All formations: every episode draws its disturbance among the config's."""
    tasks, shares = config.mixture()
    envs = FormationVecEnv(tasks, config.formations, mixture=shares, threads=threads)
    first, end = config.seeds
    if end - first < config.formations:
        raise ValueError(
            f"formations {config.formations} need as many seeds; there are {end - first}"
        )
    return envs


def make_model(config: TrainConfig, envs: FormationVecEnv, seed: int) -> Any:
    """A new model of SB3.

    Raises
    ------
    ValueError
        for settings that the algorithm does not know, or whose values it refuses.
    """
    network = config.network
    layers = list(network.hidden)
    policy: dict[str, Any] = {
        "net_arch": layers,
        "activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[network.activation],
        "log_std_init": network.initial_log_std,
    }
    make, kind = algorithm(config)
    if network.lstm is not None:
        policy |= {"lstm_hidden_size": network.lstm}
    if config.algorithm == "SAC":
        del policy["log_std_init"]  # it has a head for that
    known = set(inspect.signature(make).parameters) - {"policy", "env", "seed"}
    for name in config.settings:
        if name not in known:
            raise ValueError(f"settings.{name} is not one of {', '.join(sorted(known))}")
    try:
        model = make(kind, envs, policy_kwargs=policy, seed=seed, device="cpu", **config.settings)
    except (TypeError, AssertionError) as error:
        raise ValueError(f"settings: {config.algorithm} says: {error}") from error
    head = model.actor.mu if config.algorithm == "SAC" else model.policy.action_net
    with torch.no_grad():
        head.weight.mul_(network.action_gain)
        head.bias.mul_(network.action_gain)
    return model


def algorithm(config: TrainConfig) -> tuple[Callable[..., Any], str]:
    """The class of the algorithm, and SB3's name of its kind of policy.

    Raises
    ------
    ValueError
        if its package is missing.
    """
    if config.algorithm != "RecurrentPPO":
        return {"PPO": PPO, "SAC": SAC}[config.algorithm], "MlpPolicy"
    try:
        from sb3_contrib import RecurrentPPO
    except ModuleNotFoundError as error:
        raise ValueError("RecurrentPPO needs sb3-contrib (pip install 'tlf-env[train]')") from error
    return RecurrentPPO, "MlpLstmPolicy"


def spread_out(model: Any, envs: FormationVecEnv, first_seed: int) -> None:
    """Bring the formations to different moments of their episodes, as they will be later on.

    Without it all of them would start at once, and the first rollouts would show starts only.
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
        for plant, moments in zip(envs.plants, begin, strict=True):
            if (moments == step).any():
                plant.reset(mask=moments == step)
    model._last_obs = envs.observations()
    model._last_episode_starts = np.ones(envs.num_envs, dtype=np.bool_)


def rollout_steps(model: Any) -> int:
    """Robot steps of one call of ``learn``: PPO's rollout; SAC learns many times on the way."""
    steps = OFF_POLICY_STEPS if hasattr(model, "replay_buffer") else model.n_steps
    return int(steps) * int(model.n_envs)


def passed(every: int, before: int, now: int) -> bool:
    """Whether a multiple of ``every`` lies between."""
    return now // every > before // every


def set_learning_rate(model: Any, config: TrainConfig) -> None:
    """Let the learning rate fall linearly; SB3 itself would see one call of ``learn`` as a whole run."""
    first = config.settings.get("learning_rate", 3e-4)
    share = 1.0 - (1.0 - config.final_learning_rate_share) * min(
        model.num_timesteps / config.robot_steps, 1.0
    )
    model.lr_schedule = lambda _: first * share


def note(model: Any, done: Progress) -> None:
    """One line of a rollout and its update, for TensorBoard and ``curve.json``."""
    buffer = getattr(model, "rollout_buffer", None)
    if buffer is not None:
        done.rollouts.append(
            {
                "robot_steps": model.num_timesteps,
                "mean_reward": float(buffer.rewards.mean()),
                "action_std": float(model.policy.log_std.detach().exp().mean()),
            }
        )
        model.logger.record("rollout/mean_reward", done.rollouts[-1]["mean_reward"])
    model.logger.dump(model.num_timesteps)


def judge(
    model: Any, config: TrainConfig, seed: int, folder: Path, done: Progress, command: str
) -> None:
    """Evaluate the policy, and keep it if none before was as good."""
    seeds = range(*config.evaluation.seeds)
    cells = evaluate(model, config.evaluation_scenarios(), seeds)
    score_mm = overall_mm(cells)
    best_mm = min((one["score_mm"] for one in done.evaluations), default=math.inf)
    done.evaluations.append(
        {
            "robot_steps": model.num_timesteps,
            "score_mm": score_mm,
            "failed": sum(one.failed for one in cells.values()),
            "cells": {name: one._asdict() for name, one in cells.items()},
        }
    )
    model.logger.record("evaluation/score_mm", score_mm)
    model.logger.record("evaluation/failed", done.evaluations[-1]["failed"])
    for name, one in cells.items():
        model.logger.record(f"position_rmse_mm/{name}", one.position_rmse_mm)
    model.logger.dump(model.num_timesteps)
    if score_mm < best_mm:
        tasks, _ = config.mixture()
        export_policy(
            model,
            folder / POLICY,
            next(iter(tasks.values()))[0],
            training={
                "robot_steps": model.num_timesteps,
                "config": config.model_dump(mode="json"),
            },
            seeds={
                "learner": [seed],
                "episodes": config.seeds,
                "choosing": config.evaluation.seeds,
            },
            scores={"start": done.evaluations[0], "kept": done.evaluations[-1]},
            command=command,
        )


def write_curve(folder: Path, config: TrainConfig, seed: int, done: Progress) -> dict[str, Any]:
    """Write ``curve.json``."""
    curve = {
        "config": config.model_dump(mode="json"),
        "seed": seed,
        "versions": versions(),
        **vars(done),
    }
    with atomic(folder / CURVE, encoding="utf-8") as file:
        json.dump(curve, file, indent=1, allow_nan=False)
        file.write("\n")
    return curve


def check_folder(config: TrainConfig, seed: int, folder: Path) -> None:
    """Claim the folder for this training.

    Raises
    ------
    ValueError
        if it holds another one, or one of other sources of the simulation.
    """
    plan = {
        "config": config.model_dump(mode="json"),
        "seed": seed,
        "sources": sources_digest(),
        "torch": torch.__version__,
    }
    claim(folder / PLAN, plan, list(plan), "a training")


def tensorboard(folder: Path) -> list[Any]:
    """TensorBoard's writer, or none where it is not installed."""
    try:
        return [TensorBoardOutputFormat(str(folder))]
    except AssertionError:
        return []


@contextmanager
def interrupts() -> Iterator[list[int]]:
    """A list that is not empty once an interrupt has come; a second one ends at once.

    Outside the main thread, where no signal can be handled, it stays empty.
    """
    came: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        if came:
            raise KeyboardInterrupt
        came.append(number)

    try:
        before = signal.signal(signal.SIGINT, handle)
    except ValueError:
        yield came
        return
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)
