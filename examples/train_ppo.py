"""SB3's PPO on many formations at once: a starting point for your own training.

Every robot of every formation is a sub-environment, and one policy is trained for all of them. Its action
is a *residual*: it is added to the twist of the default controller, before its limits, so the initial policy
is close to that controller. The default trains for a few seconds, as a check; a million
robot steps take about two minutes. The policy is written in the format of ``tlf run --policy``, which does
not need torch.

    pip install 'tlf-env[train]'
    python examples/train_ppo.py --robot-steps 1000000 --out results/follower.safetensors
    tlf run infinity --disturbance slip --policy results/follower.safetensors
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from stable_baselines3 import PPO

from baselines.sb3 import FormationVecEnv
from baselines.training.export import export_policy
from tlf_env import load_scenario

EVALUATION_SEED = 10_000  # random draws that differ from those of the training


class NoResidual:
    """A residual of zero: the reference itself."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Zero for every row."""
        return np.zeros((len(observation), 2), observation.dtype), state


def evaluate(policy: Any, env: FormationVecEnv) -> float:
    """Mean reward per robot and step over one episode, with the same seeds for all policies."""
    env.seed(EVALUATION_SEED)
    observations, rewards = env.reset(), []
    done = np.zeros(env.num_envs, dtype=bool)
    while not done.all():
        observations, reward, ended, _ = env.step(
            policy.predict(observations, deterministic=True)[0]
        )
        rewards.append(np.where(done, 0.0, reward))  # after the end the next episode has begun
        done |= ended
    return float(np.mean(rewards))


def main(
    robot_steps: Annotated[int, typer.Option(min=1)] = 20_000,
    formations: int = 32,
    disturbance: str = "slip",
    horizon_s: float = 40.0,
    seed: int = 0,
    out: Path | None = None,
) -> None:
    """Train, and compare the mean reward with that of the reference."""
    scenario = load_scenario(
        "infinity",
        disturbance=disturbance,
        action="residual",
        horizon_s=horizon_s,
    )
    torch.set_num_threads(1)  # the network is small
    envs = FormationVecEnv(scenario, formations)
    tests = FormationVecEnv(scenario, 8)
    per_rollout = min(128, -(-robot_steps // envs.num_envs))
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=per_rollout,
        batch_size=min(4096, per_rollout * envs.num_envs),
        n_epochs=5,
        gamma=0.99,
        policy_kwargs={"log_std_init": -1.6},
        seed=seed,
        device="cpu",
    )
    model.policy.action_net.weight.data.mul_(0.1)  # start close to the reference
    print(f"reference: mean reward {evaluate(NoResidual(), tests):.4f}")
    model.learn(robot_steps)
    print(f"after {model.num_timesteps} robot steps: mean reward {evaluate(model, tests):.4f}")
    if out is not None:
        export_policy(
            model,
            out,
            scenario,
            training={"robot_steps": model.num_timesteps, "formations": formations},
            seeds={"learner": [seed]},
            command=f"python examples/train_ppo.py --robot-steps {robot_steps} --seed {seed}",
        )
        print(f"policy in {out}")


if __name__ == "__main__":
    typer.run(main)
