"""Classical alternatives to the paper's law, from the same ``tracking`` observation to the same ``twist``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from tlf_env.onboard.rays import Rays
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S


class _Memoryless(ABC):
    """SB3's ``predict`` around a law from named entries (physical units) to a twist."""

    privileged = False

    def __init__(self, preview_s: tuple[float, ...], rays: Rays | None) -> None:
        entries = tracking_entries(preview_s, rays)
        self._places = {name: i for i, name in enumerate(entries)}
        self._scales = np.array([entry.scale for entry in entries.values()])

    @abstractmethod
    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Forward speed (mm/s) and yaw rate (rad/s) for entries ``(batch,)`` by name."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """``twist`` action for one ``tracking`` observation or a batch.

        Raises
        ------
        ValueError
            if the observation does not have the entries of ``tracking`` with this policy's previews and rays.
        """
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] != len(self._scales):
            raise ValueError(
                f"the observation has the shape {observation.shape}; this policy takes tracking "
                f"observations of {len(self._scales)} entries"
            )
        rows = (np.atleast_2d(observation) * self._scales).T
        forward, turn = self.twist({name: rows[i] for name, i in self._places.items()})
        action = np.stack([forward / FULL_SPEED_MM_S, turn / FULL_YAW_RATE_RAD_S], axis=-1)
        action = np.clip(action, -1.0, 1.0).astype(observation.dtype)
        return (action[0] if observation.ndim == 1 else action), state


class PurePursuit(_Memoryless):
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
    ) -> None:
        super().__init__(preview_s, rays)
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


class FeedbackLinearisation(_Memoryless):
    """Input–output linearisation of a point ``ahead_mm`` in front of the axle.

    Siciliano et al., "Robotics: modelling, planning and control", Springer 2009, section 11.6.2. The
    point can move in every direction, and its error decays with ``gain_per_s``.
    """

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        ahead_mm: float = 150.0,
        gain_per_s: float = 1.0,
        rays: Rays | None = None,
    ) -> None:
        super().__init__(preview_s, rays)
        self.ahead_mm = ahead_mm
        self.gain_per_s = gain_per_s

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The twist that gives the point the desired velocity."""
        b, sin, cos = self.ahead_mm, seen["sin_e_3"], seen["cos_e_3"]
        u_1, u_2 = seen["reference_u_1"], seen["reference_u_2"]
        forward = u_1 * cos - b * u_2 * sin + self.gain_per_s * (seen["e_1"] + b * (cos - 1.0))
        right = -u_1 * sin - b * u_2 * cos + self.gain_per_s * (seen["e_2"] - b * sin)
        return forward, -right / b
