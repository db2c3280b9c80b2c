"""The laws of textbooks: their gains, and that they hold the tasks."""

import math

import numpy as np
import pytest

from baselines.policies.laws.textbook import FeedbackLinearisation, Kanayama, PurePursuit
from baselines.policies.registry import fit_policy, make_policy
from baselines.runs.run import run_policy
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

ENTRIES = tracking_entries(DEFAULT_PREVIEW_S)


def row(**seen):
    """A scaled observation of what is named; the heading error is 0 by default."""
    values = {"cos_e_3": 1.0} | seen
    return np.array([values.get(name, 0.0) / entry.scale for name, entry in ENTRIES.items()])


def twist_of(action):
    return action * (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_the_error_of_the_point_ahead_decays_with_the_gain(gain):
    policy = FeedbackLinearisation(gain_per_s=gain)
    b, dt = policy.ahead_mm, 1e-3
    u_1, u_2 = 300.0, 0.4
    robot, goal = np.array([40.0, -60.0, 0.5]), np.zeros(3)  # x, y, θ; 0 faces +y

    def point(pose):
        return pose[:2] + b * np.array([-math.sin(pose[2]), math.cos(pose[2])])

    def moved(pose, forward, turn):
        middle = pose[2] + turn * dt / 2
        step = forward * dt * np.array([-math.sin(middle), math.cos(middle)])
        return np.array([*(pose[:2] + step), pose[2] + turn * dt])

    first = point(goal) - point(robot)
    for _ in range(1000):
        d_x, d_y = goal[:2] - robot[:2]
        sin, cos = math.sin(robot[2]), math.cos(robot[2])
        seen = {
            "e_1": -sin * d_x + cos * d_y,
            "e_2": cos * d_x + sin * d_y,
            "sin_e_3": math.sin(goal[2] - robot[2]),
            "cos_e_3": math.cos(goal[2] - robot[2]),
            "reference_u_1": u_1,
            "reference_u_2": u_2,
        }
        forward, turn = policy.twist({name: np.array([x]) for name, x in seen.items()})
        robot = moved(robot, forward[0], turn[0])
        goal = moved(goal, u_1, u_2)
    assert point(goal) - point(robot) == pytest.approx(math.exp(-gain) * first, abs=0.3)


@pytest.mark.parametrize("speed_mm_s", [100.0, 400.0])
def test_kanayamas_law_damps_a_lateral_error_critically_over_the_distance(speed_mm_s):
    """On a straight, a small error e over the distance s obeys e'' + k_θ e' + k_y e = 0, with k_θ² = 4 k_y."""
    policy, dt, first = Kanayama(), 1e-3, 2.0
    rate = math.sqrt(policy.k_y_per_mm2)
    offset, heading = first, 0.0  # to the left of the reference, and counter-clockwise
    for k in range(1, 1001):
        seen = {
            "e_1": 0.0,
            "e_2": offset,
            "sin_e_3": math.sin(-heading),
            "cos_e_3": math.cos(heading),
            "reference_u_1": speed_mm_s,
            "reference_u_2": 0.0,
        }
        _, turn = policy.twist({name: np.float64(x) for name, x in seen.items()})
        offset += speed_mm_s * math.sin(heading + turn * dt / 2) * dt
        heading += turn * dt
        gone = rate * speed_mm_s * k * dt
        assert offset == pytest.approx(first * (1.0 + gone) * math.exp(-gone), abs=0.01)


def test_kanayamas_law_reduces_a_forward_error_by_its_gain():
    forward, turn = twist_of(Kanayama(k_x_per_s=3.0).predict(row(reference_u_1=200.0, e_1=10.0))[0])
    assert (forward, turn) == pytest.approx((230.0, 0.0))


def test_pure_pursuit_turns_towards_the_point_ahead():
    for right in (-50.0, 50.0):
        seen = row(reference_u_1=300.0, **{"forward_in_0.5_s": 150.0, "right_in_0.5_s": right})
        assert np.sign(PurePursuit().predict(seen)[0][1]) == -np.sign(right)


def test_pure_pursuit_needs_a_point_ahead():
    for preview_s in ((), (0.0, 1.0)):
        with pytest.raises(ValueError, match="preview"):
            make_policy("pure_pursuit", load_scenario(preview_s=preview_s))


@pytest.mark.parametrize(
    "name", ["pure_pursuit", "feedback_linearisation", "kanayama:bounded+ekf-slip+body"]
)
@pytest.mark.parametrize("task", ["infinity", "flower"])
def test_it_holds_the_task(name, task):
    fitted = fit_policy(name, load_scenario(task))
    assert fitted.scenario.control_period_s == 0.02
    record = run_policy(fitted.scenario, fitted.policy, 10_000)
    for metrics in record.metrics():
        assert metrics.position_rmse_mm < 6
        assert not metrics.lost
        assert not metrics.touched
