"""Classical alternatives to the paper's law, from the same ``tracking`` observation to the same ``twist``."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from tlf_env.common.errors import one_line
from tlf_env.common.models import Frozen, Positive
from tlf_env.common.presets import preset_names, preset_or_file, read_preset_or_file
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.limiter import (
    TwistLimits,
    TwistLimitsRow,
    braked,
    saturated,
    twist_limits_row,
)
from tlf_env.onboard.rays import Rays
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S


class ErrorBounds(Frozen):
    """Bounds on the position errors that a law sees, as those of the controller ``tuned``; None: no bound."""

    braking_error_mm: Positive | None = None  # w: e₁ beyond w becomes √(w(2e₁ − w))
    forward_error_mm: Positive | None = None  # E: then e₁ becomes E·tanh(e₁/E)
    lateral_error_mm: Positive | None = None  # the same for e₂


UNBOUNDED = ErrorBounds()
BOUNDS = tuple(ErrorBounds.model_fields)


class PurePursuitFile(ErrorBounds):
    """Parameters of :class:`PurePursuit` in a file; None: its default."""

    gain_per_s: Positive | None = None


class FeedbackLinearisationFile(ErrorBounds):
    """Parameters of :class:`FeedbackLinearisation` in a file; None: its default."""

    ahead_mm: Positive | None = None
    gain_per_s: Positive | None = None


class KanayamaFile(ErrorBounds):
    """Parameters of :class:`Kanayama` in a file; None: its default."""

    k_x_per_s: Positive | None = None
    k_y_per_mm2: Positive | None = None
    k_theta_per_mm: Positive | None = None


@driver
def _bounded(errors: np.ndarray, bounds: TwistLimitsRow) -> None:
    """Bound the errors e₁, e₂ (mm) of each row, in place."""
    for i in range(errors.shape[0]):
        errors[i, 0] = saturated(braked(errors[i, 0], bounds.braking_error), bounds.forward_error)
        errors[i, 1] = saturated(errors[i, 1], bounds.lateral_error)


class Memoryless(ABC):
    """SB3's ``predict`` around a law from named entries (physical units) to a twist."""

    privileged = False
    files: tuple[Path, ...] = ()  # where its parameters are from

    def __init__(
        self,
        preview_s: tuple[float, ...],
        rays: Rays | None,
        bounds: ErrorBounds,
    ) -> None:
        entries = tracking_entries(preview_s, rays)
        self._places = {name: i for i, name in enumerate(entries)}
        self.scales = np.array([entry.scale for entry in entries.values()])
        self._preview_s = preview_s
        self._bounds: TwistLimitsRow | None = None
        if bounds != UNBOUNDED:
            self._bounds = twist_limits_row(TwistLimits(**bounds.model_dump()), 1.0)

    @abstractmethod
    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Forward speed (mm/s) and yaw rate (rad/s) for entries ``(batch,)`` by name."""

    def wanted(self, observation: np.ndarray, lead_s: float = 0.0) -> np.ndarray:
        """The law's twists ``(row, 2)`` in mm/s and rad/s, for one observation or a batch.

        Parameters
        ----------
        lead_s
            The law takes the reference's twist of this much later, interpolated to the first preview.

        Raises
        ------
        ValueError
            if the observation does not have the entries of ``tracking`` with this policy's previews and rays.
        """
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] != len(self.scales):
            raise ValueError(
                f"the observation has the shape {observation.shape}; this policy takes tracking "
                f"observations of {len(self.scales)} entries"
            )
        rows = (np.atleast_2d(observation) * self.scales).T
        seen = {name: rows[i] for name, i in self._places.items()}
        if self._bounds is not None:
            errors = np.stack([seen["e_1"], seen["e_2"]], axis=-1)
            _bounded(errors, self._bounds)
            seen["e_1"], seen["e_2"] = errors.T
        if lead_s:
            later = f"in_{self._preview_s[0]:g}_s"
            share = lead_s / self._preview_s[0]
            for name in ("u_1", "u_2"):
                now = seen[f"reference_{name}"]
                seen[f"reference_{name}"] = now + share * (seen[f"{name}_{later}"] - now)
        return np.stack(self.twist(seen), axis=-1)

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
            as :meth:`wanted`.
        """
        observation = np.asarray(observation)
        action = self.wanted(observation) / (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)
        action = np.clip(action, -1.0, 1.0).astype(observation.dtype)
        return (action[0] if observation.ndim == 1 else action), state


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
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, bounds)
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


class FeedbackLinearisation(Memoryless):
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
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, bounds)
        self.ahead_mm = ahead_mm
        self.gain_per_s = gain_per_s

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The twist that gives the point the desired velocity."""
        b, sin, cos = self.ahead_mm, seen["sin_e_3"], seen["cos_e_3"]
        u_1, u_2 = seen["reference_u_1"], seen["reference_u_2"]
        forward = u_1 * cos - b * u_2 * sin + self.gain_per_s * (seen["e_1"] + b * (cos - 1.0))
        right = -u_1 * sin - b * u_2 * cos + self.gain_per_s * (seen["e_2"] - b * sin)
        return forward, -right / b


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
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, bounds)
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


CLASSICAL: dict[str, tuple[type[Memoryless], type[ErrorBounds]]] = {
    "pure_pursuit": (PurePursuit, PurePursuitFile),
    "feedback_linearisation": (FeedbackLinearisation, FeedbackLinearisationFile),
    "kanayama": (Kanayama, KanayamaFile),
}


def classical_names() -> list[str]:
    """Names of the classical laws: with their default parameters, and with each preset of parameters."""
    return [*CLASSICAL, *(f"{law}:{name}" for law in CLASSICAL for name in preset_names(law))]


def make_classical(
    law: str, parameters: str, preview_s: tuple[float, ...], rays: Rays | None
) -> Memoryless:
    """A classical law.

    Parameters
    ----------
    law
        A name of :data:`CLASSICAL`.
    parameters
        A preset (``configs/laws/LAW``) or the path of a ``.yaml`` file; empty: the default parameters.

    Raises
    ------
    ValueError
        in one line, if there is no such preset or file, a key or value in it is not allowed, or the law
        lacks a preview.
    """
    kind, model = CLASSICAL[law]
    given: dict[str, Any] = {}
    if parameters:
        try:
            file = model.model_validate(read_preset_or_file(law, parameters))
        except ValidationError as error:
            raise ValueError(f"{parameters}: {one_line(error, model)}") from error
        given = file.model_dump(exclude_none=True)
    bounds = ErrorBounds(**{name: given.pop(name) for name in BOUNDS if name in given})
    made = kind(preview_s, rays=rays, bounds=bounds, **given)
    path = preset_or_file(law, parameters)
    made.files = () if path is None else (path,)
    return made
