"""Which parts of a substep the robots in a tile need: those that none needs are left out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.engine.layout import in_tile
from tlf_env.engine.sensors import (
    ENCODER_EFFECTS,
    FIX_NUMBERS,
    GYRO_EFFECTS,
    NOMINAL_ENCODERS,
    NOMINAL_FIXES,
    NOMINAL_GYRO,
)
from tlf_env.engine.tile_rows import LIMITING, NOT_LIMITING, NOT_PULLING, PULLING, differ
from tlf_env.numerics.compiled import law

SPEED_OBSERVERS = np.array([in_tile("speed_observer", "angle")])
NO_SPEED_OBSERVER = np.zeros(1)


class Needs(NamedTuple):
    """Which of the parts that are left out of a nominal substep some robot of a tile needs."""

    motors: bool
    pull: bool
    encoders: bool
    gyro: bool
    fixes: bool
    observers: bool


@law
def needs_of(tile: np.ndarray) -> Needs:
    """What the robots of a tile need."""
    return Needs(
        motors=differ(tile, LIMITING, NOT_LIMITING),
        pull=differ(tile, PULLING, NOT_PULLING),
        encoders=differ(tile, ENCODER_EFFECTS, NOMINAL_ENCODERS),
        gyro=differ(tile, GYRO_EFFECTS, NOMINAL_GYRO),
        fixes=differ(tile, FIX_NUMBERS, NOMINAL_FIXES),
        observers=differ(tile, SPEED_OBSERVERS, NO_SPEED_OBSERVER),
    )
