"""Impulses of floor and friction by sweeps, for every case: any wheel may slide, any joint stick.

Block Gauss–Seidel on impulses over left wheel, right wheel and castor. For each block its impulses are
removed from the velocities, solved exactly, and added again. Axes: e to the right and f forward in the
body; across (⊥, x) and along (∥, y) the castor's fork.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.compiled import law
from tlf_env.physics.friction import disc
from tlf_env.physics.friction_limits import FrictionLimits
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Contact, Floor, Rates

SWEEP_TOLERANCE_MM_S = 1e-9
SWEEP_CAP = (
    1000  # a sticking castor at an angle can need hundreds of sweeps; most substeps need few
)


@law
def drive_wheel(
    body: Body,
    side: float,
    v_e: float,
    v_f: float,
    w: float,
    omega_0: float,
    belt: float,
    friction: float,
    grip: float,
    creep: float,
) -> tuple[float, float, float, float, float]:
    """Solve one drive wheel: first with a sticking axle, then with a sliding axle.

    ``side`` is +1 left, −1 right; ``friction`` the largest impulse of the axle, ``grip`` that of the
    tyre, ``creep`` its compliance below that. Velocities and ``omega_0`` exclude the impulses of this wheel.
    Returns ``(p_e, p_f, q, ω, λ)``.
    """
    b_e = v_e - w * body.d
    b_f = v_f - side * w * body.h - belt
    w_ef = side * body.w_ef
    # Skip the sticking case if friction and tyre together cannot stop the axle in one substep.
    if body.J * abs(omega_0) <= friction + body.R * grip:
        p_e, p_f, lam = disc(body.w_ee + creep, body.w_ff + creep, w_ef, b_e, b_f, grip)
        q = body.R * p_f - body.J * omega_0
        if abs(q) <= friction:
            return p_e, p_f, q, 0.0, lam
        q = math.copysign(friction, q)
    else:
        q = -math.copysign(friction, omega_0)
    omega = omega_0 + q * body.inverse_J
    w_ff = body.w_ff + body.spin_drive + creep
    p_e, p_f, lam = disc(body.w_ee + creep, w_ff, w_ef, b_e, b_f - body.R * omega, grip)
    return p_e, p_f, q, omega - body.R * p_f * body.inverse_J, lam


@law
def castor_wheel(
    body: Body,
    w_xx: float,
    w_xy: float,
    w_yy: float,
    b_x: float,
    b_y: float,
    omega_0: float,
    friction: float,
    grip: float,
    creep: float,
) -> tuple[float, float, float, float, float]:
    """Solve the castor wheel for a given steering state, with the same two cases as a drive wheel.

    ``b`` and ``W`` are velocity and inverse mass of the fork at the contact, without the wheel's spin.
    Returns ``(p_⊥, p_∥, q_c, ω_c, λ)``.
    """
    if body.J_c * abs(omega_0) <= friction + body.R_c * grip:
        p_x, p_y, lam = disc(w_xx + creep, w_yy + creep, w_xy, b_x, b_y, grip)
        q = body.R_c * p_y - body.J_c * omega_0
        if abs(q) <= friction:
            return p_x, p_y, q, 0.0, lam
        q = math.copysign(friction, q)
    else:
        q = -math.copysign(friction, omega_0)
    omega = omega_0 + q * body.inverse_J_c
    w_yy += body.spin_castor + creep
    p_x, p_y, lam = disc(w_xx + creep, w_yy, w_xy, b_x, b_y - body.R_c * omega, grip)
    return p_x, p_y, q, omega - body.R_c * p_y * body.inverse_J_c, lam


@law
def castor(
    body: Body,
    cos_phi: float,
    sin_phi: float,
    v_e: float,
    v_f: float,
    w: float,
    s: float,
    omega_0: float,
    axle_friction: float,
    steer_friction: float,
    grip: float,
    creep: float,
) -> tuple[float, float, float, float, float, float, float, float]:
    """Solve the castor: first with locked, then with sliding steering.

    Returns ``(p_⊥, p_∥, q_c, q_s, w, s, ω_c, λ)``.
    """
    I_total = body.I + body.I_s
    rate = (body.I * w + body.I_s * s) / I_total
    lever = body.q * cos_phi + body.T
    across = body.q * sin_phi
    forward_x, forward_y = v_f * sin_phi, v_f * cos_phi
    p_x, p_y, q_c, omega, lam = castor_wheel(
        body,
        body.inverse_m + lever * lever / I_total,
        -lever * across / I_total,
        body.inverse_m + across * across / I_total,
        (v_e + rate * body.q) * cos_phi + forward_x + body.T * rate,
        -(v_e + rate * body.q) * sin_phi + forward_y,
        omega_0,
        axle_friction,
        grip,
        creep,
    )
    locked = rate + (lever * p_x - across * p_y) / I_total
    q_s = body.I_s * (locked - s) - body.T * p_x
    if abs(q_s) <= steer_friction:
        return p_x, p_y, q_c, q_s, locked, locked, omega, lam

    q_s = math.copysign(steer_friction, q_s)
    w_free, s_free = w - q_s * body.inverse_I, s + q_s * body.inverse_I_s
    q_cos = body.q * cos_phi
    p_x, p_y, q_c, omega, lam = castor_wheel(
        body,
        body.inverse_m + q_cos * q_cos * body.inverse_I + body.T * body.T * body.inverse_I_s,
        -q_cos * across * body.inverse_I,
        body.inverse_m + across * across * body.inverse_I,
        (v_e + w_free * body.q) * cos_phi + forward_x + body.T * s_free,
        -(v_e + w_free * body.q) * sin_phi + forward_y,
        omega_0,
        axle_friction,
        grip,
        creep,
    )
    w_new = w_free + (q_cos * p_x - across * p_y) * body.inverse_I
    s_new = s_free + body.T * p_x * body.inverse_I_s
    return p_x, p_y, q_c, q_s, w_new, s_new, omega, lam


@law
def share_lateral(
    p_le: float, p_lf: float, p_re: float, p_rf: float, grip_l: float, grip_r: float
) -> tuple[float, float]:
    """Split the drive wheels' lateral impulse equally, as far as the two friction circles allow.

    While both tyres stick, their lateral forces act along one line and only the sum is determined. An
    unequal split would load the joints against each other and increase their friction.
    """
    total = p_le + p_re
    room_l = math.sqrt(max(grip_l * grip_l - p_lf * p_lf, 0.0))
    room_r = math.sqrt(max(grip_r * grip_r - p_rf * p_rf, 0.0))
    left = min(max(0.5 * total, -room_l), room_l)
    right = min(max(total - left, -room_r), room_r)
    return total - right, right


class Slips(NamedTuple):
    """Slip velocities of the tyres over the floor, mm/s."""

    e: float  # both drive wheels, to the right
    lf: float  # left, forward
    rf: float
    cx: float  # castor, ⊥ to the fork
    cy: float  # castor, ∥ to the fork


@law
def tyre_slips(body: Body, rates: Rates, floor: Floor, cos_p: float, sin_p: float) -> Slips:
    """Slip velocities that belong to some rates, at the castor angle with this cosine and sine."""
    castor_e = rates.v_e + rates.w * body.q
    return Slips(
        e=rates.v_e - rates.w * body.d,
        lf=rates.v_f - rates.w * body.h - body.R * rates.omega_l - floor.conveyor_l,
        rf=rates.v_f + rates.w * body.h - body.R * rates.omega_r - floor.conveyor_r,
        cx=castor_e * cos_p + rates.v_f * sin_p + body.T * rates.s,
        cy=-castor_e * sin_p + rates.v_f * cos_p - body.R_c * rates.omega_c,
    )


@law
def sweep(
    body: Body,
    free: Rates,
    contact: Contact,
    cos_p: float,
    sin_p: float,
    floor: Floor,
    limits: FrictionLimits,
) -> tuple[Rates, Contact]:
    """Velocities and impulses of a substep; the solution starts from the impulses in ``contact``."""
    p_le, p_lf, p_re, p_rf = contact.p_le, contact.p_lf, contact.p_re, contact.p_rf
    p_cx, p_cy = contact.p_cx, contact.p_cy
    q_l, q_r, q_c, q_s = contact.q_l, contact.q_r, contact.q_c, contact.q_s
    p_ce, p_cf = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
    v_e = free.v_e + (p_le + p_re + p_ce) * body.inverse_m
    v_f = free.v_f + (p_lf + p_rf + p_cf) * body.inverse_m
    w = (
        free.w
        + (body.h * (p_rf - p_lf) - body.d * (p_le + p_re) + body.q * p_ce - q_s) * body.inverse_I
    )
    s = free.s + (body.T * p_cx + q_s) * body.inverse_I_s
    omega_l = free.omega_l + (q_l - body.R * p_lf) * body.inverse_J
    omega_r = free.omega_r + (q_r - body.R * p_rf) * body.inverse_J
    omega_c = free.omega_c + (q_c - body.R_c * p_cy) * body.inverse_J_c
    lam_l = lam_r = 0.0

    for _ in range(SWEEP_CAP):
        old_e, old_f, old_w, old_s = v_e, v_f, w, s
        old_l, old_r, old_c = omega_l, omega_r, omega_c

        v_e -= p_le * body.inverse_m
        v_f -= p_lf * body.inverse_m
        w += (body.h * p_lf + body.d * p_le) * body.inverse_I
        p_le, p_lf, q_l, omega_l, lam_l = drive_wheel(
            body,
            1.0,
            v_e,
            v_f,
            w,
            free.omega_l,
            floor.conveyor_l,
            limits.axle_l,
            limits.grip_l,
            limits.creep_l,
        )
        v_e += p_le * body.inverse_m
        v_f += p_lf * body.inverse_m
        w -= (body.h * p_lf + body.d * p_le) * body.inverse_I

        v_e -= p_re * body.inverse_m
        v_f -= p_rf * body.inverse_m
        w -= (body.h * p_rf - body.d * p_re) * body.inverse_I
        p_re, p_rf, q_r, omega_r, lam_r = drive_wheel(
            body,
            -1.0,
            v_e,
            v_f,
            w,
            free.omega_r,
            floor.conveyor_r,
            limits.axle_r,
            limits.grip_r,
            limits.creep_r,
        )
        v_e += p_re * body.inverse_m
        v_f += p_rf * body.inverse_m
        w += (body.h * p_rf - body.d * p_re) * body.inverse_I

        p_ce, p_cf = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
        p_cx, p_cy, q_c, q_s, w, s, omega_c, _lam = castor(
            body,
            cos_p,
            sin_p,
            v_e - p_ce * body.inverse_m,
            v_f - p_cf * body.inverse_m,
            w - (body.q * p_ce - q_s) * body.inverse_I,
            s - (body.T * p_cx + q_s) * body.inverse_I_s,
            free.omega_c,
            limits.axle_c,
            limits.steering,
            limits.grip_c,
            limits.creep_c,
        )
        new_e, new_f = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
        v_e += (new_e - p_ce) * body.inverse_m
        v_f += (new_f - p_cf) * body.inverse_m

        change = max(
            max(abs(v_e - old_e), abs(v_f - old_f)),
            max(body.h * abs(w - old_w), body.T * abs(s - old_s)),
            max(body.R * abs(omega_l - old_l), body.R * abs(omega_r - old_r)),
            body.R_c * abs(omega_c - old_c),
        )
        if change < SWEEP_TOLERANCE_MM_S:
            break

    if lam_l == 0.0 and lam_r == 0.0 and floor.creep == 0.0:
        p_le, p_re = share_lateral(p_le, p_lf, p_re, p_rf, limits.grip_l, limits.grip_r)

    after = Rates(v_e=v_e, v_f=v_f, w=w, s=s, omega_l=omega_l, omega_r=omega_r, omega_c=omega_c)
    slips = tyre_slips(body, after, floor, cos_p, sin_p)
    return (
        after,
        Contact(
            p_le=p_le,
            p_lf=p_lf,
            p_re=p_re,
            p_rf=p_rf,
            p_cx=p_cx,
            p_cy=p_cy,
            q_l=q_l,
            q_r=q_r,
            q_c=q_c,
            q_s=q_s,
            slip_l=math.sqrt(slips.e * slips.e + slips.lf * slips.lf),
            slip_r=math.sqrt(slips.e * slips.e + slips.rf * slips.rf),
            slip_c=math.sqrt(slips.cx * slips.cx + slips.cy * slips.cy),
        ),
    )
