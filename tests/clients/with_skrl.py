"""skrl on the first rung."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import rung
import torch
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

ENVS, ROLLOUT = 16, 64


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )


class Policy(GaussianMixin, Model):
    """A mean for each observation, and one standard deviation."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = network(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Any, dict[str, Any]]:
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """The value of an observation."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = network(self.num_observations, 1)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Any, dict[str, Any]]:
        return self.net(inputs["observations"]), {}


class WithSkrl(rung.Client):
    """PPO on Gymnasium's vector environment."""

    library, package, algorithm, steps = "skrl", "skrl", "PPO", 60_000
    door = "`gymnasium.make_vec`"

    def __init__(self) -> None:
        torch.set_num_threads(1)
        set_seed(rung.SEED)
        made = gymnasium.make_vec(rung.ID, num_envs=ENVS, infos=False, **rung.RUNG)
        self.env = wrap_env(made)
        self.agent = self._agent()

    def _agent(self) -> PPO:
        spaces = {
            "observation_space": self.env.observation_space,
            "action_space": self.env.action_space,
            "device": "cpu",
        }
        return PPO(
            models={"policy": Policy(**spaces), "value": Value(**spaces)},
            memory=RandomMemory(memory_size=ROLLOUT, num_envs=ENVS, device="cpu"),
            cfg={
                "rollouts": ROLLOUT,
                "mini_batches": 4,
                "learning_rate": 1e-3,
                "experiment": {"write_interval": 0, "checkpoint_interval": 0},
            },
            **spaces,
        )

    @staticmethod
    def _acting(agent: PPO) -> rung.Act:
        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            with torch.no_grad():
                given = {"observations": torch.as_tensor(observation[None])}
                return agent.policy.compute(given)[0][0].numpy()

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.agent)(observation, first)

    def learn(self) -> list[float]:
        losses: list[float] = []
        track = self.agent.track_data

        def kept(tag: str, value: float) -> None:
            if "loss" in tag:
                losses.append(float(value))
            track(tag, value)

        self.agent.track_data = kept
        trainer = SequentialTrainer(
            env=self.env,
            agents=self.agent,
            cfg={
                "timesteps": self.steps // ENVS,
                "disable_progressbar": True,
                "headless": True,  # otherwise it draws by a method that no vector entry point has
                "close_environment_at_exit": False,
            },
        )
        trainer.train()
        return losses

    def loaded(self, folder: Path) -> rung.Act:
        self.agent.save(str(folder / "agent.pt"))
        other = self._agent()
        other.load(str(folder / "agent.pt"))
        return self._acting(other)


CLIENTS = (WithSkrl,)
