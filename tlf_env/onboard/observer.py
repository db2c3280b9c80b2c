"""Delayed-dynamics observer of time-gap leader-follower formation (TLF), eqs (42)–(51)."""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, Positive
from tlf_env.numerics.angles import wrap
from tlf_env.numerics.compiled import law


class ObserverParameters(Frozen):
    """Gain b = b₁ = b₂ = b₃ (1/s) and the smoothing time of eq. (51) (s)."""

    gain_per_s: Positive = 3.0
    smoothing_s: Positive = 5.0


class Message(NamedTuple):
    """A robot's broadcast: estimated pose of c (mm, rad) and twist (mm/s, rad/s)."""

    x: float
    y: float
    theta: float
    u_1: float
    u_2: float


class Reference(NamedTuple):
    """Reference of a robot, eq. (50): pose (mm, rad) and twist u₁*, u₂* (mm/s, rad/s)."""

    x: float
    y: float
    theta: float
    u_1: float
    u_2: float


@law
def smoothing(t: float, duration: float) -> float:
    """℘ of eq. (51): rises from 0 to 1 over ``duration`` s."""
    if t >= duration:
        return 1.0
    return 0.5 * (1.0 - math.cos(math.pi * t / duration))


@law
def observer_rates(
    x: float, y: float, theta: float, delayed: Message, gain: float, factor: float
) -> tuple[float, float, float]:
    """Eq. (43) times ℘: rates of the observer's pose for the predecessor's delayed message."""
    return (
        factor * (-delayed.u_1 * math.sin(theta) + gain * (delayed.x - x)),
        factor * (delayed.u_1 * math.cos(theta) + gain * (delayed.y - y)),
        factor * (delayed.u_2 + gain * wrap(delayed.theta - theta)),
    )


@law
def dead_reckoned(message: Message, duration: float) -> Message:
    """The sender's message ``duration`` s later, if it continues with the twist in this message.

    The motion is a circular arc, so that two steps equal one step of their total duration.
    """
    turn = message.u_2 * duration
    half = 0.5 * turn
    shorter = 1.0 - half * half / 6.0 if abs(half) < 1e-4 else math.sin(half) / half
    chord = message.u_1 * duration * shorter
    middle = message.theta + half
    return Message(
        message.x - chord * math.sin(middle),
        message.y + chord * math.cos(middle),
        message.theta + turn,
        message.u_1,
        message.u_2,
    )


@law
def observed_reference(
    x: float, y: float, theta: float, rate_x: float, rate_y: float, rate_theta: float
) -> Reference:
    """Eq. (50): the observer's pose and the twist of its motion."""
    return Reference(x, y, theta, math.sqrt(rate_x * rate_x + rate_y * rate_y), rate_theta)
