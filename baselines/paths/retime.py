"""A log as a path that a robot can follow: smoothed positions, and times within the robot's limits."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.paths.read import Log

SPACING_S = 0.1  # between the points that are written
GRID_MM = 5.0  # along the path, for its times
MOST_POINTS = 2_000_000  # of a path: 55 h, or 10 km
LATERAL_MM_S2 = 150.0  # of the limiter `grip`: what tyres on a slippery floor transmit
ACCELERATION_MM_S2 = 100.0
TURN_RAD_S = 1.0
SLOWEST_MM_S = 5.0
STANDS_MM = 1.0  # a shorter step along the path is standing


class Deviation(NamedTuple):
    """Distance of a smoothed path from its log, mm."""

    rms_mm: float
    largest_mm: float


def smoothed(log: Log, noise_mm: float) -> tuple[np.ndarray, np.ndarray, Deviation]:
    """Times (s) and positions (mm) of a smoothing spline through a log, and how far it is from the log.

    Parameters
    ----------
    noise_mm
        Standard deviation of the log's noise per coordinate, mm: the spline is as smooth as it can be with an
        error of this size.

    Raises
    ------
    ValueError
        for a log that is too long in time.
    """
    from scipy.interpolate import UnivariateSpline

    allowed = len(log.t_s) * noise_mm**2
    order = min(5, len(log.t_s) - 1)
    splines = [UnivariateSpline(log.t_s, values, k=order, s=allowed) for values in log.xy_mm.T]
    times = evenly(log.t_s[-1])
    points = np.stack([spline(times) for spline in splines], axis=1)
    there = np.stack([spline(log.t_s) for spline in splines], axis=1)
    apart = np.hypot(*(there - log.xy_mm).T)
    deviation = Deviation(float(np.sqrt(np.mean(apart**2))), float(apart.max()))
    return times, points, deviation


def evenly(end_s: float) -> np.ndarray:
    """Times from 0 to the end, about :data:`SPACING_S` apart.

    Raises
    ------
    ValueError
        for more than :data:`MOST_POINTS` of them.
    """
    if not end_s <= MOST_POINTS * SPACING_S:
        raise ValueError(
            f"the path takes {end_s:g} s; at most {MOST_POINTS * SPACING_S:g} s can be smoothed or timed anew"
        )
    return np.linspace(0.0, end_s, max(round(end_s / SPACING_S), 1) + 1)


def retimed(points: np.ndarray, speed_mm_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The same path from rest to rest, with a speed limit and within the limits of tyres and motors.

    The largest speed at each place follows from the limit, the yaw rate and the lateral acceleration; a pass
    forward and one backward bound the accelerations (Bobrow, Dubowsky and Gibson 1985).

    Parameters
    ----------
    points
        (point, 2), mm: the path, in its order.
    speed_mm_s
        The largest speed.

    Returns
    -------
    tuple
        Times (s) and positions (mm), about :data:`SPACING_S` apart.

    Raises
    ------
    ValueError
        for a path without length, and one that is too long, in space or in time.
    """
    from scipy.interpolate import CubicSpline

    steps = np.hypot(*np.diff(points, axis=0).T)
    kept = np.concatenate([[True], steps > STANDS_MM])
    points = points[kept]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    if len(points) < 3:
        raise ValueError(
            "the path has no length; a speed limit needs at least three different points"
        )
    if not along[-1] <= MOST_POINTS * GRID_MM:
        raise ValueError(
            f"the path is {along[-1]:g} mm long; at most {MOST_POINTS * GRID_MM:g} mm can be timed anew"
        )
    curve = CubicSpline(along, points)
    s = np.linspace(0.0, along[-1], max(math.ceil(along[-1] / GRID_MM), 2) + 1)
    first, second = curve(s, 1), curve(s, 2)
    norm = np.maximum(np.hypot(*first.T), 1e-9)
    curvature = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / norm**3
    with np.errstate(divide="ignore"):
        speed = np.minimum(speed_mm_s, np.sqrt(LATERAL_MM_S2 / curvature))
        speed = np.minimum(speed, TURN_RAD_S / curvature)
    speed = np.maximum(speed, SLOWEST_MM_S)
    speed[0] = speed[-1] = 0.0
    step = s[1] - s[0]
    gain = 2.0 * ACCELERATION_MM_S2 * step
    for k in range(1, len(s)):
        speed[k] = min(speed[k], math.sqrt(speed[k - 1] ** 2 + gain))
    for k in range(len(s) - 2, -1, -1):
        speed[k] = min(speed[k], math.sqrt(speed[k + 1] ** 2 + gain))
    times = np.concatenate([[0.0], np.cumsum(2.0 * step / (speed[1:] + speed[:-1]))])
    wanted = evenly(times[-1])
    before = np.minimum(np.searchsorted(times, wanted, side="right") - 1, len(s) - 2)
    since = wanted - times[before]
    gained = (speed[before + 1] ** 2 - speed[before] ** 2) / (2.0 * step)  # acceleration
    reached = s[before] + since * (speed[before] + 0.5 * gained * since)
    return wanted, curve(np.minimum(reached, s[-1]))
