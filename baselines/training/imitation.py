"""Imitation: a network without a base controller first learns to act like the reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from baselines.data.files import fitting_rows
from baselines.policies.reference import ReferencePolicy
from baselines.policies.registry import check_interface
from baselines.sb3 import FormationVecEnv
from baselines.training.config import ImitationConfig, TrainConfig
from tlf_env.onboard.controllers import controller
from tlf_env.task.scenario import Scenario

BATCH = 2048


class ImitationRows(NamedTuple):
    """One round, a row for each robot and step."""

    seen: np.ndarray  # observations
    meant: np.ndarray  # the teacher's actions for them
    returns: np.ndarray  # discounted rewards that followed


def imitate(model: Any, envs: FormationVecEnv, config: TrainConfig) -> None:
    """Fit a PPO model to a data set or to the reference that ``config.imitation`` names; its critic, too.

    With a data set the network is fitted to its actions, and the critic to the discounted rewards that
    followed. Otherwise the reference is the teacher.

    In the first round the teacher drives all formations, with noise on its actions so that the data
    contain its corrections. The network is fitted to the teacher's actions, and the critic to the
    discounted rewards that followed. In further rounds the network drives, and the teacher's actions are
    computed for what the network observes; so the network learns to correct its own errors (DAgger: Ross,
    Gordon, Bagnell, AISTATS 2011).

    Raises
    ------
    ValueError
        if the reference or the data do not fit the scenario, or the file cannot be read.
    """
    wanted = config.imitation
    assert wanted is not None
    scenario = envs.plants[0].scenario
    if wanted.data is not None:
        given = _from_data(Path(wanted.data), scenario, float(model.gamma))
        seen, meant, returns = map(torch.from_numpy, given)
        _fit(model, seen, meant, returns, wanted.epochs, wanted.learning_rate)
        return
    check_interface("the teacher", scenario, action="twist", observation="tracking")
    teacher = free_teacher(wanted.controller, scenario)
    generator = np.random.default_rng(model.seed)
    rows: list[ImitationRows] = []
    for round_ in range(wanted.rounds):
        driver = teacher if round_ == 0 else model
        rows.append(_drive(model, envs, driver, teacher, wanted, generator))
        seen, meant, returns = (
            torch.from_numpy(np.concatenate(one)) for one in zip(*rows, strict=True)
        )
        _fit(model, seen, meant, returns, wanted.epochs, wanted.learning_rate)


def free_teacher(name: str, scenario: Scenario) -> ReferencePolicy:
    """A controller without its limits on accelerations, as a policy from ``tracking`` to ``twist``.

    With them its command depends on the one before, and a network that imitates it drifts away.
    """
    known = controller(name)
    free = {"acceleration_mm_s2": None, "yaw_acceleration_rad_s2": None}
    known = known.model_copy(update={"limits": known.limits.model_copy(update=free)})
    return ReferencePolicy(known, scenario.control_period_s, scenario.preview_s)


def _from_data(path: Path, scenario: Scenario, gamma: float) -> ImitationRows:
    """The rows of a data set, which must have the scenario's observation and action."""
    data = fitting_rows(path, scenario)
    returns = np.empty(len(data.rewards), dtype=np.float32)
    following = 0.0
    for k in reversed(range(len(returns))):
        following = data.rewards[k] + gamma * (0.0 if data.last[k] else following)
        returns[k] = following
    return ImitationRows(data.observations, data.actions, returns)


def _drive(
    model: Any,
    envs: FormationVecEnv,
    driver: Any,
    teacher: ReferencePolicy,
    wanted: ImitationConfig,
    generator: np.random.Generator,
) -> ImitationRows:
    """Observations while ``driver`` drives, the teacher's actions for them, and the returns."""
    steps = -(-wanted.robot_steps // (envs.num_envs * wanted.rounds))
    shape = (steps, envs.num_envs)
    seen = np.empty((*shape, *model.observation_space.shape), dtype=np.float32)
    meant = np.empty((*shape, *model.action_space.shape), dtype=np.float32)
    rewards, dones = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.bool_)
    observations = envs.observations()
    for k in range(steps):
        seen[k] = observations
        meant[k], _ = teacher.predict(observations)
        given = meant[k]
        if driver is not teacher:
            given, _ = driver.predict(observations, deterministic=True)
        given = given + wanted.noise * generator.standard_normal(given.shape)
        observations, rewards[k], dones[k], _ = envs.step(np.clip(given, -1.0, 1.0))
    model._last_obs = observations
    model._last_episode_starts = np.asarray(dones[-1])
    returns = returns_of(rewards, dones, model.gamma)
    count = steps * envs.num_envs
    return ImitationRows(seen.reshape(count, -1), meant.reshape(count, -1), returns.ravel())


def returns_of(rewards: np.ndarray, dones: np.ndarray, gamma: float) -> np.ndarray:
    """Discounted rewards that followed, (step, robot); after the last step as if rewards stayed the same."""
    steps, robots = rewards.shape
    returns = np.empty_like(rewards)
    last = rewards[-steps // 4 :].mean() / (1.0 - gamma)
    following = np.full(robots, last, dtype=np.float32)
    for k in reversed(range(steps)):
        following = rewards[k] + gamma * np.where(dones[k], 0.0, following)
        returns[k] = following
    return returns


def _fit(
    model: Any,
    seen: torch.Tensor,
    meant: torch.Tensor,
    returns: torch.Tensor,
    epochs: int,
    rate: float,
) -> None:
    policy = model.policy
    kept = [parameter for name, parameter in policy.named_parameters() if name != "log_std"]
    optimizer = torch.optim.Adam(kept, lr=rate)
    spread = meant.std(dim=0) + 1e-6
    scale = returns.std() + 1e-6
    batches = -(-len(seen) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs * batches)
    for _ in range(epochs):
        for rows in torch.randperm(len(seen)).split(BATCH):
            mean = policy.get_distribution(seen[rows]).distribution.mean
            value = policy.predict_values(seen[rows]).flatten()
            loss = torch.square((mean - meant[rows]) / spread).mean()
            loss = loss + torch.square((value - returns[rows]) / scale).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
