"""The test set: cases with random tasks, robots and composite disturbances, made from a seed.

It is frozen: the cases of a version never change. A change of this file, of a file that it draws from, or of
the rules in :mod:`tlf_env.task.feasibility` that changes a case needs a new :data:`VERSION`; a test compares
the cases with recorded digests.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from pydantic import TypeAdapter

from baselines.benchmark.drawn_disturbances import (
    Channels,
    drawn_disturbance,
    load_of,
    with_patches,
)
from baselines.benchmark.drawn_tasks import (
    HORIZON_S,
    Course,
    Curve,
    drawn_course,
    drawn_curve,
    drawn_row,
    trajectory_of,
)
from baselines.benchmark.draws import Draws, rounded, words_of
from baselines.runs.splits import TEST_SET
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.feasibility import disturbed, grip_acceleration, warnings_for
from tlf_env.task.scenario import Scenario, load_scenario
from tlf_env.task.trajectories import Trajectory, reference_from

VERSION = 1
NAME = TEST_SET  # `tlf tune` and `tlf train` refuse scenarios whose names begin so

SLOWEST_MM_S = 160.0  # a task that the robots can follow only more slowly is drawn again,
TASKS = 3  # up to so many times; then the disturbance is drawn again, too, and less severe
EASIER = 0.9
HALVINGS = 3  # of the interval between the slowest and the drawn speed
ROOM_MM = 40.0  # smallest distance between outlines, if all robots are in their places
PATCH_GRIP = 1.05  # a motion needs at most this share of the dynamic grip on a patch
REST = "the reference is at rest"  # in a warning that does not count: a case may have stops
UNLIMITED = 1e6  # grip and torque of a robot that is checked for its size only
TRAJECTORY: TypeAdapter[Trajectory] = TypeAdapter(Trajectory)


class Task(NamedTuple):
    """A task that all robots of a row can follow under the known part of a disturbance."""

    row: dict[str, Any]
    trajectory: dict[str, Any]


def drawn_case(seed: int, key: str = "") -> dict[str, Any]:
    """A case of the test set as a mapping for :func:`~tlf_env.task.scenario.load_scenario`.

    Parameters
    ----------
    seed
        Number of the case, at least 0. The published cases begin at 20000.
    key
        A text that makes a set of cases of its own; empty: the published set.

    Returns
    -------
    dict
        The scenario's fields. Every number in it is rounded, so that it is the same on every machine.
    """
    draws, severity = _begun(seed, key)
    share = draws.uniform(0.78, 0.95)  # of what motors and tyres give
    task, drawn = None, severity
    while task is None:
        channels = drawn_disturbance(draws, drawn)
        task = _drawn_task(draws, channels, share)
        drawn *= EASIER
    patches = _patches(draws, severity, channels, task)
    if patches:
        channels["tyre"]["patches"] = patches
    return {
        "name": f"{NAME}-{VERSION}-{seed}",
        "trajectory": task.trajectory,
        **task.row,
        "horizon_s": HORIZON_S,
        "disturbance": {
            "name": f"{NAME}-{VERSION}-{seed}",
            **{group: channels[group] for group in sorted(channels) if channels[group]},
        },
    }


def severity_of(seed: int, key: str = "") -> float:
    """How hard the disturbance of a case is drawn, 0 to 1; parameters as of :func:`drawn_case`."""
    return _begun(seed, key)[1]


def _begun(seed: int, key: str) -> tuple[Draws, float]:
    """The draws of a case after the first, its severity."""
    draws = Draws(VERSION, seed, *words_of(key))
    return draws, draws.uniform(0, 1)


@functools.lru_cache(maxsize=64)
def case_scenario(seed: int, key: str = "") -> Scenario:
    """The scenario of a case; parameters as of :func:`drawn_case`."""
    return load_scenario(drawn_case(seed, key))


def _drawn_task(draws: Draws, channels: Channels, share: float) -> Task | None:
    """The first of some drawn tasks that the robots can follow, as fast as drawn or slower."""
    for _ in range(TASKS):
        curve, course = drawn_curve(draws), drawn_course(draws)
        row = drawn_row(draws, stops=course.stops is not None)
        robots = [_burdened(robot, channels, share) for robot in _distinct(row["robots"])]
        fitting = _as_fast_as_possible(curve, course, row["start_ramp_s"], robots)
        if fitting is not None and not _meets_itself(curve, fitting, row):
            return Task(row, trajectory_of(curve, fitting))
    return None


def _as_fast_as_possible(
    curve: Curve, course: Course, ramp_s: float, robots: list[RobotParameters]
) -> Course | None:
    """The course at its speed, or at a lower one that the robots can follow, found by bisection."""
    if _can_follow(curve, course, ramp_s, robots):
        return course
    slow, fast = SLOWEST_MM_S, course.speed_mm_s
    best = course._replace(speed_mm_s=slow)
    if not _can_follow(curve, best, ramp_s, robots):
        return None
    for _ in range(HALVINGS):
        middle = course._replace(speed_mm_s=rounded(math.sqrt(slow * fast)))
        if _can_follow(curve, middle, ramp_s, robots):
            best, slow = middle, middle.speed_mm_s
        else:
            fast = middle.speed_mm_s
    return best


def _distinct(robots: list[dict[str, Any]]) -> list[RobotParameters]:
    return list(dict.fromkeys(RobotParameters(**robot) for robot in robots))


def _burdened(robot: RobotParameters, channels: Channels, share: float) -> RobotParameters:
    """A robot with what a disturbance leaves of its motors and its grip, times a share."""
    load = load_of(channels)
    mass = robot.mass_kg + load["mass_kg"]
    force_mN = (
        load["weight"] * mass * robot.gravity_mm_s2
        + load["acceleration_mm_s2"] * mass
        + load["force_N"] * MILLINEWTON_PER_NEWTON
    )
    yaw_mN_mm = (
        load["torque_Nmm"] * MILLINEWTON_PER_NEWTON
        + load["yaw_acceleration_rad_s2"] * robot.body_inertia_kg_mm2
    )
    taken = (
        robot.wheel_radius_mm * (force_mN / 2 + yaw_mN_mm / robot.axle_width_mm)
    ) / MILLINEWTON_PER_NEWTON + load["dead_band_Nmm"] / 2
    fastest_rad_s = 500 / robot.wheel_radius_mm
    falling = load["stall_torque"] * (1.0 - load["back_emf_s_rad"] * fastest_rad_s)
    delivered = load["motors"] * (min(1.0, falling) if load["back_emf_s_rad"] else 1.0)
    com_mm = (
        robot.mass_kg * robot.com_offset_mm + load["mass_kg"] * load["behind_mm"]
    ) / mass  # the payload's place counts in turns
    castor = com_mm / (robot.castor_pivot_mm + robot.castor_trail_mm)
    heavier = robot.model_copy(
        update={
            "mass_kg": mass,
            "com_offset_mm": com_mm,
            "castor_load_share": castor,
            "drive_load_share": (1.0 - castor) / 2,
            "body_inertia_kg_mm2": robot.body_inertia_kg_mm2 + load["inertia_kg_mm2"],
            "torque_limit_Nmm": max(share * delivered * robot.torque_limit_Nmm - taken, 0.01),
        }
    )
    return disturbed(heavier, share * _grip_of(channels), 1.0)


def _grip_of(channels: Channels) -> float:
    """Share of the friction that both drive tyres have together on the whole floor."""
    tyre = channels["tyre"]
    sides = [tyre.get("friction_left", 1.0), tyre.get("friction_right", 1.0)]
    return tyre.get("friction_scale", 1.0) * sum(sides) / 2


def _can_follow(curve: Curve, course: Course, ramp_s: float, robots: list[RobotParameters]) -> bool:
    """Whether a motion is within the limits of all robots."""
    path = _loaded(trajectory_of(curve, course))
    return not any(_beyond(path, one, start_ramp_s=ramp_s) for one in robots)


def _meets_itself(curve: Curve, course: Course, row: dict[str, Any]) -> bool:
    """Whether outlines in the row come nearer than :data:`ROOM_MM`."""
    usual = RobotParameters(torque_limit_Nmm=UNLIMITED)
    wide = usual.model_copy(update={"outline_radius_mm": usual.outline_radius_mm + ROOM_MM / 2})
    lines = _beyond(
        _loaded(trajectory_of(curve, course)),
        disturbed(wide, UNLIMITED, 1.0),
        robots=len(row["robots"]),
        time_gap_s=row["time_gap_s"],
        start_spacing_mm=row["start_spacing_mm"],
        start_ramp_s=row["start_ramp_s"],
    )
    return bool(lines)


def _beyond(trajectory: Trajectory, robot: RobotParameters, **row: Any) -> list[str]:
    """The limits that a motion exceeds; a rest is none."""
    lines = warnings_for(trajectory, robot, HORIZON_S, **row)
    return [line for line in lines if REST not in line]


def _loaded(trajectory: dict[str, Any]) -> Trajectory:
    return TRAJECTORY.validate_python(trajectory)


def _patches(draws: Draws, severity: float, channels: Channels, task: Task) -> list[dict[str, Any]]:
    """Patches on the leader's path that leave enough grip for the motion there."""
    t_s = np.arange(0.0, HORIZON_S, 0.1)
    reference = reference_from(_loaded(task.trajectory), t_s, task.row["start_ramp_s"])
    grip = min(grip_acceleration(robot)[1] for robot in _distinct(task.row["robots"]))
    along = np.gradient(reference[:, 3], t_s)
    needed = np.hypot(reference[:, 3] * reference[:, 4], along)
    if not math.isfinite(float(needed.max())):
        raise ValueError("the reference of a case has no finite acceleration")
    return with_patches(
        draws, severity, reference[:, :2], needed / (PATCH_GRIP * grip * _grip_of(channels))
    )
