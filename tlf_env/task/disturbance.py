"""What disturbs the robots, and how much. A level of 0 is the run without the disturbance, bit for bit."""

from __future__ import annotations

from typing import NamedTuple

from pydantic import FiniteFloat

from tlf_env.numerics.compiled import reader
from tlf_env.physics.parameters import Frozen, NonNegative


class SlipChannel(Frozen):
    """Slip of eq. (14), injected under the drive wheels."""

    delta_1_mm_s: FiniteFloat = 0.0
    delta_2_rad_s: FiniteFloat = 0.0


class TyreChannel(Frozen):
    """Factor on the friction coefficients of all tyres."""

    friction_scale: NonNegative = 1.0


class PositionChannel(Frozen):
    """White Gaussian noise of each coordinate of each position fix."""

    noise_std_mm: NonNegative = 0.0


class Disturbance(Frozen):
    """All channels; the defaults disturb nothing."""

    name: str = "custom"
    level: NonNegative = 1.0
    slip: SlipChannel = SlipChannel()
    tyre: TyreChannel = TyreChannel()
    position: PositionChannel = PositionChannel()


class Effects(NamedTuple):
    """What the channels do to one robot during a substep."""

    delta_1: float  # mm/s
    delta_2: float  # rad/s
    grip: float
    fix_std: float  # mm


read_effects = reader(Effects)


def constant_effects(disturbance: Disturbance) -> Effects:
    """The channels' values, the level applied to their deviation from nominal.

    Raises
    ------
    ValueError
        if the level takes a channel out of its range.
    """
    level = disturbance.level
    grip = 1.0 + level * (disturbance.tyre.friction_scale - 1.0)
    if grip < 0:
        raise ValueError(
            f"disturbance level {level} takes tyre.friction_scale to {grip:g}; it must be at least 0"
        )
    return Effects(
        level * disturbance.slip.delta_1_mm_s,
        level * disturbance.slip.delta_2_rad_s,
        grip,
        level * disturbance.position.noise_std_mm,
    )
