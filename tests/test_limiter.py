"""Limits on the twist, the lead, and the controller that has them: from outside, on board, under a residual."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import stacked, unstacked, untimed
from hypothesis import given
from hypothesis import strategies as st

import tlf_env
from baselines import ReferencePolicy
from tlf_env.engine.formation import Formation
from tlf_env.envs.single import FormationEnv
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.limiter import (
    TwistLimits,
    braked,
    closing_speed,
    limited_twist,
    saturated,
    speed_range,
    twist_limits_row,
    within,
)
from tlf_env.onboard.tracking import (
    Controller,
    TrackingGains,
    controller_row,
    gains_row,
    tracking_twist,
)
from tlf_env.physics.kinematics import odometry
from tlf_env.physics.parameters import body
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import TRACKING_ENTRIES, Preview, Tracking, tracking_entries
from tlf_env.task.scenario import load_scenario

PERIOD_S = 0.02
PREVIEW_S = (0.5, 1.0)
ENTRIES = len(tracking_entries(PREVIEW_S))
SCALES = np.array([entry.scale for entry in tracking_entries(PREVIEW_S).values()])
NONE = twist_limits_row(TwistLimits(), PERIOD_S)
TUNED = controller("tuned").limits
ALL = twist_limits_row(TUNED, PERIOD_S)
PAPERS = ["consistent", "printed"]

speeds = st.floats(-2000, 2000)
yaws = st.floats(-20, 20)
twists = st.tuples(speeds, yaws)
errors = st.floats(0, 1200)  # position, mm
slips = st.tuples(st.floats(-60, 60), st.floats(-0.4, 0.4))


def place(name: str) -> int:
    return Tracking._fields.index(name)


def range_now(last, slip, cruise: float, error: float) -> tuple[float, float]:
    """Speeds (mm/s) of the wheels that may be asked for next."""
    low, high = speed_range(last[0] + slip[0], last[1] + slip[1], cruise, error, ALL)
    return low - slip[0], high - slip[0]


def batch(rows: int = 64, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (rows, ENTRIES)).astype(np.float32)


# The limiter


@untimed
@given(twists, twists, slips, speeds, errors)
def test_without_limits_the_twist_is_left_bit_for_bit(u, last, slip, cruise, error):
    assert limited_twist(*u, *last, *slip, cruise, error, NONE) == u
    assert braked(saturated(u[0], NONE.forward_error), NONE.braking_error) == u[0]


@pytest.mark.parametrize("name", PAPERS)
def test_without_limits_the_policy_is_the_papers_law_bit_for_bit(name):
    seen, gains = batch(500), gains_row(controller(name).gains)
    expected = np.empty((len(seen), 2), dtype=np.float32)
    for row, out in zip(seen, expected, strict=True):
        values = [
            float(row[place(entry)]) * TRACKING_ENTRIES[entry].scale
            for entry in ("e_1", "e_2", "sin_e_3", "cos_e_3", "reference_u_1", "reference_u_2")
        ]
        u_1, u_2 = tracking_twist(*values, gains)
        out[0] = min(max(u_1 / FULL_SPEED_MM_S, -1.0), 1.0)
        out[1] = min(max(u_2 / FULL_YAW_RATE_RAD_S, -1.0), 1.0)
    assert ReferencePolicy(name).predict(seen)[0].tobytes() == expected.tobytes()


@untimed
@given(twists, twists, slips, speeds, errors)
def test_limits_hold(u, last, slip, cruise, error):
    """Of the body's twist, the wheels' plus the slip."""
    v_1, v_2 = limited_twist(*u, *last, *slip, cruise, error, ALL)
    b_1, b_2 = v_1 + slip[0], v_2 + slip[1]
    low, high = range_now(last, slip, cruise, error)
    assert low - 1e-9 <= v_1 <= high + 1e-9
    assert abs(b_1 * b_2) <= ALL.lateral * (1 + 1e-9) + 1e-9
    if abs(v_2 - last[1]) > ALL.step_2 + 1e-9:
        assert abs(b_1 * b_2) == pytest.approx(ALL.lateral, rel=1e-6)
        assert abs(b_2) < abs(last[1] + slip[1])


@untimed
@given(twists, twists, slips, speeds, errors)
def test_catching_up_gives_way_before_turning_and_turning_before_the_references_speed(
    u, last, slip, cruise, error
):
    v_1, v_2 = limited_twist(*u, *last, *slip, cruise, error, ALL)
    low, high = speed_range(last[0] + slip[0], last[1] + slip[1], cruise, error, ALL)
    c_1 = min(max(u[0], low), high)  # as if the turn had no limit
    c_2 = within(within(u[1], 0.0, ALL.yaw_rate), last[1] + slip[1], ALL.step_2)
    slowest = 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
    if abs(v_1 + slip[0]) < abs(c_1) - 1e-9:  # slower, and no more than it had to be
        assert abs(v_1 + slip[0]) >= abs(cruise) - 1e-9
    if abs(v_2 + slip[1]) < abs(c_2) - 1e-9:  # turning gave way, for speed could not
        assert abs(v_1 + slip[0]) <= max(abs(cruise), slowest) + 1e-9


@untimed
@given(twists, twists, slips, speeds, errors)
def test_limiting_a_limited_twist_changes_nothing(u, last, slip, cruise, error):
    v_1, v_2 = limited_twist(*u, *last, *slip, cruise, error, ALL)
    again = limited_twist(v_1 + slip[0], v_2 + slip[1], *last, *slip, cruise, error, ALL)
    assert again == pytest.approx((v_1, v_2), rel=1e-12, abs=1e-9)


@untimed
@given(st.floats(-100, 100), st.floats(-0.4, 0.4), slips, speeds, errors)
def test_what_is_within_the_limits_is_left_but_for_the_slip(u_1, u_2, slip, cruise, error):
    last = u_1 - slip[0] + 0.5 * ALL.step_1, u_2 - slip[1] - 0.5 * ALL.step_2
    assert limited_twist(u_1, u_2, *last, *slip, cruise, error, ALL) == (
        u_1 - slip[0],
        u_2 - slip[1],
    )


@untimed
@given(twists, twists, slips, speeds, errors)
def test_limits_are_the_same_to_the_left_and_to_the_right_and_back_and_forth(
    u, last, slip, cruise, error
):
    v_1, v_2 = limited_twist(*u, *last, *slip, cruise, error, ALL)
    for turn, way in ((-1.0, 1.0), (1.0, -1.0)):
        mirrored = [
            sign * value
            for pair in (u, last, slip)
            for sign, value in zip((way, turn), pair, strict=True)
        ]
        assert limited_twist(*mirrored, way * cruise, error, ALL) == (way * v_1, turn * v_2)


GENTLE = twist_limits_row(
    TwistLimits(closing_deceleration_mm_s2=50.0, closing_speed_mm_s=20.0), PERIOD_S
)


@untimed
@given(speeds, st.floats(0, 700), st.floats(-1200, 1200))
def test_the_approach_only_slows_down_and_never_below_the_references_speed(u_1, cruise, e_1):
    v_1 = closing_speed(u_1, cruise, e_1, GENTLE)
    assert v_1 <= u_1
    assert v_1 == u_1 or v_1 >= cruise + 20.0
    assert closing_speed(u_1, cruise, e_1, NONE) == u_1
    assert closing_speed(u_1, cruise, -abs(e_1), GENTLE) == min(u_1, cruise + 20.0)


@pytest.mark.parametrize("final_mm_s", [0.0, 20.0])
def test_a_robot_that_approaches_as_fast_as_it_may_brakes_at_a_constant_rate(final_mm_s):
    """From 300 mm behind: Δv² = 2·a·e, and the time that a constant deceleration takes."""
    row = GENTLE._replace(closing_speed=final_mm_s)
    behind_mm, time_s, dt_s = 300.0, 0.0, 1e-4
    speeds_mm_s = []
    while behind_mm > 1e-3:
        speeds_mm_s.append(closing_speed(1e9, 400.0, behind_mm, row) - 400.0)
        behind_mm -= speeds_mm_s[-1] * dt_s
        time_s += dt_s
    first = math.sqrt(final_mm_s**2 + 2 * 50.0 * 300.0)
    assert speeds_mm_s[0] == pytest.approx(first)
    assert time_s == pytest.approx((first - final_mm_s) / 50.0, rel=2e-2)
    rates = -np.diff(speeds_mm_s[: int(0.9 * len(speeds_mm_s))]) / dt_s
    np.testing.assert_allclose(rates, 50.0, rtol=2e-2)


free = st.floats(-TUNED.free_speed_mm_s, TUNED.free_speed_mm_s)


@untimed
@given(free, free, slips, st.floats(0, 600))
def test_about_the_references_speed_a_small_error_is_corrected_at_once(wish, last, slip, cruise):
    wish, last = 0.999 * wish, 0.999 * last  # without rounding at the edges
    v_1, _ = limited_twist(
        cruise + wish, 0.0, cruise + last - slip[0], 0.0, *slip, cruise, 0.0, ALL
    )
    assert v_1 + slip[0] == pytest.approx(cruise + wish)


@pytest.mark.parametrize("error", [0.0, 5.0, 1000.0])
def test_catching_up_from_rest_is_limited_whatever_the_error(error):
    v_1, _ = limited_twist(500.0, 0.0, 0.0, 0.0, 0.0, 0.0, 500.0, error, ALL)
    assert v_1 == pytest.approx(ALL.step_1)


def test_the_yaw_rate_has_a_limit_of_its_own():
    _, v_2 = limited_twist(10.0, 5.0, 10.0, ALL.yaw_rate, 0.0, 0.0, 10.0, 0.0, ALL)
    assert v_2 == ALL.yaw_rate


def test_a_large_error_leaves_the_limit_on_the_acceleration():
    cruise = 300.0
    v_1, _ = limited_twist(600.0, 0.0, cruise, 0.0, 0.0, 0.0, cruise, 1000.0, ALL)
    assert v_1 == pytest.approx(cruise + ALL.step_1)


@untimed
@given(st.floats(-5000, 5000), st.floats(-5000, 5000))
def test_the_forward_error_saturates_smoothly(e, other):
    most = ALL.forward_error
    assert abs(saturated(e, most)) <= min(abs(e) + 1e-12, TUNED.forward_error_mm)
    assert saturated(-e, most) == -saturated(e, most)
    assert (saturated(e, most) - saturated(other, most)) * (e - other) >= 0
    assert saturated(most / 300, most) == pytest.approx(most / 300, rel=1e-5)


@untimed
@given(st.floats(-5000, 5000), st.floats(-5000, 5000), st.floats(1, 500))
def test_an_error_that_is_braked_grows_as_its_root(e, other, linear):
    assert abs(braked(e, linear)) <= abs(e)
    assert braked(-e, linear) == -braked(e, linear)
    assert (braked(e, linear) - braked(other, linear)) * (e - other) >= 0
    if abs(e) <= linear:
        assert braked(e, linear) == e
    else:
        assert braked(e, linear) ** 2 == pytest.approx(linear * (2 * abs(e) - linear))


@pytest.mark.parametrize("k_1_per_s", [0.5, 1.2])
def test_a_braked_error_falls_under_a_constant_deceleration(k_1_per_s):
    """ė = −k₁·braked(e) from 700 mm: the speed falls by k₁²·w a second until e is w."""
    linear, dt = 50.0, 1e-4
    error, speeds = 700.0, []
    while error > linear:
        speeds.append(k_1_per_s * braked(error, linear))
        error -= speeds[-1] * dt
    decelerations = -np.diff(speeds) / dt
    np.testing.assert_allclose(decelerations, k_1_per_s**2 * linear, rtol=1e-3)


def test_limits_on_accelerations_are_per_second():
    half = twist_limits_row(TUNED, PERIOD_S / 2)
    assert (2 * half.step_1, 2 * half.step_2) == (ALL.step_1, ALL.step_2)
    assert 2 * half.turning_loss == ALL.turning_loss
    assert half.lateral == ALL.lateral


def test_acceleration_at_the_lateral_limit_is_the_one_for_turns():
    last = (250.0, TUNED.lateral_acceleration_mm_s2 / 250.0)
    v_1, _ = limited_twist(1000.0, last[1], *last, 0.0, 0.0, 1000.0, 0.0, ALL)
    assert v_1 - last[0] == pytest.approx(TUNED.turning_acceleration_mm_s2 * PERIOD_S)
    straight, _ = limited_twist(1000.0, 0.0, 250.0, 0.0, 0.0, 0.0, 1000.0, 0.0, ALL)
    assert straight - 250.0 == pytest.approx(TUNED.acceleration_mm_s2 * PERIOD_S)


@pytest.mark.parametrize("field", [name for name in TwistLimits.model_fields if "_mm" in name])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_impossible_limits_are_refused(field, value):
    if field in ("reverse_mm_s", "free_speed_mm_s", "closing_speed_mm_s") and value == 0.0:
        assert getattr(TwistLimits(**{field: value}), field) == 0.0
        return
    with pytest.raises(ValueError, match=field):
        TwistLimits(**{field: value})


# The whole loop


@pytest.mark.parametrize("disturbance", ["nominal", "combined-hard"])
def test_limits_hold_on_every_command_of_an_episode(disturbance):
    """Observations and actions are float32."""
    scenario = load_scenario(
        "infinity", disturbance=disturbance, estimator="ekf-slip", horizon_s=40.0, end_on=()
    )
    formation = Formation(scenario)
    formation.reset(3)
    a, policy, robot = formation.arrays, ReferencePolicy("tuned"), body(scenario.robot)
    last, at_limit = np.zeros((2, 3)), np.zeros(3, dtype=int)
    for _ in range(scenario.horizon_steps):
        slip = a.rows("slip")[:2, :, 0].copy()
        seen = a.observations[0] * SCALES
        cruise, error = seen[:, place("reference_u_1")], np.hypot(*seen[:, :2].T)
        ranges = [
            range_now(last[:, r], slip[:, r], cruise[r], error[r]) for r in range(last.shape[1])
        ]
        low, high = np.transpose(ranges)
        a.actions[0] = policy.predict(a.observations[0])[0]
        formation.step()
        twist = np.array(
            odometry.py_func(a.rows("wanted")[0, :, 0], a.rows("wanted")[1, :, 0], robot.R, robot.h)
        )
        step, lateral = np.abs(twist - last), np.abs(np.prod(twist + slip, axis=0))
        assert (twist[0] >= low - 1e-3).all()
        assert (twist[0] <= high + 1e-3).all()
        assert (lateral <= ALL.lateral + 0.05).all()
        gives_way = step[1] > ALL.step_2 + 1e-5
        assert (lateral[gives_way] >= ALL.lateral - 0.05).all()
        at_limit[0] += np.count_nonzero(step[0] > ALL.step_1 - 1e-3)
        at_limit[1] += np.count_nonzero(step[1] > ALL.step_2 - 1e-5)
        at_limit[2] += np.count_nonzero(lateral > ALL.lateral - 0.05)
        last = twist
    assert at_limit[0] > 0
    assert at_limit[2] > 0


@pytest.mark.parametrize("base", ["tuned", "consistent"])
def test_a_residual_of_zero_is_the_base_run_as_a_twist(base):
    fields = {"estimator": "ekf-slip", "disturbance": "combined-medium", "end_on": ()}
    policy = ReferencePolicy(base)
    one = Formation(load_scenario("infinity", action="twist", **fields))
    other = Formation(load_scenario("infinity", action="residual", residual_base=base, **fields))
    one.reset(0)
    other.reset(0)
    for _ in range(one.scenario.horizon_steps):
        one.arrays.actions[0] = policy.predict(one.arrays.observations[0])[0]
        one.step()
        other.step()
        assert one.arrays.rows("motion").tobytes() == other.arrays.rows("motion").tobytes()
        assert one.arrays.rows("wanted").tobytes() == other.arrays.rows("wanted").tobytes()


def test_a_residual_stays_within_the_limits_of_its_base():
    fields = {"action": "residual", "residual_base": "tuned", "estimator": "ekf"}  # no slip
    scenario = load_scenario("infinity", horizon_s=10.0, **fields)
    formation = Formation(scenario)
    formation.reset(0)
    rng, a = np.random.default_rng(0), formation.arrays
    robot, last = body(scenario.robot), np.zeros(3)
    for _ in range(scenario.horizon_steps):
        seen = a.observations[0] * SCALES
        cruise, error = seen[:, place("reference_u_1")], np.hypot(*seen[:, :2].T)
        yaw = seen[:, place("command_u_2")]
        ranges = [
            range_now((last[r], yaw[r]), (0.0, 0.0), cruise[r], error[r]) for r in range(len(last))
        ]
        low, high = np.transpose(ranges)
        a.actions[0] = rng.uniform(-1, 1, a.actions[0].shape)
        formation.step()
        u_1, u_2 = odometry.py_func(
            a.rows("wanted")[0, :, 0], a.rows("wanted")[1, :, 0], robot.R, robot.h
        )
        assert (u_1 >= low - 1e-3).all()
        assert (u_1 <= high + 1e-3).all()
        assert (np.abs(u_1 * u_2) <= ALL.lateral + 0.05).all()
        last = u_1


def test_on_board_and_from_outside_it_is_the_same_policy():
    fields = {"estimator": "ekf-slip", "disturbance": "combined-medium", "horizon_s": 20.0}
    fields |= {"end_on": (), "residual_base": "tuned", "action": "twist"}
    policy = ReferencePolicy("tuned", PERIOD_S, PREVIEW_S)
    single = FormationEnv("infinity", learner="robot_1", others="reference", **fields)
    env = tlf_env.parallel_env("infinity", **fields)
    seen, _ = single.reset(seed=5)
    observations, _ = env.reset(seed=5)
    while env.agents:
        seen, *_ = single.step(policy.predict(seen)[0])
        actions = unstacked(env, policy.predict(stacked(observations))[0])
        observations, *_ = env.step(actions)
        there = single.formation_env.formation.arrays.observations[0]
        assert there.tobytes() == stacked(observations).tobytes()
        assert seen.tobytes() == observations["robot_1"].tobytes()


# What the policy reads


READ_WITH_LIMITS = ("command_u_1", "command_u_2", "slip_1", "slip_2")
READ = ("e_1", "e_2", "sin_e_3", "cos_e_3", "reference_u_1", "reference_u_2", *READ_WITH_LIMITS)
READ_OF_OTHERS = ("is_leader", *(name for name in Tracking._fields if "predecessor" in name))
AHEAD_U = [len(Tracking._fields) + Preview._fields.index(name) for name in ("u_1", "u_2")]


def leading(lead_s: float, name: str = "tuned") -> Controller:
    return controller(name).model_copy(update={"lead_s": lead_s})


def test_without_a_lead_no_preview_is_read():
    rows, other = batch(), batch(seed=1)
    needed = [place(name) for name in (*READ, *READ_OF_OTHERS)]
    other[:, needed] = rows[:, needed]
    policy = ReferencePolicy(controller("tuned").model_copy(update={"lead_s": 0.0}))
    assert policy.predict(rows)[0].tobytes() == policy.predict(other)[0].tobytes()
    short = np.ascontiguousarray(rows[:, : len(Tracking._fields)])
    assert policy.predict(rows)[0].tobytes() == policy.predict(short)[0].tobytes()


@pytest.mark.parametrize("name", READ)
def test_everything_that_it_should_read_matters(name):
    rows, other = 0.1 * batch(), 0.1 * batch()
    other[:, place(name)] += np.float32(0.01)
    policy = ReferencePolicy("tuned")
    assert policy.predict(rows)[0].tobytes() != policy.predict(other)[0].tobytes()


def test_with_a_lead_the_references_twist_is_that_of_later_by_a_straight_line():
    rows = batch().astype(np.float64)
    moved = rows.copy()
    now = [place("reference_u_1"), place("reference_u_2")]
    later = rows[:, AHEAD_U] * SCALES[AHEAD_U]
    moved[:, now] = (0.9 * rows[:, now] * SCALES[now] + 0.1 * later) / SCALES[now]
    for name in ("tuned", "consistent"):
        found, _ = ReferencePolicy(leading(0.05, name)).predict(rows)
        expected, _ = ReferencePolicy(leading(0.0, name)).predict(moved)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert (found != ReferencePolicy(leading(0.0, name)).predict(rows)[0]).any()


@pytest.mark.parametrize("preview_s", [(), (0.0, 0.5)])
def test_a_lead_needs_a_preview(preview_s):
    with pytest.raises(ValueError, match=r"lead_s 0\.05 needs a first preview above 0"):
        ReferencePolicy(leading(0.05), preview_s=preview_s)
    with pytest.raises(ValueError, match="lead_s"):
        controller_row(leading(0.05), PERIOD_S)
    ReferencePolicy(leading(0.0), preview_s=preview_s)


def test_a_lead_does_not_read_beyond_a_short_observation():
    with pytest.raises(ValueError, match="shape"):
        ReferencePolicy(leading(0.05)).predict(np.zeros(len(Tracking._fields), dtype=np.float32))


def test_gains_alone_are_a_controller_without_limits():
    assert ReferencePolicy(TrackingGains()).controller == controller("consistent")
    assert controller("consistent") == Controller()


def test_an_unknown_name_is_reported_with_those_there_are():
    with pytest.raises(
        ValueError, match=r"'bold' is not one of adrc, consistent, linearised, printed, tuned"
    ):
        controller("bold")
    with pytest.raises(
        ValueError, match=r"'bold' is not one of adrc, consistent, linearised, printed, tuned"
    ):
        load_scenario("infinity", residual_base="bold")
