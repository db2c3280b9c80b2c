"""What each channel of a disturbance does to the robots, what it leaves alone, and what is refused."""

import functools
import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from baselines import ReferencePolicy
from tlf_env.common.presets import preset_names, presets_folder
from tlf_env.disturbances.channels import (
    CHANNELS,
    CONTROL_STEP,
    EPISODE,
    NOMINAL_NOISE_MM,
    PATHS,
    SET_WITHIN_EPISODE,
    SUBSTEP,
    number,
    numbers,
)
from tlf_env.disturbances.model import Disturbance
from tlf_env.disturbances.table import renewed, row, unit
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.formation import Formation
from tlf_env.engine.layout import Sample
from tlf_env.engine.radio import delayed_message
from tlf_env.engine.settings import make_settings
from tlf_env.envs.parallel import parallel_env
from tlf_env.onboard.parts import part_name
from tlf_env.physics.parameters import RobotParameters, body, laden
from tlf_env.physics.state import Motion
from tlf_env.task.info import Info
from tlf_env.task.observation import SENSOR_TAIL_ENTRIES
from tlf_env.task.scenario import START_MARGIN_MM, load_scenario

ROBOT = RobotParameters()
FREE = {"joint_friction": False}  # wheels that turn without friction: the physics is closed form
DOCS = Path(__file__).parent.parent / "docs" / "disturbances.md"
GAP_S = 1.0  # short, so that followers hear something new within the first seconds
FIX = [Sample._fields.index("fix_x"), Sample._fields.index("fix_y")]
STEPS = [Sample._fields.index("step_l"), Sample._fields.index("step_r")]
ANGLES = [11, 12]  # of Motion

# One value for every channel that shows, and a random signal that stays within the range.
SHOWS = {
    "slip.delta_1_mm_s": 20.0,
    "slip.delta_2_rad_s": 0.1,
    "tyre.friction_scale": 0.5,
    "position.bias_x_mm": 5.0,
    "position.bias_y_mm": 5.0,
    "position.noise_std_mm": 2.0,
    "encoder.noise_std_rad": 1e-4,
    "encoder.quantum_rad": 1e-3,
    "actuator.torque_gain_l": 0.9,
    "actuator.torque_gain_r": 0.9,
    "actuator.dead_time_s": 0.003,
    "actuator.computing_delay_s": 0.01,
    "radio.jitter_s": 0.2,
    "radio.dropout": 0.3,
    "payload.mass_kg": 0.5,
    "payload.behind_mm": 50.0,
    "payload.inertia_kg_mm2": 2000.0,
    "start.position_std_mm": 30.0,
    "start.heading_std_rad": 0.1,
}
NEEDS_MASS = ("payload.behind_mm", "payload.inertia_kg_mm2")


def random_signal(path):
    low, high = sorted((CHANNELS[number(path)].nominal, SHOWS[path]))
    signal = {"type": "uniform", "low": low, "high": high}
    return signal if CHANNELS[number(path)].rate == EPISODE else {**signal, "every_s": 0.1}


def tree(channels):
    """``{"slip.delta_1_mm_s": 1}`` as the nested mapping of YAML."""
    out = {}
    for path, value in channels.items():
        group, name = path.split(".")
        out.setdefault(group, {})[name] = value
    return out


def make(disturbance=None, *, seed=0, parts=None, **overrides):
    overrides = {"time_gap_s": GAP_S, "horizon_s": 20.0, "end_on": ()} | overrides
    scenario = load_scenario("infinity", disturbance=disturbance or {}, **overrides)
    formation = Formation(scenario, parts)
    formation.reset(seed)
    return formation


class Run:
    """A closed loop under the reference policy, or ``actions`` for all robots, with all that it said."""

    def __init__(self, formation, seconds=3.0, actions=None):
        a, scenario = formation.arrays, formation.scenario
        policy, rows = ReferencePolicy(), []
        self.starts = a.rows("start")[:, :, 0].T.copy()
        for k in range(round(seconds / scenario.control_period_s)):
            seen = a.observations[0].copy()
            a.actions[0] = policy.predict(seen)[0] if actions is None else actions(k)
            formation.step()
            c = formation.state()[:, :2]
            rows.append(
                {
                    "motion": a.rows("motion")[:, :, 0].T.copy(),
                    "applied": formation.applied().copy(),
                    "fix": a.samples[-1, FIX, :, 0].T - c,
                    "turned": a.samples[..., 0].sum(axis=0)[STEPS].T,
                    "dropped": a.dropped[formation.step_count % len(a.dropped), :, 0].copy(),
                    "message": a.messages[:, formation.step_count % len(a.dropped), :, 0].T.copy(),
                    "info": a.infos[0].copy(),
                    "seen": a.sensor_observations[0].copy(),
                    "forward": formation.state()[:, 5],
                }
            )
        self.formation = formation
        for name in rows[0]:
            setattr(self, name, np.array([row[name] for row in rows]))

    def of_info(self, name):
        return self.info[:, :, Info._fields.index(name)]


def run(channels=None, seconds=3.0, level=1.0, actions=None, **overrides):
    disturbance = {"level": level, **tree(channels or {})}
    return Run(make(disturbance, **overrides), seconds, actions)


@functools.cache
def nominal(seconds=3.0):
    return run(seconds=seconds)


SLIPPING = {"slip.delta_1_mm_s": 12.0, "slip.delta_2_rad_s": 0.1}


def constant(*action):
    return lambda k: np.array(action)


# --- level -----------------------------------------------------------------------------------------


def test_every_channel_has_an_example():
    assert tuple(SHOWS) == PATHS


@pytest.mark.parametrize("path", PATHS)
def test_at_level_0_the_run_is_bitwise_nominal(path):
    for value in (SHOWS[path], random_signal(path)):
        found = run({path: value}, level=0.0)
        assert (found.motion == nominal().motion).all()
        assert (found.info == nominal().info).all()
        assert (found.applied == [channel.nominal for channel in CHANNELS]).all()


@pytest.mark.parametrize("path", PATHS)
def test_away_from_nominal_the_run_changes(path):
    with_mass = {"payload.mass_kg": 0.5} if path in NEEDS_MASS else {}
    before = run(with_mass) if with_mass else nominal()
    after = run({**with_mass, path: SHOWS[path]})
    assert (after.motion[-1] != before.motion[-1]).any()
    assert (after.applied[:, :, number(path)] == SHOWS[path]).all()


def test_a_payload_without_mass_changes_nothing():
    found = run({"payload.behind_mm": 50.0, "payload.inertia_kg_mm2": 2000.0})
    assert (found.motion == nominal().motion).all()


@pytest.mark.parametrize("name", preset_names("disturbance"))
def test_every_preset_at_level_0_is_bitwise_nominal(name):
    found = Run(make(name, disturbance_level=0.0))
    assert (found.motion == nominal().motion).all()


def test_level_multiplies_the_deviation_from_nominal():
    for level in (0.25, 0.5, 1.0, 1.5):
        found = run(SHOWS, seconds=0.02, level=level)
        for i, channel in enumerate(CHANNELS):
            expected = channel.nominal + level * (SHOWS[channel.path] - channel.nominal)
            assert found.applied[0, :, i] == pytest.approx(expected)


def test_level_acts_on_patches_too():
    patch = {"x_mm": 0, "y_mm": 0, "radius_mm": 1e6, "friction_scale": 0.5}
    everywhere = Run(make({"tyre": {"patches": [patch]}}))
    half = Run(make({"level": 0.5, "tyre": {"patches": [patch]}}))
    assert (everywhere.motion == run({"tyre.friction_scale": 0.5}).motion).all()
    assert (half.motion == run({"tyre.friction_scale": 0.75}).motion).all()
    none = Run(make({"level": 0.0, "tyre": {"patches": [patch]}}))
    assert (none.motion == nominal().motion).all()


def test_patches_that_overlap_multiply_and_patches_elsewhere_do_nothing():
    here = {"x_mm": 0, "y_mm": 0, "radius_mm": 1e6, "friction_scale": 0.5}
    there = {"x_mm": 1e6, "y_mm": 0, "radius_mm": 10, "friction_scale": 0.0}
    twice = Run(make({"tyre": {"patches": [here, here]}}))
    assert (twice.motion == run({"tyre.friction_scale": 0.25}).motion).all()
    assert (Run(make({"tyre": {"patches": [there]}})).motion == nominal().motion).all()


ONE_LINE = r"\A[^\n]+\Z"


# --- what never changes ----------------------------------------------------------------------------

# Path, stream and nominal value of every channel so far. A recorded result depends on each number: add
# lines, never change one.
FIXED = {
    "slip.delta_1_mm_s": (100, 0.0),
    "slip.delta_2_rad_s": (101, 0.0),
    "tyre.friction_scale": (102, 1.0),
    "position.bias_x_mm": (103, 0.0),
    "position.bias_y_mm": (104, 0.0),
    "position.noise_std_mm": (105, math.sqrt(0.2)),
    "encoder.noise_std_rad": (106, 0.0),
    "encoder.quantum_rad": (107, 0.0),
    "actuator.torque_gain_l": (108, 1.0),
    "actuator.torque_gain_r": (109, 1.0),
    "actuator.dead_time_s": (110, 0.0),
    "actuator.computing_delay_s": (111, 0.0),
    "radio.jitter_s": (112, 0.0),
    "radio.dropout": (113, 0.0),
    "payload.mass_kg": (114, 0.0),
    "payload.behind_mm": (115, 0.0),
    "payload.inertia_kg_mm2": (116, 0.0),
    "start.position_std_mm": (117, 0.0),
    "start.heading_std_rad": (118, 0.0),
}


def test_streams_and_nominal_values_never_change():
    now = {channel.path: (channel.stream, channel.nominal) for channel in CHANNELS}
    assert {path: now[path] for path in FIXED} == FIXED


def test_a_recorded_draw_never_changes():
    plant = BatchPlant("infinity", 1, disturbance="payload")
    plant.reset(seed=20000)
    assert round(plant.applied[0, 0, number("payload.mass_kg")], 5) == 0.14184


# --- random streams --------------------------------------------------------------------------------


@functools.cache
def everything():
    return run({path: random_signal(path) for path in PATHS})


@pytest.mark.parametrize("path", PATHS)
def test_a_channels_values_do_not_depend_on_other_channels(path):
    i = number(path)
    alone = run({path: random_signal(path)})
    assert (alone.applied[:, :, i] == everything().applied[:, :, i]).all()
    others = [j for j in range(len(PATHS)) if j != i]
    assert (alone.applied[:, :, others] == nominal().applied[:, :, others]).all()


def test_channels_and_robots_draw_independently():
    random = {path: random_signal(path) for path in SET_WITHIN_EPISODE}
    applied = run(random, seconds=20.0).applied[::5]  # one row per draw
    scale = [SHOWS[path] - CHANNELS[number(path)].nominal for path in SET_WITHIN_EPISODE]
    within = numbers(SUBSTEP, CONTROL_STEP)
    draws = (applied[:, :, within] - applied[:1, :, within].mean()) / scale
    columns = draws.reshape(len(draws), -1).T
    alike = np.corrcoef(columns) - np.eye(len(columns))
    assert np.abs(alike).max() < 5 / math.sqrt(len(draws))


@pytest.mark.parametrize("path", [p for p in PATHS if not p.startswith("position.")])
def test_no_channel_moves_the_noise_of_the_fixes(path):
    assert run({path: SHOWS[path]}).fix == pytest.approx(nominal().fix, abs=1e-8)


@pytest.mark.parametrize("path", [p for p in PATHS if not p.startswith("encoder.")])
def test_no_channel_moves_the_noise_of_the_encoders(path):
    def noise(channels):
        found = run({"encoder.noise_std_rad": 0.01, **channels})
        return found.turned.cumsum(axis=0) - found.motion[:, :, ANGLES]

    assert noise({path: SHOWS[path]}) == pytest.approx(noise({}), abs=1e-9)


@pytest.mark.parametrize("path", [p for p in PATHS if p != "radio.dropout"])
def test_no_channel_moves_the_dropouts(path):
    expected = run({"radio.dropout": 0.3}).dropped
    assert expected.any()
    assert (run({"radio.dropout": 0.3, path: SHOWS[path]}).dropped == expected).all()


def test_the_same_seed_repeats_bitwise_and_another_does_not():
    for name in ("combined-hard", "radio", "payload", "actuator"):
        first, again, other = (Run(make(name, seed=seed)) for seed in (7, 7, 8))
        assert (first.motion == again.motion).all()
        assert (first.info == again.info).all()
        assert (first.motion != other.motion).any()


def test_an_episode_of_a_seed_repeats_whatever_came_before():
    formation = make("combined-hard", seed=3)
    Run(formation, 0.5)
    formation.reset(3, episode=2)
    found = Run(formation, 0.5)
    fresh = make("combined-hard", seed=11)
    fresh.reset(3, episode=2)
    assert (Run(fresh, 0.5).motion == found.motion).all()
    assert (Run(make("combined-hard", seed=3), 0.5).motion != found.motion).any()


def test_a_robots_draws_do_not_depend_on_how_many_robots_there_are():
    random = {path: random_signal(path) for path in PATHS}
    few, many = (run(random, robots=n) for n in (2, 6))
    assert (few.applied == many.applied[:, :2]).all()
    assert (few.starts == many.starts[:2]).all()
    assert (few.motion == many.motion[:, :2]).all()


def test_payloads_are_taken_off_when_an_episode_has_none():
    formation = make({"payload": {"mass_kg": {"type": "step", "value": 1.0, "at_s": 5.0}}})
    assert (formation.applied()[:, number("payload.mass_kg")] == 0).all()  # its value at t = 0
    assert formation.arrays.rows("body")[0, :, 0] == pytest.approx(ROBOT.mass_kg)


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
    formation.reset(0, poses=pose)
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


# --- sensors ---------------------------------------------------------------------------------------


def test_fixes_have_the_noise_and_the_bias_asked_for():
    found = run(
        {
            "position.noise_std_mm": 3.0,
            "position.bias_x_mm": 40.0,
            "position.bias_y_mm": -20.0,
        },
        seconds=10.0,
        plant="kinematic",
        actions=constant([0.1, 0.1]),
    )
    z = found.fix - [40.0, -20.0]
    count = z[..., 0].size
    assert z.mean(axis=(0, 1)) == pytest.approx(0, abs=4 * 3 / math.sqrt(count))
    assert z.std(axis=(0, 1)) == pytest.approx(3, rel=4 / math.sqrt(2 * count))
    assert abs(np.corrcoef(z[..., 0].ravel(), z[..., 1].ravel())[0, 1]) < 4 / math.sqrt(count)
    assert abs((z[1:] * z[:-1]).mean() / 9) < 4 / math.sqrt(2 * count)


def test_nominal_fixes_have_a_variance_of_0_2_mm2():
    found = run(seconds=10.0, plant="kinematic", actions=constant([0.1, 0.1]))
    assert found.fix.var() == pytest.approx(0.2, rel=4 * math.sqrt(2 / found.fix.size))
    assert pytest.approx(math.sqrt(0.2)) == NOMINAL_NOISE_MM


def test_encoders_read_the_angle_rounded_down_to_the_quantum():
    quantum = 2 * math.pi / 512
    found = run({"encoder.quantum_rad": quantum})
    read = found.turned.cumsum(axis=0)
    exact = quantum * np.floor(found.motion[:, :, ANGLES] / quantum)
    assert read == pytest.approx(exact, abs=1e-9)


def test_encoder_noise_is_white_with_its_standard_deviation():
    found = run(
        {"encoder.noise_std_rad": 0.01},
        seconds=10.0,
        plant="kinematic",
        actions=constant([0.1, 0.1]),
    )
    noise = (found.turned.cumsum(axis=0) - found.motion[:, :, ANGLES]) / 0.01
    assert noise.mean() == pytest.approx(0, abs=4 / math.sqrt(noise.size))
    assert noise.std() == pytest.approx(1, rel=4 / math.sqrt(2 * noise.size))
    assert abs((noise[1:] * noise[:-1]).mean()) < 4 / math.sqrt(noise.size)


# --- actuators -------------------------------------------------------------------------------------


def torques(asked, channels, period_s=0.001, **overrides):
    """Torques delivered (N·mm) for torques asked for ``(step, robot, wheel)``."""
    found = run(
        channels,
        seconds=len(asked) * period_s,
        action="torque",
        control_period_s=period_s,
        horizon_s=2.0,
        actions=lambda k: asked[k] / 15.0,
        **overrides,
    )
    return np.stack([found.of_info("torque_l_Nmm"), found.of_info("torque_r_Nmm")], axis=-1)


def asked_at_random(steps):
    return np.random.default_rng(0).uniform(-5, 5, (steps, 3, 2))


def test_torque_gains_scale_the_torque_of_each_wheel():
    asked = asked_at_random(50)
    given = torques(asked, {"actuator.torque_gain_l": 0.9, "actuator.torque_gain_r": 1.2})
    assert given == pytest.approx(asked * [0.9, 1.2], abs=1e-9)


@pytest.mark.parametrize("milliseconds", [0, 1, 7, 100])
def test_dead_time_delays_the_torque_by_exactly_so_many_milliseconds(milliseconds):
    asked = asked_at_random(200)
    given = torques(asked, {"actuator.dead_time_s": milliseconds / 1000})
    assert given[:milliseconds] == pytest.approx(0.0)
    assert given[milliseconds:] == pytest.approx(asked[: 200 - milliseconds], abs=1e-9)


@pytest.mark.parametrize("milliseconds", [0, 1, 7, 20])
def test_computing_delay_holds_the_last_action_for_so_many_milliseconds(milliseconds):
    asked = asked_at_random(20)
    given = torques(asked, {"actuator.computing_delay_s": milliseconds / 1000}, 0.02)
    share = milliseconds / 20
    before = np.concatenate([np.zeros((1, 3, 2)), asked[:-1]])
    assert given == pytest.approx(share * before + (1 - share) * asked, abs=1e-9)


def test_dead_time_and_computing_delay_add_up():
    asked = asked_at_random(20)
    delays = {"actuator.computing_delay_s": 0.005, "actuator.dead_time_s": 0.003}
    one = torques(asked, {"actuator.computing_delay_s": 0.008}, 0.02)
    assert torques(asked, delays, 0.02) == pytest.approx(one, abs=1e-9)


def proportional_loop(robot, period_s):
    """A user's wheel loop."""

    class Loop:
        def reset(self):
            pass

        def torque(self, wanted, measured):
            return 10 * (np.asarray(wanted) - np.asarray(measured))

    return Loop()


def test_computing_delay_acts_on_a_users_wheel_loop_too():
    part = {"parts": {"wheel_loop": proportional_loop}, "wheel_loop": part_name(proportional_loop)}

    def moved(channels):
        found = Run(make(tree(channels), **part), 0.1, constant([0.1, 0.0]))
        return found.motion[0, :, 9]

    assert (moved({}) > 0).all()
    assert moved({"actuator.computing_delay_s": 0.02}) == pytest.approx(0.0, abs=1e-12)


def test_a_computing_delay_beyond_the_control_period_is_refused():
    with pytest.raises(ValueError, match=r"computing_delay_s.*0\.03.*0\.02"):
        make(tree({"actuator.computing_delay_s": 0.03}))


# --- radio -----------------------------------------------------------------------------------------


def ages(found, robot=1, count=2000):
    """How many control steps beyond the gap each message is late, in steps 100 to 100 + ``count``."""
    formation = found.formation
    a, s = formation.arrays, make_settings(formation.scenario)
    slots = a.messages.shape[1]
    a.messages[:] = 0.0
    out = []
    for step in range(100, 100 + count):
        a.clock[0, 1] = step
        for sent in range(step - slots + 1, step + 1):  # at rest, so that dead reckoning leaves x
            a.messages[0, sent % slots, robot - 1, 0] = sent
        out.append(step - s.gap - delayed_message(a, 0, robot, step, s).x)
    return np.array(out, dtype=int)


def test_the_dropout_is_the_share_of_messages_that_never_arrive():
    dropped = run({"radio.dropout": 0.3}, seconds=20.0).dropped
    assert dropped.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / dropped.size))
    pairs = dropped[1:] & dropped[:-1]
    assert pairs.mean() == pytest.approx(0.09, abs=0.02)  # one after the other independently


def rounded(theta, distance, turn):
    """Way in world axes on the arc of a length and a turn, by the closed form of eq. (1)."""
    if abs(turn) < 1e-9:
        return np.array([-math.sin(theta), math.cos(theta)]) * distance
    end = theta + turn
    return (
        distance
        / turn
        * np.array([math.cos(end) - math.cos(theta), math.sin(end) - math.sin(theta)])
    )


@pytest.mark.parametrize("dropout", [0.3, 0.95, 0.999])
def test_a_follower_goes_on_from_the_last_message_that_arrived(dropout):
    found = run(
        {"radio.dropout": dropout},
        seconds=12.0,
        observation="sensor",
        dtype="float64",
        time_gap_s=1.0,
        preview_s=(),
    )
    first = [*SENSOR_TAIL_ENTRIES].index("message_x") - len(SENSOR_TAIL_ENTRIES)
    scale = found.formation.arrays.sensor_scales[[first, first + 1]]
    heard = found.seen[:, 1, [first, first + 1]] * scale + found.starts[1, :2]  # by robot_1
    sent = np.concatenate([[[*found.starts[0], 0.0, 0.0]], found.message[:, 0]])
    arrived = np.concatenate([[True], ~found.dropped[:, 0]])
    expected = []
    for step in range(1, len(heard) + 1):
        newest = max(step - 50, 0)
        k = newest
        while not arrived[k]:
            k -= 1
        ago = (newest - k) * 0.02
        x, y, theta, u_1, u_2 = sent[k]
        expected.append(np.array([x, y]) + rounded(theta, u_1 * ago, u_2 * ago))
    assert heard == pytest.approx(np.array(expected), abs=1e-6)


def steady(channels):
    """From rest at once to one constant twist: the kinematic plant."""
    return run(
        channels,
        seconds=6.0,
        actions=constant([0.3, 0.0]),
        plant="kinematic",
        estimator="truth",
        observation="sensor",
        dtype="float64",
        time_gap_s=1.0,
        preview_s=(),
    )


@pytest.mark.parametrize(
    "channels", [{"radio.dropout": 0.3}, {"radio.jitter_s": 0.3}, SLIPPING | {"radio.dropout": 0.3}]
)
def test_lost_and_late_messages_change_nothing_while_the_sender_keeps_its_twist(channels):
    """On a line, and on a circle; from the first message on that tells the speed."""
    perfect = {path: value for path, value in channels.items() if not path.startswith("radio")}
    heard, expected = steady(channels).seen[:, 1], steady(perfect).seen[:, 1]
    np.testing.assert_allclose(heard[80:], expected[80:], rtol=0, atol=1e-9)
    assert np.abs(expected[80:]).max() > 0.1


@pytest.mark.parametrize("action", [(0.3, 0.0), (0.2, 0.05), (0.0, -0.1), (-0.2, 0.1)])
def test_truth_broadcasts_the_true_motion_whatever_the_encoders_say(action):
    found = run(
        SLIPPING | {"encoder.quantum_rad": 0.02, "encoder.noise_std_rad": 0.01},
        seconds=2.0,
        actions=constant(action),
        estimator="truth",
        plant="kinematic",
    )
    u_1 = 1000.0 * action[0] + SLIPPING["slip.delta_1_mm_s"]
    u_2 = 8.0 * action[1] + SLIPPING["slip.delta_2_rad_s"]
    assert found.message[:, :, 3] == pytest.approx(u_1, abs=1e-9)
    assert found.message[:, :, 4] == pytest.approx(u_2, abs=1e-9)
    one = found.formation.arrays.rows("slip")[:2, :, 0]
    assert one == pytest.approx(np.array([[v] * 3 for v in SLIPPING.values()]), abs=1e-9)


def test_truth_broadcasts_the_true_motion_of_a_robot_that_skids():
    found = run({"tyre.friction_scale": 0.2}, seconds=3.0, estimator="truth")
    theta, v_x, v_y, w = (
        found.motion[:, :, Motion._fields.index(name)] for name in ("theta", "v_x", "v_y", "w")
    )
    forward = v_y * np.cos(theta) - v_x * np.sin(theta)
    assert found.message[:, :, 3] == pytest.approx(forward, abs=1e-12)
    assert (found.message[:, :, 4] == w).all()


def test_with_the_slip_aware_filter_the_estimated_slip_goes_on_the_air():
    """Odometry does not see the conveyor; the message does, once the filter has found it."""
    channels = SLIPPING | {"position.noise_std_mm": 0.4472}
    odometry, both = (
        run(channels, seconds=8.0, actions=constant([0.3, 0.0]), estimator=estimator)
        for estimator in ("ekf", "ekf-slip")
    )
    assert (odometry.motion == both.motion).all()
    sent = (both.message - odometry.message)[-100:, :, 3:].mean(axis=0)
    assert sent[:, 0] == pytest.approx(SLIPPING["slip.delta_1_mm_s"], abs=0.5)
    assert sent[:, 1] == pytest.approx(SLIPPING["slip.delta_2_rad_s"], abs=0.02)


@pytest.mark.parametrize("steps", [1, 5, 50])
def test_jitter_makes_messages_older_evenly_up_to_its_value(steps):
    found = run({"radio.jitter_s": steps * 0.02}, seconds=0.02)
    late = ages(found)
    counts = np.bincount(late, minlength=steps + 1)
    assert len(counts) == steps + 1
    expected = len(late) / (steps + 1)
    chi_2 = ((counts - expected) ** 2 / expected).sum()
    assert chi_2 < steps + 4 * math.sqrt(2 * steps) + 6
    assert (ages(found, robot=2) != late).any()


@pytest.mark.parametrize("jitter_s", [0.005, 0.01, 0.03, 0.11])
def test_jitter_never_makes_a_message_older_than_its_value(jitter_s):
    found = run({"radio.jitter_s": jitter_s}, seconds=0.02)
    assert ages(found).max() * 0.02 <= jitter_s + 1e-12


def echo(robot, period_s):
    """A user's observer: the message is the reference."""

    class Observer:
        def reset(self, pose):
            pass

        def update(self, message, t_s):
            return tuple(message)

    return Observer()


@pytest.mark.parametrize("channel", ["radio.dropout", "radio.jitter_s"])
def test_a_users_observer_hears_through_the_same_radio(channel):
    part = {"parts": {"observer": echo}, "observer": part_name(echo)}

    def heard(channels):
        found = Run(make(tree(channels), **part))
        return found.of_info("reference_x_mm")[:, 1]

    assert (heard({channel: SHOWS[channel]}) != heard({})).any()


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
    formation.reset(0, poses=poses)
    found = formation.arrays.rows("start")[:, :, 0].T
    assert found == pytest.approx(poses)


# --- adversary -------------------------------------------------------------------------------------


def environment(adversary=None, disturbance="nominal", **overrides):
    env = parallel_env(
        "infinity", adversary=adversary, disturbance=disturbance, end_on=(), **overrides
    )
    env.reset(seed=0)
    return env


def rest(env):
    return {agent: np.zeros(2, dtype=np.float32) for agent in env.agents}


@pytest.mark.parametrize("disturbance", ["nominal", "slip"])
def test_an_adversary_sets_channels_for_each_step(disturbance):
    count = [0]

    def push(env):
        count[0] += 1
        if count[0] == 3:
            return {}
        return {"slip.delta_1_mm_s": 10.0 * count[0], "radio.dropout": [0.1, 0.2, 0.3]}

    env, plain = environment(push, disturbance), environment(None, disturbance)
    for k in (1, 2, 3, 4):
        infos, free = env.step(rest(env))[4], plain.step(rest(plain))[4]
        for i, agent in enumerate(env.agents):
            found, base = infos[agent]["disturbance"], free[agent]["disturbance"]
            assert tuple(found) == PATHS
            if k == 3:
                assert found == base
            else:
                assert found == base | {
                    "slip.delta_1_mm_s": 10.0 * k,
                    "radio.dropout": (0.1, 0.2, 0.3)[i],
                }


@pytest.mark.parametrize("path", SET_WITHIN_EPISODE)
def test_an_adversary_does_what_the_channel_does(path):
    imposed = parallel_env(
        "infinity", adversary=lambda env: {path: SHOWS[path]}, end_on=(), time_gap_s=GAP_S
    )
    policy = ReferencePolicy()
    seen, _ = imposed.reset(seed=0)
    for _ in range(100):
        seen = imposed.step({agent: policy.predict(row)[0] for agent, row in seen.items()})[0]
    # the first message and the first previews are out before the first step
    apart = 0.0 if not path.startswith("radio.") else 20.0
    same = run({path: SHOWS[path]}, seconds=2.0, horizon_s=100.0)
    assert imposed.formation.state() == pytest.approx(same.formation.state(), abs=apart)
    assert (same.formation.state() != run(seconds=2.0, horizon_s=100.0).formation.state()).any()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"slip.delta_3": 1.0}, ["slip.delta_3", "slip.delta_1_mm_s"]),
        ({"payload.mass_kg": 1.0}, ["payload.mass_kg", "within an episode"]),
        ({"start.position_std_mm": 1.0}, ["start.position_std_mm", "within an episode"]),
        ({"tyre.friction_scale": -0.1}, ["tyre.friction_scale", "-0.1", "0 to 100"]),
        ({"slip.delta_1_mm_s": math.nan}, ["slip.delta_1_mm_s", "nan", "-2000 to 2000"]),
        ({"radio.dropout": [0.1, 0.2, 1.5]}, ["radio.dropout", "1.5", "0 to 0.999"]),
        ({"actuator.computing_delay_s": 0.5}, ["actuator.computing_delay_s", "0.5", "0.02"]),
        ({"slip.delta_1_mm_s": [1.0, 2.0]}, ["slip.delta_1_mm_s", "3"]),
    ],
)
def test_an_adversarys_impossible_values_are_refused(values, words):
    env = environment(lambda env: values)
    with pytest.raises(ValueError, match=ONE_LINE) as caught:
        env.step(rest(env))
    for word in words:
        assert word in str(caught.value)


# --- validation and presets ------------------------------------------------------------------------


def refused(disturbance, **overrides):
    with pytest.raises(ValueError, match=ONE_LINE) as caught:
        load_scenario("infinity", disturbance=disturbance, **overrides)
    return str(caught.value)


@pytest.mark.parametrize("channel", CHANNELS, ids=PATHS)
def test_values_out_of_range_are_refused_with_the_range(channel):
    for value in (channel.low - 1, channel.high + 1):
        line = refused(tree({channel.path: value}))
        for word in (channel.path, f"{value:g}", f"{channel.low:g} to {channel.high:g}"):
            assert word in line


def test_a_level_that_leaves_the_range_is_refused():
    ice = {"tyre": {"friction_scale": 0.5}}
    assert load_scenario(disturbance=ice, disturbance_level=2.0)
    assert "reaches -0.05 at level 2.1" in refused(ice, disturbance_level=2.1)
    noisy = {"tyre": {"friction_scale": {"type": "gaussian", "mean": 1, "std": 0.3}}}
    assert "reaches -0.2" in refused(noisy)
    patch = {"x_mm": 0, "y_mm": 0, "radius_mm": 1, "friction_scale": 0.1}
    assert "0.1 at level 2 is below 0" in refused({"level": 2, "tyre": {"patches": [patch]}})
    for level in (-1, math.nan, math.inf, "high"):
        assert str(level) in refused({"level": level})
        assert str(level) in refused({}, disturbance_level=level)


@pytest.mark.parametrize(
    ("disturbance", "words"),
    [
        ({"wind": {}}, ["wind", "unknown key"]),
        ({"slip": {"delta_3": 1}}, ["slip.delta_3", "unknown key"]),
        ({"slip": {"delta_1_mm_s": {"type": "constant", "value": 1, "at_s": 1}}}, ["at_s"]),
        ({"slip": {"delta_1_mm_s": True}}, ["delta_1_mm_s", "True"]),
        ({"slip": {"delta_1_mm_s": "fast"}}, ["delta_1_mm_s", "fast"]),
        ({"tyre": {"patches": [{"x_mm": 0, "y_mm": 0, "radius_mm": 0}]}}, ["radius_mm", "0"]),
        ("blizzard", ["blizzard", "combined-hard", "nominal"]),
    ],
)
def test_unknown_keys_and_names_are_refused(disturbance, words):
    line = refused(disturbance)
    for word in words:
        assert word in line


def uniform(low, high, every_s=None):
    return {"type": "uniform", "low": low, "high": high, "every_s": every_s}


def combined(share):
    return {
        "start.position_std_mm": 80 * share,
        "start.heading_std_rad": 0.3 * share,
        "slip.delta_1_mm_s": uniform(-40 * share, 40 * share, 3),
        "slip.delta_2_rad_s": uniform(-0.3 * share, 0.3 * share, 3),
        "tyre.friction_scale": 1 - 0.3 * share,
        "position.noise_std_mm": 2 * share,
    }


PRESETS = {
    "nominal": {},
    "none": {"position.noise_std_mm": 0},
    "noise": {"position.noise_std_mm": 2},
    "slip": {
        "slip.delta_1_mm_s": uniform(-60, 60, 3),
        "slip.delta_2_rad_s": uniform(-0.4, 0.4, 3),
    },
    "ice": {"tyre.friction_scale": 0.5},
    "start": {"start.position_std_mm": 80, "start.heading_std_rad": 0.3},
    "payload": {
        "payload.mass_kg": uniform(0.126, 0.18),
        "payload.behind_mm": uniform(0, 40),
        "payload.inertia_kg_mm2": uniform(156, 224),
    },
    "radio": {"radio.dropout": 0.1, "radio.jitter_s": 0.1},
    "actuator": {
        "actuator.torque_gain_l": uniform(0.9, 1.1),
        "actuator.torque_gain_r": uniform(0.9, 1.1),
        "actuator.dead_time_s": 0.002,
        "actuator.computing_delay_s": 0.01,
    },
    "combined-hard": combined(1),
    "combined-medium": combined(1 / 2),
    "combined-easy": combined(1 / 4),
    "swell": {
        "slip.delta_1_mm_s": {"type": "sine", "amplitude": 40, "frequency_hz": 0.12},
        "slip.delta_2_rad_s": {
            "type": "ornstein_uhlenbeck",
            "std": 0.15,
            "time_constant_s": 1.5,
        },
    },
}


def test_presets_are_those_of_the_folder():
    assert sorted(PRESETS) == preset_names("disturbance")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_hold_their_numbers_and_nothing_else(name):
    found = load_scenario(disturbance=name).disturbance
    assert found.name == name
    assert found.level == 1
    assert found.tyre.patches == ()
    expected = Disturbance.model_validate({"name": name, **tree(PRESETS[name])})
    for path in PATHS:
        one, other = (d.signal(path).model_dump() for d in (found, expected))
        assert one["type"] == other["type"]
        assert {k: v for k, v in one.items() if v != other[k]} == pytest.approx(
            {k: other[k] for k, v in one.items() if v != other[k]}
        )


@pytest.mark.parametrize("name", ["payload", "radio", "actuator"])
def test_chosen_numbers_name_their_source(name):
    text = (presets_folder("disturbance") / f"{name}.yaml").read_text(encoding="utf-8")
    assert "Source" in text
    assert yaml.safe_load(text)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run_and_tell_what_acted(name):
    env = environment(disturbance=name)
    infos = env.step(rest(env))[4]
    disturbance = load_scenario(disturbance=name).disturbance
    for agent in env.agents:
        for path, value in infos[agent]["disturbance"].items():
            low, high = disturbance.signal(path).reach()
            assert low <= value <= high


# --- documentation ---------------------------------------------------------------------------------


def test_the_documentations_table_is_made_from_the_channels():
    page = DOCS.read_text(encoding="utf-8")
    assert renewed(page) == page
    for channel in CHANNELS:
        assert row(channel) in page


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("slip.delta_1_mm_s", "mm/s"),
        ("slip.delta_2_rad_s", "rad/s"),
        ("tyre.friction_scale", "1"),
        ("position.bias_x_mm", "mm"),
        ("encoder.quantum_rad", "rad"),
        ("radio.jitter_s", "s"),
        ("payload.mass_kg", "kg"),
        ("payload.inertia_kg_mm2", "kg·mm²"),
    ],
)
def test_the_tables_unit_is_the_names(path, expected):
    assert unit(path) == expected


def test_the_documentation_lists_the_presets():
    listed = re.findall(
        r"^\| `([a-z-]+)` \| [^|]+ \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert listed == list(PRESETS)


def test_the_documentations_examples_run():
    text = DOCS.read_text(encoding="utf-8")
    for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL):
        assert load_scenario("infinity", **yaml.safe_load(block))
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        scope = {}
        exec(block, scope)
        env = scope["env"]
        env.reset(seed=0)
        assert env.step(rest(env))[4]["robot_0"]["disturbance"]["slip.delta_1_mm_s"] == 20.0
