"""Rows of robots that meet at a crossing, with the supervisor and without it.

Writes the tables of ``docs/controller/supervisor.md``. ``python docs/figures/make_supervisor.py`` drives 16
seeds of each row for 60 s on the batch plant, on all cores; it needs no extra. ``--seeds N`` drives others,
``--only NAME`` makes one table.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from make_board import DOCS
from make_parts import put

from baselines.policies.registry import fit_policy
from baselines.runs.run import Record, run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.task.scenario import load_scenario

HORIZON_S = 60.0
SYSTEM = "feedback_linearisation:bounded+ekf-slip"
LIMITERS = ("body", "supervised")
COURSES = ("infinity", "flower")
ROWS = (3, 5, 6, 7, 8)
CONDITIONS: dict[str, Any] = {
    "nominal": "nominal",
    "start": "start",
    "ice": "ice",
    "dropout": {"radio": {"dropout": 0.5}},
}
HEAD = ("RMS", "touch", "lost", "gap")


class Cell(NamedTuple):
    """Results of the runs of one system."""

    rms_mm: float  # of the worst robot, median over the runs
    touched: int  # runs in which robots touch
    lost: int  # runs in which a robot is lost
    gap_mm: float  # smallest gap of two outlines in all runs; negative: they overlap
    motions: list[bytes]


def least_gap_mm(record: Record) -> float:
    """Smallest gap of two outlines in a run; negative if they overlap."""
    robots = record.scenario.robot_models
    theta = record["theta_rad"]
    behind = np.array([one.outline_offset_mm for one in robots])
    x = record["x_mm"] + behind * np.sin(theta)
    y = record["y_mm"] - behind * np.cos(theta)
    gaps = [
        np.hypot(x[:, i] - x[:, j], y[:, i] - y[:, j]).min()
        - robots[i].outline_radius_mm
        - robots[j].outline_radius_mm
        for i in range(len(robots))
        for j in range(i)
    ]
    return float(min(gaps))


def cell(limiter: str, course: str, robots: int, disturbance: Any, seeds: range) -> Cell:
    """Drive the seeds of one system. Robots that touch drive on, through each other."""
    scenario = load_scenario(
        course,
        robots=robots,
        horizon_s=HORIZON_S,
        plant="batch",
        disturbance=disturbance,
        end_on=(),
    )
    name = f"{SYSTEM}+{limiter}"
    fitted = fit_policy(name, scenario)
    runs = list(run_seeds(fitted.scenario, fitted.policy, seeds, name=name))
    errors = [max(robot.position_rmse_mm or 0.0 for robot in run.metrics()) for run in runs]
    return Cell(
        rms_mm=float(np.median(errors)),
        touched=sum(run.contact for run in runs),
        lost=sum(bool(np.isfinite(run.lost_at_s).any()) for run in runs),
        gap_mm=min(map(least_gap_mm, runs)),
        motions=[run["x_mm"].tobytes() + run["y_mm"].tobytes() for run in runs],
    )


def text(found: Cell) -> str:
    """The columns of one system."""
    rms_mm = f"{float(f'{found.rms_mm:.3g}'):g}"
    return f"{rms_mm} | {found.touched or ''} | {found.lost or ''} | {found.gap_mm:.0f}"


def table(condition: str, seeds: range) -> str:
    """A row for each course and number of robots, and the number of runs that are the same with both."""
    columns = [f"`{limiter}`: {one}" for limiter in LIMITERS for one in HEAD]
    lines = [
        "| course | robots | " + " | ".join([*columns, "same"]) + " |",
        "|---|---:" + "|---:" * (len(columns) + 1) + "|",
    ]
    with ProcessPoolExecutor() as pool:
        found = {
            (course, robots): [
                pool.submit(cell, limiter, course, robots, CONDITIONS[condition], seeds)
                for limiter in LIMITERS
            ]
            for course in COURSES
            for robots in ROWS
        }
        for (course, robots), pair in found.items():
            without, with_it = (each.result() for each in pair)
            same = sum(a == b for a, b in zip(without.motions, with_it.motions, strict=True))
            lines.append(f"| {course} | {robots} | {text(without)} | {text(with_it)} | {same} |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    """Drive and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--only", choices=tuple(CONDITIONS))
    options = parser.parse_args()
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    page = DOCS / "controller" / "supervisor.md"
    for condition in (options.only,) if options.only else CONDITIONS:
        print(condition, flush=True)
        put(page, table(condition, seeds), condition)


if __name__ == "__main__":
    main()
