"""The closed form of a substep in which all three wheels roll and their axles turn.

Without slip the robot has two independent velocities, v_f and w (one while the steering sticks). By
Gauss's principle they minimise the mass-weighted distance to the velocities that the bodies would have
without the floor. The floor's impulses follow from them. Then the assumption is tested: all impulses
within their friction circles, every friction torque opposing its motion. For constant limits the solution
is unique, so :mod:`tlf_env.physics.sweeps` would find the same; if the test fails, the sweeps are used.
"""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import law
from tlf_env.physics.friction_limits import FrictionLimits
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Contact, Floor, Rates


@law
def rolling(
    body: Body,
    free: Rates,
    before: Rates,
    cos_phi: float,
    sin_phi: float,
    floor: Floor,
    limits: FrictionLimits,
) -> tuple[bool, Rates, Contact]:
    """Velocities and impulses if all wheels roll, and whether they do.

    ``free`` are the velocities with torques and pushes but without floor and friction; ``before`` those
    at the start of the substep, which determine the direction of each friction torque.
    """
    q_l = -math.copysign(limits.axle_l, before.omega_l)
    q_r = -math.copysign(limits.axle_r, before.omega_r)
    q_c = -math.copysign(limits.axle_c, before.omega_c)
    # Each wheel's spin without the tyre, as a speed along the floor.
    u_l = body.R * (free.omega_l + q_l * body.inverse_J) + floor.conveyor_l
    u_r = body.R * (free.omega_r + q_r * body.inverse_J) + floor.conveyor_r
    u_c = body.R_c * (free.omega_c + q_c * body.inverse_J_c)
    pivot = body.d + body.q
    m_drive, m_castor = body.spin_mass_drive, body.spin_mass_castor

    turning = before.s != before.w
    if turning:
        q_s = -math.copysign(limits.steering, before.s - before.w)
        # s = −(a w cos φ + v_f sin φ)/T, R_c ω_c = v_f cos φ − a w sin φ, with a = pivot
        fork = body.I_s / (body.T * body.T)
        a_cos, a_sin = pivot * cos_phi, pivot * sin_phi
        fork_speed = -body.T * (free.s + q_s * body.inverse_I_s)
        a_11 = body.m + 2.0 * m_drive + fork * sin_phi * sin_phi + m_castor * cos_phi * cos_phi
        a_12 = a_cos * sin_phi * (fork - m_castor)
        a_22 = body.I_rolling + fork * a_cos * a_cos + m_castor * a_sin * a_sin
        b_1 = (
            body.m * free.v_f
            + m_drive * (u_l + u_r)
            + fork * sin_phi * fork_speed
            + m_castor * cos_phi * u_c
        )
        b_2 = (
            body.m * body.d * free.v_e
            + body.I * free.w
            - q_s
            + m_drive * body.h * (u_r - u_l)
            + fork * a_cos * fork_speed
            - m_castor * a_sin * u_c
        )
        inverse_det = 1.0 / (a_11 * a_22 - a_12 * a_12)
        v_f = (a_22 * b_1 - a_12 * b_2) * inverse_det
        w = (a_11 * b_2 - a_12 * b_1) * inverse_det
        s = -(a_cos * w + sin_phi * v_f) / body.T
    else:
        # The fork turns with the body: w = κ v_f.
        lever = pivot * cos_phi + body.T
        kappa = -sin_phi / lever
        k_l, k_r = 1.0 - body.h * kappa, 1.0 + body.h * kappa
        k_c = cos_phi - pivot * sin_phi * kappa
        k_e = body.d * kappa
        mass = (
            body.m * (1.0 + k_e * k_e)
            + (body.I + body.I_s) * kappa * kappa
            + m_drive * (k_l * k_l + k_r * k_r)
            + m_castor * k_c * k_c
        )
        v_f = (
            body.m * (free.v_f + k_e * free.v_e)
            + kappa * (body.I * free.w + body.I_s * free.s)
            + m_drive * (k_l * u_l + k_r * u_r)
            + m_castor * k_c * u_c
        ) / mass
        w = kappa * v_f
        s = w
        q_s = 0.0

    v_e = w * body.d
    along_l, along_r = v_f - w * body.h, v_f + w * body.h
    along_c = v_f * cos_phi - pivot * w * sin_phi
    # Impulses of the tyres that make each wheel roll.
    p_lf = m_drive * (u_l - along_l)
    p_rf = m_drive * (u_r - along_r)
    p_cy = m_castor * (u_c - along_c)
    omega_l = (along_l - floor.conveyor_l) / body.R
    omega_r = (along_r - floor.conveyor_r) / body.R
    omega_c = along_c / body.R_c
    gained_e = body.m * (v_e - free.v_e)
    if turning:
        p_cx = (body.I_s * (s - free.s) - q_s) / body.T
        steers = q_s * (s - w) <= 0.0
    else:
        moment = body.I * (w - free.w) + body.I_s * (s - free.s) - body.h * (p_rf - p_lf)
        p_cx = (moment + body.d * gained_e + pivot * sin_phi * p_cy) / lever
        q_s = body.I_s * (s - free.s) - body.T * p_cx
        steers = abs(q_s) <= limits.steering
    p_e = 0.5 * (gained_e - p_cx * cos_phi + p_cy * sin_phi)

    rolls = (
        steers
        and q_l * omega_l <= 0.0
        and q_r * omega_r <= 0.0
        and q_c * omega_c <= 0.0
        and p_e * p_e + p_lf * p_lf <= limits.grip_l * limits.grip_l
        and p_e * p_e + p_rf * p_rf <= limits.grip_r * limits.grip_r
        and p_cx * p_cx + p_cy * p_cy <= limits.grip_c * limits.grip_c
    )
    return (
        rolls,
        Rates(v_e=v_e, v_f=v_f, w=w, s=s, omega_l=omega_l, omega_r=omega_r, omega_c=omega_c),
        Contact(
            p_le=p_e,
            p_lf=p_lf,
            p_re=p_e,
            p_rf=p_rf,
            p_cx=p_cx,
            p_cy=p_cy,
            q_l=q_l,
            q_r=q_r,
            q_c=q_c,
            q_s=q_s,
            slip_l=0.0,
            slip_r=0.0,
            slip_c=0.0,
        ),
    )
