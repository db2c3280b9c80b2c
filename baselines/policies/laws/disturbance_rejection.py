"""Active disturbance rejection: an observer on each robot estimates unexplained motion, which is subtracted."""

from __future__ import annotations

import numpy as np

from baselines.policies.laws.law import UNBOUNDED, ErrorBounds, LawFile, Remembering
from tlf_env.common.models import Positive
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.rejection import (
    Rejection,
    RejectionRow,
    RejectionState,
    observed_rejection,
    read_rejection_of,
    rejection_row,
    write_rejection_of,
)
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.onboard.tracking import linearised_twist
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
    on Industrial Electronics 56, 2009, pages 900 to 906. The authors of the paper used it before
    (Baquero-Suárez, Cortés-Romero, Arcos-Legarda and Coral-Enriquez, Multibody System Dynamics 45, 2019,
    pages 7 to 35). For a robot that slips, see Kang, Kim, Hyun and Park, International Journal of Advanced
    Robotic Systems 10, 2013.

    The observer of :mod:`tlf_env.onboard.rejection` finds the motion d that the wheels do not explain. With
    the errors z of the point ``ahead_mm`` = b in front of the axle and the velocity r of the reference's, the
    law is that of feedback linearisation, minus d:

        u₁ = r₁ + k z₁ − d₁,  u₂ = −(r₂ + k z₂)/b − d₂

    The observer sees the errors without bounds. Where the limiter subtracts the slip of the estimator, d is
    what the estimator misses. A controller's file has the same law as ``linearisation`` with ``rejection``.

    Parameters
    ----------
    ahead_mm, gain_per_s
        b and k.
    bandwidth_rad_s
        ω.
    most_slip_mm_s, most_slip_rad_s
        Bounds of the sizes of d₁ and d₂.
    """

    memory_size = len(RejectionState._fields)

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
        self.rejection = Rejection(
            bandwidth_rad_s=bandwidth_rad_s,
            most_slip_mm_s=most_slip_mm_s,
            most_slip_rad_s=most_slip_rad_s,
        )

    def step(
        self, seen: dict[str, np.ndarray], memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The twist of feedback linearisation minus the estimated disturbance."""
        out = np.empty((len(memory), 2))
        rows = np.stack([seen[name] for name in NEEDED], axis=-1)
        row = rejection_row(self.rejection, self.period_s)
        _twists(rows, self.ahead_mm, self.gain_per_s, row, memory.T, out)
        return out[:, 0], out[:, 1]


@driver
def _twists(
    rows: np.ndarray,
    ahead: float,
    gain: float,
    row: RejectionRow,
    memory: np.ndarray,
    out: np.ndarray,
) -> None:
    for i in range(rows.shape[0]):
        e_1, e_2, whole_1, whole_2, sin, cos, ref_1, ref_2, now_1, now_2, u_1, u_2 = rows[i]
        before = read_rejection_of(memory, i)
        after = observed_rejection(
            before, row, ahead, whole_1, whole_2, sin, cos, now_1, now_2, u_1, u_2
        )
        v_1, v_2 = linearised_twist(e_1, e_2, sin, cos, ref_1, ref_2, ahead, gain)
        out[i, 0], out[i, 1] = v_1 - after.d_1, v_2 - after.d_2
        write_rejection_of(memory, i, after)
