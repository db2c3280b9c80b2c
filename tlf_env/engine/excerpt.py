"""The results of one robot in each formation, as rows over the formations, for the vector environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import CHANNELS
from tlf_env.engine.arrays import Arrays, padded
from tlf_env.numerics.compiled import block
from tlf_env.task.info import Info
from tlf_env.task.reward import RewardTerms


class Excerpt(NamedTuple):
    """Written by the thread that steps a lane, while the lane's numbers are in its cache."""

    robot: int
    numbers: np.ndarray  # (row, lane): the infos, as in INFO_KEYS, then the reward
    observations: np.ndarray  # (lane, entry); (0, entry) if nothing is to be written


# Rows: those of INFO_KEYS (Info, the reward terms, the channels, the flags), then the reward.
TERMS_ROW = len(Info._fields)
APPLIED_ROW = TERMS_ROW + len(RewardTerms._fields)
LOST_ROW = APPLIED_ROW + len(CHANNELS)
TOUCHED_ROW, TOUCHED_BY_ROW, END_ROW, REWARD_ROW = range(LOST_ROW + 1, LOST_ROW + 5)


def empty_excerpt(arrays: Arrays, robot: int, lanes: int) -> Excerpt:
    """Room for the excerpt of so many lanes, or of none."""
    shown = (
        arrays.sensor_observations
        if arrays.sensor_observations.shape[2] > 0
        else arrays.observations
    )
    numbers = np.empty((REWARD_ROW + 1, padded(lanes)))
    return Excerpt(robot, numbers, np.empty((lanes, shown.shape[2]), dtype=shown.dtype))


@block
def write_excerpt(arrays: Arrays, first: int, last: int, out: Excerpt) -> None:
    """The lanes from ``first`` to before ``last``, if there is room for any."""
    if out.observations.shape[0] == 0:
        return
    robot, numbers = out.robot, out.numbers
    sensor = arrays.sensor_observations.shape[2] > 0
    for lane in range(first, last):
        for i in range(out.observations.shape[1]):
            seen = (
                arrays.sensor_observations[lane, robot, i]
                if sensor
                else arrays.observations[lane, robot, i]
            )
            out.observations[lane, i] = seen
        for i in range(TERMS_ROW):
            numbers[i, lane] = arrays.infos[lane, robot, i]
        for i in range(APPLIED_ROW - TERMS_ROW):
            numbers[TERMS_ROW + i, lane] = arrays.terms[lane, robot, i]
        numbers[LOST_ROW, lane] = arrays.lost[lane, robot]
        numbers[TOUCHED_ROW, lane] = arrays.touched[lane, robot]
        numbers[TOUCHED_BY_ROW, lane] = arrays.touched_by[lane, robot]
        numbers[END_ROW, lane] = arrays.ends[lane, robot]
        numbers[REWARD_ROW, lane] = arrays.rewards[lane, robot]
    for i in range(LOST_ROW - APPLIED_ROW):
        for lane in range(first, last):
            numbers[APPLIED_ROW + i, lane] = arrays.applied[i, robot, lane]
