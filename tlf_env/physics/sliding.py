"""The sweeps of :mod:`tlf_env.physics.sweeps` for several robots side by side, in vectors.

The numbers of all robots lie in a table with a column for each. Every stage of a sweep runs one law over the
columns in a loop, which the compiler turns into vector instructions. A robot that has converged, or needs no
sweeps, keeps its numbers, and so does a tyre whose impulse is found while Newton's method still works on
others. So each robot goes through the same operations as alone, and gets the same bits. Rows that no stage has
written for a robot may hold anything, and are not chosen.
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
    InverseMass,
    Lifted,
    Solution,
    Sweep,
    Wheel,
    begin_sweeps,
    can_stick,
    castor_after,
    castor_if_locked,
    castor_if_steering,
    change_of,
    circle_if_stuck,
    circle_if_turning,
    drive_wheel,
    end_sweeps,
    friction_if_stuck,
    friction_if_turning,
    inverse_mass_if_locked,
    inverse_mass_if_steering,
    rates_of,
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
    "before": Rates,  # as the sweep began
    "if_locked": InverseMass,
    "if_steering": InverseMass,
    "lifted": Lifted,  # the rest is of one stage
    "wheel": Wheel,
    "stuck": Solution,  # of an axle that sticks
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
if_locked_of, set_if_locked = _access("if_locked")
if_steering_of, set_if_steering = _access("if_steering")
lifted_of, set_lifted = _access("lifted")
wheel_of, set_wheel = _access("wheel")
stuck_of, set_stuck = _access("stuck")
found_of, set_found = _access("found")
SWEEPING, WHEEL, MAY_STICK, TYRE, OPEN, STEERS = (
    _PLACES["marks"] + i for i in range(len(Marks._fields))
)
AXLE, STEERING = _PLACES["torques"], _PLACES["torques"] + 1
chosen_sweep, chosen_solution = choosing(Sweep), choosing(Solution)
chosen_circle, chosen_found = choosing(Circle), choosing(Found)


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
    set_if_locked(t, i, inverse_mass_if_locked(body, cos_p, sin_p))
    set_if_steering(t, i, inverse_mass_if_steering(body, cos_p, sin_p))
    begun = begin_sweeps(body, free, contact, cos_p, sin_p)
    set_sweep(t, i, begun)
    set_before(t, i, rates_of(begun))
    t[SWEEPING, i] = 1.0 if slides else 0.0


@law
def end(t: np.ndarray, i: int) -> tuple[Rates, Contact]:
    """Velocities and impulses of the robot in column ``i``."""
    fork = fork_of(t, i)
    return end_sweeps(
        body_of(t, i), sweep_of(t, i), fork.cos_p, fork.sin_p, floor_of(t, i), limits_of(t, i)
    )


@law
def begin_tyre(t: np.ndarray, i: int, circle: Circle, solves: bool) -> bool:
    """Try whether a tyre sticks; return whether Newton's method has to find its impulse."""
    stuck = sticking(circle)
    grips = circle.radius > 0.0
    inside = grips & is_inside(stuck, circle.radius)
    p_e, p_f = stuck.p_e if grips else 0.0, stuck.p_f if grips else 0.0
    lam = first_lambda(circle)
    lam = 0.0 if inside else lam
    lam = lam if grips else math.inf
    set_found(t, i, Found(p_e, p_f, lam, circle.radius))
    is_open = solves & grips & (not inside)
    t[TYRE, i] = t[OPEN, i] = 1.0 if is_open else 0.0
    return is_open


@law
def end_tyre(t: np.ndarray, i: int, circle: Circle) -> Found:
    """The solution of a tyre."""
    found = found_of(t, i)
    return chosen_found(t[TYRE, i] != 0.0, on_circle(found, circle.radius), found)


@law
def circle_of(t: np.ndarray, i: int, turns: bool) -> Circle:
    """The tyre of this stage, on an axle that turns or sticks."""
    wheel = wheel_of(t, i)
    stuck, turning = circle_if_stuck(wheel), circle_if_turning(wheel, t[AXLE, i])
    return chosen_circle(turns, turning, stuck)


@law
def find_impulses(t: np.ndarray, turns: bool) -> None:
    """Newton's method for the tyres that are marked ``open``."""
    some_open, step = True, 0
    while some_open and step < NEWTON_STEPS:
        some_open = False
        for i in range(COLUMNS):
            before = found_of(t, i)
            solved, found = next_found(circle_of(t, i, turns), before.lam)
            is_open = t[OPEN, i] != 0.0
            set_found(t, i, chosen_found(is_open, found, before))
            is_open = is_open & (not solved)
            t[OPEN, i] = 1.0 if is_open else 0.0
            some_open |= is_open
        step += 1


@law
def begin_wheel(t: np.ndarray, i: int, wheel: Wheel, solves: bool) -> bool:
    """Prepare a wheel, if it is to be solved; return whether its axle may stick."""
    set_wheel(t, i, wheel)
    may_stick = solves & can_stick(wheel)
    t[WHEEL, i] = 1.0 if solves else 0.0
    t[MAY_STICK, i] = 1.0 if may_stick else 0.0
    return may_stick


@law
def begin_stuck(t: np.ndarray) -> bool:
    """Begin with the tyres of the axles that may stick; whether Newton's method is needed."""
    some_open = False
    for i in range(COLUMNS):
        circle = circle_if_stuck(wheel_of(t, i))
        some_open |= begin_tyre(t, i, circle, t[MAY_STICK, i] != 0.0)
    return some_open


@law
def end_stuck(t: np.ndarray) -> None:
    """Take over the solutions of the axles that stick."""
    for i in range(COLUMNS):
        wheel = wheel_of(t, i)
        found = end_tyre(t, i, circle_if_stuck(wheel))
        q = friction_if_stuck(wheel, found.p_f)
        set_stuck(t, i, Solution(found.p_e, found.p_f, q, 0.0, found.lam))
        sticks = (t[MAY_STICK, i] != 0.0) & (abs(q) <= wheel.friction)
        t[WHEEL, i] = 0.0 if sticks else t[WHEEL, i]


@law
def begin_turning(t: np.ndarray) -> bool:
    """Begin with the tyres of the axles that slide; whether Newton's method is needed."""
    some_open = False
    for i in range(COLUMNS):
        wheel, stuck = wheel_of(t, i), stuck_of(t, i)
        q = friction_if_turning(wheel, t[MAY_STICK, i] != 0.0, stuck.q)
        t[AXLE, i] = q
        some_open |= begin_tyre(t, i, circle_if_turning(wheel, q), t[WHEEL, i] != 0.0)
    return some_open


@law
def are_some(t: np.ndarray, mark: int) -> bool:
    """Whether some robots are marked."""
    some = False
    for i in range(COLUMNS):
        some |= t[mark, i] != 0.0
    return some


@law
def solve_wheels(t: np.ndarray, some_may_stick: bool) -> None:
    """:func:`tlf_env.physics.sweeps.solve_wheel` of the robots that are marked ``wheel``.

    :func:`solution_of` gives the result.
    """
    for stage in range(2):  # a loop, so that Newton's method is there once
        if stage == 0:
            if not some_may_stick:
                continue
            some_open = begin_stuck(t)
        else:
            if not are_some(t, WHEEL):
                continue
            some_open = begin_turning(t)
        if some_open:
            find_impulses(t, stage == 1)
        if stage == 0:
            end_stuck(t)


@law
def solution_of(t: np.ndarray, i: int) -> Solution:
    """What :func:`solve_wheels` has found for a robot."""
    wheel, q = wheel_of(t, i), t[AXLE, i]
    found = end_tyre(t, i, circle_if_turning(wheel, q))
    omega = spin_if_turning(wheel, q, found.p_f)
    turned = Solution(found.p_e, found.p_f, q, omega, found.lam)
    return chosen_solution(t[WHEEL, i] != 0.0, turned, stuck_of(t, i))


@law
def begin_drive_wheel(t: np.ndarray, i: int, side: float) -> bool:
    """Prepare one drive wheel; whether its axle may stick."""
    body = body_of(t, i)
    lifted = without_drive_wheel(body, side, sweep_of(t, i))
    set_lifted(t, i, lifted)
    wheel = drive_wheel(body, side, lifted, free_of(t, i), floor_of(t, i), limits_of(t, i))
    return begin_wheel(t, i, wheel, t[SWEEPING, i] != 0.0)


@law
def end_drive_wheel(t: np.ndarray, i: int, side: float) -> None:
    """Take over the solution of one drive wheel."""
    body, before, lifted, solution = (
        body_of(t, i),
        sweep_of(t, i),
        lifted_of(t, i),
        solution_of(t, i),
    )
    after = with_drive_wheel(body, side, before, lifted, solution)
    set_sweep(t, i, chosen_sweep(t[SWEEPING, i] != 0.0, after, before))


@law
def begin_castor(t: np.ndarray, i: int) -> bool:
    """Prepare the castor with locked steering; whether its axle may stick."""
    body, fork = body_of(t, i), fork_of(t, i)
    cos_p, sin_p = fork.cos_p, fork.sin_p
    lifted = without_castor(body, sweep_of(t, i), cos_p, sin_p)
    set_lifted(t, i, lifted)
    inverse, free, limits = if_locked_of(t, i), free_of(t, i), limits_of(t, i)
    wheel = castor_if_locked(body, inverse, lifted, cos_p, sin_p, free, limits)
    return begin_wheel(t, i, wheel, t[SWEEPING, i] != 0.0)


@law
def end_locked_castor(t: np.ndarray, i: int) -> bool:
    """Take over the solution with locked steering, if it locks; whether the steering slides."""
    body, fork, lifted, limits = body_of(t, i), fork_of(t, i), lifted_of(t, i), limits_of(t, i)
    cos_p, sin_p, solution, before = fork.cos_p, fork.sin_p, solution_of(t, i), sweep_of(t, i)
    locked, q_s = turn_if_locked(body, lifted, cos_p, sin_p, solution.p_e, solution.p_f)
    sweeping, locks = t[SWEEPING, i] != 0.0, abs(q_s) <= limits.steering
    after = castor_after(body, before, cos_p, sin_p, solution, q_s, locked, locked)
    set_sweep(t, i, chosen_sweep(sweeping & locks, with_castor(before, after), before))
    t[STEERING, i] = math.copysign(limits.steering, q_s)
    return sweeping & (not locks)


@law
def begin_steering_castor(t: np.ndarray, i: int, steers: bool) -> bool:
    """Prepare the castor, if its steering slides; whether its axle may stick."""
    body, fork, lifted, q_s = body_of(t, i), fork_of(t, i), lifted_of(t, i), t[STEERING, i]
    inverse, free, limits = if_steering_of(t, i), free_of(t, i), limits_of(t, i)
    wheel = castor_if_steering(body, inverse, lifted, q_s, fork.cos_p, fork.sin_p, free, limits)
    t[STEERS, i] = 1.0 if steers else 0.0
    return begin_wheel(t, i, wheel, steers)


@law
def end_steering_castor(t: np.ndarray, i: int) -> None:
    """Take over the solution of a castor whose steering slides."""
    body, fork, lifted, q_s = body_of(t, i), fork_of(t, i), lifted_of(t, i), t[STEERING, i]
    cos_p, sin_p, solution, before = fork.cos_p, fork.sin_p, solution_of(t, i), sweep_of(t, i)
    w, s = turn_if_steering(body, lifted, q_s, cos_p, sin_p, solution.p_e, solution.p_f)
    after = castor_after(body, before, cos_p, sin_p, solution, q_s, w, s)
    set_sweep(t, i, chosen_sweep(t[STEERS, i] != 0.0, with_castor(before, after), before))


@law
def end_sweep(t: np.ndarray, i: int) -> None:
    """Mark whether the sweeps of a robot have converged."""
    after = rates_of(sweep_of(t, i))
    change = change_of(body_of(t, i), after, before_of(t, i))
    t[SWEEPING, i] = 0.0 if change < SWEEP_TOLERANCE_MM_S else t[SWEEPING, i]
    set_before(t, i, after)


@law
def sweep_once(t: np.ndarray) -> None:
    """Left wheel, right wheel, castor with locked and with sliding steering.

    The end of a stage and the beginning of the next are one loop over the robots, whose values stay in
    registers. The stages are a loop, so that the code that solves a wheel is there once.
    """
    some, may_stick = True, False
    for i in range(COLUMNS):
        may_stick |= begin_drive_wheel(t, i, LEFT)
    for stage in range(4):
        if some:
            solve_wheels(t, may_stick)
        may_stick = False
        if stage == 0:
            for i in range(COLUMNS):
                end_drive_wheel(t, i, LEFT)
                may_stick |= begin_drive_wheel(t, i, RIGHT)
        elif stage == 1:
            for i in range(COLUMNS):
                end_drive_wheel(t, i, RIGHT)
                may_stick |= begin_castor(t, i)
        elif stage == 2:
            some = False
            for i in range(COLUMNS):
                steers = end_locked_castor(t, i)
                may_stick |= begin_steering_castor(t, i, steers)
                some |= steers
        elif some:
            for i in range(COLUMNS):
                end_steering_castor(t, i)
                end_sweep(t, i)
        else:
            for i in range(COLUMNS):
                end_sweep(t, i)


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
        sweep_once(t)
