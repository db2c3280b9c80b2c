"""Where the time of a control step goes: the step's driver again, with a clock between its stages."""

from __future__ import annotations

import time

import numpy as np
from numba import types

from tlf_env.engine.arrays import Arrays
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.drivers import (
    LANES_AT_ONCE,
    find_near,
    look_all,
    take_all_actions,
    transmit_all,
)
from tlf_env.engine.settings import Settings
from tlf_env.engine.tiles import advance
from tlf_env.numerics.compiled import driver

processor_time_us = types.ExternalFunction("clock", types.int64())  # of the C library; POSIX: µs
STAGES = ("actions", "substeps", "radio", "judging", "sensing")


@driver
def timed_step(a: Arrays, s: Settings, spent: np.ndarray) -> None:
    """A control step of all lanes, none of them near; adds each stage's processor time, µs.

    The last of :data:`STAGES` runs the substeps' second half once more, with the robots where they are.
    """
    lanes = np.empty(LANES_AT_ONCE, dtype=np.int64)
    near = np.empty(LANES_AT_ONCE, dtype=np.bool_)
    formations = a.clock.shape[0]
    for begin in range(0, formations, LANES_AT_ONCE):
        end = min(begin + LANES_AT_ONCE, formations)
        for lane in range(begin, end):
            lanes[lane - begin] = lane
        start = processor_time_us()
        take_all_actions(a, begin, end, s)
        find_near(a, begin, end, near, s)
        acted = processor_time_us()
        advance(a, lanes[: end - begin], 0, s.substeps, True, True, s)
        advanced = processor_time_us()
        transmit_all(a, begin, end, s)
        transmitted = processor_time_us()
        look_all(a, begin, end, s)
        looked = processor_time_us()
        spent[0] += acted - start
        spent[1] += advanced - acted
        spent[2] += transmitted - advanced
        spent[3] += looked - transmitted


@driver
def timed_sensing(a: Arrays, s: Settings, spent: np.ndarray) -> None:
    """Sensors and estimators of a control step's substeps alone; the robots stay where they are."""
    lanes = np.arange(a.clock.shape[0])
    for begin in range(0, lanes.shape[0], LANES_AT_ONCE):
        start = processor_time_us()
        advance(a, lanes[begin : begin + LANES_AT_ONCE], 0, s.substeps, False, True, s)
        spent[4] += processor_time_us() - start


def stage_times(plant: BatchPlant, steps: int) -> dict[str, float]:
    """Processor time of each part of a formation's control step, µs. The plant is not fit for use after.

    ``plant`` is the wheel loops and the plant in all substeps, copying in and out included;
    ``onboard`` is encoders, position fixes and EKF.
    """
    a, s = plant.arrays, plant._settings
    spent = np.zeros(len(STAGES))
    timed_step(a, s, spent)
    spent[:] = 0.0
    start = time.process_time()
    for _ in range(steps):
        timed_step(a, s, spent)
    spent *= (time.process_time() - start) * 1e6 / spent.sum()  # clocks elsewhere tick otherwise
    timed_sensing(a, s, np.zeros(len(STAGES)))
    alone = np.zeros(len(STAGES))
    start = time.process_time()
    for _ in range(steps):
        timed_sensing(a, s, alone)
    spent[4] = (time.process_time() - start) * 1e6
    each = spent / (steps * plant.formations)
    return {
        "plant": each[1] - each[4],
        "onboard": each[4],
        "actions": each[0],
        "radio": each[2],
        "observation_reward_info": each[3],
    }
