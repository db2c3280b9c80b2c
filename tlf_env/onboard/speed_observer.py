"""Velocity observer of the drive wheels: their speeds from encoder readings of finite resolution.

The difference of two readings of an encoder with N counts, a period dt apart, is a whole number of steps of
2π/(N dt): 1.5 rad/s for 4096 counts and 1 ms. The observer follows the readings with the states angle,
speed and unknown acceleration; the torques, through the model of a robot that rolls, are fed forward. All
three of its poles lie at exp(−ω dt) for a bandwidth ω, which makes the gains those of an α-β-γ filter with
critical damping (E. Brookner, *Tracking and Kalman Filtering Made Easy*, 1998, section 2.2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.compiled import law
from tlf_env.physics.vehicle import Body


class SpeedObserverRow(NamedTuple):
    """Gains of the observer, and accelerations per torque; all 0 without observer."""

    angle: float  # share of the error by which the angle is corrected
    speed: float  # 1/s
    acceleration: float  # 1/s²
    own: float  # acceleration of a wheel per its own torque, rad/s² per mN·mm
    other: float  # per the other wheel's torque


class WheelState(NamedTuple):
    """Estimated angle (rad), speed (rad/s) and unknown acceleration (rad/s²) of a wheel."""

    angle: float
    speed: float
    acceleration: float


class SpeedObserverState(NamedTuple):
    """The same of both wheels."""

    angle_l: float
    speed_l: float
    acceleration_l: float
    angle_r: float
    speed_r: float
    acceleration_r: float


NO_OBSERVER = SpeedObserverRow(angle=0.0, speed=0.0, acceleration=0.0, own=0.0, other=0.0)


def speed_observer_row(bandwidth_rad_s: float | None, robot: Body, dt_s: float) -> SpeedObserverRow:
    """The observer of a bandwidth at a period of ``dt_s`` s; None: without observer."""
    if bandwidth_rad_s is None:
        return NO_OBSERVER
    pole = math.exp(-bandwidth_rad_s * dt_s)
    # A robot that rolls: mass and inertia about c, each with both wheels; the castor is left out.
    mass = robot.m + 2.0 * robot.spin_mass_drive
    forward, turn = 1.0 / (robot.R**2 * mass), robot.h**2 / (robot.R**2 * robot.I_rolling)
    return SpeedObserverRow(
        angle=1.0 - pole**3,
        speed=1.5 * (1.0 - pole) ** 2 * (1.0 + pole) / dt_s,
        acceleration=(1.0 - pole) ** 3 / dt_s**2,
        own=forward + turn,
        other=forward - turn,
    )


@law
def observed_wheel(
    wheel: WheelState, reading: float, known: float, row: SpeedObserverRow, dt: float
) -> WheelState:
    """A wheel one period on; ``reading`` (rad) is its encoder's, ``known`` what torques cause (rad/s²)."""
    total = known + wheel.acceleration
    angle = wheel.angle + dt * (wheel.speed + 0.5 * dt * total)
    error = reading - angle
    return WheelState(
        angle=angle + row.angle * error,
        speed=wheel.speed + dt * total + row.speed * error,
        acceleration=wheel.acceleration + row.acceleration * error,
    )


@law
def observed_speeds(
    state: SpeedObserverState,
    reading_l: float,
    reading_r: float,
    torque_l: float,
    torque_r: float,
    row: SpeedObserverRow,
    dt: float,
) -> SpeedObserverState:
    """Both wheels one period on, from their encoders (rad) and the torques commanded in it (mN·mm)."""
    left = observed_wheel(
        WheelState(state.angle_l, state.speed_l, state.acceleration_l),
        reading_l,
        row.own * torque_l + row.other * torque_r,
        row,
        dt,
    )
    right = observed_wheel(
        WheelState(state.angle_r, state.speed_r, state.acceleration_r),
        reading_r,
        row.own * torque_r + row.other * torque_l,
        row,
        dt,
    )
    return SpeedObserverState(
        angle_l=left.angle,
        speed_l=left.speed,
        acceleration_l=left.acceleration,
        angle_r=right.angle,
        speed_r=right.speed,
        acceleration_r=right.acceleration,
    )
