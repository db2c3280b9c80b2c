"""The table "Numbers to check an implementation against" of the physics notes, row by row.

The plant has a first-order error in its 1 ms step. A number of the table is checked to its last digit.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from physics_helpers import (
    ICE,
    NO_MEMORY,
    ROBOT,
    STILL,
    WITHOUT_JOINT_FRICTION,
    first,
    rolling,
    run,
)

from tlf_env.physics.parameters import RobotParameters, body
from tlf_env.physics.state import Motion

M, G = ROBOT.mass_kg, ROBOT.gravity_mm_s2
R, J = ROBOT.wheel_radius_mm, ROBOT.wheel_inertia_kg_mm2
R_C, J_C = ROBOT.castor_radius_mm, ROBOT.castor_inertia_kg_mm2
HALF, TRAIL = ROBOT.axle_width_mm / 2, ROBOT.castor_trail_mm
LOAD, LOAD_C = ROBOT.drive_load_share * M * G, ROBOT.castor_load_share * M * G
CASTOR_MASS = J_C / R_C**2
ROLLING_MASS = M + 2 * J / R**2 + CASTOR_MASS
# A torque difference of 1 N·mm turns the robot by HALF/R; the castor's floor contact, behind the axle
# by pivot and trail, holds against that, and twists the steering by the trail.
STEERING_PER_DIFFERENCE = HALF / R * TRAIL / (ROBOT.castor_pivot_mm + TRAIL)


def changed(joint: str, **values: float) -> RobotParameters:
    """The robot with other values for one of its joints."""
    return ROBOT.model_copy(update={joint: getattr(ROBOT, joint).model_copy(update=values)})


STEERING_LOCKED = changed("steering_joint", preload_Nmm=1e3)
BENDING_OFF = changed("steering_joint", bending=False)


def acceleration(made: Motion, seconds: float = 0.5) -> float:
    """Mean over the last part of a run along y, mm/s²."""
    return float(made.v_y[-1] - made.v_y[-1 - round(seconds / 0.001)]) / seconds


# straight run without joint friction, 8 N·mm, 4 s: 1973.29 mm


def test_straight_run_without_joint_friction_goes_1973_29_mm():
    torque, seconds = 8.0, 4.0
    expected = 2 * 1000 * torque / R / ROLLING_MASS
    assert 0.5 * expected * seconds**2 == pytest.approx(1973.29, abs=0.005)

    def way(dt_s: float) -> float:
        made = run(
            WITHOUT_JOINT_FRICTION, seconds=seconds, torques_Nmm=(torque, torque), dt_s=dt_s
        ).motion
        return float(made.y[-1] - made.y[0])

    # The implicit step adds v·dt with the new v: t(t + dt)/2 instead of t²/2.
    assert way(0.001) == pytest.approx(0.5 * expected * seconds * (seconds + 0.001), rel=1e-9)
    assert 2 * way(0.0005) - way(0.001) == pytest.approx(1973.29, abs=0.005)


# common-mode κ against eq. (6): 0.800 (0.807 if the castor wheel had no inertia)


@pytest.mark.parametrize(("castor_inertia", "row"), [(J_C, 0.800), (1e-9, 0.807)])
def test_common_mode_kappa_against_eq_6(castor_inertia, row):
    robot = WITHOUT_JOINT_FRICTION.model_copy(update={"castor_inertia_kg_mm2": castor_inertia})
    kappa_eq_6 = 1 / (0.4 * M * R**2 + J)
    made = run(robot, seconds=1, torques_Nmm=(8, 8)).motion
    kappa = made.omega_l[-1] / 8000
    assert kappa / kappa_eq_6 == pytest.approx(row, abs=0.0005)


# joint friction of a drive wheel: 5.86 N·mm static, 3.91 dynamic; break-away of the robot 7.25 N·mm


def test_joint_friction_of_a_drive_wheel_is_5_86_nmm_static():
    """A wheel that nothing but its axle holds."""
    joint = ROBOT.drive_joint
    assert joint.mu_static * joint.pin_radius_mm * LOAD / 1000 == pytest.approx(5.86, abs=0.005)
    holds = first(
        lambda torque: run(seconds=0.1, torques_Nmm=(torque, 0), floor=ICE).motion.omega_l[-1] > 0,
        5,
        7,
        1e-4,
    )
    assert holds == pytest.approx(5.86, abs=0.005)


def test_joint_friction_of_a_drive_wheel_is_3_91_nmm_dynamic():
    spinning = STILL._replace(omega_l=50.0, omega_r=-50.0)
    made = run(start=spinning, seconds=0.1, floor=ICE).motion
    for spin, sign in ((made.omega_l, 1), (made.omega_r, -1)):
        slowed = sign * (spin[0] - spin[-1]) / 0.1
        assert J * slowed / 1000 == pytest.approx(3.91, abs=0.005)


def test_the_robot_breaks_away_at_7_25_nmm():
    torque = first(
        lambda torque: run(seconds=0.5, torques_Nmm=(torque, torque)).motion.omega_l[-1] > 0,
        5,
        10,
        1e-4,
    )
    assert torque == pytest.approx(7.25, abs=0.005)


# largest acceleration at 15 N·mm; coast-down: 313.4 mm/s²; 149.0 mm/s²


def test_largest_acceleration_is_313_4_mm_s2():
    made = run(seconds=2, torques_Nmm=(15, 15)).motion
    assert acceleration(made) == pytest.approx(313.4, abs=0.05)


def test_coast_down_is_149_0_mm_s2():
    made = run(start=rolling(forward=400.0), seconds=1).motion
    assert acceleration(made) == pytest.approx(-149.0, abs=0.05)


# torque where a wheel breaks loose: 22.31 N·mm (18.43 without joint friction)
# slip sustained above: 17.77 (13.88)


def slip_after(robot: RobotParameters, torque: float, slip: float, seconds: float) -> float:
    """Slip of the drive wheels, mm/s, that starts at ``slip`` on a robot at 100 mm/s."""
    start = rolling(robot, forward=100.0)
    spin = start.omega_l + slip / R
    memory = NO_MEMORY._replace(slip_l=slip, slip_r=slip)
    made, _ = run(
        robot,
        start._replace(omega_l=spin, omega_r=spin),
        memory,
        seconds=seconds,
        torques_Nmm=(torque, torque),
    ).at(-1)
    return R * made.omega_l - made.v_y


@pytest.mark.parametrize(
    ("robot", "row"), [(ROBOT, 22.31), (WITHOUT_JOINT_FRICTION, 18.43)], ids=["", "no_joints"]
)
def test_a_wheel_breaks_loose_at_22_31_nmm(robot, row):
    torque = first(lambda torque: slip_after(robot, torque, 0.0, 20.0) > 5, 12, 30, 1e-3)
    assert torque == pytest.approx(row, abs=0.005)


@pytest.mark.parametrize(
    ("robot", "row"), [(ROBOT, 17.77), (WITHOUT_JOINT_FRICTION, 13.88)], ids=["", "no_joints"]
)
def test_slip_is_sustained_above_17_77_nmm(robot, row):
    torque = first(lambda torque: slip_after(robot, torque, 50.0, 1.0) > 50, 12, 30, 1e-3)
    assert torque == pytest.approx(row, abs=0.005)


# lateral limits: 716 mm/s² static, 539 dynamic


def test_lateral_limit_is_716_mm_s2_static():
    """Pushed sideways at the centre of mass with its steering held: the three tyres let go together."""
    force = first(
        lambda force: run(STEERING_LOCKED, seconds=20, push=(force, 0, 0)).motion.x[-1] > 1,
        100,
        2000,
        0.01,
    )
    assert force / M == pytest.approx(716, abs=0.5)
    assert force / M == pytest.approx(ROBOT.tyre.mu_static * G, abs=0.05)


def test_lateral_limit_is_539_mm_s2_dynamic():
    memory = NO_MEMORY._replace(slip_l=300.0, slip_r=300.0, slip_c=300.0)
    made = run(STEERING_LOCKED, STILL._replace(v_x=300.0), memory, seconds=0.4).motion
    slowed = (made.v_x[0] - made.v_x[-1]) / 0.4
    assert slowed == pytest.approx(539, abs=0.5)
    assert slowed == pytest.approx(ROBOT.tyre.mu_dynamic * G, rel=1e-9)
    assert abs(made.theta[-1]) < 1e-12


# torque difference τ_r − τ_l that swings the castor, rolling straight:
# 7.83 N·mm static, 5.2 moving (1.3 with bending off)

DRAG_Nmm = 4.84  # mean torque that keeps a constant speed


def steering_friction(mu: float, force_mN: float, *, bending: bool = True) -> float:
    """Eq. (5) of the steering axle under its load and a horizontal force."""
    joint = ROBOT.steering_joint
    moment = LOAD_C * TRAIL * joint.pin_radius_mm / joint.bending_arm_mm if bending else 0.0
    return mu * (joint.friction_arm_mm * LOAD_C + moment + joint.pin_radius_mm * force_mN) / 1000


def swinging_difference(mu: float, *, bending: bool = True) -> float:
    """Torque difference at which the steering turns, its own horizontal force counted in."""
    joint = ROBOT.castor_joint
    drag = joint.mu_dynamic * joint.pin_radius_mm * LOAD_C / R_C
    difference = 0.0
    for _ in range(50):
        across = 1000 * difference * STEERING_PER_DIFFERENCE / TRAIL
        friction = steering_friction(mu, math.hypot(across, drag), bending=bending)
        difference = friction / STEERING_PER_DIFFERENCE
    return difference


def measured_swinging_difference(robot: RobotParameters, side: float) -> float:
    def swings(difference: float) -> bool:
        half = side * difference / 2
        torques = (DRAG_Nmm - half, DRAG_Nmm + half)
        made = run(robot, rolling(forward=200.0), seconds=1, torques_Nmm=torques).motion
        return abs(made.psi[-1] - made.theta[-1]) > 1e-6

    return first(swings, 0.1, 15, 1e-3)


STATIC, DYNAMIC = ROBOT.steering_joint.mu_static, ROBOT.steering_joint.mu_dynamic


@pytest.mark.parametrize("side", [1, -1])
def test_castor_swings_at_a_torque_difference_of_7_83_nmm(side):
    """7.83 counts the load alone. The castor's own horizontal force makes it 7.90, as eq. (5) has it."""
    by_load = steering_friction(STATIC, 0.0) / STEERING_PER_DIFFERENCE
    assert by_load == pytest.approx(7.83, abs=0.005)
    difference = measured_swinging_difference(ROBOT, side)
    assert difference == pytest.approx(swinging_difference(STATIC), abs=0.005)


@pytest.mark.parametrize("side", [1, -1])
def test_castor_swings_at_a_torque_difference_of_1_3_nmm_without_bending(side):
    difference = measured_swinging_difference(BENDING_OFF, side)
    assert difference == pytest.approx(1.3, abs=0.05)
    assert difference == pytest.approx(swinging_difference(STATIC, bending=False), abs=0.005)


def balancing_difference(forward: float, yaw: float) -> float:
    """Torque difference at which the yaw rate stands still while the castor swings through straight."""
    swing = rolling(forward=forward)._replace(
        w=yaw,
        s=-yaw * ROBOT.castor_pivot_mm / TRAIL,
        v_x=yaw * ROBOT.com_offset_mm,
        omega_l=(forward - yaw * HALF) / R,
        omega_r=(forward + yaw * HALF) / R,
    )

    def gain(difference: float) -> float:
        torques = (DRAG_Nmm - difference / 2, DRAG_Nmm + difference / 2)
        made = run(start=swing, seconds=1e-4, torques_Nmm=torques, dt_s=1e-5).motion
        return float(made.w[-1] - made.w[5])

    low, high = gain(0.0), gain(10.0)
    return -10.0 * low / (high - low)


def test_castor_keeps_swinging_at_a_torque_difference_of_5_2_nmm():
    """In the limit of a slow robot: at speed, the castor swings on by itself."""
    yaw = 0.1  # the fork's pin turns at 1.7 mm/s, beyond its stiction
    slow, fast = balancing_difference(25.0, yaw), balancing_difference(50.0, yaw)
    difference = 2 * slow - fast
    assert difference == pytest.approx(5.2, abs=0.05)
    assert difference == pytest.approx(swinging_difference(DYNAMIC), abs=0.01)


# rest: residual speed < 2e-17 mm/s; drift over 100 s under 5/3 N·mm or a 500 mN push < 5e-14 mm;
# 950 mN slides

LOADS_AT_REST = [
    {"torques_Nmm": (5, 3)},
    {"torques_Nmm": (-5, 3)},
    {"push": (500, 0, 0)},
    {"push": (-500, 0, 0)},
]


@pytest.mark.parametrize("load", LOADS_AT_REST, ids=str)
def test_a_robot_at_rest_neither_creeps_nor_drifts(load):
    made = run(seconds=100, **load).motion
    assert np.hypot(made.v_x, made.v_y)[100:].max() < 2e-17
    assert np.hypot(made.x[-1], made.y[-1]) < 5e-14
    assert abs(made.theta[-1]) < 1e-15


@pytest.mark.parametrize("seed", range(10))
def test_a_robot_at_rest_with_any_heading_and_castor_neither_creeps_nor_drifts(seed):
    theta, psi = np.random.default_rng(seed).uniform(-3, 3, 2)
    push = (200 * math.cos(theta), 200 * math.sin(theta), 0)
    start = STILL._replace(theta=theta, psi=psi)
    made = run(start=start, seconds=100, torques_Nmm=(3, 2), push=push).motion
    assert np.hypot(made.v_x, made.v_y)[100:].max() < 2e-17
    assert np.hypot(made.x[-1] - made.x[100], made.y[-1] - made.y[100]) < 5e-14


def test_a_push_of_950_mn_slides_the_robot():
    assert ROBOT.tyre.mu_static * M * G < 950
    made = run(seconds=10, push=(950, 0, 0)).motion
    assert made.v_x[-1] > 1000


@pytest.mark.parametrize("speed", [30.0, 300.0])
def test_a_robot_comes_to_rest_and_stays(speed):
    made = run(start=rolling(forward=speed, yaw=0.3), seconds=30).motion
    assert np.hypot(made.v_x, made.v_y)[10_000:].max() < 2e-17
    assert np.hypot(made.x[-1] - made.x[10_000], made.y[-1] - made.y[10_000]) < 5e-14


def test_constants_of_the_body_fit_the_table():
    constants = body(ROBOT)
    assert constants.load_drive / 1000 == pytest.approx(4.884, abs=0.0005)
    assert constants.load_castor / 1000 == pytest.approx(2.442, abs=0.0005)
    base = ROBOT.castor_pivot_mm + TRAIL
    assert ROBOT.com_offset_mm == pytest.approx(ROBOT.castor_load_share * base)
