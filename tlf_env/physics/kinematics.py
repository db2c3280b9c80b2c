"""Kinematics of two driven wheels: odometry, its inverse, and the ``kinematic`` plant."""

from __future__ import annotations

from tlf_env.numerics.compiled import law
from tlf_env.numerics.trig import sincos
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Motion


@law
def odometry(angle_l: float, angle_r: float, R: float, h: float) -> tuple[float, float]:
    """Eq. (29): travelled distance (mm) and turn (rad) from the wheels' angle increments (rad)."""
    s_l, s_r = R * angle_l, R * angle_r
    return 0.5 * (s_r + s_l), (s_r - s_l) / (2.0 * h)


@law
def wheel_speeds(forward: float, turn: float, body: Body) -> tuple[float, float]:
    """Wheel speeds (left, right; rad/s) of a twist (mm/s, rad/s): the inverse of eq. (1)."""
    return (forward - turn * body.h) / body.R, (forward + turn * body.h) / body.R


@law
def follow_wheels(
    body: Body,
    motion: Motion,
    omega_l: float,
    omega_r: float,
    delta_1: float,
    delta_2: float,
    dt: float,
) -> Motion:
    """The ``kinematic`` plant: wheels follow their command exactly, eqs (1) and (14) over one substep.

    Integrated with the midpoint rule about c; the castor wheel rolls without slip.
    """
    u_1 = 0.5 * body.R * (omega_l + omega_r) + delta_1
    u_2 = 0.5 * body.R / body.h * (omega_r - omega_l) + delta_2
    sin, cos = sincos(motion.theta)
    x, y = motion.x - body.d * sin, motion.y + body.d * cos
    sin, cos = sincos(motion.theta + 0.5 * dt * u_2)
    x -= dt * u_1 * sin
    y += dt * u_1 * cos
    theta = motion.theta + dt * u_2
    sin, cos = sincos(theta)
    # The fork turns so that its wheel rolls: no velocity along the castor's axle.
    sin_phi, cos_phi = sincos(motion.psi - motion.theta)
    s = -(u_2 * (body.q + body.d) * cos_phi + u_1 * sin_phi) / body.T
    return Motion(
        x=x + body.d * sin,
        y=y - body.d * cos,
        theta=theta,
        psi=motion.psi + dt * s,
        v_x=-u_1 * sin + u_2 * body.d * cos,
        v_y=u_1 * cos + u_2 * body.d * sin,
        w=u_2,
        s=s,
        omega_l=omega_l,
        omega_r=omega_r,
        omega_c=0.0,
        angle_l=motion.angle_l + dt * omega_l,
        angle_r=motion.angle_r + dt * omega_r,
    )
