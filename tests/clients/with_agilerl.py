"""AgileRL on the first rung."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import rung
import torch
from agilerl.algorithms import IPPO
from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy
from agilerl.vector import PzDummyVecEnv

AGENT = "robot_0"


class WithAgileRL(rung.Client):
    """IPPO in the process of the environment."""

    library, package, algorithm, steps = "AgileRL", "agilerl", "IPPO", 20_480
    door = "`parallel_env`"

    def __init__(self) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(rung.SEED)
        np.random.seed(rung.SEED)  # noqa: NPY002 - AgileRL shuffles its batches by this generator
        self.env = PzDummyVecEnv(rung.parallel())
        self.agent = IPPO(
            [self.env.single_observation_space(AGENT)],
            [self.env.single_action_space(AGENT)],
            agent_ids=[AGENT],
            learn_step=512,
            batch_size=64,
            lr=1e-3,
            update_epochs=4,
            action_std_init=0.0,
            ent_coef=0.0,
        )
        self.losses: list[float] = []

    @staticmethod
    def _acting(agent: IPPO) -> rung.Act:
        (actor,) = agent.actors.values()

        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            with torch.no_grad():
                actor(torch.as_tensor(observation[None]))
                return actor.head_net.dist.mu[0].numpy()

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.agent)(observation, first)

    def learn(self) -> list[float]:
        learn, losses = self.agent.learn, []

        def kept(experiences: Any) -> dict[str, float]:
            found = learn(experiences)
            losses.extend(float(value) for value in found.values())
            return found

        self.agent.learn = kept
        train_multi_agent_on_policy(
            self.env,
            rung.TASK,
            "IPPO",
            [self.agent],
            max_steps=self.steps,
            evo_steps=self.steps // 4,
            eval_steps=200,
            verbose=False,
        )
        del self.agent.learn
        return losses

    def loaded(self, folder: Path) -> rung.Act:
        file = os.fspath(folder / "agent.pt")
        self.agent.save_checkpoint(file)
        return self._acting(IPPO.load(file))

    def close(self) -> None:
        self.env.close()


CLIENTS = (WithAgileRL,)
