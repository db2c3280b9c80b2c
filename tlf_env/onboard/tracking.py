"""Tracking controller (TC): errors (16), nominal law (19) and complementary law (21).

In their place a controller may have the law of a textbook, feedback linearisation of a point ahead.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, Self

from pydantic import Field, model_validator

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.common.presets import read_preset_or_file
from tlf_env.numerics.compiled import law
from tlf_env.numerics.trig import sincos
from tlf_env.onboard.limiter import TwistLimits, TwistLimitsRow, twist_limits_row
from tlf_env.onboard.rejection import Rejection, RejectionRow, rejection_row
from tlf_env.onboard.spacing import Spacing, SpacingRow, spacing_row


@functools.cache
def _consistent() -> dict[str, float]:
    """The gains of the preset ``consistent``; default gains exist only in controller files."""
    gains: dict[str, float] = read_preset_or_file("controller", "consistent")["controller"]["gains"]
    return gains


def _gain(name: str) -> Any:
    return Field(default_factory=lambda: _consistent()[name])


class TrackingGains(Frozen):
    """Gains of eqs (19) and (21); defaults from ``configs/controllers/consistent.yaml``.

    ``k_2_mm2_s`` / ``k_3_mm2`` is the damping of the heading, 1/s. η is the bound on slip that the
    complementary law assumes, one number for mm/s and rad/s, as printed in the paper.
    """

    k_1_per_s: Positive = _gain("k_1_per_s")
    k_2_mm2_s: NonNegative = _gain("k_2_mm2_s")
    k_3_mm2: Positive = _gain("k_3_mm2")
    eta: NonNegative = _gain("eta")
    epsilon: Positive = _gain("epsilon")


class Gains(NamedTuple):
    """The gains for the compiled laws."""

    k_1: float
    k_2: float
    k_3: float
    eta: float
    epsilon: float


class Linearisation(Frozen):
    """Feedback linearisation of a point ``ahead_mm`` before the axle; its error decays with ``gain_per_s``.

    ``rejection``: an observer of the motion that the wheels do not explain, which the law subtracts; it gives
    the law a memory.
    """

    ahead_mm: Positive
    gain_per_s: Positive
    rejection: Rejection | None = None


class Controller(Frozen):
    """Gains of the tracking law, and limits of its command.

    ``linearisation``: this law in place of the paper's, whose ``gains`` then have no effect.
    ``lead_s``: the law uses the reference's twist this much later, interpolated linearly to the first
    preview, to compensate for the control period and the lag of the wheel loop.
    """

    gains: TrackingGains = TrackingGains()
    linearisation: Linearisation | None = None
    limits: TwistLimits = TwistLimits()
    spacing: Spacing | None = None  # distance keeping to the predecessor, if any
    lead_s: NonNegative = 0.0

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        if self.linearisation is not None and self.gains != TrackingGains():
            raise ValueError("gains and linearisation exclude each other: they are of two laws")
        return self


class ControllerRow(NamedTuple):
    """The controller for the compiled laws."""

    gains: Gains
    ahead: float  # mm, of the point of the feedback linearisation; 0: the paper's law
    decay: float  # 1/s, of its error
    rejection: RejectionRow
    limits: TwistLimitsRow
    spacing: SpacingRow
    lead: float  # fraction of the time to the first preview


def can_lead(preview_s: tuple[float, ...]) -> bool:
    """Whether an observation's previews (s) allow a lead, which is computed from the first."""
    return bool(preview_s) and preview_s[0] > 0


def controller_row(
    controller: Controller, period_s: float, preview_s: tuple[float, ...] = ()
) -> ControllerRow:
    """Gains and limits for a control period and preview times (s).

    Raises
    ------
    ValueError
        if there is a lead and no preview above 0.
    """
    if controller.lead_s and not can_lead(preview_s):
        raise ValueError(
            f"lead_s {controller.lead_s} needs a first preview above 0, got preview_s {preview_s}"
        )
    lead = controller.lead_s / preview_s[0] if controller.lead_s else 0.0
    point = controller.linearisation
    return ControllerRow(
        gains=gains_row(controller.gains),
        ahead=0.0 if point is None else point.ahead_mm,
        decay=0.0 if point is None else point.gain_per_s,
        rejection=rejection_row(None if point is None else point.rejection, period_s),
        limits=twist_limits_row(controller.limits, period_s),
        spacing=spacing_row(controller.spacing),
        lead=lead,
    )


def gains_row(gains: TrackingGains) -> Gains:
    """The gains for the compiled laws."""
    return Gains(gains.k_1_per_s, gains.k_2_mm2_s, gains.k_3_mm2, gains.eta, gains.epsilon)


@law
def body_errors(d_x: float, d_y: float, theta: float) -> tuple[float, float]:
    """Eq. (16): position errors e₁ forward and e₂ to the right (mm), from reference − robot in world axes."""
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
    """The complete law, (19) + (21)."""
    n_1, n_2 = nominal_twist(e_1, e_2, sin_e3, cos_e3, u_1, u_2, gains)
    c_1, c_2 = complementary_twist(e_1, sin_e3, gains)
    return n_1 + c_1, n_2 + c_2


@law
def linearised_twist(
    e_1: float,
    e_2: float,
    sin_e3: float,
    cos_e3: float,
    u_1: float,
    u_2: float,
    ahead: float,
    decay: float,
) -> tuple[float, float]:
    """Twist (mm/s, rad/s) that lets the error of a point ``ahead`` mm before the axle decay with ``decay`` 1/s.

    Input–output linearisation: Siciliano et al., "Robotics: modelling, planning and control", Springer 2009,
    section 11.6.2. The point can move in every direction.
    """
    forward = u_1 * cos_e3 - ahead * u_2 * sin_e3 + decay * (e_1 + ahead * (cos_e3 - 1.0))
    right = -u_1 * sin_e3 - ahead * u_2 * cos_e3 + decay * (e_2 - ahead * sin_e3)
    return forward, -right / ahead
