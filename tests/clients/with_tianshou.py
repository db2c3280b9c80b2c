"""Tianshou on the first rung."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rung
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

ENVS = 4


def distribution(mean_and_std: tuple[torch.Tensor, torch.Tensor]) -> Any:
    """Of the actions."""
    return torch.distributions.Independent(torch.distributions.Normal(*mean_and_std), 1)


class WithTianshou(rung.Client):
    """PPO on a few environments of one learner."""

    library, package, algorithm, steps = "Tianshou", "tianshou", "PPO", 20_480
    door = "`gymnasium.make`"

    def __init__(self) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(rung.SEED)
        np.random.seed(rung.SEED)  # noqa: NPY002 - Tianshou shuffles its batches by this generator
        self.env = rung.single()
        self.learner = self._learner()

    def _learner(self) -> PPO:
        seen, acted = self.env.observation_space.shape, self.env.action_space.shape
        policy = ProbabilisticActorPolicy(
            actor=ContinuousActorProbabilistic(
                preprocess_net=Net(
                    state_shape=seen, hidden_sizes=[64, 64], activation=torch.nn.Tanh
                ),
                action_shape=acted,
                unbounded=True,
            ),
            dist_fn=distribution,
            action_space=self.env.action_space,
            deterministic_eval=True,
        )
        critic = ContinuousCritic(
            preprocess_net=Net(state_shape=seen, hidden_sizes=[64, 64], activation=torch.nn.Tanh)
        )
        return PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3))

    @staticmethod
    def _acting(learner: PPO) -> rung.Act:
        policy = learner.policy

        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            policy.eval()
            with torch.no_grad():
                found = policy(Batch(obs=observation[None], info=Batch()))
            return policy.map_action(found.act)[0]

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.learner)(observation, first)

    def learn(self) -> list[float]:
        losses: list[float] = []
        update = self.learner._update_with_batch

        def kept(*arguments: Any, **named: Any) -> Any:
            found = update(*arguments, **named)
            losses.append(float(found.loss.mean))
            return found

        self.learner._update_with_batch = kept
        self.learner.run_training(
            OnPolicyTrainerParams(
                training_collector=Collector(
                    self.learner,
                    DummyVectorEnv([rung.single] * ENVS),
                    VectorReplayBuffer(2048, ENVS),
                ),
                test_collector=None,
                max_epochs=1,
                epoch_num_steps=self.steps,
                collection_step_num_env_steps=1024,
                update_step_num_repetitions=8,
                batch_size=128,
            )
        )
        return losses

    def loaded(self, folder: Path) -> rung.Act:
        torch.save(self.learner.state_dict(), folder / "learner.pt")
        other = self._learner()
        other.load_state_dict(torch.load(folder / "learner.pt", weights_only=False))
        return self._acting(other)


CLIENTS = (WithTianshou,)
