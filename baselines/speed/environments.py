"""The environments that are timed: ours, alone and many at once, and the peers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from baselines.policies.reference import ReferencePolicy
from baselines.speed.moments import STEPS_KEPT, Moments, VectorRun
from baselines.speed.peers import MPE2, PEER_ROBOTS, PEERS, VECTOR, VMAS, Peer, is_missing
from baselines.speed.worker import Worker
from tlf_env.envs.parallel import parallel_env

# What costs less or more: few position fixes, robots that slide, and numbers of single precision.
FEW_FIXES = {"position": {"period_s": 0.01}}
SPECIAL: dict[str, dict[str, Any]] = {
    f"{VECTOR}, fixes at 100 Hz": {"disturbance": FEW_FIXES},
    f"{VECTOR}, combined-hard": {"disturbance": "combined-hard"},
    f"{VECTOR}, single precision": {"precision": "single"},
    f"{VECTOR}, single precision, fixes at 100 Hz": {
        "precision": "single",
        "disturbance": FEW_FIXES,
    },
}
SPECIAL_FORMATIONS = 1024
VMAS_SHARE = 0.1
FORMATION_STEPS = (
    25_000  # of all formations in one timing; at least MIN_STEPS and at most `steps` each
)
MIN_STEPS = 3
STEPS_AT_ONCE = 100  # at most, of a peer that takes several in one go
PAPERS_FILTER: dict[str, Any] = {"estimator": "ekf", "broadcast_smoothing_s": 0.0}


@dataclass
class TimedEnvironment:
    """An environment to be timed: ``drive(steps)`` returns the seconds of the steps, without set-up."""

    name: str
    robots: int
    drive: Callable[[int], float]  # steps → seconds
    formations: int = 1
    threads: int = 1
    share: float = 1.0  # of the steps that the others take, for a slow environment

    @property
    def key(self) -> tuple[str, int, int, int]:
        """Key of its results."""
        return self.name, self.robots, self.formations, self.threads

    def steps(self, steps: int) -> int:
        """Steps of one timing if a single formation takes ``steps``."""
        return max(MIN_STEPS, min(int(steps * self.share), FORMATION_STEPS // self.formations))


def single_formation(robots: int, steps: int, scenario: Any = "infinity") -> TimedEnvironment:
    """The pymunk environment, 20 substeps a step, along a closed-loop run of the paper's controller and filter.

    The reference's actions are recorded first and replayed for the timing. So only the environment is
    timed, on a realistic motion.
    """
    env = parallel_env(scenario, robots=robots, horizon_s=max(steps, 50) * 0.02, **PAPERS_FILTER)
    policy = ReferencePolicy("consistent")
    observations, _ = env.reset(seed=0)
    recorded: list[dict[str, np.ndarray]] = []
    while env.agents:
        actions, _ = policy.predict(np.stack([observations[agent] for agent in env.agents]))
        recorded.append(dict(zip(env.agents, actions, strict=True)))
        observations, *_ = env.step(recorded[-1])

    def drive(count: int) -> float:
        env.reset(seed=0)
        start = time.perf_counter()
        for actions in recorded[:count]:
            env.step(actions)
        return time.perf_counter() - start

    return TimedEnvironment(f"tlf_env/{env.scenario.name}-v0", robots, drive)


def vector_environments(
    robots: int, formations: Sequence[int], threads: Sequence[int], steps: int
) -> list[TimedEnvironment]:
    """The Gymnasium vector environment: one learner in each formation, all robots simulated."""
    moments = Moments(robots, max(STEPS_KEPT, steps))
    made = []
    for count in formations:
        run = VectorRun(moments, count)
        made += [
            TimedEnvironment(VECTOR, robots, partial(run.drive, threads=used), count, used)
            for used in threads
            if used == 1 or count > 1
        ]
    return made


def special_environments(steps: int) -> list[TimedEnvironment]:
    """The vector environment of :data:`SPECIAL`, at one size and with one thread."""
    made = []
    for name, fields in SPECIAL.items():
        moments = Moments(PEER_ROBOTS, max(STEPS_KEPT, steps), **fields)
        run = VectorRun(moments, SPECIAL_FORMATIONS)
        made.append(
            TimedEnvironment(name, PEER_ROBOTS, partial(run.drive, threads=1), SPECIAL_FORMATIONS)
        )
    return made


def mpe2_environment(robots: int) -> TimedEnvironment | None:
    """mpe2's ``simple_spread_v3`` with continuous actions and as many agents; None without mpe2."""
    if is_missing(PEERS[MPE2]):
        return None
    from baselines.speed.mpe2 import mpe2_drive

    return TimedEnvironment(MPE2, robots, mpe2_drive(robots))


def vmas_environments(formations: Sequence[int], threads: Sequence[int]) -> list[TimedEnvironment]:
    """VMAS with its DiffDrive dynamics; empty without vmas."""
    if is_missing(PEERS[VMAS]):
        return []
    from baselines.speed.vmas import vmas_drive

    return [
        TimedEnvironment(
            VMAS, PEER_ROBOTS, vmas_drive(PEER_ROBOTS, count, used), count, used, VMAS_SHARE
        )
        for count in formations
        for used in threads
        if used == 1 or count > 1
    ]


def served_environments(
    peer: Peer, worker: Worker, robots: int, formations: Sequence[int], threads: int, steps: int
) -> list[TimedEnvironment]:
    """A peer in a process of its own, which compiles for each number of formations here.

    Raises
    ------
    PeerError
        if it cannot be made.
    """
    made = []
    for count in formations if peer.many else (1,):
        if threads > 1 and count == 1:
            continue
        one = TimedEnvironment(
            peer.name, robots, partial(worker.drive, formations=count), count, threads
        )
        worker.make(count, min(STEPS_AT_ONCE, one.steps(steps)))
        made.append(one)
    return made
