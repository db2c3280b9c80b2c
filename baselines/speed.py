"""How many environment steps a second, beside a peer measured in the same run."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from baselines.reference import ReferencePolicy
from baselines.run import versions
from tlf_env.envs.parallel import parallel_env

ROBOTS = (3, 5)
# Cost against the number of robots, on a wide circle where even twenty do not meet.
SCALING = (1, 2, 10, 20)
WIDE_CIRCLE = {
    "name": "wide-circle",
    "trajectory": {"type": "circle", "radius_mm": 5000, "speed_mm_s": 200},
    "disturbance": "nominal",
}
PEER_CYCLES = 25  # simple_spread's own default episode


@dataclass
class Course:
    """Something that can be stepped for a while: ``drive(steps)`` steps it, set-up not counted."""

    name: str
    robots: int
    drive: Callable[[int], float]  # steps → seconds


def formation_course(robots: int, steps: int, scenario: Any = "infinity") -> Course:
    """The pymunk environment, 20 substeps a step, along a closed-loop run of the reference.

    The reference's actions are recorded first and replayed while the clock runs, so that only the
    environment is timed, on the motion that it is made for.
    """
    env = parallel_env(scenario, robots=robots, horizon_s=max(steps, 50) * 0.02)
    policy = ReferencePolicy()
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

    return Course(f"tlf_env/{env.scenario.name}-v0", robots, drive)


def peer_course(robots: int) -> Course | None:
    """mpe2's ``simple_spread_v3`` with continuous actions and as many agents, or None without mpe2."""
    if find_spec("mpe2") is None:
        return None
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=robots, continuous_actions=True, max_cycles=PEER_CYCLES)
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    recorded = [
        {agent: generator.random(5, dtype=np.float32) for agent in env.possible_agents}
        for _ in range(PEER_CYCLES)
    ]

    def drive(count: int) -> float:
        total = 0.0
        for _ in range(max(1, count // PEER_CYCLES)):
            env.reset(seed=0)
            start = time.perf_counter()
            for actions in recorded:
                env.step(actions)
            total += time.perf_counter() - start
        return total * count / (max(1, count // PEER_CYCLES) * PEER_CYCLES)

    return Course("mpe2/simple_spread_v3", robots, drive)


def measure(
    steps: int = 1000, repeats: int = 7, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Time all courses in turn, ``repeats`` times over, so that a noisy moment hits all alike.

    Returns
    -------
    dict
        ``machine``, ``versions``, ``results`` (env steps per second: median, minimum and maximum
        over the repeats), ``ratios`` (median over the repeats of ours to the peer's) and ``scaling``
        (cost of a step against the number of robots).

    Raises
    ------
    ValueError
        if ``steps`` or ``repeats`` is below 1.
    """
    if steps < 1 or repeats < 1:
        raise ValueError(f"steps {steps} and repeats {repeats} must be at least 1")
    courses: list[Course] = []
    for robots in ROBOTS:
        courses.append(formation_course(robots, steps))
        peer = peer_course(robots)
        if peer is not None:
            courses.append(peer)
    courses += [formation_course(robots, steps, WIDE_CIRCLE) for robots in SCALING]
    rates: dict[tuple[str, int], list[float]] = {(c.name, c.robots): [] for c in courses}
    for course in courses:
        course.drive(min(steps, 50))
    for repeat in range(repeats):
        for course in courses:
            rates[course.name, course.robots].append(steps / course.drive(steps))
        if progress is not None:
            progress(repeat + 1, repeats)
    return {
        "machine": {
            "processor": processor_name(),
            "cores": os.cpu_count(),
            "system": platform.platform(terse=True),
        },
        "versions": versions() | ({"mpe2": version("mpe2")} if find_spec("mpe2") else {}),
        "steps": steps,
        "repeats": repeats,
        "results": [
            {
                "env": name,
                "robots": robots,
                "env_steps_per_s": round(statistics.median(values), 1),
                "min": round(min(values), 1),
                "max": round(max(values), 1),
            }
            for (name, robots), values in rates.items()
        ],
        "ratios": _ratios(rates),
        "scaling": [
            {
                "robots": robots,
                "us_per_step": round(
                    1e6 / statistics.median(rates["tlf_env/wide-circle-v0", robots]), 1
                ),
                "us_per_robot_step": round(
                    1e6 / statistics.median(rates["tlf_env/wide-circle-v0", robots]) / robots, 1
                ),
            }
            for robots in SCALING
        ],
    }


def _ratios(rates: dict[tuple[str, int], list[float]]) -> list[dict[str, Any]]:
    ratios = []
    for (name, robots), values in rates.items():
        peer = rates.get(("mpe2/simple_spread_v3", robots))
        if peer is None or name.startswith("mpe2"):
            continue
        paired = [ours / theirs for ours, theirs in zip(values, peer, strict=True)]
        ratios.append(
            {
                "robots": robots,
                "to": "mpe2/simple_spread_v3",
                "ratio": round(statistics.median(paired), 3),
            }
        )
    return ratios


def processor_name() -> str:
    """The processor's name as the system tells it."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
