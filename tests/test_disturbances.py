"""What every channel has in common: its level, its random stream, and what it leaves alone."""

import functools
import math

import numpy as np
import pytest
from disturbance_helpers import (
    ANGLES,
    NEEDS,
    ROBOT,
    SHOWS,
    Run,
    make,
    nominal,
    random_signal,
    run,
)
from helpers import PAPERS

from tlf_env.common.presets import preset_names
from tlf_env.disturbances.channels import (
    CHANNELS,
    CONTROL_STEP,
    PATHS,
    SET_WITHIN_EPISODE,
    SUBSTEP,
    number,
    numbers,
)
from tlf_env.engine.batch import BatchPlant

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
    beside = NEEDS.get(path, {})
    before = run(beside) if beside else nominal()
    after = run({**beside, path: SHOWS[path]})
    assert (after.motion[-1] != before.motion[-1]).any()
    assert (after.gyro != before.gyro).any()
    assert (after.applied[:, :, number(path)] == SHOWS[path]).all()


@pytest.mark.parametrize("path", [path for path in PATHS if path.startswith("gyro.")])
def test_the_papers_filter_does_not_read_the_gyro(path):
    before, after = (run(channels, **PAPERS) for channels in ({}, {path: SHOWS[path]}))
    assert (after.gyro != before.gyro).any()
    assert (after.motion == before.motion).all()


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
    "slip.left_mm_s": (119, 0.0),
    "slip.right_mm_s": (120, 0.0),
    "tyre.friction_left": (121, 1.0),
    "tyre.friction_right": (122, 1.0),
    "tyre.creep": (123, 0.0),
    "floor.rolling_resistance": (124, 0.0),
    "floor.slope_rad": (125, 0.0),
    "floor.uphill_rad": (126, 0.0),
    "push.x_N": (127, 0.0),
    "push.y_N": (128, 0.0),
    "push.torque_Nmm": (129, 0.0),
    "actuator.back_emf_s_rad": (130, 0.0),
    "actuator.dead_band_Nmm": (131, 0.0),
    "actuator.current_limit": (132, 1.0),
    "actuator.stall_torque": (144, 1.0),
    "position.period_s": (133, 0.0),
    "position.delay_s": (134, 0.0),
    "position.outage": (135, 0.0),
    "position.outlier_share": (136, 0.0),
    "position.outlier_std_mm": (137, 0.0),
    "gyro.bias_rad_s": (138, 0.0),
    "gyro.scale": (139, 1.0),
    "gyro.noise_rad_s_sqrt_hz": (140, 0.0),
    "calibration.radius_left": (141, 1.0),
    "calibration.radius_right": (142, 1.0),
    "calibration.track": (143, 1.0),
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
