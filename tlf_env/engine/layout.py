"""One table of everything that the engine keeps of a robot; its places in memory follow from it.

A *row* is a named tuple of numbers of each robot. The rows of one kind lie in one array,
``(field, robot, lane)``, one after the other; a lane is one formation. A *tile* (see
:mod:`tlf_env.engine.tiles`) holds the rows of a few robots in the same order. Copying into a tile and
back, clearing a lane at the start of an episode and taking over a scenario's constants therefore work
on whole arrays and need no list of rows: a quantity is added by adding a row, or a field to its tuple.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from tlf_env.disturbances.channels import Effects
from tlf_env.numerics.rows import reader, row_reader, row_writer, writer
from tlf_env.onboard.calibration import Belief
from tlf_env.onboard.estimator import Ekf, Estimate
from tlf_env.onboard.gyro_estimator import GyroEkf, GyroEstimate
from tlf_env.onboard.rejection import RejectionState
from tlf_env.onboard.slip_estimator import SlipEkf, SlipEstimate
from tlf_env.onboard.speed_observer import SpeedObserverRow, SpeedObserverState
from tlf_env.onboard.wheel_loop import WheelLoopRow, WheelLoopState
from tlf_env.physics.vehicle import Body, Contact, Motion, Push


class Sensors(NamedTuple):
    """Last encoder readings (rad), the wheel speeds that follow from them (rad/s), and the estimator's way.

    The way is the sum of the motions by which the estimator moved its position (mm), without corrections.
    """

    encoder_l: float
    encoder_r: float
    speed_l: float
    speed_r: float
    way_x: float
    way_y: float


class Fix(NamedTuple):
    """Position fix of a substep."""

    x: float  # mm
    y: float
    here: float  # 1 if one has come, else 0
    age: float  # s
    way_x: float  # the estimator's way when it was measured, mm
    way_y: float


class Trace(NamedTuple):
    """Sums and extremes over the substeps of one control step."""

    distance: float  # odometry, mm
    turn: float  # odometry, rad
    moved: float  # odometry with the estimated slip, mm
    turned: float  # rad
    innovation_forward: float  # sums of the EKF's innovation in estimated body axes, mm
    innovation_right: float
    nis: float  # sum of the normalised innovation squared
    fixes: float  # number of position fixes
    off_x: float  # sums of the fixes minus the estimator's way when they were measured, mm
    off_y: float
    torque_l: float  # sums, mN·mm
    torque_r: float
    saturated: float  # substeps with a torque at its limit
    slip: float  # largest slip speed of a drive wheel, mm/s
    slid: float  # mean distance that the drive wheels slipped, mm
    torque_2: float  # sum of the squared torques of both wheels, (mN·mm)²
    work: float  # mechanical work that both motors put in, braking not counted, µJ


class WheelPair(NamedTuple):
    """Wheel speeds (rad/s), or torques (mN·mm)."""

    left: float
    right: float


class Pose(NamedTuple):
    """Pose of c: mm, mm, rad."""

    x: float
    y: float
    theta: float


class Way(NamedTuple):
    """A robot's dead reckoning at the end of a control step, and what was found for it later."""

    x: float  # the estimator's way, mm
    y: float
    turn: float  # turns since the start, rad
    theta: float  # the filter's heading, rad
    off_x: float  # sums of the step's fixes minus the way when they were measured, mm
    off_y: float
    fixes: float  # their number
    p_x: float  # smoothed position, mm
    p_y: float
    v_x: float  # smoothed velocity, mm/s
    v_y: float
    heading: float  # smoothed heading minus ``turn``, rad
    fitted: float  # 1 if there is a smoothed position, else 0


class Sample(NamedTuple):
    """Sensor readings of one substep."""

    fix_x: float  # last position fix, mm
    fix_y: float
    step_l: float  # angle increments of the wheels, rad
    step_r: float
    has_fix: float  # 1 if a fix has come in this substep, else 0
    fix_age: float  # its age, s
    gyro: float  # yaw rate, rad/s
    torque_l: float  # commanded, within the motor's limit, mN·mm
    torque_r: float


class Order(NamedTuple):
    """Command of one robot during a control step: rad/s, or mN·mm for torques."""

    kind: float  # of action
    wanted_l: float
    wanted_r: float
    before_l: float  # command of the first ``hold`` substeps
    before_r: float
    hold: float
    dead: float  # dead time of the torques, substeps
    fix_every: float  # substeps from a position fix to the next
    fix_delay: float  # age of a fix when it comes, substeps
    measured: float  # substeps since a fix was due to be measured
    arrived: float  # substeps since one was due to come


class Traction(NamedTuple):
    """Torques of one substep (mN·mm), and the factors on the tyres' friction."""

    commanded_l: float  # by the wheel loop or the action, within the motor's limit
    commanded_r: float
    delivered_l: float  # delivered
    delivered_r: float
    grip_l: float
    grip_r: float
    grip_c: float


class Reading(NamedTuple):
    """Encoder angles as read, rad."""

    left: float
    right: float


class YawRate(NamedTuple):
    """What the gyro reads."""

    reading: float  # rad/s


class Increments(NamedTuple):
    """Motion in a substep by the encoders: their steps (rad), distance (mm) and turn (rad)."""

    step_l: float
    step_r: float
    u_1: float
    u_2: float


class Innovation(NamedTuple):
    """Innovation of a position fix in world axes (mm), and its NIS; 0 without a fix."""

    d_x: float
    d_y: float
    nis: float


class Draw(NamedTuple):
    """Key of a random number, whole numbers; see :func:`tlf_env.numerics.philox.words`."""

    seed: int
    robot: int
    episode: int
    tick: int


class Rolls(NamedTuple):
    """1 if all wheels roll, so that the closed form of the plant holds; else 0."""

    all: float


class Column(NamedTuple):
    """robot · lanes + lane, a whole number: the robot's column in a flat array."""

    place: int


class Kind(Enum):
    """How long the numbers of a row are kept, and in which memory."""

    CONSTANT = "constant"  # copied from the scenario when an episode starts; read in every substep
    STATE = "state"  # changes in every substep; zero when an episode starts
    CONTROL = "control"  # changes once per control step, so it is not in tiles; zero when an episode starts
    SCRATCH = "scratch"  # of one substep or one control step; in tiles only
    WHOLE = "whole"  # the same, whole numbers, in a table of their own beside the tile


class Row(NamedTuple):
    """One row of the table."""

    name: str
    fields: type[Any]  # a named tuple of floats
    kind: Kind


ROWS = (
    Row("body", Body, Kind.CONSTANT),
    Row("wheel_loop", WheelLoopRow, Kind.CONSTANT),
    Row("ekf", Ekf, Kind.CONSTANT),
    Row("slip_ekf", SlipEkf, Kind.CONSTANT),
    Row("belief", Belief, Kind.CONSTANT),
    Row("speed_observer", SpeedObserverRow, Kind.CONSTANT),
    Row("gyro_ekf", GyroEkf, Kind.CONSTANT),  # the last of its kind: see WITHOUT_GYRO
    Row("motion", Motion, Kind.STATE),
    Row("contact", Contact, Kind.STATE),
    Row("loop_state", WheelLoopState, Kind.STATE),
    Row("sensors", Sensors, Kind.STATE),
    Row("observed_speed", SpeedObserverState, Kind.STATE),
    Row("commanded", WheelPair, Kind.STATE),  # torques within the motors' limits
    Row("estimate", Estimate, Kind.STATE),
    Row("slip", SlipEstimate, Kind.STATE),
    Row("trace", Trace, Kind.STATE),
    Row("gyro", GyroEstimate, Kind.STATE),  # the last of its kind
    Row("wanted", WheelPair, Kind.CONTROL),  # wheel speeds or torques that the action asks for
    Row("wanted_before", WheelPair, Kind.CONTROL),  # those of the step before
    Row("command", WheelPair, Kind.CONTROL),  # ``wanted``, or torques of a wheel loop outside
    Row("observer", Pose, Kind.CONTROL),
    Row("start", Pose, Kind.CONTROL),
    Row(
        "rejection", RejectionState, Kind.CONTROL
    ),  # of the reference's law, or of a residual's base
    Row("effects", Effects, Kind.SCRATCH),  # copied from the channels' values
    Row("sample", Sample, Kind.SCRATCH),
    Row("order", Order, Kind.SCRATCH),
    Row("traction", Traction, Kind.SCRATCH),
    Row("push", Push, Kind.SCRATCH),
    Row("reading", Reading, Kind.SCRATCH),
    Row("fix", Fix, Kind.SCRATCH),
    Row("yaw_rate", YawRate, Kind.SCRATCH),
    Row("moved", Motion, Kind.SCRATCH),  # as the plant leaves it, before the pose is advanced
    Row("impulses", Contact, Kind.SCRATCH),
    Row("rolls", Rolls, Kind.SCRATCH),
    Row("draw", Draw, Kind.WHOLE),
    Row("column", Column, Kind.WHOLE),
)
BY_NAME = {row.name: row for row in ROWS}


def fields_of(*kinds: Kind) -> int:
    """How many fields the rows of some kinds have."""
    return sum(len(row.fields._fields) for row in ROWS if row.kind in kinds)


def _first_fields(*kinds: Kind) -> dict[str, int]:
    """Where each row of some kinds begins, kind after kind."""
    first, places = 0, {}
    for row in (row for kind in kinds for row in ROWS if row.kind is kind):
        places[row.name] = first
        first += len(row.fields._fields)
    return places


CONSTANT_FIELDS = fields_of(Kind.CONSTANT)
STATE_FIELDS = fields_of(Kind.STATE)  # those of ``Arrays.states`` that are copied into tiles
TILE_ROWS = fields_of(Kind.CONSTANT, Kind.STATE, Kind.SCRATCH)
WHOLE_ROWS = fields_of(Kind.WHOLE)
_IN_ARRAYS = _first_fields(Kind.CONSTANT) | _first_fields(Kind.STATE, Kind.CONTROL)
_IN_TILES = _first_fields(Kind.CONSTANT, Kind.STATE, Kind.SCRATCH) | _first_fields(Kind.WHOLE)
CONSTANTS_IN_TILE, STATES_IN_TILE = 0, CONSTANT_FIELDS
# How many fields of the constants and of the states are read without the filter that uses the gyro.
WITHOUT_GYRO = _IN_ARRAYS["gyro_ekf"], _IN_ARRAYS["gyro"]
EFFECTS_IN_TILE = _IN_TILES["effects"]


def in_array(name: str, field: str | None = None) -> int:
    """Place of a row, or of one of its fields, in ``Arrays.constants`` or ``Arrays.states``."""
    return _IN_ARRAYS[name] + _place(name, field)


def in_tile(name: str, field: str | None = None) -> int:
    """Place of a row, or of one of its fields, in a tile, or in the table of whole numbers beside it."""
    return _IN_TILES[name] + _place(name, field)


def _place(name: str, field: str | None) -> int:
    return 0 if field is None else BY_NAME[name].fields._fields.index(field)


def array_reader(name: str) -> Callable[..., Any]:
    """Compiled ``read(array, robot, lane)`` of a row's named tuple."""
    return reader(BY_NAME[name].fields, in_array(name))


def array_writer(name: str) -> Callable[..., Any]:
    """Compiled ``write(array, robot, lane, row)``, the inverse of :func:`array_reader`."""
    return writer(BY_NAME[name].fields, in_array(name))


def tile_reader(name: str) -> Callable[..., Any]:
    """Compiled ``read(tile, i)`` of a row's named tuple, for the robot in column ``i``."""
    return row_reader(BY_NAME[name].fields, in_tile(name))


def tile_writer(name: str) -> Callable[..., Any]:
    """Compiled ``write(tile, i, row)``, the inverse of :func:`tile_reader`."""
    return row_writer(BY_NAME[name].fields, in_tile(name))


def tile_access(name: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """:func:`tile_reader` and :func:`tile_writer`."""
    return tile_reader(name), tile_writer(name)


def rows_of(array: np.ndarray, name: str) -> np.ndarray:
    """A row's fields in its array, ``(field, robot, lane)``; a view."""
    first = in_array(name)
    return array[first : first + len(BY_NAME[name].fields._fields)]
