"""Training on the batch plant: one policy for all robots, judged on seeds held apart, resumable.

    tlf train configs/train/residual.yaml --seeds 0,1,2

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from baselines.card import CARD
from baselines.checkpoint import read_checkpoint, write_checkpoint
from baselines.export import export_policy
from baselines.pool import run_jobs
from baselines.run import run_seeds, versions
from baselines.sb3 import FormationVecEnv
from baselines.train_config import TrainConfig
from tlf_env.numerics.compiled import sources_digest
from tlf_env.numerics.files import atomic
from tlf_env.onboard.parts import Policy
from tlf_env.task.scenario import Scenario

POLICY, CHECKPOINT, CURVE, PLAN, STEPS = (
    "policy.safetensors",
    "checkpoint.safetensors",
    "curve.json",
    "plan.json",
    "robot_steps",
)
FAILED_MM = 1000.0  # what a run counts for in which a robot is lost or touches another
SMALLEST_MM = 0.1
OFF_POLICY_STEPS = 64
MEASURED = ("position_rmse_mm", "error_capped_mean_mm", "torque_rms_Nmm")


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
    envs = make_envs(config)
    model = make_model(config, envs, seed)
    model.set_logger(Logger(str(folder), tensorboard(folder)))
    if (folder / CHECKPOINT).exists():
        done = Progress(**read_checkpoint(folder / CHECKPOINT, model, envs))
    else:
        done = Progress()
        spread(model, envs, config.seeds[0])
        judge(model, config, seed, folder, done, command)
    began = time.perf_counter() - done.wall_time_s
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


def make_envs(config: TrainConfig) -> FormationVecEnv:
    """All formations: every episode draws its disturbance among the config's."""
    tasks, shares = config.mixture()
    envs = FormationVecEnv(tasks, config.formations, mixture=shares)
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


def spread(model: Any, envs: FormationVecEnv, first_seed: int) -> None:
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


class Cell(NamedTuple):
    """One task under one disturbance, over the seeds: medians of the worst robot, and failures."""

    position_rmse_mm: float
    error_capped_mean_mm: float
    torque_rms_Nmm: float
    failed: int  # runs in which a robot was lost or touched another
    runs: int
    score_mm: float  # geometric mean of the position RMS, FAILED_MM for a failed run


def evaluate(policy: Policy, config: TrainConfig) -> dict[str, Cell]:
    """Every task and disturbance of ``config.evaluation``, by ``"task, disturbance"``."""
    seeds = range(*config.evaluation.seeds)
    return {
        f"{task}, {disturbance}": cell(policy, scenario, seeds)
        for (task, disturbance), scenario in config.evaluation_scenarios().items()
    }


def cell(policy: Policy, scenario: Scenario, seeds: range) -> Cell:
    """One scenario over the seeds."""
    worst, failed = [], []
    for record in run_seeds(scenario, policy, seeds):
        robots = record.metrics()
        worst.append([max(getattr(robot, name) for robot in robots) for name in MEASURED])
        failed.append(any(robot.lost or robot.touched for robot in robots))
    table = np.array(worst)
    counted = np.where(failed, FAILED_MM, np.clip(table[:, 0], SMALLEST_MM, FAILED_MM))
    return Cell(
        **dict(zip(MEASURED, np.median(table, axis=0).tolist(), strict=True)),
        failed=sum(failed),
        runs=len(failed),
        score_mm=float(np.exp(np.log(counted).mean())),
    )


def judge(
    model: Any, config: TrainConfig, seed: int, folder: Path, done: Progress, command: str
) -> None:
    """Evaluate the policy, and keep it if none before was as good."""
    cells = evaluate(model, config)
    score_mm = math.exp(float(np.mean([math.log(one.score_mm) for one in cells.values()])))
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
    """Make the folder, or check that it holds this training.

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
    path = folder / PLAN
    if not path.exists():
        with atomic(path, encoding="utf-8") as file:
            json.dump(plan, file, indent=1)
            file.write("\n")
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    for name, value in plan.items():
        if before.get(name) != value:
            raise ValueError(
                f"{folder} holds a training with another {name}; take another --out, or remove it"
            )


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


def train_seeds(
    config: TrainConfig,
    seeds: Sequence[int],
    folder: Path,
    *,
    processes: int = 1,
    ray_address: str | None = None,
    command: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Train with several seeds, each in ``folder/seed_N``; the best policy goes to ``folder``.

    Returns
    -------
    list
        What :func:`train` returns, in the order of the seeds.

    Raises
    ------
    ValueError
        as :func:`train` does; for a number of processes below 1; without a Ray cluster at the address.
    KeyboardInterrupt
        after an interrupt, once all trainings have written their checkpoints.
    """
    places = {seed: folder / f"seed_{seed}" for seed in seeds}
    for seed, place in places.items():  # before any of them works for long
        check_folder(config, seed, place)
    alone = ray_address is None and processes == 1

    def tell() -> None:
        if progress is not None:
            done = sum(_steps_done(place) for place in places.values())
            progress(min(done, total), total)

    total = config.robot_steps * len(places)
    curves: dict[int, dict[str, Any]] = {}
    jobs = [
        (config, seed, place, command, tell if alone else None) for seed, place in places.items()
    ]
    for curve in run_jobs(
        _train_job, jobs, processes=processes, ray_address=ray_address, ahead=1, meanwhile=tell
    ):
        curves[curve["seed"]] = curve
        tell()
    best = min(curves, key=lambda seed: kept(curves[seed])["score_mm"])
    for name in (POLICY, str(Path(POLICY).with_suffix(CARD))):
        with atomic(folder / name, "wb") as file:
            file.write((places[best] / name).read_bytes())
    return [curves[seed] for seed in seeds]


def _train_job(
    config: TrainConfig, seed: int, folder: Path, command: str, tell: Callable[[], None] | None
) -> dict[str, Any]:
    """One seed; how far it is stands in a file, so that another process or machine can tell."""

    def progress(done: int, total: int) -> None:
        with atomic(folder / STEPS) as file:
            file.write(f"{done}\n")
        if tell is not None:
            tell()

    return train(config, seed, folder, command=command, progress=progress)


def _steps_done(folder: Path) -> int:
    try:
        return int((folder / STEPS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return 0


def kept(curve: dict[str, Any]) -> dict[str, Any]:
    """The evaluation of the policy that was kept."""
    return min(curve["evaluations"], key=lambda one: one["score_mm"])
