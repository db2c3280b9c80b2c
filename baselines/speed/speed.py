"""How many steps a second, beside peers measured in the same run."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from baselines.policies.reference import ReferencePolicy
from baselines.runs.run import versions
from tlf_env.engine.arrays import Arrays, make_arrays
from tlf_env.engine.batch import BatchPlant
from tlf_env.envs.parallel import parallel_env
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.actions import REFERENCE

ROBOTS = (3, 5)
FORMATIONS = (1, 32, 1024, 8192)
THREADS = (1, 2)
PEER_ROBOTS = 3  # of VMAS
VMAS_SHARE = 0.1
# Cost against the number of robots, on a wide circle where even twenty do not meet.
SCALING = (1, 2, 10, 20)
WIDE_CIRCLE = {
    "name": "wide-circle",
    "trajectory": {"type": "circle", "radius_mm": 5000, "speed_mm_s": 200},
    "disturbance": "nominal",
}
PEER_CYCLES = 25  # simple_spread's own default episode
MPE2, VMAS, ALONE, VECTOR = (
    "mpe2/simple_spread_v3",
    "vmas/diff_drive",
    "tlf_env/infinity-v0",
    "tlf_env.FormationVectorEnv",
)

# Formations of a batch start the timing where some others stand in the middle of their episodes.
SEEDS = 32
# The reference that drives them, on the estimate that it is tuned for: none of them gets lost.
DRIVEN: dict[str, Any] = {"residual_base": "tuned", "estimator": "ekf-slip"}
BEGUN_STEPS = 1000  # all robots are on their way
MOMENTS = 16
STEPS_BETWEEN_MOMENTS = 100
STEPS_KEPT = 1500  # of the learner's actions, from each moment on
FORMATION_STEPS = 25_000  # in one timing of a batch, at least MIN_STEPS and at most `steps` each
MIN_STEPS = 3
PARTS_FORMATIONS = 1024


@dataclass
class Course:
    """Something that can be stepped for a while: ``drive(steps)`` steps it, set-up not counted."""

    name: str
    robots: int
    drive: Callable[[int], float]  # steps → seconds
    formations: int = 1
    threads: int = 1
    share: float = 1.0  # of the steps that others take, for what is slow

    @property
    def key(self) -> tuple[str, int, int, int]:
        """What tells it from others."""
        return self.name, self.robots, self.formations, self.threads

    def steps(self, steps: int) -> int:
        """Steps of one timing where a single formation takes ``steps``."""
        return max(MIN_STEPS, min(int(steps * self.share), FORMATION_STEPS // self.formations))


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


class Moments:
    """Some formations under the reference at several moments of a lap, and all their actions."""

    def __init__(self, robots: int, kept: int = STEPS_KEPT) -> None:
        plant = BatchPlant("infinity", SEEDS, robots=robots, end_on=(), **DRIVEN)
        plant.reset(seed=0)
        plant.arrays.kinds[:] = REFERENCE
        idle = np.zeros(plant.arrays.actions.shape)
        last = BEGUN_STEPS + (MOMENTS - 1) * STEPS_BETWEEN_MOMENTS
        self.robots = robots
        self.kept = kept
        self.arrays: list[Arrays] = []
        self.actions = np.empty((last + kept - BEGUN_STEPS, *idle.shape))  # (step, lane, robot, 2)
        for step in range(last + kept):
            if BEGUN_STEPS <= step <= last and (step - BEGUN_STEPS) % STEPS_BETWEEN_MOMENTS == 0:
                self.arrays.append(Arrays(*(array.copy() for array in plant.arrays)))
            plant.step(idle)
            if step >= BEGUN_STEPS:
                self.actions[step - BEGUN_STEPS] = plant.arrays.actions
        self.lanes = np.flatnonzero(~plant.lost.any(axis=1))  # the others may spin where they are

    def places(self, formations: int) -> tuple[np.ndarray, np.ndarray]:
        """At which moment each formation stands, and whose state it takes."""
        rows = np.arange(formations)
        return rows // len(self.lanes) % MOMENTS, self.lanes[rows % len(self.lanes)]

    def spread(self, plant: BatchPlant) -> None:
        """Put a plant's formations, whatever their number, where these stand, seeds included."""
        rows = np.arange(plant.formations)
        moment, lanes = self.places(plant.formations)
        for name, axis in lane_axes(plant).items():
            if name == "kinds":
                continue
            into = np.moveaxis(getattr(plant.arrays, name), axis, 0)
            for number, arrays in enumerate(self.arrays):
                chosen = rows[moment == number]
                into[chosen] = np.moveaxis(getattr(arrays, name), axis, 0)[lanes[chosen]]

    def actions_of(self, formations: int, step: int) -> np.ndarray:
        """What the reference did ``step`` steps after, (formation, robot, 2)."""
        moment, lanes = self.places(formations)
        return self.actions[moment * STEPS_BETWEEN_MOMENTS + step, lanes]


def lane_axes(plant: BatchPlant) -> dict[str, int]:
    """Which axis of each array counts the lanes, where one does."""
    one, two = (make_arrays(plant.scenarios, plant.arrays.table, lanes) for lanes in (1, 2))
    axes = {}
    for name in Arrays._fields:
        few, more = getattr(one, name).shape, getattr(two, name).shape
        if few != more:
            axes[name] = next(i for i in range(len(few)) if few[i] != more[i])
    return axes


class VectorRun:
    """A vector environment in the middle of its episodes, stepped with recorded actions."""

    def __init__(self, moments: Moments, formations: int) -> None:
        self.moments, self.formations = moments, formations
        self.env = FormationVectorEnv(
            "infinity",
            formations,
            robots=moments.robots,
            end_on=(),
            threads=max(THREADS),
            **DRIVEN,
        )
        self.env.reset(seed=0)
        self._next = moments.kept

    def drive(self, steps: int, threads: int) -> float:
        """Seconds of so many steps, robot_1 by prepared actions and the others by the reference."""
        moments = self.moments
        if steps > moments.kept:
            raise ValueError(f"steps {steps} must be at most {moments.kept}")
        if self._next + steps > moments.kept:
            moments.spread(self.env.plant)
            self._next = 0
        learner = min(1, moments.robots - 1)
        actions = [
            moments.actions_of(self.formations, self._next + k)[:, learner].astype(np.float32)
            for k in range(steps)
        ]
        self._next += steps
        self.env.plant.threads = threads
        start = time.perf_counter()
        for action in actions:
            self.env.step(action)
        return time.perf_counter() - start


def vector_courses(
    robots: int, formations: Sequence[int], threads: Sequence[int], steps: int
) -> list[Course]:
    """The Gymnasium vector environment: one learner in each formation, all robots simulated."""
    moments = Moments(robots, max(STEPS_KEPT, steps))
    courses = []
    for count in formations:
        run = VectorRun(moments, count)
        courses += [
            Course(VECTOR, robots, partial(run.drive, threads=used), count, used)
            for used in threads
            if used == 1 or count > 1
        ]
    return courses


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

    return Course(MPE2, robots, drive)


def vmas_courses(formations: Sequence[int], threads: Sequence[int]) -> list[Course]:
    """VMAS with its DiffDrive dynamics, or nothing without vmas."""
    if find_spec("vmas") is None:
        return []
    from baselines.speed.vmas import vmas_drive

    return [
        Course(VMAS, PEER_ROBOTS, vmas_drive(PEER_ROBOTS, count, used), count, used, VMAS_SHARE)
        for count in formations
        for used in threads
        if used == 1 or count > 1
    ]


def measure(
    steps: int = 1000,
    repeats: int = 7,
    progress: Callable[[int, int], None] | None = None,
    formations: Sequence[int] = FORMATIONS,
    threads: Sequence[int] = THREADS,
    peers: bool = True,
    parts: bool = True,
) -> dict[str, Any]:
    """Time all courses in turn, ``repeats`` times over, so that a noisy moment hits all alike.

    Parameters
    ----------
    steps
        Control steps in one timing of a single formation; batches take fewer.
    repeats
        Timings of each course.
    formations, threads
        Of the vector environment and of VMAS; no formations leave both out.
    peers
        Whether mpe2 and VMAS run too, where they are installed.
    parts
        Whether to tell where the time of a control step goes.

    Returns
    -------
    dict
        ``machine``, ``versions``, ``results`` (steps per second: median, minimum and maximum over
        the repeats; an agent step is one robot's in one formation), ``ratios`` (medians over the
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
    courses: list[Course] = []
    for robots in ROBOTS:
        courses.append(formation_course(robots, steps))
        if peers and (peer := peer_course(robots)) is not None:
            courses.append(peer)
    courses += [formation_course(robots, steps, WIDE_CIRCLE) for robots in SCALING]
    if formations:
        for robots in ROBOTS:
            courses += vector_courses(robots, formations, threads, steps)
        if peers:
            courses += vmas_courses(formations, threads)
    rates: dict[tuple[str, int, int, int], list[float]] = {course.key: [] for course in courses}
    for course in courses:
        course.drive(course.steps(min(steps, 50)))
    for repeat in range(repeats):
        for course in courses:
            count = course.steps(steps)
            rates[course.key].append(course.formations * count / course.drive(count))
        if progress is not None:
            progress(repeat + 1, repeats)
    del courses
    return {
        "machine": {
            "processor": processor_name(),
            "cores": os.cpu_count(),
            "system": platform.platform(terse=True),
            "load_average": load,
        },
        "versions": versions()
        | {name: version(name) for name in ("mpe2", "vmas", "torch") if peers and find_spec(name)},
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
        "parts": [_parts(robots, steps, repeats) for robots in ROBOTS] if parts else [],
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
    """Ours to mpe2's with as many robots, and to VMAS's with as many formations and threads too."""
    ratios = []
    for (name, robots, formations, threads), values in rates.items():
        if name not in (ALONE, VECTOR):
            continue
        beside = [(MPE2, robots, 1, 1)]
        if name == VECTOR:
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


def _parts(robots: int, steps: int, repeats: int) -> dict[str, Any]:
    """Parts of a formation's control step in a batch, µs of processor time on one thread, medians."""
    from baselines.speed.parts import stage_times

    formations = min(PARTS_FORMATIONS, max(1, steps))
    run = VectorRun(Moments(robots, 100), formations)
    plant, moments = run.env.plant, run.moments
    count = 2 * MIN_STEPS
    actions = [moments.actions_of(formations, k) for k in range(count)]
    rows: list[dict[str, float]] = []
    for _ in range(repeats):
        moments.spread(plant)
        start = time.process_time()
        for action in actions:
            plant.step(action)
        bare = time.process_time() - start
        learner = [action[:, min(1, robots - 1)].astype(np.float32) for action in actions]
        moments.spread(plant)
        start = time.process_time()
        for action in learner:
            run.env.step(action)
        whole = time.process_time() - start
        moments.spread(plant)
        row = stage_times(plant, count)
        row["api"] = max(whole - bare, 0.0) * 1e6 / (count * formations)
        rows.append(row)
    medians = {
        name: round(float(statistics.median(row[name] for row in rows)), 3) for name in rows[0]
    }
    return {"robots": robots, "formations": formations, "us_per_formation_step": medians}


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
