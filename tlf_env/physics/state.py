"""A robot's state in the kernel. Units: mm, kg, s, rad; forces mN, impulses mN·s and mN·mm·s."""

from __future__ import annotations

from typing import NamedTuple

from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import reader, replacing, writer
from tlf_env.numerics.trig import sincos
from tlf_env.physics.parameters import Body


class Motion(NamedTuple):
    """Pose and velocities of the five bodies. Heading 0 is +y (unlike ROS REP-103, where it is +x)."""

    x: float  # centre of mass, mm
    y: float
    theta: float  # heading, rad, counter-clockwise from +y, not wrapped
    psi: float  # fork angle in the world, rad; castor angle φ = ψ − θ
    v_x: float  # velocity of the centre of mass, mm/s
    v_y: float
    w: float  # yaw rate, rad/s
    s: float  # fork rate ψ̇, rad/s
    omega_l: float  # spins, rad/s
    omega_r: float
    omega_c: float
    angle_l: float  # drive wheels' angles, rad
    angle_r: float


class Contact(NamedTuple):
    """Previous impulses, from which the solver starts, and slip speeds; part of the state."""

    p_le: float  # tyre impulses, mN·s
    p_lf: float
    p_re: float
    p_rf: float
    p_cx: float  # castor, ⊥ to the fork
    p_cy: float  # castor, ∥ to the fork
    q_l: float  # joint friction impulses, mN·mm·s
    q_r: float
    q_c: float
    q_s: float  # steering
    slip_l: float  # slip speeds |v| at the floor, mm/s
    slip_r: float
    slip_c: float


class Rates(NamedTuple):
    """Velocities in body axes: e to the right, f forward (mm/s, rad/s)."""

    v_e: float
    v_f: float
    w: float
    s: float
    omega_l: float
    omega_r: float
    omega_c: float


class Floor(NamedTuple):
    """Effect of the floor on one robot in one substep."""

    conveyor_l: float  # σ_l, σ_r: injected slip of eq. (14) as speeds of the floor, mm/s
    conveyor_r: float
    grip_l: float  # factors on the tyres' friction
    grip_r: float
    grip_c: float
    rolling: float = 0.0  # resistance to rolling: force over load
    creep: float = 0.0  # slip ratio per force over load, of a tyre below its limit


class Push(NamedTuple):
    """External force at the centre of mass in world axes (mN) and torque (mN·mm)."""

    f_x: float
    f_y: float
    torque: float


read_body = reader(Body)
read_motion = reader(Motion)
write_motion = writer(Motion)
read_contact = reader(Contact)
write_contact = writer(Contact)
with_pose = replacing(Motion, "x", "y", "theta")


@law
def conveyor(delta_1: float, delta_2: float, half_width: float) -> tuple[float, float]:
    """Speeds of the floor (left, right; mm/s) that inject the slip δ₁ (mm/s), δ₂ (rad/s) of eq. (14)."""
    return delta_1 - delta_2 * half_width, delta_1 + delta_2 * half_width


@law
def forward_and_yaw(motion: Motion) -> tuple[float, float]:
    """Speed along the heading (mm/s; equal for all points of the robot's axis) and yaw rate (rad/s)."""
    sin, cos = sincos(motion.theta)
    return motion.v_y * cos - motion.v_x * sin, motion.w


@law
def advance_pose(motion: Motion, dt: float) -> Motion:
    """The pose after one substep, computed exactly as Chipmunk does: p + v·dt, θ + w·dt."""
    return with_pose(
        motion,
        x=motion.x + motion.v_x * dt,
        y=motion.y + motion.v_y * dt,
        theta=motion.theta + motion.w * dt,
    )


@law
def axle_midpoint(motion: Motion, d: float) -> tuple[float, float]:
    """Position of c, mm: the centre of mass lies ``d`` behind it."""
    sin, cos = sincos(motion.theta)
    return motion.x - d * sin, motion.y + d * cos
