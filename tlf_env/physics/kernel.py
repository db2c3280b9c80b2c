"""The wheel kernel: one substep of one robot, implicit in all friction (``docs/physics.md``).

Block Gauss–Seidel on impulses over left wheel, right wheel and castor. Each block takes its own
impulses out of the velocities, is solved exactly, and puts them back. Axes: e to the right and f
forward in the body, ⊥ and ∥ in the castor's fork. Units: mm, kg, s, rad; impulses mN·s and mN·mm·s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.compiled import block, law, reader, writer
from tlf_env.physics.friction import coefficient, disc, joint_torque
from tlf_env.physics.parameters import Body

SWEEP_TOLERANCE_MM_S = 1e-9
SWEEP_CAP = 64


class Motion(NamedTuple):
    """Pose and velocities of the five bodies."""

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
    """The solver's memory, part of the state: last impulses, and slip speeds."""

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


class Floor(NamedTuple):
    """What the floor does to one robot during one substep."""

    conveyor_l: float  # σ_l, σ_r: injected slip of eq. (14) as conveyor speeds, mm/s
    conveyor_r: float
    grip_l: float  # factors on the tyres' friction
    grip_r: float
    grip_c: float


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


@law
def conveyor(delta_1: float, delta_2: float, half_width: float) -> tuple[float, float]:
    """Conveyor speeds (left, right; mm/s) that inject the slip δ₁ (mm/s), δ₂ (rad/s) of eq. (14)."""
    return delta_1 - delta_2 * half_width, delta_1 + delta_2 * half_width


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
) -> tuple[float, float, float, float, float]:
    """Solve one drive wheel: stuck axle first, then the axle sliding.

    ``side`` is +1 left, −1 right; ``friction`` the axle's largest impulse, ``grip`` the tyre's;
    velocities and ``omega_0`` are those without this wheel's own impulses.
    Returns ``(p_e, p_f, q, ω, λ)``.
    """
    b_e = v_e - w * body.d
    b_f = v_f - side * w * body.h - belt
    w_ef = side * body.w_ef
    # An axle whose spin neither friction nor tyre can stop in one substep need not be tried stuck.
    if body.J * abs(omega_0) <= friction + body.R * grip:
        p_e, p_f, lam = disc(body.w_ee, body.w_ff, w_ef, b_e, b_f, grip)
        q = body.R * p_f - body.J * omega_0
        if abs(q) <= friction:
            return p_e, p_f, q, 0.0, lam
        q = math.copysign(friction, q)
    else:
        q = -math.copysign(friction, omega_0)
    omega = omega_0 + q / body.J
    p_e, p_f, lam = disc(
        body.w_ee, body.w_ff + body.spin_drive, w_ef, b_e, b_f - body.R * omega, grip
    )
    return p_e, p_f, q, omega - body.R * p_f / body.J, lam


@law
def castor_axle(
    body: Body,
    w_xx: float,
    w_xy: float,
    w_yy: float,
    b_x: float,
    b_y: float,
    omega_0: float,
    friction: float,
    grip: float,
) -> tuple[float, float, float, float, float]:
    """Solve the castor wheel for a given steering state; the same two trials as a drive wheel.

    ``b`` and ``W`` are the fork point's velocity and inverse mass, the wheel's spin left out.
    Returns ``(p_⊥, p_∥, q_c, ω_c, λ)``.
    """
    if body.J_c * abs(omega_0) <= friction + body.R_c * grip:
        p_x, p_y, lam = disc(w_xx, w_yy, w_xy, b_x, b_y, grip)
        q = body.R_c * p_y - body.J_c * omega_0
        if abs(q) <= friction:
            return p_x, p_y, q, 0.0, lam
        q = math.copysign(friction, q)
    else:
        q = -math.copysign(friction, omega_0)
    omega = omega_0 + q / body.J_c
    p_x, p_y, lam = disc(w_xx, w_yy + body.spin_castor, w_xy, b_x, b_y - body.R_c * omega, grip)
    return p_x, p_y, q, omega - body.R_c * p_y / body.J_c, lam


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
) -> tuple[float, float, float, float, float, float, float, float]:
    """Solve the castor: steering locked first, then sliding. Returns ``(p_⊥, p_∥, q_c, q_s, w, s, ω_c, λ)``."""
    I_total = body.I + body.I_s
    rate = (body.I * w + body.I_s * s) / I_total
    lever = body.q * cos_phi + body.T
    across = body.q * sin_phi
    forward_x, forward_y = v_f * sin_phi, v_f * cos_phi
    p_x, p_y, q_c, omega, lam = castor_axle(
        body,
        1.0 / body.m + lever * lever / I_total,
        -lever * across / I_total,
        1.0 / body.m + across * across / I_total,
        (v_e + rate * body.q) * cos_phi + forward_x + body.T * rate,
        -(v_e + rate * body.q) * sin_phi + forward_y,
        omega_0,
        axle_friction,
        grip,
    )
    locked = rate + (lever * p_x - across * p_y) / I_total
    q_s = body.I_s * (locked - s) - body.T * p_x
    if abs(q_s) <= steer_friction:
        return p_x, p_y, q_c, q_s, locked, locked, omega, lam

    q_s = math.copysign(steer_friction, q_s)
    w_free, s_free = w - q_s / body.I, s + q_s / body.I_s
    q_cos = body.q * cos_phi
    p_x, p_y, q_c, omega, lam = castor_axle(
        body,
        1.0 / body.m + q_cos * q_cos / body.I + body.T * body.T / body.I_s,
        -q_cos * across / body.I,
        1.0 / body.m + across * across / body.I,
        (v_e + w_free * body.q) * cos_phi + forward_x + body.T * s_free,
        -(v_e + w_free * body.q) * sin_phi + forward_y,
        omega_0,
        axle_friction,
        grip,
    )
    w_new = w_free + (q_cos * p_x - across * p_y) / body.I
    s_new = s_free + body.T * p_x / body.I_s
    return p_x, p_y, q_c, q_s, w_new, s_new, omega, lam


@law
def tyre_coefficient(body: Body, slip: float) -> float:
    """Friction coefficient of a tyre at a slip speed in mm/s."""
    return coefficient(
        slip, body.mu_static, body.mu_dynamic, body.stiction_speed, body.dynamic_speed
    )


@law
def drive_friction(body: Body, omega: float, p_e: float, p_f: float, dt: float) -> float:
    """Largest friction impulse of a drive wheel's axle, eq. (5), from the last tyre impulses."""
    mu = coefficient(
        body.R * omega,
        body.drive_mu_static,
        body.drive_mu_dynamic,
        body.drive_stiction_speed,
        body.drive_dynamic_speed,
    )
    lateral, longitudinal = p_e / dt, p_f / dt
    radial = math.sqrt(body.load_drive * body.load_drive + longitudinal * longitudinal)
    return dt * joint_torque(
        mu,
        body.drive_axial,
        body.drive_radial,
        body.drive_bending,
        body.drive_preload,
        lateral,
        radial,
        body.R * lateral,
    )


@law
def castor_friction(
    body: Body, omega_c: float, phi_rate: float, p_x: float, p_y: float, dt: float
) -> tuple[float, float]:
    """Largest friction impulses of the castor's axle and of its steering, eq. (5)."""
    mu_axle = coefficient(
        body.R_c * omega_c,
        body.axle_mu_static,
        body.axle_mu_dynamic,
        body.axle_stiction_speed,
        body.axle_dynamic_speed,
    )
    mu_steer = coefficient(
        body.steer_pin * phi_rate,
        body.steer_mu_static,
        body.steer_mu_dynamic,
        body.steer_stiction_speed,
        body.steer_dynamic_speed,
    )
    f_x, f_y = p_x / dt, p_y / dt
    axle = joint_torque(
        mu_axle,
        body.axle_axial,
        body.axle_radial,
        body.axle_bending,
        body.axle_preload,
        f_x,
        math.sqrt(body.load_castor * body.load_castor + f_y * f_y),
        body.R_c * f_x,
    )
    steer = joint_torque(
        mu_steer,
        body.steer_axial,
        body.steer_radial,
        body.steer_bending,
        body.steer_preload,
        body.load_castor,
        math.sqrt(f_x * f_x + f_y * f_y),
        body.load_castor * body.T,
    )
    return dt * axle, dt * steer


@law
def share_lateral(
    p_le: float, p_lf: float, p_re: float, p_rf: float, grip_l: float, grip_r: float
) -> tuple[float, float]:
    """Split the drive wheels' lateral impulse equally, as far as the two friction circles allow.

    While both tyres stick their lateral forces act along one line, so that only the sum is determined;
    an arbitrary split would squeeze the joints and raise their friction.
    """
    total = p_le + p_re
    room_l = math.sqrt(max(grip_l * grip_l - p_lf * p_lf, 0.0))
    room_r = math.sqrt(max(grip_r * grip_r - p_rf * p_rf, 0.0))
    left = min(max(0.5 * total, -room_l), room_l)
    right = min(max(total - left, -room_r), room_r)
    return total - right, right


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
    """Velocities after one substep, all friction implicit; the pose is left to :func:`advance_pose`.

    Torques in mN·mm, ``dt`` in s. Fork and wheel angles are advanced here with the new rates.
    """
    # Frames at mid attitude.
    theta = motion.theta + 0.5 * dt * motion.w
    phi_rate = motion.s - motion.w
    phi = motion.psi - motion.theta + 0.5 * dt * phi_rate
    cos_t, sin_t = math.cos(theta), math.sin(theta)
    cos_p, sin_p = math.cos(phi), math.sin(phi)

    # Limits, frozen during the sweeps.
    grip_l = dt * body.load_drive * floor.grip_l * tyre_coefficient(body, contact.slip_l)
    grip_r = dt * body.load_drive * floor.grip_r * tyre_coefficient(body, contact.slip_r)
    grip_c = dt * body.load_castor * floor.grip_c * tyre_coefficient(body, contact.slip_c)
    friction_l = drive_friction(body, motion.omega_l, contact.p_le, contact.p_lf, dt)
    friction_r = drive_friction(body, motion.omega_r, contact.p_re, contact.p_rf, dt)
    friction_c, friction_s = castor_friction(
        body, motion.omega_c, phi_rate, contact.p_cx, contact.p_cy, dt
    )

    # Torques and external forces enter as impulses.
    v_x = motion.v_x + push.f_x * dt / body.m
    v_y = motion.v_y + push.f_y * dt / body.m
    free_e = cos_t * v_x + sin_t * v_y
    free_f = -sin_t * v_x + cos_t * v_y
    spin_l = motion.omega_l + torque_l * dt / body.J
    spin_r = motion.omega_r + torque_r * dt / body.J

    # Warm start with all stored impulses.
    p_le, p_lf, p_re, p_rf = contact.p_le, contact.p_lf, contact.p_re, contact.p_rf
    p_cx, p_cy = contact.p_cx, contact.p_cy
    q_l, q_r, q_c, q_s = contact.q_l, contact.q_r, contact.q_c, contact.q_s
    p_ce, p_cf = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
    v_e = free_e + (p_le + p_re + p_ce) / body.m
    v_f = free_f + (p_lf + p_rf + p_cf) / body.m
    w = (
        motion.w
        + push.torque * dt / body.I
        + (body.h * (p_rf - p_lf) - body.d * (p_le + p_re) + body.q * p_ce - q_s) / body.I
    )
    s = motion.s + (body.T * p_cx + q_s) / body.I_s
    omega_l = spin_l + (q_l - body.R * p_lf) / body.J
    omega_r = spin_r + (q_r - body.R * p_rf) / body.J
    omega_c = motion.omega_c + (q_c - body.R_c * p_cy) / body.J_c
    lam_l = lam_r = 0.0

    for _ in range(SWEEP_CAP):
        old_e, old_f, old_w, old_s = v_e, v_f, w, s
        old_l, old_r, old_c = omega_l, omega_r, omega_c

        v_e -= p_le / body.m
        v_f -= p_lf / body.m
        w += (body.h * p_lf + body.d * p_le) / body.I
        p_le, p_lf, q_l, omega_l, lam_l = drive_wheel(
            body, 1.0, v_e, v_f, w, spin_l, floor.conveyor_l, friction_l, grip_l
        )
        v_e += p_le / body.m
        v_f += p_lf / body.m
        w -= (body.h * p_lf + body.d * p_le) / body.I

        v_e -= p_re / body.m
        v_f -= p_rf / body.m
        w -= (body.h * p_rf - body.d * p_re) / body.I
        p_re, p_rf, q_r, omega_r, lam_r = drive_wheel(
            body, -1.0, v_e, v_f, w, spin_r, floor.conveyor_r, friction_r, grip_r
        )
        v_e += p_re / body.m
        v_f += p_rf / body.m
        w += (body.h * p_rf - body.d * p_re) / body.I

        p_ce, p_cf = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
        p_cx, p_cy, q_c, q_s, w, s, omega_c, _lam = castor(
            body,
            cos_p,
            sin_p,
            v_e - p_ce / body.m,
            v_f - p_cf / body.m,
            w - (body.q * p_ce - q_s) / body.I,
            s - (body.T * p_cx + q_s) / body.I_s,
            motion.omega_c,
            friction_c,
            friction_s,
            grip_c,
        )
        new_e, new_f = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
        v_e += (new_e - p_ce) / body.m
        v_f += (new_f - p_cf) / body.m

        change = max(
            max(abs(v_e - old_e), abs(v_f - old_f)),
            max(body.h * abs(w - old_w), body.T * abs(s - old_s)),
            max(body.R * abs(omega_l - old_l), body.R * abs(omega_r - old_r)),
            body.R_c * abs(omega_c - old_c),
        )
        if change < SWEEP_TOLERANCE_MM_S:
            break

    if lam_l == 0.0 and lam_r == 0.0:
        p_le, p_re = share_lateral(p_le, p_lf, p_re, p_rf, grip_l, grip_r)

    side_slip = v_e - w * body.d
    slip_lf = v_f - w * body.h - body.R * omega_l - floor.conveyor_l
    slip_rf = v_f + w * body.h - body.R * omega_r - floor.conveyor_r
    castor_e = v_e + w * body.q
    slip_cx = castor_e * cos_p + v_f * sin_p + body.T * s
    slip_cy = -castor_e * sin_p + v_f * cos_p - body.R_c * omega_c
    after = Motion(
        motion.x,
        motion.y,
        motion.theta,
        motion.psi + dt * s,
        cos_t * v_e - sin_t * v_f,
        sin_t * v_e + cos_t * v_f,
        w,
        s,
        omega_l,
        omega_r,
        omega_c,
        motion.angle_l + dt * omega_l,
        motion.angle_r + dt * omega_r,
    )
    memory = Contact(
        p_le,
        p_lf,
        p_re,
        p_rf,
        p_cx,
        p_cy,
        q_l,
        q_r,
        q_c,
        q_s,
        math.sqrt(side_slip * side_slip + slip_lf * slip_lf),
        math.sqrt(side_slip * side_slip + slip_rf * slip_rf),
        math.sqrt(slip_cx * slip_cx + slip_cy * slip_cy),
    )
    return after, memory


@law
def advance_pose(motion: Motion, dt: float) -> Motion:
    """Pose one substep on, added up exactly as Chipmunk does: p + v·dt, θ + w·dt."""
    return Motion(
        motion.x + motion.v_x * dt,
        motion.y + motion.v_y * dt,
        motion.theta + motion.w * dt,
        motion.psi,
        motion.v_x,
        motion.v_y,
        motion.w,
        motion.s,
        motion.omega_l,
        motion.omega_r,
        motion.omega_c,
        motion.angle_l,
        motion.angle_r,
    )


@law
def axle_midpoint(motion: Motion, d: float) -> tuple[float, float]:
    """Position of c, mm: the centre of mass lies ``d`` behind it."""
    return motion.x - d * math.sin(motion.theta), motion.y + d * math.cos(motion.theta)
