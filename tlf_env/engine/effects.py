"""Evaluation of the disturbance's channels: where, when and from which stream of random numbers."""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import (
    CHANNELS,
    COMPUTING_DELAY,
    CONTROL_STEP,
    DEAD_TIME,
    SUBSTEP,
    numbers,
)
from tlf_env.disturbances.signals import SignalRow, is_due, signal_value
from tlf_env.engine.arrays import Arrays
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import block, law

STREAMS = np.array([channel.stream for channel in CHANNELS])
NOMINALS = np.array([channel.nominal for channel in CHANNELS])
LOWS = np.array([channel.low for channel in CHANNELS])
HIGHS = np.array([channel.high for channel in CHANNELS])
# Places of the channels by their rate.
OF_SUBSTEPS, OF_STEPS = numbers(SUBSTEP), numbers(CONTROL_STEP)


@block
def evaluate(arrays: Arrays, lane: int, robot: int, c: int, tick: int, settings: Settings) -> None:
    """Evaluate channel ``c`` for one robot at a tick."""
    signal = arrays.signals[arrays.variants[lane], c]
    value, arrays.processes[c, robot, lane] = signal_value(
        SignalRow(signal[0], signal[1], signal[2], signal[3], signal[4]),
        tick,
        settings.dt,
        arrays.seeds[lane],
        STREAMS[c],
        robot,
        arrays.clock[lane, 2],
        arrays.processes[c, robot, lane],
    )
    value = NOMINALS[c] + arrays.levels[lane] * (value - NOMINALS[c])
    value = min(max(value, LOWS[c]), HIGHS[c])
    if settings.adversary and not np.isnan(arrays.imposed[c, robot, lane]):
        value = arrays.imposed[c, robot, lane]
    arrays.applied[c, robot, lane] = value


@law
def evaluate_all(arrays: Arrays, lane: int, robot: int, settings: Settings) -> None:
    """Evaluate all channels of one robot at the start of an episode."""
    for c in range(arrays.applied.shape[0]):
        evaluate(arrays, lane, robot, c, 0, settings)


@law
def refresh(
    arrays: Arrays,
    lane: int,
    robot: int,
    channels: np.ndarray,
    tick: int,
    ticks: int,
    settings: Settings,
) -> bool:
    """Evaluate the given channels that may have changed in the last ``ticks``; return whether any may have."""
    found = False
    for i in range(channels.shape[0]):
        c = channels[i]
        signal = arrays.signals[arrays.variants[lane], c]
        if settings.adversary or is_due(signal[0], signal[4], tick, ticks):
            evaluate(arrays, lane, robot, c, tick, settings)
            found = True
    return found


@law
def delays(arrays: Arrays, lane: int, robot: int, dt: float) -> tuple[int, int]:
    """Dead time of the torques, and for how long the last action still holds, in ticks."""
    dead = round(arrays.applied[DEAD_TIME, robot, lane] / dt)
    return dead, round(arrays.applied[COMPUTING_DELAY, robot, lane] / dt)
