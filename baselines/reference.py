"""The paper's tracking controller as a policy: a pure function of the ``tracking`` observation."""

from __future__ import annotations

from typing import Any

import numpy as np

from tlf_env.numerics.compiled import driver
from tlf_env.onboard.tracking import Gains, TrackingGains, gains_row, tracking_gains
from tlf_env.task.actions import ACTION_SIZE, limited, reference_action
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking

SCALES = np.array([entry.scale for entry in TRACKING_ENTRIES.values()])


@driver
def _actions(rows: np.ndarray, scales: np.ndarray, gains: Gains, out: np.ndarray) -> None:
    for i in range(rows.shape[0]):
        a_0, a_1 = reference_action(rows[i], scales, gains)
        out[i, 0], out[i, 1] = limited(a_0), limited(a_1)


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

        Returns the action, in the observation's dtype and within [−1, 1], and ``state`` unchanged:
        the law has no memory.

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
        rows = np.ascontiguousarray(np.atleast_2d(observation))
        action = np.empty((len(rows), ACTION_SIZE), dtype=rows.dtype)
        _actions(rows, SCALES, self._row, action)
        return (action[0] if observation.ndim == 1 else action), state
