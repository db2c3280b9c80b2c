"""Statements of the proofs that a small number decides."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from baselines.paper.claims import Below, Claim, Measured
from baselines.paper.errors import Law, complementary, rates
from baselines.paper.parts import Part, Progress, Table
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.tracking import Gains, gains_row


class Proofs(NamedTuple):
    """Numbers of this part."""

    gains: Gains
    jump: float  # of one component of (21) at the edge of its layer, over η
    layer: float  # largest λᵀδ + λᵀϱ inside the layer of (21), over ε
    bound: float  # V̇₁ over the right side of (26), at the worst start
    bound_at_mm: float
    observer: float  # relative error of the derivative that proof 4 prints for its V₂


def compute(progress: Progress) -> Proofs:
    """All numbers, in closed form or by search."""
    gains = gains_row(controller("printed").gains)
    distance = 100.0
    result = Proofs(
        gains, jump(gains), layer_bound(gains), *violation(gains, distance), observer_rate()
    )
    progress(1, 1)
    return result


def jump(gains: Gains) -> float:
    """Largest step of a component of ϱ over η, across η‖λ‖₁ = ε; searched over the shares of λ."""
    largest = 0.0
    for share in np.linspace(0.0, 1.0, 1001):
        size = gains.epsilon / gains.eta
        inside, outside = (
            np.array(
                complementary(
                    np.array([-share * size * scale]),
                    np.array([-(1 - share) * size * scale / gains.k_3]),
                    gains,
                )
            )
            for scale in (1 - 1e-9, 1 + 1e-9)
        )
        largest = max(largest, float(np.abs(outside - inside).max()))
    return largest / gains.eta


def layer_bound(gains: Gains) -> float:
    """Largest η‖λ‖₁ + λᵀϱ inside the layer over ε: λᵀδ at the worst slip with ‖δ‖∞ = η."""
    size = gains.epsilon / gains.eta * np.linspace(0, 1, 401)[:-1, None]
    share = np.linspace(0, 1, 401)[None, :]
    l_1, l_2 = size * share, size * (1 - share)
    r_1, r_2 = complementary(-l_1, -l_2 / gains.k_3, gains)
    return float((gains.eta * (l_1 + l_2) + l_1 * r_1 + l_2 * r_2).max() / gains.epsilon)


def violation(gains: Gains, distance_mm: float) -> tuple[float, float]:
    """V̇₁ less the right side of (26) at e = (0, e₂, 0) without slip, mm²/s; and e₂ (mm)."""
    e = np.array([0.0, distance_mm, 0.0])
    e_dot = rates(e[:, None], 300.0, 0.0, Law(gains, complementary=True))[:, 0]
    V_dot = e[0] * e_dot[0] + e[1] * e_dot[1] + gains.k_3 * math.sin(e[2]) * e_dot[2]
    allowed = -min(gains.k_1, gains.k_2) * float(e @ e) + gains.epsilon / 4
    return float(V_dot - allowed), distance_mm


def observer_rate(b: float = 3.0) -> float:
    """Largest difference of V̇₂ of proof 4, along (48) and (49), from what is printed, over the latter."""
    angles = np.linspace(0, 2 * np.pi, 721)
    z_1, z_2 = np.cos(angles), np.sin(angles)
    turn = 0.4  # rad/s
    rate = (z_1 + z_2) * ((-z_2 * turn - b * z_1) + (z_1 * turn - b * z_2))
    return float(np.max(np.abs(rate + b * (z_1**2 + z_2**2)) / b))


def draw(_: Proofs) -> Mapping[str, Figure]:
    """No figure."""
    return {}


def tables(_: Proofs) -> tuple[Table, ...]:
    """No table."""
    return ()


def _violation(data: Proofs) -> Measured:
    return Measured(data.bound, f"at e₁ = e₃ = 0 and e₂ = {data.bound_at_mm:g} mm, where V̇₁ = 0")


CLAIMS = (
    Claim(
        "complementary-continuous",
        "The complementary law is a continuous approximation of the sign function",
        "eq. (21)",
        "continuous",
        "largest jump of a component at the edge of the layer, over η",
        "",
        lambda data: data.jump,
        Below(0.001),
    ),
    Claim(
        "layer-bound",
        "Inside the layer slip raises V̇₁ by at most ε/4",
        "eq. (25)",
        "ε/4",
        "largest λᵀδ + λᵀϱ over ε, for slip of the size η: it tends to 1/2",
        "",
        lambda data: data.layer,
        Below(0.2501),
    ),
    Claim(
        "ultimate-bound",
        "V̇₁ is at most −k‖e‖² + ε/4, which bounds the error",
        "eqs (26) and (27)",
        "at most 0",
        "V̇₁ less that bound, printed gains, without slip",
        "mm²/s",
        _violation,
        Below(1e-9),
    ),
    Claim(
        "observer-proof",
        "V₂ = (z₁ + z₂)²/2 has the derivative −bz₁² − bz₂²",
        "proof 4",
        "equal",
        "largest relative difference on a circle, b = 3 1/s; (z₁² + z₂²)/2 has this derivative",
        "",
        lambda data: data.observer,
        Below(1e-9),
    ),
)

PART = Part(
    name="proofs",
    title="Statements of the proofs",
    text=(
        "Single numbers that decide a statement. A counter-example shows that the step of the proof is "
        "not valid; it does not show that the loop fails.",
    ),
    compute=compute,
    draw=draw,
    captions={},
    tables=tables,
    claims=CLAIMS,
)
