"""TD3+BC: learning from data sets of runs alone (Fujimoto and Gu, NeurIPS 2021).

TD3 with one more term: the network's actions are to have a large value and to stay near the data's. No step
of the simulation is made but for evaluations.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional

from baselines.data.files import Rows, fitting_rows
from baselines.runs.seed_ranges import TRAINING_SEEDS, check_seeds
from baselines.runs.splits import check_training_names
from baselines.sb3 import FormationVecEnv
from tlf_env.common.errors import path_text
from tlf_env.task.scenario import Scenario

UPDATES_PER_CALL = 100  # between two looks at the time, an interrupt and the evaluations
LEAST_VARIANCE = 1e-6  # of an entry that is standardised; those that never change stay small
CLIP = 100.0  # standardised entries


class DataBuffer(ReplayBuffer):
    """A replay buffer that holds the steps of data sets, all of them and nothing else.

    A step that terminates has no value behind it. One at which an episode is truncated has: that of its last
    observation.
    """

    def __init__(self, data: Sequence[Rows], *args: Any, **kwargs: Any) -> None:
        size = sum(len(one.actions) for one in data)
        super().__init__(size, *args, n_envs=1, handle_timeout_termination=True, **kwargs)
        ended = [one.last for one in data]
        columns = {
            "observations": [one.observations for one in data],
            "next_observations": [one.next_observations for one in data],
            "actions": [one.actions for one in data],
            "rewards": [one.rewards for one in data],
            "dones": ended,
            "timeouts": [one.last & ~one.terminated for one in data],
        }
        for name, parts in columns.items():
            getattr(self, name)[:, 0] = np.concatenate(parts)
        self.full = True


class TD3BC(TD3):
    """SB3's TD3 that learns from data sets, and keeps its actions near theirs.

    The actor's loss is the mean of |π(s) − a|² − λ·Q(s, π(s)), λ = α / mean |Q(s, π(s))|; the square is the
    mean over the entries of the action. With α = 0 it imitates the data, and the critics are not trained.

    Parameters
    ----------
    policy, env
        As for TD3; the environment is not stepped.
    data
        The data sets.
    alpha
        α, from 0 on.
    **kwargs
        As for TD3.

    Raises
    ------
    ValueError
        for an α below 0.
    """

    def __init__(
        self,
        policy: Any,
        env: Any,
        data: Sequence[Rows] = (),
        alpha: float = 2.5,
        learning_rate: Any = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        policy_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        device: Any = "auto",
    ) -> None:
        if not alpha >= 0.0:
            raise ValueError(f"alpha {alpha:g} must be from 0 on")
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=1,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            policy_delay=policy_delay,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            policy_kwargs=policy_kwargs,
            seed=seed,
            device=device,
        )
        self.alpha = alpha
        self.origins = [one.origin() for one in data]
        self.set_logger(Logger(None, []))  # until another one is set
        self.replay_buffer = DataBuffer(
            data, self.observation_space, self.action_space, device=self.device
        )

    def learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Self:
        """Draw at least so many steps of the data, and learn from them; the other arguments have no effect."""
        updates = -(-total_timesteps // self.batch_size)
        self.train(updates, self.batch_size)
        self.num_timesteps += updates * self.batch_size
        return self

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """As TD3's, with the distance from the data's actions in the actor's loss."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        assert self.replay_buffer is not None
        losses: dict[str, float] = {}
        for _ in range(gradient_steps):
            self._n_updates += 1
            rows = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            if self.alpha > 0.0:
                losses["critic_loss"] = self._fit_critics(rows)
            if self._n_updates % self.policy_delay:
                continue
            loss = self.actor_loss(rows.observations, rows.actions)
            losses["actor_loss"] = loss.item()
            self.actor.optimizer.zero_grad()
            loss.backward()
            self.actor.optimizer.step()
            for mine, target in (
                (self.critic, self.critic_target),
                (self.actor, self.actor_target),
            ):
                polyak_update(mine.parameters(), target.parameters(), self.tau)
        for name, value in losses.items():
            self.logger.record(f"train/{name}", value)

    def _fit_critics(self, rows: Any) -> float:
        """One step of the critics towards :meth:`targets`; returns their loss before it."""
        wanted = self.targets(rows)
        found = self.critic(rows.observations, rows.actions)
        loss = torch.stack([functional.mse_loss(one, wanted) for one in found]).sum()
        self.critic.optimizer.zero_grad()
        loss.backward()
        self.critic.optimizer.step()
        return float(loss.item())

    def targets(self, rows: Any) -> torch.Tensor:
        """What the critics are fitted to, ``(row, 1)``: reward and, unless it terminated, what follows."""
        with torch.no_grad():
            drawn = torch.randn_like(rows.actions) * self.target_policy_noise
            noise = drawn.clamp(-self.target_noise_clip, self.target_noise_clip)
            actions = (self.actor_target(rows.next_observations) + noise).clamp(-1.0, 1.0)
            values = torch.cat(self.critic_target(rows.next_observations, actions), dim=1)
            least = values.min(dim=1, keepdim=True).values
            target: torch.Tensor = rows.rewards + (1.0 - rows.dones) * self.gamma * least
        return target

    def actor_loss(self, observations: torch.Tensor, meant: torch.Tensor) -> torch.Tensor:
        """Squared distance from the data's actions ``meant`` less their value times λ."""
        actions = self.actor(observations)
        distance = functional.mse_loss(actions, meant)
        if self.alpha == 0.0:
            return distance
        values = self.critic.q1_forward(observations, actions)
        return distance - self.alpha * values.mean() / values.detach().abs().mean()


def read_data(files: Sequence[str], scenario: Scenario) -> list[Rows]:
    """The data sets of some files, which must fit a scenario and come from what may train.

    Raises
    ------
    ValueError
        naming the file, for one that cannot be read, does not fit (:func:`fitting_rows`), or has tasks,
        disturbances or seeds that are for choices or tests.
    """
    found = []
    for file in files:
        data = fitting_rows(Path(file), scenario)
        name = path_text(Path(file))
        check_seeds(f"{name}: seeds", (data.seeds[0], data.seeds[-1] + 1), TRAINING_SEEDS)
        for task in data.tasks:
            for disturbance in data.disturbances:
                try:
                    check_training_names(task, disturbance)
                except ValueError as error:
                    raise ValueError(f"{name}: {error}") from error
        found.append(data)
    return found


def standardised(envs: FormationVecEnv, data: Sequence[Rows]) -> VecNormalize:
    """Environments whose observations have mean 0 and variance 1 over the data."""
    seen = np.concatenate([one.observations for one in data])
    given = VecNormalize(
        envs, training=False, norm_reward=False, clip_obs=CLIP, epsilon=LEAST_VARIANCE
    )
    given.obs_rms.mean = seen.mean(axis=0, dtype=np.float64)
    given.obs_rms.var = seen.var(axis=0, dtype=np.float64)
    return given


def digest(file: str | Path) -> str:
    """SHA-256 of a file's content.

    Raises
    ------
    ValueError
        for a file that cannot be read.
    """
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"cannot read {path_text(Path(file))}: {error}") from error
