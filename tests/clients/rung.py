"""What a client library has to do on the ladder's first rung, and how that is measured.

The rung is that of ``configs/train/ladder-1-point.yaml``: one robot without inertia follows a point, from its
true pose. Its action is added to the twist of the reference, so that an action of zero stays as far behind as
the start from rest leaves it, up to 0.7 m. To be short, an episode has 200 steps of 0.1 s, and the reward says
how far is too far, as in ``configs/train/scratch.yaml``.
"""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import tlf_env

RUNG: dict[str, Any] = {
    "robots": 1,
    "plant": "kinematic",
    "estimator": "truth",
    "disturbance": "none",
    "action": "tracking_twist",
    "reward": {"far": -1.0, "alive": 1.2},
    "control_period_s": 0.1,
    "horizon_s": 20.0,
}
TASK = "infinity"
ID = "tlf_env:tlf_env/Infinity-v0"  # with its module: also for libraries that make it in other processes
PHASES_S = (0.0, 4.0, 8.0, 12.0, 16.0)  # moments of the path at which the judged episodes begin
SEED = 0

Act = Callable[[np.ndarray, bool], np.ndarray]


def single(**changes: Any) -> gymnasium.Env:
    """The rung for one learner, by ``gymnasium.make``."""
    return gymnasium.make(ID, infos=False, **RUNG | changes)


def parallel(**changes: Any) -> Any:
    """The rung by ``parallel_env``."""
    return tlf_env.parallel_env(TASK, infos=False, **RUNG | changes)


class Client(ABC):
    """A learner of a library. A subclass names the library, and makes the learner in ``__init__``."""

    library: str  # as the page names it
    package: str  # as the registry of packages names it
    algorithm: str
    door: str  # by which the environment is reached
    steps: int  # of the environment, in a training
    remark: str = ""

    @abstractmethod
    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        """The action without noise, shape (2,), for an observation, shape (41,); ``first`` of an episode."""

    @abstractmethod
    def learn(self) -> list[float]:
        """Train for :attr:`steps` steps, and return the losses that the library reports."""

    @abstractmethod
    def loaded(self, folder: Path) -> Act:
        """Save into an empty folder, load from there into a new learner, and return how that acts."""

    def close(self) -> None:  # noqa: B027 - not abstract: most learners have nothing to end
        """End what runs in the background."""


def returns(act: Act) -> list[float]:
    """Return of an episode from each of :data:`PHASES_S`, in which actions are clipped to their space."""
    env = single()
    found = []
    for phase_s in PHASES_S:
        seen, _ = env.reset(seed=SEED, options={"phase_s": phase_s})
        total, first, over = 0.0, True, False
        while not over:
            action = np.asarray(act(seen, first), np.float32).reshape(2)
            seen, reward, terminated, truncated, _ = env.step(np.clip(action, -1.0, 1.0))
            total, first, over = total + float(reward), False, terminated or truncated
        found.append(total)
    return found


def observations(count: int = 64) -> np.ndarray:
    """Observations of an episode with random actions, one row each."""
    env = single()
    rng = np.random.default_rng(SEED)
    rows = [env.reset(seed=SEED)[0]]
    while len(rows) < count:
        rows.append(env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))[0])
    return np.array(rows)


def same_actions(one: Act, other: Act) -> bool:
    """Whether two policies act alike in an episode, to the last bit."""
    rows = observations()
    mine, theirs = (
        np.array([act(row, i == 0) for i, row in enumerate(rows)]) for act in (one, other)
    )
    return bool(np.array_equal(mine, theirs))


def rises(before: list[float], after: list[float]) -> bool:
    """Whether the mean return has grown by more than twice the standard error of its growth."""
    growth = np.subtract(after, before)
    return bool(growth.mean() > 2.0 * growth.std(ddof=1) / math.sqrt(len(growth)))


def versions(*packages: str) -> dict[str, str]:
    """Versions of Python and of packages, those that are not installed left out."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = importlib.metadata.version(name).partition("+")[0]
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def processor_time_s() -> float:
    """Time of the processor that this process has used, and its children that have ended."""
    return sum(os.times()[:4])


def measured(kind: type[Client], folder: Path) -> dict[str, Any]:
    """A row of the table: train a client, and see what it did before and afterwards."""
    begun_s = processor_time_s()
    client = kind()
    try:
        before = returns(client.act)
        losses = client.learn()
        if not losses or not np.isfinite(losses).all():
            raise ValueError(f"the losses of {kind.library}'s {kind.algorithm} are {losses}")
        after = returns(client.act)
        same = same_actions(client.act, client.loaded(folder))
    finally:
        client.close()
    return {
        "library": kind.library,
        "package": kind.package,
        "version": importlib.metadata.version(kind.package),
        "algorithm": kind.algorithm,
        "door": kind.door,
        "steps": kind.steps,
        "before": [round(one, 2) for one in before],
        "after": [round(one, 2) for one in after],
        "rises": rises(before, after),
        "losses": len(losses),
        "loads": same,
        "seconds": round(processor_time_s() - begun_s, 1),
        "remark": kind.remark,
        "versions": versions("torch", "numpy", "gymnasium", "pettingzoo"),
    }
