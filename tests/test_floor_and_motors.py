"""Slopes, pushes, rolling resistance, creep, split friction and motors against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

import tlf_env
from tlf_env.disturbances.channels import nominal_effects
from tlf_env.engine.formation import Formation
from tlf_env.engine.substeps import motor_torque
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.scenario import load_scenario

ROBOT = RobotParameters()
G, M, R, H = ROBOT.gravity_mm_s2, ROBOT.mass_kg, ROBOT.wheel_radius_mm, ROBOT.axle_width_mm / 2
# Mass that a rolling robot moves: with the spins of its three wheels.
M_ROLLING = (
    M
    + 2 * ROBOT.wheel_inertia_kg_mm2 / R**2
    + ROBOT.castor_inertia_kg_mm2 / ROBOT.castor_radius_mm**2
)
PERIOD_S = 0.02
FREE = {"joint_friction": False}


def driven(steps, action=(0.0, 0.0), *, plant="pymunk", robot=None, kind="torque", **disturbance):
    """Rows of x, y, heading, slip and wheel speeds of one robot that starts at rest, heading +y."""
    env = tlf_env.parallel_env(
        "infinity",
        robots=1,
        action=kind,
        disturbance=disturbance or "none",
        robot=robot or {},
        plant=plant,
        end_on=(),
        preview_s=(),
    )
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    rows = []
    for k in range(steps):
        now = action(k) if callable(action) else action
        *_, infos = env.step({"robot_0": np.array(now)})
        info, wheels = infos["robot_0"], env.formation.named("motion")
        rows.append(
            [
                *(info[key] for key in ("x_mm", "y_mm", "theta_rad", "slip_mm_s")),
                float(wheels.omega_l[0]),
                float(wheels.omega_r[0]),
            ]
        )
    return np.array(rows)


def acceleration(places):
    """Least-squares acceleration of places at the control steps, mm/s²."""
    t_s = np.arange(1, len(places) + 1) * PERIOD_S
    return 2 * np.polyfit(t_s, places, 2)[0]


@pytest.mark.parametrize("plant", ["pymunk", "chipmunk"])
def test_a_robot_rolls_down_a_slope_by_g_sin(plant):
    slope = 0.05
    rows = driven(50, robot=FREE, floor={"slope_rad": slope, "uphill_rad": math.pi}, plant=plant)
    expected = G * math.sin(slope) * M / M_ROLLING
    assert acceleration(rows[:, 1]) == pytest.approx(expected, rel=2e-3)


def test_a_robot_across_a_slope_holds_up_to_static_friction_and_slides_beyond():
    across = math.pi / 2  # the floor rises towards −x
    # The drive wheels hold: they carry 0.8 of the weight, and the castor swings.
    held = driven(100, floor={"slope_rad": 0.05, "uphill_rad": across})
    assert np.abs(held[-1, :3]).max() < 1e-3
    slope = 0.12
    rows = driven(25, floor={"slope_rad": slope, "uphill_rad": across})
    speed = (rows[-1, 0] - rows[-2, 0]) / PERIOD_S
    # Between all three tyres and the drive wheels' alone: the castor swings and rubs less than it could.
    least, most = (
        G * (math.sin(slope) - share * ROBOT.tyre.mu_dynamic * math.cos(slope))
        for share in (1, 0.8)
    )
    assert 0.97 * least < speed / 0.49 < most


@pytest.mark.parametrize("plant", ["pymunk", "batch", "chipmunk"])
def test_a_push_accelerates_by_force_over_mass(plant):
    along = driven(50, robot=FREE, push={"y_N": 0.2}, plant=plant)
    assert acceleration(along[:, 1]) == pytest.approx(200.0 / M_ROLLING, rel=2e-3)
    sideways = driven(25, push={"x_N": 3.0}, plant=plant)
    expected = (3000.0 - ROBOT.tyre.mu_dynamic * M * G) / M
    speed = (sideways[-1, 0] - sideways[-2, 0]) / PERIOD_S
    assert speed == pytest.approx(expected * 0.49, rel=0.03)


def test_resistance_to_rolling_slows_by_its_coefficient_times_g():
    def full_then_none(k):
        return (0.5, 0.5) if k < 50 else (0.0, 0.0)

    free = driven(100, full_then_none, robot=FREE)
    rows = driven(100, full_then_none, robot=FREE, floor={"rolling_resistance": 0.005})
    assert acceleration(free[60:, 1]) == pytest.approx(0.0, abs=1.0)
    assert acceleration(rows[60:, 1]) == pytest.approx(-0.005 * G * M / M_ROLLING, rel=0.01)


def test_a_motor_follows_its_torque_speed_curve():
    """v = v₀ (1 − exp(−t/T)) with v₀ = R/k and T = m R²/(2 k τ)."""
    k, limit = 0.1, ROBOT.torque_limit_Nmm * 1000
    rows = driven(200, (1.0, 1.0), robot=FREE, actuator={"back_emf_s_rad": k})
    t_s = np.arange(1, 201) * PERIOD_S
    time_s = M_ROLLING * R**2 / (2 * k * limit)
    expected = R / k * (t_s - time_s * (1 - np.exp(-t_s / time_s)))
    assert rows[:, 1] == pytest.approx(expected, rel=0.01, abs=1.0)
    assert rows[-1, 4] < 1 / k


@pytest.mark.parametrize("stall", [0.5, 1.0, 2.5])
def test_a_motor_keeps_its_current_limit_until_the_line_from_its_stall_torque(stall):
    limit, k, current = 15.0, 0.02, 0.9
    effects = nominal_effects()._replace(
        actuator_back_emf_s_rad=k, actuator_current_limit=current, actuator_stall_torque=stall
    )
    for omega in np.linspace(-60.0, 60.0, 49):
        line = stall * (1 - k * omega)
        most = limit * min(max(line, 0.0), current)
        assert motor_torque(limit, omega, limit, effects) == pytest.approx(most)
        assert motor_torque(-limit, -omega, limit, effects) == pytest.approx(-most)


def test_braking_torque_is_not_limited_by_the_back_emf():
    def forward_then_back(k):
        return (1.0, 1.0) if k < 50 else (-1.0, -1.0)

    plain = driven(70, forward_then_back, robot=FREE)
    curve = driven(70, forward_then_back, robot=FREE, actuator={"back_emf_s_rad": 0.02})
    assert acceleration(curve[55:, 1]) == pytest.approx(acceleration(plain[55:, 1]), rel=1e-2)


def test_a_current_limit_and_a_dead_band_take_what_they_say():
    half = driven(30, (1.0, 1.0), robot=FREE, actuator={"current_limit": 0.5})
    full = driven(30, (1.0, 1.0), robot=FREE)
    assert acceleration(half[:, 1]) == pytest.approx(acceleration(full[:, 1]) / 2, rel=1e-3)
    band = ROBOT.torque_limit_Nmm / 2
    below = driven(30, (0.49, 0.49), robot=FREE, actuator={"dead_band_Nmm": band})
    above = driven(30, (0.51, 0.51), robot=FREE, actuator={"dead_band_Nmm": band})
    assert np.abs(below[:, 1]).max() == 0.0
    assert above[-1, 1] == driven(30, (0.51, 0.51), robot=FREE)[-1, 1]


def test_a_tyre_creeps_by_its_share_of_load():
    """Slip over rolling speed = creep · force/load, at a constant torque below the friction limit."""
    creep = 0.3
    rows = driven(100, (0.5, 0.5), robot=FREE, tyre={"creep": creep})
    speed = np.gradient(rows[:, 1], PERIOD_S)
    rolling = R * rows[:, 4]
    castor = ROBOT.castor_inertia_kg_mm2 / ROBOT.castor_radius_mm**2
    force = (M + castor) * acceleration(rows[40:, 1]) / 2  # of each drive wheel, mN
    load = ROBOT.drive_load_share * M * G
    middle = slice(60, 95)
    slip = rolling[middle] - speed[middle]
    # Wheel speeds are those at the end of a step, and places give those at its middle: a step's change.
    assert slip / rolling[middle] == pytest.approx(creep * force / load, rel=0.05)
    assert rows[middle, 3] == pytest.approx(creep * force / load * rolling[middle], rel=0.02)


def test_a_plant_without_creep_says_so():
    with pytest.raises(ValueError, match=r"tyre\.creep needs 'pymunk' or 'batch'"):
        driven(1, tyre={"creep": 0.1}, plant="chipmunk")


@pytest.mark.parametrize(("plant", "creeps"), [("pymunk", True), ("chipmunk", False)])
def test_creep_of_an_adversary_acts_or_is_refused(plant, creeps):
    """Creep of 0 is no creep, so that ``chipmunk`` takes it."""
    formation = Formation(load_scenario("infinity", robots=2, plant=plant, adversary=True))
    formation.reset(0)
    formation.impose({"tyre.creep": 0.0})
    for value in (0.1, np.array([0.0, 0.1])):
        if creeps:
            formation.impose({"tyre.creep": value})
        else:
            with pytest.raises(
                ValueError, match=r"tyre\.creep .* needs plant 'pymunk'; the tyres of"
            ):
                formation.impose({"tyre.creep": value})


def test_creep_vanishes_at_rest_and_at_zero():
    held = driven(100, floor={"slope_rad": 0.05, "uphill_rad": math.pi / 2}, tyre={"creep": 0.5})
    assert np.abs(held[-1, :3]).max() < 1e-3
    plain = driven(100, (0.6, 0.2))
    assert (driven(100, (0.6, 0.2), tyre={"creep": 0.0}) == plain).all()


def test_without_friction_on_the_left_its_wheel_spins_freely():
    rows = driven(20, (0.2, 0.2), robot=FREE, tyre={"friction_left": 0.0})
    torque = 0.2 * ROBOT.torque_limit_Nmm * 1000
    assert rows[-1, 4] == pytest.approx(
        torque * 20 * PERIOD_S / ROBOT.wheel_inertia_kg_mm2, rel=1e-9
    )
    assert rows[-1, 5] < 0.2 * rows[-1, 4]
    assert rows[-1, 2] > 0.01  # the right wheel alone turns it to the left


@pytest.mark.parametrize("plant", ["pymunk", "kinematic"])
def test_slip_of_each_wheel_is_that_of_eq_14(plant):
    delta_1, delta_2 = 20.0, 0.1
    fields = {"kind": "wheel_speed", "plant": plant}
    both = driven(
        50, (0.2, 0.2), slip={"delta_1_mm_s": delta_1, "delta_2_rad_s": delta_2}, **fields
    )
    each = driven(
        50,
        (0.2, 0.2),
        slip={"left_mm_s": delta_1 - delta_2 * H, "right_mm_s": delta_1 + delta_2 * H},
        **fields,
    )
    assert each == pytest.approx(both, abs=1e-6)
    assert np.abs(both - driven(50, (0.2, 0.2), **fields)).max() > 5.0
