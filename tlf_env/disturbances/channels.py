"""The channels through which a disturbance acts: neutral value, range, rate and random stream of each."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

NOMINAL_NOISE_MM = math.sqrt(0.2)  # σ_m of eq. (37): a variance of 0.2 mm² per coordinate

# Streams of random numbers that belong to no channel. A stream's number is part of every recorded
# result: it never changes, and a number once used is never used for anything else.
POSITION_NOISE = 1
START_POSE = 2
ENCODER_NOISE = 3
RADIO_JITTER = 4
RADIO_DROPOUT = 5
MIXTURE = 6
MOVING_OBSTACLE = 7
RAYS = 8
POSITION_OUTAGE = 9
POSITION_OUTLIER = 10
GYRO_NOISE = 11

Rate = Literal["substep", "control step", "episode"]
SUBSTEP: Rate = "substep"  # acts in the plant and the sensors, so it is evaluated in every substep
CONTROL_STEP: Rate = "control step"  # evaluated once per control step
EPISODE: Rate = "episode"  # evaluated once, at the start


class Channel(NamedTuple):
    """One channel. The order of :data:`CHANNELS` is free; path, stream and nominal value never change.

    The nominal value is the one without a disturbance. A recorded result counts it as absent, so a
    channel may be added at any time without changing what older results are compared by.
    """

    path: str  # in YAML
    stream: int  # of its random numbers
    rate: Rate
    nominal: float
    limits: tuple[float, float]  # smallest and largest value allowed
    meaning: str

    @property
    def key(self) -> str:
        """Its key in an info, and its field in :class:`Effects`: the path with ``_`` for ``.``."""
        return self.path.replace(".", "_")

    @property
    def low(self) -> float:
        """The smallest value allowed."""
        return self.limits[0]

    @property
    def high(self) -> float:
        """The largest value allowed."""
        return self.limits[1]


CHANNELS = (
    Channel("slip.delta_1_mm_s", 100, SUBSTEP, 0.0, (-2000.0, 2000.0), "slip δ₁ of eq. (14), both wheels"),
    Channel("slip.delta_2_rad_s", 101, SUBSTEP, 0.0, (-20.0, 20.0), "slip δ₂ of eq. (14)"),
    Channel("tyre.friction_scale", 102, SUBSTEP, 1.0, (0.0, 100.0), "factor on the friction of all tyres"),
    Channel("position.bias_x_mm", 103, SUBSTEP, 0.0, (-1e4, 1e4), "offset of the position fixes, x"),
    Channel("position.bias_y_mm", 104, SUBSTEP, 0.0, (-1e4, 1e4), "offset of the position fixes, y"),
    Channel("position.noise_std_mm", 105, SUBSTEP, NOMINAL_NOISE_MM, (0.0, 1e3), "white noise of a fix"),
    Channel("encoder.noise_std_rad", 106, SUBSTEP, 0.0, (0.0, 1.0), "white noise of each encoder reading"),
    Channel("encoder.quantum_rad", 107, SUBSTEP, 0.0, (0.0, 1.0), "resolution of the encoders"),
    Channel("actuator.torque_gain_l", 108, SUBSTEP, 1.0, (0.0, 10.0), "delivered/commanded torque, left"),
    Channel("actuator.torque_gain_r", 109, SUBSTEP, 1.0, (0.0, 10.0), "delivered/commanded torque, right"),
    Channel("actuator.dead_time_s", 110, CONTROL_STEP, 0.0, (0.0, 0.1), "from wheel loop to torque"),
    Channel("actuator.computing_delay_s", 111, CONTROL_STEP, 0.0, (0.0, 1.0), "from action to wheel loop"),
    Channel("radio.jitter_s", 112, CONTROL_STEP, 0.0, (0.0, 10.0), "largest extra age of a message"),
    Channel("radio.dropout", 113, CONTROL_STEP, 0.0, (0.0, 0.999), "share of messages that never arrive"),
    Channel("payload.mass_kg", 114, EPISODE, 0.0, (0.0, 100.0), "mass put on the chassis"),
    Channel("payload.behind_mm", 115, EPISODE, 0.0, (-200.0, 200.0), "its distance behind the axle's midpoint"),
    Channel("payload.inertia_kg_mm2", 116, EPISODE, 0.0, (0.0, 1e7), "its inertia about its own centre"),
    Channel("start.position_std_mm", 117, EPISODE, 0.0, (0.0, 1e4), "scatter of the starts, per coordinate"),
    Channel("start.heading_std_rad", 118, EPISODE, 0.0, (0.0, 10.0), "scatter of the start headings"),
    Channel("slip.left_mm_s", 119, SUBSTEP, 0.0, (-2000.0, 2000.0), "slip added under the left wheel"),
    Channel("slip.right_mm_s", 120, SUBSTEP, 0.0, (-2000.0, 2000.0), "slip added under the right wheel"),
    Channel("tyre.friction_left", 121, SUBSTEP, 1.0, (0.0, 100.0), "factor on the left drive tyre"),
    Channel("tyre.friction_right", 122, SUBSTEP, 1.0, (0.0, 100.0), "factor on the right drive tyre"),
    Channel("tyre.creep", 123, SUBSTEP, 0.0, (0.0, 10.0), "slip ratio per force over load, below the limit"),
    Channel("floor.rolling_resistance", 124, SUBSTEP, 0.0, (0.0, 1.0), "resisting force over load, each wheel"),
    Channel("floor.slope_rad", 125, SUBSTEP, 0.0, (-0.7, 0.7), "slope of the floor"),
    Channel("floor.uphill_rad", 126, SUBSTEP, 0.0, (-10.0, 10.0), "direction in which it rises, from +y"),
    Channel("push.x_N", 127, SUBSTEP, 0.0, (-1000.0, 1000.0), "force at the centre of mass, x"),
    Channel("push.y_N", 128, SUBSTEP, 0.0, (-1000.0, 1000.0), "force at the centre of mass, y"),
    Channel("push.torque_Nmm", 129, SUBSTEP, 0.0, (-1e5, 1e5), "torque about the centre of mass"),
    Channel("actuator.back_emf_s_rad", 130, SUBSTEP, 0.0, (0.0, 1.0), "share of torque lost per rad/s"),
    Channel("actuator.dead_band_Nmm", 131, SUBSTEP, 0.0, (0.0, 1000.0), "smaller torques are not delivered"),
    Channel("actuator.current_limit", 132, SUBSTEP, 1.0, (0.0, 10.0), "factor on the torque limit delivered"),
    Channel("actuator.stall_torque", 144, SUBSTEP, 1.0, (0.0, 100.0), "torque at rest over the torque limit"),
    Channel("position.period_s", 133, EPISODE, 0.0, (0.0, 1.0), "between fixes; 0: one in every physics step"),
    Channel("position.delay_s", 134, EPISODE, 0.0, (0.0, 0.5), "age of a fix when it arrives"),
    Channel("position.outage", 135, SUBSTEP, 0.0, (0.0, 1.0), "share of the fixes that are missing"),
    Channel("position.outlier_share", 136, SUBSTEP, 0.0, (0.0, 1.0), "share of the fixes that are outliers"),
    Channel("position.outlier_std_mm", 137, SUBSTEP, 0.0, (0.0, 1e4), "further error of an outlier"),
    Channel("gyro.bias_rad_s", 138, SUBSTEP, 0.0, (-10.0, 10.0), "offset of the gyro"),
    Channel("gyro.scale", 139, SUBSTEP, 1.0, (0.0, 2.0), "measured over true yaw rate"),
    Channel("gyro.noise_rad_s_sqrt_hz", 140, SUBSTEP, 0.0, (0.0, 1.0), "density of the gyro's white noise"),
    Channel("calibration.radius_left", 141, EPISODE, 1.0, (0.5, 2.0), "believed over true radius, left"),
    Channel("calibration.radius_right", 142, EPISODE, 1.0, (0.5, 2.0), "believed over true radius, right"),
    Channel("calibration.track", 143, EPISODE, 1.0, (0.5, 2.0), "believed over true width of the axle"),
)  # fmt: skip


class Effects(NamedTuple):
    """Values of the channels of every substep, for one robot, by their keys."""

    slip_delta_1_mm_s: float
    slip_delta_2_rad_s: float
    tyre_friction_scale: float
    position_bias_x_mm: float
    position_bias_y_mm: float
    position_noise_std_mm: float
    encoder_noise_std_rad: float
    encoder_quantum_rad: float
    actuator_torque_gain_l: float
    actuator_torque_gain_r: float
    slip_left_mm_s: float
    slip_right_mm_s: float
    tyre_friction_left: float
    tyre_friction_right: float
    tyre_creep: float
    floor_rolling_resistance: float
    floor_slope_rad: float
    floor_uphill_rad: float
    push_x_N: float
    push_y_N: float
    push_torque_Nmm: float
    actuator_back_emf_s_rad: float
    actuator_dead_band_Nmm: float
    actuator_current_limit: float
    actuator_stall_torque: float
    position_outage: float
    position_outlier_share: float
    position_outlier_std_mm: float
    gyro_bias_rad_s: float
    gyro_scale: float
    gyro_noise_rad_s_sqrt_hz: float


PATHS = tuple(channel.path for channel in CHANNELS)
SET_WITHIN_EPISODE = tuple(channel.path for channel in CHANNELS if channel.rate != EPISODE)


def number(path: str) -> int:
    """A channel's place in :data:`CHANNELS`."""
    return PATHS.index(path)


def numbers(*rates: Rate) -> np.ndarray:
    """Places of the channels of some rates, in order."""
    return np.array([i for i, one in enumerate(CHANNELS) if one.rate in rates], dtype=np.int64)


def nominal_effects() -> Effects:
    """The effects without a disturbance."""
    return Effects(*(CHANNELS[i].nominal for i in numbers(SUBSTEP)))


def effects_of_group(group: str) -> list[str]:
    """Fields of :class:`Effects` that belong to a group of channels."""
    return [name for name in Effects._fields if name.startswith(f"{group}_")]


def _check_table() -> None:
    streams = [channel.stream for channel in CHANNELS]
    if len(set(streams)) < len(streams) or min(streams) < 100:
        raise ValueError("every channel needs a stream of its own, from 100 on")
    fields = tuple(CHANNELS[i].key for i in numbers(SUBSTEP))
    if Effects._fields != fields:
        raise ValueError(f"Effects must have the fields {fields}, has {Effects._fields}")


_check_table()

DEAD_TIME = number("actuator.dead_time_s")
COMPUTING_DELAY = number("actuator.computing_delay_s")
JITTER = number("radio.jitter_s")
DROPOUT = number("radio.dropout")
PAYLOAD_MASS = number("payload.mass_kg")
PAYLOAD_BEHIND = number("payload.behind_mm")
PAYLOAD_INERTIA = number("payload.inertia_kg_mm2")
START_POSITION = number("start.position_std_mm")
START_HEADING = number("start.heading_std_rad")
FIX_PERIOD = number("position.period_s")
FIX_DELAY = number("position.delay_s")
RADIUS_LEFT = number("calibration.radius_left")
RADIUS_RIGHT = number("calibration.radius_right")
TRACK = number("calibration.track")
