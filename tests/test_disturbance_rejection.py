"""Active disturbance rejection: what its observer finds, how fast, and that it is subtracted."""

import math

import gymnasium
import numpy as np
import pytest

import tlf_env
from baselines import ReferencePolicy
from baselines.policies.laws.disturbance_rejection import DisturbanceRejection
from baselines.policies.laws.law import ErrorBounds
from baselines.policies.laws.textbook import FeedbackLinearisation
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy, run_seeds
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_CONTROL_PERIOD_S, DEFAULT_PREVIEW_S, load_scenario

ENTRIES = tracking_entries(DEFAULT_PREVIEW_S)
T = DEFAULT_CONTROL_PERIOD_S
D_1, D_2 = 2, 3  # places in the memory


def moved(pose, twist):
    """A pose (x, y, θ; 0 faces +y) after a control period with a constant twist."""
    u_1, u_2 = twist
    turn = 0.5 * u_2 * T
    chord = u_1 * T * (math.sin(turn) / turn if turn else 1.0)
    middle = pose[2] + turn
    step = [-chord * math.sin(middle), chord * math.cos(middle), u_2 * T]
    return pose + np.array(step)


def driven(law, slip=(0.0, 0.0), steps=400, start=(0.0, 0.0, 0.0), estimated=(0.0, 0.0)):
    """Errors ``(step, 3)`` and memories of a robot that slips, and whose wheels follow at once."""
    robot, goal, wheels = np.array(start), np.zeros(3), np.array([300.0, 0.3])
    state, errors, memories = None, [], []
    for _ in range(steps):
        (d_x, d_y, e_3), theta = goal - robot, robot[2]
        sin, cos = math.sin(theta), math.cos(theta)
        e_1, e_2 = -sin * d_x + cos * d_y, cos * d_x + sin * d_y
        errors.append((e_1, e_2, e_3))
        seen = {"e_1": e_1, "e_2": e_2, "sin_e_3": math.sin(e_3), "cos_e_3": math.cos(e_3)}
        for i in (1, 2):
            seen |= {f"reference_u_{i}": (300.0, 0.3)[i - 1], f"slip_{i}": estimated[i - 1]}
            seen |= {f"odometry_u_{i}": wheels[i - 1], f"command_u_{i}": wheels[i - 1]}
        row = [seen.get(name, 0.0) / entry.scale for name, entry in ENTRIES.items()]
        wanted, state = law.wanted(np.array(row), state, slip_cancelled=any(estimated))
        memories.append(state[0])
        wheels = wanted[0] - estimated
        robot, goal = moved(robot, wheels + slip), moved(goal, (300.0, 0.3))
    return np.array(errors), np.array(memories)


@pytest.mark.parametrize("slip", [(60.0, 0.0), (0.0, -0.4), (-40.0, 0.3)])
def test_a_constant_slip_is_found_and_leaves_no_error(slip):
    errors, memories = driven(DisturbanceRejection(), slip)
    np.testing.assert_allclose(memories[-1, [D_1, D_2]], slip, rtol=0.02, atol=0.02)
    assert np.abs(errors[-1, :2]).max() < 0.5
    plain, _ = driven(DisturbanceRejection(bandwidth_rad_s=1e-9), slip)
    assert np.hypot(*plain[-1, :2]) > 15.0  # without an observer it does


@pytest.mark.parametrize("bandwidth", [2.0, 10.0])
def test_the_observer_has_two_poles_at_its_bandwidth(bandwidth):
    """The error x of the estimate obeys x[k + 2] − 2β x[k + 1] + β² x[k] = 0."""
    _, memories = driven(DisturbanceRejection(bandwidth_rad_s=bandwidth), (50.0, 0.0), 100)
    left = 50.0 - memories[1:, D_1]
    beta = math.exp(-bandwidth * T)
    np.testing.assert_allclose(left[2:], 2 * beta * left[1:-1] - beta**2 * left[:-2], atol=0.05)
    assert left[0] == pytest.approx(50.0 * (1 - (1 - beta) ** 2), rel=1e-3)


def test_without_slip_it_is_feedback_linearisation():
    start = (10.0, -20.0, 0.2)
    errors, memories = driven(DisturbanceRejection(), start=start, steps=200)
    assert np.abs(memories[:, D_1]).max() < 0.05
    assert np.abs(memories[:, D_2]).max() < 0.002

    class Plain(FeedbackLinearisation):
        def wanted(self, *given, **named):
            return super().wanted(*given, **named)[0], [np.zeros(6)]

    plain, _ = driven(Plain(ahead_mm=80.0, gain_per_s=1.3), start=start, steps=200)
    np.testing.assert_allclose(errors, plain, atol=0.05)


def test_a_slip_that_is_subtracted_behind_the_law_is_not_found_again():
    slip = (50.0, -0.3)
    errors, memories = driven(DisturbanceRejection(), slip, estimated=slip)
    assert np.abs(memories[:, [D_1, D_2]]).max() < 0.05
    assert np.abs(errors[-1]).max() < 0.05


def test_the_estimate_is_bounded():
    law = DisturbanceRejection(most_slip_mm_s=30.0, most_slip_rad_s=0.1)
    _, memories = driven(law, (60.0, 0.4), 100)
    assert memories[:, D_1].max() == 30.0
    assert memories[:, D_2].max() == 0.1


def test_the_observer_sees_the_errors_without_bounds():
    bounds = ErrorBounds(forward_error_mm=20.0, lateral_error_mm=20.0)
    _, memories = driven(DisturbanceRejection(bounds=bounds), start=(200.0, -300.0, 0.5), steps=150)
    assert np.abs(memories[:, D_1]).max() < 0.3
    assert np.abs(memories[:, D_2]).max() < 0.01


def test_side_by_side_and_alone_the_memories_are_apart():
    scenario = load_scenario("infinity", horizon_s=2.0, disturbance="slip", plant="batch")
    fitted = fit_policy("adrc:bounded+ekf-slip+body", scenario)
    together = list(run_seeds(fitted.scenario, fitted.policy, [3, 4]))
    for seed, record in zip((3, 4), together, strict=True):
        alone = run_policy(fitted.scenario, fitted.policy, seed)
        np.testing.assert_array_equal(record["x_mm"], alone["x_mm"])
    assert (together[0]["x_mm"] != together[1]["x_mm"]).any()


def test_a_reset_of_the_environment_clears_the_memory_of_the_others():
    fitted = fit_policy("adrc:bounded+ekf-slip+body", load_scenario("infinity"))
    env = gymnasium.make(
        "tlf_env/Infinity-v0", others=fitted.policy, disturbance="slip", estimator="ekf-slip"
    )

    def rewards(seed):
        env.reset(seed=seed)
        return [env.step(np.zeros(2, dtype=np.float32))[1] for _ in range(60)]

    first = rewards(3)
    rewards(4)
    assert rewards(3) == first


def test_the_reference_with_rejection_keeps_its_state_and_starts_anew_without():
    policy = ReferencePolicy("adrc")
    speeds = ("reference_u_1", "command_u_1", "odometry_u_1", "u_1_in_0.5_s")
    moving = dict.fromkeys(speeds, 300.0) | {"cos_e_3": 1.0, "is_leader": 1.0}
    moving["odometry_u_1"] = 280.0
    row = [moving.get(name, 0.0) / entry.scale for name, entry in ENTRIES.items()]
    rows = np.tile(row, (4, 1))
    rows[:, 0] += [0.001, 0.002, 0.003, 0.004]  # e_1
    first, state = policy.predict(rows)
    assert state.shape == (4, 7)
    assert (state[:, D_1] == 0).all()
    kept = state.copy()
    second, later = policy.predict(rows, state)
    np.testing.assert_array_equal(state, kept)  # the given state is not changed
    assert (later[:, D_1] != 0).all()
    assert (first != second).any()
    start = np.array([True, False, True, False])
    mixed, _ = policy.predict(rows, state, start)
    np.testing.assert_array_equal(mixed[start], first[start])
    np.testing.assert_array_equal(mixed[~start], second[~start])
    with pytest.raises(ValueError, match=r"the state must be of the shape \(4, 7\), got \(3, 7\)"):
        policy.predict(rows, state[:3])


def test_without_rejection_the_state_is_passed_through():
    rows = np.zeros((2, len(ENTRIES)), dtype=np.float32)
    assert ReferencePolicy("linearised").predict(rows, "anything")[1] == "anything"


def test_the_observer_in_the_engine_starts_anew_with_each_episode():
    """The same seed after another one: the same run, bit for bit."""
    env = gymnasium.make(
        "tlf_env/Infinity-v0", residual_base="adrc", action="residual", disturbance="slip"
    )

    def seen(seed):
        env.reset(seed=seed)
        return [env.step(np.zeros(2, dtype=np.float32))[0].tobytes() for _ in range(120)]

    first = seen(3)
    seen(4)
    assert seen(3) == first


def test_a_residual_of_zero_is_the_law_with_its_memory():
    """What the engine keeps is what the policy keeps: a residual of zero drives as the policy does."""
    options = {"disturbance": "slip", "horizon_s": 3.0}
    by_engine = tlf_env.parallel_env("infinity", action="residual", residual_base="adrc", **options)
    by_policy = tlf_env.parallel_env("infinity", **options)
    policy, state = ReferencePolicy("adrc"), None
    zero = dict.fromkeys(by_engine.possible_agents, np.zeros(2, dtype=np.float32))
    seen, _ = by_policy.reset(seed=1)
    by_engine.reset(seed=1)
    while by_policy.agents:
        actions, state = policy.predict(np.stack([seen[one] for one in by_policy.agents]), state)
        seen, *_, infos = by_policy.step(dict(zip(by_policy.agents, actions, strict=True)))
        others = by_engine.step(zero)[4]
        assert {k: v["x_mm"] for k, v in others.items()} == {k: v["x_mm"] for k, v in infos.items()}
    assert np.abs(state[:, D_1]).max() > 1.0
