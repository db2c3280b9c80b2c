"""What sets the channels: an adversary, scenarios and presets, and the page that describes them."""

import math
import re

import numpy as np
import pytest
import yaml
from disturbance_helpers import DOCS, GAP_S, NEEDS, ONE_LINE, SHOWS, environment, rest, run, tree

from baselines import ReferencePolicy
from tlf_env.common.presets import preset_names, presets_folder
from tlf_env.disturbances.channels import (
    CHANNELS,
    PATHS,
    SET_WITHIN_EPISODE,
)
from tlf_env.disturbances.model import Disturbance
from tlf_env.disturbances.table import renewed, row, unit
from tlf_env.envs.parallel import parallel_env
from tlf_env.task.scenario import load_scenario

# --- adversary -------------------------------------------------------------------------------------


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
            found, base = (
                {one.path: info[agent][one.key] for one in CHANNELS} for info in (infos, free)
            )
            if k == 3:
                assert found == base
            else:
                assert found == base | {
                    "slip.delta_1_mm_s": 10.0 * k,
                    "radio.dropout": (0.1, 0.2, 0.3)[i],
                }


@pytest.mark.parametrize("path", SET_WITHIN_EPISODE)
def test_an_adversary_does_what_the_channel_does(path):
    beside = NEEDS.get(path, {})
    imposed = parallel_env(
        "infinity",
        adversary=lambda env: beside | {path: SHOWS[path]},
        end_on=(),
        time_gap_s=GAP_S,
    )
    policy = ReferencePolicy()
    seen, _ = imposed.reset(seed=0)
    for _ in range(150):
        seen = imposed.step({agent: policy.predict(row)[0] for agent, row in seen.items()})[0]
    # the first message and the first previews are out before the first step
    apart = 0.0 if not path.startswith("radio.") else 20.0
    same = run({**beside, path: SHOWS[path]}, seconds=3.0, horizon_s=100.0)
    assert imposed.formation.state() == pytest.approx(same.formation.state(), abs=apart)
    assert (same.formation.state() != run(seconds=3.0, horizon_s=100.0).formation.state()).any()


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
        ({"slip.delta_1_mm_s": True}, ["slip.delta_1_mm_s", "True"]),
        ({"slip.delta_1_mm_s": [1.0, True, 2.0]}, ["slip.delta_1_mm_s", "True"]),
        ({"slip.delta_1_mm_s": np.ones(3, dtype=bool)}, ["slip.delta_1_mm_s", "True"]),
        (5, ["adversary", "mapping", "got 5"]),
        (None, ["adversary", "mapping", "got None"]),
        ([("slip.delta_1_mm_s", 1.0)], ["adversary", "mapping", "got [("]),
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


MOTOR = {
    "actuator.back_emf_s_rad": 0.0212,
    "actuator.stall_torque": 1.89,
    "actuator.current_limit": uniform(0.9, 1.1),
    "actuator.dead_band_Nmm": 1.67,
}
MOTION_CAPTURE = {
    "position.period_s": 0.01,
    "position.delay_s": 0.01,
    "position.noise_std_mm": 0.1,
    "position.outage": 0.0034,
}
GYRO = {
    "gyro.noise_rad_s_sqrt_hz": 8.73e-5,
    "gyro.bias_rad_s": {"type": "random_walk", "per_sqrt_s": 4.94e-6},
    "gyro.scale": uniform(0.97, 1.03),
}
CALIBRATION = {
    "calibration.radius_left": uniform(0.993, 1.007),
    "calibration.radius_right": uniform(0.993, 1.007),
    "calibration.track": uniform(0.98, 1.02),
}
PRESETS = {
    "nominal": {},
    "none": {"position.noise_std_mm": 0},
    "noise": {"position.noise_std_mm": 2},
    "slip": {
        "slip.delta_1_mm_s": uniform(-60, 60, 3),
        "slip.delta_2_rad_s": uniform(-0.4, 0.4, 3),
    },
    "slip-ramps": {
        "slip.delta_1_mm_s": uniform(-60, 60, 3) | {"ramp_s": 0.2},
        "slip.delta_2_rad_s": uniform(-0.4, 0.4, 3) | {"ramp_s": 0.2},
    },
    "slip-noise": {
        "slip.delta_1_mm_s": {"type": "band_limited", "std": 30, "correlation_s": 0.5},
        "slip.delta_2_rad_s": {"type": "band_limited", "std": 0.2, "correlation_s": 0.5},
    },
    "slip-sines": {
        "slip.delta_1_mm_s": {
            "type": "sine",
            "amplitude": 40,
            "frequency_hz": 0.3,
            "random_phase": True,
        },
        "slip.delta_2_rad_s": {
            "type": "sine",
            "amplitude": 0.25,
            "frequency_hz": 0.41,
            "random_phase": True,
        },
    },
    "ice": {"tyre.friction_scale": 0.5},
    "split-ice": {"tyre.friction_left": 0.6},
    "split-ice-right": {"tyre.friction_right": 0.6},
    "patches": {},
    "creep": {"tyre.creep": 0.1},
    "rolling": {"floor.rolling_resistance": 0.004},
    "slope": {"floor.slope_rad": 0.005},
    "pushes": {
        "push.x_N": {"type": "band_limited", "std": 0.03, "correlation_s": 0.5},
        "push.y_N": {"type": "band_limited", "std": 0.03, "correlation_s": 0.5},
        "push.torque_Nmm": {"type": "band_limited", "std": 2, "correlation_s": 0.5},
    },
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
    "motor": MOTOR,
    "encoders-4096": {"encoder.quantum_rad": 2 * math.pi / 4096},
    "encoders-1024": {"encoder.quantum_rad": 2 * math.pi / 1024},
    "fixes-100hz": MOTION_CAPTURE,
    "fixes-camera": {
        "position.period_s": 0.033,
        "position.delay_s": 0.05,
        "position.noise_std_mm": 1,
    },
    "fixes-uwb": {
        "position.period_s": 0.1,
        "position.delay_s": 0.3,
        "position.noise_std_mm": 31,
        "position.bias_x_mm": {"type": "ornstein_uhlenbeck", "std": 134, "time_constant_s": 1.5},
        "position.bias_y_mm": {"type": "ornstein_uhlenbeck", "std": 134, "time_constant_s": 1.5},
        "position.outlier_share": 0.034,
        "position.outlier_std_mm": 90,
    },
    "fixes-outage": {
        "position.outage": {"type": "pulses", "value": 1, "every_s": 20, "duration_s": 1}
    },
    "gyro": GYRO,
    "calibration": CALIBRATION,
    "hardware": MOTOR
    | MOTION_CAPTURE
    | GYRO
    | CALIBRATION
    | {"encoder.quantum_rad": 2 * math.pi / 4096},
}


# x_mm, y_mm, radius_mm and friction_scale of the presets with patches
PATCHES = {
    "patches": [
        (4495.0, 2782.0, 250.0, 0.4),
        (4056.0, 545.0, 250.0, 0.4),
        (986.0, 4479.0, 250.0, 0.4),
        (582.0, 1412.0, 250.0, 0.4),
    ]
}


def test_presets_are_those_of_the_folder():
    assert sorted(PRESETS) == preset_names("disturbance")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_hold_their_numbers_and_nothing_else(name):
    found = load_scenario(disturbance=name).disturbance
    assert found.name == name
    assert found.level == 1
    assert [tuple(patch.model_dump().values()) for patch in found.tyre.patches] == PATCHES.get(
        name, []
    )
    expected = Disturbance.model_validate({"name": name, **tree(PRESETS[name])})
    for path in PATHS:
        one, other = (d.signal(path).model_dump() for d in (found, expected))
        assert one["type"] == other["type"]
        assert {k: v for k, v in one.items() if v != other[k]} == pytest.approx(
            {k: other[k] for k, v in one.items() if v != other[k]}
        )


@pytest.mark.parametrize(
    "name",
    [
        *("payload", "radio", "actuator", "motor", "encoders-4096", "encoders-1024"),
        *("fixes-100hz", "fixes-camera", "fixes-uwb", "gyro", "calibration"),
        *("rolling", "slope"),
    ],
)
def test_chosen_numbers_name_their_source(name):
    text = (presets_folder("disturbance") / f"{name}.yaml").read_text(encoding="utf-8")
    assert "Source" in text
    assert yaml.safe_load(text)


ROUNDING = 1e-12


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run_and_tell_what_acted(name):
    env = environment(disturbance=name)
    infos = env.step(rest(env))[4]
    disturbance = load_scenario(disturbance=name).disturbance
    for agent in env.agents:
        for channel in CHANNELS:
            value = infos[agent][channel.key]
            signal = disturbance.signal(channel.path)
            low, high = signal.reach()
            if signal.type == "random_walk":  # it has no reach, only the channel's range
                low, high = channel.limits
            assert low - ROUNDING <= value <= high + ROUNDING


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
        r"^\| `([a-z0-9-]+)` \| [^|]+ \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE
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
        assert env.step(rest(env))[4]["robot_0"]["slip_delta_1_mm_s"] == 20.0
