"""Largest friction impulses of tyres and joints in a substep; constant while the impulses are solved."""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.compiled import law
from tlf_env.physics.friction import coefficient
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Contact, Floor, Motion


class FrictionLimits(NamedTuple):
    """Friction circles of the tyres (mN·s) and largest friction impulses of the joints (mN·mm·s)."""

    grip_l: float
    grip_r: float
    grip_c: float
    axle_l: float
    axle_r: float
    axle_c: float
    steering: float
    creep_l: float  # compliance of a tyre below its limit: slip per impulse, mm/s per mN·s
    creep_r: float
    creep_c: float


@law
def creep(floor: Floor, speed: float, load: float, dt: float) -> float:
    """Compliance of a tyre that rolls at a speed (mm/s): slip = creep·|speed|·force/load."""
    return floor.creep * abs(speed) / (load * dt)


@law
def grip(body: Body, load: float, factor: float, slip: float, dt: float) -> float:
    """Radius μN·dt of a tyre's friction circle at its last slip speed (mm/s)."""
    mu = coefficient(slip, body.mu_static, body.mu_dynamic, body.stiction_speed, body.dynamic_speed)
    return mu * load * factor * dt


@law
def drive_axle(body: Body, omega: float, p_e: float, p_f: float, dt: float) -> float:
    """Eq. (5) for a drive wheel: F_a lateral, F_r = √(N² + longitudinal²), T_r = R·|lateral|."""
    mu = coefficient(
        body.R * omega,
        body.drive_mu_static,
        body.drive_mu_dynamic,
        body.drive_stiction_speed,
        body.drive_dynamic_speed,
    )
    load = body.load_drive * dt
    return mu * (
        (body.drive_axial + body.drive_bending * body.R) * abs(p_e)
        + body.drive_radial * math.sqrt(load * load + p_f * p_f)
        + body.drive_preload * dt
    )


@law
def castor_axle(body: Body, omega: float, p_x: float, p_y: float, dt: float) -> float:
    """Eq. (5) for the castor wheel, applied as for a drive wheel."""
    mu = coefficient(
        body.R_c * omega,
        body.axle_mu_static,
        body.axle_mu_dynamic,
        body.axle_stiction_speed,
        body.axle_dynamic_speed,
    )
    load = body.load_castor * dt
    return mu * (
        (body.axle_axial + body.axle_bending * body.R_c) * abs(p_x)
        + body.axle_radial * math.sqrt(load * load + p_y * p_y)
        + body.axle_preload * dt
    )


@law
def steering_axle(body: Body, phi_rate: float, p_x: float, p_y: float, dt: float) -> float:
    """Eq. (5) for the steering: F_a the load, F_r the castor's horizontal force, T_r = load·trail."""
    mu = coefficient(
        body.steer_pin * phi_rate,
        body.steer_mu_static,
        body.steer_mu_dynamic,
        body.steer_stiction_speed,
        body.steer_dynamic_speed,
    )
    load = body.load_castor * dt
    return mu * (
        (body.steer_axial + body.steer_bending * body.T) * load
        + body.steer_radial * math.sqrt(p_x * p_x + p_y * p_y)
        + body.steer_preload * dt
    )


@law
def friction_limits(
    body: Body, motion: Motion, contact: Contact, floor: Floor, dt: float
) -> FrictionLimits:
    """All limits of a substep, from the speeds at its start and the previous impulses.

    Resistance to rolling is a torque on the axle that opposes its spin: coefficient·load·radius.
    """
    rolling = floor.rolling * dt
    spin_l, spin_r = body.R * motion.omega_l, body.R * motion.omega_r
    spin_c = body.R_c * motion.omega_c
    return FrictionLimits(
        grip_l=grip(body, body.load_drive, floor.grip_l, contact.slip_l, dt),
        grip_r=grip(body, body.load_drive, floor.grip_r, contact.slip_r, dt),
        grip_c=grip(body, body.load_castor, floor.grip_c, contact.slip_c, dt),
        axle_l=drive_axle(body, motion.omega_l, contact.p_le, contact.p_lf, dt)
        + rolling * body.load_drive * body.R,
        axle_r=drive_axle(body, motion.omega_r, contact.p_re, contact.p_rf, dt)
        + rolling * body.load_drive * body.R,
        axle_c=castor_axle(body, motion.omega_c, contact.p_cx, contact.p_cy, dt)
        + rolling * body.load_castor * body.R_c,
        steering=steering_axle(body, motion.s - motion.w, contact.p_cx, contact.p_cy, dt),
        creep_l=creep(floor, spin_l, body.load_drive, dt),
        creep_r=creep(floor, spin_r, body.load_drive, dt),
        creep_c=creep(floor, spin_c, body.load_castor, dt),
    )
