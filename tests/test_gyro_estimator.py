"""The filter with gyro and torques: analytic limits of its laws, and what it finds in closed loop."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from baselines import ReferencePolicy
from tlf_env import load_scenario, parallel_env
from tlf_env.onboard.estimator import Estimate
from tlf_env.onboard.gyro_estimator import (
    GyroEkfParameters,
    correct_with_gyro,
    gyro_ekf_constants,
    predict_with_gyro,
)
from tlf_env.onboard.slip_estimator import SlipEstimate
from tlf_env.physics.vehicle import RobotParameters, body

DT_S = 0.001
ROBOT = RobotParameters()
BODY = body(ROBOT)
REST = SlipEstimate(*(0.0 for _ in SlipEstimate._fields))
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
) -> tuple[Estimate, SlipEstimate]:
    """Pose and slip after some samples, without fixes or with ``fixes(t_s)``."""
    ekf = gyro_ekf_constants(GyroEkfParameters(**parameters), BODY, DT_S)
    estimate, slip = START, REST
    for k in range(samples):
        estimate, slip = predict_with_gyro(estimate, slip, ekf, u_1, rate, torque, DT_S)
        x, y = (0.0, 0.0) if fixes is None else fixes((k + 1) * DT_S)
        here = 0.0 if fixes is None else 1.0
        estimate, slip, *_ = correct_with_gyro(estimate, slip, ekf, x, y, here, u_2, rate, DT_S)
    return estimate, slip


def test_without_torques_and_fixes_the_speed_is_that_of_the_encoders_and_the_turn_the_gyros():
    estimate, slip = advanced(1000, u_1=0.3, u_2=4e-4, rate=0.5, torque=1e5, torque_time_s=None)
    assert estimate.theta == pytest.approx(0.5, rel=1e-9)
    radius = 300.0 / 0.5  # of the circle
    assert estimate.x == pytest.approx(-radius * (1.0 - math.cos(0.5)), rel=1e-6)
    assert estimate.y == pytest.approx(radius * math.sin(0.5), rel=1e-6)
    assert slip.delta_1 == 0.0
    assert slip.delta_2 == pytest.approx(0.5 - 0.4, rel=1e-9)


def test_a_torque_accelerates_the_body_by_newtons_law_while_the_wheels_stand():
    """Wheels held on a floor that moves: the encoders see nothing, the torques do."""
    torque, time_s, tau_s = 5000.0, 0.05, 2.0  # mN·mm in all
    _, slip = advanced(round(time_s / DT_S), torque=torque, torque_time_s=tau_s)
    acceleration = torque / (ROBOT.wheel_radius_mm * ROBOT.mass_kg)
    speed = acceleration * tau_s * (1.0 - math.exp(-time_s / tau_s))
    assert slip.advance / DT_S == pytest.approx(speed, rel=2e-3)
    assert slip.rolled == 0.0


def test_the_speed_returns_to_that_of_the_encoders():
    _, slip = advanced(3000, u_1=0.4, torque_time_s=0.3)
    assert slip.advance == pytest.approx(0.4, rel=1e-4)
    assert slip.delta_1 == pytest.approx(0.0, abs=0.05)


def test_a_constant_error_of_the_gyro_is_found_from_the_fixes():
    bias, speed = 0.05, 400.0

    def straight(t_s: float) -> tuple[float, float]:
        return 0.0, speed * t_s

    estimate, slip = advanced(8000, u_1=speed * DT_S, rate=bias, fixes=straight, torque_time_s=None)
    assert slip.gyro_error == pytest.approx(-bias, abs=1e-3)
    assert slip.delta_2 == pytest.approx(0.0, abs=1e-3)
    assert estimate.theta == pytest.approx(0.0, abs=1e-3)


def test_steady_slip_is_found_at_any_rate_of_turning():
    slip_1, slip_2, speed = 30.0, 0.2, 400.0

    def circle(t_s: float) -> tuple[float, float]:
        radius = (speed + slip_1) / slip_2
        return -radius * (1.0 - math.cos(slip_2 * t_s)), radius * math.sin(slip_2 * t_s)

    _, slip = advanced(4000, u_1=speed * DT_S, rate=slip_2, fixes=circle)
    assert slip.delta_1 == pytest.approx(slip_1, abs=0.5)
    assert slip.delta_2 == pytest.approx(slip_2, abs=1e-3)


def test_reported_slips_keep_their_bounds():
    _, slip = advanced(2000, u_1=0.4, rate=3.0, delta_2_bound_rad_s=0.25)
    assert slip.delta_2 == 0.25
    assert slip.slip_2 == pytest.approx(3.0, rel=1e-6)


def test_the_payload_is_not_known_to_the_filter():
    """The body of an episode may be laden; the filter has the constants of the empty one."""
    env = parallel_env("infinity", estimator="ekf-gyro", disturbance={"payload": {"mass_kg": 0.3}})
    env.reset(seed=0)
    found = env.formation.named("slip_ekf").by_torque[0]
    assert found == pytest.approx(DT_S**2 / (ROBOT.mass_kg * ROBOT.wheel_radius_mm))
    assert env.formation.named("body").m[0] == pytest.approx(ROBOT.mass_kg + 0.3)


def slip_errors(estimator: str, disturbance: Any) -> np.ndarray:
    """RMS of the errors of δ₁ (mm/s) and δ₂ (rad/s), worst robot, from 5 to 12 s."""
    env = parallel_env(
        "infinity", estimator=estimator, disturbance=disturbance, horizon_s=12.0, end_on=()
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
    assert (env.formation.named("slip_ekf").by_torque == 0.0).all()
    assert (env.formation.named("slip_ekf").to_encoders == 1.0).all()


@pytest.mark.parametrize(
    ("field", "value"), [("torque_time_s", 0.0), ("fix_variance_mm2", -1.0), ("gyro_walk", 1.0)]
)
def test_impossible_parameters_are_named(field, value):
    with pytest.raises(ValueError, match=rf"ekf_gyro\.{field}"):
        load_scenario("infinity", ekf_gyro={field: value})
