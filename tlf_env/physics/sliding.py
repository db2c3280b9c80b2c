"""The sweeps of :mod:`tlf_env.physics.sweeps` for several robots side by side, in vectors.

The numbers of all robots lie in a table with a column for each. Every stage of a sweep runs one law over the
columns in a loop, which the compiler turns into vector instructions. A robot that has converged, or needs no
sweeps, keeps its numbers, and so does a tyre whose impulse is found while Newton's method still works on
others. So each robot goes through the same operations as alone, and gets the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.memory import shaped
from tlf_env.numerics.rows import choosing, row_reader, row_writer
from tlf_env.physics.friction import (
    NEWTON_STEPS,
    Circle,
    Found,
    first_lambda,
    is_inside,
    next_found,
    on_circle,
    sticking,
)
from tlf_env.physics.friction_limits import FrictionLimits
from tlf_env.physics.parameters import Body
from tlf_env.physics.state import Contact, Floor, Rates
from tlf_env.physics.sweeps import (
    LEFT,
    RIGHT,
    SWEEP_CAP,
    SWEEP_TOLERANCE_MM_S,
    Lifted,
    Solution,
    Sweep,
    Wheel,
    begin_sweeps,
    can_stick,
    castor_if_locked,
    castor_if_steering,
    change_of,
    circle_if_stuck,
    circle_if_turning,
    drive_wheel,
    end_sweeps,
    friction_if_stuck,
    friction_if_turning,
    spin_if_turning,
    sweep_on,
    turn_if_locked,
    turn_if_steering,
    with_castor,
    with_drive_wheel,
    without_castor,
    without_drive_wheel,
)

COLUMNS = 8  # robots in a table


class Fork(NamedTuple):
    """Cosine and sine of the castor's angle."""

    cos_p: float
    sin_p: float


class Marks(NamedTuple):
    """1 or 0 for each robot."""

    sweeping: float  # its sweeps have not converged
    wheel: float  # the wheel of this stage is to be solved
    may_stick: float  # its axle may stick
    tyre: float  # its tyre is to be solved
    open: float  # Newton's method has not converged
    steers: float  # the steering slides


class Torques(NamedTuple):
    """Friction impulses in a stage of a sweep."""

    q: float  # of the axle of this stage
    q_s: float  # of the steering


_TABLE: dict[str, Any] = {
    "body": Body,
    "floor": Floor,
    "fork": Fork,
    "limits": FrictionLimits,
    "free": Rates,
    "sweep": Sweep,
    "before": Sweep,  # as the sweep began
    "lifted": Lifted,  # the rest is of one stage
    "wheel": Wheel,
    "solution": Solution,
    "circle": Circle,
    "found": Found,
    "marks": Marks,
    "torques": Torques,
}
_PLACES = dict(
    zip(_TABLE, accumulate([len(row._fields) for row in _TABLE.values()], initial=0), strict=False)
)
ROWS = sum(len(row._fields) for row in _TABLE.values())  # of a table


def _access(name: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    return row_reader(_TABLE[name], _PLACES[name]), row_writer(_TABLE[name], _PLACES[name])


body_of, set_body = _access("body")
floor_of, set_floor = _access("floor")
fork_of, set_fork = _access("fork")
limits_of, set_limits = _access("limits")
free_of, set_free = _access("free")
sweep_of, set_sweep = _access("sweep")
before_of, set_before = _access("before")
lifted_of, set_lifted = _access("lifted")
wheel_of, set_wheel = _access("wheel")
solution_of, set_solution = _access("solution")
circle_of, set_circle = _access("circle")
found_of, set_found = _access("found")
SWEEPING, WHEEL, MAY_STICK, TYRE, OPEN, STEERS = (
    _PLACES["marks"] + i for i in range(len(Marks._fields))
)
AXLE, STEERING = _PLACES["torques"], _PLACES["torques"] + 1
chosen_sweep, chosen_solution = choosing(Sweep), choosing(Solution)
chosen_found = choosing(Found)


@law
def begin(
    t: np.ndarray,
    i: int,
    slides: bool,
    body: Body,
    free: Rates,
    contact: Contact,
    cos_p: float,
    sin_p: float,
    floor: Floor,
    limits: FrictionLimits,
) -> None:
    """Write what the sweeps of a robot need, and whether it needs any, into column ``i``."""
    set_body(t, i, body)
    set_floor(t, i, floor)
    set_fork(t, i, Fork(cos_p, sin_p))
    set_limits(t, i, limits)
    set_free(t, i, free)
    set_sweep(t, i, begin_sweeps(body, free, contact, cos_p, sin_p))
    t[SWEEPING, i] = 1.0 if slides else 0.0


@law
def end(t: np.ndarray, i: int) -> tuple[Rates, Contact]:
    """Velocities and impulses of the robot in column ``i``."""
    fork = fork_of(t, i)
    return end_sweeps(
        body_of(t, i), sweep_of(t, i), fork.cos_p, fork.sin_p, floor_of(t, i), limits_of(t, i)
    )


@block
def solve_tyres(table: np.ndarray) -> None:
    """:func:`tlf_env.physics.friction.disc` of the circles whose robots are marked ``tyre``."""
    t = shaped(table, ROWS, COLUMNS)
    some_open = False
    for i in range(COLUMNS):
        circle = circle_of(t, i)
        stuck = sticking(circle)
        grips = circle.radius > 0.0
        inside = grips & is_inside(stuck, circle.radius)
        p_e, p_f = stuck.p_e if grips else 0.0, stuck.p_f if grips else 0.0
        lam = first_lambda(circle)
        lam = 0.0 if inside else lam
        lam = lam if grips else math.inf
        set_found(t, i, Found(p_e, p_f, lam, circle.radius))
        is_open = (t[TYRE, i] != 0.0) & grips & (not inside)
        t[TYRE, i] = t[OPEN, i] = 1.0 if is_open else 0.0
        some_open |= is_open
    if not some_open:
        return
    step = 0
    while some_open and step < NEWTON_STEPS:
        some_open = False
        for i in range(COLUMNS):
            before = found_of(t, i)
            solved, found = next_found(circle_of(t, i), before.lam)
            is_open = t[OPEN, i] != 0.0
            set_found(t, i, chosen_found(is_open, found, before))
            is_open = is_open & (not solved)
            t[OPEN, i] = 1.0 if is_open else 0.0
            some_open |= is_open
        step += 1
    for i in range(COLUMNS):
        found = found_of(t, i)
        scaled = on_circle(found, circle_of(t, i).radius)
        set_found(t, i, chosen_found(t[TYRE, i] != 0.0, scaled, found))


@law
def begin_stuck(t: np.ndarray) -> bool:
    """Prepare the tyres of the axles that may stick; whether there are any."""
    some = False
    for i in range(COLUMNS):
        wheel = wheel_of(t, i)
        may_stick = (t[WHEEL, i] != 0.0) & can_stick(wheel)
        t[MAY_STICK, i] = t[TYRE, i] = 1.0 if may_stick else 0.0
        set_circle(t, i, circle_if_stuck(wheel))
        set_solution(t, i, Solution(0.0, 0.0, 0.0, 0.0, 0.0))
        some |= may_stick
    return some


@law
def end_stuck(t: np.ndarray) -> None:
    """Take over the solutions of the axles that stick."""
    for i in range(COLUMNS):
        found, wheel = found_of(t, i), wheel_of(t, i)
        q = friction_if_stuck(wheel, found.p_f)
        set_solution(t, i, Solution(found.p_e, found.p_f, q, 0.0, found.lam))
        sticks = (t[MAY_STICK, i] != 0.0) & (abs(q) <= wheel.friction)
        t[WHEEL, i] = 0.0 if sticks else t[WHEEL, i]


@law
def begin_turning(t: np.ndarray) -> bool:
    """Prepare the tyres of the axles that slide; whether there are any."""
    some = False
    for i in range(COLUMNS):
        wheel, solution = wheel_of(t, i), solution_of(t, i)
        q = friction_if_turning(wheel, t[MAY_STICK, i] != 0.0, solution.q)
        t[AXLE, i] = q
        t[TYRE, i] = t[WHEEL, i]
        set_circle(t, i, circle_if_turning(wheel, q))
        some |= t[WHEEL, i] != 0.0
    return some


@law
def end_turning(t: np.ndarray) -> None:
    """Take over the solutions of the axles that slide."""
    for i in range(COLUMNS):
        wheel, found, q = wheel_of(t, i), found_of(t, i), t[AXLE, i]
        omega = spin_if_turning(wheel, q, found.p_f)
        turned = Solution(found.p_e, found.p_f, q, omega, found.lam)
        set_solution(t, i, chosen_solution(t[WHEEL, i] != 0.0, turned, solution_of(t, i)))


@block
def solve_wheels(table: np.ndarray) -> None:
    """:func:`tlf_env.physics.sweeps.solve_wheel` of the robots that are marked ``wheel``."""
    t = shaped(table, ROWS, COLUMNS)
    for stage in range(2):  # a loop, so that the code that solves a tyre is there once
        some = begin_stuck(t) if stage == 0 else begin_turning(t)
        if some:
            solve_tyres(t)
            if stage == 0:
                end_stuck(t)
            else:
                end_turning(t)


@law
def begin_drive_wheel(t: np.ndarray, side: float) -> bool:
    """Prepare one drive wheel of all robots; whether some are to be solved."""
    for i in range(COLUMNS):
        body = body_of(t, i)
        lifted = without_drive_wheel(body, side, sweep_of(t, i))
        set_lifted(t, i, lifted)
        set_wheel(
            t, i, drive_wheel(body, side, lifted, free_of(t, i), floor_of(t, i), limits_of(t, i))
        )
        t[WHEEL, i] = t[SWEEPING, i]
    return True


@law
def end_drive_wheel(t: np.ndarray, side: float) -> None:
    """Take over the solutions of one drive wheel."""
    for i in range(COLUMNS):
        before = sweep_of(t, i)
        after = with_drive_wheel(body_of(t, i), side, before, lifted_of(t, i), solution_of(t, i))
        set_sweep(t, i, chosen_sweep(t[SWEEPING, i] != 0.0, after, before))


@law
def begin_castor(t: np.ndarray) -> bool:
    """Prepare the castors of all robots with locked steering; whether some are to be solved."""
    for i in range(COLUMNS):
        body, fork = body_of(t, i), fork_of(t, i)
        lifted = without_castor(body, sweep_of(t, i), fork.cos_p, fork.sin_p)
        set_lifted(t, i, lifted)
        wheel = castor_if_locked(
            body, lifted, fork.cos_p, fork.sin_p, free_of(t, i), limits_of(t, i)
        )
        set_wheel(t, i, wheel)
        t[WHEEL, i] = t[SWEEPING, i]
    return True


@law
def end_locked_castor(t: np.ndarray) -> None:
    """Take over the solutions with locked steering of those whose steering locks."""
    for i in range(COLUMNS):
        body, fork, lifted = body_of(t, i), fork_of(t, i), lifted_of(t, i)
        limits, solution, before = limits_of(t, i), solution_of(t, i), sweep_of(t, i)
        cos_p, sin_p = fork.cos_p, fork.sin_p
        locked, q_s = turn_if_locked(body, lifted, cos_p, sin_p, solution.p_e, solution.p_f)
        sweeping, locks = t[SWEEPING, i] != 0.0, abs(q_s) <= limits.steering
        after = with_castor(body, before, cos_p, sin_p, solution, q_s, locked, locked)
        set_sweep(t, i, chosen_sweep(sweeping & locks, after, before))
        t[STEERING, i] = math.copysign(limits.steering, q_s)
        t[STEERS, i] = 1.0 if sweeping & (not locks) else 0.0


@law
def begin_steering_castor(t: np.ndarray) -> bool:
    """Prepare the castors whose steering slides; whether there are any."""
    some = False
    for i in range(COLUMNS):
        body, fork, lifted, q_s = body_of(t, i), fork_of(t, i), lifted_of(t, i), t[STEERING, i]
        wheel = castor_if_steering(
            body, lifted, q_s, fork.cos_p, fork.sin_p, free_of(t, i), limits_of(t, i)
        )
        set_wheel(t, i, wheel)
        t[WHEEL, i] = t[STEERS, i]
        some |= t[STEERS, i] != 0.0
    return some


@law
def end_steering_castor(t: np.ndarray) -> None:
    """Take over the solutions of the castors whose steering slides."""
    for i in range(COLUMNS):
        body, fork, lifted = body_of(t, i), fork_of(t, i), lifted_of(t, i)
        solution, before, q_s = solution_of(t, i), sweep_of(t, i), t[STEERING, i]
        cos_p, sin_p = fork.cos_p, fork.sin_p
        w, s = turn_if_steering(body, lifted, q_s, cos_p, sin_p, solution.p_e, solution.p_f)
        after = with_castor(body, before, cos_p, sin_p, solution, q_s, w, s)
        set_sweep(t, i, chosen_sweep(t[STEERS, i] != 0.0, after, before))


@law
def sweep_once(t: np.ndarray) -> None:
    """Left wheel, right wheel, castor with locked and with sliding steering.

    A loop, so that the code that solves a wheel is there once.
    """
    for stage in range(4):
        if stage == 0:
            some = begin_drive_wheel(t, LEFT)
        elif stage == 1:
            some = begin_drive_wheel(t, RIGHT)
        elif stage == 2:
            some = begin_castor(t)
        else:
            some = begin_steering_castor(t)
        if some:
            solve_wheels(t)
        if stage == 0:
            end_drive_wheel(t, LEFT)
        elif stage == 1:
            end_drive_wheel(t, RIGHT)
        elif stage == 2:
            end_locked_castor(t)
        elif some:
            end_steering_castor(t)


@block
def sweep_together(table: np.ndarray) -> None:
    """Sweeps of the robots that need them, each until its velocities no longer change.

    The last one that sweeps goes on alone.
    """
    t = shaped(table, ROWS, COLUMNS)
    for k in range(SWEEP_CAP):
        number, last = 0, 0
        for i in range(COLUMNS):
            if t[SWEEPING, i] != 0.0:
                number, last = number + 1, i
        if number == 0:
            return
        if number == 1:
            fork = fork_of(t, last)
            alone = sweep_on(
                body_of(t, last),
                free_of(t, last),
                fork.cos_p,
                fork.sin_p,
                floor_of(t, last),
                limits_of(t, last),
                sweep_of(t, last),
                SWEEP_CAP - k,
            )
            set_sweep(t, last, alone)
            return
        for i in range(COLUMNS):
            set_before(t, i, sweep_of(t, i))
        sweep_once(t)
        for i in range(COLUMNS):
            change = change_of(body_of(t, i), sweep_of(t, i), before_of(t, i))
            t[SWEEPING, i] = 0.0 if change < SWEEP_TOLERANCE_MM_S else t[SWEEPING, i]
