"""The reference controllers as a policy, from the ``tracking`` observation and the state of its law, if any."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.policies.columns import find_columns
from baselines.policies.memory import next_memory
from tlf_env.common.presets import is_file_name
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.controllers import controller_for, load_controller
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER
from tlf_env.onboard.rejection import RejectionState, read_rejection_of, write_rejection_of
from tlf_env.onboard.supervisor import Neighbour, Supervisor, SupervisorRow, supervisor_row
from tlf_env.onboard.tracking import (
    Controller,
    ControllerRow,
    TrackingGains,
    controller_row,
)
from tlf_env.task.actions import ACTION_SIZE, allowed_twist, twist_action, wanted_twist
from tlf_env.task.observation import NEIGHBOUR_ENTRIES, Tracking, tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S
from tlf_env.task.sources import DEFAULT_CONTROL_PERIOD_S


@driver
def _actions(
    rows: np.ndarray,
    scales: np.ndarray,
    row: ControllerRow,
    supervisor: SupervisorRow,
    memory: np.ndarray,
    out: np.ndarray,
) -> None:
    for i in range(rows.shape[0]):
        before = read_rejection_of(memory, i)
        u_1, u_2, after = wanted_twist(rows[i], scales, row, before)
        write_rejection_of(memory, i, after)
        u_1, u_2 = allowed_twist(rows[i], scales, row, supervisor, u_1, u_2)
        out[i, 0], out[i, 1] = twist_action(rows[i], scales, row, u_1, u_2)


class ReferencePolicy:
    """A controller's law and limits, from the observation to a ``twist`` action, as SB3's ``predict``.

    Parameters
    ----------
    gains
        A preset or the path of a controller file (``.yaml``), :class:`TrackingGains` or
        :class:`Controller`. Presets: ``"linearised"``, the default (feedback linearisation behind limits on
        the twist); the paper's law, eqs (16)–(21), with its gains ``"consistent"`` (k₂ = 0.83·k₃) or
        ``"printed"`` (k₂ = 0.83 mm²/s); ``"tuned"`` (the paper's law with other gains, and limits).
    control_period_s
        Control period, s; needed for the limits on accelerations.
    preview_s
        The scenario's previews, s; a lead is computed from the first.
    supervisor
        Slows the robot down for its neighbour, whose entries the observation then has to have. None: does
        not.

    Raises
    ------
    ValueError
        for an unknown preset, an invalid file, and a lead without a first preview above 0; the default
        controller goes without its lead there.
    """

    privileged = False
    # The fields that a preset or a controller file asks for, of the estimator and the broadcasts.
    scenario_overrides: Mapping[str, Any] = {}

    def __init__(
        self,
        gains: str | TrackingGains | Controller = DEFAULT_CONTROLLER,
        control_period_s: float = DEFAULT_CONTROL_PERIOD_S,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        supervisor: Supervisor | None = None,
    ) -> None:
        self.files: tuple[Path, ...] = ()
        asked: dict[str, Any] = {}
        if isinstance(gains, str):
            self.controller = controller_for(gains, preview_s)
            asked = load_controller(gains).scenario_overrides
            self.files = (Path(gains),) if is_file_name(gains) else ()
        elif isinstance(gains, TrackingGains):
            self.controller = Controller(gains=gains)
        else:
            self.controller = gains
        self._row = controller_row(self.controller, control_period_s, preview_s)
        # The law takes the fields of Tracking and, for a lead, the first preview, in this order.
        names = list(Tracking._fields)
        if self.controller.lead_s:
            now = tracking_entries(())
            names += [name for name in tracking_entries(preview_s[:1]) if name not in now]
        entries = tracking_entries(preview_s)
        self.supervisor = supervisor
        self._supervisor_row = supervisor_row(supervisor, len(names))
        if supervisor is not None:
            names += NEIGHBOUR_ENTRIES
            entries = tracking_entries(preview_s, neighbour=Neighbour())
        self._columns = find_columns(names, entries)
        self._preview_s = tuple(preview_s)
        self._needed = int(self._columns.places.max()) + 1
        self._scales = np.array([entries[name].scale for name in names])
        if supervisor is not None:
            asked = {"neighbour": Neighbour().model_dump()} | asked
        self.scenario_overrides = asked

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Action for one ``tracking`` observation ``(entry,)`` or a batch ``(batch, entry)``.

        Returns the action, in the observation's dtype and within [−1, 1], and the next state: ``state``
        unchanged, or for a law with ``rejection`` what its observer keeps, ``(row, 7)``. Without the last
        state such a law starts anew and subtracts nothing.

        Raises
        ------
        ValueError
            if the observation is not a ``tracking`` observation, or the state is of another number of rows.
        """
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] < self._needed:
            raise ValueError(
                f"the observation has the shape {observation.shape}; a tracking observation with "
                f"preview_s {self._preview_s} has at least {self._needed} entries, in one row or a batch "
                "of rows"
            )
        rows = np.atleast_2d(observation)
        if not self._columns.leading:
            rows = self._columns.take(rows)
        rows = np.ascontiguousarray(rows)
        action = np.empty((len(rows), ACTION_SIZE), dtype=rows.dtype)
        remembers = self._row.rejection.at_once > 0.0
        shape = (len(rows), len(RejectionState._fields))
        memory = next_memory(state, shape, episode_start) if remembers else np.zeros(shape)
        _actions(rows, self._scales, self._row, self._supervisor_row, memory.T, action)
        if remembers:
            state = memory
        return (action[0] if observation.ndim == 1 else action), state
