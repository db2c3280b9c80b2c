"""The results of one robot in each formation, as rows over the formations, for the vector environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import CHANNELS
from tlf_env.engine.arrays import Arrays, padded
from tlf_env.numerics.compiled import block
from tlf_env.numerics.indices import natural
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
    robot, numbers = natural(out.robot), out.numbers
    sensor = arrays.sensor_observations.shape[2] > 0
    shown = arrays.sensor_observations if sensor else arrays.observations
    for lane in range(first, last):
        seen, copied = shown[lane, robot], out.observations[lane]
        for i in range(copied.shape[0]):
            copied[i] = seen[i]
    for i in range(LOST_ROW - APPLIED_ROW):
        row, applied = numbers[APPLIED_ROW + i, first:last], arrays.applied[i, robot, first:last]
        for k in range(row.shape[0]):
            row[k] = applied[k]
    for lane in range(first, last):
        k = natural(lane)
        for i in range(TERMS_ROW):
            numbers[i, k] = arrays.infos[k, robot, i]
        for i in range(APPLIED_ROW - TERMS_ROW):
            numbers[TERMS_ROW + i, k] = arrays.terms[k, robot, i]
        numbers[LOST_ROW, k] = arrays.lost[k, robot]
        numbers[TOUCHED_ROW, k] = arrays.touched[k, robot]
        numbers[TOUCHED_BY_ROW, k] = arrays.touched_by[k, robot]
        numbers[END_ROW, k] = arrays.ends[k, robot]
        numbers[REWARD_ROW, k] = arrays.rewards[k, robot]
