"""The laws of a substep, written again from first principles, and what a recorded substep owes them.

Nothing here uses the laws of ``tlf_env``. A substep is known by the states before and after it, the impulses
in the solver's memory, the torques that were delivered, and the values of the channels. Units: mm, kg, s, rad;
forces mN, torques mN·mm; energies mN·mm = µJ.

**The balance.** The mass matrix M is constant and diagonal in the axes at mid attitude, in which a substep is
solved, and the impulses P_j change the velocities V by M ΔV = Σ P_j g_j. So exactly, at any length of the step,

    ΔT = ½ V₁ᵀMV₁ − ½ V₀ᵀMV₀ = Σ P_j · g_jᵀ(V₀ + V₁)/2 :

each impulse works with the mean of the velocities before and after at the point where it acts. With floors that
move (conveyors) at σ a tyre's work is that of the floor, p_f·σ, and that of its slip, which is lost. A slope's
force F works F·(V₀ + V₁)/2·Δt; the place moves by V₁Δt, so that the potential energy falls by F·V₁Δt: the
difference, F·ΔV/2·Δt, belongs to the semi-implicit step. Nothing else is left over but rounding. The size that
rounding is compared with is the sum of all terms' sizes, with what each impulse, and each that the sweeps begin
with, would do alone: P²/M.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.channels import PATHS
from tlf_env.numerics.compiled import driver, law
from tlf_env.numerics.rows import row_reader, row_writer
from tlf_env.physics.parameters import RobotParameters
from tlf_env.physics.state import Contact, Motion

ROUNDING = float(np.finfo(float).eps)
SOME_ROUNDINGS = 64 * ROUNDING  # of a friction limit
SHARE_ROUNDING = 1e-10  # of the largest friction limit of a robot
STILL_MM_S = 1e-8  # slower slip counts as none: sweeps end at changes of a tenth of it
STICKS = 1.0 - 1e-9  # of the circle: an impulse below sticks
KNOWN = (
    SOME_ROUNDINGS / 1e-9
)  # of its largest value: a smaller limit is not known well enough for that
TINY = 1e-300
UNSEEN = 1e-160  # an impulse's square is 0 below it, so that it is inside of every circle
SMALLEST = 1e-280  # a sum of terms above the numbers that are kept with fewer digits


class Robot(NamedTuple):
    """Constants of a robot with its payload. Torques in mN·mm; curves are μ_s, μ_d, v_s, v_d of Fig. 3(b)."""

    m: float
    I: float  # noqa: E741 - the symbol of the equations
    d: float
    q: float
    h: float
    T: float
    R: float
    R_c: float
    J: float
    J_c: float
    I_s: float
    g: float
    N: float
    N_c: float
    limit: float
    tyre_s: float
    tyre_d: float
    tyre_v_s: float
    tyre_v_d: float
    drive_s: float
    drive_d: float
    drive_v_s: float
    drive_v_d: float
    drive_axial: float
    drive_radial: float
    drive_bending: float
    drive_preload: float
    axle_s: float
    axle_d: float
    axle_v_s: float
    axle_v_d: float
    axle_axial: float
    axle_radial: float
    axle_bending: float
    axle_preload: float
    steer_s: float
    steer_d: float
    steer_v_s: float
    steer_v_d: float
    steer_axial: float
    steer_radial: float
    steer_bending: float
    steer_preload: float
    pin: float


class Payload(NamedTuple):
    """kg, mm behind the axle, kg·mm²."""

    mass: float
    behind: float
    inertia: float


def curve_of(friction: object) -> list[float]:
    """Fig. 3(b) of a tyre or a joint."""
    names = ("mu_static", "mu_dynamic", "stiction_speed_mm_s", "dynamic_speed_mm_s")
    return [getattr(friction, name) for name in names]


def robot_row(robot: RobotParameters, payload: Payload) -> Robot:
    """Constants of a robot: moments about the axle and the parallel-axis theorem for its payload."""
    m, d = robot.mass_kg + payload.mass, robot.com_offset_mm
    share, inertia = robot.castor_load_share, robot.body_inertia_kg_mm2
    if payload.mass > 0:
        d = (robot.mass_kg * robot.com_offset_mm + payload.mass * payload.behind) / m
        share = d / (robot.castor_pivot_mm + robot.castor_trail_mm)
        inertia += robot.mass_kg * (d - robot.com_offset_mm) ** 2
        inertia += payload.inertia + payload.mass * (payload.behind - d) ** 2
    weight = m * robot.gravity_mm_s2
    joints = []
    for joint in (robot.drive_joint, robot.castor_joint, robot.steering_joint):
        static, dynamic, *speeds = curve_of(joint)
        on = float(robot.joint_friction)
        bending = joint.pin_radius_mm / joint.bending_arm_mm if joint.bending else 0.0
        arms = [joint.friction_arm_mm, joint.pin_radius_mm, bending, 1000.0 * joint.preload_Nmm]
        joints += [on * static, on * dynamic, *speeds, *arms]
    return Robot(
        m,
        inertia,
        d,
        robot.castor_pivot_mm - d,
        robot.axle_width_mm / 2,
        robot.castor_trail_mm,
        robot.wheel_radius_mm,
        robot.castor_radius_mm,
        robot.wheel_inertia_kg_mm2,
        robot.castor_inertia_kg_mm2,
        robot.fork_inertia_kg_mm2,
        robot.gravity_mm_s2,
        0.5 * (1 - share) * weight,
        share * weight,
        1000.0 * robot.torque_limit_Nmm,
        *curve_of(robot.tyre),
        *joints,
        robot.steering_joint.pin_radius_mm,
    )


class Inputs(NamedTuple):
    """What acts on a robot in a substep: torques, floors and pushes."""

    torque_l: float
    torque_r: float
    belt_l: float
    belt_r: float
    grip_l: float
    grip_r: float
    grip_c: float
    rolling: float
    creep: float
    push_x: float
    push_y: float
    push_w: float
    slope_x: float
    slope_y: float


class Work(NamedTuple):
    """What each source puts into the robots in a substep, µJ, and what is lost."""

    motors: float
    pushes: float
    slope: float
    conveyors: float
    tyres: float  # of their slip: minus what is lost in them
    joints: float
    change: float  # of the kinetic energy


class Owed(NamedTuple):
    """Residuals of a substep; all are 0 in exact arithmetic, if the sweeps have converged."""

    energy: float  # change less work, over the sum of all terms' sizes
    momentum: float  # of the worst of seven balances, the same
    tyre: float  # impulse beyond the friction circle, over the circle
    joint: float  # friction torque beyond eq. (5), over it
    slip: float  # speed of a tyre that should stick, or off the direction against its force, mm/s
    turn: float  # speed of a joint that should stick, rate times length, mm/s
    gain: float  # energy that friction adds beyond what the conveyors put in, and beyond that of
    # bodies that the sweeps count as resting, over the terms' size
    place: float  # way less V₁Δt, over the coordinate's size
    slides: float  # 1 if some tyre slides, else 0
    finite: float  # 0 if all numbers are finite, else 1


CHANNEL = {path.replace(".", "_"): i for i, path in enumerate(PATHS)}
DELTA_1, DELTA_2 = CHANNEL["slip_delta_1_mm_s"], CHANNEL["slip_delta_2_rad_s"]
SLIP_L, SLIP_R = CHANNEL["slip_left_mm_s"], CHANNEL["slip_right_mm_s"]
GRIP, GRIP_L, GRIP_R = (CHANNEL[f"tyre_friction_{name}"] for name in ("scale", "left", "right"))
CREEP, ROLLING = CHANNEL["tyre_creep"], CHANNEL["floor_rolling_resistance"]
SLOPE, UPHILL = CHANNEL["floor_slope_rad"], CHANNEL["floor_uphill_rad"]
PUSH_X, PUSH_Y, PUSH_W = CHANNEL["push_x_N"], CHANNEL["push_y_N"], CHANNEL["push_torque_Nmm"]
GAIN_L, GAIN_R = CHANNEL["actuator_torque_gain_l"], CHANNEL["actuator_torque_gain_r"]
BACK_EMF, DEAD_BAND = CHANNEL["actuator_back_emf_s_rad"], CHANNEL["actuator_dead_band_Nmm"]
CURRENT, STALL = CHANNEL["actuator_current_limit"], CHANNEL["actuator_stall_torque"]

robot_of, motion_of, contact_of, inputs_at = (
    row_reader(row, 0) for row in (Robot, Motion, Contact, Inputs)
)
set_inputs, set_work, set_owed = (row_writer(row, 0) for row in (Inputs, Work, Owed))


@law
def mu_at(speed: float, static: float, dynamic: float, v_s: float, v_d: float) -> float:
    """The coefficient of Fig. 3(b)."""
    x = min(max((abs(speed) - v_s) / (v_d - v_s), 0.0), 1.0)
    return static + (dynamic - static) * x**2 * (3.0 - 2.0 * x)


@law
def on_patches(patches: np.ndarray, x: float, y: float) -> float:
    """Product of the factors of the patches (patch, (x, y, radius, scale)) that a point lies on."""
    factor = 1.0
    for k in range(patches.shape[0]):
        if math.hypot(x - patches[k, 0], y - patches[k, 1]) <= patches[k, 2]:
            factor *= patches[k, 3]
    return factor


@law
def inputs_of(
    r: Robot, a: Motion, channels: np.ndarray, i: int, patches: np.ndarray, t_l: float, t_r: float
) -> Inputs:
    """The floor, pushes and torques, from the channels' values (channel, robot)."""
    turn = channels[DELTA_2, i] * r.h
    sin, cos = math.sin(a.theta), math.cos(a.theta)
    c_x, c_y = a.x - r.d * sin, a.y + r.d * cos
    grip = channels[GRIP, i] * math.cos(channels[SLOPE, i])
    down = r.m * r.g * math.sin(channels[SLOPE, i])
    castor_x = a.x + r.q * sin + r.T * math.sin(a.psi)
    castor_y = a.y - r.q * cos - r.T * math.cos(a.psi)
    on_l = on_patches(patches, c_x - r.h * cos, c_y - r.h * sin)
    on_r = on_patches(patches, c_x + r.h * cos, c_y + r.h * sin)
    return Inputs(
        t_l,
        t_r,
        channels[DELTA_1, i] - turn + channels[SLIP_L, i],
        channels[DELTA_1, i] + turn + channels[SLIP_R, i],
        grip * channels[GRIP_L, i] * on_l,
        grip * channels[GRIP_R, i] * on_r,
        grip * on_patches(patches, castor_x, castor_y),
        channels[ROLLING, i],
        channels[CREEP, i],
        1000.0 * channels[PUSH_X, i],
        1000.0 * channels[PUSH_Y, i],
        1000.0 * channels[PUSH_W, i],
        down * math.sin(channels[UPHILL, i]),
        -down * math.cos(channels[UPHILL, i]),
    )


@law
def delivered(
    r: Robot, channels: np.ndarray, i: int, torque: float, gain: float, spin: float
) -> float:
    """What a motor delivers of a torque that was commanded one dead time ago, mN·mm.

    Its limits act if one of the robot's channels differs from its neutral value.
    """
    torque *= gain
    lost, band = channels[BACK_EMF, i], 1000.0 * channels[DEAD_BAND, i]
    current, stall = channels[CURRENT, i], channels[STALL, i]
    if lost == 0.0 and band == 0.0 and current == 1.0 and stall == 1.0:
        return torque
    if abs(torque) <= band:
        return 0.0
    driving = -abs(spin) if spin * torque < 0.0 else abs(spin)
    most = r.limit * min(max(stall * (1.0 - lost * driving), 0.0), current)
    return min(max(torque, -most), most)


@law
def kinetic(r: Robot, v: Motion) -> float:
    """Kinetic energy of the five bodies."""
    return 0.5 * (
        r.m * (v.v_x**2 + v.v_y**2)
        + r.I * v.w**2
        + r.I_s * v.s**2
        + r.J * (v.omega_l**2 + v.omega_r**2)
        + r.J_c * v.omega_c**2
    )


@law
def off_direction(
    p_1: float, p_2: float, s_1: float, s_2: float, circle: float
) -> tuple[float, bool]:
    """Speed by which a tyre breaks Coulomb's law (mm/s), and whether it slides."""
    size = math.hypot(p_1, p_2)
    if size < circle * STICKS:
        return math.hypot(s_1, s_2), False
    if size == 0.0:
        return 0.0, True
    along, across = (p_1 * s_1 + p_2 * s_2) / size, (p_1 * s_2 - p_2 * s_1) / size
    return math.hypot(across, max(along, 0.0)), True


@law
def beyond(much: float, most: float, static: float) -> float:
    """How far a friction impulse is beyond its limit, over it; ``static`` is the limit's largest value.

    The limit is a difference of rounded numbers, and the share of a tyre may be the root of one.
    """
    if much <= most + SHARE_ROUNDING * static + UNSEEN:
        return 0.0
    return much / most - 1.0 if most > 0.0 else math.inf


@law
def five(
    static: float, dynamic: float, v_s: float, v_d: float, axial: float, radial: float, bending: float,
    preload: float, speed: float, force_a: float, force_r: float, moment: float,
) -> tuple[float, float]:  # fmt: skip
    """The largest friction torque of eq. (5), and that with static friction."""
    arms = axial * abs(force_a) + radial * abs(force_r) + bending * abs(moment) + preload
    return mu_at(speed, static, dynamic, v_s, v_d) * arms, static * arms


@law
def relative(total: float, size: float) -> float:
    """A sum over its terms' size."""
    return abs(total) / max(size, SMALLEST)


@law
def audit(
    r: Robot, a: Motion, b: Motion, o: Contact, p: Contact, u: Inputs, dt: float
) -> tuple[Work, Owed]:
    """What a substep owes to mechanics and to the friction laws: states and impulses before and after."""
    theta = a.theta + 0.5 * dt * a.w
    phi = a.psi - a.theta + 0.5 * dt * (a.s - a.w)
    cos, sin, c, n = math.cos(theta), math.sin(theta), math.cos(phi), math.sin(phi)
    e_0, f_0 = cos * a.v_x + sin * a.v_y, cos * a.v_y - sin * a.v_x
    e_1, f_1 = cos * b.v_x + sin * b.v_y, cos * b.v_y - sin * b.v_x
    push_e, push_f = dt * (cos * u.push_x + sin * u.push_y), dt * (cos * u.push_y - sin * u.push_x)
    down_e, down_f = (
        dt * (cos * u.slope_x + sin * u.slope_y),
        dt * (cos * u.slope_y - sin * u.slope_x),
    )
    push_w, t_l, t_r = dt * u.push_w, dt * u.torque_l, dt * u.torque_r
    p_ce, p_cf = p.p_cx * c - p.p_cy * n, p.p_cx * n + p.p_cy * c

    # Momenta. The sweeps begin with the last impulses, so their size counts for the rounding, too; the axes
    # turn into each other, and levers make moments of forces: so does rounding.
    drive = math.hypot(o.p_le, o.p_lf) + math.hypot(o.p_re, o.p_rf)
    castor = math.hypot(o.p_cx, o.p_cy)
    across = (
        r.m * (math.hypot(e_0, f_0) + math.hypot(e_1, f_1))
        + math.hypot(p.p_le, p.p_lf) + math.hypot(p.p_re, p.p_rf) + math.hypot(p.p_cx, p.p_cy)
        + math.hypot(push_e + down_e, push_f + down_f) + drive + castor
    )  # fmt: skip
    yaw = r.h * (p.p_rf - p.p_lf) - r.d * (p.p_le + p.p_re) + r.q * p_ce - p.q_s + push_w
    reach = r.h + r.d + abs(r.q)
    momentum = relative(r.m * (e_1 - e_0) - p.p_le - p.p_re - p_ce - push_e - down_e, across)
    momentum = max(
        momentum, relative(r.m * (f_1 - f_0) - p.p_lf - p.p_rf - p_cf - push_f - down_f, across)
    )
    size = r.I * (abs(a.w) + abs(b.w)) + reach * across + abs(p.q_s) + abs(o.q_s) + abs(push_w)
    momentum = max(momentum, relative(r.I * (b.w - a.w) - yaw, size))
    size = r.I_s * (abs(a.s) + abs(b.s)) + r.T * across + abs(p.q_s) + abs(o.q_s)
    momentum = max(momentum, relative(r.I_s * (b.s - a.s) - r.T * p.p_cx - p.q_s, size))
    spins = (
        (r.J, r.R, a.omega_l, b.omega_l, t_l, p.q_l, o.q_l, p.p_lf, o.p_lf),
        (r.J, r.R, a.omega_r, b.omega_r, t_r, p.q_r, o.q_r, p.p_rf, o.p_rf),
        (r.J_c, r.R_c, a.omega_c, b.omega_c, 0.0, p.q_c, o.q_c, p.p_cy, o.p_cy),
    )
    for inertia, radius, old, new, twist, friction, last, along, before in spins:
        size = inertia * (abs(old) + abs(new)) + abs(twist) + abs(friction) + abs(last)
        size += radius * (abs(along) + abs(before))
        rest = inertia * (new - old) - twist - friction + radius * along
        momentum = max(momentum, relative(rest, size))

    # Slips of the left, the right and the castor's tyre, before and after.
    pivot_0, pivot_1 = e_0 + a.w * r.q, e_1 + b.w * r.q
    slip_0 = (
        (e_0 - a.w * r.d, f_0 - a.w * r.h - r.R * a.omega_l - u.belt_l),
        (e_0 - a.w * r.d, f_0 + a.w * r.h - r.R * a.omega_r - u.belt_r),
        (pivot_0 * c + f_0 * n + r.T * a.s, f_0 * c - pivot_0 * n - r.R_c * a.omega_c),
    )
    slip_1 = (
        (e_1 - b.w * r.d, f_1 - b.w * r.h - r.R * b.omega_l - u.belt_l),
        (e_1 - b.w * r.d, f_1 + b.w * r.h - r.R * b.omega_r - u.belt_r),
        (pivot_1 * c + f_1 * n + r.T * b.s, f_1 * c - pivot_1 * n - r.R_c * b.omega_c),
    )
    tyres = ((p.p_le, p.p_lf), (p.p_re, p.p_rf), (p.p_cx, p.p_cy))
    belts = (u.belt_l, u.belt_r, 0.0)
    grips, loads = (u.grip_l, u.grip_r, u.grip_c), (r.N, r.N, r.N_c)
    rims = (r.R * a.omega_l, r.R * a.omega_r, r.R_c * a.omega_c)
    ease_d = 1 / r.m + (r.h**2 + r.d**2) / r.I + r.R**2 / r.J
    ease_c = 1 / r.m + r.q**2 / r.I + r.T**2 / r.I_s + r.R_c**2 / r.J_c
    ease, begun, lasts = (
        (ease_d, ease_d, ease_c),
        (drive, drive, castor),
        (o.slip_l, o.slip_r, o.slip_c),
    )
    lost = gain = over = slip = 0.0
    slides = False
    size = kinetic(r, a) + kinetic(r, b)
    for k in range(3):
        p_1, p_2 = tyres[k]
        x_0, y_0 = slip_0[k]
        x_1, y_1 = slip_1[k]
        much = math.hypot(p_1, p_2)
        lost += 0.5 * (p_1 * (x_0 + x_1) + p_2 * (y_0 + y_1))
        gain += p_1 * x_1 + p_2 * y_1
        size += much * (math.hypot(x_0, y_0) + math.hypot(x_1, y_1) + abs(belts[k]))
        size += (much + begun[k]) ** 2 * ease[k]
        press = loads[k] * grips[k] * dt
        circle = mu_at(lasts[k], r.tyre_s, r.tyre_d, r.tyre_v_s, r.tyre_v_d) * press
        # With a castor or a drive wheel on ice the rounding is that of the forces on the others.
        most = r.tyre_s * max(u.grip_l, u.grip_r, u.grip_c) * dt * r.m * r.g
        over = max(over, beyond(much, circle, most))
        if circle > KNOWN * most:
            soft = u.creep * abs(rims[k]) / (loads[k] * dt)
            off, slid = off_direction(p_1, p_2, x_1 + soft * p_1, y_1 + soft * p_2, circle)
            slip = max(slip, off)
            slides |= slid

    # Joints: eq. (5) from the rates before and the last impulses.
    le, lf, re, rf = o.p_le / dt, o.p_lf / dt, o.p_re / dt, o.p_rf / dt
    cx, cy = o.p_cx / dt, o.p_cy / dt
    drag, drag_c = u.rolling * r.N * r.R, u.rolling * r.N_c * r.R_c
    cap_l, static_l = five(
        r.drive_s, r.drive_d, r.drive_v_s, r.drive_v_d, r.drive_axial, r.drive_radial, r.drive_bending,
        r.drive_preload, rims[0], le, math.hypot(r.N, lf), r.R * le,
    )  # fmt: skip
    cap_r, static_r = five(
        r.drive_s, r.drive_d, r.drive_v_s, r.drive_v_d, r.drive_axial, r.drive_radial, r.drive_bending,
        r.drive_preload, rims[1], re, math.hypot(r.N, rf), r.R * re,
    )  # fmt: skip
    cap_c, static_c = five(
        r.axle_s, r.axle_d, r.axle_v_s, r.axle_v_d, r.axle_axial, r.axle_radial, r.axle_bending,
        r.axle_preload, rims[2], cx, math.hypot(r.N_c, cy), r.R_c * cx,
    )  # fmt: skip
    cap_s, static_s = five(
        r.steer_s, r.steer_d, r.steer_v_s, r.steer_v_d, r.steer_axial, r.steer_radial, r.steer_bending,
        r.steer_preload, r.pin * (a.s - a.w), r.N_c, math.hypot(cx, cy), r.N_c * r.T,
    )  # fmt: skip
    joints = (
        (p.q_l, a.omega_l, b.omega_l, dt * (cap_l + drag), dt * (static_l + drag), r.R, 1 / r.J, o.q_l),
        (p.q_r, a.omega_r, b.omega_r, dt * (cap_r + drag), dt * (static_r + drag), r.R, 1 / r.J, o.q_r),
        (p.q_c, a.omega_c, b.omega_c, dt * (cap_c + drag_c), dt * (static_c + drag_c), r.R_c, 1 / r.J_c, o.q_c),
        (p.q_s, a.s - a.w, b.s - b.w, dt * cap_s, dt * static_s, r.T, 1 / r.I_s + 1 / r.I, o.q_s),
    )  # fmt: skip
    rubbed = joint = turn = 0.0
    for q, old, new, cap, static, length, soft, last in joints:
        rubbed += 0.5 * q * (old + new)
        gain += q * new
        size += abs(q) * (abs(old) + abs(new)) + (abs(q) + abs(last)) ** 2 * soft
        joint = max(joint, beyond(abs(q), cap, static))
        if (abs(q) < cap * STICKS and cap > KNOWN * static) or q * new > 0.0:
            turn = max(turn, length * abs(new))

    # Friction takes the velocities from V* to V₁: ½V₁ᵀMV₁ − ½V*ᵀMV* = Σ P·gᵀV₁ − ½(V₁ − V*)ᵀM(V₁ − V*).
    changes = (
        (r.m, e_1 - e_0 - (push_e + down_e) / r.m, 1.0),
        (r.m, f_1 - f_0 - (push_f + down_f) / r.m, 1.0),
        (r.I, b.w - a.w - push_w / r.I, r.h),
        (r.I_s, b.s - a.s, r.T),
        (r.J, b.omega_l - a.omega_l - t_l / r.J, r.R),
        (r.J, b.omega_r - a.omega_r - t_r / r.J, r.R),
        (r.J_c, b.omega_c - a.omega_c, r.R_c),
    )
    for mass, change, length in changes:
        gain -= 0.5 * mass * (change**2 + (STILL_MM_S / length) ** 2)
    force = math.hypot(push_e + down_e, push_f + down_f)
    size += abs(t_l) * (abs(a.omega_l) + abs(b.omega_l) + abs(t_l) / r.J)
    size += abs(t_r) * (abs(a.omega_r) + abs(b.omega_r) + abs(t_r) / r.J)
    size += force * (math.hypot(e_0, f_0) + math.hypot(e_1, f_1) + force / r.m)
    size += abs(push_w) * (abs(a.w) + abs(b.w) + abs(push_w) / r.I)
    work = Work(
        0.5 * (t_l * (a.omega_l + b.omega_l) + t_r * (a.omega_r + b.omega_r)),
        0.5 * (push_e * (e_0 + e_1) + push_f * (f_0 + f_1) + push_w * (a.w + b.w)),
        0.5 * (down_e * (e_0 + e_1) + down_f * (f_0 + f_1)),
        p.p_lf * u.belt_l + p.p_rf * u.belt_r,
        lost,
        rubbed,
        kinetic(r, b) - kinetic(r, a),
    )
    put_in = work.motors + work.pushes + work.slope + work.conveyors + work.tyres + work.joints
    place = max(
        abs(b.x - a.x - dt * b.v_x) / max(abs(a.x) + dt * abs(b.v_x), TINY),
        abs(b.y - a.y - dt * b.v_y) / max(abs(a.y) + dt * abs(b.v_y), TINY),
    )
    total = 0.0
    for value in b:
        total += value
    for value in p:
        total += value
    return work, Owed(
        relative(work.change - put_in, size),
        momentum,
        over,
        joint,
        slip,
        turn,
        relative(max(gain, 0.0), size),
        place,
        1.0 if slides else 0.0,
        0.0 if math.isfinite(total) else 1.0,
    )


@driver
def inputs_all(
    robots: np.ndarray,
    before: np.ndarray,
    torques: np.ndarray,
    commanded: np.ndarray,
    channels: np.ndarray,
    patches: np.ndarray,
    inputs: np.ndarray,
    off: np.ndarray,
) -> None:
    """What acts on many robots in a substep, ``(field, robot)``; patches (robot, patch, number).

    ``torques`` (2, robot) are those delivered, ``commanded`` those of one dead time ago. Writes the last two:
    ``off`` (robot,) is how far a torque is off the motors' law, over 1 mN·mm and its size.
    """
    for i in range(robots.shape[1]):
        r, a = robot_of(robots, i), motion_of(before, i)
        set_inputs(
            inputs, i, inputs_of(r, a, channels, i, patches[i], torques[0, i], torques[1, i])
        )
        off[i] = 0.0
        for wheel in range(2):
            gain = channels[GAIN_L, i] if wheel == 0 else channels[GAIN_R, i]
            spin = a.omega_l if wheel == 0 else a.omega_r
            wanted = delivered(r, channels, i, commanded[wheel, i], gain, spin)
            off[i] = max(off[i], abs(torques[wheel, i] - wanted) / (1.0 + abs(wanted)))


@driver
def audit_all(
    robots: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    last: np.ndarray,
    given: np.ndarray,
    inputs: np.ndarray,
    dt: np.ndarray,
    works: np.ndarray,
    owed: np.ndarray,
) -> None:
    """Audit substeps, ``(field, robot)``; ``dt`` (robot,). Writes the last two arrays."""
    for i in range(robots.shape[1]):
        work, owes = audit(
            robot_of(robots, i), motion_of(before, i), motion_of(after, i), contact_of(last, i),
            contact_of(given, i), inputs_at(inputs, i), dt[i],
        )  # fmt: skip
        set_work(works, i, work)
        set_owed(owed, i, owes)


def finite(arrays: Sequence[np.ndarray]) -> bool:
    """Whether all numbers are finite."""
    return all(math.isfinite(float(np.sum(x))) or bool(np.isfinite(x).all()) for x in arrays)
