"""The ``kinematic`` plant: wheels follow their command exactly and the robot moves by eq. (14)."""

from __future__ import annotations

from tlf_env.numerics.compiled import law
from tlf_env.numerics.trig import sincos
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Motion


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
    """Eqs (1) and (14) over one substep, by the midpoint rule about c; the castor trails along."""
    u_1 = 0.5 * body.R * (omega_l + omega_r) + delta_1
    u_2 = 0.5 * body.R / body.h * (omega_r - omega_l) + delta_2
    sin, cos = sincos(motion.theta)
    x, y = motion.x - body.d * sin, motion.y + body.d * cos
    sin, cos = sincos(motion.theta + 0.5 * dt * u_2)
    x -= dt * u_1 * sin
    y += dt * u_1 * cos
    theta = motion.theta + dt * u_2
    sin, cos = sincos(theta)
    # The fork turns so that its wheel rolls: its axle sees no velocity along itself.
    sin_phi, cos_phi = sincos(motion.psi - motion.theta)
    s = -(u_2 * (body.q + body.d) * cos_phi + u_1 * sin_phi) / body.T
    return Motion(
        x + body.d * sin,
        y - body.d * cos,
        theta,
        motion.psi + dt * s,
        -u_1 * sin + u_2 * body.d * cos,
        u_1 * cos + u_2 * body.d * sin,
        u_2,
        s,
        omega_l,
        omega_r,
        0.0,
        motion.angle_l + dt * omega_l,
        motion.angle_r + dt * omega_r,
    )
