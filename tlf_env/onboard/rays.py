"""A ring of range sensors on a robot: rays in equally spaced directions, each reading a distance."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from tlf_env.common.models import Frozen, NonNegative, Number, Positive, Whole

MAX_RAYS = 360


class Rays(Frozen):
    """Range sensors of every robot; their rays start at the centre of its outline.

    A reading is the distance from that centre to the first thing that a ray meets, except the robot
    itself; ``range_mm`` if there is nothing within it. With noise it is clipped to 0 … ``range_mm``.
    """

    count: Annotated[Whole, Field(ge=1, le=MAX_RAYS)] = 16
    range_mm: Positive = 1000.0
    noise_std_mm: NonNegative = 0.0  # white noise of each reading
    # Time between two readings, of which the last holds; None: one control period.
    period_s: Positive | None = None
    first_angle_rad: Number = 0.0  # of ray_0 from forward; the others follow counter-clockwise

    @property
    def directions(self) -> np.ndarray:
        """Cosine and sine of each ray's angle from forward, ``(ray, 2)``."""
        angles = self.first_angle_rad + np.arange(self.count) * (2.0 * math.pi / self.count)
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
