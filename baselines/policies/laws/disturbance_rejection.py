"""Active disturbance rejection: an observer on each robot estimates unexplained motion, which is subtracted."""

from __future__ import annotations

import math

import numpy as np

from baselines.policies.laws.law import UNBOUNDED, ErrorBounds, LawFile, Remembering
from tlf_env.common.models import Positive
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.task.scenario import DEFAULT_PREVIEW_S

NEEDED = (
    "e_1",
    "e_2",
    "whole_e_1",
    "whole_e_2",
    "sin_e_3",
    "cos_e_3",
    "reference_u_1",
    "reference_u_2",
    "present_u_1",
    "present_u_2",
    "turned_u_1",
    "turned_u_2",
)  # what the law sees, in the order of the columns of _twists


class DisturbanceRejectionFile(LawFile):
    """Parameters of :class:`DisturbanceRejection` in a file; None: its default."""

    ahead_mm: Positive | None = None
    gain_per_s: Positive | None = None
    bandwidth_rad_s: Positive | None = None
    most_slip_mm_s: Positive | None = None
    most_slip_rad_s: Positive | None = None


class DisturbanceRejection(Remembering):
    """Feedback linearisation with a linear extended state observer on each robot.

    Active disturbance rejection: Han, "From PID to active disturbance rejection control", IEEE Transactions
    on Industrial Electronics 56, 2009, pages 900 to 906; with an observer of one bandwidth: Gao, "Scaling and
    bandwidth-parameterization based controller tuning", American Control Conference 2003, pages 4989 to 4996.
    The authors of the paper used it before (Baquero-Suárez, Cortés-Romero, Arcos-Legarda and Coral-Enriquez,
    Multibody System Dynamics 45, 2019, pages 7 to 35). For a robot that slips, see Kang, Kim, Hyun and Park,
    International Journal of Advanced Robotic Systems 10, 2013.

    The point ``ahead_mm`` = b in front of the axle has the errors z = (e₁ + b(cos e₃ − 1), e₂ − b sin e₃). If
    the reference's point moves with r in the robot's axes (forward, right), then

        ż₁ = r₁ − (u₁ + d₁) − u₂ z₂,  ż₂ = r₂ + b (u₂ + d₂) + u₂ z₁

    where u is the twist by the wheels, mean over the last step, and d all motion that it does not explain.
    (With the command in place of the wheels, a motor at its largest torque would pass for slip, and the
    law would ask for more.) The observer predicts z and holds d over a control period T, and corrects both by
    the observed z with the gains 1 − β² and (1 − β)²/T, β = exp(−ωT), so that both its poles are at β
    (Miklosovic, Radke and Gao, American Control Conference 2006). The law is that of feedback linearisation,
    minus d:

        u₁ = r₁ + k z₁ − d₁,  u₂ = −(r₂ + k z₂)/b − d₂

    The observer sees the errors without bounds. Where the limiter subtracts the slip of the estimator, d is
    what the estimator misses.

    Parameters
    ----------
    ahead_mm, gain_per_s
        b and k.
    bandwidth_rad_s
        ω.
    most_slip_mm_s, most_slip_rad_s
        Bounds of the sizes of d₁ and d₂.
    """

    memory_size = 6  # z, d, and the last r

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        ahead_mm: float = 80.0,
        gain_per_s: float = 1.3,
        bandwidth_rad_s: float = 6.0,
        most_slip_mm_s: float = 120.0,
        most_slip_rad_s: float = 0.9,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        self.ahead_mm, self.gain_per_s = ahead_mm, gain_per_s
        self.bandwidth_rad_s = bandwidth_rad_s
        self.most_slip_mm_s, self.most_slip_rad_s = most_slip_mm_s, most_slip_rad_s

    def step(
        self, seen: dict[str, np.ndarray], memory: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The twist of feedback linearisation minus the estimated disturbance."""
        out = np.empty((len(memory), 2))
        _twists(
            np.stack([seen[name] for name in NEEDED], axis=-1),
            fresh,
            self.ahead_mm,
            self.gain_per_s,
            self.bandwidth_rad_s,
            self.period_s,
            self.most_slip_mm_s,
            self.most_slip_rad_s,
            memory,
            out,
        )
        return out[:, 0], out[:, 1]


@driver
def _twists(
    rows: np.ndarray,
    fresh: np.ndarray,
    b: float,
    gain: float,
    bandwidth: float,
    period: float,
    most_1: float,
    most_2: float,
    memory: np.ndarray,
    out: np.ndarray,
) -> None:
    beta = math.exp(-bandwidth * period)
    at_once, over_time = 1.0 - beta * beta, (1.0 - beta) ** 2 / period
    for i in range(rows.shape[0]):
        e_1, e_2, whole_1, whole_2, sin, cos, ref_1, ref_2, now_1, now_2, u_1, u_2 = rows[i]
        r_1, r_2 = now_1 * cos - b * now_2 * sin, -now_1 * sin - b * now_2 * cos
        seen_1, seen_2 = whole_1 + b * (cos - 1.0), whole_2 - b * sin
        z_1, z_2, d_1, d_2, last_1, last_2 = memory[i]
        if fresh[i]:
            z_1, z_2, d_1, d_2 = seen_1, seen_2, 0.0, 0.0
        else:
            # Half of the motion, the turn of the axes, and the other half.
            half_1 = 0.5 * period * (0.5 * (last_1 + r_1) - u_1 - d_1)
            half_2 = 0.5 * period * (0.5 * (last_2 + r_2) + b * (u_2 + d_2))
            sin_turn, cos_turn = math.sin(u_2 * period), math.cos(u_2 * period)
            z_1, z_2 = z_1 + half_1, z_2 + half_2
            z_1, z_2 = cos_turn * z_1 - sin_turn * z_2, sin_turn * z_1 + cos_turn * z_2
            z_1, z_2 = z_1 + half_1, z_2 + half_2
            missed_1, missed_2 = seen_1 - z_1, seen_2 - z_2
            z_1, z_2 = z_1 + at_once * missed_1, z_2 + at_once * missed_2
            d_1 = min(max(d_1 - over_time * missed_1, -most_1), most_1)
            d_2 = min(max(d_2 + over_time * missed_2 / b, -most_2), most_2)
        memory[i] = z_1, z_2, d_1, d_2, r_1, r_2
        error_1, error_2 = e_1 + b * (cos - 1.0), e_2 - b * sin
        forward = ref_1 * cos - b * ref_2 * sin + gain * error_1
        right = -ref_1 * sin - b * ref_2 * cos + gain * error_2
        out[i, 0], out[i, 1] = forward - d_1, -right / b - d_2
