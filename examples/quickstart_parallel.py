"""Three robots on the ∞, every one an agent: the PettingZoo parallel API in one loop.

Shows reset, step, what ``info`` tells, and a policy that sees observations only.

    python examples/quickstart_parallel.py --horizon-s 30
"""

from __future__ import annotations

import typer

import tlf_env
from baselines import ReferencePolicy


def main(horizon_s: float = 30.0, seed: int = 0) -> None:
    """Drive the paper's controller to the end of an episode and print each robot's error."""
    env = tlf_env.parallel_env("infinity", horizon_s=horizon_s)
    policy = ReferencePolicy()
    observations, infos = env.reset(seed=seed)
    returns = dict.fromkeys(env.agents, 0.0)
    while env.agents:
        actions = {agent: policy.predict(seen)[0] for agent, seen in observations.items()}
        observations, rewards, _terminated, _truncated, infos = env.step(actions)
        for agent, reward in rewards.items():
            returns[agent] += reward

    print(f"ended by {infos['robot_0']['end']} after {env.formation.time_s:g} s")
    for agent, info in infos.items():
        print(
            f"{agent}: {info['position_error_mm']:6.2f} mm off its reference, "
            f"time gap off by {info['time_gap_error_s']:+.4f} s, return {returns[agent]:.0f}"
        )


if __name__ == "__main__":
    typer.run(main)
