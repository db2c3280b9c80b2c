"""What a robot's computer believes of its wheels, and the conversions between wheels and twist that use it.

Radii and width of the axle are measured with errors (J. Borenstein and L. Feng, *Measurement and
correction of systematic odometry errors in mobile robots*, IEEE Trans. Robotics and Automation 12, 1996).
"""

from __future__ import annotations

from typing import NamedTuple

from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.physics.vehicle import Body, odometry, wheel_speeds


class Belief(NamedTuple):
    """What a robot's computer believes of its wheels."""

    radius_l: float  # over the true one
    radius_r: float
    h: float  # half the width of the axle, mm


with_h = replacing(Body, "h")


@law
def believed_odometry(
    angle_l: float, angle_r: float, body: Body, belief: Belief
) -> tuple[float, float]:
    """Eq. (29) as the robot's computer evaluates it: mm and rad from the wheels' increments (rad)."""
    return odometry(angle_l * belief.radius_l, angle_r * belief.radius_r, body.R, belief.h)


@law
def believed_wheel_speeds(
    forward: float, turn: float, body: Body, belief: Belief
) -> tuple[float, float]:
    """Wheel speeds (left, right; rad/s) by which the robot's computer expects a twist (mm/s, rad/s)."""
    left, right = wheel_speeds(forward, turn, with_h(body, belief.h))
    return left / belief.radius_l, right / belief.radius_r
