"""Rollouts of one process and of the workers of a Ray cluster: the table of ``docs/scale.md``.

``python docs/figures/make_scale.py`` needs the extras ``train`` and ``ray`` and takes about five minutes.
Ray runs on this machine. All ways take turns; a round of each is :data:`STEPS` control steps with actions of a
small deviation, as a learner's are, and times are medians of the rounds by the clock.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from make_board import DOCS
from make_parts import put
from make_speed import number, table

from baselines.ray_sb3 import RayFormationVecEnv
from baselines.sb3 import FormationVecEnv

PAGE = DOCS / "scale.md"
FORMATIONS = (64, 512)
STEPS, ROUNDS, DEVIATION = 60, 7, 0.1
SCENARIO: dict[str, Any] = {"action": "tracking_twist", "infos": False}
WAYS: dict[str, Callable[[int], Any]] = {
    "one process, one thread": lambda count: FormationVecEnv("infinity", count, **SCENARIO),
    "one process, two threads": lambda count: FormationVecEnv(
        "infinity", count, threads=2, **SCENARIO
    ),
    "Ray, one worker": lambda count: RayFormationVecEnv("infinity", count, workers=1, **SCENARIO),
    "Ray, two workers": lambda count: RayFormationVecEnv("infinity", count, workers=2, **SCENARIO),
}


@contextmanager
def made(way: str, formations: int) -> Iterator[Any]:
    """The environments of a way, in the middle of their episodes."""
    envs = WAYS[way](formations)
    try:
        envs.seed(0)
        envs.reset()
        drive(envs, 3 * STEPS)
        yield envs
    finally:
        envs.close()


def drive(envs: Any, steps: int) -> float:
    """Time of some steps, s."""
    generator = np.random.default_rng(0)
    actions = DEVIATION * generator.standard_normal((steps, envs.num_envs, 2)).clip(-3, 3)
    start = time.perf_counter()
    for one in actions.astype(np.float32):
        envs.step(one)
    return time.perf_counter() - start


def main() -> None:
    """Measure, and write the table."""
    rows = {way: [way] for way in WAYS}
    for count in FORMATIONS:
        times: dict[str, list[float]] = {way: [] for way in WAYS}
        for _ in range(ROUNDS):
            for way in WAYS:
                with made(way, count) as envs:
                    times[way].append(drive(envs, STEPS) / STEPS)
        for way, found in times.items():
            step_s = statistics.median(found)
            rows[way] += [f"{step_s * 1e3:.2f}", number(3 * count / step_s)]
            print(count, way, *rows[way][-2:], flush=True)
    head = [""]
    for count in FORMATIONS:
        head += [f"{count} formations: ms per step", "robot steps/s"]
    put(PAGE, table(head, list(rows.values())), "rollouts")


if __name__ == "__main__":
    main()
