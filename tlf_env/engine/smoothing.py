"""Smoothed broadcasts: a robot's pose and twist a short time ago, from the position fixes before and after.

A follower uses what its predecessor broadcast one gap ago. Until then the predecessor may replace it. It
fits a parabola to the fixes around a moment, less its own dead reckoning (the *way*, which is smooth).
Position and velocity at the moment follow from it. The direction of the velocity is the heading, up to
skidding; while the robot is slow its noise is large, and the filter's heading counts more. Likewise the
filter's speed counts more where fixes are rare or noisy. The heading minus the way's is fitted by a line over
a second window of the same width, which gives the yaw rate.

A local polynomial fit over evenly spaced points is a Savitzky–Golay filter (A. Savitzky, M. Golay,
*Analytical Chemistry* 36, 1964, pages 1627 to 1639). Here the weights follow the number of fixes, since some
may be missing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.engine.arrays import (
    Arrays,
    read_ekf,
    read_estimate,
    read_gyro,
    read_gyro_ekf,
    read_sensors,
    read_slip,
    read_slip_ekf,
    read_trace,
    read_way,
    write_message,
    write_way,
)
from tlf_env.engine.effects import fix_timing
from tlf_env.engine.layout import Way
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.kinds import EKF, EKF_GYRO, EKF_SLIP
from tlf_env.onboard.observer import Message

LEAST_VARIANCE = 1e-12  # (mm/s)²
LEAST_SPREAD = 1e-6  # of the normal equations' determinant, relative to that of even fixes

with_place = replacing(Way, "p_x", "p_y", "v_x", "v_y", "heading", "fitted")


class FittedPlace(NamedTuple):
    """Position (mm) and velocity (mm/s) at a moment, and the velocity's variance; ``fitted`` is 1 or 0."""

    x: float
    y: float
    way_x: float  # velocity of the way
    way_y: float
    v_x: float
    v_y: float
    variance: float  # (mm/s)² of each component, per variance of a fix in mm²
    fitted: float


@law
def keep_way(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Put the way of a control step and the sums of its fixes into the ring."""
    slots = arrays.ways.shape[1]
    before = read_way(arrays.ways, (step - 1) % slots, robot, lane)
    trace, sensors = (
        read_trace(arrays.states, robot, lane),
        read_sensors(arrays.states, robot, lane),
    )
    turn = before.turn + trace.turned if step > 1 else trace.turned
    way = Way(
        x=sensors.way_x,
        y=sensors.way_y,
        turn=turn,
        theta=read_estimate(arrays.states, robot, lane).theta,
        off_x=trace.off_x,
        off_y=trace.off_y,
        fixes=trace.fixes,
        p_x=0.0,
        p_y=0.0,
        v_x=0.0,
        v_y=0.0,
        heading=0.0,
        fitted=0.0,
    )
    write_way(arrays.ways, step % slots, robot, lane, way)


@law
def place_at(
    arrays: Arrays, lane: int, robot: int, step: int, late: int, settings: Settings
) -> FittedPlace:
    """Position and velocity at the end of a control step, from fixes that come ``late`` substeps late."""
    slots, half = arrays.ways.shape[1], settings.half_window
    behind = (late + settings.substeps - 1) // settings.substeps
    # Fixes of a control step were measured on average so long before its end, s.
    early = 0.5 * (settings.period - settings.dt) + late * settings.dt
    width = (half + 1) * settings.period
    s_0 = s_1 = s_2 = s_3 = s_4 = 0.0
    x_0 = x_1 = x_2 = y_0 = y_1 = y_2 = 0.0
    for k in range(-half, half + 1):
        way = read_way(arrays.ways, (step + behind + k) % slots, robot, lane)
        t = ((behind + k) * settings.period - early) / width
        t_2 = t * t
        s_0 += way.fixes
        s_1 += way.fixes * t
        s_2 += way.fixes * t_2
        s_3 += way.fixes * t * t_2
        s_4 += way.fixes * t_2 * t_2
        x_0 += way.off_x
        x_1 += way.off_x * t
        x_2 += way.off_x * t_2
        y_0 += way.off_y
        y_1 += way.off_y * t
        y_2 += way.off_y * t_2
    # Cramer's rule for the parabola a + b t + c t²: its value and slope at t = 0.
    m_0, m_1, m_2 = s_2 * s_4 - s_3 * s_3, s_2 * s_3 - s_1 * s_4, s_1 * s_3 - s_2 * s_2
    n_1, n_2 = s_0 * s_4 - s_2 * s_2, s_1 * s_2 - s_0 * s_3
    det = s_0 * m_0 + s_1 * m_1 + s_2 * m_2
    here = read_way(arrays.ways, step % slots, robot, lane)
    if not det > LEAST_SPREAD * s_0 * s_0 * s_0:
        return FittedPlace(
            x=here.x,
            y=here.y,
            way_x=0.0,
            way_y=0.0,
            v_x=0.0,
            v_y=0.0,
            variance=math.inf,
            fitted=0.0,
        )
    before = read_way(arrays.ways, (step - 1) % slots, robot, lane)
    after = read_way(arrays.ways, (step + 1) % slots, robot, lane)
    per_s = 1.0 / (2.0 * settings.period)
    way_x, way_y = (after.x - before.x) * per_s, (after.y - before.y) * per_s
    return FittedPlace(
        x=here.x + (m_0 * x_0 + m_1 * x_1 + m_2 * x_2) / det,
        y=here.y + (m_0 * y_0 + m_1 * y_1 + m_2 * y_2) / det,
        way_x=way_x,
        way_y=way_y,
        v_x=way_x + (m_1 * x_0 + n_1 * x_1 + n_2 * x_2) / (det * width),
        v_y=way_y + (m_1 * y_0 + n_1 * y_1 + n_2 * y_2) / (det * width),
        variance=n_1 / (det * width * width),
        fitted=1.0,
    )


@law
def fix_variance(arrays: Arrays, lane: int, robot: int, settings: Settings) -> float:
    """The variance of a fix (mm²) that the robot's filter assumes or has adapted."""
    if settings.estimator == EKF:
        return read_ekf(arrays.constants, robot, lane).variance
    if settings.estimator == EKF_GYRO:
        gyro_ekf = read_gyro_ekf(arrays.constants, robot, lane)
        found = read_gyro(arrays.states, robot, lane).variance
        return max(gyro_ekf.variance + found, gyro_ekf.least_variance)
    ekf = read_slip_ekf(arrays.constants, robot, lane)
    return max(ekf.variance + read_slip(arrays.states, robot, lane).variance, ekf.least_variance)


@law
def velocity_share(
    arrays: Arrays, lane: int, robot: int, variance: float, settings: Settings
) -> float:
    """Weight of a fitted velocity of this variance ((mm/s)²) against the filter's; 1 if that has none."""
    if settings.estimator == EKF_GYRO:
        by_filter = read_gyro(arrays.states, robot, lane).p_11
    elif settings.estimator == EKF_SLIP:
        by_filter = read_slip(arrays.states, robot, lane).p_11
    else:
        return 1.0
    return by_filter / max(by_filter + variance, LEAST_VARIANCE)


@law
def smooth(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Replace the robot's message of some steps ago by a smoothed one, unless this broadcast is lost."""
    keep_way(arrays, lane, robot, step, settings)
    slots, half = arrays.ways.shape[1], settings.half_window
    _, late = fix_timing(arrays, lane, robot, settings.dt)
    behind = (late + settings.substeps - 1) // settings.substeps
    middle = step - half - behind  # the first window's moment
    if middle - half < 1:
        return
    place = place_at(arrays, lane, robot, middle, late, settings)
    way = read_way(arrays.ways, middle % slots, robot, lane)
    sin, cos = math.sin(way.theta), math.cos(way.theta)
    ahead, across = cos * place.v_y - sin * place.v_x, -cos * place.v_x - sin * place.v_y
    speed_2 = ahead * ahead + across * across
    course = math.copysign(1.0, ahead) * across
    by_filter = read_estimate(arrays.states, robot, lane).p_tt
    of_course = place.variance * fix_variance(arrays, lane, robot, settings)
    weight = by_filter * speed_2 / (by_filter * speed_2 + of_course) if place.fitted > 0.0 else 0.0
    heading = way.theta + weight * math.atan2(course, abs(ahead))
    share = velocity_share(arrays, lane, robot, of_course, settings)
    v_x = place.way_x + share * (place.v_x - place.way_x)
    v_y = place.way_y + share * (place.v_y - place.way_y)
    turned = with_place(way, place.x, place.y, v_x, v_y, heading - way.turn, place.fitted)
    write_way(arrays.ways, middle % slots, robot, lane, turned)
    then = middle - half  # the second window's moment
    lost = arrays.dropped[step % arrays.dropped.shape[0], robot, lane]
    if lost or then - half < half + 1:
        return
    way = read_way(arrays.ways, then % slots, robot, lane)
    if way.fitted == 0.0:
        return
    total = slope = spread = 0.0
    for k in range(-half, half + 1):
        off = read_way(arrays.ways, (then + k) % slots, robot, lane).heading
        total += off
        slope += off * k
        spread += k * k
    before = read_way(arrays.ways, (then - 1) % slots, robot, lane)
    after = read_way(arrays.ways, (then + 1) % slots, robot, lane)
    theta = way.turn + total / (2 * half + 1)
    u_1 = math.cos(theta) * way.v_y - math.sin(theta) * way.v_x
    u_2 = ((after.turn - before.turn) / 2.0 + slope / spread) / settings.period
    message = Message(way.p_x, way.p_y, theta, u_1, u_2)
    write_message(arrays.messages, then % arrays.messages.shape[1], robot, lane, message)
