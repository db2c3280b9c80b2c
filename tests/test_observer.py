"""The delayed-dynamics observer of time-gap leader-follower formation, eqs (42)–(51)."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from helpers import alike, play, reference_actions, untimed
from hypothesis import given
from hypothesis import strategies as st

import tlf_env
from tlf_env.onboard.observer import (
    Message,
    dead_reckoned,
    observed_reference,
    observer_rates,
    smoothing,
)
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking, tracking_entries

B, SMOOTHING_S = 3.0, 5.0  # the paper's

places = st.floats(-1e4, 1e4)
headings = st.floats(-10, 10)
speeds = st.floats(-600, 600)
turns = st.floats(-3, 3)


def integrate(message_at, start, step_s: float, duration_s: float, first_s: float = 0.0):
    """The observer by explicit Euler, as it runs on board; poses at every step."""
    pose, poses = np.array(start, dtype=float), []
    for k in range(round(duration_s / step_s)):
        t_s = first_s + k * step_s
        poses.append(pose)
        rates = observer_rates(*pose, message_at(t_s), B, smoothing(t_s, SMOOTHING_S))
        pose = pose + step_s * np.array(rates)
    return np.array([*poses, pose])


def circle(t_s: float, speed: float = 300.0, turn: float = 0.5) -> Message:
    """A robot on a circle, from the origin and heading +y."""
    theta = turn * t_s
    radius = speed / turn
    return Message(radius * (math.cos(theta) - 1), radius * math.sin(theta), theta, speed, turn)


# The law


@untimed
@given(places, places, headings, places, places, st.floats(-3, 3), speeds, turns)
def test_error_dynamics_are_eqs_45_to_47(x, y, theta, d_x, d_y, d_theta, u_1, u_2):
    delayed = Message(x, y, theta, u_1, u_2)
    rates = observer_rates(x - d_x, y - d_y, theta - d_theta, delayed, B, 1.0)
    sin, cos = math.sin(theta), math.cos(theta)
    S = np.array([[-sin, cos], [cos, sin]])
    z_1, z_2 = S @ (d_x, d_y)
    e_rates = np.array([-u_1 * sin, u_1 * cos]) - rates[:2]
    # Ṡ e = u₂ (−z₂, z₁), as (44) turns with θ_g.
    z_rates = S @ e_rates + u_2 * np.array([-z_2, z_1])
    expected = (
        -z_2 * u_2 + u_1 * (1 - math.cos(d_theta)) - B * z_1,
        z_1 * u_2 - u_1 * math.sin(d_theta) - B * z_2,
    )
    np.testing.assert_allclose(z_rates, expected, rtol=1e-9, atol=1e-6)
    assert u_2 - rates[2] == pytest.approx(-B * d_theta, rel=1e-9, abs=1e-9)


def test_heading_error_decays_with_the_smoothed_gain_to_first_order_in_the_step():
    """z₃ = z₃(0) exp(−b∫℘dt) while the predecessor does not turn."""
    t_s = 3.0
    integral = 0.5 * (t_s - SMOOTHING_S / math.pi * math.sin(math.pi * t_s / SMOOTHING_S))
    exact = 0.8 * math.exp(-B * integral)

    def error(step_s: float) -> float:
        still = Message(0.0, 0.0, 0.8, 0.0, 0.0)
        return 0.8 - integrate(lambda _: still, (0, 0, 0), step_s, t_s)[-1, 2] - exact

    errors = [error(0.02 / 2**k) for k in range(4)]
    assert abs(errors[0]) < 0.02 * exact
    for coarse, fine in itertools.pairwise(errors):
        assert coarse / fine == pytest.approx(2.0, abs=0.05)


def test_position_error_decays_at_b_once_the_heading_is_right():
    """Eqs (48) and (49): with z₃ = 0 the norm of (z₁, z₂) falls as e^(−bt), whatever u₂."""
    start = np.array([-300.0, 200.0, circle(SMOOTHING_S).theta])
    start[:2] += circle(SMOOTHING_S)[:2]
    ratios = []
    for step_s in (0.002, 0.001):
        last = integrate(circle, start, step_s, 1.0, first_s=SMOOTHING_S)[-1]
        error = np.subtract(circle(SMOOTHING_S + 1.0)[:2], last[:2])
        ratios.append(np.linalg.norm(error) / math.hypot(300, 200) / math.exp(-B))
    assert abs(ratios[1] - 1) < 5e-3
    assert (ratios[0] - 1) / (ratios[1] - 1) == pytest.approx(2.0, abs=0.1)


def test_observer_converges_from_anywhere():
    for start in ((900.0, -500.0, 2.0), (-2000.0, 0.0, -3.0)):
        last = integrate(circle, start, 0.001, 12.0)[-1]
        expected = circle(12.0)
        assert math.dist(last[:2], expected[:2]) < 0.5
        assert abs(math.remainder(last[2] - expected.theta, 2 * math.pi)) < 1e-3


def test_observer_turns_the_short_way():
    """A message one turn away means the same heading."""
    here = observer_rates(0.0, 0.0, 0.3, Message(0.0, 0.0, 0.5, 100.0, 0.2), B, 1.0)
    turned = observer_rates(0.0, 0.0, 0.3, Message(0.0, 0.0, 0.5 + 4 * math.pi, 100.0, 0.2), B, 1.0)
    assert turned == pytest.approx(here, rel=1e-12)


@pytest.mark.parametrize(
    ("t_s", "value"),
    [(0.0, 0.0), (1.25, 0.5 - math.sqrt(0.125)), (2.5, 0.5), (5.0, 1.0), (7.0, 1.0)],
)
def test_smoothing_is_eq_51(t_s, value):
    assert smoothing(t_s, SMOOTHING_S) == pytest.approx(value, abs=1e-15)


@given(st.floats(0, 10), st.floats(0, 10))
def test_smoothing_rises_between_0_and_1(t_1, t_2):
    early, late = sorted((t_1, t_2))
    assert 0 <= smoothing(early, SMOOTHING_S) <= smoothing(late, SMOOTHING_S) <= 1


def test_smoothing_has_no_jump_at_its_end():
    assert smoothing(SMOOTHING_S - 1e-6, SMOOTHING_S) == pytest.approx(1.0, abs=1e-12)


@given(places, places, headings, speeds, speeds, turns)
def test_reference_twist_is_eq_50_and_its_speed_never_negative(x, y, theta, v_x, v_y, turn):
    reference = observed_reference(x, y, theta, v_x, v_y, turn)
    assert reference[:3] == (x, y, theta)
    assert reference.u_1 >= 0
    assert reference.u_1 == pytest.approx(math.hypot(v_x, v_y), rel=1e-12)
    assert reference.u_2 == turn


# In the environment


def entry(observation: np.ndarray, name: str) -> float:
    """An entry of an observation, in its unit."""
    index = list(tracking_entries((0.5, 1.0))).index(name)
    return float(observation[index]) * tracking_entries((0.5, 1.0))[name].scale


def references(infos) -> np.ndarray:
    """Reference poses, (robot, 3)."""
    return np.array(
        [
            [info[f"reference_{name}"] for name in ("x_mm", "y_mm", "theta_rad")]
            for info in infos.values()
        ]
    )


def test_before_one_gap_a_follower_sees_its_predecessors_initial_pose_at_rest():
    """Whatever the leader does meanwhile; the observer starts at the follower's own pose."""
    env = tlf_env.parallel_env("infinity", disturbance="none", end_on=(), plant="kinematic")
    _, infos = env.reset(seed=0)
    start = references(infos)
    true_start = np.array([[i["x_mm"], i["y_mm"], i["theta_rad"]] for i in infos.values()])
    np.testing.assert_array_equal(start[1:], true_start[1:])
    actions = {**alike(env), "robot_0": np.array([0.3, 0.2], dtype=np.float32)}
    steps = play(env, {}, 250, lambda *_: actions)
    for follower in (1, 2):
        rest = Message(*true_start[follower - 1], 0.0, 0.0)
        expected = integrate(lambda _, rest=rest: rest, true_start[follower], 0.02, 5.0)
        measured = [references(step[4])[follower] for step in steps]
        np.testing.assert_allclose(measured, expected[1:], rtol=1e-12)


@pytest.mark.parametrize("gap_s", [1.0, 2.0])
def test_messages_arrive_exactly_one_gap_late(gap_s):
    """A change of the leader's action in step k reaches the follower's twist in step k + gap.

    Its pose follows one step later, and the preview of 0.5 s sees both 0.5 s before.
    """
    gap, changed, preview = round(gap_s / 0.02), 30, 25

    def run(disturbed: bool):
        env = tlf_env.parallel_env(
            "infinity",
            disturbance="none",
            time_gap_s=gap_s,
            broadcast_smoothing_s=0.0,
            end_on=(),
            plant="kinematic",
        )
        env.reset(seed=0)
        calm = {**alike(env), "robot_0": np.array([0.2, 0.0], dtype=np.float32)}
        other = {**calm, "robot_0": np.array([0.25, 0.1], dtype=np.float32)}
        return [
            env.step(other if disturbed and k == changed else calm)
            for k in range(changed + gap + 10)
        ]

    pairs = list(zip(run(False), run(True), strict=True))

    def first_change(look) -> int:
        return next(k for k, (a, b) in enumerate(pairs) if look(a) != look(b))

    def seen(name):
        return lambda step: entry(step[0]["robot_1"], name)

    assert first_change(lambda step: step[4]["robot_0"]["x_mm"]) == changed
    assert first_change(seen("reference_u_1")) == changed + gap
    assert first_change(seen("reference_u_2")) == changed + gap
    assert first_change(lambda step: step[4]["robot_1"]["reference_x_mm"]) == changed + gap + 1
    assert first_change(seen("u_1_in_0.5_s")) == changed + gap - preview
    assert first_change(seen("forward_in_0.5_s")) == changed + gap - preview + 1
    unchanged = [a[0]["robot_2"].tobytes() == b[0]["robot_2"].tobytes() for a, b in pairs]
    assert all(unchanged)


@pytest.mark.parametrize("preview_s", [0.5, 1.0])
def test_previews_are_the_later_references(preview_s):
    """Of the leader and of the followers alike, seen from the estimated pose."""
    env = tlf_env.parallel_env("infinity", end_on=())
    observations, infos = env.reset(seed=3)
    ahead, steps = round(preview_s / 0.02), 600
    seen, poses, twists = [], [], []
    for _ in range(steps):
        estimates = env.formation.arrays.rows("estimate")[:3, :, 0].T
        row = []
        for agent, (x, y, theta) in zip(env.agents, estimates, strict=True):
            names = ("forward", "right", "sin_turn", "cos_turn", "u_1", "u_2")
            forward, right, sin, cos, u_1, u_2 = (
                entry(observations[agent], f"{name}_in_{preview_s:g}_s") for name in names
            )
            row.append(
                [
                    x - forward * math.sin(theta) + right * math.cos(theta),
                    y + forward * math.cos(theta) + right * math.sin(theta),
                    math.sin(theta) * cos + math.cos(theta) * sin,
                    math.cos(theta) * cos - math.sin(theta) * sin,
                    u_1,
                    u_2,
                ]
            )
        seen.append(row)
        here = references(infos)
        poses.append(np.column_stack([here[:, :2], np.sin(here[:, 2]), np.cos(here[:, 2])]))
        twists.append(
            [[entry(o, "reference_u_1"), entry(o, "reference_u_2")] for o in observations.values()]
        )
        observations, *_, infos = env.step(reference_actions(env, observations))
    later = np.concatenate([poses, twists], axis=2)[ahead:]
    now = np.array(seen)[: steps - ahead]
    np.testing.assert_allclose(now, later, rtol=1e-6, atol=2e-3)
    assert np.abs(now[:, :, 2:4] - later[:, :, 2:4]).max() < 1e-6


def test_speed_of_every_reference_is_never_negative():
    env = tlf_env.parallel_env("infinity", end_on=())
    observations, _ = env.reset(seed=0)
    index = Tracking._fields.index("reference_u_1")
    assert TRACKING_ENTRIES["reference_u_1"].scale > 0
    for step in play(env, observations, 1000):
        assert all(observation[index] >= 0 for observation in step[0].values())


def test_a_followers_reference_moves_with_its_twist():
    env = tlf_env.parallel_env("infinity", end_on=())
    observations, infos = env.reset(seed=0)
    for _ in range(600):
        before, seen = references(infos), list(observations.values())
        observations, *_, infos = env.step(reference_actions(env, observations))
        rates = (references(infos) - before) / 0.02
        for i in (1, 2):
            u_1, u_2 = entry(seen[i], "reference_u_1"), entry(seen[i], "reference_u_2")
            assert math.hypot(*rates[i, :2]) == pytest.approx(u_1, rel=1e-5, abs=1e-3)
            assert rates[i, 2] == pytest.approx(u_2, rel=1e-5, abs=1e-5)


# Dead reckoning over what the radio lost


@untimed
@given(places, places, headings, speeds, turns, st.floats(0, 2))
def test_dead_reckoning_is_the_integral_of_the_twist(x, y, theta, u_1, u_2, duration):
    """On a line or a circle, against fine steps of Runge and Kutta's fourth order."""

    def rate(t: float) -> np.ndarray:
        return np.array([-u_1 * math.sin(theta + u_2 * t), u_1 * math.cos(theta + u_2 * t)])

    place, step = np.array([x, y]), duration / 100
    for k in range(100):
        t = k * step
        place = place + step / 6 * (rate(t) + 4 * rate(t + step / 2) + rate(t + step))
    found = dead_reckoned(Message(x, y, theta, u_1, u_2), duration)
    np.testing.assert_allclose(found[:2], place, rtol=0, atol=1e-6)
    assert found[2:] == (theta + u_2 * duration, u_1, u_2)


@untimed
@given(headings, speeds, turns, st.floats(0, 2), st.floats(0, 2))
def test_dead_reckoning_in_two_steps_is_that_in_one(theta, u_1, u_2, first, second):
    message = Message(100.0, -50.0, theta, u_1, u_2)
    found = dead_reckoned(dead_reckoned(message, first), second)
    np.testing.assert_allclose(found, dead_reckoned(message, first + second), rtol=0, atol=1e-9)
    assert dead_reckoned(message, 0.0) == message


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-5, 1.9e-4, 2.1e-4, 1e-3])
def test_dead_reckoning_is_smooth_where_the_circle_becomes_a_line(turn):
    half = turn / 2
    chord = 500.0 * (1 - half**2 / 6 + half**4 / 120)
    found = dead_reckoned(Message(0.0, 0.0, 0.0, 500.0, turn), 1.0)
    assert math.hypot(found.x, found.y) == pytest.approx(chord, rel=1e-15)
