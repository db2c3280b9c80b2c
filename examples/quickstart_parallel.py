"""The PettingZoo parallel API in one loop: three robots on the ∞, each of them an agent.

It shows reset, step, the content of ``info``, and a policy that uses only observations.

    python examples/quickstart_parallel.py --horizon-s 30
"""

from __future__ import annotations

import typer

import tlf_env
from baselines import ReferencePolicy


def main(horizon_s: float = 30.0, seed: int = 0) -> None:
    """Run the default controller to the end of an episode and print the error of each robot."""
    env = tlf_env.parallel_env("infinity", horizon_s=horizon_s)
    policy = ReferencePolicy()
    observations, infos = env.reset(seed=seed)
    returns = dict.fromkeys(env.agents, 0.0)
    while env.agents:
        actions = {
            agent: policy.predict(observation)[0] for agent, observation in observations.items()
        }
        observations, rewards, _terminated, _truncated, infos = env.step(actions)
        for agent, reward in rewards.items():
            returns[agent] += reward

    end = tlf_env.EndReason(infos["robot_0"]["end"])
    print(f"ended by {end.name} after {env.formation.time_s:g} s")
    for agent, info in infos.items():
        print(
            f"{agent}: {info['position_error_mm']:6.2f} mm off its reference, "
            f"time gap off by {info['time_gap_error_s']:+.4f} s, return {returns[agent]:.0f}"
        )


if __name__ == "__main__":
    typer.run(main)
