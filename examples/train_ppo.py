"""SB3's PPO on one follower: a starting point, not a result.

The learner is ``robot_1``; what it does is added to the reference controller's twist, so that it
begins as the reference. Exploration is kept small: the wheel loop answers a few mm/s of noise with
its full torque, and a robot that skids learns nothing. The default trains for a few seconds and shows
that everything fits together. 80 000 steps bring the mean return from the reference's 783 to 820–960
(seeds 0 to 2); give it more, and longer episodes.

    pip install 'tlf-env[train]'
    python examples/train_ppo.py --steps 80000 --out follower.zip
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import typer
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import tlf_env  # noqa: F401  registers the environments

TASK = "tlf_env/Infinity-v0"
ENVS = 8
JUDGED_FROM_SEED = 10_000  # other draws of noise than those of the training


class NoResidual:
    """The reference itself: a residual of zero."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Zero for every environment of the batch."""
        return np.zeros((len(observation), 2), observation.dtype), state


def judge(policy: Any, options: dict[str, Any], episodes: int) -> float:
    """Mean return over the same few episodes for everybody."""
    env = make_vec_env(TASK, 1, seed=JUDGED_FROM_SEED, env_kwargs=options)
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=episodes)
    env.close()
    return float(np.mean(mean))


def main(
    steps: int = 16384,
    episodes: int = 2,
    horizon_s: float = 20.0,
    seed: int = 0,
    out: Path | None = None,
) -> None:
    """Train, and compare the returns before and after with the reference's."""
    options = {"learner": "robot_1", "action": "residual", "horizon_s": horizon_s}
    torch.set_num_threads(1)  # the network is small
    envs = make_vec_env(TASK, ENVS, seed=seed, env_kwargs=options)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=min(1024, steps // ENVS),
        batch_size=min(1024, steps),
        n_epochs=5,
        gamma=0.95,  # 20 steps, 0.4 s: a residual acts at once
        learning_rate=1e-4,
        policy_kwargs={"log_std_init": -4.5},  # 1.7 mm/s
        seed=seed,
        device="cpu",
    )
    model.policy.action_net.weight.data.mul_(0.1)  # begin as the reference
    print(f"reference: mean return {judge(NoResidual(), options, episodes):.1f}")
    print(f"untrained: mean return {judge(model, options, episodes):.1f}")
    model.learn(steps)
    after = judge(model, options, episodes)
    print(f"after {model.num_timesteps} steps: mean return {after:.1f}")
    if out is not None:
        model.save(out)
        print(f"policy in {out}")
    envs.close()


if __name__ == "__main__":
    typer.run(main)
