"""SB3's PPO on many formations at once: a starting point, not a result.

Every robot of every formation is a sub-environment, and one policy learns for all of them. What it does is
added to the twist of the tuned reference, before that reference's limits, so that it begins as the
reference. The default trains for a few seconds and shows that everything fits together; a million robot
steps take about two minutes. The policy is written without torch's files, for ``tlf run --policy``.

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

JUDGED_FROM_SEED = 10_000  # other draws than those of the training


class NoResidual:
    """The reference itself: a residual of zero."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Zero for every row."""
        return np.zeros((len(observation), 2), observation.dtype), state


def judge(policy: Any, env: FormationVecEnv) -> float:
    """Mean reward of a robot and step over one episode of the same seeds for everybody."""
    env.seed(JUDGED_FROM_SEED)
    seen, rewards = env.reset(), []
    done = np.zeros(env.num_envs, dtype=bool)
    while not done.all():
        seen, reward, ended, _ = env.step(policy.predict(seen, deterministic=True)[0])
        rewards.append(np.where(done, 0.0, reward))  # what comes after the end is another episode
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
    """Train, and compare the rewards before and after with the reference's."""
    scenario = load_scenario(
        "infinity",
        disturbance=disturbance,
        action="residual",
        residual_base="tuned",
        estimator="ekf-slip",
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
    model.policy.action_net.weight.data.mul_(0.1)  # begin as the reference
    print(f"reference: mean reward {judge(NoResidual(), tests):.4f}")
    model.learn(robot_steps)
    print(f"after {model.num_timesteps} robot steps: mean reward {judge(model, tests):.4f}")
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
