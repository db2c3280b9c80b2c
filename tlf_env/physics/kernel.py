"""The wheel kernel: one substep of one robot, implicit in all friction (``docs/physics.md``).

Frames are taken at mid attitude, and torques and pushes enter as impulses. Then the impulses of floor and
friction are solved: in closed form if all wheels roll (:func:`roll`), otherwise by sweeps (:func:`slide`, or
for several robots at once :func:`begin_slide`, :func:`sweep_together` and :func:`end_slide`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.rows import replacing
from tlf_env.numerics.trig import sincos
from tlf_env.physics.friction_limits import FrictionLimits, friction_limits
from tlf_env.physics.parameters import Body
from tlf_env.physics.rolling import rolling
from tlf_env.physics.sliding import COLUMNS, ROWS, begin, end
from tlf_env.physics.state import Contact, Floor, Motion, Push, Rates
from tlf_env.physics.sweeps import sweep

SLIDE_ROWS, SLIDE_COLUMNS = ROWS + 2, COLUMNS  # the sweeps' rows, and two for the heading
SIN_T, COS_T = ROWS, ROWS + 1

with_torques = replacing(Rates, "w", "omega_l", "omega_r")


class SubstepFrame(NamedTuple):
    """Data of a substep from which the impulses of floor and friction are solved."""

    sin_t: float  # heading at mid attitude
    cos_t: float
    sin_p: float  # castor angle at mid attitude
    cos_p: float
    before: Rates  # velocities at the start of the substep
    free: Rates  # with torques and pushes, without floor and friction
    limits: FrictionLimits


@law
def substep_frame(
    body: Body,
    motion: Motion,
    contact: Contact,
    floor: Floor,
    push: Push,
    torque_l: float,
    torque_r: float,
    dt: float,
) -> SubstepFrame:
    """Frames at mid attitude, velocities without floor and friction, and limits of the friction impulses."""
    sin_t, cos_t = sincos(motion.theta + 0.5 * dt * motion.w)
    sin_p, cos_p = sincos(motion.psi - motion.theta + 0.5 * dt * (motion.s - motion.w))
    v_x = motion.v_x + push.f_x * dt * body.inverse_m
    v_y = motion.v_y + push.f_y * dt * body.inverse_m
    before = Rates(
        v_e=cos_t * v_x + sin_t * v_y,
        v_f=-sin_t * v_x + cos_t * v_y,
        w=motion.w,
        s=motion.s,
        omega_l=motion.omega_l,
        omega_r=motion.omega_r,
        omega_c=motion.omega_c,
    )
    free = with_torques(
        before,
        w=motion.w + push.torque * dt * body.inverse_I,
        omega_l=motion.omega_l + torque_l * dt * body.inverse_J,
        omega_r=motion.omega_r + torque_r * dt * body.inverse_J,
    )
    return SubstepFrame(
        sin_t=sin_t,
        cos_t=cos_t,
        sin_p=sin_p,
        cos_p=cos_p,
        before=before,
        free=free,
        limits=friction_limits(body, motion, contact, floor, dt),
    )


@law
def moved(motion: Motion, sin_t: float, cos_t: float, after: Rates, dt: float) -> Motion:
    """The motion with new velocities, in world axes by the heading at mid attitude.

    Fork and wheel angles are advanced with them.
    """
    return Motion(
        x=motion.x,
        y=motion.y,
        theta=motion.theta,
        psi=motion.psi + dt * after.s,
        v_x=cos_t * after.v_e - sin_t * after.v_f,
        v_y=sin_t * after.v_e + cos_t * after.v_f,
        w=after.w,
        s=after.s,
        omega_l=after.omega_l,
        omega_r=after.omega_r,
        omega_c=after.omega_c,
        angle_l=motion.angle_l + dt * after.omega_l,
        angle_r=motion.angle_r + dt * after.omega_r,
    )


@law
def roll(
    body: Body,
    motion: Motion,
    contact: Contact,
    floor: Floor,
    push: Push,
    torque_l: float,
    torque_r: float,
    dt: float,
) -> tuple[bool, Motion, Contact]:
    """Whether all three wheels roll, and the substep in closed form, which is valid only then."""
    frame = substep_frame(body, motion, contact, floor, push, torque_l, torque_r, dt)
    rolls, after, impulses = rolling(
        body, frame.free, frame.before, frame.cos_p, frame.sin_p, floor, frame.limits
    )
    return (
        rolls and floor.creep == 0.0,
        moved(motion, frame.sin_t, frame.cos_t, after, dt),
        impulses,
    )


@law
def slide(
    body: Body,
    motion: Motion,
    contact: Contact,
    floor: Floor,
    push: Push,
    torque_l: float,
    torque_r: float,
    dt: float,
) -> tuple[Motion, Contact]:
    """A substep by sweeps, valid whether the wheels roll or slide."""
    frame = substep_frame(body, motion, contact, floor, push, torque_l, torque_r, dt)
    after, impulses = sweep(
        body, frame.free, contact, frame.cos_p, frame.sin_p, floor, frame.limits
    )
    return moved(motion, frame.sin_t, frame.cos_t, after, dt), impulses


@law
def begin_slide(
    table: np.ndarray,
    column: int,
    slides: bool,
    body: Body,
    motion: Motion,
    contact: Contact,
    floor: Floor,
    push: Push,
    torque_l: float,
    torque_r: float,
    dt: float,
) -> None:
    """Prepare :func:`slide` of a robot in a column of a table for :func:`sweep_together`.

    The table has the shape ``(SLIDE_ROWS, SLIDE_COLUMNS)``; a robot that does not slide is left as it is.
    """
    frame = substep_frame(body, motion, contact, floor, push, torque_l, torque_r, dt)
    begin(
        table,
        column,
        slides,
        body,
        frame.free,
        contact,
        frame.cos_p,
        frame.sin_p,
        floor,
        frame.limits,
    )
    table[SIN_T, column], table[COS_T, column] = frame.sin_t, frame.cos_t


@law
def end_slide(table: np.ndarray, column: int, motion: Motion, dt: float) -> tuple[Motion, Contact]:
    """The result of :func:`slide` for the robot in a column."""
    after, impulses = end(table, column)
    return moved(motion, table[SIN_T, column], table[COS_T, column], after, dt), impulses


@block
def substep(
    body: Body,
    motion: Motion,
    contact: Contact,
    floor: Floor,
    push: Push,
    torque_l: float,
    torque_r: float,
    dt: float,
) -> tuple[Motion, Contact]:
    """Velocities after one substep; :func:`tlf_env.physics.state.advance_pose` advances the pose.

    Torques in mN·mm, ``dt`` in s. Fork and wheel angles are advanced here, with the new rates.
    """
    rolls, after, impulses = roll(body, motion, contact, floor, push, torque_l, torque_r, dt)
    if rolls:
        return after, impulses
    return slide(body, motion, contact, floor, push, torque_l, torque_r, dt)
