"""Runs of the paper's two simulations, for Fig. 11: three plants, both readings of k₂."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from baselines.policies.registry import fit_policy
from baselines.runs.run import Record, run_policy
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.scenario import Scenario, load_scenario

TASKS = {"infinity": "∞", "flower": "flower"}
PLANTS = ("kinematic", "bending off", "complete")
GAINS = ("printed", "consistent")
PERIODS_S = (0.001, 0.02)  # of the tracking law and the observer; that of the figures is the first
SETTLED_FROM, TAIL_FROM = 0.4, 0.7  # shares of a run
LOST_MM, LOST_RMS_MM = 1200.0, 100.0
SOON_S = 20.0
KEPT_EVERY_S = 0.1


class Key(NamedTuple):
    """Which run."""

    task: str
    plant: str
    gains: str
    period_s: float


class Outcome(NamedTuple):
    """A run, thinned to rows every 0.1 s; arrays are (time, robot) unless they are (robot,)."""

    t_s: np.ndarray  # (time,)
    x_mm: np.ndarray
    y_mm: np.ndarray
    leader_mm: np.ndarray  # (time, 2): the path of eq. (52) or (53)
    J_mm_s: np.ndarray  # eq. (54)
    J_theta_rad_s: np.ndarray
    absolute_J_mm_s: np.ndarray  # with the magnitudes of both errors
    absolute_J_theta_rad_s: np.ndarray
    rms_mm: np.ndarray  # (robot,): of the position error, from 40 % of the run on
    lost: np.ndarray  # (robot,): beyond 1200 mm at any time, or above 100 mm RMS in the last 30 %
    early_rms_mm: np.ndarray  # (robot,): before 20 s
    late_rms_mm: np.ndarray  # (robot,): from 20 s on
    gap_rms_s: np.ndarray  # (robot,): of the time-gap error, from 40 % on; 0 for the leader
    heading_rms_rad: np.ndarray  # (robot,): of the estimated heading's error, from 40 % on
    distance_mm: tuple[float, float]  # smallest and largest between neighbours, from 40 % on
    early_distance_mm: float  # smallest between any two robots before 20 s
    J_range_mm_s: np.ndarray  # (robot,): largest less smallest J from 20 s on
    J_theta_range_rad_s: np.ndarray

    @property
    def worst_mm(self) -> float:
        """RMS position error of the worst robot; infinite if any is lost."""
        return math.inf if self.lost.any() else float(self.rms_mm.max())


def every_key() -> list[Key]:
    """Every run: all at 1 ms, and the complete plant at 20 ms, too."""
    return [
        Key(task, plant, gains, period_s)
        for task in TASKS
        for period_s in PERIODS_S
        for plant in PLANTS
        for gains in GAINS
        if period_s == PERIODS_S[0] or plant == "complete"
    ]


def scenario_of(key: Key) -> Scenario:
    """The scenario of a run, without contact between robots."""
    fields: dict[str, Any] = {"plant": "kinematic" if key.plant == "kinematic" else "batch"}
    if key.plant == "bending off":
        robot = RobotParameters()
        joint = robot.steering_joint.model_copy(update={"bending": False})
        fields["robot"] = robot.model_copy(update={"steering_joint": joint})
    return load_scenario(key.task, control_period_s=key.period_s, **fields)


def run(key: Key, progress: Callable[[int, int], None] | None = None) -> Outcome:
    """Drive a run to its horizon, seed 0, with the paper's filter."""
    fitted = fit_policy(f"reference:{key.gains}", scenario_of(key))
    return outcome(run_policy(fitted.scenario, fitted.policy, 0, progress=progress))


def outcome(record: Record) -> Outcome:
    """What the figures and claims need of a run."""
    t_s, period_s = record.t_s, record.scenario.control_period_s
    rows = len(t_s)
    settled, tail = slice(int(SETTLED_FROM * rows), None), slice(int(TAIL_FROM * rows), None)
    soon = int(np.searchsorted(t_s, SOON_S))
    error_mm = record["position_error_mm"]

    def rms(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(np.mean(values**2, axis=0)))

    off_x = np.abs(record["x_mm"] - record["reference_x_mm"])
    off_y = np.abs(record["y_mm"] - record["reference_y_mm"])
    x_mm, y_mm = record["x_mm"], record["y_mm"]
    between = np.hypot(x_mm[:, :, None] - x_mm[:, None, :], y_mm[:, :, None] - y_mm[:, None, :])
    neighbours = np.hypot(np.diff(x_mm, axis=1), np.diff(y_mm, axis=1))[settled]
    pairs = np.triu_indices(record.robots, 1)
    heading = record["estimated_theta_rad"] - record["theta_rad"]
    kept = slice(None, None, round(KEPT_EVERY_S / period_s))
    return Outcome(
        t_s=t_s[kept],
        x_mm=x_mm[kept],
        y_mm=y_mm[kept],
        leader_mm=record.leader[kept],
        J_mm_s=record["J_mm_s"][kept],
        J_theta_rad_s=record["J_theta_rad_s"][kept],
        absolute_J_mm_s=(np.cumsum(off_x + off_y, axis=0) * period_s)[kept],
        absolute_J_theta_rad_s=(np.cumsum(np.abs(record["heading_error_rad"]), axis=0) * period_s)[
            kept
        ],
        rms_mm=rms(error_mm[settled]),
        lost=(error_mm.max(axis=0) > LOST_MM) | (rms(error_mm[tail]) > LOST_RMS_MM),
        early_rms_mm=rms(error_mm[:soon]),
        late_rms_mm=rms(error_mm[soon:]),
        gap_rms_s=rms(record["time_gap_error_s"][settled]),
        heading_rms_rad=rms(heading[settled]),
        distance_mm=(float(neighbours.min()), float(neighbours.max())),
        early_distance_mm=float(between[:soon, *pairs].min()),
        J_range_mm_s=np.ptp(record["J_mm_s"][soon:], axis=0),
        J_theta_range_rad_s=np.ptp(record["J_theta_rad_s"][soon:], axis=0),
    )
