"""Our own environments as a process of their own steps them, for memory and for the time of a start."""

from __future__ import annotations

import numpy as np

from baselines.speed.moments import DRIVEN
from baselines.speed.served import Drive, timed
from tlf_env.envs.parallel import parallel_env
from tlf_env.envs.vector import FormationVectorEnv


def vector_drive(robots: int, formations: int, threads: int, at_once: int) -> Drive:
    """``drive(steps)`` of the Gymnasium vector environment from the start of its episodes, actions zero."""
    env = FormationVectorEnv(
        "infinity", formations, threads=threads, robots=robots, end_on=(), **DRIVEN
    )
    env.reset(seed=0)
    idle = np.zeros((formations, 2), dtype=np.float32)
    return lambda steps: timed(lambda: env.step(idle), steps)


def single_drive(robots: int, formations: int, threads: int, at_once: int) -> Drive:
    """``drive(steps)`` of one formation of the PettingZoo environment, with actions of zero."""
    env = parallel_env("infinity", robots=robots)
    idle = {agent: np.zeros(2, dtype=np.float32) for agent in env.possible_agents}
    env.reset(seed=0)

    def drive(steps: int) -> float:
        return timed(lambda: env.step(idle), steps)

    return drive
