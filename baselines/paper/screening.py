"""What the paper does not print: plausible ranges, a screening by elementary effects, and a map.

M. D. Morris, "Factorial sampling plans for preliminary computational experiments", Technometrics 33(2), 1991;
μ* is that of F. Campolongo, J. Cariboni, A. Saltelli, Environmental Modelling & Software 22, 2007.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from SALib.analyze import morris as analysis
from SALib.sample import morris as sampling

from baselines.paper.lanes import Ends, drive
from baselines.policies.registry import fit_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.scenario import load_scenario
from tlf_env.task.trajectories import sample

TASK, HORIZON_S = "infinity", 100.0
PERIODS_S = (0.001, 0.002, 0.005, 0.01)  # levels of the control period
LEVELS, WALKS, SEED = 4, 14, 1
LEAST_MM, MOST_MM = 0.1, 1000.0  # errors are cut off here: a lost robot may be anywhere


class Factor(NamedTuple):
    """A quantity that the paper does not print."""

    name: str
    text: str
    low: float
    high: float
    unit: str


ROBOT = (
    Factor("body_inertia_kg_mm2", "yaw inertia", 2000.0, 9000.0, "kg·mm²"),
    Factor("castor_trail_mm", "castor's trail", 5.0, 30.0, "mm"),
    Factor("castor_pivot_mm", "castor's pivot behind the axle", 60.0, 110.0, "mm"),
    Factor("castor_radius_mm", "castor's radius", 10.0, 30.0, "mm"),
    Factor("castor_inertia_kg_mm2", "castor's inertia", 1.0, 10.0, "kg·mm²"),
    Factor("fork_inertia_kg_mm2", "fork's inertia", 5.0, 50.0, "kg·mm²"),
    Factor("dynamic_speed_mm_s", "tyres' v_d", 2.2, 6.0, "mm/s"),
)
OTHERS = (
    Factor("period", "control period", 0.0, 1.0, "1, 2, 5 or 10 ms"),
    Factor("spacing_mm", "distance at the start", 225.0, 525.0, "mm"),
    Factor("noise", "noise of the fixes", 0.0, 1.0, "4 seeds"),
)
STARTS = (
    Factor("behind_mm", "leader behind its reference", 0.0, 300.0, "mm"),
    Factor("aside_mm", "aside, alternately", -60.0, 60.0, "mm"),
    Factor("turned_rad", "turned, alternately", -0.3, 0.3, "rad"),
)
STUDIES = {"starts on the tangent": ROBOT + OTHERS, "any start": ROBOT + OTHERS + STARTS}
MAP_INERTIAS = tuple(np.arange(1500.0, 9001.0, 750.0).tolist())
MAP_TRAILS = (2.0, 4.0, 6.0, 8.0, 10.0, 12.5, 15.0, 17.5, 20.0, 25.0, 30.0)


class Screening(NamedTuple):
    """Elementary effects of the factors on log₁₀ of the worst robot's RMS error."""

    factors: tuple[Factor, ...]
    points: np.ndarray  # (run, factor)
    worst_mm: np.ndarray  # (run,), infinite if a robot is lost
    mu_star: np.ndarray  # (factor,): mean of their magnitudes, for a change over the whole range
    confidence: np.ndarray  # (factor,): half the 95 % interval of it
    sigma: np.ndarray  # (factor,): their standard deviation: interactions and bends

    def share_below(self, limit_mm: float) -> float:
        """Share of the runs with an error below a limit."""
        return float(np.mean(self.worst_mm < limit_mm))


def robot_with(values: Mapping[str, float]) -> RobotParameters:
    """Our robot with other values of what is not printed; the load shares, which are, stay."""
    robot = RobotParameters()
    fields = robot.model_dump()
    fields |= {key: value for key, value in values.items() if key in fields}
    behind = fields["castor_pivot_mm"] + fields["castor_trail_mm"]
    fields["com_offset_mm"] = robot.castor_load_share * behind
    if "dynamic_speed_mm_s" in values:
        fields["tyre"] = fields["tyre"] | {"dynamic_speed_mm_s": values["dynamic_speed_mm_s"]}
    return RobotParameters.model_validate(fields)


def start_poses(values: Mapping[str, float]) -> np.ndarray:
    """Start poses ``(robot, 3)`` behind the path's first point, in mm, mm, rad."""
    scenario = load_scenario(TASK)
    x, y, theta = sample(scenario.trajectory, np.zeros(1))[0, :3]
    rows = []
    for robot in range(scenario.robot_count):
        sign = 1.0 if robot % 2 == 0 else -1.0
        behind = values.get("behind_mm", 0.0) + robot * values.get(
            "spacing_mm", scenario.start_spacing_mm
        )
        aside = sign * values.get("aside_mm", 0.0)
        rows.append(
            (
                x + behind * np.sin(theta) + aside * np.cos(theta),
                y - behind * np.cos(theta) + aside * np.sin(theta),
                theta + sign * values.get("turned_rad", 0.0),
            )
        )
    return np.array(rows)


def level(value: float) -> int:
    """The level of a factor from 0 to 1."""
    return round(value * (LEVELS - 1))


def runs(
    gains: str, cases: Sequence[Mapping[str, float]], progress: Callable[[float], None]
) -> Ends:
    """A run of each case, side by side with those of the same control period."""
    periods = np.array([level(case.get("period", 0.0)) for case in cases])
    parts, places, done = [], [], 0
    for number, period_s in enumerate(PERIODS_S):
        where = np.flatnonzero(periods == number)
        if not len(where):
            continue
        some = [cases[place] for place in where.tolist()]
        base = load_scenario(TASK, control_period_s=period_s, plant="batch", horizon_s=HORIZON_S)
        fitted = fit_policy(f"reference:{gains}", base)
        scenarios = [
            fitted.scenario.model_copy(update={"robot": robot_with(case)}) for case in some
        ]
        seeds = [FIRST_TABLE_SEED + level(case.get("noise", 0.0)) for case in some]
        poses = np.array([start_poses(case) for case in some])
        share = len(where) / len(cases)
        parts.append(
            drive(
                scenarios, fitted.policy, seeds, poses, _within(progress, done / len(cases), share)
            )
        )
        places.append(where)
        done += len(where)
    order = np.argsort(np.concatenate(places))
    return Ends(*(np.concatenate(arrays)[order] for arrays in zip(*parts, strict=True)))


def _within(
    progress: Callable[[float], None], first: float, share: float
) -> Callable[[int, int], None]:
    """The progress of a part of some runs, as a share of all."""
    return lambda done, total: progress(first + share * done / total)


def screen(factors: tuple[Factor, ...], gains: str, progress: Callable[[float], None]) -> Screening:
    """Morris's screening: walks on a grid of four levels that change one factor at a time."""
    problem: dict[str, Any] = {
        "num_vars": len(factors),
        "names": [one.name for one in factors],
        "bounds": [[one.low, one.high] for one in factors],
    }
    points = sampling.sample(problem, WALKS, num_levels=LEVELS, seed=SEED)
    cases = [dict(zip(problem["names"], row.tolist(), strict=True)) for row in points]
    ends = runs(gains, cases, progress)
    error = np.where(ends.lost, MOST_MM, ends.rms_mm.max(axis=1))
    heights = np.log10(np.clip(error, LEAST_MM, MOST_MM))
    found = analysis.analyze(problem, points, heights, num_levels=LEVELS, seed=SEED)
    return Screening(
        factors=factors,
        points=points,
        worst_mm=ends.worst_mm,
        mu_star=np.asarray(found["mu_star"], dtype=np.float64),
        confidence=np.asarray(found["mu_star_conf"], dtype=np.float64),
        sigma=np.asarray(found["sigma"], dtype=np.float64),
    )


def mapped(gains: str, progress: Callable[[float], None]) -> np.ndarray:
    """RMS error of the worst robot over trail and yaw inertia at 1 ms, (trail, inertia); infinite if lost."""
    cases = [
        {"castor_trail_mm": trail, "body_inertia_kg_mm2": inertia}
        for trail in MAP_TRAILS
        for inertia in MAP_INERTIAS
    ]
    return runs(gains, cases, progress).worst_mm.reshape(len(MAP_TRAILS), len(MAP_INERTIAS))
