"""The filter with gyro and torques: analytic limits of its laws, and what it finds in closed loop."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from baselines import ReferencePolicy
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from tlf_env import load_scenario, parallel_env
from tlf_env.onboard.controllers import ControllerFile
from tlf_env.onboard.estimator import Estimate
from tlf_env.onboard.gyro_estimator import (
    ACCELERATION_TIME_S,
    GyroEkfParameters,
    GyroEstimate,
    correct_with_gyro,
    drag_mm_s2,
    gyro_ekf_constants,
    predict_with_gyro,
    quietness,
    reported_slip,
)
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.physics.vehicle import RobotParameters, body

DT_S = 0.001
ROBOT = RobotParameters()
BODY = body(ROBOT)
REST = GyroEstimate(*(0.0 for _ in GyroEstimate._fields))
START = Estimate(0.0, 0.0, 0.0, *(0.0 for _ in range(6)))


def advanced(
    samples: int,
    *,
    u_1: float = 0.0,
    u_2: float = 0.0,
    rate: float = 0.0,
    torque: float = 0.0,
    fixes: Any = None,
    **parameters: Any,
) -> tuple[Estimate, GyroEstimate, tuple[float, float]]:
    """Pose, errors and slip after some samples, without fixes or with ``fixes(t_s)``; all slip is reported."""
    given = {"floor_slip_acceleration_mm_s2": None} | parameters
    ekf = gyro_ekf_constants(GyroEkfParameters(**given), BODY, DT_S)
    estimate, found = START, REST
    for k in range(samples):
        estimate, found = predict_with_gyro(estimate, found, ekf, u_1, rate, torque, DT_S)
        x, y = (0.0, 0.0) if fixes is None else fixes((k + 1) * DT_S)
        here = 0.0 if fixes is None else 1.0
        estimate, found, *_ = correct_with_gyro(estimate, found, ekf, x, y, here, u_2, rate, DT_S)
    return estimate, found, reported_slip(found, ekf)


def test_without_torques_and_fixes_the_speed_is_that_of_the_encoders_and_the_turn_the_gyros():
    estimate, _, slip = advanced(1000, u_1=0.3, u_2=4e-4, rate=0.5, torque=1e5, torque_time_s=None)
    assert estimate.theta == pytest.approx(0.5, rel=1e-9)
    radius = 300.0 / 0.5  # of the circle
    assert estimate.x == pytest.approx(-radius * (1.0 - math.cos(0.5)), rel=1e-6)
    assert estimate.y == pytest.approx(radius * math.sin(0.5), rel=1e-6)
    assert slip[0] == 0.0
    assert slip[1] == pytest.approx(0.5 - 0.4, rel=1e-9)


def test_a_torque_accelerates_the_body_by_newtons_law_whatever_the_wheels_do():
    """Wheels that turn evenly on a floor that moves: the encoders see no acceleration, the torques do."""
    torque, time_s, tau_s, speed = 20_000.0, 0.05, 2.0, 100.0  # mN·mm in all
    rolling = REST._replace(rolled=speed * DT_S, advance=speed * DT_S)
    ekf = gyro_ekf_constants(GyroEkfParameters(torque_time_s=tau_s), BODY, DT_S)
    estimate, found = START, rolling
    for _ in range(round(time_s / DT_S)):
        estimate, found = predict_with_gyro(estimate, found, ekf, speed * DT_S, 0.0, torque, DT_S)
    gained = torque / (ROBOT.wheel_radius_mm * ROBOT.mass_kg) - drag_mm_s2(BODY)
    expected = speed + gained * tau_s * (1.0 - math.exp(-time_s / tau_s))
    assert found.advance / DT_S == pytest.approx(expected, rel=2e-3)


def test_the_drag_is_that_of_a_robot_that_rolls_straight_ahead():
    """Newton's law on a simulated run: what is left of the torques is the friction of the joints."""
    env = parallel_env("infinity", robots=1, disturbance="none", horizon_s=20.0, estimator="truth")
    policy, rows = ReferencePolicy("tuned"), []
    seen, _ = env.reset(seed=0)
    while env.agents:
        actions = policy.predict(np.stack(list(seen.values())))[0]
        seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        trace = env.formation.named("trace")
        rows.append([float(trace.torque_l[0] + trace.torque_r[0]), float(trace.distance[0])])
    period_s, substeps = 0.02, 20
    torque = np.array(rows)[:, 0] / substeps
    speed = np.array(rows)[:, 1] / period_s
    mass = ROBOT.mass_kg + 2.0 * BODY.spin_mass_drive
    dragged = torque[1:] / ROBOT.wheel_radius_mm - mass * np.diff(speed) / period_s
    found = np.median(dragged[250:]) / ROBOT.mass_kg
    assert (
        drag_mm_s2(BODY) < found < 1.1 * drag_mm_s2(BODY)
    )  # in curves joints carry lateral forces, too


def test_wheels_that_stand_say_that_the_robot_stands():
    """Their joints may hold against any torque within their friction."""
    _, found, slip = advanced(1000, torque=5000.0)
    assert found.advance == 0.0
    assert slip == (0.0, 0.0)


def test_the_speed_returns_to_that_of_the_encoders():
    torque = drag_mm_s2(BODY) * ROBOT.mass_kg * ROBOT.wheel_radius_mm
    _, found, slip = advanced(12000, u_1=0.4, torque=torque)
    assert found.advance == pytest.approx(0.4, rel=1e-3)
    assert slip[0] == pytest.approx(0.0, abs=0.05)


def test_a_constant_error_of_the_gyro_is_found_from_the_fixes():
    bias, speed = 0.05, 400.0

    def straight(t_s: float) -> tuple[float, float]:
        return 0.0, speed * t_s

    estimate, found, slip = advanced(
        8000, u_1=speed * DT_S, rate=bias, fixes=straight, torque_time_s=None, gyro_scale_std=0.0
    )
    assert found.gyro_error == pytest.approx(-bias, abs=1e-3)
    assert found.scale_error == 0.0
    assert slip[1] == pytest.approx(0.0, abs=1e-3)
    assert estimate.theta == pytest.approx(0.0, abs=2e-3)


def test_a_wrong_scale_of_the_gyro_is_found_where_the_robot_turns_both_ways():
    """Bias and scale cannot be distinguished at one yaw rate; at two they can."""
    scale, speed, rate, turn_s = 1.03, 400.0, 0.8, 2.0
    ekf = gyro_ekf_constants(GyroEkfParameters(torque_time_s=None), BODY, DT_S)
    estimate, found = START, REST
    x = y = theta = 0.0
    for k in range(16000):
        w = rate if (k * DT_S // turn_s) % 2 == 0 else -rate
        middle = theta + 0.5 * w * DT_S
        x, y = x - speed * DT_S * math.sin(middle), y + speed * DT_S * math.cos(middle)
        theta += w * DT_S
        given = scale * w
        estimate, found = predict_with_gyro(estimate, found, ekf, speed * DT_S, given, 0.0, DT_S)
        estimate, found, *_ = correct_with_gyro(
            estimate, found, ekf, x, y, 1.0, w * DT_S, given, DT_S
        )
    assert (1.0 + found.scale_error) * scale == pytest.approx(1.0, abs=2e-3)
    assert found.gyro_error == pytest.approx(0.0, abs=2e-3)
    assert estimate.theta == pytest.approx(theta, abs=1e-3)


@pytest.mark.parametrize("noise_mm", [0.3, 1.0])
def test_the_variance_of_the_fixes_is_found_from_their_scatter(noise_mm):
    """Where the robot stands, whatever the variance at the start; errors that stay do not count."""
    rng = np.random.default_rng(5)
    fixes = rng.normal((40.0, -20.0), noise_mm, size=(4000, 2))
    ekf = gyro_ekf_constants(GyroEkfParameters(outlier_threshold=None), BODY, DT_S)
    estimate, found = START._replace(x=40.0, y=-20.0), REST
    levels = []
    for x, y in fixes.tolist():
        estimate, found = predict_with_gyro(estimate, found, ekf, 0.0, 0.0, 0.0, DT_S)
        estimate, found, *_ = correct_with_gyro(estimate, found, ekf, x, y, 1.0, 0.0, 0.0, DT_S)
        levels.append(ekf.variance + found.variance)
    assert np.mean(levels[2000:]) == pytest.approx(noise_mm**2, rel=0.15)


def test_an_outlier_moves_the_pose_less_the_farther_it_lies():
    """The influence of a fix grows up to the threshold and decreases beyond."""
    moved = {}
    for threshold in (30.0, None):
        ekf = gyro_ekf_constants(GyroEkfParameters(outlier_threshold=threshold), BODY, DT_S)
        estimate, found = START, REST
        for _ in range(200):
            estimate, found = predict_with_gyro(estimate, found, ekf, 0.0, 0.0, 0.0, DT_S)
            estimate, found, *_ = correct_with_gyro(
                estimate, found, ekf, 0.0, 0.0, 1.0, 0.0, 0.0, DT_S
            )
        moved[threshold] = [
            abs(correct_with_gyro(estimate, found, ekf, far, 0.0, 1.0, 0.0, 0.0, DT_S)[0].x)
            for far in (0.5, 50.0, 500.0)
        ]
    assert moved[30.0][0] == moved[None][0]
    assert moved[30.0][2] < moved[30.0][1] < 0.1 * moved[None][1]


def test_the_covariance_is_that_of_the_matrix_equations():
    """F P Fᵀ + Q and (I − K H) P with matrices, for random covariances."""
    rng = np.random.default_rng(5)
    parameters = GyroEkfParameters(fix_variance_time_s=None, torque_time_s=None)
    ekf = gyro_ekf_constants(parameters, BODY, DT_S)
    pose = ("p_xx", "p_xy", "p_xt", "p_yy", "p_yt", "p_tt")
    errors = [f"p_{a}{b}" for b in "123" for a in "xyt"]
    errors += ["p_11", "p_12", "p_13", "p_22", "p_23", "p_33"]
    names = "xyt123"
    order = {f"p_{a}{b}": (names.index(a), names.index(b)) for a in names for b in names}

    def matrix(estimate: Estimate, found: GyroEstimate) -> np.ndarray:
        out = np.zeros((6, 6))
        for name in pose:
            out[order[name]] = out[order[name][::-1]] = getattr(estimate, name)
        for name in errors:
            out[order[name]] = out[order[name][::-1]] = getattr(found, name)
        out[5, 5] += ekf.scale
        return out

    for _ in range(5):
        root = rng.normal(size=(6, 6)) * [1.0, 1.0, 0.01, 10.0, 0.01, 0.01]
        whole = root.T @ root
        whole[5, 5] += ekf.scale
        estimate = Estimate(3.0, -2.0, 0.7, *(whole[order[name]] for name in pose))
        values = {name: whole[order[name]] for name in errors}
        values["p_33"] -= ekf.scale
        found = REST._replace(speed_error=20.0, gyro_error=0.02, scale_error=0.01, **values)
        u_1, rate = 0.4, 0.9
        after, errors_after = predict_with_gyro(estimate, found, ekf, u_1, rate, 0.0, DT_S)
        moved = u_1 + 20.0 * DT_S
        turned = (rate * 1.01 + 0.02) * DT_S
        middle = 0.7 + 0.5 * turned
        along = np.array([-math.sin(middle), math.cos(middle)])
        f = np.eye(6)
        f[:2, 2] = moved * np.array([-math.cos(middle), -math.sin(middle)])
        f[:2, 3] = along * DT_S
        f[2, 4], f[2, 5] = DT_S, rate * DT_S
        f[:2, 4], f[:2, 5] = 0.5 * DT_S * f[:2, 2], 0.5 * rate * DT_S * f[:2, 2]
        noise = np.diag([0.0, 0.0, ekf.heading, ekf.walk_1, ekf.walk_2, 0.0])
        right = np.array([along[1], -along[0]])
        noise[:2, :2] = ekf.forward * np.outer(along, along) + ekf.sideways * np.outer(right, right)
        expected = f @ whole @ f.T + noise
        np.testing.assert_allclose(matrix(after, errors_after), expected, rtol=1e-9, atol=1e-12)
        h = np.eye(2, 6)
        variance = max(ekf.variance_factor * ekf.variance, ekf.least_variance)
        s = h @ expected @ h.T + variance * np.eye(2)
        k = expected @ h.T @ np.linalg.inv(s)
        innovation = np.array([0.3, -0.2])
        last, errors_last, *_ = correct_with_gyro(
            after, errors_after, ekf, after.x + 0.3, after.y - 0.2, 1.0, 0.0, rate, DT_S
        )
        expected_last = expected - k @ h @ expected
        np.testing.assert_allclose(matrix(last, errors_last), expected_last, rtol=1e-7, atol=1e-9)
        step = k @ innovation
        assert last.theta - after.theta == pytest.approx(step[2], rel=1e-9)
        assert errors_last.speed_error - 20.0 == pytest.approx(step[3], rel=1e-9)


def test_steady_slip_is_found_at_any_rate_of_turning():
    slip_1, slip_2, speed = 30.0, 0.2, 400.0

    def circle(t_s: float) -> tuple[float, float]:
        radius = (speed + slip_1) / slip_2
        return -radius * (1.0 - math.cos(slip_2 * t_s)), radius * math.sin(slip_2 * t_s)

    _, _, slip = advanced(8000, u_1=speed * DT_S, rate=slip_2, fixes=circle)
    assert slip[0] == pytest.approx(slip_1, abs=0.5)
    assert slip[1] == pytest.approx(slip_2, abs=1e-3)


def test_reported_slips_keep_their_bounds():
    _, found, slip = advanced(2000, u_1=0.4, rate=3.0, delta_2_bound_rad_s=0.25)
    assert slip[1] == 0.25
    assert found.slip_2 == pytest.approx(3.0, rel=1e-6)


def test_the_payload_is_not_known_to_the_filter():
    """The body of an episode may be laden; the filter has the constants of the empty one."""
    env = parallel_env("infinity", estimator="ekf-gyro", disturbance={"payload": {"mass_kg": 0.3}})
    env.reset(seed=0)
    found = env.formation.named("gyro_ekf").by_torque[0]
    assert found == pytest.approx(DT_S**2 / (ROBOT.mass_kg * ROBOT.wheel_radius_mm))
    assert env.formation.named("body").m[0] == pytest.approx(ROBOT.mass_kg + 0.3)


def slip_errors(estimator: str, disturbance: Any) -> np.ndarray:
    """RMS of the errors of δ₁ (mm/s) and δ₂ (rad/s), worst robot, from 5 to 12 s; all slip is reported."""
    env = parallel_env(
        "infinity",
        estimator=estimator,
        disturbance=disturbance,
        horizon_s=12.0,
        end_on=(),
        ekf_gyro={"floor_slip_acceleration_mm_s2": None},
    )
    policy, rows = ReferencePolicy("tuned"), []
    seen, _ = env.reset(seed=3)
    while env.agents:
        actions = policy.predict(np.stack(list(seen.values())))[0]
        seen, _, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        slip = env.formation.named("slip")
        injected = [
            [one["slip_delta_1_mm_s"] for one in infos.values()],
            [one["slip_delta_2_rad_s"] for one in infos.values()],
        ]
        rows.append(np.array([slip.delta_1, slip.delta_2]) - injected)
    return np.sqrt((np.array(rows)[250:] ** 2).mean(axis=0)).max(axis=1)


@pytest.mark.parametrize("shape", ["slip-sines", "slip-noise"])
def test_continuous_slip_is_followed_better_than_by_the_fixes_alone(shape):
    with_gyro, alone = (slip_errors(kind, shape) for kind in ("ekf-gyro", "ekf-slip"))
    assert (with_gyro < [0.6 * alone[0], 0.3 * alone[1]]).all()


def test_a_kinematic_plant_has_no_torques_so_the_encoders_give_the_speed():
    env = parallel_env("infinity", estimator="ekf-gyro", plant="kinematic")
    env.reset(seed=0)
    assert (env.formation.named("gyro_ekf").by_torque == 0.0).all()
    assert (env.formation.named("gyro_ekf").drag == 0.0).all()
    assert (env.formation.named("gyro_ekf").to_encoders == 1.0).all()


@pytest.mark.parametrize(
    ("field", "value"), [("torque_time_s", 0.0), ("fix_variance_mm2", -1.0), ("gyro_walk", 1.0)]
)
def test_impossible_parameters_are_named(field, value):
    with pytest.raises(ValueError, match=rf"ekf_gyro\.{field}"):
        load_scenario("infinity", ekf_gyro={field: value})


FULL_SPEED_MM_S, SLIP_MM_S = 300.0, 30.0


def reported_over(samples: int, slip_mm_s: float, acceleration_mm_s2: float) -> list[float]:
    """Reported δ₁ while the torques accelerate the body, for wheels that turn with another speed."""
    ekf = gyro_ekf_constants(GyroEkfParameters(fix_variance_time_s=None), BODY, DT_S)
    by_drag = drag_mm_s2(BODY) + acceleration_mm_s2
    torque = by_drag * ROBOT.mass_kg * ROBOT.wheel_radius_mm
    rolled = (FULL_SPEED_MM_S - slip_mm_s) * DT_S
    estimate, found, seen = START, REST._replace(rolled=rolled, advance=FULL_SPEED_MM_S * DT_S), []
    found = found._replace(speed=FULL_SPEED_MM_S)
    for _ in range(samples):
        estimate, found = predict_with_gyro(estimate, found, ekf, rolled, 0.0, torque, DT_S)
        found = found._replace(speed_error=0.0)
        estimate, found, *_ = correct_with_gyro(estimate, found, ekf, 0.0, 0.0, 0.0, 0.0, 0.0, DT_S)
        seen.append(reported_slip(found, ekf)[0])
    return seen


def test_slip_at_constant_speed_is_the_floors():
    assert reported_over(600, SLIP_MM_S, 0.0)[-1] > 0.3 * SLIP_MM_S


def test_slip_of_tyres_that_transmit_force_is_not_reported():
    """The same slip, while the torques accelerate the body by more than the limit."""
    assert not any(reported_over(600, SLIP_MM_S, 200.0))


def test_a_slip_below_the_least_is_not_reported():
    assert not any(reported_over(2000, 0.9 * GyroEkfParameters().floor_slip_mm_s, 0.0))


def test_how_quiet_a_body_is_depends_on_all_its_acceleration():
    parameters = GyroEkfParameters()
    most = parameters.floor_slip_acceleration_mm_s2
    ekf = gyro_ekf_constants(parameters, BODY, DT_S)
    arm_mm = ROBOT.body_inertia_kg_mm2 / ROBOT.mass_kg / (ROBOT.axle_width_mm / 2)
    assert ekf.arm == pytest.approx(arm_mm, rel=0.05)
    for share, quiet in ((0.0, 1.0), (0.5, 1.0), (0.75, 0.5), (1.0, 0.0), (3.0, 0.0)):
        a = share * most
        forward = REST._replace(speed=200.0 - a * ACCELERATION_TIME_S)
        turning = REST._replace(yaw_rate=-a / ekf.arm * ACCELERATION_TIME_S)
        assert quietness(forward, ekf, 200.0, 0.0) == pytest.approx(quiet, abs=1e-12)
        assert quietness(turning, ekf, 0.0, 0.0) == pytest.approx(quiet, abs=1e-12)
        curve = REST._replace(speed=200.0, yaw_rate=a / 200.0)
        assert quietness(curve, ekf, 200.0, a / 200.0) == pytest.approx(quiet, abs=1e-12)
        both = REST._replace(speed=200.0 - 0.6 * a * ACCELERATION_TIME_S, yaw_rate=0.8 * a / 200.0)
        assert quietness(both, ekf, 200.0, 0.8 * a / 200.0) == pytest.approx(quiet, abs=1e-12)


@pytest.mark.parametrize("friction_scale", [0.4, 0.35])
def test_the_default_holds_a_floor_with_little_grip(friction_scale):
    """A sliding tyre's slip is not subtracted; with all slip reported, runs of these seeds are lost."""
    scenario = load_scenario(
        "infinity",
        disturbance={"tyre": {"friction_scale": friction_scale}},
        start_ramp_s=6.0,
        horizon_s=40.0,
        plant="batch",
    )
    seeds = list(range(10_000, 10_008))
    fitted = fit_policy("reference:linearised", scenario)
    runs = [record.metrics() for record in run_seeds(fitted.scenario, fitted.policy, seeds)]
    assert not any(map(failed, runs))
    worst_mm = [max(robot.position_rmse_mm for robot in run) for run in runs]
    assert np.median(worst_mm) < 1.0


@pytest.mark.parametrize(("field", "kind"), [("ekf_gyro", "ekf-gyro"), ("ekf_slip", "ekf-slip")])
def test_a_controller_file_with_numbers_of_a_filter_names_it_and_gives_all_its_numbers(field, kind):
    numbers = {"fix_variance_time_s": None}  # which is not the default
    given = ControllerFile(controller="printed", **{field: numbers})
    parameters = {"ekf_gyro": GyroEkfParameters, "ekf_slip": SlipEkfParameters}[field]
    whole = parameters(**numbers).model_dump()
    assert given.scenario_overrides == {"estimator": kind, field: whole}
    assert whole["fix_variance_time_s"] is None
    other = ControllerFile(controller="printed", estimator="ekf", **{field: numbers})
    assert other.scenario_overrides["estimator"] == "ekf"
    assert ControllerFile(controller="printed").scenario_overrides == {}
