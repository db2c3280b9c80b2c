"""What a run is summed up by; formulas in ``docs/metrics.md``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tlf_env.task.scenario import Scenario

ERROR_CAP_MM = 500.0
FORMATION_SETTLE_S = 5.0
LOST_RMS_MM = 100.0
LOST_TAIL_FRACTION = 0.3


class RobotMetrics(NamedTuple):
    """One robot's summary; None where a value is undefined."""

    position_rmse_mm: float | None  # to the robot's own reference, from settle_s on
    position_max_mm: float | None
    formation_rmse_mm: float | None  # to ref(t − i·gap), from t ≥ i·gap + 5 s on
    error_capped_mean_mm: float  # mean over the whole run of min(position error, 500)
    heading_rmse_rad: float | None
    time_gap_rmse_s: float | None  # followers only
    J_mm_s: float  # eq. (54) at the end
    J_theta_rad_s: float
    saturation_fraction: float  # of all substeps
    slip_max_mm_s: float
    lost: bool
    touched: bool


def rms(values: np.ndarray) -> float | None:
    """Root mean square, None of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else None


def robot_metrics(
    scenario: Scenario,
    t_s: np.ndarray,
    columns: Mapping[str, np.ndarray],
    lost: np.ndarray,
    touched: np.ndarray,
) -> list[RobotMetrics]:
    """Metrics of every robot from a run's columns, each ``(time, robot)``.

    A robot is lost if its error passed ``lost_beyond_mm`` at any time, or if its RMS over the last
    30 % is above 100 mm.
    """
    settled = t_s >= scenario.settle_s
    tail = t_s >= (1 - LOST_TAIL_FRACTION) * scenario.horizon_s
    after_start = t_s > 0
    out = []
    for i in range(len(lost)):
        error = columns["position_error_mm"][:, i]
        in_formation = t_s >= i * scenario.time_gap_s + FORMATION_SETTLE_S
        tail_rms = rms(error[tail])
        gap = rms(columns["time_gap_error_s"][settled & (t_s >= scenario.time_gap_s), i])
        out.append(
            RobotMetrics(
                position_rmse_mm=rms(error[settled]),
                position_max_mm=float(error[settled].max()) if settled.any() else None,
                formation_rmse_mm=rms(columns["formation_error_mm"][in_formation, i]),
                error_capped_mean_mm=float(np.minimum(error, ERROR_CAP_MM).mean()),
                heading_rmse_rad=rms(columns["heading_error_rad"][settled, i]),
                time_gap_rmse_s=gap if i > 0 else None,
                J_mm_s=float(columns["J_mm_s"][-1, i]),
                J_theta_rad_s=float(columns["J_theta_rad_s"][-1, i]),
                saturation_fraction=float(columns["saturation_fraction"][after_start, i].mean()),
                slip_max_mm_s=float(columns["slip_mm_s"][:, i].max()),
                lost=bool(lost[i]) or (tail_rms is not None and tail_rms > LOST_RMS_MM),
                touched=bool(touched[i]),
            )
        )
    return out
