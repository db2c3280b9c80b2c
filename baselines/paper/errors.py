"""Tracking errors in ideal kinematics, eqs (17) and (20), for many starts and laws side by side.

The laws themselves are those of :mod:`tlf_env.onboard.tracking` on arrays; a test compares them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tlf_env.onboard.controllers import controller
from tlf_env.onboard.tracking import Gains, gains_row

STEP_S = 0.01
END_S = 10.0
POSITION_MM, HEADING_RAD = 10.0, 0.05  # from here on an error counts as converged

Reference = Callable[[float], tuple[float, float]]  # time in s to u₁* (mm/s) and u₂* (rad/s)


class Law(NamedTuple):
    """A set of gains, with the complementary law (21) or without."""

    gains: Gains
    complementary: bool


class Paths(NamedTuple):
    """Errors over time."""

    t_s: np.ndarray  # (time,)
    e: np.ndarray  # (time, 3, start): mm, mm, rad


class Converged(NamedTuple):
    """When, and to which turn, the errors of some starts converge."""

    at_s: np.ndarray  # (start,): the error is small from then on; infinite if never
    turn: np.ndarray  # (start,): e₃ / 2π at the end, rounded
    left_mm: np.ndarray  # (start,): largest distance in the last 10 s


def laws() -> dict[str, Law]:
    """Both readings of k₂, with and without the complementary law, by name."""
    return {
        f"{preset}, ϱ {'on' if on else 'off'}": Law(gains_row(controller(preset).gains), on)
        for preset in ("printed", "consistent")
        for on in (False, True)
    }


def straight(_: float) -> tuple[float, float]:
    """A straight line at 300 mm/s."""
    return 300.0, 0.0


def circle(_: float) -> tuple[float, float]:
    """A circle at 300 mm/s and 0.4 rad/s."""
    return 300.0, 0.4


def infinity(t_s: float) -> tuple[float, float]:
    """u₁* and u₂* of the path of eq. (52)."""
    v_x, v_y = 250 * math.cos(t_s / 8), 500 * math.cos(t_s / 4)
    a_x, a_y = -31.25 * math.sin(t_s / 8), -125 * math.sin(t_s / 4)
    return math.hypot(v_x, v_y), (v_x * a_y - v_y * a_x) / (v_x * v_x + v_y * v_y)


REFERENCES: dict[str, Reference] = {
    "straight line": straight,
    "circle": circle,
    "path of eq. (52)": infinity,
}


def complementary(
    e_1: np.ndarray, sin_e3: np.ndarray, gains: Gains
) -> tuple[np.ndarray, np.ndarray]:
    """Law (21) for arrays of errors: ϱ₁ in mm/s and ϱ₂ in rad/s."""
    l_1, l_2 = -e_1, -gains.k_3 * sin_e3
    outside = gains.eta * (np.abs(l_1) + np.abs(l_2)) >= gains.epsilon
    slope = gains.eta**2 / gains.epsilon
    return (
        np.where(outside, -gains.eta * np.sign(l_1), -slope * l_1),
        np.where(outside, -gains.eta * np.sign(l_2), -slope * l_2),
    )


def rates(
    e: np.ndarray, u_1: float, u_2: float, law: Law, slip: tuple[Any, Any] = (0.0, 0.0)
) -> np.ndarray:
    """ė of eq. (20), and of (17) with (19) and (21) if the complementary law is on; e is (3, start).

    ``slip`` is δ₁ (mm/s) and δ₂ (rad/s) of eq. (14).
    """
    e_1, e_2, e_3 = e
    gains = law.gains
    sin = np.sin(e_3)
    turn = (gains.k_2 * sin - e_2 * u_1) / gains.k_3
    forward = -gains.k_1 * e_1
    if law.complementary:
        r_1, r_2 = complementary(e_1, sin, gains)
        turn, forward = turn + r_2, forward - r_1
    turn, forward = turn + slip[1], forward - slip[0]
    return np.stack([forward - e_2 * (u_2 + turn), e_1 * (u_2 + turn) - u_1 * sin, -turn])


def advance(
    e: np.ndarray,
    t_s: float,
    law: Law,
    reference: Reference,
    slip: tuple[Any, Any] = (0.0, 0.0),
) -> np.ndarray:
    """One step of Runge and Kutta's fourth order."""
    h = STEP_S
    now, middle, then = reference(t_s), reference(t_s + h / 2), reference(t_s + h)
    k_1 = rates(e, *now, law, slip)
    k_2 = rates(e + h / 2 * k_1, *middle, law, slip)
    k_3 = rates(e + h / 2 * k_2, *middle, law, slip)
    k_4 = rates(e + h * k_3, *then, law, slip)
    return e + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4)


def settled(
    law: Law, reference: Reference, slip: tuple[Any, Any], duration_s: float, count: int = 1
) -> np.ndarray:
    """The errors (3, case) that constant slip leaves, from no error at the start.

    Gains and slip are numbers, or arrays with one for each of ``count`` cases.
    """
    e = np.zeros((3, count))
    for k in range(round(duration_s / STEP_S)):
        e = advance(e, k * STEP_S, law, reference, slip)
    return e


def paths(
    starts: np.ndarray, law: Law, reference: Reference, duration_s: float, every: int = 1
) -> Paths:
    """Errors from some starts (3, start), with each ``every``-th step kept."""
    steps = round(duration_s / STEP_S)
    e = np.array(starts, dtype=float)
    kept = [e]
    for k in range(steps):
        e = advance(e, k * STEP_S, law, reference)
        if (k + 1) % every == 0:
            kept.append(e)
    return Paths(np.arange(len(kept)) * every * STEP_S, np.stack(kept))


def convergence(starts: np.ndarray, law: Law, reference: Reference, duration_s: float) -> Converged:
    """When the errors of some starts (3, start) come within 10 mm and 0.05 rad of a turn and stay there."""
    e = np.array(starts, dtype=float)
    last = np.where(_far(e), 0.0, -STEP_S)
    left_mm = np.zeros(e.shape[1])
    for k in range(round(duration_s / STEP_S)):
        e = advance(e, k * STEP_S, law, reference)
        last[_far(e)] = (k + 1) * STEP_S
        if (k + 1) * STEP_S > duration_s - END_S:
            left_mm = np.maximum(left_mm, np.hypot(e[0], e[1]))
    at_s = np.where(last >= duration_s - STEP_S / 2, np.inf, last + STEP_S)
    return Converged(at_s, np.round(e[2] / (2 * np.pi)), left_mm)


def _far(e: np.ndarray) -> np.ndarray:
    off = e[2] - 2 * np.pi * np.round(e[2] / (2 * np.pi))
    return np.asarray((np.hypot(e[0], e[1]) > POSITION_MM) | (np.abs(off) > HEADING_RAD))


def growth_rates(e_3: float, law: Law, reference: Reference = circle) -> np.ndarray:
    """Eigenvalues (1/s) of eq. (20) linearised about [0 0 e₃], by central differences."""
    u_1, u_2 = reference(0.0)
    at = np.array([0.0, 0.0, e_3])
    columns = []
    for i, step in enumerate((1e-3, 1e-3, 1e-6)):
        d = step * np.eye(3)[i]
        pair = np.stack([at + d, at - d], axis=1)
        after = rates(pair, u_1, u_2, law)
        columns.append((after[:, 0] - after[:, 1]) / (2 * step))
    return np.asarray(np.linalg.eigvals(np.stack(columns, axis=1)))
