"""Angular velocity controller (AVC) of one drive wheel, eq. (13), in N·mm per rad/s.

K(s) = k (s² + a₁ s + a₀) / (s (s + p)) = k + k_i / s + k_p / (s + p), with the exact partial fractions
k_i = k a₀ / p and k_p = k (p² − a₁ p + a₀) / (−p). With the printed numbers these are 22.69 and 127.31;
the paper rounds them to 22 and 128.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from pydantic import Field

from tlf_env.common.models import Frozen, Positive
from tlf_env.numerics.compiled import law
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON


class WheelLoopParameters(Frozen):
    """Eq. (13): ``gain`` (s² + ``zeros_1`` s + ``zeros_0``) / (s (s + ``pole``)), N·mm per rad/s.

    ``speed_observer_rad_s`` is the bandwidth of the observer that measures the wheels' speeds
    (:mod:`tlf_env.onboard.speed_observer`). None: the difference of two encoder readings.
    """

    gain_Nmm_s: Positive = 150.0
    zeros_1: Positive = 3.0
    zeros_0: Positive = 0.3025
    pole_rad_s: Positive = 2.0
    speed_observer_rad_s: Annotated[Positive, Field(le=1e4)] | None = None


class WheelLoopRow(NamedTuple):
    """Digital form of eq. (13), torques in mN·mm."""

    gain: float
    integral_step: float
    lag_decay: float
    lag_step: float


class WheelLoopState(NamedTuple):
    """Torques of the integrator and the lag of each wheel, mN·mm."""

    integral_l: float
    lag_l: float
    integral_r: float
    lag_r: float


def digital_wheel_loop(parameters: WheelLoopParameters, dt_s: float) -> WheelLoopRow:
    """Eq. (13) at a period of ``dt_s`` s, with exact decay of the lag and without delay of the error."""
    k, p = parameters.gain_Nmm_s, parameters.pole_rad_s
    a_1, a_0 = parameters.zeros_1, parameters.zeros_0
    integral = k * a_0 / p
    lag = -k * (p**2 - a_1 * p + a_0) / p
    decay = math.exp(-p * dt_s)
    return WheelLoopRow(
        gain=k * MILLINEWTON_PER_NEWTON,
        integral_step=integral * dt_s * MILLINEWTON_PER_NEWTON,
        lag_decay=decay,
        lag_step=lag * (1 - decay) / p * MILLINEWTON_PER_NEWTON,
    )


@law
def wheel_torque(
    error: float, integral: float, lag: float, loop: WheelLoopRow, limit: float
) -> tuple[float, float, float]:
    """Torque for a speed error in rad/s; returns ``(torque, integral, lag)``, torque within ±``limit``.

    Anti-windup: while the torque is at its limit and the error would increase it, integrator and lag keep
    their values.
    """
    next_integral = integral + loop.integral_step * error
    next_lag = loop.lag_decay * lag + loop.lag_step * error
    torque = loop.gain * error + next_integral + next_lag
    limited = min(max(torque, -limit), limit)
    if torque != limited and error * torque > 0.0:
        return limited, integral, lag
    return limited, next_integral, next_lag
