"""The presets of real sensors and motors against the numbers of their page: data sheets and measurements."""

from __future__ import annotations

import functools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import PAPERS

import tlf_env
from baselines import ReferencePolicy
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from tlf_env.common.presets import preset_names
from tlf_env.disturbances.channels import PATHS, nominal_effects
from tlf_env.engine.layout import Sample
from tlf_env.engine.substeps import motor_torque
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.scenario import load_scenario

PAGE = (Path(__file__).parent.parent / "docs" / "hardware.md").read_text(encoding="utf-8")
PARTS = ("motor", "encoders-4096", "fixes-100hz", "gyro", "calibration")  # of `hardware`
NAMES = (*PARTS, "encoders-1024", "fixes-camera", "fixes-uwb", "fixes-outage", "hardware")

GRAVITY_M_S2 = 9.80665
LIMIT_Nmm = RobotParameters().torque_limit_Nmm
PERIOD_S = 0.02
DRIVER_V, RESISTOR_OHM = 0.2, 1.0  # DRV8833: the current limit is 0.2 V / R
ROUNDED = 5e-3  # the presets have three digits


@functools.cache
def disturbance(preset):
    return load_scenario(disturbance=preset).disturbance


def signal(preset, path):
    return disturbance(preset).signal(path)


def constant(preset, path):
    found = signal(preset, path)
    assert found.type == "constant"
    return found.value


def on_page(pattern):
    """The numbers of the first match on the page."""
    found = re.search(pattern, PAGE)
    assert found, pattern
    return [float(number.replace(" ", "")) for number in found.groups()]


# --- the page --------------------------------------------------------------------------------------


def test_the_page_lists_the_presets_and_no_others():
    first = PAGE[: PAGE.index("![")]
    listed = re.findall(r"`([a-z0-9-]+)`", "".join(re.findall(r"^\| (`[^|]+) \|", first, re.M)))
    assert sorted(listed) == sorted(NAMES)
    assert set(NAMES) <= set(preset_names("disturbance"))


# --- motor -----------------------------------------------------------------------------------------

NO_LOAD_RPM, NO_LOAD_A, STALL_KGMM, STALL_A = on_page(
    r"no load: (\d+) rpm, ([\d.]+) A; stall: ([\d.]+) kg·mm, ([\d.]+) A"
)
NO_LOAD_RAD_S = NO_LOAD_RPM * 2 * math.pi / 60
STALL_Nmm = STALL_KGMM * GRAVITY_M_S2
Nmm_A = STALL_Nmm / (STALL_A - NO_LOAD_A)


def test_the_motors_values_follow_from_its_data_sheet():
    assert constant("motor", "actuator.back_emf_s_rad") == pytest.approx(
        1 / NO_LOAD_RAD_S, rel=ROUNDED
    )
    assert constant("motor", "actuator.dead_band_Nmm") == pytest.approx(
        Nmm_A * NO_LOAD_A, rel=ROUNDED
    )
    assert constant("motor", "actuator.stall_torque") == pytest.approx(
        STALL_Nmm / LIMIT_Nmm, rel=ROUNDED
    )
    limit = Nmm_A * (DRIVER_V / RESISTOR_OHM - NO_LOAD_A)
    drawn = signal("motor", "actuator.current_limit")
    assert (drawn.low + drawn.high) / 2 == pytest.approx(limit / LIMIT_Nmm, rel=ROUNDED)
    assert (drawn.high - drawn.low) / 2 == pytest.approx(0.1)


def test_the_motors_curve_is_its_data_sheets_below_the_drivers_limit():
    effects = nominal_effects()._replace(
        actuator_back_emf_s_rad=constant("motor", "actuator.back_emf_s_rad"),
        actuator_dead_band_Nmm=constant("motor", "actuator.dead_band_Nmm"),
        actuator_stall_torque=constant("motor", "actuator.stall_torque"),
    )
    full = 1000 * LIMIT_Nmm  # mN·mm

    def most(omega):
        return motor_torque(full, omega, full, effects)

    assert most(0.0) == full
    for omega in np.linspace(0.0, NO_LOAD_RAD_S, 25):
        sheet = 1000 * STALL_Nmm * (1 - omega / NO_LOAD_RAD_S)
        found = most(omega)
        assert found == pytest.approx(min(sheet, full), abs=2 * ROUNDED * full) or found == 0.0
    assert most(1.01 * NO_LOAD_RAD_S) == 0.0
    band = 1000 * Nmm_A * NO_LOAD_A
    assert motor_torque(0.99 * band, 0.0, full, effects) == 0.0
    assert motor_torque(1.01 * band, 0.0, full, effects) == 1.01 * band


def test_a_robot_without_friction_reaches_the_motors_speed_without_load():
    env = tlf_env.parallel_env(
        "infinity",
        robots=1,
        action="torque",
        disturbance="motor",
        robot={"joint_friction": False},
        horizon_s=60.0,
        end_on=(),
        preview_s=(),
    )
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    for _ in range(round(50 / PERIOD_S)):  # ten time constants of m R²/(2 k τ)
        env.step({"robot_0": np.array([1.0, 1.0], dtype=np.float32)})
    wheels = env.formation.named("motion")
    assert float(wheels.omega_l[0]) == pytest.approx(NO_LOAD_RAD_S, rel=0.01)


# --- encoders and fixes ----------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [1024, 4096])
def test_a_turn_has_the_presets_counts(counts):
    assert constant(f"encoders-{counts}", "encoder.quantum_rad") * counts == 2 * math.pi


def samples(preset, seconds):
    """Sensor samples (substep, robot) of robots at rest under a preset, by name."""
    env = tlf_env.parallel_env(
        "infinity", disturbance=preset, end_on=(), preview_s=(), observation="sensor"
    )
    env.reset(seed=0)
    rest = {agent: np.zeros(2, dtype=np.float32) for agent in env.agents}
    found = []
    for _ in range(round(seconds / PERIOD_S)):
        env.step(rest)
        found.append(env.formation.arrays.samples[..., 0].copy())
    rows = np.concatenate(found)
    return {name: rows[:, i] for i, name in enumerate(Sample._fields)}


@pytest.mark.parametrize(
    ("preset", "rate_hz", "delay_s"),
    [("fixes-100hz", 100, 0.010), ("fixes-camera", 30, 0.050), ("fixes-uwb", 10, 0.3)],
)
def test_fixes_come_at_the_devices_rate_and_age(preset, rate_hz, delay_s):
    assert 1 / constant(preset, "position.period_s") == pytest.approx(rate_hz, rel=0.011)
    seconds = 6.0
    found = samples(preset, seconds)
    expected = rate_hz * (seconds - delay_s) * (1 - (preset == "fixes-100hz") * 0.0034)
    assert found["has_fix"].sum(axis=0) == pytest.approx(np.full(3, expected), abs=0.01 * expected)
    assert found["fix_age"][-1] == pytest.approx(delay_s)


def test_the_radios_error_has_the_measured_size_and_memory():
    whole, white = on_page(r"\\sqrt\{(\d+)\^2 - (\d+)\^2\}")
    assert constant("fixes-uwb", "position.noise_std_mm") == white
    (after_1_s,) = on_page(r"after 1 s is ([\d.]+)")
    for axis in "xy":
        slow = signal("fixes-uwb", f"position.bias_{axis}_mm")
        assert math.hypot(white, slow.std) == pytest.approx(whole, rel=ROUNDED)
        assert math.exp(-1 / slow.time_constant_s) == pytest.approx(after_1_s, abs=0.01)


def test_an_outage_lasts_a_second_and_comes_once_in_twenty():
    has = samples("fixes-outage", 40.0)["has_fix"]
    starts = []
    for robot in has.T:
        for window in (robot[:20_000], robot[20_000:40_000]):
            gone = np.flatnonzero(window == 0.0)
            assert len(gone) == 1000
            assert gone[-1] - gone[0] == 999
            starts.append(gone[0])
    assert len(set(starts)) == len(starts)  # each robot's are its own


# --- gyro ------------------------------------------------------------------------------------------


def test_the_gyros_values_follow_from_its_data_sheet():
    density, scale_percent = on_page(r"noise density ([\d.]+) °/s/√Hz; scale ±(\d+) %")
    white = constant("gyro", "gyro.noise_rad_s_sqrt_hz")
    assert white == pytest.approx(math.radians(density), rel=ROUNDED)
    drawn = signal("gyro", "gyro.scale")
    assert (drawn.low, drawn.high) == (1 - scale_percent / 100, 1 + scale_percent / 100)


def test_the_gyros_lowest_allan_deviation_is_its_bias_stability():
    (stability_deg_h,) = on_page(r"bias stability ([\d.]+) °/h")
    white = constant("gyro", "gyro.noise_rad_s_sqrt_hz")
    walk = signal("gyro", "gyro.bias_rad_s").per_sqrt_s
    tau_s = np.logspace(-1, 4, 100_001)
    deviation = np.sqrt(white**2 / tau_s + walk**2 * tau_s / 3)
    assert deviation.min() == pytest.approx(math.radians(stability_deg_h) / 3600, rel=ROUNDED)


# --- calibration -----------------------------------------------------------------------------------


def test_wheels_differ_as_much_as_those_of_the_page():
    (percent,) = on_page(r"a standard deviation of \$0.007\\sqrt\{2/3\} = ([\d.]+)\$ %")
    left, right = (
        signal("calibration", f"calibration.radius_{side}") for side in ("left", "right")
    )
    variances = [(one.high - one.low) ** 2 / 12 for one in (left, right)]
    assert math.sqrt(sum(variances)) == pytest.approx(percent / 100, rel=0.01)


def test_each_robot_and_episode_has_its_own_calibration():
    env = tlf_env.parallel_env("infinity", disturbance="calibration")
    drawn = []
    for seed in (0, 1):
        _, infos = env.reset(seed=seed)
        drawn += [
            info[f"calibration_{name}"]
            for info in infos.values()
            for name in ("radius_left", "radius_right", "track")
        ]
    assert len(set(drawn)) == len(drawn) == 18
    assert max(abs(np.array(drawn) - 1)) <= 0.02


# --- all together ----------------------------------------------------------------------------------


def test_hardware_is_its_parts_together():
    for path in PATHS:
        nominal = signal("nominal", path)
        acting = [one for part in PARTS if (one := signal(part, path)) != nominal]
        assert len(acting) <= 1
        assert signal("hardware", path) == (acting or [nominal])[0]


def driven(**overrides):
    """States (step, robot, entry) and sensor samples of five seconds under the reference policy."""
    env = tlf_env.parallel_env("infinity", end_on=(), **overrides)
    seen, _ = env.reset(seed=3)
    policy, states, sensed = ReferencePolicy(), [], []
    for _ in range(250):
        seen = env.step({agent: policy.predict(row)[0] for agent, row in seen.items()})[0]
        states.append(env.formation.state().copy())
        sensed.append(env.formation.arrays.samples.copy())
    return np.array(states), np.array(sensed)


@functools.cache
def nominal():
    return driven(disturbance="nominal")


@pytest.mark.parametrize("preset", NAMES)
def test_at_level_zero_a_run_is_nominal(preset):
    states, sensed = nominal()
    at_zero = driven(disturbance=preset, disturbance_level=0.0)
    assert (at_zero[0] == states).all()
    assert (at_zero[1] == sensed).all()
    if preset != "fixes-outage":  # its time is drawn
        acting = driven(disturbance=preset)
        assert (acting[1] != sensed).any()
        assert (acting[0] != states).any()


def test_the_papers_filter_does_not_read_the_gyro():
    nominal, bent = (driven(disturbance=name, **PAPERS) for name in ("nominal", "gyro"))
    assert (bent[1] != nominal[1]).any()
    assert (bent[0] == nominal[0]).all()


def test_the_scenario_is_the_infinity_with_hardware():
    plain, real = load_scenario("infinity"), load_scenario("infinity_hardware")
    assert real.trajectory == plain.trajectory
    assert (real.robots, real.time_gap_s) == (plain.robots, plain.time_gap_s)
    assert real.disturbance.name == "hardware"
    assert real.wheel_loop.speed_observer_rad_s == 80
    assert real.start_ramp_s > 0
    assert load_scenario("infinity_hardware", disturbance="nominal").disturbance.name == "nominal"


def test_the_tuned_reference_drives_the_infinity_with_hardware():
    fitted = fit_policy("reference:tuned", load_scenario("infinity_hardware", horizon_s=40.0))
    run = run_policy(fitted.scenario, fitted.policy)
    settled = run.t_s >= 24.0
    errors = run.columns["position_error_mm"][settled]
    assert np.sqrt((errors**2).mean(axis=0)).max() < 3.0
    assert np.isinf(run.lost_at_s).all()
