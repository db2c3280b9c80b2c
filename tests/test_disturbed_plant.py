"""What slip, friction, payload and the start do to the plant."""

import functools
import math

import numpy as np
import pytest
from disturbance_helpers import FREE, ROBOT, Run, constant, make, run, tree

from tlf_env.physics.parameters import RobotParameters, body, laden
from tlf_env.task.scenario import START_MARGIN_MM
from tlf_env.task.start import Start

# --- slip ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", ["pymunk", "kinematic"])
def test_slip_reproduces_equation_14_while_the_wheels_roll(plant):
    found = run(
        {"slip.delta_1_mm_s": 20.0, "slip.delta_2_rad_s": -0.15},
        seconds=1.5,
        control_period_s=0.001,
        horizon_s=2.0,
        plant=plant,
        actions=constant([0.15, 0.02], [0.1, -0.01], [0.05, 0.0]),
    )
    before, after = found.motion[:-1], found.motion[1:]
    if plant == "pymunk":  # the kernel's frame: the attitude in the middle of the substep
        theta = before[:, :, 2] + 0.0005 * before[:, :, 6]
    else:
        theta = after[:, :, 2]
    v_x, v_y, u_2 = (after[:, :, i] for i in (4, 5, 6))
    u_1 = -v_x * np.sin(theta) + v_y * np.cos(theta)
    omega_l, omega_r = after[:, :, 8], after[:, :, 9]
    radius, width = ROBOT.wheel_radius_mm, ROBOT.axle_width_mm
    rolls = found.of_info("slip_mm_s")[1:] == 0.0
    assert rolls[len(rolls) // 2 :].mean() > 0.9
    assert (u_1 - radius * (omega_l + omega_r) / 2)[rolls] == pytest.approx(20.0, abs=1e-9)
    assert (u_2 - radius * (omega_r - omega_l) / width)[rolls] == pytest.approx(-0.15, abs=1e-9)


def test_slip_that_changes_within_a_control_step_acts_at_every_substep():
    sine = {"type": "sine", "amplitude": 30.0, "frequency_hz": 25.0}  # 40 ms: two control steps
    found = run(
        {"slip.delta_1_mm_s": sine}, seconds=0.2, plant="kinematic", actions=constant([0, 0])
    )
    t = np.arange(200) * 0.001
    way = 0.001 * (30.0 * np.sin(2 * np.pi * 25.0 * t)).reshape(10, 20).sum(axis=1)
    moved = np.linalg.norm(np.diff(found.motion[:, :, :2], axis=0), axis=-1)
    assert moved == pytest.approx(np.abs(way[1:, None]) * np.ones(3), abs=1e-9)


# --- friction --------------------------------------------------------------------------------------

LOAD = ROBOT.drive_load_share * ROBOT.mass_kg * ROBOT.gravity_mm_s2  # mN on each drive wheel
MU_S, MU_D = ROBOT.tyre.mu_static, ROBOT.tyre.mu_dynamic
CASTOR_MASS = ROBOT.castor_inertia_kg_mm2 / ROBOT.castor_radius_mm**2  # of its spin, kg
WHEEL_MASS = ROBOT.wheel_inertia_kg_mm2 / ROBOT.wheel_radius_mm**2


def test_on_ice_spinning_wheels_drive_and_locked_wheels_brake_with_dynamic_friction():
    scale = 0.3

    def spin_then_lock(k):
        return np.full((3, 2), 1.0 if k < 20 else 0.0)

    found = run(
        {"tyre.friction_scale": scale},
        seconds=0.7,
        action="wheel_speed",
        robot=FREE,
        actions=spin_then_lock,
    )
    most = 2 * MU_D * scale * LOAD / (ROBOT.mass_kg + CASTOR_MASS)
    rate = np.diff(found.forward, axis=0) / 0.02
    assert rate[2:18] == pytest.approx(most, rel=2e-3)
    assert found.motion[30:, :, 8] == pytest.approx(0.0, abs=0.3)  # locked
    assert (found.forward[30] > 20).all()
    assert rate[28:33] == pytest.approx(-most, rel=2e-3)


@pytest.mark.parametrize("scale", [0.3, 0.6])
def test_friction_scale_scales_the_torque_at_which_the_wheels_break_loose(scale):
    force = MU_S * scale * LOAD
    acceleration = 2 * force / (ROBOT.mass_kg + CASTOR_MASS)
    most = (force + WHEEL_MASS * acceleration) * ROBOT.wheel_radius_mm / 1000  # N·mm
    if scale == 0.6:
        assert most == pytest.approx(0.6 * 18.43, abs=0.01)
    for factor, slips in ((0.995, False), (1.005, True)):
        torque = factor * most / 15.0
        found = run(
            {"tyre.friction_scale": scale},
            seconds=0.2,
            action="torque",
            robot=FREE,
            actions=constant([torque, torque]),
        )
        assert ((found.of_info("slip_mm_s") > 3.0).any(axis=0) == slips).all()


def test_a_patch_under_one_wheel_turns_the_robot_as_newton_says():
    scale, torque_Nmm = 0.4, 14.0
    pose = np.array([[0.0, 0.0, 0.0]])  # c at the origin, facing +y; the left wheel at x < 0
    half = ROBOT.axle_width_mm / 2
    patch = {"x_mm": -half, "y_mm": 0, "radius_mm": 40, "friction_scale": scale}
    formation = make({"tyre": {"patches": [patch]}}, robots=1, action="torque", robot=FREE)
    formation.reset(0, start=Start(poses=np.reshape(pose, (1, -1, 3)), phases_s=None))
    found = Run(formation, 0.08, constant([torque_Nmm / 15, torque_Nmm / 15]))
    # Left wheel slides: F_l = μ_d s N. Right wheel rolls: τ/R − F_r = (J/R²)(a + h α). Castor rolls.
    # (m + J_c/R_c²) a = F_l + F_r;  (I + m d² + I_s p²/T²) α = h (F_r − F_l), about c
    slide = MU_D * scale * LOAD
    ratio = ROBOT.castor_pivot_mm / ROBOT.castor_trail_mm
    inertia = (
        ROBOT.body_inertia_kg_mm2
        + ROBOT.mass_kg * ROBOT.com_offset_mm**2
        + ROBOT.fork_inertia_kg_mm2 * ratio**2
    )
    drive = 1000 * torque_Nmm / ROBOT.wheel_radius_mm
    matrix = [
        [ROBOT.mass_kg + CASTOR_MASS + WHEEL_MASS, WHEEL_MASS * half],
        [half * WHEEL_MASS, inertia + half**2 * WHEEL_MASS],
    ]
    a, alpha = np.linalg.solve(matrix, [slide + drive, half * (drive - slide)])
    assert alpha > 1.0
    window = slice(0, 3)  # the castor has hardly turned
    assert np.diff(found.motion[window, 0, 6]) / 0.02 == pytest.approx(alpha, rel=0.02)
    assert np.diff(found.forward[window, 0]) / 0.02 == pytest.approx(a, rel=0.02)


# --- payload ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass_kg", "behind_mm", "inertia_kg_mm2"),
    [(0.5, 60.0, 800.0), (0.5, -30.0, 0.0), (3.0, 90.0, 1e4)],
)
def test_a_payload_moves_mass_inertia_and_loads_by_the_parallel_axis_theorem(
    mass_kg, behind_mm, inertia_kg_mm2
):
    robot = laden(body(ROBOT), mass_kg, behind_mm, inertia_kg_mm2)
    both = [(ROBOT.mass_kg, ROBOT.com_offset_mm), (mass_kg, behind_mm)]
    assert robot.m == sum(m for m, _ in both)
    # the same about the axle's midpoint, where it does not matter where the common centre lies
    about_c = ROBOT.body_inertia_kg_mm2 + inertia_kg_mm2 + sum(m * x**2 for m, x in both)
    assert robot.I + robot.m * robot.d**2 == pytest.approx(about_c, rel=1e-12)
    assert robot.m * robot.d == pytest.approx(sum(m * x for m, x in both))
    # forces and moments about the axle
    base = ROBOT.castor_pivot_mm + ROBOT.castor_trail_mm
    castor = sum(m * x for m, x in both) * ROBOT.gravity_mm_s2 / base
    assert robot.load_castor == pytest.approx(castor)
    weight = robot.m * ROBOT.gravity_mm_s2
    assert 2 * robot.load_drive + robot.load_castor == pytest.approx(weight)


@pytest.mark.parametrize(("mass_kg", "behind_mm"), [(0.5, 60.0), (1.7, 33.3)])
def test_a_payload_leaves_the_constants_of_a_robot_of_that_weight(mass_kg, behind_mm):
    found = laden(body(ROBOT), mass_kg, behind_mm, 800.0)
    share = found.d / (ROBOT.castor_pivot_mm + ROBOT.castor_trail_mm)
    changed = {
        "mass_kg": found.m,
        "com_offset_mm": found.d,
        "body_inertia_kg_mm2": found.I,
        "castor_load_share": share,
        "drive_load_share": (1 - share) / 2,
    }
    same = body(RobotParameters(**(ROBOT.model_dump() | changed)))
    assert same == body(ROBOT)._replace(**found._asdict())


def test_a_payload_slows_the_robot_as_newton_says():
    payload = {"payload.mass_kg": 0.5, "payload.behind_mm": 20.0}
    found = run(payload, seconds=0.5, action="torque", robot=FREE, actions=constant([0.5, 0.5]))
    mass = ROBOT.mass_kg + 0.5 + CASTOR_MASS + 2 * WHEEL_MASS
    rate = 2 * 7500 / ROBOT.wheel_radius_mm / mass
    assert np.diff(found.forward, axis=0) / 0.02 == pytest.approx(rate, rel=1e-6)


@pytest.mark.parametrize("behind_mm", [-200.0, 200.0])
def test_a_payload_off_the_wheels_base_is_refused(behind_mm):
    with pytest.raises(
        ValueError, match=r"payload of 2 kg at -?200 mm.*from 0 to 100 mm"
    ) as caught:
        make(tree({"payload.mass_kg": 2.0, "payload.behind_mm": behind_mm}))
    assert "\n" not in str(caught.value)


# --- start -----------------------------------------------------------------------------------------


def outline_gaps(poses):
    """Room between the outlines of neighbours, mm."""
    behind = ROBOT.outline_offset_mm
    x = poses[..., 0] + behind * np.sin(poses[..., 2])
    y = poses[..., 1] - behind * np.cos(poses[..., 2])
    n = poses.shape[-2]
    pairs = [(i, j) for i in range(n) for j in range(i)]
    apart = [np.hypot(x[..., i] - x[..., j], y[..., i] - y[..., j]) for i, j in pairs]
    return np.array(apart) - 2 * ROBOT.outline_radius_mm


@functools.cache
def scattered_starts(name):
    formation = make(name)
    out = []
    for seed in range(1500):
        formation.reset(seed)
        out.append(formation.arrays.rows("start")[:, :, 0].T.copy())
    return np.array(out)


def test_start_poses_scatter_as_asked():
    straight = make().arrays.rows("start")[:, :, 0].T
    off = scattered_starts("start") - straight
    count = len(off)
    for axis, std in ((0, 80.0), (1, 80.0), (2, 0.3)):
        leader = off[:, 0, axis] / std  # placed first, so never redrawn
        assert leader.mean() == pytest.approx(0, abs=4 / math.sqrt(count))
        assert leader.std() == pytest.approx(1, rel=4 / math.sqrt(2 * count))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(off[:, 0, a], off[:, 0, b])[0, 1]) < 4 / math.sqrt(count)
    assert abs(np.corrcoef(off[:, 0, 2], off[:, 1, 2])[0, 1]) < 4 / math.sqrt(count)


def test_start_outlines_never_overlap_though_unchecked_draws_would():
    poses = scattered_starts("start")
    assert outline_gaps(poses).min() > START_MARGIN_MM
    straight = make().arrays.rows("start")[:, :, 0].T
    free = straight + np.random.default_rng(0).normal(size=poses.shape) * [80, 80, 0.3]
    assert (outline_gaps(free).min(axis=0) < 0).mean() > 0.05


def test_a_scatter_without_room_is_refused_and_given_poses_are_taken_as_they_are():
    formation = make()
    with pytest.raises(ValueError, match=r"robot_1: no start pose without overlap"):
        make({"start": {"heading_std_rad": 1e-15}}, start_spacing_mm=221.0)
    poses = formation.arrays.rows("start")[:, :, 0].T + np.array([10.0, 20.0, 0.1])
    formation = make("start")
    formation.reset(0, start=Start(poses=poses[None], phases_s=None))
    found = formation.arrays.rows("start")[:, :, 0].T
    assert found == pytest.approx(poses)
