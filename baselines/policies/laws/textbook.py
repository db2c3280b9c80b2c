"""Tracking laws of textbooks: pure pursuit, feedback linearisation, and Kanayama's law."""

from __future__ import annotations

import math

import numpy as np

from baselines.policies.laws.law import UNBOUNDED, ErrorBounds, LawFile, Memoryless
from tlf_env.common.models import Positive
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.onboard.tracking import linearised_twist
from tlf_env.task.scenario import DEFAULT_PREVIEW_S


class PurePursuitFile(LawFile):
    """Parameters of :class:`PurePursuit` in a file; None: its default."""

    gain_per_s: Positive | None = None


class PurePursuit(Memoryless):
    """Steer along the circle through the robot's position and a later position of its reference.

    Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992. The
    speed is the reference's plus ``gain_per_s`` times the forward error. The later position is the
    observation's first preview (by default 0.5 s ahead).

    Raises
    ------
    ValueError
        if there is no preview, or the first is at 0 s.
    """

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        gain_per_s: float = 0.23,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        if not preview_s or preview_s[0] <= 0:
            raise ValueError(
                f"pure pursuit needs a first preview above 0, got preview_s {preview_s}"
            )
        self.gain_per_s = gain_per_s
        self._ahead = f"in_{preview_s[0]:g}_s"

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Speed and curvature of the pursuit circle, 2·lateral/distance²."""
        forward, right = seen[f"forward_{self._ahead}"], seen[f"right_{self._ahead}"]
        speed = seen["reference_u_1"] + self.gain_per_s * seen["e_1"]
        distance_2 = forward**2 + right**2
        curvature = np.divide(
            -2.0 * right, distance_2, out=np.zeros_like(right), where=distance_2 > 1.0
        )
        return speed, curvature * np.abs(speed)


_LINEARISED_FROM = ("e_1", "e_2", "sin_e_3", "cos_e_3", "reference_u_1", "reference_u_2")


@driver
def _linearised(
    seen: np.ndarray, ahead: float, decay: float, forward: np.ndarray, yaw_rate: np.ndarray
) -> None:
    """The law of each column of ``seen``, whose rows are errors and the reference's twist."""
    for i in range(seen.shape[1]):
        forward[i], yaw_rate[i] = linearised_twist(
            seen[0, i], seen[1, i], seen[2, i], seen[3, i], seen[4, i], seen[5, i], ahead, decay
        )


class FeedbackLinearisationFile(LawFile):
    """Parameters of :class:`FeedbackLinearisation` in a file; None: its default."""

    ahead_mm: Positive | None = None
    gain_per_s: Positive | None = None


class FeedbackLinearisation(Memoryless):
    """Input–output linearisation of a point ``ahead_mm`` in front of the axle.

    The law of :func:`tlf_env.onboard.tracking.linearised_twist`, with its source there. The error of the point
    decays with ``gain_per_s``.
    """

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        ahead_mm: float = 150.0,
        gain_per_s: float = 1.0,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        self.ahead_mm = ahead_mm
        self.gain_per_s = gain_per_s

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The twist that gives the point the desired velocity."""
        forward, yaw_rate = np.empty_like(seen["e_1"]), np.empty_like(seen["e_1"])
        _linearised(
            np.stack([seen[name] for name in _LINEARISED_FROM]),
            self.ahead_mm,
            self.gain_per_s,
            forward,
            yaw_rate,
        )
        return forward, yaw_rate


class KanayamaFile(LawFile):
    """Parameters of :class:`Kanayama` in a file; None: its default."""

    k_x_per_s: Positive | None = None
    k_y_per_mm2: Positive | None = None
    k_theta_per_mm: Positive | None = None


class Kanayama(Memoryless):
    """A stable tracking law whose correction of the heading grows with the reference's speed.

    Kanayama, Kimura, Miyazaki and Noguchi, "A stable tracking control method for an autonomous mobile
    robot", IEEE International Conference on Robotics and Automation 1990, pages 384 to 389. The default
    gains are those of the paper: 10 1/s and 0.0064 1/cm², and ``k_theta`` by its rule of critical damping,
    2·√``k_y`` (0.16 1/cm). Small lateral errors then decay over a distance, whatever the speed.
    """

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        k_x_per_s: float = 10.0,
        k_y_per_mm2: float = 6.4e-5,
        k_theta_per_mm: float | None = None,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        self.k_x_per_s = k_x_per_s
        self.k_y_per_mm2 = k_y_per_mm2
        critical = 2.0 * math.sqrt(k_y_per_mm2)
        self.k_theta_per_mm = critical if k_theta_per_mm is None else k_theta_per_mm

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The paper's law, with the lateral error counted to the right."""
        u_1, u_2 = seen["reference_u_1"], seen["reference_u_2"]
        forward = u_1 * seen["cos_e_3"] + self.k_x_per_s * seen["e_1"]
        bend = self.k_theta_per_mm * seen["sin_e_3"] - self.k_y_per_mm2 * seen["e_2"]
        return forward, u_2 + u_1 * bend
