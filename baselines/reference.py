"""The paper's tracking controller as a policy: a pure function of the ``tracking`` observation."""

from __future__ import annotations

from typing import Any

import numpy as np

from tlf_env.numerics.compiled import driver
from tlf_env.onboard.tracking import TrackingGains, gains_row, tracking_gains, tracking_twist
from tlf_env.task.drivers import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking

READ = ("e_1", "e_2", "sin_e_3", "cos_e_3", "reference_u_1", "reference_u_2")
COLUMNS = np.array([Tracking._fields.index(name) for name in READ])
SCALES = np.array([TRACKING_ENTRIES[name].scale for name in READ])


@driver
def _twists(rows: np.ndarray, gains: Any, out: np.ndarray) -> None:
    for i in range(rows.shape[0]):
        u_1, u_2 = tracking_twist(
            rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4], rows[i, 5], gains
        )
        out[i, 0] = u_1 / FULL_SPEED_MM_S
        out[i, 1] = u_2 / FULL_YAW_RATE_RAD_S


class ReferencePolicy:
    """Eqs (16)–(21) from the observation to a ``twist`` action, with the signature of SB3's ``predict``.

    Parameters
    ----------
    gains
        ``"consistent"`` (k₂ = 0.83·k₃), ``"printed"`` (k₂ = 0.83 mm²/s), or :class:`TrackingGains`.

    Raises
    ------
    ValueError
        for an unknown preset.
    """

    privileged = False

    def __init__(self, gains: str | TrackingGains = "consistent") -> None:
        self.gains = tracking_gains(gains) if isinstance(gains, str) else gains
        self._row = gains_row(self.gains)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Action for one ``tracking`` observation ``(entry,)`` or a batch ``(batch, entry)``.

        Returns the action, float32 within [−1, 1], and ``state`` unchanged: the law has no memory.

        Raises
        ------
        ValueError
            if the observation is not a ``tracking`` observation.
        """
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] < len(Tracking._fields):
            raise ValueError(
                f"the observation has the shape {observation.shape}; a tracking observation has at "
                f"least {len(Tracking._fields)} entries, in one row or a batch of rows"
            )
        rows = np.atleast_2d(observation)[:, COLUMNS] * SCALES
        action = np.empty((len(rows), 2))
        _twists(rows, self._row, action)
        action = np.clip(action, -1.0, 1.0).astype(np.float32)
        return (action[0] if observation.ndim == 1 else action), state
