"""Tracking controller (TC): errors (16), nominal law (19) and complementary law (21)."""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.numerics.compiled import law
from tlf_env.numerics.trig import sincos
from tlf_env.onboard.limiter import Limits, TwistLimits, limits_row
from tlf_env.onboard.spacing import Spacing, SpacingRow, spacing_row

HEADING_DAMPING_PER_S = 0.83


class TrackingGains(Frozen):
    """Gains of eqs (19) and (21).

    ``k_2_mm2_s`` / ``k_3_mm2`` is the damping of the heading, 1/s. η is the bound on slip that the
    complementary law assumes, in mm/s and rad/s at once, as printed.
    """

    k_1_per_s: Positive = 0.23
    k_2_mm2_s: NonNegative = HEADING_DAMPING_PER_S * 12e3
    k_3_mm2: Positive = 12e3
    eta: NonNegative = 1.9e-3
    epsilon: Positive = 0.1


class Gains(NamedTuple):
    """The same numbers as the compiled law takes them."""

    k_1: float
    k_2: float
    k_3: float
    eta: float
    epsilon: float


class Controller(Frozen):
    """The tracking law's gains and the limits on what it asks for.

    With ``lead_s`` the reference's twist enters as it will be so much later, by a straight line to the
    first preview: what is asked for holds for a control period, and the wheel loop takes its time.
    """

    gains: TrackingGains = TrackingGains()
    limits: TwistLimits = TwistLimits()
    spacing: Spacing | None = None  # the distance kept from the predecessor, if any
    lead_s: NonNegative = 0.0


class ControllerRow(NamedTuple):
    """The same numbers as the compiled law takes them."""

    gains: Gains
    limits: Limits
    spacing: SpacingRow
    lead: float  # as a fraction of the time to the first preview


# `consistent` reads the printed k₂ = 0.83 as the ratio k₂/k₃ in 1/s, of the same size as k₁; `printed`
# takes it as it stands, 0.83 mm²/s, which leaves the heading almost undamped. See docs/controller.md.
GAIN_PRESETS: dict[str, TrackingGains] = {
    "consistent": TrackingGains(),
    "printed": TrackingGains(k_2_mm2_s=0.83),
}
# `tuned` is not the paper's. The law keeps its form; its numbers and the limits are chosen for a robot
# that slips and knows it.
CONTROLLERS: dict[str, Controller] = {
    **{name: Controller(gains=gains) for name, gains in GAIN_PRESETS.items()},
    "tuned": Controller(
        gains=TrackingGains(
            k_1_per_s=1.3, k_2_mm2_s=105_350.0, k_3_mm2=2.15e4, eta=1e-4, epsilon=0.05
        ),
        limits=TwistLimits(
            braking_error_mm=23.0,
            forward_error_mm=119.0,
            lateral_error_mm=150.0,
            acceleration_mm_s2=195.0,
            turning_acceleration_mm_s2=150.0,
            yaw_acceleration_rad_s2=11.5,
            yaw_rate_rad_s=1.5,
            lateral_acceleration_mm_s2=165.0,
            free_speed_mm_s=130.0,
            free_reach_mm=27.0,
            reverse_mm_s=20.0,
            cancel_slip=True,
        ),
        spacing=Spacing(),
        lead_s=0.02,
    ),
}


def tracking_gains(name: str) -> TrackingGains:
    """The gains of a preset of the paper's law, which has no limits.

    Raises
    ------
    ValueError
        naming the presets there are.
    """
    if name not in GAIN_PRESETS:
        raise ValueError(f"gains {name!r} is not one of {', '.join(GAIN_PRESETS)}")
    return GAIN_PRESETS[name]


def controller(name: str) -> Controller:
    """Gains and limits of a preset.

    Raises
    ------
    ValueError
        naming the presets there are.
    """
    if name not in CONTROLLERS:
        raise ValueError(f"gains {name!r} is not one of {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name]


def controller_row(
    known: Controller, period_s: float, preview_s: tuple[float, ...] = ()
) -> ControllerRow:
    """Gains and limits for a control period and preview times (s), as the compiled law takes them.

    Raises
    ------
    ValueError
        if there is a lead and no preview to make it from.
    """
    if known.lead_s and not (preview_s and preview_s[0] > 0):
        raise ValueError(
            f"lead_s {known.lead_s} needs a first preview above 0, got preview_s {preview_s}"
        )
    lead = known.lead_s / preview_s[0] if known.lead_s else 0.0
    return ControllerRow(
        gains_row(known.gains),
        limits_row(known.limits, period_s),
        spacing_row(known.spacing),
        lead,
    )


def gains_row(gains: TrackingGains) -> Gains:
    """The gains as the compiled law takes them."""
    return Gains(gains.k_1_per_s, gains.k_2_mm2_s, gains.k_3_mm2, gains.eta, gains.epsilon)


@law
def body_errors(d_x: float, d_y: float, theta: float) -> tuple[float, float]:
    """Eq. (16), position part: e₁ forward and e₂ to the right (mm), for reference − robot in world axes."""
    sin, cos = sincos(theta)
    return -sin * d_x + cos * d_y, cos * d_x + sin * d_y


@law
def nominal_twist(
    e_1: float, e_2: float, sin_e3: float, cos_e3: float, u_1: float, u_2: float, gains: Gains
) -> tuple[float, float]:
    """Nominal law (19): twist (mm/s, rad/s) for body errors and the reference's twist u₁*, u₂*."""
    return (
        gains.k_1 * e_1 + u_1 * cos_e3,
        gains.k_2 / gains.k_3 * sin_e3 + u_2 - e_2 * u_1 / gains.k_3,
    )


@law
def complementary_twist(e_1: float, sin_e3: float, gains: Gains) -> tuple[float, float]:
    """Complementary law (21), with λ = (−e₁, −k₃ sin e₃)."""
    l_1, l_2 = -e_1, -gains.k_3 * sin_e3
    if gains.eta * (abs(l_1) + abs(l_2)) >= gains.epsilon:
        r_1 = -math.copysign(gains.eta, l_1) if l_1 != 0.0 else 0.0
        r_2 = -math.copysign(gains.eta, l_2) if l_2 != 0.0 else 0.0
        return r_1, r_2
    slope = gains.eta * gains.eta / gains.epsilon
    return -slope * l_1, -slope * l_2


@law
def tracking_twist(
    e_1: float, e_2: float, sin_e3: float, cos_e3: float, u_1: float, u_2: float, gains: Gains
) -> tuple[float, float]:
    """The whole law, (19) + (21)."""
    n_1, n_2 = nominal_twist(e_1, e_2, sin_e3, cos_e3, u_1, u_2, gains)
    c_1, c_2 = complementary_twist(e_1, sin_e3, gains)
    return n_1 + c_1, n_2 + c_2
