"""Impulses of floor and friction by sweeps, for every case: any wheel may slide, any joint stick.

Block Gauss–Seidel on impulses over left wheel, right wheel and castor. For each block its impulses are
removed from the velocities, solved exactly, and added again. Axes: e to the right and f forward in the
body; across (⊥, x) and along (∥, y) the castor's fork.

The laws here are of one robot. :func:`sweep` runs them for one, :mod:`tlf_env.physics.sliding` for many.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.rows import replacing
from tlf_env.physics.friction import Circle, disc
from tlf_env.physics.friction_limits import FrictionLimits
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Contact, Floor, Rates

SWEEP_TOLERANCE_MM_S = 1e-9
SWEEP_CAP = (
    1000  # a sticking castor at an angle can need hundreds of sweeps; most substeps need few
)
LEFT, RIGHT = 1.0, -1.0


class Sweep(NamedTuple):
    """Impulses as in :class:`~tlf_env.physics.state.Contact`, the velocities with them, and both tyres' λ."""

    p_le: float
    p_lf: float
    p_re: float
    p_rf: float
    p_cx: float
    p_cy: float
    q_l: float
    q_r: float
    q_c: float
    q_s: float
    v_e: float
    v_f: float
    w: float
    s: float
    omega_l: float
    omega_r: float
    omega_c: float
    lam_l: float
    lam_r: float


class Wheel(NamedTuple):
    """A wheel and its axle. Velocities and ``omega_0`` exclude the impulses of this wheel."""

    radius: float
    inertia: float
    inverse_inertia: float
    w_ee: float  # inverse mass at the contact with a sticking axle, the tyre's compliance added
    w_ff: float
    w_ef: float
    w_ff_turning: float  # with a sliding axle
    b_e: float  # velocity of the contact without the wheel's spin
    b_f: float
    omega_0: float
    friction: float  # largest impulse of the axle
    grip: float  # largest impulse of the tyre


class Solution(NamedTuple):
    """Impulses of a tyre and of its axle, the wheel's spin, and λ of the tyre."""

    p_e: float
    p_f: float
    q: float
    omega: float
    lam: float


class Lifted(NamedTuple):
    """Velocities of body and fork without the impulses of one block."""

    v_e: float
    v_f: float
    w: float
    s: float


class Castor(NamedTuple):
    """What the castor changes in a sweep."""

    p_cx: float
    p_cy: float
    q_c: float
    q_s: float
    omega_c: float
    v_e: float
    v_f: float
    w: float
    s: float


class InverseMass(NamedTuple):
    """Inverse mass of the fork at the castor's contact, across and along the fork."""

    xx: float
    yy: float
    xy: float


with_left = replacing(Sweep, "p_le", "p_lf", "q_l", "omega_l", "lam_l", "v_e", "v_f", "w")
with_right = replacing(Sweep, "p_re", "p_rf", "q_r", "omega_r", "lam_r", "v_e", "v_f", "w")
with_fork = replacing(Sweep, "p_cx", "p_cy", "q_c", "q_s", "omega_c", "v_e", "v_f", "w", "s")


@law
def can_stick(wheel: Wheel) -> bool:
    """Whether friction and tyre together can stop the axle in one substep."""
    return wheel.inertia * abs(wheel.omega_0) <= wheel.friction + wheel.radius * wheel.grip


@law
def circle_if_stuck(wheel: Wheel) -> Circle:
    """The tyre on an axle that does not turn."""
    return Circle(wheel.w_ee, wheel.w_ff, wheel.w_ef, wheel.b_e, wheel.b_f, wheel.grip)


@law
def friction_if_stuck(wheel: Wheel, p_f: float) -> float:
    """The axle's friction impulse that holds it against its tyre."""
    return wheel.radius * p_f - wheel.inertia * wheel.omega_0


@law
def friction_if_turning(wheel: Wheel, may_stick: bool, q_stuck: float) -> float:
    """The axle's friction impulse if it slides: against what would have been needed, or against its spin."""
    opposing = math.copysign(wheel.friction, wheel.omega_0)
    return math.copysign(wheel.friction, q_stuck) if may_stick else -opposing


@law
def circle_if_turning(wheel: Wheel, q: float) -> Circle:
    """The tyre on an axle that slides with the friction impulse ``q``."""
    omega = wheel.omega_0 + q * wheel.inverse_inertia
    b_f = wheel.b_f - wheel.radius * omega
    return Circle(wheel.w_ee, wheel.w_ff_turning, wheel.w_ef, wheel.b_e, b_f, wheel.grip)


@law
def spin_if_turning(wheel: Wheel, q: float, p_f: float) -> float:
    """The wheel's spin after both impulses."""
    omega = wheel.omega_0 + q * wheel.inverse_inertia
    return omega - wheel.radius * p_f * wheel.inverse_inertia


@law
def solve_wheel(wheel: Wheel) -> Solution:
    """Solve one wheel: first with a sticking axle, then with a sliding axle."""
    may_stick = can_stick(wheel)
    q = 0.0
    if may_stick:
        circle = circle_if_stuck(wheel)
        p_e, p_f, lam = disc(
            circle.w_ee, circle.w_ff, circle.w_ef, circle.b_e, circle.b_f, circle.radius
        )
        q = friction_if_stuck(wheel, p_f)
        if abs(q) <= wheel.friction:
            return Solution(p_e, p_f, q, 0.0, lam)
    q = friction_if_turning(wheel, may_stick, q)
    circle = circle_if_turning(wheel, q)
    p_e, p_f, lam = disc(
        circle.w_ee, circle.w_ff, circle.w_ef, circle.b_e, circle.b_f, circle.radius
    )
    return Solution(p_e, p_f, q, spin_if_turning(wheel, q, p_f), lam)


@law
def without_drive_wheel(body: Body, side: float, sweep: Sweep) -> Lifted:
    """Velocities without the impulses of the ``LEFT`` or the ``RIGHT`` tyre."""
    if side == LEFT:
        p_e, p_f = sweep.p_le, sweep.p_lf
        w = sweep.w + (body.h * p_f + body.d * p_e) * body.inverse_I
    else:
        p_e, p_f = sweep.p_re, sweep.p_rf
        w = sweep.w - (body.h * p_f - body.d * p_e) * body.inverse_I
    return Lifted(
        v_e=sweep.v_e - p_e * body.inverse_m,
        v_f=sweep.v_f - p_f * body.inverse_m,
        w=w,
        s=sweep.s,
    )


@law
def drive_wheel(
    body: Body, side: float, lifted: Lifted, free: Rates, floor: Floor, limits: FrictionLimits
) -> Wheel:
    """The ``LEFT`` or the ``RIGHT`` wheel."""
    if side == LEFT:
        omega_0, belt, creep = free.omega_l, floor.conveyor_l, limits.creep_l
        friction, grip = limits.axle_l, limits.grip_l
    else:
        omega_0, belt, creep = free.omega_r, floor.conveyor_r, limits.creep_r
        friction, grip = limits.axle_r, limits.grip_r
    return Wheel(
        radius=body.R,
        inertia=body.J,
        inverse_inertia=body.inverse_J,
        w_ee=body.w_ee + creep,
        w_ff=body.w_ff + creep,
        w_ef=side * body.w_ef,
        w_ff_turning=body.w_ff + body.spin_drive + creep,
        b_e=lifted.v_e - lifted.w * body.d,
        b_f=lifted.v_f - side * lifted.w * body.h - belt,
        omega_0=omega_0,
        friction=friction,
        grip=grip,
    )


@law
def with_drive_wheel(
    body: Body, side: float, sweep: Sweep, lifted: Lifted, wheel: Solution
) -> Sweep:
    """The sweep with the impulses of a drive wheel added."""
    v_e = lifted.v_e + wheel.p_e * body.inverse_m
    v_f = lifted.v_f + wheel.p_f * body.inverse_m
    if side == LEFT:
        w = lifted.w - (body.h * wheel.p_f + body.d * wheel.p_e) * body.inverse_I
        return with_left(sweep, wheel.p_e, wheel.p_f, wheel.q, wheel.omega, wheel.lam, v_e, v_f, w)
    w = lifted.w + (body.h * wheel.p_f - body.d * wheel.p_e) * body.inverse_I
    return with_right(sweep, wheel.p_e, wheel.p_f, wheel.q, wheel.omega, wheel.lam, v_e, v_f, w)


@law
def castor_impulse(sweep: Sweep, cos_p: float, sin_p: float) -> tuple[float, float]:
    """The castor's impulse in body axes."""
    return (
        sweep.p_cx * cos_p - sweep.p_cy * sin_p,
        sweep.p_cx * sin_p + sweep.p_cy * cos_p,
    )


@law
def without_castor(body: Body, sweep: Sweep, cos_p: float, sin_p: float) -> Lifted:
    """Velocities without the impulses of castor and steering."""
    p_ce, p_cf = castor_impulse(sweep, cos_p, sin_p)
    return Lifted(
        v_e=sweep.v_e - p_ce * body.inverse_m,
        v_f=sweep.v_f - p_cf * body.inverse_m,
        w=sweep.w - (body.q * p_ce - sweep.q_s) * body.inverse_I,
        s=sweep.s - (body.T * sweep.p_cx + sweep.q_s) * body.inverse_I_s,
    )


@law
def castor_wheel(
    body: Body,
    inverse: InverseMass,
    b_x: float,
    b_y: float,
    free: Rates,
    limits: FrictionLimits,
) -> Wheel:
    """The castor's wheel for an inverse mass and a velocity of the fork at the contact."""
    return Wheel(
        radius=body.R_c,
        inertia=body.J_c,
        inverse_inertia=body.inverse_J_c,
        w_ee=inverse.xx + limits.creep_c,
        w_ff=inverse.yy + limits.creep_c,
        w_ef=inverse.xy,
        w_ff_turning=inverse.yy + (body.spin_castor + limits.creep_c),
        b_e=b_x,
        b_f=b_y,
        omega_0=free.omega_c,
        friction=limits.axle_c,
        grip=limits.grip_c,
    )


@law
def rate_if_locked(body: Body, lifted: Lifted) -> float:
    """The rate at which body and fork turn as one."""
    return (body.I * lifted.w + body.I_s * lifted.s) / (body.I + body.I_s)


@law
def inverse_mass_if_locked(body: Body, cos_p: float, sin_p: float) -> InverseMass:
    """While the steering is locked."""
    I_total = body.I + body.I_s
    lever, across = body.q * cos_p + body.T, body.q * sin_p
    return InverseMass(
        xx=body.inverse_m + lever * lever / I_total,
        yy=body.inverse_m + across * across / I_total,
        xy=-lever * across / I_total,
    )


@law
def inverse_mass_if_steering(body: Body, cos_p: float, sin_p: float) -> InverseMass:
    """While the steering slides."""
    q_cos, across = body.q * cos_p, body.q * sin_p
    return InverseMass(
        xx=body.inverse_m + q_cos * q_cos * body.inverse_I + body.T * body.T * body.inverse_I_s,
        yy=body.inverse_m + across * across * body.inverse_I,
        xy=-q_cos * across * body.inverse_I,
    )


@law
def castor_if_locked(
    body: Body,
    inverse: InverseMass,
    lifted: Lifted,
    cos_p: float,
    sin_p: float,
    free: Rates,
    limits: FrictionLimits,
) -> Wheel:
    """The castor's wheel while the steering is locked."""
    rate = rate_if_locked(body, lifted)
    return castor_wheel(
        body,
        inverse,
        (lifted.v_e + rate * body.q) * cos_p + lifted.v_f * sin_p + body.T * rate,
        -(lifted.v_e + rate * body.q) * sin_p + lifted.v_f * cos_p,
        free,
        limits,
    )


@law
def turn_if_locked(
    body: Body, lifted: Lifted, cos_p: float, sin_p: float, p_x: float, p_y: float
) -> tuple[float, float]:
    """The rate of body and fork after the tyre's impulse, and the friction impulse that locks the steering."""
    lever, across = body.q * cos_p + body.T, body.q * sin_p
    rate = rate_if_locked(body, lifted)
    locked = rate + (lever * p_x - across * p_y) / (body.I + body.I_s)
    return locked, body.I_s * (locked - lifted.s) - body.T * p_x


@law
def castor_if_steering(
    body: Body,
    inverse: InverseMass,
    lifted: Lifted,
    q_s: float,
    cos_p: float,
    sin_p: float,
    free: Rates,
    limits: FrictionLimits,
) -> Wheel:
    """The castor's wheel while the steering slides with the friction impulse ``q_s``."""
    w_free, s_free = lifted.w - q_s * body.inverse_I, lifted.s + q_s * body.inverse_I_s
    return castor_wheel(
        body,
        inverse,
        (lifted.v_e + w_free * body.q) * cos_p + lifted.v_f * sin_p + body.T * s_free,
        -(lifted.v_e + w_free * body.q) * sin_p + lifted.v_f * cos_p,
        free,
        limits,
    )


@law
def turn_if_steering(
    body: Body, lifted: Lifted, q_s: float, cos_p: float, sin_p: float, p_x: float, p_y: float
) -> tuple[float, float]:
    """The rates of body and fork after the tyre's impulse."""
    w_free, s_free = lifted.w - q_s * body.inverse_I, lifted.s + q_s * body.inverse_I_s
    q_cos, across = body.q * cos_p, body.q * sin_p
    return (
        w_free + (q_cos * p_x - across * p_y) * body.inverse_I,
        s_free + body.T * p_x * body.inverse_I_s,
    )


@law
def castor_after(
    body: Body,
    sweep: Sweep,
    cos_p: float,
    sin_p: float,
    wheel: Solution,
    q_s: float,
    w: float,
    s: float,
) -> Castor:
    """New impulses of castor and steering, and the velocities with them."""
    p_ce, p_cf = castor_impulse(sweep, cos_p, sin_p)
    new_e = wheel.p_e * cos_p - wheel.p_f * sin_p
    new_f = wheel.p_e * sin_p + wheel.p_f * cos_p
    return Castor(
        p_cx=wheel.p_e,
        p_cy=wheel.p_f,
        q_c=wheel.q,
        q_s=q_s,
        omega_c=wheel.omega,
        v_e=sweep.v_e + (new_e - p_ce) * body.inverse_m,
        v_f=sweep.v_f + (new_f - p_cf) * body.inverse_m,
        w=w,
        s=s,
    )


@law
def with_castor(sweep: Sweep, castor: Castor) -> Sweep:
    """The sweep with what the castor changes."""
    return with_fork(
        sweep,
        castor.p_cx,
        castor.p_cy,
        castor.q_c,
        castor.q_s,
        castor.omega_c,
        castor.v_e,
        castor.v_f,
        castor.w,
        castor.s,
    )


@law
def solve_castor(
    body: Body,
    if_locked: InverseMass,
    if_steering: InverseMass,
    sweep: Sweep,
    cos_p: float,
    sin_p: float,
    free: Rates,
    limits: FrictionLimits,
) -> Sweep:
    """Solve the castor: first with locked, then with sliding steering."""
    lifted = without_castor(body, sweep, cos_p, sin_p)
    wheel = solve_wheel(castor_if_locked(body, if_locked, lifted, cos_p, sin_p, free, limits))
    locked, q_s = turn_if_locked(body, lifted, cos_p, sin_p, wheel.p_e, wheel.p_f)
    if abs(q_s) <= limits.steering:
        return with_castor(
            sweep, castor_after(body, sweep, cos_p, sin_p, wheel, q_s, locked, locked)
        )
    q_s = math.copysign(limits.steering, q_s)
    wheel = solve_wheel(
        castor_if_steering(body, if_steering, lifted, q_s, cos_p, sin_p, free, limits)
    )
    w, s = turn_if_steering(body, lifted, q_s, cos_p, sin_p, wheel.p_e, wheel.p_f)
    return with_castor(sweep, castor_after(body, sweep, cos_p, sin_p, wheel, q_s, w, s))


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
def begin_sweeps(body: Body, free: Rates, contact: Contact, cos_p: float, sin_p: float) -> Sweep:
    """The impulses in ``contact``, and the velocities with them."""
    p_le, p_lf, p_re, p_rf = contact.p_le, contact.p_lf, contact.p_re, contact.p_rf
    p_cx, p_cy = contact.p_cx, contact.p_cy
    q_l, q_r, q_c, q_s = contact.q_l, contact.q_r, contact.q_c, contact.q_s
    p_ce, p_cf = p_cx * cos_p - p_cy * sin_p, p_cx * sin_p + p_cy * cos_p
    return Sweep(
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
        v_e=free.v_e + (p_le + p_re + p_ce) * body.inverse_m,
        v_f=free.v_f + (p_lf + p_rf + p_cf) * body.inverse_m,
        w=free.w
        + (body.h * (p_rf - p_lf) - body.d * (p_le + p_re) + body.q * p_ce - q_s) * body.inverse_I,
        s=free.s + (body.T * p_cx + q_s) * body.inverse_I_s,
        omega_l=free.omega_l + (q_l - body.R * p_lf) * body.inverse_J,
        omega_r=free.omega_r + (q_r - body.R * p_rf) * body.inverse_J,
        omega_c=free.omega_c + (q_c - body.R_c * p_cy) * body.inverse_J_c,
        lam_l=0.0,
        lam_r=0.0,
    )


@law
def rates_of(sweep: Sweep) -> Rates:
    """The velocities of a sweep."""
    return Rates(
        v_e=sweep.v_e,
        v_f=sweep.v_f,
        w=sweep.w,
        s=sweep.s,
        omega_l=sweep.omega_l,
        omega_r=sweep.omega_r,
        omega_c=sweep.omega_c,
    )


@law
def change_of(body: Body, after: Rates, before: Rates) -> float:
    """Largest change of a velocity by a sweep, mm/s."""
    return max(
        max(abs(after.v_e - before.v_e), abs(after.v_f - before.v_f)),
        max(body.h * abs(after.w - before.w), body.T * abs(after.s - before.s)),
        max(
            body.R * abs(after.omega_l - before.omega_l),
            body.R * abs(after.omega_r - before.omega_r),
        ),
        body.R_c * abs(after.omega_c - before.omega_c),
    )


@block
def sweep_on(
    body: Body,
    free: Rates,
    cos_p: float,
    sin_p: float,
    floor: Floor,
    limits: FrictionLimits,
    sweep: Sweep,
    sweeps: int,
) -> Sweep:
    """Sweeps until the velocities no longer change, at most so many."""
    if_locked = inverse_mass_if_locked(body, cos_p, sin_p)
    if_steering = inverse_mass_if_steering(body, cos_p, sin_p)
    for _ in range(sweeps):
        before = rates_of(sweep)
        for side in (LEFT, RIGHT):
            lifted = without_drive_wheel(body, side, sweep)
            wheel = solve_wheel(drive_wheel(body, side, lifted, free, floor, limits))
            sweep = with_drive_wheel(body, side, sweep, lifted, wheel)
        sweep = solve_castor(body, if_locked, if_steering, sweep, cos_p, sin_p, free, limits)
        if change_of(body, rates_of(sweep), before) < SWEEP_TOLERANCE_MM_S:
            break
    return sweep


@law
def end_sweeps(
    body: Body,
    sweep: Sweep,
    cos_p: float,
    sin_p: float,
    floor: Floor,
    limits: FrictionLimits,
) -> tuple[Rates, Contact]:
    """Velocities and impulses of a substep, from the last sweep."""
    p_le, p_re = sweep.p_le, sweep.p_re
    both_stick = sweep.lam_l == 0.0 and sweep.lam_r == 0.0 and floor.creep == 0.0
    even_l, even_r = share_lateral(p_le, sweep.p_lf, p_re, sweep.p_rf, limits.grip_l, limits.grip_r)
    p_le, p_re = even_l if both_stick else p_le, even_r if both_stick else p_re
    after = rates_of(sweep)
    slips = tyre_slips(body, after, floor, cos_p, sin_p)
    return (
        after,
        Contact(
            p_le=p_le,
            p_lf=sweep.p_lf,
            p_re=p_re,
            p_rf=sweep.p_rf,
            p_cx=sweep.p_cx,
            p_cy=sweep.p_cy,
            q_l=sweep.q_l,
            q_r=sweep.q_r,
            q_c=sweep.q_c,
            q_s=sweep.q_s,
            slip_l=math.sqrt(slips.e * slips.e + slips.lf * slips.lf),
            slip_r=math.sqrt(slips.e * slips.e + slips.rf * slips.rf),
            slip_c=math.sqrt(slips.cx * slips.cx + slips.cy * slips.cy),
        ),
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
    begun = begin_sweeps(body, free, contact, cos_p, sin_p)
    solved = sweep_on(body, free, cos_p, sin_p, floor, limits, begun, SWEEP_CAP)
    return end_sweeps(body, solved, cos_p, sin_p, floor, limits)
