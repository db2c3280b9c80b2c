"""Training on the batch plant: one policy for all robots, evaluated on separate seeds, resumable.

    tlf train residual --seeds 0,1,2

One call of :func:`train` is one seed. It makes environments and a model, spreads the formations over
their episodes, and then alternates rollouts and updates. At intervals the policy is evaluated on choosing
seeds; ``policy.safetensors`` holds the best one so far. ``curve.json`` records the course of the training.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import torch
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from baselines.runs.jobs import alone_in, claim
from baselines.runs.provenance import simulation_digest
from baselines.runs.stopping import interrupts
from baselines.sb3 import FormationVecEnv
from baselines.training.checkpoint import read_checkpoint, write_checkpoint
from baselines.training.config import TrainConfig
from baselines.training.curve import TrainingProgress, write_curve
from baselines.training.export import export_policy
from baselines.training.history import ModelPolicy
from baselines.training.imitation import imitate
from baselines.training.model import (
    make_envs,
    make_model,
    rollout_steps,
    set_learning_rate,
    spread_out,
)
from baselines.training.offline import digest
from baselines.training.scoring import overall_mm, score_policy
from baselines.training.sensor_imitation import imitate_with_sensors
from tlf_env.common.files import naming
from tlf_env.task.neutral import scenario_hash

POLICY_FILE, CHECKPOINT_FILE, TRAINING_FILE = (
    "policy.safetensors",
    "checkpoint.safetensors",
    "plan.json",
)


def train(
    config: TrainConfig,
    seed: int,
    folder: Path,
    *,
    command: str = "",
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    evaluated: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Train with one seed, from the folder's checkpoint if there is one, and keep the best policy.

    After an interrupt (SIGINT or SIGTERM) the current rollout and its update are finished and a checkpoint is
    written. The next call continues to the same result, bit for bit, as an uninterrupted training.

    Parameters
    ----------
    seed
        Seed of the network, of the draws of actions and of the order of samples. The episodes are the
        same for every seed: formation k begins with the first of ``config.seeds`` + k.
    folder
        Folder for ``policy.safetensors`` with its card, ``checkpoint.safetensors``, ``curve.json`` and
        TensorBoard's files.
    threads
        Threads that step the formations; their number changes no result.
    progress
        Called with the robot steps done and their total.
    evaluated
        Called with each evaluation, as ``curve.json`` has it.

    Returns
    -------
    dict
        The content of ``curve.json``.

    Raises
    ------
    ValueError
        if the folder holds another training, or a setting does not fit the algorithm.
    KeyboardInterrupt
        after an interrupt, once the checkpoint is written.
    """
    torch.set_num_threads(1)  # small networks: more threads would cost more than they gain
    check_folder(config, seed, folder)
    with alone_in(folder):
        return _train(config, seed, folder, command, threads, progress, evaluated)


def _train(
    config: TrainConfig,
    seed: int,
    folder: Path,
    command: str,
    threads: int,
    progress: Callable[[int, int], None] | None,
    evaluated: Callable[[dict[str, Any]], None] | None,
) -> dict[str, Any]:
    def evaluate() -> None:
        evaluate_and_keep(model, config, seed, folder, done, command)
        done.evaluated_at_s.append(time.process_time() - began_processor)
        if evaluated is not None:
            evaluated(done.evaluations[-1])

    began, began_processor = time.perf_counter(), time.process_time()
    envs = make_envs(config, threads)
    model = make_model(config, envs, seed)
    model.set_logger(Logger(str(folder), tensorboard(folder)))
    if (folder / CHECKPOINT_FILE).exists():
        done = TrainingProgress(**read_checkpoint(folder / CHECKPOINT_FILE, model, envs))
        began -= done.wall_time_s
        began_processor -= done.processor_time_s
        set_level(envs, config, done)
    else:
        done = TrainingProgress()
        set_level(envs, config, done)
        if config.offline is None:
            spread_out(model, envs, config.seeds[0])
        if config.imitation is not None:
            (imitate_with_sensors if config.network.input == "sensor" else imitate)(
                model, envs, config
            )
        evaluate()
    with interrupts() as stop:
        while model.num_timesteps < config.robot_steps:
            before = model.num_timesteps
            set_learning_rate(model, config)
            model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
            now, last = model.num_timesteps, model.num_timesteps >= config.robot_steps
            record_rollout(model, done)
            raise_level(envs, config, done)
            if last or passed(config.evaluation.every, before, now):
                evaluate()
            done.wall_time_s = time.perf_counter() - began
            done.processor_time_s = time.process_time() - began_processor
            if progress is not None:
                progress(min(now, config.robot_steps), config.robot_steps)
            stopping = bool(stop)
            if last or stopping or passed(config.checkpoint_every, before, now):
                write_checkpoint(folder / CHECKPOINT_FILE, model, envs, vars(done))
                write_curve(folder, config, seed, done)
            if stopping and not last:
                raise KeyboardInterrupt
    return write_curve(folder, config, seed, done)


def passed(every: int, before: int, now: int) -> bool:
    """Whether a multiple of ``every`` lies above ``before`` and not above ``now``."""
    return now // every > before // every


def set_level(envs: FormationVecEnv, config: TrainConfig, done: TrainingProgress) -> None:
    """Let episodes draw the levels of the curriculum that were reached."""
    if config.curriculum is not None:
        envs.set_shares(config.shares(done.level_count))


def raise_level(envs: FormationVecEnv, config: TrainConfig, done: TrainingProgress) -> None:
    """Add the next level of the curriculum if few enough of the last episodes failed."""
    if config.curriculum is None or done.level_count == len(config.levels):
        return
    counted = len(envs.last_ends) == envs.last_ends.maxlen
    failed_share = 1.0 - envs.end_shares()["horizon"]
    if counted and failed_share <= config.curriculum.failed_share:
        done.level_count += 1
        set_level(envs, config, done)
        envs.last_ends.clear()


def record_rollout(model: Any, done: TrainingProgress) -> None:
    """Record a rollout and its update for TensorBoard and ``curve.json``."""
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
    model.logger.record("curriculum/level_count", done.level_count)
    for reason, share in model.get_env().end_shares().items():
        model.logger.record(f"ends/{reason}", share)
    model.logger.dump(model.num_timesteps)


def evaluate_and_keep(
    model: Any, config: TrainConfig, seed: int, folder: Path, done: TrainingProgress, command: str
) -> None:
    """Evaluate the policy, and keep it if it is the best so far."""
    seeds = range(*config.evaluation.seeds)
    scores = score_policy(ModelPolicy(model), config.evaluation_scenarios(), seeds)
    score_mm = overall_mm(scores)
    best_mm = min((one["score_mm"] for one in done.evaluations), default=math.inf)
    done.evaluations.append(
        {
            "robot_steps": model.num_timesteps,
            "score_mm": score_mm,
            "failed": sum(one.failed for one in scores.values()),
            "cells": {name: one._asdict() for name, one in scores.items()},
        }
    )
    model.logger.record("evaluation/score_mm", score_mm)
    model.logger.record("evaluation/failed", done.evaluations[-1]["failed"])
    for name, one in scores.items():
        model.logger.record(f"position_rmse_mm/{name}", one.position_rmse_mm)
    model.logger.dump(model.num_timesteps)
    if score_mm < best_mm:
        tasks, _ = config.mixture()
        export_policy(
            model,
            folder / POLICY_FILE,
            next(iter(tasks.values()))[0],
            training={
                "robot_steps": model.num_timesteps,
                "config": config.recorded,
                **({"data": model.origins} if config.offline else {}),
            },
            seeds={
                "learner": [seed],
                "episodes": seeds_of_episodes(model, config),
                "choosing": config.evaluation.seeds,
            },
            scores={"start": done.evaluations[0], "kept": done.evaluations[-1]},
            command=command,
        )


def seeds_of_episodes(model: Any, config: TrainConfig) -> tuple[int, ...]:
    """The first seed and the end of those that the model learned from; offline for each file of data."""
    if config.offline is None:
        return config.seeds
    return tuple(seed for one in model.origins for seed in one["seeds"])


def check_folder(config: TrainConfig, seed: int, folder: Path) -> None:
    """Claim the folder for this training.

    Raises
    ------
    ValueError
        if it holds another training, or one with another simulation.
    """
    plan = {
        "config": config.recorded,
        "seed": seed,
        "scenarios": [f"{place}: {scenario_hash(one)}" for place, one in config.named_scenarios()],
        "simulation": simulation_digest(),
        "torch": torch.__version__,
    }
    if config.offline is not None:
        plan["data"] = [digest(file) for file in config.offline.files]
    claim(folder / TRAINING_FILE, plan, list(plan), "a training")


def tensorboard(folder: Path) -> list[Any]:
    """TensorBoard's writer, or no writer if TensorBoard is not installed.

    Raises
    ------
    OSError
        that names the folder, if it cannot be written: TensorBoard's thread would end with a traceback.
    """
    with naming(folder):
        TemporaryFile(dir=folder).close()
    try:
        return [TensorBoardOutputFormat(str(folder))]
    except AssertionError:
        return []
