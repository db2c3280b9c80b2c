"""Reference trajectories of the leader, with exact first and second derivatives.

Every trajectory is a sum of sinusoids per axis, so that its derivatives are sums of sinusoids too.
Heading as in the paper: θ* = atan2(−ẋ*, ẏ*), 0 facing +y, unwrapped over time.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from tlf_env.physics.parameters import Frozen, Positive

REFERENCE_COLUMNS = ("x_mm", "y_mm", "theta_rad", "u_1_mm_s", "u_2_rad_s")


class Sinusoid(NamedTuple):
    """amplitude · sin(rate · t + phase)."""

    amplitude_mm: float
    rate_rad_s: float
    phase_rad: float


def _derivative(terms: list[Sinusoid], t_s: np.ndarray, order: int) -> np.ndarray:
    total = np.zeros_like(t_s)
    for term in terms:
        phase = term.rate_rad_s * t_s + term.phase_rad + order * np.pi / 2
        total += term.amplitude_mm * term.rate_rad_s**order * np.sin(phase)
    return total


class _Harmonic(Frozen):
    centre_x_mm: FiniteFloat = 0.0
    centre_y_mm: FiniteFloat = 0.0

    @abstractmethod
    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """The terms of x and of y about the centre."""

    def derivatives(self, t_s: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration: ``(3, 2, ...)`` in mm, mm/s, mm/s²."""
        t_s = np.asarray(t_s, dtype=np.float64)
        axes = self.sinusoids()
        out = np.array([[_derivative(terms, t_s, order) for terms in axes] for order in range(3)])
        out[0, 0] += self.centre_x_mm
        out[0, 1] += self.centre_y_mm
        return out


class Lissajous(_Harmonic):
    """x = A sin(a t + α) + x₀, y = B sin(b t + β) + y₀. The paper's ∞ is eq. (52): A = B, b = 2a."""

    type: Literal["lissajous"] = "lissajous"
    amplitude_x_mm: Positive
    amplitude_y_mm: Positive
    rate_x_rad_s: Positive
    rate_y_rad_s: Positive
    phase_x_rad: FiniteFloat = 0.0
    phase_y_rad: FiniteFloat = 0.0

    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """One term per axis."""
        return (
            [Sinusoid(self.amplitude_x_mm, self.rate_x_rad_s, self.phase_x_rad)],
            [Sinusoid(self.amplitude_y_mm, self.rate_y_rad_s, self.phase_y_rad)],
        )


class Rose(_Harmonic):
    """x = A cos(k s) sin s + x₀, y = −B cos(k s) cos s + y₀, s = 2πt/period. Eq. (53): k = 2, 120 s."""

    type: Literal["rose"] = "rose"
    amplitude_x_mm: Positive
    amplitude_y_mm: Positive
    petals_k: Positive = 2.0
    period_s: Positive

    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """Two terms per axis: the products of eq. (53) as sums."""
        rate = 2 * np.pi / self.period_s
        fast, slow = (self.petals_k + 1) * rate, (self.petals_k - 1) * rate
        half_x, half_y = self.amplitude_x_mm / 2, self.amplitude_y_mm / 2
        return (
            [Sinusoid(half_x, fast, 0.0), Sinusoid(-half_x, slow, 0.0)],
            [Sinusoid(-half_y, fast, np.pi / 2), Sinusoid(-half_y, slow, np.pi / 2)],
        )


Trajectory = Annotated[Lissajous | Rose, Field(discriminator="type")]


def sample(trajectory: Lissajous | Rose, t_s: np.ndarray) -> np.ndarray:
    """Reference pose and twist ``(len(t_s), 5)``, columns as in :data:`REFERENCE_COLUMNS`.

    ``t_s`` is increasing; the heading is unwrapped along it. u₁* = √(ẋ² + ẏ²) and
    u₂* = θ̇* = (ẋÿ − ẏẍ)/u₁*², 0 where the reference stands still.
    """
    (x, y), (v_x, v_y), (a_x, a_y) = trajectory.derivatives(t_s)
    speed_2 = v_x**2 + v_y**2
    turn = np.divide(v_x * a_y - v_y * a_x, speed_2, out=np.zeros_like(speed_2), where=speed_2 > 0)
    theta = np.unwrap(np.arctan2(-v_x, v_y))
    return np.stack([x, y, theta, np.sqrt(speed_2), turn], axis=-1)
