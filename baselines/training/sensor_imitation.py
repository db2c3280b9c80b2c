"""Imitation for a network on raw sensors. Its teacher sees what the robot's filter estimates.

The teacher is a controller that acts on the observation ``tracking``, which the engine computes for every
robot. The network is fitted to the teacher's twists for what it reads itself, and drives in all rounds but the
first (DAgger: Ross, Gordon, Bagnell, AISTATS 2011; with a teacher that sees more: Chen et al., CoRL 2019).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from baselines.policies.reference import ReferencePolicy
from baselines.training.imitation import free_teacher, returns_of
from baselines.training.sensor_policy import TRUTHS, SensorPolicy, SensorVecEnv
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import SENSOR_TAIL_ENTRIES

BATCH = 1024
# Scales of the reference's speed and yaw rate in the observation.
ENTRY_SCALES = tuple(SENSOR_TAIL_ENTRIES[f"message_u_{i}"].scale for i in (1, 2))
EVERY = 2  # control steps between two rows: rows of neighbouring steps are nearly the same
NOISE_KEPT = 0.95  # of the noise on the actions from step to step, so that it moves robots
SCALES = (10.0, 0.1)  # mm/s and rad/s: errors of the twist beyond this count linearly
KNEE = 0.3  # in units of SCALES: below, errors count quadratically
FINAL_EPOCHS = 2.5  # times as many in the last round


class SensorRows(NamedTuple):
    """One round: features, the twists (in :data:`SCALES`) the teacher would add to the reference's."""

    features: torch.Tensor
    added: torch.Tensor


class CriticRows(NamedTuple):
    """What the critic saw in a round, and the discounted rewards that followed."""

    truths: torch.Tensor
    returns: torch.Tensor


def imitate_with_sensors(model: Any, envs: SensorVecEnv, config: Any) -> None:
    """Fit a PPO model with a sensor policy to the reference; its critic, too.

    The first round is driven by the teacher, the others by the network, all with noise on the actions. After
    each round the network is fitted to the last ``window`` rounds, so that the first ones, in which it still
    lost its robots, are forgotten.
    """
    wanted = config.imitation
    teacher = free_teacher(wanted.controller, envs.plants[0].scenario)
    generator = np.random.default_rng(model.seed)
    optimizer = torch.optim.Adam(
        [
            *model.policy.mlp_extractor.policy_net.parameters(),
            *model.policy.action_net.parameters(),
        ],
        lr=wanted.learning_rate,
    )
    rounds: list[SensorRows] = []
    for number in range(wanted.rounds):
        last = number == wanted.rounds - 1
        rows, critic = _drive(model, envs, teacher, number > 0, wanted, generator)
        rounds = [*rounds, rows][-(wanted.window or wanted.rounds) :]
        epochs = round(wanted.epochs * (FINAL_EPOCHS if last else 1))
        features, added = (torch.cat(part) for part in zip(*rounds, strict=True))
        _fit(model.policy, optimizer, features, added, epochs, wanted.learning_rate)
    _fit_critic(model.policy, critic, wanted.epochs, wanted.learning_rate)


def _drive(
    model: Any,
    envs: SensorVecEnv,
    teacher: ReferencePolicy,
    alone: bool,
    wanted: Any,
    generator: np.random.Generator,
) -> tuple[SensorRows, CriticRows]:
    """A round: the network drives, or the teacher if it is not ``alone``."""
    extractor, layer = model.policy.mlp_extractor, envs.layer
    steps = -(-wanted.robot_steps // (envs.num_envs * wanted.rounds))
    twist_scales = np.array([FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S])
    features, added, truths, rewards, dones = [], [], [], [], []
    noise, observations = np.zeros((envs.num_envs, 2)), envs.observations()
    for k in range(steps):
        given, _ = teacher.predict(tracking_rows(envs))
        twist = given * twist_scales
        read = torch.from_numpy(observations)
        with torch.no_grad():
            found = extractor.features(read)
        if k % EVERY == 0:
            reference = observations[:, list(layer.twist)] * ENTRY_SCALES
            features.append(found.half())  # half the memory; features are within ±10
            added.append(torch.from_numpy(((twist - reference) / SCALES).astype(np.float32)))
            truths.append(observations[:, -TRUTHS:].copy())
        actions = twist / ENTRY_SCALES @ layer.wheels.T
        if alone:
            actions, _ = model.predict(observations, deterministic=True)
        noise = NOISE_KEPT * noise
        noise += np.sqrt(1 - NOISE_KEPT**2) * wanted.noise * generator.standard_normal(noise.shape)
        given = np.clip(actions + noise, -1.0, 1.0).astype(observations.dtype)
        observations, reward, done, _ = envs.step(given)
        rewards.append(reward)
        dones.append(done)
    model._last_obs, model._last_episode_starts = observations, np.asarray(dones[-1])
    returns = returns_of(np.array(rewards), np.array(dones), float(model.gamma))[::EVERY]
    return (
        SensorRows(torch.cat(features), torch.cat(added)),
        CriticRows(torch.from_numpy(np.concatenate(truths)), torch.from_numpy(returns.ravel())),
    )


def tracking_rows(envs: SensorVecEnv) -> np.ndarray:
    """The ``tracking`` observations of all robots, a row each: what their filters estimate."""
    each = [plant.arrays.observations for plant in envs.plants]
    return np.concatenate([one.reshape(-1, one.shape[2]) for one in each])


def _fit(
    policy: SensorPolicy,
    optimizer: torch.optim.Optimizer,
    features: torch.Tensor,
    added: torch.Tensor,
    epochs: int,
    rate: float,
) -> None:
    """Fit the actor to the teacher's twists; the rate rises for a tenth of the batches, then falls."""
    batches = -(-len(features) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=2 * rate, total_steps=epochs * batches, pct_start=0.1
    )
    for _ in range(epochs):
        for rows in torch.randperm(len(features)).split(BATCH):
            loss = loss_of(policy, features[rows], added[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()


def loss_of(policy: SensorPolicy, features: torch.Tensor, added: torch.Tensor) -> torch.Tensor:
    """How far the actor's twists are from the teacher's: the mean of a smooth error."""
    known = features.float()
    actions = policy.action_net(policy.mlp_extractor.of_features(known))
    to_twist = torch.linalg.inv(torch.from_numpy(policy.layer.wheels)).float()
    mine = (
        (actions @ to_twist.T - known[:, -2:]) * torch.tensor(ENTRY_SCALES) / torch.tensor(SCALES)
    )
    return torch.nn.functional.smooth_l1_loss(mine, added, beta=KNEE)


def _fit_critic(policy: SensorPolicy, rows: CriticRows, epochs: int, rate: float) -> None:
    critic = torch.nn.Sequential(policy.mlp_extractor.value_net, policy.value_net)
    optimizer = torch.optim.Adam(critic.parameters(), lr=rate)
    scale = rows.returns.std() + 1e-6
    for _ in range(epochs):
        for chosen in torch.randperm(len(rows.truths)).split(BATCH):
            value = critic(rows.truths[chosen]).flatten()
            loss = torch.square((value - rows.returns[chosen]) / scale).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
