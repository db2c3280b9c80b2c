"""Limits on the twist that a controller asks for, so that the tyres can give it.

A lateral error of 100 mm asks the paper's law for 4 rad/s; the wheels skid, and a filter that assumes no
slip loses the heading. The limits act on the twist that the body is expected to have, which is the
wheels' twist plus the estimated slip δ₁, δ₂ of eq. (14). They are not the paper's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, NonNegative, Positive, infinite_if_none
from tlf_env.numerics.compiled import law


class TwistLimits(Frozen):
    """None leaves a limit out; without any the law is the paper's."""

    forward_error_mm: Positive | None = None  # e₁ enters as E·tanh(e₁/E)
    lateral_error_mm: Positive | None = None  # e₂ likewise
    braking_error_mm: Positive | None = None  # before that, e₁ beyond w becomes √(w(2e₁ − w))
    acceleration_mm_s2: Positive | None = None  # of u₁
    yaw_acceleration_rad_s2: Positive | None = None  # of u₂
    yaw_rate_rad_s: Positive | None = None  # of |u₂|
    lateral_acceleration_mm_s2: Positive | None = None  # of |u₁ u₂|
    turning_acceleration_mm_s2: Positive | None = None  # of u₁ where |u₁ u₂| is at its limit
    # Where the position error is well below the reach, u₁ changes at once within so much of the reference's
    # speed.
    free_speed_mm_s: NonNegative = 0.0
    free_reach_mm: Positive = 30.0
    reverse_mm_s: NonNegative | None = None  # of u₁ backward
    cancel_slip: bool = False  # take the estimated slip off the wheels' twist


class TwistLimitsRow(NamedTuple):
    """The same as the compiled law takes them; infinity where there is none."""

    forward_error: float
    lateral_error: float
    braking_error: float
    step_1: float  # mm/s per control step
    step_2: float  # rad/s per control step
    yaw_rate: float  # rad/s
    lateral: float
    turning_loss: float  # mm/s per control step, what step_1 loses where |u₁ u₂| is at its limit
    free: float  # mm/s
    free_reach: float  # mm
    reverse: float  # mm/s
    slip: float  # 1 if the estimated slip counts, else 0


def twist_limits_row(limits: TwistLimits, period_s: float) -> TwistLimitsRow:
    """Limits for a control period, as the compiled law takes them."""
    most, least = limits.acceleration_mm_s2, limits.turning_acceleration_mm_s2
    turning_loss = 0.0 if most is None or least is None else max(most - least, 0.0)
    return TwistLimitsRow(
        forward_error=infinite_if_none(limits.forward_error_mm),
        lateral_error=infinite_if_none(limits.lateral_error_mm),
        braking_error=infinite_if_none(limits.braking_error_mm),
        step_1=infinite_if_none(limits.acceleration_mm_s2, period_s),
        step_2=infinite_if_none(limits.yaw_acceleration_rad_s2, period_s),
        yaw_rate=infinite_if_none(limits.yaw_rate_rad_s),
        lateral=infinite_if_none(limits.lateral_acceleration_mm_s2),
        turning_loss=turning_loss * period_s,
        free=limits.free_speed_mm_s,
        free_reach=limits.free_reach_mm,
        reverse=infinite_if_none(limits.reverse_mm_s),
        slip=1.0 if limits.cancel_slip else 0.0,
    )


@law
def saturated(error: float, most: float) -> float:
    """A position error as the tracking law gets it, at most so large, mm."""
    if most == math.inf:
        return error
    return most * math.tanh(error / most)


@law
def braked(error: float, linear: float) -> float:
    """A forward error, mm, such that the speed k₁·error can be braked away on the way that is left.

    Beyond ``linear`` it grows as the root, with one slope where they meet: e₁ then falls under a constant
    deceleration, k₁² times ``linear``.
    """
    if abs(error) <= linear:
        return error
    return math.copysign(math.sqrt(linear * (2.0 * abs(error) - linear)), error)


@law
def within(value: float, centre: float, reach: float) -> float:
    """``value`` held within ``centre`` ± ``reach``."""
    return min(max(value, centre - reach), centre + reach)


@law
def speed_range(
    b_1: float, b_2: float, cruise: float, error: float, limits: TwistLimitsRow
) -> tuple[float, float]:
    """Speeds (mm/s) that the body may be asked for next, if ``b`` is what its last command comes to.

    In a turn the motors have less left to accelerate with: the limit falls with the square of |b₁ b₂|. A
    small correction of a small error, about the reference's speed ``cruise``, needs no limit; catching up
    does, for it asks for all that the motors have.
    """
    used = min(abs(b_1 * b_2) / limits.lateral, 1.0)
    step = limits.step_1 - limits.turning_loss * used * used
    low, high = b_1 - step, b_1 + step
    far = error / limits.free_reach
    free = limits.free / (1.0 + far * far * far * far)
    if abs(b_1 - cruise) <= free:
        low, high = min(low, cruise - free), max(high, cruise + free)
    return low, high


@law
def limited_twist(
    u_1: float,
    u_2: float,
    last_1: float,
    last_2: float,
    delta_1: float,
    delta_2: float,
    cruise: float,
    error: float,
    limits: TwistLimitsRow,
) -> tuple[float, float]:
    """Twist for the wheels (mm/s, rad/s) if the body shall have ``u``.

    ``last`` is the wheels' twist of the step before, ``delta`` the estimated slip, ``cruise`` the
    reference's speed (mm/s), ``error`` the estimated position error (mm). Where speed and yaw rate together
    are too much, what is beyond the reference's speed gives way first, and then the yaw rate.
    """
    s_1, s_2 = limits.slip * delta_1, limits.slip * delta_2
    b_2 = within(within(u_2, 0.0, limits.yaw_rate), last_2 + s_2, limits.step_2)
    low, high = speed_range(last_1 + s_1, last_2 + s_2, cruise, error, limits)
    b_1 = min(max(u_1, low), high)
    if abs(b_1 * b_2) > limits.lateral:
        enough = max(limits.lateral / abs(b_2), abs(cruise))
        if abs(b_1) > enough:
            b_1 = min(max(math.copysign(enough, b_1), low), high)
    if abs(b_1 * b_2) > limits.lateral:
        b_2 = math.copysign(limits.lateral / abs(b_1), b_2)
    return b_1 - s_1, b_2 - s_2
