"""The terms of the reward; each is logged and has its own weight."""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.compiled import law

SLIP_UNIT_MM_S = 100.0
FAR_MM = 1000.0


class RewardTerms(NamedTuple):
    """Unweighted terms of one robot and one step; see :data:`REWARD_MEANINGS`."""

    far: float
    coarse: float
    medium: float
    fine: float
    action_change: float
    action_size: float
    slip: float
    lost: float
    touched: float


REWARD_MEANINGS = {
    "far": "e/1000 mm, e the true position error to the robot's own reference",
    "coarse": "exp(−e/100 mm)",
    "medium": "exp(−e/10 mm)",
    "fine": "exp(−e/2 mm)",
    "action_change": "|Δa|², a in units of the action space",
    "action_size": "|a|²",
    "slip": "largest slip speed of a drive wheel in the step, in 100 mm/s",
    "lost": "1 in the step in which the robot is lost",
    "touched": "1 in the step in which the robot first touches another robot, a wall or an obstacle",
}

DEFAULT_WEIGHTS = RewardTerms(
    far=0.0,
    coarse=0.5,
    medium=0.5,
    fine=0.5,
    action_change=-0.02,
    action_size=-0.005,
    slip=-0.05,
    lost=-20.0,
    touched=-20.0,
)


@law
def reward_terms(
    error: float, change: float, size: float, slip: float, lost: bool, touched: bool
) -> RewardTerms:
    """The terms for a position error in mm, |Δa|², |a|², and a slip speed in mm/s."""
    return RewardTerms(
        far=error / FAR_MM,
        coarse=math.exp(-error / 100.0),
        medium=math.exp(-error / 10.0),
        fine=math.exp(-error / 2.0),
        action_change=change,
        action_size=size,
        slip=slip / SLIP_UNIT_MM_S,
        lost=1.0 if lost else 0.0,
        touched=1.0 if touched else 0.0,
    )
