"""Evaluation of the disturbance's channels: where, when and from which stream of random numbers."""

from __future__ import annotations

import numpy as np

from tlf_env.disturbances.channels import (
    CHANNELS,
    COMPUTING_DELAY,
    CONTROL_STEP,
    DEAD_TIME,
    FIX_DELAY,
    FIX_PERIOD,
    SUBSTEP,
    numbers,
)
from tlf_env.disturbances.signals import SignalRow, is_due, signal_value
from tlf_env.engine.arrays import Arrays
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import block, law

STREAMS = np.array([one.stream for one in CHANNELS])
NOMINALS = np.array([one.nominal for one in CHANNELS])
LOWS = np.array([one.low for one in CHANNELS])
HIGHS = np.array([one.high for one in CHANNELS])
# Places of the channels by their rate.
OF_SUBSTEPS, OF_STEPS = numbers(SUBSTEP), numbers(CONTROL_STEP)


@law
def signal_row(signal: np.ndarray) -> SignalRow:
    """A row of ``Arrays.signals``."""
    return SignalRow(signal[0], signal[1], signal[2], signal[3], signal[4], signal[5])


@block
def evaluate(
    arrays: Arrays, lane: int, robot: int, channel: int, tick: int, settings: Settings
) -> None:
    """Evaluate a channel (its place in the table) for one robot at a tick."""
    signal = arrays.signals[arrays.variants[lane], channel]
    value, arrays.processes[channel, robot, lane] = signal_value(
        signal_row(signal),
        tick,
        settings.dt,
        arrays.seeds[lane],
        STREAMS[channel],
        robot,
        arrays.clock[lane, 2],
        arrays.processes[channel, robot, lane],
    )
    value = NOMINALS[channel] + arrays.levels[lane] * (value - NOMINALS[channel])
    value = min(max(value, LOWS[channel]), HIGHS[channel])
    if settings.adversary and not np.isnan(arrays.imposed[channel, robot, lane]):
        value = arrays.imposed[channel, robot, lane]
    arrays.applied[channel, robot, lane] = value


@law
def evaluate_all(arrays: Arrays, lane: int, robot: int, settings: Settings) -> None:
    """Evaluate all channels of one robot at the start of an episode."""
    for channel in range(arrays.applied.shape[0]):
        evaluate(arrays, lane, robot, channel, 0, settings)


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
        channel = channels[i]
        signal = arrays.signals[arrays.variants[lane], channel]
        if settings.adversary or is_due(signal_row(signal), tick, ticks):
            evaluate(arrays, lane, robot, channel, tick, settings)
            found = True
    return found


@law
def delays(arrays: Arrays, lane: int, robot: int, dt: float) -> tuple[int, int]:
    """Dead time of the torques, and for how long the last action still holds, in ticks."""
    dead = round(arrays.applied[DEAD_TIME, robot, lane] / dt)
    return dead, round(arrays.applied[COMPUTING_DELAY, robot, lane] / dt)


@law
def fix_timing(arrays: Arrays, lane: int, robot: int, dt: float) -> tuple[int, int]:
    """Ticks from a position fix to the next, at least 1, and from its measurement to its arrival."""
    every = max(round(arrays.applied[FIX_PERIOD, robot, lane] / dt), 1)
    return every, round(arrays.applied[FIX_DELAY, robot, lane] / dt)
