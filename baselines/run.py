"""One run of a policy on a scenario: recorded, measured, and written to a folder."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tlf_env.envs.parallel import FormationParallelEnv, parallel_env
from tlf_env.numerics.files import atomic
from tlf_env.physics.state import Motion
from tlf_env.task.arrays import Info
from tlf_env.task.metrics import RobotMetrics, robot_metrics
from tlf_env.task.scenario import Scenario

REPORTED_PACKAGES = ("tlf-env", "numpy", "numba", "gymnasium", "pettingzoo", "pymunk")


class Policy(Protocol):
    """Whatever acts: the signature of SB3's ``predict``."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions for a batch of observations, and the next state."""


# Columns of a record, in the order of trajectory.csv; each is (time, robot).
RECORDED = (
    "x_mm",
    "y_mm",
    "theta_rad",
    "castor_rad",
    "reference_x_mm",
    "reference_y_mm",
    "reference_theta_rad",
    "position_error_mm",
    "formation_error_mm",
    "heading_error_rad",
    "time_gap_error_s",
    "J_mm_s",
    "J_theta_rad_s",
    "omega_l_rad_s",
    "omega_r_rad_s",
    "omega_l_command_rad_s",
    "omega_r_command_rad_s",
    "torque_l_Nmm",
    "torque_r_Nmm",
    "saturation_fraction",
    "slip_mm_s",
    "innovation_nis",
)
FROM_INFO = (
    "x_mm",
    "y_mm",
    "theta_rad",
    "reference_x_mm",
    "reference_y_mm",
    "reference_theta_rad",
    "position_error_mm",
    "formation_error_mm",
    "heading_error_rad",
    "time_gap_error_s",
    "torque_l_Nmm",
    "torque_r_Nmm",
    "saturation_fraction",
    "slip_mm_s",
    "innovation_nis",
)


@dataclass(frozen=True)
class Record:
    """A finished run, one row per control step (the start included).

    Torques are means over the control step that ends at the row's time, ``slip_mm_s`` is its maximum.
    """

    scenario: Scenario
    seed: int
    policy: str
    t_s: np.ndarray  # (time,)
    columns: dict[str, np.ndarray]  # each (time, robot)
    leader: np.ndarray  # (time, 2): the leader's reference path, mm
    lost: np.ndarray  # (robot,) bool, at any time
    touched: np.ndarray  # (robot,) bool, at any time

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    @property
    def robots(self) -> int:
        """How many robots."""
        return len(self.lost)

    def metrics(self) -> list[RobotMetrics]:
        """The summary of every robot."""
        return robot_metrics(self.scenario, self.t_s, self.columns, self.lost, self.touched)


def run_policy(
    scenario: Scenario,
    policy: Policy,
    seed: int = 0,
    *,
    name: str = "policy",
    progress: Callable[[int, int], None] | None = None,
) -> Record:
    """Drive a policy over the whole horizon, ends or not (``end_on=()``), and record everything.

    Parameters
    ----------
    progress
        Called with the steps done and the steps in all.
    """
    env = parallel_env(scenario.model_copy(update={"end_on": ()}))
    observations, _ = env.reset(seed=seed)
    n, steps = scenario.robot_count, scenario.horizon_steps
    rows = {name: np.zeros((steps + 1, n)) for name in RECORDED}
    _note(env, rows, 0)
    state: Any = None
    start = np.ones(n, dtype=np.bool_)
    for k in range(1, steps + 1):
        batch = np.stack([observations[agent] for agent in env.agents])
        actions, state = policy.predict(batch, state, start, True)
        start = np.zeros(n, dtype=np.bool_)
        observations, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        _note(env, rows, k)
        if progress is not None:
            progress(k, steps)
    a = env.formation.arrays
    period_s = scenario.control_period_s
    return Record(
        scenario=scenario,
        seed=seed,
        policy=name,
        t_s=np.arange(steps + 1) * period_s,
        columns=_with_functionals(rows, period_s),
        leader=a.table[: steps + 1, :2].copy(),
        lost=a.lost[0].copy(),
        touched=a.touched[0].copy(),
    )


def _note(env: FormationParallelEnv, rows: dict[str, np.ndarray], k: int) -> None:
    a = env.formation.arrays
    infos = a.infos[0]
    for column in FROM_INFO:
        rows[column][k] = infos[:, Info._fields.index(column)]
    motion = Motion(*a.motions[:, :, 0])
    rows["castor_rad"][k] = motion.psi - motion.theta
    rows["omega_l_rad_s"][k] = motion.omega_l
    rows["omega_r_rad_s"][k] = motion.omega_r
    rows["omega_l_command_rad_s"][k] = a.wanted[0, :, 0]
    rows["omega_r_command_rad_s"][k] = a.wanted[1, :, 0]


def _with_functionals(rows: dict[str, np.ndarray], period_s: float) -> dict[str, np.ndarray]:
    """Add J and J_θ of eq. (54): running integrals of the signed errors, robot − reference."""
    error = rows["x_mm"] - rows["reference_x_mm"] + rows["y_mm"] - rows["reference_y_mm"]
    rows["J_mm_s"] = np.cumsum(error, axis=0) * period_s
    rows["J_theta_rad_s"] = np.cumsum(-rows["heading_error_rad"], axis=0) * period_s
    return rows


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    found = {"python": platform.python_version()}
    for package in REPORTED_PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def summary(record: Record) -> dict[str, Any]:
    """What ``summary.json`` holds."""
    return {
        "scenario": record.scenario.model_dump(mode="json"),
        "seed": record.seed,
        "policy": record.policy,
        "settle_s": record.scenario.settle_s,
        "versions": versions(),
        "robots": {f"robot_{i}": metrics._asdict() for i, metrics in enumerate(record.metrics())},
    }


def write_record(record: Record, folder: Path) -> None:
    """Write ``summary.json``, ``trajectory.npz`` and ``trajectory.csv``, each atomically."""
    with atomic(folder / "summary.json", encoding="utf-8") as file:
        json.dump(summary(record), file, indent=2, allow_nan=False)
        file.write("\n")
    with atomic(folder / "trajectory.npz", "wb") as file:
        columns: dict[str, Any] = dict(record.columns)
        np.savez_compressed(file, t_s=record.t_s, leader_reference_mm=record.leader, **columns)
    with atomic(folder / "trajectory.csv", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t_s", "robot", *RECORDED])
        table = np.stack([record[name] for name in RECORDED], axis=-1)
        for t_s, rows in zip(record.t_s, table, strict=True):
            for i, row in enumerate(rows):
                writer.writerow([f"{t_s:.6g}", i, *(f"{value:.9g}" for value in row)])
