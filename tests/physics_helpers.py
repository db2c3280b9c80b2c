"""Runs of one robot, recorded at every substep, and measures of what was recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tlf_env.numerics.compiled import driver
from tlf_env.physics.kernel import substep
from tlf_env.physics.parameters import Body, RobotParameters, body
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Push,
    advance_pose,
    read_body,
    read_contact,
    read_motion,
    write_contact,
    write_motion,
)

DT_S = 0.001
ROBOT = RobotParameters()
FLOOR = Floor(0.0, 0.0, 1.0, 1.0, 1.0)
STILL = Motion(*[0.0] * len(Motion._fields))
NO_MEMORY = Contact(*[0.0] * len(Contact._fields))


@driver
def record(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    torques: np.ndarray,
    pushes: np.ndarray,
    floors: np.ndarray,
    dt: float,
) -> None:
    """Fill ``motions`` and ``contacts`` (field, step, 1) from their first column on."""
    robot = read_body(bodies, 0, 0)
    for k in range(torques.shape[0]):
        floor = Floor(floors[k, 0], floors[k, 1], floors[k, 2], floors[k, 3], floors[k, 4])
        push = Push(pushes[k, 0], pushes[k, 1], pushes[k, 2])
        motion, contact = substep(
            robot,
            read_motion(motions, k, 0),
            read_contact(contacts, k, 0),
            floor,
            push,
            torques[k, 0],
            torques[k, 1],
            dt,
        )
        write_motion(motions, k + 1, 0, advance_pose(motion, dt))
        write_contact(contacts, k + 1, 0, contact)


class Run(NamedTuple):
    """Everything before the first and after every substep; fields are arrays over time."""

    motion: Motion
    contact: Contact

    def last(self) -> tuple[Motion, Contact]:
        return Motion(*(row[-1] for row in self.motion)), Contact(*(row[-1] for row in self.contact))


def run(
    robot: RobotParameters | Body = ROBOT,
    start: Motion = STILL,
    memory: Contact = NO_MEMORY,
    *,
    seconds: float,
    torques_Nmm: object = (0.0, 0.0),
    push: object = (0.0, 0.0, 0.0),
    floor: object = FLOOR,
    dt_s: float = DT_S,
) -> Run:
    """Drive one robot; torques (N·mm), push (mN, mN·mm) and floor are constant or one row a substep."""
    steps = round(seconds / dt_s)

    def rows(values: object) -> np.ndarray:
        array = np.asarray(values, dtype=np.float64)
        return np.ascontiguousarray(np.broadcast_to(array, (steps, array.shape[-1])))

    motions = np.zeros((len(Motion._fields), steps + 1, 1))
    contacts = np.zeros((len(Contact._fields), steps + 1, 1))
    motions[:, 0, 0], contacts[:, 0, 0] = start, memory
    constants = body(robot) if isinstance(robot, RobotParameters) else robot
    bodies = np.array(constants, dtype=np.float64).reshape(-1, 1, 1)
    record(bodies, motions, contacts, 1000.0 * rows(torques_Nmm), rows(push), rows(floor), dt_s)
    return Run(Motion(*motions[:, :, 0]), Contact(*contacts[:, :, 0]))


def rolling(robot: RobotParameters = ROBOT, forward: float = 0.0, yaw: float = 0.0) -> Motion:
    """At the origin, heading along +y, every wheel rolling, the castor's fork where it trails."""
    d, half = robot.com_offset_mm, robot.axle_width_mm / 2
    radius = robot.wheel_radius_mm
    base = robot.castor_pivot_mm
    phi = -math.atan2(yaw * base, forward) if forward or yaw else 0.0
    castor_speed = forward * math.cos(phi) - yaw * base * math.sin(phi)
    return STILL._replace(
        y=-d,
        psi=phi,
        v_x=yaw * d,
        v_y=forward,
        w=yaw,
        s=yaw,
        omega_l=(forward - yaw * half) / radius,
        omega_r=(forward + yaw * half) / radius,
        omega_c=castor_speed / robot.castor_radius_mm,
    )


def forward_speed(motion: Motion) -> np.ndarray:
    return -motion.v_x * np.sin(motion.theta) + motion.v_y * np.cos(motion.theta)


def kinetic_energy(robot: Body, motion: Motion) -> np.ndarray:
    """In mN·mm."""
    return 0.5 * (
        robot.m * (motion.v_x**2 + motion.v_y**2)
        + robot.I * motion.w**2
        + robot.I_s * motion.s**2
        + robot.J * (motion.omega_l**2 + motion.omega_r**2)
        + robot.J_c * motion.omega_c**2
    )


def bisect(starts_to: Callable[[float], bool], low: float, high: float, width: float) -> float:
    """Smallest value at which something starts, which it does not at ``low`` and does at ``high``."""
    assert not starts_to(low)
    assert starts_to(high)
    while high - low > width:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if starts_to(middle) else (middle, high)
    return 0.5 * (low + high)
