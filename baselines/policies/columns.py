"""Columns of an observation that a policy takes, found by the names of its entries."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np


class Columns(NamedTuple):
    """Columns of an observation, in the order in which a policy takes them."""

    places: np.ndarray  # (taken entry,): column of each
    width: int  # entries of the whole observation

    @property
    def leading(self) -> bool:
        """Whether the observation begins with these columns, in this order."""
        return np.array_equal(self.places, np.arange(len(self.places)))

    def take(self, rows: np.ndarray) -> np.ndarray:
        """The columns of rows ``(row, entry)``."""
        return rows[:, : len(self.places)] if self.leading else rows[:, self.places]


def find_columns(wanted: Iterable[str], offered: Iterable[str]) -> Columns:
    """The columns of the wanted entries in an observation with the offered ones.

    Raises
    ------
    ValueError
        naming the first wanted entry that the observation lacks.
    """
    place = {name: i for i, name in enumerate(offered)}
    names = list(wanted)
    for name in names:
        if name not in place:
            raise ValueError(f"the observation lacks the entry {name!r}")
    return Columns(np.array([place[name] for name in names], dtype=np.int64), len(place))


def find_scaled_columns(wanted: Mapping[str, float], offered: Mapping[str, float]) -> Columns:
    """The columns of the wanted entries, which must have the same scales (the values scaled to 1).

    Raises
    ------
    ValueError
        as :func:`find_columns`, and naming the first entry with another scale.
    """
    columns = find_columns(wanted, offered)
    for name, scale in wanted.items():
        if offered[name] != scale:
            raise ValueError(
                f"the policy takes the entry {name!r} with scale {scale:g}, the observation has scale "
                f"{offered[name]:g}"
            )
    return columns
