"""The wheel loop of eqs (6) to (13) as linear systems, for both units of K(s) and several plants.

The paper prints K(s) without a unit. In kg·mm²/s² per rad/s its design figures follow (the *design* loop); in
N·mm per rad/s, 1000 times as much, the robot moves (the *running* loop). Needs python-control.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import control
import numpy as np
from scipy import signal
from scipy.optimize import minimize_scalar

from tlf_env.onboard.wheel_loop import WheelLoopParameters
from tlf_env.physics.linear import linearise
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import RobotParameters

ROBOT = RobotParameters()
LOOP = WheelLoopParameters()
# Eq. (6), rad/s² per N·mm.
KAPPA = MILLINEWTON_PER_NEWTON / (
    ROBOT.drive_load_share * ROBOT.mass_kg * ROBOT.wheel_radius_mm**2 + ROBOT.wheel_inertia_kg_mm2
)
UNITS = {"design": 1 / MILLINEWTON_PER_NEWTON, "running": 1.0}  # of K, N·mm per printed unit
SPEED_MM_S = 300.0  # at which the differential mode is linearised
SWING_RAD_S = 1.0  # amplitude for the describing function of joint friction
OMEGA = np.geomspace(1e-4, 1e5, 3601)  # rad/s
HIGH_RAD_S = 1e9  # beyond all poles


class Conditions(NamedTuple):
    """Suprema of a loop, over all frequencies."""

    stable: bool  # the nominal closed loop
    crossover_rad_s: float  # the highest at which |L| = 1; NaN without one
    robust: float  # (9) sup |W_δ T|
    nominal: float  # (10) sup |W_e S|
    both: float  # (11) sup of their sum
    margin: float  # inf |1 + L|


def laplace() -> Any:
    """The variable s as a transfer function."""
    return control.tf("s")


def weight_uncertainty() -> Any:
    """W_δ of eq. (12)."""
    return (laplace() + 1.27) / 2.54


def weight_error() -> Any:
    """W_e of eq. (12)."""
    s = laplace()
    return (s + 0.1) / (1.5 * s)


def controller(form: str = "exact") -> Any:
    """K(s) of eq. (13) in the unit that is printed: ``exact``, or the ``rounded`` partial fractions."""
    s = laplace()
    if form == "exact":
        return (
            LOOP.gain_Nmm_s * (s**2 + LOOP.zeros_1 * s + LOOP.zeros_0) / (s * (s + LOOP.pole_rad_s))
        )
    return 150 + 22 / s + 128 / (s + 2)


def sliding_friction() -> float:
    """Sliding friction of a drive wheel's joint without side force, by eq. (5): μ_d R_p N, in N·mm."""
    load_mN = ROBOT.drive_load_share * ROBOT.mass_kg * ROBOT.gravity_mm_s2
    joint = ROBOT.drive_joint
    return joint.mu_dynamic * joint.pin_radius_mm * load_mN / MILLINEWTON_PER_NEWTON


def equivalent_viscosity(swing_rad_s: float = SWING_RAD_S) -> float:
    """Describing function of sliding friction about rest, 4 T_f / (π A): N·mm per rad/s at amplitude A."""
    return 4 * sliding_friction() / (math.pi * swing_rad_s)


def steepest_fall() -> float:
    """Steepest fall of joint friction with speed, between v_s and v_d of Fig. 3(b): N·mm per rad/s (negative).

    The cubic step falls by 1.5 (μ_s − μ_d)/(v_d − v_s) in its middle.
    """
    joint = ROBOT.drive_joint
    fall = (
        1.5
        * (joint.mu_static - joint.mu_dynamic)
        / (joint.dynamic_speed_mm_s - joint.stiction_speed_mm_s)
    )
    return -fall / joint.mu_dynamic * sliding_friction() * ROBOT.wheel_radius_mm


def plants() -> dict[str, Any]:
    """Transfer functions from a wheel's torque (N·mm) to its speed (rad/s), by name.

    Common mode: both wheels have the same torque; differential mode: opposite torques. The last three have a
    linear joint friction: the sliding friction of the others is constant, and so an input disturbance.
    """
    s = laplace()
    linear = linearise(ROBOT, SPEED_MM_S)
    found = {"eq. (6)": KAPPA / s}
    # Straight on, the speed does not act on yaw rate and castor, nor they on it.
    modes = {"common mode": ([0], (1.0, 1.0)), "differential mode": ([1, 2], (-1.0, 1.0))}
    for name, (states, signs) in modes.items():
        B = linear.B[states] @ np.array(signs)[:, None]
        C = np.array(signs)[None, :] / 2 @ linear.C[:, states]
        A = linear.A[np.ix_(states, states)]
        numerator, denominator = signal.ss2tf(A, B, C, np.zeros((1, 1)))
        found[name] = control.tf(numerator[0], denominator)
    viscosity = equivalent_viscosity()
    for name in list(found):
        found[f"{name}, friction about rest"] = control.feedback(found[name], viscosity)
    found["eq. (6), friction falls"] = control.feedback(found["eq. (6)"], steepest_fall())
    return found


def kappa_of(plant: Any) -> float:
    """κ of a plant: what ω̇/τ tends to at high frequencies, rad/s² per N·mm."""
    return float(abs(HIGH_RAD_S * plant(1j * HIGH_RAD_S)))


def open_loop(plant: Any, unit: str = "running", form: str = "exact") -> Any:
    """L(s) = G(s) K(s) for a unit of K of :data:`UNITS`."""
    return UNITS[unit] * plant * controller(form)


def conditions(plant: Any, unit: str = "running", form: str = "exact") -> Conditions:
    """Conditions (9), (10) and (11) for a plant."""
    L = open_loop(plant, unit, form)
    poles = control.feedback(L, 1).poles()
    w_delta, w_e = weight_uncertainty(), weight_error()

    def robust(omega: Any) -> Any:
        loop = L(1j * omega)
        return np.abs(w_delta(1j * omega) * loop / (1 + loop))

    def nominal(omega: Any) -> Any:
        return np.abs(w_e(1j * omega) / (1 + L(1j * omega)))

    magnitude = np.abs(L(1j * OMEGA))
    return Conditions(
        stable=bool(np.all(poles.real < 1e-9)),
        crossover_rad_s=last_crossing(OMEGA, magnitude),
        robust=supremum(robust),
        nominal=supremum(nominal),
        both=supremum(lambda omega: robust(omega) + nominal(omega)),
        margin=-supremum(lambda omega: -np.abs(1 + L(1j * omega))),
    )


def supremum(of: Any) -> float:
    """The largest value of a function of frequency (rad/s): on a grid, then refined about the largest."""
    values = of(OMEGA)
    k = int(np.argmax(values))
    low, high = math.log(OMEGA[max(k - 1, 0)]), math.log(OMEGA[min(k + 1, len(OMEGA) - 1)])
    found = minimize_scalar(
        lambda x: -float(of(math.exp(x))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return max(float(values[k]), -float(found.fun))


def last_crossing(omega: np.ndarray, magnitude: np.ndarray) -> float:
    """The highest frequency at which a magnitude falls through 1, interpolated; NaN without one."""
    above = magnitude >= 1
    falls = np.flatnonzero(above[:-1] & ~above[1:])
    if not len(falls):
        return math.nan
    k = falls[-1]
    x, y = np.log(omega[k : k + 2]), np.log(magnitude[k : k + 2])
    return float(np.exp(x[0] - y[0] * (x[1] - x[0]) / (y[1] - y[0])))
