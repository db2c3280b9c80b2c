"""PPO with its defaults learns to follow, from nothing: one robot, no controller beneath, by Gymnasium.

The default system drives the other robots. The action of the learner is added to the twist of its reference,
so that an action of zero follows it; before the training the robot is lost after half a minute. 1 000 000 steps
take 14 minutes.

    pip install 'tlf-env[train]'
    python examples/learn_to_follow.py --steps 1000000
"""

from __future__ import annotations

from typing import NamedTuple

import gymnasium
import numpy as np
import torch
import typer
from stable_baselines3 import PPO

import tlf_env

FIRST_SEED = 20_000  # random draws that differ from those of the training
SETTLED_SHARE = 0.4  # of the episode; errors count after it


class Played(NamedTuple):
    """One episode with a policy's actions, without noise on them."""

    total: float  # return
    rms_mm: float  # of the position error
    end: tlf_env.EndReason


def play(model: PPO, env: gymnasium.Env, seed: int) -> Played:
    """Play one episode to its end."""
    seen, _ = env.reset(seed=seed)
    total, errors_mm, over = 0.0, [], False
    while not over:
        action, _ = model.predict(seen, deterministic=True)
        seen, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        errors_mm.append(info["position_error_mm"])
        over = terminated or truncated
    settled = np.array(errors_mm[int(SETTLED_SHARE * len(errors_mm)) :])
    return Played(total, float(np.sqrt(np.mean(settled**2))), tlf_env.EndReason(info["end"]))


def main(steps: int = 20_000, episodes: int = 5, horizon_s: float = 60.0, seed: int = 0) -> None:
    """Train, and compare what the policy did before with what it does afterwards."""
    torch.set_num_threads(1)  # the network is small
    train = gymnasium.make("tlf_env/Infinity-v0", infos=False)
    test = gymnasium.make(
        "tlf_env/Infinity-v0", horizon_s=horizon_s, infos=("position_error_mm", "end")
    )
    model = PPO("MlpPolicy", train, seed=seed, device="cpu")
    for when in ("before", "after"):
        if when == "after":
            model.learn(steps)
        found = [play(model, test, FIRST_SEED + i) for i in range(episodes)]
        held = sum(one.end is tlf_env.EndReason.HORIZON for one in found)
        print(
            f"{when}: mean return {np.mean([one.total for one in found]):.0f}, held {held} of {episodes}, "
            f"position RMS {np.median([one.rms_mm for one in found]):.2f} mm (median)"
        )


if __name__ == "__main__":
    typer.run(main)
