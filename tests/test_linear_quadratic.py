"""The linear-quadratic law: its gains against other solutions of the same problem, and its limits."""

import math

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

from baselines.policies.laws.catalogue import make_law
from baselines.policies.laws.linear_quadratic import LinearQuadratic
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

ENTRIES = tracking_entries(DEFAULT_PREVIEW_S)
B = -np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])


def a_of(u_1, u_2):
    return np.array([[0.0, -u_2, 0.0], [u_2, 0.0, -u_1], [0.0, 0.0, 0.0]])


def discretised(u_1, u_2, step):
    """Exact F and G of a step."""
    whole = np.zeros((5, 5))
    whole[:3, :3], whole[:3, 3:] = a_of(u_1, u_2), B
    found = expm(whole * step)
    return found[:3, :3], found[:3, 3:]


def gain(law, *twists):
    """The gain for one row; a single twist is that at all times."""
    times = len(law.times_s)
    given = np.array(twists if len(twists) == times else twists * times, dtype=float)
    return law.gains(given[None])[0]


@pytest.mark.parametrize("twist", [(300.0, 0.0), (300.0, 0.8), (200.0, -1.5), (-150.0, 0.3)])
def test_with_a_long_horizon_the_gain_is_that_of_the_algebraic_riccati_equation(twist):
    law = LinearQuadratic(horizon_s=40.0, step_s=0.02)
    q, r = np.diag(law.error_weights) * law.step_s, np.diag(law.correction_weights) * law.step_s
    f, g = discretised(*twist, law.step_s)
    p = solve_discrete_are(f, g, q, r)
    wanted = -np.linalg.solve(r + g.T @ p @ g, g.T @ p @ f)
    np.testing.assert_allclose(gain(law, twist), wanted, rtol=1e-4, atol=1e-7)


def test_with_small_steps_the_gain_is_that_of_continuous_time():
    law = LinearQuadratic(horizon_s=20.0, step_s=2e-4)
    p = solve_continuous_are(
        a_of(300.0, 0.5), B, np.diag(law.error_weights), np.diag(law.correction_weights)
    )
    wanted = -np.diag(1.0 / law.correction_weights) @ B.T @ p
    np.testing.assert_allclose(gain(law, (300.0, 0.5)), wanted, rtol=3e-3, atol=1e-5)


def test_with_a_changing_twist_the_gain_minimises_the_cost_over_the_horizon():
    """The first correction of the gain is that of a dense least-squares problem over all corrections."""
    law = LinearQuadratic(horizon_s=1.5, step_s=0.05)
    twists = np.array([(100.0, 0.0), (250.0, 0.9), (350.0, -0.6)])
    weights_e, weights_v = np.sqrt(law.error_weights), np.sqrt(law.correction_weights)
    first = np.array([8.0, -5.0, 0.1])
    # e_k = free_k + sum of effect_k,j v_j
    free, effect = first, np.zeros((3, 2 * law.steps))
    rows, aims = [], []
    for k in range(law.steps):
        time = (k + 0.5) * law.step_s
        now = [np.interp(time, law.times_s, twists[:, i]) for i in (0, 1)]
        f, g = discretised(*now, law.step_s)
        free, effect = f @ free, f @ effect
        effect[:, 2 * k : 2 * k + 2] += g
        rows.append(weights_e[:, None] * effect)
        aims.append(-weights_e * free)
    rows.append(np.diag(np.tile(weights_v, law.steps)))
    aims.append(np.zeros(2 * law.steps))
    solution = np.linalg.lstsq(np.vstack(rows), np.concatenate(aims))[0]
    np.testing.assert_allclose(gain(law, *twists) @ first, solution[:2], rtol=1e-4)


def test_the_closed_loop_of_the_gain_is_stable_at_every_cruise():
    law = LinearQuadratic()
    for u_1 in (50.0, 200.0, 400.0):
        for u_2 in (-1.5, 0.0, 0.7):
            f, g = discretised(u_1, u_2, 0.02)
            poles = np.linalg.eigvals(f + g @ gain(law, (u_1, u_2)))
            assert np.abs(poles).max() < 1.0


def test_at_rest_a_lateral_error_asks_for_nothing():
    """Nothing can be done about it; the errors that can be reduced have the gains tolerance/tolerance."""
    found = gain(LinearQuadratic(horizon_s=20.0, step_s=1e-3), (0.0, 0.0))
    wanted = [[13.0 / 10.0, 0.0, 0.0], [0.0, 0.0, 0.14 / 0.04]]
    np.testing.assert_allclose(found, wanted, rtol=5e-3, atol=1e-9)
    for speed in (1e-6, 1e-3, 1.0, 10.0):  # and the gain is continuous there
        near = gain(LinearQuadratic(), (speed, 0.0)) - gain(LinearQuadratic(), (0.0, 0.0))
        assert np.abs(near).max() < 0.05 * speed


def test_a_mirrored_reference_has_the_mirrored_gain():
    law = LinearQuadratic()
    left, right = gain(law, (300.0, 0.6)), gain(law, (300.0, -0.6))
    np.testing.assert_array_equal(left * [[1, -1, -1], [-1, 1, 1]], right)


def test_the_twist_is_the_references_and_the_gain_times_the_errors():
    law = LinearQuadratic()
    e_3 = 0.4
    seen = {"e_1": 12.0, "e_2": -7.0, "sin_e_3": math.sin(e_3), "cos_e_3": math.cos(e_3)}
    for name, value in (("u_1", 300.0), ("u_2", 0.5)):
        seen |= {f"{name}_in_{time_s:g}_s": value for time_s in DEFAULT_PREVIEW_S}
        seen[f"reference_{name}"] = value
    row = np.array([seen.get(name, 0.0) / entry.scale for name, entry in ENTRIES.items()])
    action = law.predict(row)[0] * (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)
    wanted = np.array([300.0 * math.cos(e_3), 0.5]) + gain(law, (300.0, 0.5)) @ [12.0, -7.0, e_3]
    np.testing.assert_allclose(action, wanted, rtol=1e-9)


def test_a_scenario_without_previews_has_a_constant_reference():
    assert len(LinearQuadratic(()).times_s) == 1
    found, wanted = gain(LinearQuadratic(()), (300.0, 0.5)), gain(LinearQuadratic(), (300.0, 0.5))
    np.testing.assert_array_equal(found, wanted)


def test_a_horizon_shorter_than_a_step_is_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("horizon_s: 0.01")
    with pytest.raises(ValueError, match=r"^horizon_s 0\.01 must be at least step_s 0\.03$"):
        make_law("lqr", str(path), load_scenario())
