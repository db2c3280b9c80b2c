"""The observations ``tracking`` and ``sensor``: their entries, units and scales."""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.angles import wrap
from tlf_env.numerics.compiled import law
from tlf_env.onboard.observer import Message, Reference
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.onboard.tracking import body_errors

OBSERVATION_LIMIT = 10.0


class Entry(NamedTuple):
    """One entry of an observation: its meaning, its unit, and the value that is scaled to 1."""

    meaning: str
    unit: str
    scale: float


class Tracking(NamedTuple):
    """Entries of the ``tracking`` observation, in physical units, before scaling."""

    e_1: float
    e_2: float
    sin_e_3: float
    cos_e_3: float
    e_1_fine: float
    e_2_fine: float
    sin_e_3_fine: float
    reference_u_1: float
    reference_u_2: float
    odometry_u_1: float
    odometry_u_2: float
    last_action_0: float
    last_action_1: float
    command_u_1: float
    command_u_2: float
    innovation_forward: float
    innovation_right: float
    slip_1: float
    slip_2: float
    torque_l: float
    torque_r: float
    is_leader: float
    is_last: float
    predecessor_forward: float
    predecessor_right: float
    predecessor_sin_turn: float
    predecessor_cos_turn: float
    predecessor_u_1: float
    predecessor_u_2: float


TRACKING_ENTRIES = {
    "e_1": Entry("position error forward, e₁ of eq. (16), from the estimated pose", "mm", 500.0),
    "e_2": Entry("position error to the right, e₂", "mm", 500.0),
    "sin_e_3": Entry("sine of the heading error e₃", "1", 1.0),
    "cos_e_3": Entry("cosine of the heading error e₃", "1", 1.0),
    "e_1_fine": Entry("e₁ again, fine", "mm", 10.0),
    "e_2_fine": Entry("e₂ again, fine", "mm", 10.0),
    "sin_e_3_fine": Entry("sine of e₃ again, fine", "1", 0.1),
    "reference_u_1": Entry("speed of the reference, u₁*", "mm/s", 500.0),
    "reference_u_2": Entry("yaw rate of the reference, u₂*", "rad/s", 2.0),
    "odometry_u_1": Entry("speed by the wheels, mean over the last step", "mm/s", 500.0),
    "odometry_u_2": Entry("yaw rate by the wheels, mean over the last step", "rad/s", 2.0),
    "last_action_0": Entry("last action, first component", "1", 1.0),
    "last_action_1": Entry("last action, second component", "1", 1.0),
    "command_u_1": Entry(
        "last commanded speed of the wheels; 0 with action `torque`", "mm/s", 1000.0
    ),
    "command_u_2": Entry(
        "last commanded yaw rate of the wheels; 0 with action `torque`", "rad/s", 8.0
    ),
    "innovation_forward": Entry("EKF innovation forward, mean over the last step", "mm", 1.0),
    "innovation_right": Entry("EKF innovation to the right, mean over the last step", "mm", 1.0),
    "slip_1": Entry(
        "estimate of the slip δ₁; 0 with ekf, and with ekf-gyro while it has seen no slip of the floor",
        "mm/s",
        100.0,
    ),
    "slip_2": Entry("estimate of the slip δ₂, as that of slip_1", "rad/s", 1.0),
    "torque_l": Entry("torque of the left wheel, mean over the last step", "N·mm", 15.0),
    "torque_r": Entry("torque of the right wheel, mean over the last step", "N·mm", 15.0),
    "is_leader": Entry("1 for the leader (robot_0)", "1", 1.0),
    "is_last": Entry("1 for the last robot of the formation", "1", 1.0),
    "predecessor_forward": Entry(
        "position of the predecessor by its last message, forward of the estimated pose; this and the "
        "five that follow are 0 for the leader",
        "mm",
        500.0,
    ),
    "predecessor_right": Entry("its position, to the right of the estimated pose", "mm", 500.0),
    "predecessor_sin_turn": Entry("sine of its heading minus the estimated heading", "1", 1.0),
    "predecessor_cos_turn": Entry("cosine of its heading minus the estimated heading", "1", 1.0),
    "predecessor_u_1": Entry("its speed by the last message", "mm/s", 500.0),
    "predecessor_u_2": Entry("its yaw rate by the last message", "rad/s", 2.0),
}


class Preview(NamedTuple):
    """Entries that repeat for each preview time."""

    forward: float
    right: float
    sin_turn: float
    cos_turn: float
    u_1: float
    u_2: float


PREVIEW_ENTRIES = {
    "forward": Entry("position of the later reference, forward of the estimated pose", "mm", 500.0),
    "right": Entry(
        "position of the later reference, to the right of the estimated pose", "mm", 500.0
    ),
    "sin_turn": Entry("sine of its heading minus the estimated heading", "1", 1.0),
    "cos_turn": Entry("cosine of its heading minus the estimated heading", "1", 1.0),
    "u_1": Entry("its speed u₁*", "mm/s", 500.0),
    "u_2": Entry("its yaw rate u₂*", "rad/s", 2.0),
}


# Entries of the nearest robot that is heard besides the predecessor: whether there is one, and its Preview.
NEIGHBOUR_ENTRIES = {
    "neighbour_heard": Entry(
        "1 if a robot with a smaller number, other than the predecessor, is within range_mm; the nearest "
        "of these is the neighbour; the six that follow are 0 if there is none",
        "1",
        1.0,
    ),
    "neighbour_forward": Entry(
        "position of the neighbour by its last message, forward of the estimated pose", "mm", 500.0
    ),
    "neighbour_right": Entry("its position, to the right of the estimated pose", "mm", 500.0),
    "neighbour_sin_turn": Entry("sine of its heading minus the estimated heading", "1", 1.0),
    "neighbour_cos_turn": Entry("cosine of its heading minus the estimated heading", "1", 1.0),
    "neighbour_u_1": Entry("its speed by the last message", "mm/s", 500.0),
    "neighbour_u_2": Entry("its yaw rate by the last message", "rad/s", 2.0),
}


RAY_MEANING = "distance to the first thing that the ray meets, at most its range"


def ray_entries(rays: Rays | None) -> dict[str, Entry]:
    """Entries of the range sensors by name, ``ray_0`` and so on; none without range sensors."""
    if rays is None:
        return {}
    one = Entry(RAY_MEANING, "mm", rays.range_mm)
    return {f"ray_{i}": one for i in range(rays.count)}


def tracking_entries(
    preview_s: tuple[float, ...], rays: Rays | None = None, neighbour: Neighbour | None = None
) -> dict[str, Entry]:
    """All entries by name, in order; the previews' names carry their time: ``forward_in_0.5_s``.

    Those of a neighbour, if any, come after the previews and before the rays.
    """
    later = {
        f"{name}_in_{time_s:g}_s": entry
        for time_s in preview_s
        for name, entry in PREVIEW_ENTRIES.items()
    }
    heard = {} if neighbour is None else NEIGHBOUR_ENTRIES
    return TRACKING_ENTRIES | later | heard | ray_entries(rays)


def neighbour_place(preview_s: tuple[float, ...], neighbour: Neighbour | None) -> int:
    """Place of the neighbour's first entry in a ``tracking`` observation; −1 without a neighbour."""
    return -1 if neighbour is None else len(tracking_entries(preview_s))


@law
def scaled(value: float, scale: float) -> float:
    """An entry in its scale, clipped at ±10."""
    return min(max(value / scale, -OBSERVATION_LIMIT), OBSERVATION_LIMIT)


@law
def preview_entries(later: Reference | Message, x: float, y: float, theta: float) -> Preview:
    """A later reference, or another robot by its message, relative to an estimated pose."""
    forward, right = body_errors(later.x - x, later.y - y, theta)
    turn = wrap(later.theta - theta)
    return Preview(forward, right, math.sin(turn), math.cos(turn), later.u_1, later.u_2)


class SensorTail(NamedTuple):
    """Entries of the ``sensor`` observation after its samples, in physical units."""

    time: float
    start_x: float
    start_y: float
    start_sin: float
    start_cos: float
    message_x: float
    message_y: float
    message_sin: float
    message_cos: float
    message_u_1: float
    message_u_2: float
    is_leader: float


SAMPLE_ENTRIES = {
    "fix_x": Entry("position fix of c, x from the start pose's", "mm", 1000.0),
    "fix_y": Entry("position fix of c, y from the start pose's", "mm", 1000.0),
    "step_l": Entry("angle increment of the left wheel", "rad", 0.01),
    "step_r": Entry("angle increment of the right wheel", "rad", 0.01),
}
SENSOR_TAIL_ENTRIES = {
    "time": Entry(
        "time since the start; at 0 there is no sample yet, and the samples are 0", "s", 100.0
    ),
    "start_x": Entry("start pose of c, x in the world", "mm", 1000.0),
    "start_y": Entry("start pose of c, y in the world", "mm", 1000.0),
    "start_sin": Entry("sine of the start heading", "1", 1.0),
    "start_cos": Entry("cosine of the start heading", "1", 1.0),
    "message_x": Entry(
        "x relative to the own start: the leader's reference now, or the predecessor's broadcast of one "
        "gap ago (before that, its start pose at rest)",
        "mm",
        1000.0,
    ),
    "message_y": Entry("y of the same", "mm", 1000.0),
    "message_sin": Entry("sine of its heading", "1", 1.0),
    "message_cos": Entry("cosine of its heading", "1", 1.0),
    "message_u_1": Entry("its speed", "mm/s", 500.0),
    "message_u_2": Entry("its yaw rate", "rad/s", 2.0),
    "is_leader": Entry("1 for the leader (robot_0)", "1", 1.0),
}


def sensor_entries(substeps: int, rays: Rays | None = None) -> dict[str, Entry]:
    """All entries of ``sensor`` by name, in order; the samples' names carry their number, oldest first."""
    samples = {
        f"{name}_{k}": entry for k in range(substeps) for name, entry in SAMPLE_ENTRIES.items()
    }
    return samples | SENSOR_TAIL_ENTRIES | ray_entries(rays)
