"""mpe2's ``simple_spread_v3`` as a peer: point masses in the plane."""

from __future__ import annotations

import time

import numpy as np
from mpe2 import simple_spread_v3

from baselines.speed.served import Drive

CYCLES = 25  # simple_spread's own default episode


def mpe2_drive(robots: int, formations: int = 1, threads: int = 1, at_once: int = 1) -> Drive:
    """``drive(steps)`` of one formation with continuous actions.

    Raises
    ------
    ValueError
        for more than one formation: an environment is one world.
    """
    if formations != 1:
        raise ValueError(f"formations {formations} must be 1")
    env = simple_spread_v3.parallel_env(N=robots, continuous_actions=True, max_cycles=CYCLES)
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    recorded = [
        {agent: generator.random(5, dtype=np.float32) for agent in env.possible_agents}
        for _ in range(CYCLES)
    ]

    def drive(count: int) -> float:
        total = 0.0
        for _ in range(max(1, count // CYCLES)):
            env.reset(seed=0)
            start = time.perf_counter()
            for actions in recorded:
                env.step(actions)
            total += time.perf_counter() - start
        return total * count / (max(1, count // CYCLES) * CYCLES)

    return drive
