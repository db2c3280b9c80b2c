"""The action about the reference's twist, the range of an action, and the limiter of a scenario's actions."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from helpers import stacked, unstacked

import tlf_env
from baselines import ReferencePolicy
from baselines.policies.registry import fit_policy
from baselines.policies.systems import LimitedLaw
from tlf_env.engine.formation import Formation
from tlf_env.onboard.limiter import speed_range, twist_limits_row
from tlf_env.onboard.limiters import DEFAULT_LIMITER, Limiter, load_limiter
from tlf_env.physics.kinematics import odometry
from tlf_env.physics.parameters import body
from tlf_env.task.actions import (
    FULL_SPEED_MM_S,
    FULL_WHEEL_SPEED_RAD_S,
    FULL_YAW_RATE_RAD_S,
    led_reference,
)
from tlf_env.task.observation import Tracking, tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

SCALES = np.array([entry.scale for entry in tracking_entries(DEFAULT_PREVIEW_S).values()])
PERIOD_S = 0.02
GRIP = load_limiter("grip")
LIMITS = twist_limits_row(GRIP.limits, PERIOD_S)
SHORT = {"horizon_s": 10.0, "dtype": "float64"}
KINDS = ("twist", "wheel_speed", "tracking_twist")


def place(name: str) -> int:
    return Tracking._fields.index(name)


def commanded(formation: Formation) -> np.ndarray:
    """The twists that the wheels of all robots are commanded, ``(2, robot)``."""
    robot, wanted = body(formation.scenario.robot), formation.arrays.rows("wanted")
    return np.array(odometry.py_func(wanted[0, :, 0], wanted[1, :, 0], robot.R, robot.h))


def at_start(**fields: object) -> Formation:
    formation = Formation(load_scenario("infinity", **{**SHORT, "end_on": (), **fields}))
    formation.reset(0)
    return formation


def test_zero_is_the_twist_of_the_reference():
    formation = at_start(action="tracking_twist", limiter="none")
    for _ in range(50):
        seen = formation.arrays.observations[0] * SCALES
        formation.step()
        wanted = seen[:, [place("reference_u_1"), place("reference_u_2")]].T
        np.testing.assert_allclose(commanded(formation), wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("range_", [None, (60.0, 0.5)])
def test_the_range_is_what_one_means(range_):
    fields = {"action": "tracking_twist", "limiter": "none", "action_range": range_}
    formation = at_start(**fields, tracking_fade_mm=0.0)
    seen = formation.arrays.observations[0] * SCALES
    formation.arrays.actions[0] = [[1.0, 0.5], [-0.5, -1.0], [0.0, 0.25]]
    formation.step()
    full = np.array(range_ or (100.0, 1.0))
    wanted = seen[:, [place("reference_u_1"), place("reference_u_2")]]
    wanted = wanted + full * [[1.0, 0.5], [-0.5, -1.0], [0.0, 0.25]]
    np.testing.assert_allclose(commanded(formation), wanted.T, rtol=0, atol=1e-9)
    assert tuple(entry.scale for entry in formation.scenario.action_entries) == tuple(full)


@pytest.mark.parametrize("fade_mm", [None, 40.0])
def test_the_range_shrinks_towards_the_reference(fade_mm):
    """By e/(e + F), with the estimated error that the observation has."""
    fields = {"action": "tracking_twist", "limiter": "none", "disturbance": "start"}
    formation = at_start(**fields, tracking_fade_mm=fade_mm)
    for _ in range(50):
        formation.step()
    seen = formation.arrays.observations[0] * SCALES
    error_mm = np.hypot(seen[:, place("e_1")], seen[:, place("e_2")])
    assert error_mm[0] > 100.0
    assert 0.01 < error_mm[1] < 100.0
    formation.arrays.actions[0] = np.tile([1.0, -1.0], (3, 1))
    formation.step()
    added = commanded(formation) - seen[:, [place("reference_u_1"), place("reference_u_2")]].T
    share = error_mm / (error_mm + (10.0 if fade_mm is None else fade_mm))
    np.testing.assert_allclose(added, np.outer([100.0, -1.0], share), rtol=0, atol=1e-4)


def test_the_range_of_a_residual_is_what_one_means():
    """On a controller without limits, whose twist an action adds to."""
    fields = {"action": "residual", "residual_base": "consistent"}
    base, narrow = at_start(**fields), at_start(**fields, action_range=(30.0, 0.25))
    narrow.arrays.actions[0] = [[1.0, 0.0], [0.0, -1.0], [0.5, 1.0]]
    base.step()
    narrow.step()
    added = commanded(narrow) - commanded(base)
    np.testing.assert_allclose(added, [[30.0, 0.0, 15.0], [0.0, -0.25, 0.25]], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("limiter", "disturbance", "horizon_s"),
    [("grip", "combined-easy", 10.0), ("grip", "slip", 3.0), ("supervised", "nominal", 30.0)],
)
def test_the_law_of_a_system_as_actions_is_the_system(limiter, disturbance, horizon_s):
    """Its wanted twist as an action, behind the limiter in the scenario, gives its commands."""
    fields = {"robots": 7, "end_on": (), "disturbance": disturbance, "horizon_s": horizon_s}
    scenario = load_scenario("infinity", dtype="float64", neighbour={}, **fields)
    fitted = fit_policy(f"feedback_linearisation:bounded+ekf-gyro-smoothed+{limiter}", scenario)
    assert isinstance(fitted.policy, LimitedLaw)
    lead_s = load_limiter(limiter).lead_s
    asked = {"action": "tracking_twist", "action_range": (2000.0, 20.0), "limiter": limiter}
    asked |= {"tracking_fade_mm": 0.0}
    whole, parts = Formation(fitted.scenario), Formation(load_scenario(fitted.scenario, **asked))
    entries = tracking_entries(scenario.preview_s, neighbour=scenario.neighbour)
    scales = np.array([entry.scale for entry in entries.values()])
    whole.reset(3)
    parts.reset(3)
    for _ in range(scenario.horizon_steps):
        seen = parts.arrays.observations[0].copy()
        wanted, _ = fitted.policy.law.wanted(seen, lead_s=lead_s, slip_cancelled=True)
        reference = [led_reference(row, scales, lead_s / scenario.preview_s[0]) for row in seen]
        parts.arrays.actions[0] = (wanted - reference) / [2000.0, 20.0]
        whole.arrays.actions[0] = fitted.policy.predict(whole.arrays.observations[0])[0]
        whole.step()
        parts.step()
        np.testing.assert_allclose(commanded(parts), commanded(whole), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_limits_hold_on_any_action(kind):
    formation = at_start(action=kind, limiter="grip", estimator="ekf")  # no slip is subtracted
    rng, a, last, gave_way = np.random.default_rng(0), formation.arrays, np.zeros((2, 3)), 0
    for _ in range(formation.scenario.horizon_steps):
        seen = a.observations[0] * SCALES
        cruise, error = seen[:, place("reference_u_1")], np.hypot(*seen[:, :2].T)
        low, high = np.transpose(
            [
                speed_range.py_func(last[0, i], last[1, i], cruise[i], error[i], LIMITS)
                for i in range(3)
            ]
        )
        a.actions[0] = rng.uniform(-1, 1, a.actions[0].shape)
        formation.step()
        u_1, u_2 = last = commanded(formation)
        assert (u_1 >= low - 1e-6).all()
        assert (u_1 <= high + 1e-6).all()
        assert (np.abs(u_1 * u_2) <= LIMITS.lateral + 1e-6).all()
        assert (np.abs(u_2) <= LIMITS.yaw_rate + 1e-6).all()
        gave_way += np.count_nonzero(u_1 > high - 1e-6)
    assert gave_way > 0


def test_a_wheel_speed_is_limited_as_the_twist_that_it_makes():
    fields = {"limiter": "grip", "disturbance": "slip"}
    twist, wheels = at_start(action="twist", **fields), at_start(action="wheel_speed", **fields)
    robot, rng = body(twist.scenario.robot), np.random.default_rng(1)
    for _ in range(200):
        speeds = rng.uniform(-0.5, 0.5, (3, 2))
        wheels.arrays.actions[0] = speeds
        u_1, u_2 = odometry.py_func(*(FULL_WHEEL_SPEED_RAD_S * speeds.T), robot.R, robot.h)
        twist.arrays.actions[0] = np.transpose([u_1 / FULL_SPEED_MM_S, u_2 / FULL_YAW_RATE_RAD_S])
        twist.step()
        wheels.step()
        np.testing.assert_allclose(commanded(wheels), commanded(twist), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["twist", "wheel_speed"])
def test_a_limiter_without_limits_changes_no_bit(kind):
    one, other = at_start(action=kind), at_start(action=kind, limiter="none")
    rng = np.random.default_rng(2)
    for _ in range(200):
        actions = rng.uniform(-0.3, 0.3, (3, 2))
        one.arrays.actions[0] = other.arrays.actions[0] = actions
        one.step()
        other.step()
        assert one.arrays.states.tobytes() == other.arrays.states.tobytes()


def test_a_robot_that_catches_up_slows_down_before_it_arrives():
    """With an action that always wants to be faster, unless it would have to brake harder than it may."""
    formation = at_start(action="tracking_twist", horizon_s=20.0)
    limits = load_limiter("approach").limits
    assert limits.closing_deceleration_mm_s2 is not None
    least = limits.turning_acceleration_mm_s2  # in a turn; more on a straight
    assert least is not None
    held = 0
    for _ in range(950):
        seen = formation.arrays.observations[0] * SCALES
        formation.arrays.actions[0] = np.tile([1.0, 0.0], (3, 1))
        formation.step()
        e_1, slip = np.maximum(seen[:, place("e_1")], 0.0), seen[:, place("slip_1")]
        closing = np.sqrt(
            limits.closing_speed_mm_s**2 + 2.0 * limits.closing_deceleration_mm_s2 * e_1
        )
        most = seen[:, place("reference_u_1")] + closing
        braked = seen[:, place("command_u_1")] + slip - least * PERIOD_S
        speed = commanded(formation)[0] + slip
        assert (speed <= np.maximum(most, braked) + 0.1).all()
        held += int((np.abs(speed - most) < 0.1).sum())
    assert held > 100  # it is this limit that holds the robots back


def test_without_a_limiter_of_its_own_the_action_about_the_reference_has_the_usual_one():
    usual = load_scenario("infinity", action="tracking_twist")
    assert usual.limiter is None
    assert usual.action_limiter == load_limiter(DEFAULT_LIMITER)
    blind = load_scenario("infinity", action="tracking_twist", preview_s=())
    assert blind.action_limiter == load_limiter(DEFAULT_LIMITER).model_copy(update={"lead_s": 0.0})
    for kind in ("twist", "wheel_speed", "torque", "residual"):
        assert load_scenario("infinity", action=kind).action_limiter == Limiter()


@pytest.mark.parametrize("others", ["reference", ReferencePolicy()])
def test_the_limiter_is_that_of_the_learner_alone(others):
    fields = {"action": "twist", "limiter": "none", "horizon_s": 10.0, "end_on": ()}
    free = gymnasium.make("tlf_env/Infinity-v0", others=others, **fields)
    bound = gymnasium.make("tlf_env/Infinity-v0", others=others, **{**fields, "limiter": "grip"})
    arrays = [env.unwrapped.formation_env.formation.arrays for env in (free, bound)]
    for env in (free, bound):
        env.reset(seed=1)
    for step in range(300):
        action = np.array([0.6 * math.sin(0.1 * step), 0.3], dtype=np.float32)
        for env in (free, bound):
            env.step(action)
        leader = [one.states[:, 0, 0].tobytes() for one in arrays]
        assert leader[0] == leader[1]
    own = [one.states[:, 1, 0].tobytes() for one in arrays]
    assert own[0] != own[1]


def test_all_doors_command_the_same():
    fields = {"action": "tracking_twist", "disturbance": "slip", "horizon_s": 8.0}
    env = tlf_env.parallel_env("infinity", plant="batch", **fields)
    batch = tlf_env.BatchPlant("infinity", 2, **fields)
    observations, _ = env.reset(seed=4)
    batch.reset(4)
    rng = np.random.default_rng(3)
    while env.agents:
        actions = rng.uniform(-0.05, 0.05, (3, 2)).astype(np.float32)
        observations, *_ = env.step(unstacked(env, actions))
        batch.step(np.stack([actions, actions]))
        if env.agents:
            assert batch.observations[0].tobytes() == stacked(observations).tobytes()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"action_range": (100.0, 1.0)},
            "action_range goes with the actions residual and tracking",
        ),
        ({"action": "tracking_twist", "action_range": (0.0, 1.0)}, "action_range"),
        ({"action": "tracking_twist", "tracking_fade_mm": -1.0}, "tracking_fade_mm"),
        (
            {"tracking_fade_mm": 5.0},
            "tracking_fade_mm goes with the action tracking_twist, not with",
        ),
        ({"action": "tracking_twist", "action_range": 3.0}, "action_range"),
        ({"action": "torque", "limiter": "grip"}, "limiter goes with the actions twist, wheel_"),
        ({"action": "residual", "limiter": "grip"}, "limiter goes with the actions twist, wheel_"),
        ({"limiter": "grid"}, r"'grid' is not one of approach, body, grip, none"),
        ({"limiter": {"limits": {"yaw_rate_rad_s": -1.0}}}, "limiter.limits.yaw_rate_rad_s"),
        ({"limiter": {"limits": {"lateral_error_mm": 5.0}}}, "belongs to a controller"),
        (
            {"limiter": "grip", "preview_s": ()},
            r"limiter.lead_s 0.02 needs a first preview above 0",
        ),
        ({"limiter": "supervised"}, "limiter.supervisor needs a neighbour"),
    ],
)
def test_what_does_not_fit_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        load_scenario("infinity", **fields)


def test_a_limiter_that_subtracts_slip_needs_a_filter_that_finds_some():
    with pytest.warns(UserWarning, match="the limiter subtracts the estimated slip"):
        tlf_env.parallel_env("infinity", action="twist", limiter="grip", estimator="ekf")


def test_the_supervisor_of_a_limiter_stops_before_a_robot_that_stands_in_the_way():
    poses = [[0.0, 900.0, 0.0], [900.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    fields = {"neighbour": {}, "action": "twist", "horizon_s": 8.0, "end_on": ("touched",)}
    touched = []
    for limiter in ("body", "supervised"):
        env = tlf_env.parallel_env("infinity", limiter=limiter, **fields)
        env.reset(seed=0, options={"poses": poses})
        ahead = {"robot_0": 0.0, "robot_1": 0.0, "robot_2": 0.4}
        actions = {name: np.array([u_1, 0.0], np.float32) for name, u_1 in ahead.items()}
        infos = {}
        while env.agents:
            *_, infos = env.step(actions)
        touched.append(bool(infos["robot_2"]["touched"]))
    assert touched == [True, False]
