"""Everything that an episode remembers, as arrays: one quantity a row, formations last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import CHANNELS, DEAD_TIME, JITTER
from tlf_env.disturbances.model import Effects, PatchRow, leveled, patch_rows, signal_rows
from tlf_env.numerics.compiled import reader, writer
from tlf_env.onboard.estimator import Ekf, Estimate, ekf_constants
from tlf_env.onboard.observer import Message, Reference
from tlf_env.onboard.slip_estimator import SlipEkf, SlipEstimate, slip_ekf_constants
from tlf_env.onboard.wheel_loop import (
    WheelLoopParameters,
    WheelLoopRow,
    WheelLoopState,
    digital_wheel_loop,
)
from tlf_env.physics.vehicle import Body, Contact, Motion, body_array
from tlf_env.task.actions import ACTION_KINDS, ACTION_SIZE
from tlf_env.task.info import Info
from tlf_env.task.measures import TIME_GAP_WINDOW_S
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.reward import RewardTerms
from tlf_env.task.scenario import Scenario


class Sensors(NamedTuple):
    """Last encoder readings (rad) and the wheel speeds they gave (rad/s)."""

    encoder_l: float
    encoder_r: float
    speed_l: float
    speed_r: float


class Trace(NamedTuple):
    """Sums and extremes over the substeps of one control step."""

    distance: float  # odometry, mm
    turn: float  # odometry, rad
    moved: float  # the same with the estimated slip, mm
    turned: float  # rad
    innovation_forward: float  # sums of the EKF's innovation in estimated body axes, mm
    innovation_right: float
    nis: float  # sum of the normalised innovation squared
    torque_l: float  # sums, mN·mm
    torque_r: float
    saturated: float  # substeps with a torque at its limit
    slip: float  # largest slip speed of a drive wheel, mm/s
    slid: float  # mean way that the drive wheels slipped, mm
    torque_2: float  # sum of the squared torques of both wheels, (mN·mm)²
    work: float  # mechanical work of both motors that they put in, braking not counted, µJ


class Sample(NamedTuple):
    """One substep's readings: position fix (mm) and the wheels' angle increments (rad)."""

    fix_x: float
    fix_y: float
    step_l: float
    step_r: float


class Variants(NamedTuple):
    """Constants of the scenarios that lanes may run, as an episode's start needs them."""

    bodies: np.ndarray  # (field, robot, variant), without payload
    wheel_loops: np.ndarray  # (field, robot, variant)
    ekfs: np.ndarray  # (field, robot, variant)
    slip_ekfs: np.ndarray  # (field, robot, variant)
    levels: np.ndarray  # (variant,) of the disturbance
    mixture: np.ndarray  # (variant,): summed shares if every episode draws its variant, else empty


class Arrays(NamedTuple):
    """``(field, robot, lane)`` unless said; a lane is one formation.

    Where lanes come last there may be a few more than formations, which nobody uses (:func:`padded`).

    Lanes may run different scenarios, their :class:`Variants`.
    """

    # constants of the variants
    signals: np.ndarray  # (variant, channel, SignalRow)
    patches: np.ndarray  # (variant, patch, PatchRow)
    table: np.ndarray  # (step, Reference): the leader's reference at the control steps
    # constants of an episode
    variants: np.ndarray  # (lane,) int64
    bodies: np.ndarray
    wheel_loops: np.ndarray
    ekfs: np.ndarray
    slip_ekfs: np.ndarray
    levels: np.ndarray  # (lane,) of the disturbance
    # physics
    motions: np.ndarray
    contacts: np.ndarray
    processes: np.ndarray  # (channel, robot, lane): memory of Ornstein–Uhlenbeck signals
    applied: np.ndarray  # (channel, robot, lane): the channels' values, last evaluated
    imposed: np.ndarray  # (channel, robot, lane): set by an adversary; NaN where not
    torques: np.ndarray  # (wheel, slot, robot, lane): ring over the longest dead time, mN·mm
    # on board, every substep
    loop_states: np.ndarray
    sensors: np.ndarray
    estimates: np.ndarray
    slip_estimates: np.ndarray
    traces: np.ndarray
    kinds: np.ndarray  # (robot, lane) int64: of each robot's action
    wanted: np.ndarray  # wheel speeds asked for (rad/s), or torques (mN·mm)
    wanted_before: np.ndarray  # those of the step before
    commands: np.ndarray  # the same, or the torques (mN·mm) of a wheel loop outside
    samples: np.ndarray  # (substep, Sample, robot, lane): what the sensors said in a control step
    # on board, every control step
    dropped: np.ndarray  # (slot, robot, lane) bool: whether that broadcast was lost on the air
    messages: np.ndarray  # (Message, slot, robot, lane): ring over one gap
    observers: np.ndarray  # (x y θ, robot, lane)
    references: np.ndarray  # (Reference, slot, robot, lane): ring over the longest preview
    # truth
    paths: np.ndarray  # (x y, slot, robot, lane): ring over one gap and the window behind it
    longest: np.ndarray  # (robot, lane): longest way within a control step so far, mm
    # time and random numbers
    clock: np.ndarray  # (lane, 3) int64: substeps, control steps, episode
    seeds: np.ndarray  # (lane,) int64
    # interface, formations first
    actions: np.ndarray  # (lane, robot, 2)
    last_actions: np.ndarray
    twists: np.ndarray  # (lane, robot, 2): twist actions made on board, in the actions' dtype
    observations: np.ndarray  # (lane, robot, entry): `tracking`
    sensor_observations: (
        np.ndarray
    )  # (lane, robot, entry): `sensor`, without entries if not asked for
    starts: np.ndarray  # (x y θ, robot, lane): pose of c at the start
    terms: np.ndarray  # (lane, robot, RewardTerms)
    rewards: np.ndarray  # (lane, robot)
    infos: np.ndarray  # (lane, robot, Info)
    lost: np.ndarray  # (lane, robot) bool, at any time so far
    touched: np.ndarray
    lost_now: np.ndarray  # (lane, robot) bool, for the first time in this step
    touched_now: np.ndarray
    ends: np.ndarray  # (lane, robot) int8: why the episode ended in this step, as in END_REASONS
    scales: np.ndarray  # (entry,) of `tracking`
    sensor_scales: np.ndarray  # (entry,) of `sensor`
    weights: np.ndarray  # (RewardTerms,)
    previews: np.ndarray  # (preview,) int64, in control steps


read_effects = reader(Effects)  # from `applied`, whose first channels these are
read_sensors = reader(Sensors)
write_sensors = writer(Sensors)
read_trace = reader(Trace)
write_trace = writer(Trace)
write_sample = writer(Sample)


def _constant(row: tuple[float, ...], robots: int, lanes: int) -> np.ndarray:
    return np.tile(np.array(row, dtype=np.float64)[:, None, None], (1, robots, lanes))


def _per_variant(rows: Sequence[tuple[float, ...]], robots: int) -> np.ndarray:
    """Rows of the variants as (field, robot, variant), every robot alike."""
    return np.ascontiguousarray(np.repeat(np.array(rows).T[:, None, :], robots, axis=1))


FEW_LANES = 64
DOUBLES_PER_CACHE_LINE = 8
NOWHERE = PatchRow(x=math.inf, y=0.0, radius=0.0, scale=1.0)


def _all_patches(scenarios: Sequence[Scenario]) -> np.ndarray:
    """Patches as (variant, patch, PatchRow), filled up with patches that nothing lies on."""
    rows = [patch_rows(scenario.disturbance) for scenario in scenarios]
    out = np.tile(np.array(NOWHERE), (len(rows), max(map(len, rows)), 1))
    for patches, some in zip(out, rows, strict=True):
        patches[: len(some)] = some
    return out


def longest(scenario: Scenario, channel: int) -> float:
    """The largest value that a channel can have; its range's end if an adversary may set it."""
    if scenario.adversary:
        return CHANNELS[channel].high
    reach = scenario.disturbance.signal(CHANNELS[channel].path).reach(CHANNELS[channel].nominal)
    level = scenario.disturbance.level
    return max(leveled(CHANNELS[channel].nominal, end, level) for end in reach)


def _loop_row(scenario: Scenario) -> tuple[float, ...]:
    wheel_loop = scenario.wheel_loop
    if isinstance(wheel_loop, str):  # an object outside; the arrays' own loop rests
        wheel_loop = WheelLoopParameters()
    return digital_wheel_loop(wheel_loop, scenario.physics_period_s)


def make_variants(scenarios: Sequence[Scenario], mixture: Sequence[float] = ()) -> Variants:
    """Constants of the scenarios; with the shares ``mixture``, which sum to 1, episodes draw theirs."""
    n = scenarios[0].robot_count
    return Variants(
        bodies=np.concatenate([body_array(list(one.robot_models)) for one in scenarios], axis=2),
        wheel_loops=_per_variant([_loop_row(one) for one in scenarios], n),
        ekfs=_per_variant([ekf_constants(one.ekf) for one in scenarios], n),
        slip_ekfs=_per_variant(
            [slip_ekf_constants(one.ekf_slip, one.physics_period_s) for one in scenarios], n
        ),
        levels=np.array([one.disturbance.level for one in scenarios]),
        mixture=np.cumsum(np.array(mixture, dtype=np.float64)),
    )


def padded(lanes: int) -> int:
    """How many lanes a row has, so that rows of many lanes are an odd number of cache lines long.

    A power of two would put one lane's numbers of all rows into the same few places of the cache.
    """
    if lanes < FEW_LANES:
        return lanes
    cache_lines = -(-lanes // DOUBLES_PER_CACHE_LINE)
    return DOUBLES_PER_CACHE_LINE * (cache_lines | 1)


def make_arrays(
    scenarios: Sequence[Scenario],
    table: np.ndarray,
    lanes: int = 1,
) -> Arrays:
    """Arrays of ``lanes`` formations, not yet reset; lane k runs scenario k modulo their number.

    The scenarios may differ in their robots' parameters, wheel loops, filters and disturbances only.
    """
    scenario = scenarios[0]
    n = scenario.robot_count
    dtype = np.dtype(scenario.dtype)
    sensor = len(sensor_entries(scenario.substeps)) if scenario.observation == "sensor" else 0
    gap = scenario.gap_steps
    window = round(TIME_GAP_WINDOW_S / scenario.control_period_s)
    lookahead = max(scenario.preview_steps, default=0)
    entries = len(tracking_entries(scenario.preview_s))

    dead = max(round(longest(one, DEAD_TIME) / one.physics_period_s) for one in scenarios)
    late = max(math.ceil(longest(one, JITTER) / one.control_period_s) for one in scenarios)
    ring = gap + 1 + late
    columns = padded(lanes)

    def zeros(fields: int) -> np.ndarray:
        return np.zeros((fields, n, columns))

    return Arrays(
        signals=np.array(
            [
                signal_rows(one.disturbance, one.physics_period_s, one.control_period_s)
                for one in scenarios
            ]
        ),
        patches=_all_patches(scenarios),
        table=table.copy(),
        variants=np.arange(lanes) % len(scenarios),
        bodies=zeros(len(Body._fields)),
        wheel_loops=zeros(len(WheelLoopRow._fields)),
        ekfs=zeros(len(Ekf._fields)),
        slip_ekfs=zeros(len(SlipEkf._fields)),
        levels=np.zeros(lanes),
        motions=zeros(len(Motion._fields)),
        contacts=zeros(len(Contact._fields)),
        processes=zeros(len(CHANNELS)),
        applied=_constant(tuple(channel.nominal for channel in CHANNELS), n, columns),
        imposed=np.full((len(CHANNELS), n, columns), np.nan),
        torques=np.zeros((2, dead + 1, n, columns)),
        loop_states=zeros(len(WheelLoopState._fields)),
        sensors=zeros(len(Sensors._fields)),
        estimates=zeros(len(Estimate._fields)),
        slip_estimates=zeros(len(SlipEstimate._fields)),
        traces=zeros(len(Trace._fields)),
        kinds=np.full((n, columns), ACTION_KINDS[scenario.action], dtype=np.int64),
        wanted=zeros(2),
        wanted_before=zeros(2),
        commands=zeros(2),
        samples=np.zeros((scenario.substeps, len(Sample._fields), n, columns)),
        dropped=np.zeros((ring, n, columns), dtype=np.bool_),
        messages=np.zeros((len(Message._fields), ring, n, columns)),
        observers=zeros(3),
        references=np.zeros((len(Reference._fields), lookahead + 1, n, columns)),
        paths=np.zeros((2, gap + window + 1, n, columns)),
        longest=np.zeros((n, columns)),
        clock=np.zeros((lanes, 3), dtype=np.int64),
        seeds=np.zeros(lanes, dtype=np.int64),
        actions=np.zeros((lanes, n, ACTION_SIZE)),
        last_actions=np.zeros((lanes, n, ACTION_SIZE)),
        twists=np.zeros((lanes, n, ACTION_SIZE), dtype=dtype),
        observations=np.zeros((lanes, n, entries), dtype=dtype),
        sensor_observations=np.zeros((lanes, n, sensor), dtype=dtype),
        starts=zeros(3),
        terms=np.zeros((lanes, n, len(RewardTerms._fields))),
        rewards=np.zeros((lanes, n)),
        infos=np.zeros((lanes, n, len(Info._fields))),
        lost=np.zeros((lanes, n), dtype=np.bool_),
        touched=np.zeros((lanes, n), dtype=np.bool_),
        lost_now=np.zeros((lanes, n), dtype=np.bool_),
        touched_now=np.zeros((lanes, n), dtype=np.bool_),
        ends=np.zeros((lanes, n), dtype=np.int8),
        scales=np.array([entry.scale for entry in tracking_entries(scenario.preview_s).values()]),
        sensor_scales=np.array(
            [entry.scale for entry in sensor_entries(scenario.substeps).values()]
        ),
        weights=np.array([scenario.reward[name] for name in RewardTerms._fields]),
        previews=np.array(scenario.preview_steps, dtype=np.int64),
    )
