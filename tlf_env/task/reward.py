"""The terms of the reward; each is logged and has its own weight."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

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
    alive: float


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
    "alive": "1 in every step in which neither happens; a weight of it outweighs `far`",
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
    alive=0.0,
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
        alive=0.0 if lost or touched else 1.0,
    )


def least_reward(weights: Mapping[str, float], lost_beyond_mm: float) -> tuple[float, float]:
    """The smallest reward of a step that a robot cannot avoid, and its position error in mm.

    A robot that is not lost can always have an action of zero, and wheels that do not slip; then all
    arguments of the terms are 0 but its error, 0 to ``lost_beyond_mm``. If the smallest is negative, being
    lost may be the best choice: it costs ``lost`` once, driving on this much in every step.
    """
    terms_of: Any = getattr(reward_terms, "py_func", reward_terms)  # not compiled for Python
    avoided = [0] * (len(inspect.signature(terms_of).parameters) - 1)
    errors_mm = (0.0, *np.geomspace(0.01, lost_beyond_mm, 200).tolist())
    rewards = [
        sum(weights[name] * value for name, value in terms._asdict().items())
        for terms in (terms_of(error, *avoided) for error in errors_mm)
    ]
    return min(zip(rewards, errors_mm, strict=True))
