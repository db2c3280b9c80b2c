"""The Gymnasium API in one loop: one robot learns, the default controller drives the others.

The learner is the first follower. Its action is a *residual*: it is added to the twist of the default
controller. An action of zero gives the reference itself; random actions show the effect of a bad policy.

    python examples/quickstart_gymnasium.py --horizon-s 30
"""

from __future__ import annotations

import gymnasium
import numpy as np
import typer

import tlf_env  # importing it registers the environments with Gymnasium


def episode_return(env: gymnasium.Env, *, random: bool, seed: int) -> tuple[float, str]:
    """Return of one episode with random or zero actions, and the reason for its end."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    total, over = 0.0, False
    while not over:
        action = env.action_space.sample() if random else np.zeros(2, np.float32)
        _seen, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        over = terminated or truncated
    return total, tlf_env.EndReason(info["end"]).name


def main(horizon_s: float = 30.0, seed: int = 0) -> None:
    """Compare zero with random residuals."""
    env = gymnasium.make(
        "tlf_env/Infinity-v0", learner="robot_1", action="residual", horizon_s=horizon_s
    )
    print(f"observation {env.observation_space.shape}, action {env.action_space.shape}")
    for name, random in (("reference", False), ("reference + random residual", True)):
        total, end = episode_return(env, random=random, seed=seed)
        print(f"{name:28s} return {total:7.1f}, ended by {end}")
    env.close()


if __name__ == "__main__":
    typer.run(main)
