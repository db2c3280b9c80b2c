"""Time of each part of a control step: the step's driver again, with a clock between its stages."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
from numba import types

from baselines.speed.environments import MIN_STEPS
from baselines.speed.moments import Moments, VectorRun
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
from tlf_env.numerics.compiled import compile_for, driver

processor_time_us = types.ExternalFunction("clock", types.int64())  # of the C library; POSIX: µs
PARTS_FORMATIONS = 1024
STAGES = ("actions", "substeps", "radio", "judging", "sensing")


@driver
def timed_step(arrays: Arrays, settings: Settings, spent: np.ndarray) -> None:
    """A control step of all lanes, without contacts; adds each stage's processor time, µs.

    The last of :data:`STAGES` is measured by :func:`timed_sensing`.
    """
    lanes = np.empty(LANES_AT_ONCE, dtype=np.int64)
    near = np.empty(LANES_AT_ONCE, dtype=np.bool_)
    formations = arrays.clock.shape[0]
    for begin in range(0, formations, LANES_AT_ONCE):
        end = min(begin + LANES_AT_ONCE, formations)
        for lane in range(begin, end):
            lanes[lane - begin] = lane
        start = processor_time_us()
        take_all_actions(arrays, begin, end, settings)
        find_near(arrays, begin, end, near, settings)
        acted = processor_time_us()
        advance(
            settings.number,
            arrays,
            lanes[: end - begin],
            0,
            settings.substeps,
            True,
            True,
            settings,
        )
        advanced = processor_time_us()
        transmit_all(arrays, begin, end, arrays.states.shape[1], settings)
        transmitted = processor_time_us()
        look_all(arrays, begin, end, settings)
        looked = processor_time_us()
        spent[0] += acted - start
        spent[1] += advanced - acted
        spent[2] += transmitted - advanced
        spent[3] += looked - transmitted


@driver
def timed_sensing(arrays: Arrays, settings: Settings, spent: np.ndarray) -> None:
    """Sensors and estimators of a control step's substeps alone; the robots do not move."""
    lanes = np.arange(arrays.clock.shape[0])
    for begin in range(0, lanes.shape[0], LANES_AT_ONCE):
        start = processor_time_us()
        advance(
            settings.number,
            arrays,
            lanes[begin : begin + LANES_AT_ONCE],
            0,
            settings.substeps,
            False,
            True,
            settings,
        )
        spent[4] += processor_time_us() - start


def compile_timed(plant: BatchPlant) -> bool:
    """Compile the drivers of this module, or load them from the cache; whether any was not there."""
    arrays, settings, spent = plant.arrays, plant._settings, np.zeros(len(STAGES))
    step = compile_for(timed_step, arrays, settings, spent)
    return compile_for(timed_sensing, arrays, settings, spent) or step


def stage_times(plant: BatchPlant, steps: int) -> dict[str, float]:
    """Processor time of each part of a formation's control step, µs; leaves the plant unusable.

    ``plant`` is the wheel loops and the plant in all substeps, copying in and out included;
    ``onboard`` is encoders, position fixes and EKF.
    """
    arrays, settings = plant.arrays, plant._settings
    spent = np.zeros(len(STAGES))
    timed_step(arrays, settings, spent)
    spent[:] = 0.0
    start = time.process_time()
    for _ in range(steps):
        timed_step(arrays, settings, spent)
    spent *= (
        (time.process_time() - start) * 1e6 / spent.sum()
    )  # the tick of clock() differs between systems
    timed_sensing(arrays, settings, np.zeros(len(STAGES)))
    alone = np.zeros(len(STAGES))
    start = time.process_time()
    for _ in range(steps):
        timed_sensing(arrays, settings, alone)
    spent[4] = (time.process_time() - start) * 1e6
    each = spent / (steps * plant.formations)
    return {
        "plant": each[1] - each[4],
        "onboard": each[4],
        "actions": each[0],
        "radio": each[2],
        "observation_reward_info": each[3],
    }


def part_times(robots: int, steps: int, repeats: int) -> dict[str, Any]:
    """Parts of a formation's control step in a batch, µs of processor time on one thread, medians."""
    formations = min(PARTS_FORMATIONS, max(1, steps))
    run = VectorRun(Moments(robots, 100), formations)
    plant, moments = run.env.plant, run.moments
    count = 2 * MIN_STEPS
    actions = [moments.actions_of(formations, k) for k in range(count)]
    rows: list[dict[str, float]] = []
    for _ in range(repeats):
        moments.spread(plant)
        start = time.process_time()
        for action in actions:
            plant.step(action)
        bare = time.process_time() - start
        learner = [action[:, min(1, robots - 1)].astype(np.float32) for action in actions]
        moments.spread(plant)
        start = time.process_time()
        for action in learner:
            run.env.step(action)
        whole = time.process_time() - start
        moments.spread(plant)
        row = stage_times(plant, count)
        row["api"] = max(whole - bare, 0.0) * 1e6 / (count * formations)
        rows.append(row)
    medians = {
        name: round(float(statistics.median(row[name] for row in rows)), 3) for name in rows[0]
    }
    return {"robots": robots, "formations": formations, "us_per_formation_step": medians}
