"""Limits on the twist that a controller commands, so that the tyres can transmit it.

For a lateral error of 100 mm the paper's law commands 4 rad/s: the wheels skid, and the heading of a
filter that assumes no slip becomes wrong. The limits act on the expected twist of the body, which is the
wheels' twist plus the estimated slip δ₁, δ₂ of eq. (14). They are not part of the paper.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, NonNegative, Positive, Switch, infinite_if_none
from tlf_env.numerics.compiled import law

# Fields that bound what a law sees, and so belong to a controller; the others limit what it may command.
BOUNDS = ("braking_error_mm", "forward_error_mm", "lateral_error_mm")


class TwistLimits(Frozen):
    """None: no such limit. Without any limit the law is that of the paper."""

    forward_error_mm: Positive | None = None  # E: e₁ becomes E·tanh(e₁/E)
    lateral_error_mm: Positive | None = None  # the same for e₂
    braking_error_mm: Positive | None = None  # w: before that, e₁ beyond w becomes √(w(2e₁ − w))
    acceleration_mm_s2: Positive | None = None  # of u₁
    yaw_acceleration_rad_s2: Positive | None = None  # of u₂
    yaw_rate_rad_s: Positive | None = None  # of |u₂|
    lateral_acceleration_mm_s2: Positive | None = None  # of |u₁ u₂|
    turning_acceleration_mm_s2: Positive | None = None  # of u₁ when |u₁ u₂| is at its limit
    # While the position error is well below free_reach_mm, changes of u₁ within free_speed_mm_s of the
    # reference's speed are not limited.
    free_speed_mm_s: NonNegative = 0.0
    free_reach_mm: Positive = 30.0
    reverse_mm_s: NonNegative | None = None  # of u₁ backward
    # u₁ exceeds the reference's speed at most by √(closing_speed_mm_s² + 2·closing_deceleration_mm_s2·e₁), so
    # that this deceleration is enough to arrive at the reference with closing_speed_mm_s.
    closing_deceleration_mm_s2: Positive | None = None
    closing_speed_mm_s: NonNegative = 20.0
    cancel_slip: Switch = False  # subtract the estimated slip from the wheels' twist


class TwistLimitsRow(NamedTuple):
    """The limits for the compiled laws; infinity: no such limit."""

    forward_error: float
    lateral_error: float
    braking_error: float
    step_1: float  # mm/s per control step
    step_2: float  # rad/s per control step
    yaw_rate: float  # rad/s
    lateral: float
    turning_loss: float  # mm/s per control step, reduction of step_1 when |u₁ u₂| is at its limit
    free: float  # mm/s
    free_reach: float  # mm
    reverse: float  # mm/s
    closing: float  # mm/s²
    closing_speed: float  # mm/s
    slip: float  # 1 if the estimated slip is subtracted, else 0


def twist_limits_row(limits: TwistLimits, period_s: float) -> TwistLimitsRow:
    """The limits for a control period."""
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
        closing=infinite_if_none(limits.closing_deceleration_mm_s2),
        closing_speed=limits.closing_speed_mm_s,
        slip=1.0 if limits.cancel_slip else 0.0,
    )


@law
def saturated(error: float, most: float) -> float:
    """A position error (mm) limited smoothly to ±``most``."""
    if most == math.inf:
        return error
    return most * math.tanh(error / most)


@law
def braked(error: float, linear: float) -> float:
    """A forward error (mm) for which the speed k₁·error can be stopped within the remaining distance.

    Beyond ``linear`` it grows with the square root, with a continuous slope: e₁ then decreases with a
    constant deceleration of k₁²·``linear``.
    """
    if abs(error) <= linear:
        return error
    return math.copysign(math.sqrt(linear * (2.0 * abs(error) - linear)), error)


@law
def closing_speed(u_1: float, cruise: float, e_1: float, limits: TwistLimitsRow) -> float:
    """A wanted speed (mm/s), reduced so that the robot can brake gently before it reaches its reference.

    ``cruise`` is the reference's speed (mm/s), ``e_1`` the forward error (mm). The robots behind drive the
    same path a time gap later: where a robot brakes hard after it has caught up, they must do so, too, and
    have nothing left for their own errors.
    """
    if limits.closing == math.inf:
        return u_1
    final = limits.closing_speed
    return min(u_1, cruise + math.sqrt(final * final + 2.0 * limits.closing * max(e_1, 0.0)))


@law
def within(value: float, centre: float, reach: float) -> float:
    """``value`` clipped to ``centre`` ± ``reach``."""
    return min(max(value, centre - reach), centre + reach)


@law
def speed_range(
    b_1: float, b_2: float, cruise: float, error: float, limits: TwistLimitsRow
) -> tuple[float, float]:
    """Range of the next commanded speed of the body (mm/s), if ``b`` is the body's twist by the last command.

    In a turn less motor torque is left for acceleration: the limit decreases with the square of |b₁ b₂|.
    Small corrections of a small error about the reference's speed ``cruise`` are not limited. A robot
    that catches up is, since it would use the full torque.
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
    """Twist for the wheels (mm/s, rad/s) for a wanted twist ``u`` of the body.

    ``last`` is the wheels' twist of the previous step, ``delta`` the estimated slip, ``cruise`` the
    reference's speed (mm/s), ``error`` the estimated position error (mm). If |u₁ u₂| exceeds its limit,
    speed above the reference's speed is reduced first, then the yaw rate.
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
