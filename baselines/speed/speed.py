"""Steps per second, compared with peers that are measured in the same run."""

from __future__ import annotations

import os
import platform
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from baselines.runs.provenance import installed_versions, versions
from baselines.speed.environments import (
    ALONE,
    MPE2,
    SPECIAL,
    SPECIAL_FORMATIONS,
    VECTOR,
    VMAS,
    TimedEnvironment,
    mpe2_environment,
    single_formation,
    special_environments,
    vector_environments,
    vmas_environments,
)
from baselines.speed.moments import THREADS
from baselines.speed.parts import part_times
from tlf_env.engine.batch import BatchPlant

ROBOTS = (3, 5)
FORMATIONS = (1, 32, 1024, 8192)
# Cost against the number of robots, on a circle so wide that even twenty robots do not meet.
SCALING = (1, 2, 10, 20)
WIDE_CIRCLE = {
    "name": "wide-circle",
    "trajectory": {"type": "circle", "radius_mm": 5000, "speed_mm_s": 200},
    "disturbance": "nominal",
}
PEER_PACKAGES = ("mpe2", "vmas", "torch")


def measure(
    steps: int = 1000,
    repeats: int = 7,
    progress: Callable[[int, int], None] | None = None,
    formations: Sequence[int] = FORMATIONS,
    threads: Sequence[int] = THREADS,
    peers: bool = True,
    parts: bool = True,
) -> dict[str, Any]:
    """Time all environments in turn, ``repeats`` times, so that a disturbance affects all of them alike.

    Parameters
    ----------
    steps
        Control steps in one timing of a single formation; batches take fewer.
    repeats
        Timings of each environment.
    formations, threads
        Numbers for the vector environment and VMAS; without formations both are left out. Scenarios that cost
        less or more than usual are timed if 1024 formations or more are among them.
    peers
        Whether to time mpe2 and VMAS, too, if they are installed.
    parts
        Whether to measure the parts of a control step.

    Returns
    -------
    dict
        ``machine``, ``versions``, ``results`` (steps per second: median, minimum and maximum over
        the repeats; an agent step is one step of one robot), ``ratios`` (medians over the
        repeats of ours to a peer's agent steps), ``scaling`` (cost of a step against the number of
        robots), ``parts`` (µs of a formation's control step) and ``memory_per_formation_bytes``.

    Raises
    ------
    ValueError
        if ``steps``, ``repeats``, a number of formations or of threads is below 1.
    """
    if steps < 1 or repeats < 1:
        raise ValueError(f"steps {steps} and repeats {repeats} must be at least 1")
    if any(number < 1 for number in (*formations, *threads)):
        raise ValueError(f"formations {formations} and threads {threads} must be at least 1")
    load = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
    timed: list[TimedEnvironment] = []
    for robots in ROBOTS:
        timed.append(single_formation(robots, steps))
        if peers and (peer := mpe2_environment(robots)) is not None:
            timed.append(peer)
    timed += [single_formation(robots, steps, WIDE_CIRCLE) for robots in SCALING]
    if formations:
        for robots in ROBOTS:
            timed += vector_environments(robots, formations, threads, steps)
        if max(formations) >= SPECIAL_FORMATIONS:
            timed += special_environments(steps)
        if peers:
            timed += vmas_environments(formations, threads)
    rates: dict[tuple[str, int, int, int], list[float]] = {one.key: [] for one in timed}
    for one in timed:
        one.drive(one.steps(min(steps, 50)))
    for repeat in range(repeats):
        for one in timed:
            count = one.steps(steps)
            rates[one.key].append(one.formations * count / one.drive(count))
        if progress is not None:
            progress(repeat + 1, repeats)
    del timed
    return {
        "machine": {
            "processor": processor_name(),
            "cores": os.cpu_count(),
            "system": platform.platform(terse=True),
            "load_average": load,
        },
        "versions": versions() | installed_versions(PEER_PACKAGES if peers else ()),
        "steps": steps,
        "repeats": repeats,
        "results": [_result(key, values) for key, values in rates.items()],
        "ratios": _ratios(rates),
        "scaling": [
            {
                "robots": robots,
                "us_per_step": round(1e6 / found, 1),
                "us_per_robot_step": round(1e6 / found / robots, 1),
            }
            for robots in SCALING
            for found in [statistics.median(rates["tlf_env/wide-circle-v0", robots, 1, 1])]
        ],
        "memory_per_formation_bytes": {
            str(robots): BatchPlant("infinity", 1, robots=robots).memory_per_formation_bytes
            for robots in ROBOTS
        },
        "parts": [part_times(robots, steps, repeats) for robots in ROBOTS] if parts else [],
    }


def _result(key: tuple[str, int, int, int], values: list[float]) -> dict[str, Any]:
    name, robots, formations, threads = key
    middle = statistics.median(values)
    return {
        "env": name,
        "robots": robots,
        "formations": formations,
        "threads": threads,
        "env_steps_per_s": round(middle, 1),
        "min": round(min(values), 1),
        "max": round(max(values), 1),
        "agent_steps_per_s": round(middle * robots, 1),
    }


def _ratios(rates: dict[tuple[str, int, int, int], list[float]]) -> list[dict[str, Any]]:
    """Ratios of our rates to mpe2's with as many robots, and to VMAS's with as many formations and threads."""
    ratios = []
    for (name, robots, formations, threads), values in rates.items():
        if name not in (ALONE, VECTOR, *SPECIAL):
            continue
        beside = [(MPE2, robots, 1, 1)]
        if name != ALONE:
            beside.append((VMAS, robots, formations, threads))
        for key in beside:
            if key not in rates:
                continue
            paired = [ours / theirs for ours, theirs in zip(values, rates[key], strict=True)]
            ratios.append(
                {
                    "env": name,
                    "robots": robots,
                    "formations": formations,
                    "threads": threads,
                    "to": key[0],
                    "ratio": round(statistics.median(paired), 3),
                    "min": round(min(paired), 3),
                    "max": round(max(paired), 3),
                }
            )
    return ratios


def processor_name() -> str:
    """Name of the processor as the system reports it."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
