"""Disturbance rejection: a robot's observer of the motion that its wheels do not explain.

A linear extended state observer (Gao, "Scaling and bandwidth-parameterization based controller tuning",
American Control Conference 2003, pages 4989 to 4996) for feedback linearisation. The point b in front of the
axle has the errors z = (e₁ + b(cos e₃ − 1), e₂ − b sin e₃). If the reference's point moves with r in the
robot's axes (forward, right), then

    ż₁ = r₁ − (u₁ + d₁) − u₂ z₂,  ż₂ = r₂ + b (u₂ + d₂) + u₂ z₁

where u is the twist by the wheels, mean over the last step, and d all motion that it does not explain.
(With the command in place of the wheels, a motor at its largest torque would pass for slip, and the law
would ask for more.) The observer predicts z and holds d over a control period T, and corrects both by the
observed z with the gains 1 − β² and (1 − β)²/T, β = exp(−ωT), so that both its poles are at β (Miklosovic,
Radke and Gao, American Control Conference 2006).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.common.models import Frozen, Positive
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import row_reader, row_writer


class Rejection(Frozen):
    """Bandwidth ω of the observer, and bounds of the sizes of d₁ and d₂."""

    bandwidth_rad_s: Positive
    most_slip_mm_s: Positive
    most_slip_rad_s: Positive


class RejectionRow(NamedTuple):
    """The observer for the compiled laws."""

    at_once: float  # gain of z; 0: there is no observer
    over_time: float  # gain of d, 1/s
    period: float  # s
    most_1: float  # mm/s
    most_2: float  # rad/s


class RejectionState(NamedTuple):
    """What a robot's observer keeps from step to step; all 0 at the start of an episode."""

    z_1: float  # mm
    z_2: float
    d_1: float  # mm/s
    d_2: float  # rad/s
    r_1: float  # the last r, mm/s
    r_2: float
    known: float  # 1 after the first step, else 0


# Of many robots, in an array (field, robot).
read_rejection_of, write_rejection_of = row_reader(RejectionState, 0), row_writer(RejectionState, 0)


def rejection_row(rejection: Rejection | None, period_s: float) -> RejectionRow:
    """The observer for a control period; None: there is none."""
    if rejection is None:
        return RejectionRow(0.0, 0.0, period_s, 0.0, 0.0)
    beta = math.exp(-rejection.bandwidth_rad_s * period_s)
    return RejectionRow(
        at_once=1.0 - beta * beta,
        over_time=(1.0 - beta) ** 2 / period_s,
        period=period_s,
        most_1=rejection.most_slip_mm_s,
        most_2=rejection.most_slip_rad_s,
    )


@law
def observed_rejection(
    state: RejectionState,
    row: RejectionRow,
    ahead: float,
    e_1: float,
    e_2: float,
    sin: float,
    cos: float,
    reference_1: float,
    reference_2: float,
    u_1: float,
    u_2: float,
) -> RejectionState:
    """The observer after a step, for whole errors and the twists of reference and wheels."""
    r_1 = reference_1 * cos - ahead * reference_2 * sin
    r_2 = -reference_1 * sin - ahead * reference_2 * cos
    seen_1, seen_2 = e_1 + ahead * (cos - 1.0), e_2 - ahead * sin
    if state.known < 0.5:
        return RejectionState(z_1=seen_1, z_2=seen_2, d_1=0.0, d_2=0.0, r_1=r_1, r_2=r_2, known=1.0)
    # Half of the motion, the turn of the axes, and the other half.
    half_1 = 0.5 * row.period * (0.5 * (state.r_1 + r_1) - u_1 - state.d_1)
    half_2 = 0.5 * row.period * (0.5 * (state.r_2 + r_2) + ahead * (u_2 + state.d_2))
    sin_turn, cos_turn = math.sin(u_2 * row.period), math.cos(u_2 * row.period)
    z_1, z_2 = state.z_1 + half_1, state.z_2 + half_2
    z_1, z_2 = cos_turn * z_1 - sin_turn * z_2, sin_turn * z_1 + cos_turn * z_2
    z_1, z_2 = z_1 + half_1, z_2 + half_2
    missed_1, missed_2 = seen_1 - z_1, seen_2 - z_2
    d_1 = state.d_1 - row.over_time * missed_1
    d_2 = state.d_2 + row.over_time * missed_2 / ahead
    return RejectionState(
        z_1=z_1 + row.at_once * missed_1,
        z_2=z_2 + row.at_once * missed_2,
        d_1=min(max(d_1, -row.most_1), row.most_1),
        d_2=min(max(d_2, -row.most_2), row.most_2),
        r_1=r_1,
        r_2=r_2,
        known=1.0,
    )
