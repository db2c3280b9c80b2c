"""The scenario: where it comes from, what it refuses, and how it prints."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

import tlf_env
from baselines import ReferencePolicy
from tlf_env.common.presets import preset_names, presets_folder
from tlf_env.task.observation import OBSERVATION_LIMIT, SAMPLE_ENTRIES
from tlf_env.task.scenario import Scenario, load_scenario, scenario_notes, scenario_warnings
from tlf_env.task.trajectories import sample

NAN, INF = math.nan, math.inf


def refusal(*args, **kwargs) -> str:
    """The message with which a scenario is refused: one line."""
    with pytest.raises(ValueError, match=r"\S") as caught:
        tlf_env.parallel_env(*args, **kwargs)
    message = str(caught.value)
    assert "\n" not in message.strip()
    assert len(message) < 500
    return message


def written(tmp_path, text: str, name: str = "mine.yaml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


# Where it comes from


def test_presets_are_there():
    assert {"infinity", "flower"} <= set(preset_names())
    disturbances = preset_names("disturbance")
    assert {"nominal", "none"} <= set(disturbances)


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("disturbance", preset_names("disturbance"))
def test_presets_load(name, disturbance):
    scenario = load_scenario(name, disturbance=disturbance)
    assert scenario.name == name
    assert scenario.disturbance.name == disturbance


def test_infinity_and_flower_are_the_papers():
    infinity, flower = load_scenario("infinity"), load_scenario("flower")
    assert (infinity.robots, infinity.time_gap_s, infinity.horizon_s) == (3, 5.0, 100.0)
    assert (flower.robots, flower.time_gap_s, flower.horizon_s) == (5, 5.0, 150.0)
    for scenario in (infinity, flower):
        assert scenario.settle_s == pytest.approx(0.4 * scenario.horizon_s)
        assert scenario.physics_period_s == 0.001
        assert scenario.control_period_s == 0.02
        assert scenario.start_spacing_mm == 300
        assert scenario.observer.gain_per_s == 3
        assert scenario.observer.smoothing_s == 5
        assert scenario.ekf.fix_variance_mm2 == 0.2
        assert scenario.lost_beyond_mm == 1200
        assert scenario.disturbance.position.noise_std_mm.value**2 == pytest.approx(0.2)


def test_robot_is_that_of_table_1():
    robot = load_scenario("infinity").robot
    assert (robot.mass_kg, robot.wheel_radius_mm, robot.axle_width_mm) == (1.245, 50, 156)
    assert (robot.wheel_inertia_kg_mm2, robot.gravity_mm_s2) == (52.91, 9807)
    assert (robot.torque_limit_Nmm, robot.tyre.mu_static, robot.tyre.mu_dynamic) == (
        15,
        0.073,
        0.055,
    )
    for joint, arms in (
        (robot.drive_joint, (0.15, 0.1, 12, 8, 36)),
        (robot.castor_joint, (0.15, 0.1, 6.2, 3.025, 30)),
        (robot.steering_joint, (0.05, 0.033, 2.5, 2.5, 3)),
    ):
        assert arms == (
            joint.mu_static,
            joint.mu_dynamic,
            joint.friction_arm_mm,
            joint.pin_radius_mm,
            joint.bending_arm_mm,
        )
        assert joint.dynamic_speed_mm_s == 1.5 * joint.stiction_speed_mm_s == 1.5
        assert joint.bending
        assert joint.preload_Nmm == 0


def test_a_scenario_passes_through_unchanged():
    scenario = load_scenario("flower", robots=2)
    assert load_scenario(scenario) == scenario
    assert tlf_env.parallel_env(scenario).scenario == scenario


def test_keywords_yaml_and_mapping_are_the_same(tmp_path):
    by_keyword = load_scenario(
        "infinity",
        robots=4,
        time_gap_s=3.0,
        disturbance={"slip": {"delta_1_mm_s": 5.0}, "level": 0.5},
        reward={"fine": 2.0},
        ekf={"alpha_1": 1e-3},
    )
    text = yaml.safe_dump(
        {
            **yaml.safe_load((presets_folder() / "infinity.yaml").read_text(encoding="utf-8")),
            "robots": 4,
            "time_gap_s": 3.0,
            "disturbance": {"slip": {"delta_1_mm_s": 5.0}, "level": 0.5},
            "reward": {"fine": 2.0},
            "ekf": {"alpha_1": 1e-3},
        }
    )
    by_file = load_scenario(written(tmp_path, text, "infinity.yaml"))
    assert by_file == by_keyword
    assert load_scenario(str(written(tmp_path, text, "infinity.yaml"))) == by_keyword
    assert load_scenario({"name": "infinity", **yaml.safe_load(text)}) == by_keyword


def test_a_file_gives_its_name(tmp_path):
    text = (presets_folder() / "flower.yaml").read_text(encoding="utf-8")
    assert load_scenario(written(tmp_path, text, "roundabout.yml")).name == "roundabout"


def test_none_leaves_the_presets_value():
    assert load_scenario("flower", horizon_s=None, robots=None) == load_scenario("flower")


def test_one_number_deep_inside_can_be_changed_alone():
    whole = load_scenario("infinity").robot
    changed = load_scenario("infinity", robot={"steering_joint": {"bending": False}}).robot
    joint = whole.steering_joint.model_copy(update={"bending": False})
    assert changed == whole.model_copy(update={"steering_joint": joint})


def test_level_overrides_that_of_any_disturbance():
    for disturbance in ("nominal", {"slip": {"delta_1_mm_s": 5.0}}, None):
        scenario = load_scenario("infinity", disturbance=disturbance, disturbance_level=0.25)
        assert scenario.disturbance.level == 0.25


def test_reward_weights_not_named_keep_their_defaults():
    changed = load_scenario("infinity", reward={"fine": 3.0}).reward
    assert changed == {**load_scenario("infinity").reward, "fine": 3.0}


# What it refuses


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ({"robots": 0}, ("robots", "0")),
        ({"robots": -3}, ("robots", "-3")),
        ({"robots": 2.5}, ("robots", "2.5")),
        ({"robots": "many"}, ("robots", "many")),
        ({"robots": True}, ("robots", "True", "a whole number")),
        ({"robots": [1, 2]}, ("robots.0", "got 1", "robots.1", "got 2")),
        ({"horizon_s": True}, ("horizon_s", "True", "a number")),
        ({"horizon_s": 1e308}, ("horizon_s", "1e+308", "within ±1e+15")),
        ({"lost_beyond_mm": 1.1e15}, ("lost_beyond_mm", "1100000000000000", "within ±1e+15")),
        ({"lost_beyond_mm": 9e-16}, ("lost_beyond_mm", "9e-16", "at least 1e-15")),
        ({"horizon_s": 1e14}, ("horizon_s", "100000000000000", "10000000 steps")),
        ({"time_gap_s": 1e9}, ("time_gap_s", "1000000000.0", "10000000 steps")),
        ({"time_gap_s": 1e14}, ("time_gap_s", "100000000000000", "10000000 steps")),
        ({"control_period_s": 1e14}, ("control_period_s", "100000000000000", "10000000 steps")),
        ({"preview_s": (1e14,)}, ("preview_s", "100000000000000", "time_gap_s 5.0")),
        ({"start_spacing_mm": 1e14}, ("start_spacing_mm", "100000000000000", "1000000000")),
        ({"name": ""}, ("name", "''", "letter")),
        ({"name": ".."}, ("name", "'..'", "letter")),
        ({"name": "../../up"}, ("name", "'../../up'", "letters, digits")),
        ({"name": "a/b"}, ("name", "'a/b'", "letters, digits")),
        ({"name": "/root"}, ("name", "'/root'", "letters, digits")),
        ({"name": "two\nlines"}, ("name", "two", "letters, digits")),
        ({"name": "x" * 101}, ("name", "100 letters")),
        ({"adversary": 3}, ("adversary", "3", "callable")),
        ({"time_gap_s": 5.01}, ("time_gap_s", "5.01", "0.02")),
        ({"time_gap_s": 0.0}, ("time_gap_s", "0.0")),
        ({"time_gap_s": -5.0}, ("time_gap_s", "-5.0")),
        ({"horizon_s": 99.999}, ("horizon_s", "99.999")),
        ({"horizon_s": 0}, ("horizon_s", "0")),
        ({"horizon_s": 1e9}, ("horizon_s", "1000000000")),
        ({"control_period_s": 0.0205}, ("control_period_s", "0.0205", "0.001")),
        ({"control_period_s": 0.0005}, ("control_period_s", "0.0005", "0.001")),
        ({"control_period_s": 0.0}, ("control_period_s", "0")),
        ({"physics_period_s": 0.003}, ("control_period_s", "0.02", "0.003")),
        ({"physics_period_s": -0.001}, ("physics_period_s", "-0.001")),
        ({"preview_s": (0.505,)}, ("preview_s", "0.505")),
        ({"preview_s": (6.0,)}, ("preview_s", "6.0", "5.0")),
        ({"preview_s": (-0.5,)}, ("preview_s", "-0.5")),
        ({"start_spacing_mm": 200.0}, ("start_spacing_mm", "200", "220")),
        ({"lost_beyond_mm": 0.0}, ("lost_beyond_mm", "0.0")),
        ({"plant": "gazebo"}, ("plant", "gazebo", "pymunk", "kinematic")),
        ({"action": "voltage"}, ("action", "voltage", "twist")),
        ({"observation": "pixels"}, ("observation", "pixels", "tracking")),
        ({"estimator": "ukf"}, ("estimator", "ukf", "'ekf'", "or module:factory")),
        ({"wheel_loop": "ukf"}, ("wheel_loop", "ukf", "module:factory")),
        ({"observer": "a b:c"}, ("observer", "a b:c", "module:factory")),
        ({"end_on": ("bored",)}, ("end_on", "bored", "lost")),
        ({"disturbance": "storm"}, ("storm", "nominal")),
        ({"disturbance": {"wind": {}}}, ("disturbance.wind", "unknown")),
        ({"disturbance": {"slip": {"delta_9": 1.0}}}, ("disturbance.slip.delta_9", "unknown")),
        ({"disturbance": {"tyre": {"friction_scale": -0.1}}}, ("friction_scale", "-0.1")),
        ({"disturbance": {"position": {"noise_std_mm": -1.0}}}, ("noise_std_mm", "-1.0")),
        (
            {"disturbance": {"tyre": {"friction_scale": 0.5}, "level": 3.0}},
            ("level", "3.0", "friction_scale"),
        ),
        ({"disturbance_level": -1.0}, ("level", "-1.0")),
        ({"disturbance_level": NAN}, ("level", "nan")),
        ({"disturbance_level": INF}, ("level", "inf")),
        ({"disturbance_level": "high"}, ("level", "high")),
        ({"disturbance_level": True}, ("level", "True")),
        ({"disturbance": {"level": True}}, ("disturbance.level", "True")),
        ({"reward": {"style": 1.0}}, ("reward", "style", "coarse")),
        ({"reward": {"fine": NAN}}, ("reward", "fine", "nan")),
        ({"reward": 3.0}, ("reward", "3.0")),
        ({"robot": {"mass_kg": 0.0}}, ("robot.mass_kg", "0.0")),
        ({"robot": {"mass_kg": NAN}}, ("robot.mass_kg", "nan")),
        ({"robot": {"wheels": 4}}, ("robot.wheels", "unknown")),
        ({"robot": {"com_offset_mm": 25.0}}, ("com_offset_mm", "25.0")),
        ({"robot": {"torque_limit_Nmm": -15.0}}, ("torque_limit_Nmm", "-15")),
        ({"ekf": {"fix_variance_mm2": 0.0}}, ("fix_variance_mm2", "0.0")),
        ({"observer": {"gain_per_s": INF}}, ("gain_per_s", "inf")),
        ({"wheel_loop": {"gain_Nmm_s": NAN}}, ("gain_Nmm_s", "nan")),
        ({"trajectory": {"type": "spiral"}}, ("trajectory", "spiral", "rose")),
        (
            {"trajectory": {"amplitude_x_mm": 1e14}},
            ("amplitude_x_mm", "100000000000000", "1000000000"),
        ),
        ({"trajectory": {"centre_y_mm": -1e14}}, ("centre_y_mm", "-100000000000000", "1000000000")),
        ({"trajectory": {"rate_y_rad_s": 1e14}}, ("rate_y_rad_s", "100000000000000", "10000")),
        ({"trajectory": {"phase_x_rad": 1e14}}, ("phase_x_rad", "100000000000000", "1000000000")),
        ({"render_mode": "hologram"}, ("render_mode", "hologram")),
    ],
)
def test_an_impossible_value_is_refused_and_named(overrides, named):
    message = refusal("infinity", **overrides)
    for part in named:
        assert part in message


@pytest.mark.parametrize(
    ("overrides", "unwanted"),
    [
        ({"robots": [1, 2]}, "at least 1 item"),
        ({"robots": [{"mass_kg": -1}]}, "at least 1 item"),
        ({"estimator": "ukf"}, "pattern"),
        ({"wheel_loop": "ukf"}, "pattern"),
    ],
)
def test_a_refusal_says_nothing_that_misleads(overrides, unwanted):
    assert unwanted not in refusal("infinity", **overrides)


@pytest.mark.parametrize("source", [5, 1.5, None, ["infinity"], True])
def test_what_is_no_scenario_is_refused(source):
    assert repr(source) in refusal(source).replace('"', "")
    with pytest.raises(ValueError, match="must be a preset's name"):
        load_scenario(source)


@pytest.mark.parametrize("source", [5, None])
def test_a_batch_refuses_what_is_no_scenario(source):
    with pytest.raises(ValueError, match="must be a preset's name"):
        tlf_env.BatchPlant(source, 2)


def test_a_preview_that_repeats_is_refused():
    """Each time gives entries of its own to the observation, by name."""
    with pytest.raises(ValueError, match="preview_s"):
        load_scenario("infinity", preview_s=(0.5, 0.5))


FLOATS = (
    "time_gap_s",
    "start_spacing_mm",
    "physics_period_s",
    "control_period_s",
    "horizon_s",
    "lost_beyond_mm",
)


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("name", FLOATS)
def test_numbers_must_be_finite(name, value):
    message = refusal("infinity", **{name: value})
    assert name in message
    assert str(abs(value)) in message


@pytest.mark.parametrize("group", ["robot", "ekf", "observer", "wheel_loop"])
def test_every_number_of_the_robot_and_its_controllers_must_be_finite(group):
    model = getattr(load_scenario("infinity"), group)
    for name, value in model.model_dump().items():
        if isinstance(value, float):
            message = refusal("infinity", **{group: {name: NAN}})
            assert f"{group}.{name}" in message


@pytest.mark.parametrize("curve", ["tyre", "drive_joint", "castor_joint", "steering_joint"])
def test_friction_must_be_possible(curve):
    whole = getattr(load_scenario("infinity").robot, curve).model_dump()
    for change, named in (
        ({"mu_static": -0.1}, "-0.1"),
        ({"mu_static": NAN}, "nan"),
        ({"mu_dynamic": 2.0}, "2.0"),
        ({"dynamic_speed_mm_s": 0.5}, "0.5"),
    ):
        message = refusal("infinity", robot={curve: {**whole, **change}})
        assert curve in message
        assert named in message


def test_an_unknown_preset_is_refused_with_the_presets_there_are():
    message = refusal("lemniscate")
    for part in ("lemniscate", "infinity", "flower"):
        assert part in message


def test_unknown_gains_are_refused_with_the_presets_there_are():
    with pytest.raises(ValueError, match="heroic") as caught:
        ReferencePolicy("heroic")
    assert "consistent" in str(caught.value)
    assert "printed" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "robots: [3",
        "a: b: c",
        "- robots",
        "just words",
        "",
        "\x00",
        "robots: 3\n",  # no trajectory
        "trajectory: {type: rose, amplitude_x_mm: 1, amplitude_y_mm: 1, period_s: .nan}",
        "trajectory: {type: rose, amplitude_x_mm: 1, amplitude_y_mm: 1, period_s: 9}\nspeed: 3",
        "trajectory: {type: circle, radius_mm: 1, speed_mm_s: 1.0e+300}",
        "trajectory: {type: circle, radius_mm: 1.0e-300, speed_mm_s: 1}",
        "trajectory: {type: circle, radius_mm: 1, period_s: 1.0e-300}",
        "trajectory: {type: rose, amplitude_x_mm: 1, amplitude_y_mm: 1, petals_k: 1e8, period_s: 1}",
        "trajectory: {type: stop_and_go, path: {type: circle, radius_mm: 500, period_s: 20}, "
        "drive_s: 10, stop_s: 5, ramp_s: 1.0e-300}",
    ],
)
def test_a_broken_file_is_refused(tmp_path, text):
    refusal(written(tmp_path, text))


ALIASES = "a0: &a0 [1]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9)
)
MERGES = "a0: &a0 {k0: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}], k{i}: 1}}\n" for i in range(1, 9)
)


@pytest.mark.parametrize("text", [ALIASES + "robots: *a8\n", ALIASES, MERGES])
def test_aliases_of_aliases_are_counted(tmp_path, text):
    message = refusal(written(tmp_path, text))
    assert "line 7: more than 1000000 values" in message


@pytest.mark.parametrize("text", ["a: &a [1, *a]\n", "a: &a {b: {c: *a}}\n"])
def test_a_value_within_itself_is_refused(tmp_path, text):
    assert "contains itself" in refusal(written(tmp_path, text))


def test_an_alias_may_repeat_a_robot(tmp_path):
    robots = f"robots: [&r {{mass_kg: 1.2}}{', *r' * 99}]\n"
    text = f"trajectory: {{type: circle, radius_mm: 90000, speed_mm_s: 100}}\n{robots}"
    assert load_scenario(written(tmp_path, text)).robot_count == 100


@pytest.mark.parametrize("place", ["", "robot:\n  mass_kg: 1.245\n  "])
def test_a_key_that_stands_twice_is_refused_and_named(tmp_path, place):
    """YAML itself would take the last one in silence."""
    inside = place.replace("mass_kg: 1.245", "gravity_mm_s2: 9807")
    text = f"trajectory: {{type: circle, radius_mm: 1000, speed_mm_s: 100}}\n{inside}"
    key = "horizon_s: 50" if not place else "mass_kg: 1.245"
    indent = "  " if place else ""
    load_scenario(written(tmp_path, f"{text}{key}\n"))
    message = refusal(written(tmp_path, f"{text}{key}\n{indent}{key}\n"))
    assert repr(key.split(":")[0]) in message
    assert "is repeated" in message
    assert "line 3" in message or "line 5" in message


def test_a_merged_mapping_may_be_overridden(tmp_path):
    text = (
        "robot: &base {gravity_mm_s2: 1000}\n"
        "robots: [{<<: *base, gravity_mm_s2: 2000}, *base]\n"
        "trajectory: {type: circle, radius_mm: 1000, speed_mm_s: 100}\n"
    )
    models = load_scenario(written(tmp_path, text)).robot_models
    assert [robot.gravity_mm_s2 for robot in models] == [2000, 1000]


@pytest.mark.parametrize(
    ("file", "name"),
    [("my run (2).yaml", "my_run__2_"), (".yml.yaml", "_yml"), ("ä-1.yaml", "ä-1")],
)
def test_a_files_name_becomes_one_that_names_a_folder(tmp_path, file, name):
    text = (presets_folder() / "flower.yaml").read_text(encoding="utf-8")
    assert load_scenario(written(tmp_path, text, file)).name == name


def test_a_missing_file_is_refused_and_named(tmp_path):
    assert "nowhere.yaml" in refusal(tmp_path / "nowhere.yaml")
    assert "nowhere.yaml" in refusal(str(tmp_path / "nowhere.yaml"))


def test_a_folder_is_no_file(tmp_path):
    folder = tmp_path / "folder.yaml"
    folder.mkdir()
    assert "folder.yaml" in refusal(folder)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"\xff\xfe\x00\xd8robots")
    assert "binary.yaml" in refusal(path)


# What it is once made


def test_scenario_is_frozen():
    scenario = load_scenario("infinity")
    for change in (
        lambda: setattr(scenario, "robots", 5),
        lambda: setattr(scenario.robot, "mass_kg", 2.0),
        lambda: setattr(scenario.robot.tyre, "mu_static", 2.0),
        lambda: setattr(scenario.disturbance.slip, "delta_1_mm_s", 2.0),
        lambda: setattr(scenario.trajectory, "amplitude_x_mm", 2.0),
    ):
        with pytest.raises(ValidationError, match="frozen"):
            change()


def test_reward_weights_are_frozen_too():
    scenario = load_scenario("infinity")
    with pytest.raises(TypeError):
        scenario.reward["fine"] = 99.0


@pytest.mark.parametrize("name", preset_names())
def test_scenario_survives_json(name):
    scenario = load_scenario(name, disturbance={"slip": {"delta_2_rad_s": 0.1}, "level": 1 / 3})
    assert Scenario.model_validate_json(scenario.model_dump_json()) == scenario
    assert load_scenario(json.loads(scenario.model_dump_json())) == scenario


def names_within(value) -> Iterator[str]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from names_within(item)


def test_the_environment_prints_the_whole_scenario():
    scenario = tlf_env.parallel_env("flower", robots=2, time_gap_s=4.0).scenario
    text = repr(scenario)
    for name in names_within(scenario.model_dump()):
        assert name in text
    assert "time_gap_s=4.0" in text
    assert "robots=2" in text


def test_steps_follow_from_the_periods():
    scenario = load_scenario("infinity", control_period_s=0.05, time_gap_s=0.15, preview_s=(0.1,))
    assert (scenario.substeps, scenario.horizon_steps, scenario.gap_steps) == (50, 2000, 3)
    assert scenario.preview_steps == (2,)


def test_periods_divide_in_spite_of_rounding():
    """In binary 0.06/0.006, 0.006/0.001 and 0.3/0.006 are not whole."""
    scenario = load_scenario(
        "infinity", control_period_s=0.006, time_gap_s=0.06, preview_s=(0.006,), horizon_s=0.3
    )
    assert (scenario.substeps, scenario.gap_steps, scenario.horizon_steps) == (6, 10, 50)


def test_a_base_that_needs_a_slip_estimate_says_so():
    def warned(scenario):
        return any("estimates none" in line for line in scenario_warnings(scenario))

    needs = load_scenario("infinity", action="residual", residual_base="tuned", estimator="ekf")
    assert warned(needs)
    assert warned(load_scenario(needs, action="twist"))  # it may drive the others
    assert warned(load_scenario(action="residual", estimator="ekf"))
    fields = ({"estimator": "ekf-slip"}, {"estimator": "ekf-gyro"}, {"residual_base": "consistent"})
    assert not any(warned(load_scenario(needs, **one)) for one in fields)
    assert not warned(load_scenario("infinity", estimator="ekf"))  # the default drives nothing here


# Warnings


def grip_warnings(**fields) -> list[str]:
    return scenario_warnings(load_scenario("infinity", **fields))


def test_constant_friction_warns_as_the_same_tyres_do():
    tyre = load_scenario("infinity").robot.tyre
    weak = {"mu_static": 0.2 * tyre.mu_static, "mu_dynamic": 0.2 * tyre.mu_dynamic}
    expected = grip_warnings(robot={"tyre": weak})
    assert any("static grip limit" in line for line in expected)
    for disturbance in (
        {"tyre": {"friction_scale": 0.2}},
        {"tyre": {"friction_scale": 0.6}, "level": 2.0},
        {"tyre": {"friction_scale": {"type": "constant", "value": 0.2}}},
    ):
        assert grip_warnings(disturbance=disturbance) == expected


@pytest.mark.parametrize("wheel", ["torque_gain_l", "torque_gain_r"])
def test_a_weak_motor_warns_as_a_lower_limit_does(wheel):
    expected = grip_warnings(robot={"torque_limit_Nmm": 7.5})
    assert any("N·mm of a motor, above 7.5" in line for line in expected)
    assert grip_warnings(disturbance={"actuator": {wheel: 0.5}}) == expected


@pytest.mark.parametrize(
    "disturbance",
    [
        {"tyre": {"friction_scale": 0.2}, "level": 0.0},
        {"tyre": {"friction_scale": {"type": "uniform", "low": 0.1, "high": 0.2}}},
        {"tyre": {"friction_scale": {"type": "step", "value": 0.2, "at_s": 5.0}}},
        {"actuator": {"torque_gain_l": {"type": "gaussian", "std": 0.1}}},
        {"tyre": {"friction_scale": 2.0}},
    ],
)
def test_what_is_not_constantly_weak_does_not_warn(disturbance):
    assert grip_warnings(disturbance=disturbance) == []


def test_a_motor_that_gives_nothing_is_warned_of():
    dead = {"actuator": {"torque_gain_l": 0.0, "torque_gain_r": 0.0}}
    assert any(
        "above 0 (on a straight the motors give 0" in line
        for line in grip_warnings(disturbance=dead)
    )
    (note,) = scenario_notes(load_scenario("infinity", disturbance=dead))
    assert "0 N·mm does not move the leader" in note


def test_the_start_at_speed_is_a_note_with_the_motors_that_there_are():
    (note,) = scenario_notes(load_scenario("infinity"))
    assert "starts at 559 mm/s" in note
    (weak,) = scenario_notes(
        load_scenario("infinity", disturbance={"actuator": {"torque_gain_l": 0.8}})
    )
    assert note != weak
    assert scenario_notes(load_scenario("stop_and_go")) == []


CIRCLE = {"type": "circle", "speed_mm_s": 400.0}


def sensor_lines(radius_mm: float = 1000.0, centre_x_mm: float = 0.0, **fields) -> list[str]:
    trajectory = {**CIRCLE, "radius_mm": radius_mm, "centre_x_mm": centre_x_mm}
    data = {"trajectory": trajectory, "observation": "sensor", "horizon_s": 100.0, **fields}
    return [line for line in scenario_warnings(load_scenario(data)) if "observation" in line]


@pytest.mark.parametrize("name", ["infinity", "flower", "circle", "stop_and_go"])
def test_no_preset_is_beyond_what_sensors_tell(name):
    lines = scenario_warnings(load_scenario(name, observation="sensor"))
    assert not any("observation" in line for line in lines)


def test_a_reference_beyond_the_fixes_is_told_with_its_place():
    assert sensor_lines(4900.0) == []
    (line,) = sensor_lines(5100.0)
    assert "from the start of robot_0" in line
    assert "±10000 mm" in line
    assert re.match(r"t = \d+\.\d\d s at \(-?\d+, -?\d+\) mm", line)
    assert sensor_lines(5100.0, observation="tracking") == []


def test_the_sensor_warning_is_where_the_entry_saturates():
    """The first time that is reported is the first at which an entry of a perfect fix is clipped."""
    (line,) = sensor_lines(5100.0)
    told_s = float(re.match(r"t = (\S+) s", line)[1])
    scale = SAMPLE_ENTRIES["fix_x"].scale
    trajectory = load_scenario({"trajectory": {**CIRCLE, "radius_mm": 5100.0}}).trajectory
    start, before, at = sample(trajectory, np.array([0.0, told_s - 0.02, told_s + 0.01]))[:, :2]
    assert np.abs(before - start).max() / scale < OBSERVATION_LIMIT
    assert np.abs(at - start).max() / scale > OBSERVATION_LIMIT


def test_only_robots_that_get_that_far_count():
    """A follower that sets out last is not driven as far as the leader within the horizon."""
    every = sensor_lines(5100.0, robots=2, time_gap_s=5.0)
    late = sensor_lines(5100.0, robots=2, time_gap_s=90.0)
    assert "2 robots in all" in every[0]
    assert "in all" not in late[0]


def test_a_start_beyond_the_world_is_told_with_its_place():
    assert sensor_lines(1000.0, 8900.0) == []
    (line,) = sensor_lines(1000.0, 9100.0)
    assert "robot_0 starts at (10100, 0) mm" in line
    assert "±10000 mm" in line
    (line,) = sensor_lines(1000.0, 0.0, robots=40)
    assert "robot_34 starts at (1000, -10200) mm" in line
    assert "6 robots in all" in line


def test_a_horizon_beyond_the_clock_is_warned_of():
    assert sensor_lines(horizon_s=1000.0) == []
    (line,) = sensor_lines(horizon_s=1000.02)
    assert "t = 1000 s" in line
    assert "1000.02 s" in line


def test_a_scenario_is_built_on_another(tmp_path):
    """Mappings are merged, and a file's own values come first, as keywords of `load_scenario` do."""
    path = written(
        tmp_path, "base: infinity\ntime_gap_s: 3\ntrajectory: {phase_y_rad: 1}\n", "own.yaml"
    )
    found = load_scenario(path)
    assert found == load_scenario(
        "infinity", name="own", time_gap_s=3, trajectory={"phase_y_rad": 1}
    )
    second = written(tmp_path, "base: own.yaml\nrobots: 5\n", "second.yaml")
    assert load_scenario(second) == load_scenario(found, name="second", robots=5)
    assert load_scenario({"base": "infinity", "robots": 5}) == load_scenario("infinity", robots=5)


def test_a_disturbance_is_built_on_another(tmp_path):
    more = {"slip": {"delta_1_mm_s": 40}}
    found = load_scenario("infinity", disturbance={"base": "slip", **more}).disturbance
    slip = load_scenario("infinity", disturbance="slip").disturbance
    assert found.constant("slip.delta_1_mm_s") == 40
    assert found.constant("slip.delta_2_rad_s") == slip.constant("slip.delta_2_rad_s") != 0
    assert found.position == slip.position
    written(tmp_path, "base: slip\nslip: {delta_1_mm_s: 40}\nname: slip\n", "more.yaml")
    path = written(tmp_path, "base: infinity\ndisturbance: more.yaml\n", "own.yaml")
    assert load_scenario(path).disturbance == found


def test_the_trajectory_of_another_scenario_or_of_a_path(tmp_path):
    flower = load_scenario("flower")
    assert load_scenario("infinity", trajectory="flower").trajectory == flower.trajectory
    written(tmp_path, "t_s,x_mm,y_mm\n0,0,0\n10,1000,0\n20,2000,500\n", "path.csv")
    path = written(tmp_path, "base: infinity\ntrajectory: path.csv\nhorizon_s: 20\n", "own.yaml")
    points = load_scenario(path).trajectory.points
    assert points == ((0, 0, 0), (10, 1000, 0), (20, 2000, 500))
    turned = load_scenario(
        {"base": "infinity", "trajectory": "infinity"}, trajectory={"phase_y_rad": 1}
    )
    assert turned.trajectory.phase_y_rad == 1


@pytest.mark.parametrize(
    ("data", "named"),
    [
        ({"base": 3}, "base 3 must be the name of a scenario"),
        ({"base": "infiniti"}, "did you mean 'infinity'?"),
        ({"base": "infinity", "trajectory": "flowr"}, "did you mean 'flower'?"),
        ({"base": "infinity", "disturbance": {"base": "slp"}}, "did you mean 'slip'?"),
        ({"base": "infinity", "disturbance": {"base": 3}}, "base 3 must be the name of a disturb"),
        ({"base": "infinity", "trajectory": "nowhere.csv"}, "nowhere.csv"),
    ],
)
def test_what_cannot_be_built_on_is_refused_and_named(data, named):
    assert named in refusal(data)


def test_scenarios_that_are_built_on_themselves_are_refused(tmp_path):
    path = written(tmp_path, "base: own.yaml\n", "own.yaml")
    assert "own.yaml: more than 20 of them are built on each other" in refusal(path)
    path = written(tmp_path, "trajectory: own.yaml\n", "own.yaml")
    assert "own.yaml: more than 20 scenarios name each other" in refusal(path)
