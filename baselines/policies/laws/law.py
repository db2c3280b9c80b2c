"""What all tracking laws share: the entries that a law sees, bounds on errors, memory, and ``predict``."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.policies.memory import next_memory
from tlf_env.common.models import Frozen, Positive
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.limiter import (
    TwistLimits,
    TwistLimitsRow,
    braked,
    saturated,
    twist_limits_row,
)
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.sources import DEFAULT_CONTROL_PERIOD_S


class ErrorBounds(Frozen):
    """Bounds on the position errors that a law sees, as those of the controller ``tuned``; None: no bound."""

    braking_error_mm: Positive | None = None  # w: e₁ beyond w becomes √(w(2e₁ − w))
    forward_error_mm: Positive | None = None  # E: then e₁ becomes E·tanh(e₁/E)
    lateral_error_mm: Positive | None = None  # the same for e₂


UNBOUNDED = ErrorBounds()


class LawFile(ErrorBounds):
    """What the parameter file of any law may have."""

    found: dict[str, Any] | None = None  # how a search found it; not used


@driver
def _bounded(errors: np.ndarray, bounds: TwistLimitsRow) -> None:
    """Bound the errors e₁, e₂ (mm) of each row, in place."""
    for i in range(errors.shape[0]):
        errors[i, 0] = saturated(braked(errors[i, 0], bounds.braking_error), bounds.forward_error)
        errors[i, 1] = saturated(errors[i, 1], bounds.lateral_error)


@driver
def _angles(sines: np.ndarray, cosines: np.ndarray, out: np.ndarray) -> None:
    for i in range(out.shape[0]):
        out[i] = math.atan2(sines[i], cosines[i])


def angles(sines: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Angles (rad) of sines and cosines, with the same bits for a row in every batch."""
    out = np.empty(len(sines))
    _angles(np.ascontiguousarray(sines), np.ascontiguousarray(cosines), out)
    return out


class Law(ABC):
    """SB3's ``predict`` around a law from named entries (physical units) to a twist.

    Besides the entries of the observation, a law sees for each robot

    - ``whole_e_1``, ``whole_e_2``: the position errors without bounds; ``e_1`` and ``e_2`` are bounded.
    - ``present_u_1``, ``present_u_2``: the reference's twist without lead.
    - ``granted_u_1``, ``granted_u_2``: the part of its last wanted twist that was commanded, mm/s and
      rad/s. Where the limiter subtracts the slip, that is the last command plus the estimated slip.
    - ``turned_u_1``, ``turned_u_2``: the part that the wheels turned, likewise from the odometry.
    - ``left_slip_1``, ``left_slip_2``: the estimated slip that nothing behind the law subtracts.
    """

    privileged = False
    scenario_overrides: Mapping[str, Any] = {}  # scenario fields that it asks for
    period_s = DEFAULT_CONTROL_PERIOD_S  # control period, for laws with a memory
    files: tuple[Path, ...] = ()  # what it is made from, besides the file of its class

    def __init__(
        self,
        preview_s: tuple[float, ...],
        rays: Rays | None,
        neighbour: Neighbour | None,
        bounds: ErrorBounds,
    ) -> None:
        entries = tracking_entries(preview_s, rays, neighbour)
        self._places = {name: i for i, name in enumerate(entries)}
        self.scales = np.array([entry.scale for entry in entries.values()])
        self._preview_s = preview_s
        self._bounds: TwistLimitsRow | None = None
        if bounds != UNBOUNDED:
            self._bounds = twist_limits_row(TwistLimits(**bounds.model_dump()), 1.0)

    def place(self, entry: str) -> int:
        """The place of an entry in the observation; −1 if it has none."""
        return self._places.get(entry, -1)

    @abstractmethod
    def advance(
        self, seen: dict[str, np.ndarray], state: Any, episode_start: np.ndarray | None
    ) -> tuple[tuple[np.ndarray, np.ndarray], Any]:
        """Forward speed (mm/s) and yaw rate (rad/s) for entries ``(row,)`` by name, and the next state."""

    def wanted(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        *,
        lead_s: float = 0.0,
        slip_cancelled: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """The law's twists ``(row, 2)`` in mm/s and rad/s for one observation or a batch, and its next state.

        Parameters
        ----------
        state
            What the last call returned; None at the start.
        episode_start
            True for the rows ``(row,)`` whose state is reset first. None: no row.
        lead_s
            The law takes the reference's twist of this much later, interpolated to the first preview.
        slip_cancelled
            Whether the estimated slip is subtracted from the twist before it is commanded.

        Raises
        ------
        ValueError
            if the observation does not have the entries of ``tracking`` with this policy's previews, rays
            and neighbour, or the state is not that of a call with as many rows.
        """
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] != len(self.scales):
            raise ValueError(
                f"the observation has the shape {observation.shape}; this policy takes tracking "
                f"observations of {len(self.scales)} entries"
            )
        rows = (np.atleast_2d(observation) * self.scales).T
        seen = {name: rows[i] for name, i in self._places.items()}
        seen["whole_e_1"], seen["whole_e_2"] = seen["e_1"], seen["e_2"]
        if self._bounds is not None:
            errors = np.stack([seen["e_1"], seen["e_2"]], axis=-1)
            _bounded(errors, self._bounds)
            seen["e_1"], seen["e_2"] = errors.T
        seen["present_u_1"], seen["present_u_2"] = seen["reference_u_1"], seen["reference_u_2"]
        if lead_s:
            later = f"in_{self._preview_s[0]:g}_s"
            share = lead_s / self._preview_s[0]
            for name in ("u_1", "u_2"):
                now = seen[f"reference_{name}"]
                seen[f"reference_{name}"] = now + share * (seen[f"{name}_{later}"] - now)
        for i in (1, 2):
            command, slip = seen[f"command_u_{i}"], seen[f"slip_{i}"]
            seen[f"granted_u_{i}"] = command + slip if slip_cancelled else command
            odometry = seen[f"odometry_u_{i}"]
            seen[f"turned_u_{i}"] = odometry + slip if slip_cancelled else odometry
            seen[f"left_slip_{i}"] = np.zeros_like(slip) if slip_cancelled else slip
        twist, state = self.advance(seen, state, episode_start)
        return np.stack(twist, axis=-1), state

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """``twist`` action for one ``tracking`` observation or a batch, and the next state.

        Raises
        ------
        ValueError
            as :meth:`wanted`.
        """
        observation = np.asarray(observation)
        wanted, state = self.wanted(observation, state, episode_start)
        action = wanted / (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)
        action = np.clip(action, -1.0, 1.0).astype(observation.dtype)
        return (action[0] if observation.ndim == 1 else action), state


class Memoryless(Law):
    """A law whose twist depends on the present observation only; its state is passed through."""

    @abstractmethod
    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Forward speed (mm/s) and yaw rate (rad/s) for entries ``(row,)`` by name."""

    def advance(
        self, seen: dict[str, np.ndarray], state: Any, episode_start: np.ndarray | None
    ) -> tuple[tuple[np.ndarray, np.ndarray], Any]:
        """The twist, and the state unchanged."""
        return self.twist(seen), state


class Remembering(Law):
    """A law with a memory of some numbers for each robot; its state is an array ``(row, number)``."""

    memory_size: int

    @abstractmethod
    def step(
        self, seen: dict[str, np.ndarray], memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Speed and yaw rate as for :meth:`Memoryless.twist`.

        Parameters
        ----------
        memory
            ``(row, memory_size)``, to be changed in place; 0 in rows without a past.
        """

    def advance(
        self, seen: dict[str, np.ndarray], state: Any, episode_start: np.ndarray | None
    ) -> tuple[tuple[np.ndarray, np.ndarray], Any]:
        """The twist, and the next memory; the given one is not changed."""
        memory = next_memory(state, (len(seen["e_1"]), self.memory_size), episode_start)
        return self.step(seen, memory), memory
