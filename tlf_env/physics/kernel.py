"""The wheel kernel: one substep of one robot, implicit in all friction (``docs/physics.md``).

Frames are taken at mid attitude; torques and pushes enter as impulses; then the impulses of floor and
friction follow, in closed form where all wheels roll and by sweeps where not.
"""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import block
from tlf_env.physics.limits import limits
from tlf_env.physics.parameters import Body
from tlf_env.physics.rolling import rolling
from tlf_env.physics.state import Contact, Floor, Motion, Push, Rates
from tlf_env.physics.sweeps import sweep


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
    """Velocities after one substep; the pose is left to :func:`tlf_env.physics.state.advance_pose`.

    Torques in mN·mm, ``dt`` in s. Fork and wheel angles are advanced here with the new rates.
    """
    theta = motion.theta + 0.5 * dt * motion.w
    phi = motion.psi - motion.theta + 0.5 * dt * (motion.s - motion.w)
    cos_t, sin_t = math.cos(theta), math.sin(theta)
    cos_p, sin_p = math.cos(phi), math.sin(phi)

    most = limits(body, motion, contact, floor, dt)
    v_x = motion.v_x + push.f_x * dt * body.inverse_m
    v_y = motion.v_y + push.f_y * dt * body.inverse_m
    before = Rates(
        cos_t * v_x + sin_t * v_y,
        -sin_t * v_x + cos_t * v_y,
        motion.w,
        motion.s,
        motion.omega_l,
        motion.omega_r,
        motion.omega_c,
    )
    free = Rates(
        before.v_e,
        before.v_f,
        motion.w + push.torque * dt * body.inverse_I,
        motion.s,
        motion.omega_l + torque_l * dt * body.inverse_J,
        motion.omega_r + torque_r * dt * body.inverse_J,
        motion.omega_c,
    )
    rolls, after, impulses = rolling(body, free, before, cos_p, sin_p, floor, most)
    if not rolls:
        after, impulses = sweep(body, free, contact, cos_p, sin_p, floor, most)
    return (
        Motion(
            motion.x,
            motion.y,
            motion.theta,
            motion.psi + dt * after.s,
            cos_t * after.v_e - sin_t * after.v_f,
            sin_t * after.v_e + cos_t * after.v_f,
            after.w,
            after.s,
            after.omega_l,
            after.omega_r,
            after.omega_c,
            motion.angle_l + dt * after.omega_l,
            motion.angle_r + dt * after.omega_r,
        ),
        impulses,
    )
