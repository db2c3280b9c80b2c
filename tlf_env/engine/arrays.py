"""The arrays of an episode: constants, states, rings over time, and the results that interfaces read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tlf_env.disturbances.channels import CHANNELS, DEAD_TIME, EPISODE, FIX_DELAY, JITTER
from tlf_env.disturbances.model import (
    PatchRow,
    changing_channels,
    leveled,
    patch_rows,
    signal_rows,
)
from tlf_env.engine.layout import (
    BY_NAME,
    CONSTANT_FIELDS,
    ROWS,
    Fix,
    Kind,
    Sample,
    Traction,
    Way,
    array_reader,
    array_writer,
    fields_of,
    rows_of,
)
from tlf_env.numerics.memory import zeros
from tlf_env.numerics.pointers import by_pointer
from tlf_env.numerics.rows import reader, slot_reader, slot_writer, writer
from tlf_env.onboard.calibration import Belief
from tlf_env.onboard.estimator import ekf_constants
from tlf_env.onboard.gyro_estimator import gyro_ekf_constants
from tlf_env.onboard.observer import Message, Reference
from tlf_env.onboard.slip_estimator import slip_ekf_constants
from tlf_env.onboard.speed_observer import speed_observer_row
from tlf_env.onboard.wheel_loop import WheelLoopParameters, digital_wheel_loop
from tlf_env.physics.vehicle import Floor, Push, body
from tlf_env.physics.world import capsule_rows
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.info import Info
from tlf_env.task.measures import TIME_GAP_WINDOW_S
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.reward import RewardTerms
from tlf_env.task.scenario import Scenario

# Arrays that follow from the scenario alone, or (``tables``) from it and the phase of a start, or (``timed``)
# from what is asked for.
FROM_SCENARIO = (
    "signals",
    "patches",
    "walls",
    "rays",
    "tables",
    "scales",
    "sensor_scales",
    "weights",
    "previews",
    "changing",
    "timed",
)
FEW_LANES = 64
DOUBLES_PER_CACHE_LINE = 8
FAR_AWAY = PatchRow(x=math.inf, y=0.0, radius=0.0, scale=1.0)  # no robot is ever on it


class Variants(NamedTuple):
    """Constants of the scenarios that lanes may run (their variants), as an episode's start needs them."""

    constants: np.ndarray  # (field, robot, variant), bodies without payload
    levels: np.ndarray  # (variant,) of the disturbance
    mixture: np.ndarray  # (variant,): summed shares if every episode draws its variant, else empty


@by_pointer
class Arrays(NamedTuple):
    """``(field, robot, lane)`` unless another shape is given; a lane is one formation.

    Where lanes come last, some unused ones may follow (:func:`padded`). Lanes may run different
    scenarios, their :class:`Variants`.
    """

    # constants of the variants
    signals: np.ndarray  # (variant, channel, SignalRow)
    patches: np.ndarray  # (variant, patch, PatchRow)
    walls: np.ndarray  # (capsule, Capsule): the static world
    rays: (
        np.ndarray
    )  # (ray, 2): cosine and sine of the angle from forward of each range sensor's ray
    tables: np.ndarray  # (table, step, Reference): the leader's reference at the control steps
    # constants of an episode
    variants: np.ndarray  # (lane,) int64
    routes: np.ndarray  # (lane,) int64: which of the tables the leader follows
    constants: np.ndarray  # the rows of kind CONSTANT
    levels: np.ndarray  # (lane,) of the disturbance
    # what changes
    states: np.ndarray  # the rows of kind STATE, then those of kind CONTROL
    processes: np.ndarray  # (channel, robot, lane): memory of random processes
    applied: np.ndarray  # (channel, robot, lane): the channels' values, last evaluated
    imposed: np.ndarray  # (channel, robot, lane): values set by an adversary, else NaN
    torques: np.ndarray  # (wheel, slot, robot, lane): ring over the longest dead time, mN·mm
    kinds: np.ndarray  # (robot, lane) int64: of each robot's action
    inputs: (
        np.ndarray
    )  # (Traction and Floor, robot, lane) of a substep on plant `chipmunk`, else empty
    samples: np.ndarray  # (substep, Sample, robot, lane): sensor readings of a control step
    fixes: np.ndarray  # (Fix, slot, robot, lane): ring over the longest delay of the fixes
    dropped: np.ndarray  # (slot, robot, lane) bool: whether that broadcast was lost
    messages: np.ndarray  # (Message, slot, robot, lane): ring over one gap
    ways: (
        np.ndarray
    )  # (Way, slot, robot, lane): ring over the windows of smoothed broadcasts, or none
    references: np.ndarray  # (Reference, slot, robot, lane): ring over the longest preview
    paths: (
        np.ndarray
    )  # (x y way, slot, robot, lane): true positions, way so far; one gap and a window
    # time and random numbers
    clock: np.ndarray  # (lane, 4) int64: substeps, control steps, episode, control step of its end
    seeds: np.ndarray  # (lane,) int64
    # interface, formations first
    actions: np.ndarray  # (lane, robot, 2)
    last_actions: np.ndarray
    twists: np.ndarray  # (lane, robot, 2): twist actions made on board, in the actions' dtype
    observations: np.ndarray  # (lane, robot, entry): `tracking`
    sensor_observations: np.ndarray  # (lane, robot, entry): `sensor`, without entries if unused
    terms: np.ndarray  # (lane, robot, RewardTerms)
    rewards: np.ndarray  # (lane, robot)
    infos: np.ndarray  # (lane, robot, Info)
    lost: np.ndarray  # (lane, robot) bool, at any time so far
    touched: np.ndarray
    lost_now: np.ndarray  # (lane, robot) bool, for the first time in this step
    touched_now: np.ndarray
    touched_by: np.ndarray  # (lane, robot) int8: what was touched first, a TouchedBy
    ranges: np.ndarray  # (lane, robot, ray): distances to what the rays meet, mm
    calm: np.ndarray  # (lane,) int64: the control step before which no robot can meet a wall
    ends: np.ndarray  # (lane, robot) int8: why the episode ended in this step, an EndReason
    scales: np.ndarray  # (entry,) of `tracking`
    sensor_scales: np.ndarray  # (entry,) of `sensor`
    weights: np.ndarray  # (RewardTerms,)
    previews: np.ndarray  # (preview,) int64, in control steps
    changing: (
        np.ndarray
    )  # (channel,) int64: places of those that may change in a substep, in some variant
    timed: np.ndarray  # (robot,) bool: whose time gap error is computed

    def rows(self, name: str) -> np.ndarray:
        """A row of the engine's table by name, ``(field, robot, lane)``; a view."""
        constant = BY_NAME[name].kind is Kind.CONSTANT
        return rows_of(self.constants if constant else self.states, name)

    def named(self, name: str) -> Any:
        """A row's named tuple, each field an array ``(robot, lane)``, unused lanes left out; views."""
        return BY_NAME[name].fields(*self.rows(name)[:, :, : len(self.seeds)])

    def slot(self, ring: np.ndarray, step: int) -> np.ndarray:
        """A ring's entry of a control step, ``(field, robot, lane)``, unused lanes left out; a view."""
        return ring[:, step % ring.shape[1], :, : len(self.seeds)]


# Where Floor and Push begin in Arrays.inputs, after Traction.
FLOOR_INPUT = len(Traction._fields)
PUSH_INPUT = FLOOR_INPUT + len(Floor._fields)

read_body = array_reader("body")
read_belief, write_belief = array_reader("belief"), array_writer("belief")
read_slip_ekf, write_slip_ekf = array_reader("slip_ekf"), array_writer("slip_ekf")
read_gyro_ekf, write_gyro_ekf = array_reader("gyro_ekf"), array_writer("gyro_ekf")
read_motion, write_motion = array_reader("motion"), array_writer("motion")
read_estimate, write_estimate = array_reader("estimate"), array_writer("estimate")
read_slip = array_reader("slip")
read_gyro = array_reader("gyro")
read_ekf = array_reader("ekf")
read_sensors = array_reader("sensors")
read_way, write_way = slot_reader(Way), slot_writer(Way)
read_message, write_message = slot_reader(Message), slot_writer(Message)
read_kept, write_kept = slot_reader(Reference), slot_writer(Reference)  # of Arrays.references
read_contact = array_reader("contact")
read_trace, write_trace = array_reader("trace"), array_writer("trace")
read_traction, write_traction = reader(Traction), writer(Traction)  # of Arrays.inputs
write_floor = writer(Floor, FLOOR_INPUT)
write_push = writer(Push, PUSH_INPUT)
read_wanted, write_wanted = array_reader("wanted"), array_writer("wanted")
read_wanted_before = array_reader("wanted_before")
write_wanted_before = array_writer("wanted_before")
read_command, write_command = array_reader("command"), array_writer("command")
read_observer, write_observer = array_reader("observer"), array_writer("observer")
read_rejection, write_rejection = array_reader("rejection"), array_writer("rejection")
read_start, write_start = array_reader("start"), array_writer("start")


def constant_rows(scenario: Scenario) -> dict[str, Sequence[tuple[float, ...]]]:
    """Values of the rows of kind CONSTANT for a scenario, by name, one tuple for each robot."""
    loop = scenario.wheel_loop
    if isinstance(loop, str):  # an object outside; the engine's own loop is not used
        loop = WheelLoopParameters()
    robots, dt_s = scenario.robot_models, scenario.physics_period_s
    bodies = [body(robot) for robot in robots]
    gyro = scenario.ekf_gyro
    if scenario.plant == "kinematic":  # there are no torques
        gyro = gyro.model_copy(update={"torque_time_s": None})
    return {
        "body": bodies,
        "wheel_loop": [digital_wheel_loop(loop, dt_s)] * len(robots),
        "ekf": [ekf_constants(scenario.ekf)] * len(robots),
        "slip_ekf": [slip_ekf_constants(scenario.ekf_slip, dt_s)] * len(robots),
        "gyro_ekf": [gyro_ekf_constants(gyro, one, dt_s) for one in bodies],
        "belief": [Belief(radius_l=1.0, radius_r=1.0, h=one.h) for one in bodies],
        "speed_observer": [
            speed_observer_row(loop.speed_observer_rad_s, one, dt_s) for one in bodies
        ],
    }


def make_constants(scenario: Scenario) -> np.ndarray:
    """The rows of kind CONSTANT for a scenario, (field, robot)."""
    made = constant_rows(scenario)
    names = [row.name for row in ROWS if row.kind is Kind.CONSTANT]
    return np.concatenate([np.array(made[name], dtype=np.float64).T for name in names])


def _all_patches(scenarios: Sequence[Scenario]) -> np.ndarray:
    """Patches as (variant, patch, PatchRow), filled up with patches that no robot is ever on."""
    rows = [patch_rows(one.disturbance, one.world.patches) for one in scenarios]
    out = np.tile(np.array(FAR_AWAY), (len(rows), max(map(len, rows)), 1))
    for patches, some in zip(out, rows, strict=True):
        patches[: len(some)] = some
    return out


def longest(scenario: Scenario, channel: int) -> float:
    """The largest value that a channel can have.

    It is its range's end if an adversary may set it, or for a signal without a bound.
    """
    one, level = CHANNELS[channel], scenario.disturbance.level
    signal = scenario.disturbance.signal(one.path)
    imposed = scenario.adversary and one.rate != EPISODE
    if imposed or (level > 0.0 and not signal.is_bounded()):
        return one.high
    return max(leveled(one.nominal, end, level) for end in signal.reach(one.nominal))


def make_variants(scenarios: Sequence[Scenario], mixture: Sequence[float] = ()) -> Variants:
    """Constants of the scenarios; with the shares ``mixture``, which sum to 1, episodes draw theirs."""
    return Variants(
        constants=np.ascontiguousarray(
            np.stack([make_constants(one) for one in scenarios], axis=-1)
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


def smoothing_slots(scenario: Scenario, old: int) -> int:
    """Control steps in the ring of ways, if fixes are at most ``old`` substeps late; 0 without smoothing."""
    half = scenario.smoothing_steps
    return 4 * half + -(-old // scenario.substeps) + 4 if half else 0


def make_arrays(
    scenarios: Sequence[Scenario],
    table: np.ndarray,
    lanes: int = 1,
) -> Arrays:
    """Arrays of ``lanes`` formations, not yet reset; lane k runs scenario k modulo their number.

    The scenarios may differ in their robots' parameters, wheel loops, filters and disturbances only.
    """
    scenario = scenarios[0]
    robots = scenario.robot_count
    dtype = np.dtype(scenario.dtype)
    tracking = tracking_entries(scenario.preview_s, scenario.rays, scenario.neighbour)
    sensor = sensor_entries(scenario.substeps, scenario.rays)
    sensor_size = len(sensor) if scenario.observation == "sensor" else 0
    rays = np.zeros((0, 2)) if scenario.rays is None else scenario.rays.directions
    gap = scenario.gap_steps
    window = round(TIME_GAP_WINDOW_S / scenario.control_period_s)
    lookahead = max(scenario.preview_steps, default=0)

    dead = max(round(longest(one, DEAD_TIME) / one.physics_period_s) for one in scenarios)
    old = max(round(longest(one, FIX_DELAY) / one.physics_period_s) for one in scenarios)
    late = max(math.ceil(longest(one, JITTER) / one.control_period_s) for one in scenarios)
    ring = gap + 1 + late
    columns = padded(lanes)

    def rows_of_zeros(fields: int) -> np.ndarray:
        return zeros((fields, robots, columns))

    applied = rows_of_zeros(len(CHANNELS))
    applied[:] = np.array([channel.nominal for channel in CHANNELS])[:, None, None]
    return Arrays(
        signals=np.array(
            [
                signal_rows(one.disturbance, one.physics_period_s, one.control_period_s)
                for one in scenarios
            ]
        ),
        patches=_all_patches(scenarios),
        walls=capsule_rows(scenario.world),
        rays=rays,
        tables=table[None].copy(),
        variants=np.arange(lanes) % len(scenarios),
        routes=np.zeros(lanes, dtype=np.int64),
        constants=rows_of_zeros(CONSTANT_FIELDS),
        levels=np.zeros(lanes),
        states=rows_of_zeros(fields_of(Kind.STATE, Kind.CONTROL)),
        processes=rows_of_zeros(len(CHANNELS)),
        applied=applied,
        imposed=np.full((len(CHANNELS), robots, columns), np.nan),
        torques=zeros((2, dead + 1, robots, columns)),
        kinds=np.full((robots, columns), scenario.action_kind, dtype=np.int64),
        inputs=rows_of_zeros(PUSH_INPUT + len(Push._fields) if scenario.plant == "chipmunk" else 0),
        samples=zeros((scenario.substeps, len(Sample._fields), robots, columns)),
        fixes=zeros((len(Fix._fields), old + 1, robots, columns)),
        dropped=np.zeros((ring, robots, columns), dtype=np.bool_),
        messages=zeros((len(Message._fields), ring, robots, columns)),
        ways=zeros((len(Way._fields), smoothing_slots(scenario, old), robots, columns)),
        references=zeros((len(Reference._fields), lookahead + 1, robots, columns)),
        paths=zeros((3, gap + window + 1, robots, columns)),
        clock=np.zeros((lanes, 4), dtype=np.int64),
        seeds=np.zeros(lanes, dtype=np.int64),
        actions=np.zeros((lanes, robots, ACTION_SIZE)),
        last_actions=np.zeros((lanes, robots, ACTION_SIZE)),
        twists=np.zeros((lanes, robots, ACTION_SIZE), dtype=dtype),
        observations=np.zeros((lanes, robots, len(tracking)), dtype=dtype),
        sensor_observations=np.zeros((lanes, robots, sensor_size), dtype=dtype),
        terms=np.zeros((lanes, robots, len(RewardTerms._fields))),
        rewards=np.zeros((lanes, robots)),
        infos=np.zeros((lanes, robots, len(Info._fields))),
        lost=np.zeros((lanes, robots), dtype=np.bool_),
        touched=np.zeros((lanes, robots), dtype=np.bool_),
        lost_now=np.zeros((lanes, robots), dtype=np.bool_),
        touched_now=np.zeros((lanes, robots), dtype=np.bool_),
        touched_by=np.zeros((lanes, robots), dtype=np.int8),
        ranges=np.zeros((lanes, robots, len(rays))),
        calm=np.zeros(lanes, dtype=np.int64),
        ends=np.zeros((lanes, robots), dtype=np.int8),
        scales=np.array([entry.scale for entry in tracking.values()]),
        sensor_scales=np.array([entry.scale for entry in sensor.values()]),
        weights=np.array([scenario.reward[name] for name in RewardTerms._fields]),
        previews=np.array(scenario.preview_steps, dtype=np.int64),
        changing=changing_channels([one.disturbance for one in scenarios], scenario.adversary),
        timed=np.ones(robots, dtype=np.bool_),
    )
