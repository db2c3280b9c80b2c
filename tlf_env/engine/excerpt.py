"""What an interface shows of one robot in each formation, as rows over the formations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import CHANNELS
from tlf_env.engine.arrays import Arrays, padded
from tlf_env.numerics.compiled import block
from tlf_env.task.info import Info
from tlf_env.task.reward import RewardTerms


class Excerpt(NamedTuple):
    """Written while the lane's numbers are in the cache of the thread that made them."""

    robot: int
    numbers: np.ndarray  # (row, lane): Info, RewardTerms, the channels, reward, lost, touched, end
    observations: np.ndarray  # (lane, entry); (0, entry) if nothing is to be written


TERMS = len(Info._fields)
APPLIED = TERMS + len(RewardTerms._fields)
REWARD = APPLIED + len(CHANNELS)
LOST, TOUCHED, END, ROWS = range(REWARD + 1, REWARD + 5)


def empty_excerpt(arrays: Arrays, robot: int, lanes: int) -> Excerpt:
    """Room for the excerpt of so many lanes, or of none."""
    shown = (
        arrays.sensor_observations
        if arrays.sensor_observations.shape[2] > 0
        else arrays.observations
    )
    numbers = np.empty((ROWS, padded(lanes)))
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
        for i in range(TERMS):
            numbers[i, lane] = arrays.infos[lane, robot, i]
        for i in range(APPLIED - TERMS):
            numbers[TERMS + i, lane] = arrays.terms[lane, robot, i]
        numbers[REWARD, lane] = arrays.rewards[lane, robot]
        numbers[LOST, lane] = arrays.lost[lane, robot]
        numbers[TOUCHED, lane] = arrays.touched[lane, robot]
        numbers[END, lane] = arrays.ends[lane, robot]
    for i in range(REWARD - APPLIED):
        for lane in range(first, last):
            numbers[APPLIED + i, lane] = arrays.applied[i, robot, lane]
