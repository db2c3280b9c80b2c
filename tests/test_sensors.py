"""Position fixes, gyro, calibration and velocity observer against closed forms and independent numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st

import tlf_env
from baselines import ReferencePolicy
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.layout import Sample
from tlf_env.onboard.slip_estimator import SlipEkfParameters, for_fixes, slip_ekf_constants
from tlf_env.onboard.speed_observer import (
    NO_OBSERVER,
    SpeedObserverState,
    WheelState,
    observed_speeds,
    observed_wheel,
    speed_observer_row,
)
from tlf_env.physics.parameters import RobotParameters, body

DT_S, PERIOD_S, SUBSTEPS = 0.001, 0.02, 20
ROBOT = RobotParameters()
R, H = ROBOT.wheel_radius_mm, ROBOT.axle_width_mm / 2


def columns(samples, *names):
    """Columns of sensor samples, (substep, name)."""
    return samples[:, [Sample._fields.index(name) for name in names]]


def sampled(seconds, action=(0.3, 0.0), *, seed=0, plant="pymunk", **overrides):
    """Samples (substep, Sample) and true states (step, State) of one robot with a constant action."""
    overrides = {"observation": "sensor"} | overrides  # so that all samples are kept
    env = tlf_env.parallel_env(
        "infinity", robots=1, plant=plant, end_on=(), preview_s=(), **overrides
    )
    env.reset(seed=seed, options={"poses": [[0.0, 0.0, 0.0]]})
    samples, states = [], [env.formation.state()[0].copy()]
    for _ in range(round(seconds / PERIOD_S)):
        env.step({"robot_0": np.array(action, dtype=np.float32)})
        samples.append(env.formation.arrays.samples[:, :, 0, 0].copy())
        states.append(env.formation.state()[0].copy())
    return np.concatenate(samples), np.array(states), env.formation


# --- position fixes --------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 7, 10, 33])
def test_fixes_come_at_their_rate_and_hold_in_between(every):
    samples, _, _ = sampled(0.5, disturbance={"position": {"period_s": every * DT_S}})
    fixes, has = columns(samples, "fix_x", "fix_y"), columns(samples, "has_fix")[:, 0]
    ticks = 1 + np.arange(len(has))
    assert (has == (ticks % every == 0)).all()
    every_tick, _, _ = sampled(0.5, disturbance={"position": {"period_s": 0.0}})
    # The first fix is that of the nominal run; later ones differ as the robot does not.
    assert (fixes[every - 1] == columns(every_tick, "fix_x", "fix_y")[every - 1]).all()
    held = ticks % every != 0
    held[: every - 1] = False
    held[0] = False
    before = np.roll(fixes, 1, axis=0)
    assert (fixes[held] == before[held]).all()
    assert (fixes[: every - 1] == 0.0).all()  # the start pose stands for the last fix


def test_a_fix_that_comes_late_is_the_one_of_its_own_time():
    delay = 30
    late, _, _ = sampled(0.5, disturbance={"position": {"delay_s": delay * DT_S}})
    at_once, _, _ = sampled(0.5)
    has = columns(late, "has_fix")[:, 0]
    assert (has == (np.arange(len(has)) >= delay)).all()
    assert columns(late, "fix_age") == pytest.approx(delay * DT_S)
    assert (columns(at_once, "fix_age") == 0.0).all()
    found, true = columns(late, "fix_x", "fix_y"), columns(at_once, "fix_x", "fix_y")
    # A twist of the wheels without feedback: both runs are the same.
    assert (found[delay:] == true[:-delay]).all()


@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip", "ekf-gyro"])
def test_late_fixes_without_noise_cost_a_moving_robot_nothing(estimator):
    """Fixes of 50 ms ago at 300 mm/s are 15 mm behind; filters move them on."""
    for every, delay in ((1, 50), (10, 45)):
        position = {"noise_std_mm": 0.0, "period_s": every * DT_S, "delay_s": delay * DT_S}
        _, states, formation = sampled(
            4.0, (0.3, 0.05), estimator=estimator, disturbance={"position": position}
        )
        estimate = formation.named("estimate")
        error = math.hypot(estimate.x[0] - states[-1, 0], estimate.y[0] - states[-1, 1])
        assert error < 0.3


@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip", "ekf-gyro"])
def test_without_fixes_the_filter_is_odometry(estimator):
    samples, _, formation = sampled(
        2.0, (0.3, 0.1), estimator=estimator, disturbance={"position": {"outage": 1.0}}
    )
    assert (columns(samples, "has_fix") == 0.0).all()
    x = y = theta = 0.0
    for left, right in columns(samples, "step_l", "step_r"):
        forward, turn = R * (left + right) / 2, R * (right - left) / (2 * H)
        x -= forward * math.sin(theta + turn / 2)
        y += forward * math.cos(theta + turn / 2)
        theta += turn
    estimate = formation.named("estimate")
    if estimator == "ekf":
        found = (estimate.x[0], estimate.y[0], estimate.theta[0])
        assert found == pytest.approx((x, y, theta), abs=1e-9)
    assert estimate.p_xx[0] > 0.01  # uncertainty grows
    assert formation.info().innovation_nis[0] == 0.0


def test_an_outage_is_a_window_without_fixes():
    outage = {"type": "impulse", "value": 1.0, "at_s": 0.25, "duration_s": 0.125}
    samples, _, _ = sampled(0.5, disturbance={"position": {"outage": outage}})
    has = columns(samples, "has_fix")[:, 0]
    # The channel of a substep is evaluated at its beginning, the fix is measured at its end.
    assert (np.flatnonzero(has == 0.0) == np.arange(250, 375)).all()


def test_fixes_are_lost_and_far_off_as_often_as_given():
    position = {"outage": 0.3, "outlier_share": 0.1, "outlier_std_mm": 50.0, "noise_std_mm": 0.0}
    samples, states, _ = sampled(10.0, (0.0, 0.0), disturbance={"position": position})
    has = columns(samples, "has_fix")[:, 0] > 0.0
    n = len(has)
    assert has.mean() == pytest.approx(0.7, abs=4 * math.sqrt(0.21 / n))
    errors = columns(samples, "fix_x", "fix_y")[has] - states[-1, :2]
    far = np.abs(errors).max(axis=1) > 1e-6
    assert far.mean() == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / has.sum()))
    assert errors[far].std() == pytest.approx(50.0, rel=4 / math.sqrt(2 * 2 * far.sum()))
    # Whether a fix is lost does not depend on whether it is an outlier.
    plain, _, _ = sampled(10.0, (0.0, 0.0), disturbance={"position": {"outage": 0.3}})
    assert (columns(plain, "has_fix") == columns(samples, "has_fix")).all()


def test_a_batch_has_the_same_fixes_as_a_formation():
    position = {
        "period_s": {"type": "uniform", "low": 0.005, "high": 0.03},
        "delay_s": {"type": "uniform", "low": 0.0, "high": 0.05},
        "outage": 0.2,
        "outlier_share": 0.05,
        "outlier_std_mm": 20.0,
    }
    disturbance = {
        "position": position,
        "gyro": {"bias_rad_s": {"type": "random_walk", "per_sqrt_s": 0.01}},
        "calibration": {"track": {"type": "uniform", "low": 0.98, "high": 1.02}},
        "encoder": {"quantum_rad": 2 * math.pi / 4096},
    }
    given = {
        "estimator": "ekf-slip",
        "disturbance": disturbance,
        "end_on": (),
        "wheel_loop": {"speed_observer_rad_s": 80.0},
    }
    formations = 3
    batch = BatchPlant("infinity", formations, **given)
    batch.reset(seed=5)
    singles = []
    for k in range(formations):
        env = tlf_env.parallel_env("infinity", **given)
        env.reset(seed=5 + k)
        singles.append(env)
    policy = ReferencePolicy("tuned")
    for _ in range(40):
        actions = policy.predict(batch.observations.reshape(-1, batch.observations.shape[-1]))[0]
        actions = actions.reshape(formations, 3, 2)
        for env, row in zip(singles, actions, strict=True):
            env.step(dict(zip(env.agents, row, strict=True)))
        batch.step(actions)
    for k, env in enumerate(singles):
        single = env.formation.arrays
        assert (batch.arrays.samples[:, :, :, k] == single.samples[:, :, :, 0]).all()
        for name in ("estimate", "slip", "sensors", "observed_speed", "motion"):
            assert (batch.arrays.rows(name)[:, :, k] == single.rows(name)[:, :, 0]).all()


@untimed
@given(st.integers(1, 200))
def test_means_over_fixes_last_as_long_at_every_rate(every):
    """The exponential means of the innovations forget as much in a second at any rate of fixes."""
    ekf = slip_ekf_constants(SlipEkfParameters(), DT_S)
    changed = for_fixes(ekf, every)
    for name in ("mean_weight", "variance_weight"):
        once = math.log1p(-getattr(ekf, name)) * every
        assert math.log1p(-getattr(changed, name)) == pytest.approx(once)
    # The threshold is the given multiple of the variance of such a mean, a/(2 − a).
    share = changed.mean_weight / (2 - changed.mean_weight)
    wanted = SlipEkfParameters().surprise_threshold
    assert changed.threshold / share == pytest.approx(wanted)
    assert for_fixes(ekf, 1) == ekf


# --- gyro ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", ["pymunk", "kinematic", "chipmunk"])
def test_an_ideal_gyro_reads_the_yaw_rate(plant):
    samples, states, _ = sampled(1.0, (0.2, 0.2), plant=plant)
    turned = np.diff(np.unwrap(np.arctan2(states[:, 2], states[:, 3])))
    read = columns(samples, "gyro")[:, 0].reshape(-1, SUBSTEPS).mean(axis=1) * PERIOD_S
    assert read == pytest.approx(turned, abs=1e-4)
    assert np.abs(read).max() > 0.01


def test_scale_and_bias_of_the_gyro():
    ideal, _, _ = sampled(0.5, (0.2, 0.2))
    changed, _, _ = sampled(
        0.5, (0.2, 0.2), disturbance={"gyro": {"scale": 1.05, "bias_rad_s": 0.02}}
    )
    assert columns(changed, "gyro") == pytest.approx(1.05 * columns(ideal, "gyro") + 0.02)


def allan_deviation(rates, taus):
    """Allan deviation of rates (rad/s) sampled every DT_S, over windows of ``taus`` (s)."""
    angle = np.concatenate([[0.0], np.cumsum(rates) * DT_S])
    out = []
    for tau in taus:
        m = round(tau / DT_S)
        second = angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]
        out.append(math.sqrt((second**2).mean() / (2 * tau**2)))
    return np.array(out)


def test_allan_deviation_of_the_gyro():
    """White noise N falls as N/√τ; a bias that walks with K per √s rises as K √(τ/3) (IEEE Std 952)."""
    taus = np.array([0.01, 0.03, 0.1, 0.3])
    white, _, _ = sampled(
        60.0, (0.0, 0.0), plant="kinematic", disturbance={"gyro": {"noise_rad_s_sqrt_hz": 1e-3}}
    )
    found = allan_deviation(columns(white, "gyro")[:, 0], taus)
    # Relative standard error of an Allan deviation over n windows: about 1/√n.
    assert found == pytest.approx(1e-3 / np.sqrt(taus), rel=4 / math.sqrt(60.0 / 0.3))
    walk = {"type": "random_walk", "per_sqrt_s": 1e-2}
    walking, _, _ = sampled(
        60.0, (0.0, 0.0), plant="kinematic", disturbance={"gyro": {"bias_rad_s": walk}}
    )
    found = allan_deviation(columns(walking, "gyro")[:, 0], taus)
    assert found == pytest.approx(1e-2 * np.sqrt(taus / 3), rel=4 / math.sqrt(60.0 / 0.3))


def test_a_random_walk_spreads_with_the_root_of_time():
    walk = {"type": "random_walk", "per_sqrt_s": 2.0, "start": 3.0}
    batch = BatchPlant(
        "infinity", 300, disturbance={"position": {"bias_x_mm": walk}}, plant="batch"
    )
    batch.reset(seed=1)
    idle = np.zeros((300, 3, 2), dtype=np.float32)
    for seconds in (1.0, 4.0):
        while batch.arrays.clock[0, 1] < seconds / PERIOD_S:
            batch.step(idle)
        values = batch.info("position_bias_x_mm").ravel()
        n = values.size
        assert values.mean() == pytest.approx(3.0, abs=4 * 2 * math.sqrt(seconds / n))
        assert values.std() == pytest.approx(2 * math.sqrt(seconds), rel=4 / math.sqrt(2 * n))


# --- calibration -----------------------------------------------------------------------------------


def test_a_wrong_radius_turns_a_straight_line():
    """A left wheel that is believed 1 % larger is commanded slower: yaw rate u₁ (1 − 1/1.01)/L.

    The filter has no gyro, which would show it.
    """
    error = {"calibration": {"radius_left": 1.01}, "position": {"outage": 1.0}}
    _, states, formation = sampled(
        2.0, (0.3, 0.0), plant="kinematic", estimator="ekf", disturbance=error
    )
    rate = 300.0 * (1 - 1 / 1.01) / (2 * H)
    assert states[-1, 7] == pytest.approx(rate)
    # The robot believes that it drives straight on.
    estimate = formation.named("estimate")
    assert (estimate.x[0], estimate.theta[0]) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert estimate.y[0] == pytest.approx(600.0, abs=7.0)


def test_a_wrong_track_turns_by_its_factor():
    error = {"calibration": {"track": 1.02}, "position": {"outage": 1.0}}
    _, states, formation = sampled(
        1.0, (0.0, 0.1), plant="kinematic", estimator="ekf", disturbance=error
    )
    assert states[-1, 7] == pytest.approx(0.8 * 1.02)
    theta = formation.named("estimate").theta[0]
    true = math.atan2(states[-1, 2], states[-1, 3])
    assert theta * 1.02 == pytest.approx(true)


def test_calibration_is_anew_in_every_episode():
    """Errors are drawn for each episode, and do not add up over resets."""
    disturbance = {"calibration": {"track": 1.02}}
    env = tlf_env.parallel_env("infinity", disturbance=disturbance)
    for seed in (0, 1, 2):
        env.reset(seed=seed)
        assert env.formation.named("belief").h == pytest.approx(1.02 * H)


# --- velocity observer -----------------------------------------------------------------------------


def followed(row, angles, known):
    wheel, speeds = WheelState(0.0, 0.0, 0.0), []
    for angle, rate in zip(angles, known, strict=True):
        wheel = observed_wheel(wheel, angle, rate, row, DT_S)
        speeds.append(wheel.speed)
    return np.array(speeds)


@pytest.mark.parametrize("bandwidth_rad_s", [20.0, 80.0, 300.0])
def test_the_observer_follows_an_unknown_steady_acceleration(bandwidth_rad_s):
    row = speed_observer_row(bandwidth_rad_s, body(ROBOT), DT_S)
    t = DT_S * np.arange(1, 2001)
    speeds = followed(row, 0.5 * 6.0 * t**2, np.zeros(2000))
    settled = round(15.0 / bandwidth_rad_s / DT_S)
    assert speeds[settled:] == pytest.approx(6.0 * t[settled:], abs=0.01)
    # Three poles at exp(−ω dt): an error has decayed to a small part after 15/ω, not much earlier.
    early = round(1.0 / bandwidth_rad_s / DT_S)
    assert abs(speeds[early] - 6.0 * t[early]) > 0.1 * 6.0 * t[early]


def test_known_torques_cost_no_lag():
    row = speed_observer_row(80.0, body(ROBOT), DT_S)
    t = DT_S * np.arange(0, 2001)
    rates = 30.0 * np.sin(20.0 * t[1:])  # constant within a period
    speed = np.concatenate([[0.0], np.cumsum(rates) * DT_S])
    angle = np.cumsum(DT_S * speed[:-1] + 0.5 * DT_S**2 * rates)
    known, unknown = followed(row, angle, rates), followed(row, angle, np.zeros(2000))
    assert known == pytest.approx(speed[1:], abs=1e-9)
    assert np.abs(unknown - speed[1:]).max() > 0.05


def test_each_wheel_turns_as_both_torques_on_a_rolling_robot_say():
    """Newton's and Euler's laws about the axle's midpoint; from an exact start nothing is to be corrected."""
    rng = np.random.default_rng(0)
    robot, row = body(ROBOT), speed_observer_row(80.0, body(ROBOT), DT_S)
    radius, half = ROBOT.wheel_radius_mm, ROBOT.axle_width_mm / 2
    spin = ROBOT.wheel_inertia_kg_mm2 / radius**2
    mass = ROBOT.mass_kg + 2 * spin
    inertia = (
        ROBOT.body_inertia_kg_mm2 + ROBOT.mass_kg * ROBOT.com_offset_mm**2 + 2 * spin * half**2
    )
    assert robot.m == ROBOT.mass_kg
    state, angles, speeds = SpeedObserverState(*[0.0] * 6), np.zeros(2), np.zeros(2)
    for left, right in rng.uniform(-5e3, 15e3, (200, 2)):
        forward = (left + right) / radius / mass
        turning = half * (right - left) / radius / inertia
        rates = np.array([forward - half * turning, forward + half * turning]) / radius
        angles += DT_S * speeds + 0.5 * DT_S**2 * rates
        speeds += DT_S * rates
        state = observed_speeds(state, *angles, left, right, row, DT_S)
    assert np.abs(speeds).min() > 0.5
    assert (state.angle_l, state.angle_r) == pytest.approx(tuple(angles))
    assert (state.speed_l, state.speed_r) == pytest.approx(tuple(speeds))
    assert (state.acceleration_l, state.acceleration_r) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_the_model_of_the_observer_is_the_plants():
    """Accelerations per torque of a robot whose joints do not rub, against the plant."""
    row = speed_observer_row(80.0, body(ROBOT), DT_S)
    env = tlf_env.parallel_env(
        "infinity",
        robots=1,
        action="torque",
        preview_s=(),
        robot={"joint_friction": False},
        end_on=(),
    )
    for torques, expected in (
        ((3.0, 3.0), row.own + row.other),
        ((-2.0, 2.0), row.own - row.other),
    ):
        env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
        for _ in range(5):
            env.step({"robot_0": np.array(torques, dtype=np.float32) / 15.0})
        right = env.formation.named("motion").omega_r[0] / 0.1
        # The observer leaves out the castor.
        assert right == pytest.approx(1000.0 * torques[1] * expected, rel=0.1)


def test_quantised_readings_become_smooth_speeds():
    """4096 counts at 1 ms: differences are whole steps of 1.53 rad/s, the observer's error is far below."""
    quantum = 2 * math.pi / 4096
    row = speed_observer_row(80.0, body(ROBOT), DT_S)
    t = DT_S * np.arange(1, 4001)
    angles = 7.3 * t
    readings = quantum * np.floor(angles / quantum)
    differences = np.diff(readings) / DT_S
    assert np.abs(differences - 7.3).max() > 0.5
    speeds = followed(row, readings, np.zeros(4000))[500:]
    assert np.abs(speeds - 7.3).max() < 0.05


def test_without_observer_nothing_is_observed():
    assert speed_observer_row(None, body(ROBOT), DT_S) == NO_OBSERVER
    _, _, formation = sampled(0.2)
    assert (formation.arrays.rows("observed_speed") == 0.0).all()
    sensors = formation.named("sensors")
    steps = columns(formation.arrays.samples[:, :, 0, 0], "step_l", "step_r")[-1]
    assert (sensors.speed_l[0], sensors.speed_r[0]) == pytest.approx(tuple(steps / DT_S))


@pytest.mark.parametrize(
    "given",
    [
        {
            "wheel_loop": {"speed_observer_rad_s": 80.0},
            "disturbance": {"encoder": {"quantum_rad": 2 * math.pi / 4096}},
        },
        {"disturbance": {"position": {"period_s": 0.01}}},
    ],
    ids=["4096 counts", "fixes at 100 Hz"],
)
def test_the_reference_holds_the_path_with_sensors_of_real_robots(given):
    """60 s of the ∞ from 100 seeds: none lost, and the worst robot's RMS from 24 s on below 3 mm."""
    formations = 100
    batch = BatchPlant("infinity", formations, estimator="ekf-slip", horizon_s=60.0, **given)
    batch.reset(seed=30000)
    policy = ReferencePolicy("tuned")
    errors = []
    for k in range(3000):
        rows = batch.observations.reshape(3 * formations, -1)
        batch.step(policy.predict(rows)[0].reshape(formations, 3, 2))
        if k >= 1200:
            errors.append(batch.info("position_error_mm").copy())
    assert not batch.info("lost").any()
    assert not batch.info("touched").any()
    assert np.sqrt((np.array(errors) ** 2).mean(axis=0)).max() < 3.0
