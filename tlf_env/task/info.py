"""Results of a step beside the observation: ``info``, ``state`` and the reasons of an episode's end."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from tlf_env.common.errors import nearest, shown
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.task.reward import REWARD_MEANINGS


class Info(NamedTuple):
    """The contents of ``info`` for one robot after a step; see :data:`INFO_MEANINGS`."""

    position_error_mm: float
    formation_error_mm: float
    heading_error_rad: float
    time_gap_error_s: float
    slip_mm_s: float
    torque_l_Nmm: float
    torque_r_Nmm: float
    torque_rms_Nmm: float
    energy_mJ: float
    slid_mm: float
    saturation_fraction: float
    innovation_nis: float
    x_mm: float
    y_mm: float
    theta_rad: float
    reference_x_mm: float
    reference_y_mm: float
    reference_theta_rad: float
    clipped: float


TIME_GAP_KEY = "time_gap_error_s"


class EndReason(IntEnum):
    """Why a robot's episode ended in a step: the values of ``info["end"]`` and ``BatchPlant.ends``."""

    RUNNING = 0
    LOST = 1
    TOUCHED = 2
    OTHER_ROBOT = 3
    HORIZON = 4


class TouchedBy(IntEnum):
    """What a robot touched first: the values of ``info["touched_by"]`` and ``BatchPlant.touched_by``."""

    NOTHING = 0
    ROBOT = 1
    WALL = 2
    OBSTACLE = 3


# The same as plain numbers, for compiled laws.
RUNNING, LOST, TOUCHED, OTHER_ROBOT, HORIZON = (int(reason) for reason in EndReason)
NOTHING, ROBOT, WALL, OBSTACLE = (int(thing) for thing in TouchedBy)

INFO_MEANINGS = {
    "position_error_mm": "true position of c to the robot's own reference (leader: the path)",
    "formation_error_mm": "true position to ref(t − i·gap), at rest at ref(0) before",
    "heading_error_rad": "reference's heading minus the true one, within ±π",
    "time_gap_error_s": "how much later than one gap ago the predecessor passed here; 0 for the "
    "leader and before one gap",
    "slip_mm_s": "largest slip speed of a drive wheel in the step",
    "torque_l_Nmm": "torque delivered to the left wheel, mean over the step",
    "torque_r_Nmm": "torque delivered to the right wheel, mean over the step",
    "torque_rms_Nmm": "root mean square over the step and both wheels",
    "energy_mJ": "work of the motors during the step; braking returns none",
    "slid_mm": "mean distance that the drive wheels slipped in the step",
    "saturation_fraction": "share of the substeps with a commanded torque at its limit",
    "innovation_nis": "normalised innovation squared of the EKF, mean over the step",
    "x_mm": "true position of c",
    "y_mm": "true position of c",
    "theta_rad": "true heading, not wrapped",
    "reference_x_mm": "the robot's own reference",
    "reference_y_mm": "the robot's own reference",
    "reference_theta_rad": "its heading",
    "clipped": "actions of this robot outside [−1, 1] so far in the episode",
}
FLAG_MEANINGS = {
    "lost": "whether the robot was lost at any time so far",
    "touched": "whether it touched another robot, a wall or an obstacle at any time so far",
    "touched_by": "what it touched first, a `tlf_env.TouchedBy`: 0 nothing, 1 a robot, 2 a wall or "
    "another thing that stands fast, 3 a moving obstacle",
    "end": "why the episode ended in this step, a `tlf_env.EndReason`: 0 running, 1 lost, 2 touched, "
    "3 another robot ended it, 4 horizon",
}
# All keys of an info, in order, with their meanings.
MEANINGS = {
    **INFO_MEANINGS,
    **{f"reward_{name}": f"reward term: {text}" for name, text in REWARD_MEANINGS.items()},
    **{channel.key: f"disturbance: {channel.meaning}" for channel in CHANNELS},
    **FLAG_MEANINGS,
}
INFO_KEYS = tuple(MEANINGS)

InfoChoice = bool | Sequence[str]


def chosen_keys(infos: InfoChoice) -> tuple[str, ...]:
    """Keys of the infos that an environment returns: all if True, none if False, or those listed.

    Raises
    ------
    ValueError
        for an unknown key, or anything else.
    """
    if isinstance(infos, bool):
        return INFO_KEYS if infos else ()
    if isinstance(infos, str) or not isinstance(infos, Sequence):
        raise ValueError(f"infos {shown(infos)} must be True, False or a sequence of keys of info")
    for key in infos:
        check_key(key)
    return tuple(dict.fromkeys(infos))


def check_key(key: str) -> None:
    """Check that info has a key.

    Raises
    ------
    ValueError
        naming the key and the nearest one that exists.
    """
    if key in INFO_KEYS:
        return
    hint = nearest(key, INFO_KEYS) or f"; the keys are {', '.join(INFO_KEYS)}"
    raise ValueError(f"info has no key {shown(key)}{hint}")


class State(NamedTuple):
    """One robot's true state, for critics that may see it: c, castor, twist, wheels, reference."""

    x_mm: float
    y_mm: float
    sin_theta: float
    cos_theta: float
    castor_rad: float
    forward_mm_s: float
    right_mm_s: float
    yaw_rad_s: float
    omega_l_rad_s: float
    omega_r_rad_s: float
    reference_x_mm: float
    reference_y_mm: float
