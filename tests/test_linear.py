"""The linearised plant against long simulations, and against what can be derived by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from physics_helpers import forward_speed, rolling, run
from scipy.linalg import expm

from tlf_env.physics.linear import ENDLESS_GRIP, INPUTS, OUTPUTS, STATES, LinearPlant, linearise
from tlf_env.physics.parameters import RobotParameters

ROBOT = RobotParameters()
LIGHT_FORK = RobotParameters(fork_inertia_kg_mm2=1e-6)  # a castor that only rolls along
N_PER_MN = 1000.0
ALL_ROBOTS = pytest.mark.parametrize("robot", [ROBOT, LIGHT_FORK], ids=["robot", "light_fork"])
OPERATING_POINTS = pytest.mark.parametrize(
    ("u_1_mm_s", "u_2_rad_s"), [(300.0, 0.0), (400.0, 0.0), (300.0, 0.5), (100.0, -0.3)]
)


def simulate(
    robot: RobotParameters, state: np.ndarray, torques_Nmm: np.ndarray, seconds: float
) -> np.ndarray:
    """The same state after a run on the plant, without dry friction, at a fine step."""
    ideal = robot.model_copy(update={"joint_friction": False, "tyre": ENDLESS_GRIP})
    forward, yaw, castor = state.tolist()
    pivot, trail = robot.castor_pivot_mm, robot.castor_trail_mm
    start = rolling(robot, forward, yaw)._replace(
        psi=castor,
        s=-(pivot * yaw * np.cos(castor) + forward * np.sin(castor)) / trail,
        omega_c=(forward * np.cos(castor) - pivot * yaw * np.sin(castor)) / robot.castor_radius_mm,
    )
    end, _ = run(ideal, start, seconds=seconds, torques_Nmm=torques_Nmm, dt_s=1e-5).last()
    return np.array([forward_speed(end), end.w, end.psi - end.theta])


@ALL_ROBOTS
@OPERATING_POINTS
def test_the_operating_point_holds_itself(
    robot: RobotParameters, u_1_mm_s: float, u_2_rad_s: float
) -> None:
    plant = linearise(robot, u_1_mm_s, u_2_rad_s)
    end = simulate(robot, plant.state, plant.torques_Nmm, seconds=0.05)
    np.testing.assert_allclose(end, plant.state, atol=2e-5)


@ALL_ROBOTS
@OPERATING_POINTS
def test_a_long_simulation_moves_as_the_linear_plant_says(
    robot: RobotParameters, u_1_mm_s: float, u_2_rad_s: float
) -> None:
    plant, seconds = linearise(robot, u_1_mm_s, u_2_rad_s), 0.05
    whole = np.block([[plant.A, plant.B], [np.zeros((2, 5))]])
    linear = expm(seconds * whole)[:3]
    simulated = np.empty((3, 5))
    for i, size in enumerate((0.1, 1e-3, 1e-3, 0.1, 0.1)):
        d = size * np.eye(5)[i]
        ends = [
            simulate(robot, plant.state + sign * d[:3], plant.torques_Nmm + sign * d[3:], seconds)
            for sign in (1.0, -1.0)
        ]
        simulated[:, i] = (ends[0] - ends[1]) / (2 * size)
    np.testing.assert_allclose(linear, simulated, rtol=2e-3, atol=2e-4)


def acceleration(plant: LinearPlant, left: float, right: float) -> np.ndarray:
    """Wheels' accelerations (rad/s²) for torques of 1 N·mm with these signs."""
    return plant.C @ plant.B @ np.array([left, right])


def test_the_paper_designs_on_a_wheel_that_is_too_light() -> None:
    carried = 0.4 * ROBOT.mass_kg * ROBOT.wheel_radius_mm**2 + ROBOT.wheel_inertia_kg_mm2
    assert N_PER_MN / carried == pytest.approx(0.7705, abs=5e-5)  # eq. (6)
    common = acceleration(linearise(), 1.0, 1.0)
    # Half the robot on each wheel, and what spins with it: 2τ/R = (m + 2J/R² + J_c/R_c²)·R·ω̇.
    p = ROBOT
    moved = (
        0.5 * p.mass_kg * p.wheel_radius_mm**2
        + p.wheel_inertia_kg_mm2
        + 0.5 * p.castor_inertia_kg_mm2 * (p.wheel_radius_mm / p.castor_radius_mm) ** 2
    )
    assert N_PER_MN / moved == pytest.approx(0.6166, abs=1e-4)
    np.testing.assert_allclose(common, N_PER_MN / moved, rtol=1e-4)
    assert common[0] * carried / N_PER_MN == pytest.approx(0.800, abs=5e-4)


def test_the_castors_wheel_costs_a_little() -> None:
    light = linearise(RobotParameters(castor_inertia_kg_mm2=1e-6))
    carried = 0.4 * ROBOT.mass_kg * ROBOT.wheel_radius_mm**2 + ROBOT.wheel_inertia_kg_mm2
    ratio = acceleration(light, 1.0, 1.0)[0] * carried / N_PER_MN
    assert ratio == pytest.approx(0.807, abs=1e-3)


@pytest.mark.parametrize("fork", [20.0, 1e-6])
def test_against_each_other_the_wheels_turn_the_robot_and_the_fork(fork: float) -> None:
    p = RobotParameters(fork_inertia_kg_mm2=fork)
    half, radius = p.axle_width_mm / 2, p.wheel_radius_mm
    about_c = (
        p.body_inertia_kg_mm2
        + p.mass_kg * p.com_offset_mm**2
        + 2 * p.wheel_inertia_kg_mm2 * (half / radius) ** 2
    )
    # Rolling straight, the fork swings a/T times as fast as the robot turns.
    about_c += fork * (p.castor_pivot_mm / p.castor_trail_mm) ** 2
    # (τ_r − τ_l)·h/R = I·ẇ and ω̇_r = −ω̇_l = ẇ·h/R
    expected = 2 * (half / radius) ** 2 / about_c * N_PER_MN
    left, right = acceleration(linearise(p), -1.0, 1.0)
    assert right == pytest.approx(expected, rel=1e-3)
    assert left == pytest.approx(-expected, rel=1e-3)
    assert expected == pytest.approx(0.641 if fork > 1.0 else 0.700, abs=5e-4)


def test_a_mass_behind_the_axle_makes_straight_driving_unstable() -> None:
    # About c: I·ẇ = m·d·u₁·w, what the mass's inertia pulls outward in a turn.
    p = LIGHT_FORK
    about_c = (
        p.body_inertia_kg_mm2
        + p.mass_kg * p.com_offset_mm**2
        + 2 * p.wheel_inertia_kg_mm2 * (p.axle_width_mm / 2 / p.wheel_radius_mm) ** 2
    )
    rate = p.mass_kg * p.com_offset_mm * 400.0 / about_c
    assert rate == pytest.approx(1.43, abs=5e-3)
    A = linearise(p, 400.0).A
    assert A[1, 1] == pytest.approx(rate, rel=1e-3)
    assert A[1, 2] == pytest.approx(0.0, abs=1e-3)
    assert max(np.linalg.eigvals(A).real) == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize("u_1_mm_s", [100.0, 400.0])
def test_the_castor_falls_into_its_trail_and_its_fork_pulls_on_the_yaw(u_1_mm_s: float) -> None:
    p, u = ROBOT, u_1_mm_s
    pivot, trail, fork = p.castor_pivot_mm, p.castor_trail_mm, p.fork_inertia_kg_mm2
    A = linearise(p, u).A
    # The castor's contact does not slide sideways: φ̇ = −(a/T + 1)·w − (u/T)·φ.
    assert A[2, 1] == pytest.approx(-(pivot / trail + 1), rel=1e-3)
    assert A[2, 2] == pytest.approx(-u / trail, rel=1e-3)
    # With the fork's rate s = −(a·w + u·φ)/T, Lagrange: (I + I_s a²/T²)·ẇ = m·d·u·w − I_s·(a·u/T²)·φ̇.
    about_c = (
        p.body_inertia_kg_mm2
        + p.mass_kg * p.com_offset_mm**2
        + 2 * p.wheel_inertia_kg_mm2 * (p.axle_width_mm / 2 / p.wheel_radius_mm) ** 2
        + fork * (pivot / trail) ** 2
    )
    pull = fork * pivot * u / trail**2
    assert A[1, 1] == pytest.approx(
        (p.mass_kg * p.com_offset_mm * u + pull * (pivot / trail + 1)) / about_c, rel=1e-3
    )
    assert A[1, 2] == pytest.approx(pull * u / trail / about_c, rel=1e-3)
    # Nothing couples into the forward speed.
    np.testing.assert_allclose(A[0], 0.0, atol=1e-3)
    np.testing.assert_allclose(A[1:, 0], 0.0, atol=1e-3)


def test_left_and_right_curves_mirror_each_other() -> None:
    left, right = linearise(u_2_rad_s=0.4), linearise(u_2_rad_s=-0.4)
    flip = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(left.A, flip @ right.A @ flip, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(left.B, flip @ right.B[:, ::-1], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(left.torques_Nmm, right.torques_Nmm[::-1], rtol=1e-3)


def test_the_outputs_are_the_wheels_speeds() -> None:
    plant = linearise(u_1_mm_s=250.0, u_2_rad_s=0.5)
    left, right = plant.C @ plant.state
    assert left == pytest.approx((250.0 - 0.5 * 78.0) / 50.0)
    assert right == pytest.approx((250.0 + 0.5 * 78.0) / 50.0)


def test_python_control_gets_named_signals() -> None:
    control = pytest.importorskip("control")
    plant = linearise()
    system = plant.to_control()
    assert isinstance(system, control.StateSpace)
    assert tuple(system.state_labels) == STATES
    assert tuple(system.input_labels) == INPUTS
    assert tuple(system.output_labels) == OUTPUTS
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(system, name), getattr(plant, name))
    one = system["omega_l_rad_s", "torque_l_Nmm"]
    assert (one.ninputs, one.noutputs) == (1, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"u_1_mm_s": 0.0}, r"u_1_mm_s 0.0 must be above 0"),
        ({"u_1_mm_s": -300.0}, r"u_1_mm_s -300.0 must be above 0"),
        ({"u_1_mm_s": np.nan}, r"u_1_mm_s nan must be above 0"),
        ({"u_1_mm_s": np.inf}, r"u_1_mm_s inf must be above 0"),
        ({"u_2_rad_s": np.nan}, r"u_2_rad_s nan at 300.0 mm/s is too tight"),
        ({"u_2_rad_s": np.inf}, r"u_2_rad_s inf at 300.0 mm/s is too tight"),
        (
            {
                "robot": RobotParameters(castor_pivot_mm=10.0, castor_trail_mm=90.0),
                "u_2_rad_s": 4.0,
            },
            r"u_2_rad_s 4.0 at 300.0 mm/s is too tight",
        ),
    ],
)
def test_impossible_operating_points_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        linearise(**options)
