"""The channels through which a disturbance acts: what each is without it, its range, its random stream."""

from __future__ import annotations

import math
from typing import NamedTuple

NOMINAL_NOISE_MM = math.sqrt(0.2)  # σ_m of eq. (37): a variance of 0.2 mm² per coordinate

# Numbers of random streams that belong to no channel. A number, once given, is never given again: it is
# part of every result. Channels use FIRST_CHANNEL_STREAM + their place below, so their order is fixed too.
POSITION_NOISE = 1
START_POSE = 2
ENCODER_NOISE = 3
RADIO_JITTER = 4
RADIO_DROPOUT = 5
MIXTURE = 6
FIRST_CHANNEL_STREAM = 100


class Channel(NamedTuple):
    """One channel: path in YAML, value without a disturbance, and the range that makes sense."""

    path: str
    nominal: float
    low: float
    high: float
    meaning: str


CHANNELS = (
    # every substep
    Channel(
        "slip.delta_1_mm_s", 0.0, -2000.0, 2000.0, "slip δ₁ of eq. (14), under both drive wheels"
    ),
    Channel("slip.delta_2_rad_s", 0.0, -20.0, 20.0, "slip δ₂ of eq. (14)"),
    Channel("tyre.friction_scale", 1.0, 0.0, 100.0, "factor on the friction of all tyres"),
    Channel("position.bias_x_mm", 0.0, -1e4, 1e4, "offset of the position fixes, x"),
    Channel("position.bias_y_mm", 0.0, -1e4, 1e4, "offset of the position fixes, y"),
    Channel(
        "position.noise_std_mm",
        NOMINAL_NOISE_MM,
        0.0,
        1e3,
        "white noise of each coordinate of a fix",
    ),
    Channel("encoder.noise_std_rad", 0.0, 0.0, 1.0, "white noise of each encoder reading"),
    Channel("encoder.quantum_rad", 0.0, 0.0, 1.0, "resolution of the encoders"),
    Channel(
        "actuator.torque_gain_l", 1.0, 0.0, 10.0, "torque delivered over torque asked for, left"
    ),
    Channel("actuator.torque_gain_r", 1.0, 0.0, 10.0, "the same, right"),
    # every control step
    Channel("actuator.dead_time_s", 0.0, 0.0, 0.1, "delay between the wheel loop and the torque"),
    Channel(
        "actuator.computing_delay_s", 0.0, 0.0, 1.0, "delay between an action and the wheel loops"
    ),
    Channel(
        "radio.jitter_s", 0.0, 0.0, 10.0, "a message is up to this much older than the time gap"
    ),
    Channel("radio.dropout", 0.0, 0.0, 0.999, "share of messages that never arrive"),
    # once per episode
    Channel("payload.mass_kg", 0.0, 0.0, 100.0, "mass put on the chassis"),
    Channel("payload.behind_mm", 0.0, -200.0, 200.0, "its place behind the axle's midpoint"),
    Channel("payload.inertia_kg_mm2", 0.0, 0.0, 1e7, "its inertia about its own centre"),
    Channel(
        "start.position_std_mm", 0.0, 0.0, 1e4, "scatter of the start positions, per coordinate"
    ),
    Channel("start.heading_std_rad", 0.0, 0.0, 10.0, "scatter of the start headings"),
)
PATHS = tuple(channel.path for channel in CHANNELS)
SUBSTEP_CHANNELS = 10
STEP_CHANNELS = 14


def number(path: str) -> int:
    """A channel's place."""
    return PATHS.index(path)


DEAD_TIME = number("actuator.dead_time_s")
COMPUTING_DELAY = number("actuator.computing_delay_s")
JITTER = number("radio.jitter_s")
DROPOUT = number("radio.dropout")
PAYLOAD_MASS = number("payload.mass_kg")
PAYLOAD_BEHIND = number("payload.behind_mm")
PAYLOAD_INERTIA = number("payload.inertia_kg_mm2")
START_POSITION = number("start.position_std_mm")
START_HEADING = number("start.heading_std_rad")
