"""The state of a policy that keeps some numbers for each row, between calls of SB3's ``predict``."""

from __future__ import annotations

from typing import Any

import numpy as np


def next_memory(state: Any, shape: tuple[int, int], episode_start: np.ndarray | None) -> np.ndarray:
    """A copy of the last state ``(row, number)`` for the next step; 0 in the rows that start anew.

    Parameters
    ----------
    state
        What the last call returned; None at the start.
    shape
        Rows of this call, and numbers for each.
    episode_start
        True for the rows ``(row,)`` whose state is reset. None: no row.

    Raises
    ------
    ValueError
        if the state is not that of a call with as many rows.
    """
    memory = np.zeros(shape) if state is None else np.array(state, dtype=np.float64)
    if memory.shape != shape:
        raise ValueError(f"the state must be of the shape {shape}, got {memory.shape}")
    if episode_start is not None:
        memory[np.asarray(episode_start, dtype=np.bool_)] = 0.0
    return memory
