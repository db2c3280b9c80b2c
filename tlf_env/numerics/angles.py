"""Wrapping of angles."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.numerics.compiled import law

TURN = 2.0 * math.pi


@law
def wrap(angle: float) -> float:
    """The angle wrapped to [−π, π], rad."""
    return angle - TURN * np.rint(angle / TURN)
