"""Metrics of a run; definitions with formulas in ``docs/metrics.md``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tlf_env.task.info import TouchedBy
from tlf_env.task.scenario import Scenario

ERROR_CAP_MM = 500.0
FORMATION_SETTLE_S = 5.0
LOST_RMS_MM = 100.0
LOST_TAIL_FRACTION = 0.3
START_S = 10.0  # so long a robot that sets out may be far from its reference
SCORE_UNIT_MM = 10.0
NEAR_MM = 10.0
SETTLED_MM = 20.0  # settling time: the position error stays below this


class RobotMetrics(NamedTuple):
    """Metrics of one robot; None if a value is undefined."""

    position_rmse_mm: float | None  # to the robot's reference, from settle_s on
    position_max_mm: float | None
    cross_track_rmse_mm: float | None  # of the error across the reference's heading
    along_track_rmse_mm: float | None
    formation_rmse_mm: float | None  # to ref(t − i·gap), from t ≥ i·gap + 5 s on
    settled_formation_rmse_mm: float | None  # from settle_s on
    error_capped_mean_mm: float  # mean of min(position error, 500) over the whole run
    heading_rmse_rad: float | None
    time_gap_rmse_s: float | None  # followers only
    settling_time_s: float | None  # after it the position error stays below 20 mm
    time_to_10_mm_s: float | None  # the same for 10 mm
    J_mm_s: float  # eq. (54) at the end
    J_theta_rad_s: float
    torque_rms_Nmm: float
    energy_J: float
    saturation_fraction: float  # of all substeps
    slip_max_mm_s: float
    slip_distance_mm: float
    nearest_mm: float | None  # smallest distance to another robot's axle midpoint
    score: float  # 0 to 100
    lost: bool
    touched: bool
    touched_by: str | None  # what it touched first: robot, wall or obstacle


def touched_name(thing: int) -> str | None:
    """Name of what a robot touched, a :class:`~tlf_env.TouchedBy`; None for nothing."""
    return TouchedBy(thing).name.lower() if thing else None


def rms(values: np.ndarray) -> float | None:
    """Root mean square; None for an empty array."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else None


def robot_metrics(
    scenario: Scenario,
    t_s: np.ndarray,
    columns: Mapping[str, np.ndarray],
    lost_at_s: np.ndarray,
    touched_at_s: np.ndarray,
    touched_by: np.ndarray | None = None,
) -> list[RobotMetrics]:
    """Metrics of every robot from a run's columns, each ``(time, robot)``.

    ``lost_at_s`` and ``touched_at_s`` ``(robot,)`` are the times at which a robot's error first exceeded
    ``lost_beyond_mm`` and at which it first touched another robot, a wall or an obstacle, infinity if never;
    ``touched_by`` is what it touched, a :class:`~tlf_env.TouchedBy`. A robot also counts as lost if its RMS
    error over the last 30 % of the run is above 100 mm, without the first 10 s after it sets out.
    """
    settled = t_s >= scenario.settle_s
    nearest = nearest_mm(columns)
    out = []
    for i in range(len(lost_at_s)):
        error = columns["position_error_mm"][:, i]
        along, across = track_errors(columns, i)
        in_formation = t_s >= i * scenario.time_gap_s + FORMATION_SETTLE_S
        formation = columns["formation_error_mm"][:, i]
        gapped = settled & (t_s >= scenario.time_gap_s)
        tail_s = max(
            (1 - LOST_TAIL_FRACTION) * scenario.horizon_s, i * scenario.time_gap_s + START_S
        )
        tail_rms = rms(error[t_s >= tail_s])
        end_s = min(float(lost_at_s[i]), float(touched_at_s[i]))
        out.append(
            RobotMetrics(
                position_rmse_mm=rms(error[settled]),
                position_max_mm=float(error[settled].max()) if settled.any() else None,
                cross_track_rmse_mm=rms(across[settled]),
                along_track_rmse_mm=rms(along[settled]),
                formation_rmse_mm=rms(formation[in_formation]),
                settled_formation_rmse_mm=rms(formation[settled & in_formation]),
                error_capped_mean_mm=float(np.minimum(error, ERROR_CAP_MM).mean()),
                heading_rmse_rad=rms(columns["heading_error_rad"][settled, i]),
                time_gap_rmse_s=rms(columns["time_gap_error_s"][gapped, i]) if i > 0 else None,
                settling_time_s=settling_time_s(t_s, error),
                time_to_10_mm_s=settling_time_s(t_s, error, NEAR_MM),
                J_mm_s=float(columns["J_mm_s"][-1, i]),
                J_theta_rad_s=float(columns["J_theta_rad_s"][-1, i]),
                torque_rms_Nmm=rms(columns["torque_rms_Nmm"][1:, i]) or 0.0,
                energy_J=float(columns["energy_mJ"][:, i].sum()) / 1000,
                saturation_fraction=float(columns["saturation_fraction"][1:, i].mean()),
                slip_max_mm_s=float(columns["slip_mm_s"][:, i].max()),
                slip_distance_mm=float(columns["slid_mm"][:, i].sum()),
                nearest_mm=nearest[i],
                score=score(t_s, formation, end_s),
                lost=bool(np.isfinite(lost_at_s[i]))
                or (tail_rms is not None and tail_rms > LOST_RMS_MM),
                touched=bool(np.isfinite(touched_at_s[i])),
                touched_by=None if touched_by is None else touched_name(int(touched_by[i])),
            )
        )
    return out


def track_errors(columns: Mapping[str, np.ndarray], robot: int) -> tuple[np.ndarray, np.ndarray]:
    """Error of a robot along and across its reference's heading, robot − reference, mm."""
    d_x = columns["x_mm"][:, robot] - columns["reference_x_mm"][:, robot]
    d_y = columns["y_mm"][:, robot] - columns["reference_y_mm"][:, robot]
    theta = columns["reference_theta_rad"][:, robot]
    sin, cos = np.sin(theta), np.cos(theta)
    return -sin * d_x + cos * d_y, cos * d_x + sin * d_y


def settling_time_s(
    t_s: np.ndarray, error: np.ndarray, within_mm: float = SETTLED_MM
) -> float | None:
    """The time after which the error stays below ``within_mm``; None if it does not."""
    outside = np.flatnonzero(error >= within_mm)
    if not outside.size:
        return float(t_s[0])
    return float(t_s[outside[-1] + 1]) if outside[-1] + 1 < len(t_s) else None


def score(t_s: np.ndarray, formation_error_mm: np.ndarray, end_s: float) -> float:
    """100 × mean over time of 1/(1 + formation error/10 mm), 0 from when the robot is lost or touches."""
    points = 1 / (1 + formation_error_mm / SCORE_UNIT_MM)
    return float(100 * np.where(t_s < end_s, points, 0.0).mean())


def nearest_mm(columns: Mapping[str, np.ndarray]) -> list[float | None]:
    """Smallest distance of each robot to another, between axle midpoints; None for a single robot."""
    x, y = columns["x_mm"], columns["y_mm"]
    robots = x.shape[1]
    if robots == 1:
        return [None]
    smallest = np.full(robots, np.inf)
    for i in range(robots):
        for j in range(i):
            least = float(np.hypot(x[:, i] - x[:, j], y[:, i] - y[:, j]).min())
            smallest[i], smallest[j] = min(smallest[i], least), min(smallest[j], least)
    return smallest.tolist()


class StringMetrics(NamedTuple):
    """Amplification of errors along the string, for the worst pair of neighbours; None if undefined.

    A gain of at most 1 means that no follower amplifies its predecessor's error.
    """

    time_gain: (
        float | None
    )  # largest ratio of RMS deviations across the path, follower to predecessor
    frequency_gain: float | None  # largest gain of the error's spectrum between neighbours
    frequency_Hz: float | None  # frequency of that gain


MIN_COHERENCE = 0.5
MAX_FREQUENCY_HZ = 1.0  # above it the errors are sensor noise
SEGMENT_S = 20.0


def string_metrics(
    scenario: Scenario, columns: Mapping[str, np.ndarray], leader: np.ndarray
) -> StringMetrics:
    """String stability: lateral deviations from the leader's reference path, compared between neighbours.

    ``leader`` ``(time, 2)`` is the leader's reference, mm. Robot i's deviation at t refers to
    ref(t − i·gap), and is compared with its predecessor's at t − gap, at the same point of the path. The
    frequency gain is |S_xy|/S_xx (Welch, 20 s segments) at frequencies up to 1 Hz with a coherence of at
    least 0.5. From ``settle_s`` on.
    """
    from scipy.signal import csd, welch

    first = round(scenario.settle_s / scenario.control_period_s)
    steps, robots = columns["x_mm"].shape
    across = [deviation_mm(columns, leader, i, i * scenario.gap_steps) for i in range(robots)]
    gains: list[float] = []
    peaks: list[tuple[float, float]] = []
    for i in range(1, robots):
        start = max(first - (i - 1) * scenario.gap_steps, 0)
        mine = across[i][start : steps - i * scenario.gap_steps]
        theirs = across[i - 1][start : start + len(mine)]
        ahead, behind = rms(theirs), rms(mine)
        if not ahead or behind is None:
            continue
        gains.append(behind / ahead)
        options = {
            "fs": 1 / scenario.control_period_s,
            "nperseg": min(len(mine), round(SEGMENT_S / scenario.control_period_s)),
        }
        frequency, cross = csd(theirs, mine, **options)
        power, own_power = welch(theirs, **options)[1], welch(mine, **options)[1]
        moving = (power > 0) & (own_power > 0)
        # |S_xy|²/(S_xx S_yy); 0 where one of them does not move
        coherence = np.divide(np.abs(cross) ** 2, power, out=np.zeros_like(power), where=moving)
        np.divide(coherence, own_power, out=coherence, where=moving)
        usable = moving & (coherence >= MIN_COHERENCE)
        usable &= (frequency > 0) & (frequency <= MAX_FREQUENCY_HZ)
        if usable.any():
            gain = np.abs(cross[usable]) / power[usable]
            peak = int(np.argmax(gain))
            peaks.append((float(gain[peak]), float(frequency[usable][peak])))
    top = max(peaks, default=(None, None))
    return StringMetrics(max(gains, default=None), top[0], top[1])


def deviation_mm(
    columns: Mapping[str, np.ndarray], leader: np.ndarray, robot: int, lag: int
) -> np.ndarray:
    """Signed lateral distance of a robot from the leader's path ``lag`` steps earlier, ``(time − lag,)``."""
    x, y = columns["x_mm"][lag:, robot], columns["y_mm"][lag:, robot]
    path = leader[: len(x)]
    if len(path) < 2:
        return np.zeros(len(path))
    tangent = np.gradient(path, axis=0)
    length = np.hypot(tangent[:, 0], tangent[:, 1])
    moved = tangent[:, 0] * (y - path[:, 1]) - tangent[:, 1] * (x - path[:, 0])
    return np.divide(moved, length, out=np.zeros_like(moved), where=length > 0)
