"""RLlib on the first rung."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import ray
import rung
import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

BATCH = 2000
TRAINING = {
    "lr": 1e-3,
    "train_batch_size_per_learner": BATCH,
    "minibatch_size": 128,
    "num_epochs": 8,
    "lambda_": 0.95,  # RLlib's default is 1: sums of rewards to the end, whose noise throws the policy back
    "vf_clip_param": 1000.0,  # RLlib's default of 10 is for returns of about that size
}


class OfRLlib(rung.Client):
    """PPO with runners in the same process."""

    library, package, algorithm, steps = "RLlib", "ray", "PPO", 8_000
    module_id = "default_policy"

    def config(self) -> PPOConfig:
        """What the algorithm is made of."""
        return (
            PPOConfig()
            .environment(rung.ID, env_config={**rung.RUNG, "infos": False})
            .env_runners(num_env_runners=0)
            .training(**TRAINING)
            .debugging(seed=rung.SEED, log_level="ERROR")
        )

    def __init__(self) -> None:
        ray.init(  # of its own, not a cluster that other processes have started
            "local",
            num_cpus=1,
            include_dashboard=False,
            log_to_driver=False,
            ignore_reinit_error=True,
        )
        torch.set_num_threads(1)
        self.learner = self.config().build_algo()

    @staticmethod
    def _acting(module: RLModule) -> rung.Act:
        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            given = {Columns.OBS: torch.as_tensor(observation[None])}
            with torch.no_grad():
                found = module.forward_inference(given)[Columns.ACTION_DIST_INPUTS]
            return found[0, :2].numpy()

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.learner.get_module(self.module_id))(observation, first)

    def learn(self) -> list[float]:
        losses = []
        for _ in range(self.steps // BATCH):
            found = self.learner.train()["learners"][self.module_id]
            losses += [float(found[name]) for name in ("total_loss", "policy_loss", "vf_loss")]
        return losses

    def loaded(self, folder: Path) -> rung.Act:
        path = os.fspath(folder / "algorithm")
        self.learner.save_to_path(path)
        self.other = Algorithm.from_checkpoint(path)
        return self._acting(self.other.get_module(self.module_id))

    def close(self) -> None:
        for learner in (self.learner, getattr(self, "other", None)):
            if learner is not None:
                learner.stop()
        ray.shutdown()


class Single(OfRLlib):
    """With the environment of one learner."""

    door = "`gymnasium.make`"


class Parallel(OfRLlib):
    """With every robot as an agent; the rung has one."""

    door, module_id = "`parallel_env`", "robots"

    def config(self) -> PPOConfig:
        register_env("rung", lambda _: ParallelPettingZooEnv(rung.parallel()))

        def policy(*_: Any, **__: Any) -> str:
            return "robots"

        return (
            super()
            .config()
            .environment("rung", env_config={})
            .multi_agent(policies={"robots"}, policy_mapping_fn=policy)
        )


CLIENTS = (Single, Parallel)
