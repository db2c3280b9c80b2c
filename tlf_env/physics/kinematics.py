"""The ``kinematic`` plant: wheels follow their command exactly and the robot moves by eq. (14)."""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import law
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
    x = motion.x - body.d * math.sin(motion.theta)
    y = motion.y + body.d * math.cos(motion.theta)
    middle = motion.theta + 0.5 * dt * u_2
    x -= dt * u_1 * math.sin(middle)
    y += dt * u_1 * math.cos(middle)
    theta = motion.theta + dt * u_2
    sin, cos = math.sin(theta), math.cos(theta)
    # The fork turns so that its wheel rolls: its axle sees no velocity along itself.
    phi = motion.psi - motion.theta
    s = -(u_2 * (body.q + body.d) * math.cos(phi) + u_1 * math.sin(phi)) / body.T
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
