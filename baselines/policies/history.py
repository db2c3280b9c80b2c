"""A learned policy's history: earlier observations that its network sees beside the present one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from baselines.policies.columns import find_columns
from baselines.policies.memory import next_memory
from tlf_env.common.models import Frozen, Whole


class History(Frozen):
    """Which earlier observations a network sees, beside the present one.

    Each of them is the mean over ``mean_of`` control steps; the first of them begins at the start of the
    episode, the next one where the last ended. A mean is there once its last step is over; until then it is 0.
    A ``tracking`` observation contains the robot's last action.
    """

    observations: Annotated[Whole, Field(ge=0, le=64)]  # the newest first; 0: none
    mean_of: Annotated[Whole, Field(ge=1, le=1000)] = 1  # control steps; 1: plain observations
    # Names of the entries that are kept; None: all.
    entries: Annotated[tuple[str, ...], Field(min_length=1)] | None = None

    def places(self, names: Iterable[str]) -> np.ndarray:
        """Columns of the kept entries in an observation with these entries.

        Raises
        ------
        ValueError
            naming the first kept entry that the observation lacks, or that is named twice.
        """
        offered = list(names)
        kept = offered if self.entries is None else list(self.entries)
        for name in kept:
            if kept.count(name) > 1:
                raise ValueError(f"history.entries has {name!r} twice")
        try:
            return find_columns(kept, offered).places
        except ValueError as error:
            raise ValueError(f"history.entries: {error}") from error

    def size(self, entries: int) -> int:
        """Entries of all earlier observations, if one observation has so many."""
        return self.observations * (entries if self.entries is None else len(self.entries))


class Past:
    """The history of robots, as arrays ``(row, number)``: steps and sums since the last mean, then the means.

    Parameters
    ----------
    names
        The entries of an observation, in order.
    """

    def __init__(self, history: History, names: Iterable[str]) -> None:
        self._every = history.mean_of
        self._places = history.places(names)
        self._means = 1 + len(self._places)  # where they begin
        self._numbers = self._means + history.observations * len(self._places)

    def memory(self, state: Any, rows: int, episode_start: np.ndarray | None = None) -> np.ndarray:
        """The history before a step of so many robots; see :func:`~baselines.policies.memory.next_memory`.

        Raises
        ------
        ValueError
            if the state is not that of so many robots.
        """
        return next_memory(state, (rows, self._numbers), episode_start)

    def joined(self, present: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """What the network sees: present observations ``(row, entry)``, and after them the earlier ones."""
        means = memory[:, self._means :].astype(present.dtype)
        return np.concatenate([present, means], axis=1)

    def after(self, memory: np.ndarray, present: np.ndarray) -> np.ndarray:
        """The history after a step; the given one is not changed."""
        new = memory.copy()
        new[:, 0] += 1
        new[:, 1 : self._means] += present[:, self._places]
        full = new[:, 0] == self._every
        if full.any():
            rows = new[full]
            mean = rows[:, 1 : self._means] / self._every
            parts = [np.zeros((len(rows), self._means)), mean, rows[:, self._means :]]
            new[full] = np.concatenate(parts, axis=1)[:, : self._numbers]
        return new
