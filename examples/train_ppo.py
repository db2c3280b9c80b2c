"""SB3's PPO on one follower: a starting point, not a result.

The learner is ``robot_1``; what it does is added to the reference controller's twist, so that it
begins near the reference. A few thousand steps take a minute and teach next to nothing: they show
that everything fits together. Give it a million, and other draws of noise than those it is judged on.

    pip install 'tlf-env[train]'
    python examples/train_ppo.py --steps 1000000 --out follower.zip
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import tlf_env  # noqa: F401  registers the environments

TRAINED_AS = "tlf_env/Infinity-v0"
TASK = {"learner": "robot_1", "action": "residual", "horizon_s": 20.0}
JUDGED_FROM_SEED = 10_000


class NoResidual:
    """The reference itself: a residual of zero."""

    def predict(
        self, observation: np.ndarray, state=None, episode_start=None, deterministic=True
    ) -> tuple[np.ndarray, None]:
        """Zero for every environment of the batch."""
        return np.zeros((len(observation), 2), np.float32), None


def judge(policy: object, episodes: int) -> float:
    """Mean return over the same few episodes for everybody."""
    env = make_vec_env(TRAINED_AS, 1, seed=JUDGED_FROM_SEED, env_kwargs=TASK)
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=episodes)
    env.close()
    return float(mean)


def main(steps: int = 8192, episodes: int = 2, seed: int = 0, out: Path | None = None) -> None:
    """Train, and compare the returns before and after with the reference's."""
    envs = make_vec_env(TRAINED_AS, 4, seed=seed, env_kwargs=TASK)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=512,
        batch_size=512,
        gamma=0.99,
        learning_rate=3e-4,
        policy_kwargs={"log_std_init": -2.0},  # begin near the reference
        seed=seed,
        device="cpu",
    )
    print(f"reference       return {judge(NoResidual(), episodes):8.1f}")
    print(f"untrained       return {judge(model, episodes):8.1f}")
    model.learn(steps)
    print(f"after {model.num_timesteps:8d}  return {judge(model, episodes):8.1f}")
    if out is not None:
        model.save(out)
        print(f"policy in {out}")
    envs.close()


if __name__ == "__main__":
    typer.run(main)
