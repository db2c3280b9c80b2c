"""Runs of one robot, recorded at every substep, and measures of what was recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tlf_env.numerics.compiled import driver
from tlf_env.physics.kernel import substep
from tlf_env.physics.parameters import (
    Body,
    FrictionCurve,
    JointFriction,
    RobotParameters,
    body,
)
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
WITHOUT_JOINT_FRICTION = RobotParameters(joint_friction=False)


def complete(floor: ArrayLike) -> np.ndarray:
    """A floor, or one a substep, with zeros for the fields that are not given."""
    given = np.asarray(floor, dtype=np.float64)
    missing = np.zeros((*given.shape[:-1], len(Floor._fields) - given.shape[-1]))
    return np.concatenate([given, missing], axis=-1)


FLOOR = Floor(0.0, 0.0, 1.0, 1.0, 1.0)
ICE = Floor(0.0, 0.0, 0.0, 0.0, 0.0)
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
    """Fill ``motions`` and ``contacts`` (field, substep, 1) from their first column on."""
    robot = read_body(bodies, 0, 0)
    for k in range(torques.shape[0]):
        floor = Floor(
            floors[k, 0],
            floors[k, 1],
            floors[k, 2],
            floors[k, 3],
            floors[k, 4],
            floors[k, 5],
            floors[k, 6],
        )
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
    """The state before the first and after every substep: every field is an array over time."""

    motion: Motion
    contact: Contact

    def last(self) -> tuple[Motion, Contact]:
        return self.at(-1)

    def at(self, k: int) -> tuple[Motion, Contact]:
        return Motion(*(row[k] for row in self.motion)), Contact(*(row[k] for row in self.contact))


def run(
    robot: RobotParameters | Body = ROBOT,
    start: Motion = STILL,
    memory: Contact = NO_MEMORY,
    *,
    seconds: float,
    torques_Nmm: ArrayLike = (0.0, 0.0),
    push: ArrayLike = (0.0, 0.0, 0.0),
    floor: ArrayLike = FLOOR,
    dt_s: float = DT_S,
) -> Run:
    """Drive a robot; torques (left, right), push (mN, mN, mN·mm) and floor: one row, or one a substep."""
    steps = round(seconds / dt_s)

    def rows(values: ArrayLike) -> np.ndarray:
        array = np.asarray(values, dtype=np.float64)
        return np.ascontiguousarray(np.broadcast_to(array, (steps, array.shape[-1])))

    motions = np.zeros((len(Motion._fields), steps + 1, 1))
    contacts = np.zeros((len(Contact._fields), steps + 1, 1))
    motions[:, 0, 0], contacts[:, 0, 0] = start, memory
    constants = body(robot) if isinstance(robot, RobotParameters) else robot
    bodies = np.array(constants, dtype=np.float64).reshape(-1, 1, 1)
    record(
        bodies,
        motions,
        contacts,
        1000.0 * rows(torques_Nmm),
        rows(push),
        rows(complete(floor)),
        dt_s,
    )
    return Run(Motion(*motions[:, :, 0]), Contact(*contacts[:, :, 0]))


def rolling(robot: RobotParameters = ROBOT, forward: float = 0.0, yaw: float = 0.0) -> Motion:
    """Heading along +y, the axle's midpoint at the origin, every wheel rolling, the castor trailing."""
    phi = math.atan2(-yaw * robot.castor_pivot_mm, forward)
    castor_speed = math.hypot(yaw * robot.castor_pivot_mm, forward)
    turn = yaw * robot.axle_width_mm / 2
    return STILL._replace(
        y=-robot.com_offset_mm,
        psi=phi,
        v_x=yaw * robot.com_offset_mm,
        v_y=forward,
        w=yaw,
        s=yaw,
        omega_l=(forward - turn) / robot.wheel_radius_mm,
        omega_r=(forward + turn) / robot.wheel_radius_mm,
        omega_c=castor_speed / robot.castor_radius_mm,
    )


def random_start(rng: np.random.Generator, scale: float = 1.0) -> Motion:
    """Every velocity at random, so that most wheels slide; ``scale`` 1 is a fast robot."""
    speeds = [300, 300, 2, 5, 10, 10, 20] * rng.normal(size=7) * scale
    theta, psi = rng.uniform(-4, 4, 2)
    return Motion(*rng.normal(size=2), theta, psi, *speeds, 0.0, 0.0)


def random_torques(rng: np.random.Generator, seconds: float, largest_Nmm: float) -> np.ndarray:
    """Torques that jump every 50 ms, one row a substep."""
    levels = rng.uniform(-largest_Nmm, largest_Nmm, (round(seconds / 0.05), 2))
    return np.repeat(levels, 50, axis=0)


def wheel_slip(robot: RobotParameters, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """δ₁ and δ₂ of eq. (14) after every substep: the twist of c less what the drive wheels make of it.

    Body axes are those at mid attitude, in which the kernel solves.
    """
    radius, width = robot.wheel_radius_mm, robot.axle_width_mm
    middle = motion.theta[:-1] + motion.w[:-1] * DT_S / 2
    after = Motion(*(x[1:] for x in motion))
    forward = -after.v_x * np.sin(middle) + after.v_y * np.cos(middle)
    delta_1 = forward - radius * (after.omega_l + after.omega_r) / 2
    delta_2 = after.w - radius * (after.omega_r - after.omega_l) / width
    return delta_1, delta_2


def kinetic_energy(robot: RobotParameters | Body, motion: Motion) -> np.ndarray:
    """Of all five bodies, in mN·mm; in the precision of ``motion``."""
    r = body(robot) if isinstance(robot, RobotParameters) else robot
    return 0.5 * (
        r.m * (motion.v_x**2 + motion.v_y**2)
        + r.I * motion.w**2
        + r.I_s * motion.s**2
        + r.J * (motion.omega_l**2 + motion.omega_r**2)
        + r.J_c * motion.omega_c**2
    )


def first(starts: Callable[[float], bool], low: float, high: float, width: float) -> float:
    """Smallest value, to within ``width``, at which something starts that does not at ``low``."""
    assert not starts(low)
    assert starts(high)
    while high - low > width:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if starts(middle) else (middle, high)
    return 0.5 * (low + high)


def forward_speed(motion: Motion) -> np.ndarray:
    return -motion.v_x * np.sin(motion.theta) + motion.v_y * np.cos(motion.theta)


def curve(mu: FrictionCurve, speed: np.ndarray) -> np.ndarray:
    """Coefficient of Fig. 3(b) at speeds in mm/s."""
    x = np.clip(
        (np.abs(speed) - mu.stiction_speed_mm_s) / (mu.dynamic_speed_mm_s - mu.stiction_speed_mm_s),
        0,
        1,
    )
    return mu.mu_static + (mu.mu_dynamic - mu.mu_static) * x**2 * (3 - 2 * x)


def joint_torque(joint: JointFriction, speed, axial, radial, moment) -> np.ndarray:
    """Eq. (5), mN·mm."""
    lever = joint.pin_radius_mm / joint.bending_arm_mm
    return curve(joint, speed) * (
        joint.friction_arm_mm * np.abs(axial)
        + joint.pin_radius_mm * np.abs(radial)
        + lever * np.abs(moment)
        + 1000 * joint.preload_Nmm
    )
