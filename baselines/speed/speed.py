"""Steps per second, compared with peers that are measured in the same run."""

from __future__ import annotations

import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from baselines.runs.provenance import installed_versions, versions
from baselines.speed.crew import Crew
from baselines.speed.environments import (
    SPECIAL,
    SPECIAL_FORMATIONS,
    TimedEnvironment,
    mpe2_environment,
    single_formation,
    special_environments,
    vector_environments,
    vmas_environments,
)
from baselines.speed.footprint import (
    measured_peers,
    memory_rows,
    start_rows,
)
from baselines.speed.moments import THREADS
from baselines.speed.parts import part_times
from baselines.speed.peers import ALONE, PEER_ROBOTS, PEERS, VECTOR, Peer, checked_pythons
from baselines.speed.trained import trained_row
from tlf_env.engine.batch import BatchPlant

Key = tuple[str, int, int, int]  # name, robots, formations, threads

ROBOTS = (3, 5)
FORMATIONS = (1, 32, 1024, 8192)
# Cost against the number of robots, on a circle so wide that even twenty robots do not meet.
SCALING = (1, 2, 10, 20)
WIDE_CIRCLE = {
    "name": "wide-circle",
    "trajectory": {"type": "circle", "radius_mm": 5000, "speed_mm_s": 200},
    "disturbance": "nominal",
}


def measure(
    steps: int = 1000,
    repeats: int = 7,
    progress: Callable[..., None] | None = None,
    formations: Sequence[int] = FORMATIONS,
    threads: Sequence[int] = THREADS,
    peers: bool = True,
    parts: bool = True,
    peer_pythons: Mapping[str, str] | None = None,
    memory: Sequence[int] | None = None,
    start: int | None = None,
    training: str | None = None,
) -> dict[str, Any]:
    """Time all environments in turn, ``repeats`` times, so that a disturbance affects all of them alike.

    Peers in JAX or Bullet run in processes of their own, as their libraries read only once how many
    threads they have, and may need other versions than ours.

    Parameters
    ----------
    steps
        Control steps in one timing of a single formation; batches take fewer.
    repeats
        Timings of each environment.
    formations, threads
        Numbers for the vector environment and the peers of many formations; without formations all of these
        are left out. Scenarios that cost less or more than usual are timed if 1024 formations or more are
        among them.
    peers
        Whether to time those of :data:`~baselines.speed.peers.PEERS`, too, that are installed.
    parts
        Whether to measure the parts of a control step.
    peer_pythons
        The Python of a peer, by its package, where it is not ours.
    memory
        Two numbers of formations between which the growth of the memory is measured; None: it is not.
    start
        Formations of those environments of many of which the time up to the first step is measured, of
        ours also without compiled drivers; None: it is not.
    training
        Preset or file of a training that is timed; None: none is.

    Returns
    -------
    dict
        ``machine``, ``versions``, ``results`` (steps per second: median, minimum and maximum over
        the repeats; an agent step is one step of one robot), ``ratios`` (medians over the
        repeats of ours to a peer's agent steps), ``scaling`` (cost of a step against the number of
        robots), ``parts`` (µs of a formation's control step), ``memory_per_formation_bytes`` (of our arrays),
        ``compiled`` (processor time that compiling the steps of a peer took, s), ``left_out`` (a line for each
        peer that was not measured), and ``memory``, ``starts`` and ``training`` where these were asked for.

    Raises
    ------
    ValueError
        if ``steps``, ``repeats``, a number of formations or of threads is below 1, for a Python that is not
        there, and for a training without stable-baselines3.
    OSError
        for a peer that ends while it is timed, and a training that fails.
    """
    if steps < 1 or repeats < 1:
        raise ValueError(f"steps {steps} and repeats {repeats} must be at least 1")
    if any(number < 1 for number in (*formations, *threads)):
        raise ValueError(f"formations {formations} and threads {threads} must be at least 1")
    if memory is not None and not 1 <= memory[0] < memory[-1]:
        raise ValueError(f"memory {tuple(memory)} must be two growing numbers of formations")
    crew = Crew(checked_pythons(peer_pythons or {}))
    load = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
    update = progress or _no_progress
    with crew:
        rates = _rates(crew, steps, repeats, update, formations, threads, peers)
    result = {
        "machine": {
            "processor": processor_name(),
            "cores": os.cpu_count(),
            "system": platform.platform(terse=True),
            "load_average": load,
        },
        "versions": versions() | _peer_versions(crew, rates),
        "steps": steps,
        "repeats": repeats,
        "results": [_result(key, values) for key, values in rates.items()],
        "ratios": _ratios(rates),
        "compiled": [
            {
                "env": one.peer.name,
                "robots": one.robots,
                "formations": count,
                "threads": one.threads,
                "compile_s": round(seconds, 2),
            }
            for one in crew.workers
            for count, seconds in one.compile_s.items()
            if seconds
        ],
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
    if memory is not None:
        counted = _Counter(update, len(measured_peers(crew, peers, many=True)), "memory")
        result["memory"] = memory_rows(crew, peers, (memory[0], memory[-1]), counted)
    if start is not None:
        counted = _Counter(update, len(measured_peers(crew, peers, many=False)), "starts")
        result["starts"] = start_rows(crew, peers, start, counted)
    if training is not None:
        update(0, 1, "training")
        result["training"] = trained_row(training)
    result["left_out"] = crew.left_out
    return result


def _no_progress(done: int, total: int, what: str = "") -> None:
    pass


class _Counter:
    """Counts what is done, for a progress bar."""

    def __init__(self, update: Callable[..., None], total: int, what: str) -> None:
        self.update, self.total, self.what, self.done = update, total, what, 0
        update(0, total, what)

    def __call__(self) -> None:
        self.done += 1
        self.update(self.done, self.total, self.what)


def _rates(
    crew: Crew,
    steps: int,
    repeats: int,
    update: Callable[..., None],
    formations: Sequence[int],
    threads: Sequence[int],
    peers: bool,
) -> dict[Key, list[float]]:
    """Formation steps per second of every environment, ``repeats`` times."""
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
    if peers:
        timed += crew.environments(formations, threads, steps)
    rates: dict[Key, list[float]] = {one.key: [] for one in timed}
    for one in timed:
        one.drive(one.steps(min(steps, 50)))
    for repeat in range(repeats):
        for one in timed:
            count = one.steps(steps)
            rates[one.key].append(one.formations * count / one.drive(count))
        update(repeat + 1, repeats)
    return rates


def _peer_versions(crew: Crew, rates: Mapping[Key, list[float]]) -> dict[str, str]:
    """Versions of the peers that were timed, each of its own Python."""
    names = {name for name, *_ in rates}
    here = [peer for peer in PEERS.values() if peer.name in names and not peer.served]
    found = installed_versions(package for peer in here for package in peer.packages)
    for worker in crew.workers:
        found |= worker.versions
    return found


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


def _ratios(rates: Mapping[Key, list[float]]) -> list[dict[str, Any]]:
    """Ratios of our agent steps per second to those of each peer, turn by turn.

    A peer of many formations is compared with ours of as many formations and threads, one of a single formation
    with all of ours; both with ours of as many robots, a peer of one robot with ours of three.
    """
    ratios = []
    for (name, robots, formations, threads), values in rates.items():
        if name not in (ALONE, VECTOR, *SPECIAL):
            continue
        for peer in PEERS.values():
            key = _beside(peer, name, robots, formations, threads)
            if key is None or key not in rates:
                continue
            paired = [
                ours * robots / (theirs * key[1])
                for ours, theirs in zip(values, rates[key], strict=True)
            ]
            ratios.append(
                {
                    "env": name,
                    "robots": robots,
                    "formations": formations,
                    "threads": threads,
                    "to": peer.name,
                    "ratio": round(statistics.median(paired), 3),
                    "min": round(min(paired), 3),
                    "max": round(max(paired), 3),
                }
            )
    return ratios


def _beside(peer: Peer, name: str, robots: int, formations: int, threads: int) -> Key | None:
    """What a peer is compared with ours by; None if it is not."""
    theirs = 1 if peer.robots == (1,) and robots == PEER_ROBOTS else robots
    if not peer.many:
        return peer.name, theirs, 1, 1
    return None if name == ALONE else (peer.name, theirs, formations, threads)


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
