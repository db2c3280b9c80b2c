"""Model predictive control: its plans against a solution of the whole problem, its constraints, its doors."""

import sys

import numpy as np
import pytest

from baselines.policies.laws.catalogue import make_law
from baselines.policies.laws.predictive import NODE, PREVIEW_S, Predictive
from baselines.policies.registry import fit_policy, make_policy
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

casadi = pytest.importorskip("casadi")

AT_REST = np.zeros((len(PREVIEW_S), 2))


def circle(u_1, u_2, e_1=0.0, e_2=0.0, e_3=0.0):
    """Previews ``(preview, 6)`` of a reference with a constant twist, with errors as of eq. (16)."""
    rows = []
    for time_s in PREVIEW_S:
        turn = u_2 * time_s
        ahead, right = u_1 * time_s, 0.0
        if u_2:
            ahead, right = u_1 / u_2 * np.sin(turn), -u_1 / u_2 * (1 - np.cos(turn))
        sin, cos = np.sin(e_3), np.cos(e_3)
        place = e_1 + cos * ahead + sin * right, e_2 - sin * ahead + cos * right
        rows.append((*place, np.sin(turn + e_3), np.cos(turn + e_3), u_1, u_2))
    return np.array(rows)


def converged(law, start, nodes, plan=AT_REST, steps=30):
    for _ in range(steps):
        plan, jump = law.improved(np.array(start, dtype=float), nodes, plan)
        assert jump == 0.0  # none is allowed
    return plan


def predicted(start, plan):
    """Poses and twists ``(preview, 5)`` by small steps, in the robot's axes (forward, right, turn)."""
    x, y, turn, u_1, u_2 = 0.0, 0.0, 0.0, start[0], start[1]
    rows, dt = [], 1e-3
    dead = round(0.02 / dt)
    k, ends = 0, [round(time_s / dt) for time_s in PREVIEW_S]
    for i in range(ends[-1]):
        a_1, a_2 = (0.0, 0.0) if i < dead else plan[k]
        middle = turn + 0.5 * dt * (u_2 + start[3])
        x += dt * (u_1 + start[2] + 0.5 * dt * a_1) * np.cos(middle)
        y -= dt * (u_1 + start[2] + 0.5 * dt * a_1) * np.sin(middle)
        turn += dt * (u_2 + start[3] + 0.5 * dt * a_2)
        u_1, u_2 = u_1 + dt * a_1, u_2 + dt * a_2
        if i + 1 == ends[k]:
            rows.append((x, y, turn, u_1, u_2))
            k += 1
    return np.array(rows)


@pytest.mark.parametrize(("u_1", "u_2"), [(300.0, 0.0), (250.0, 0.5), (200.0, -0.7)])
def test_on_the_reference_nothing_is_changed(u_1, u_2):
    plan = converged(Predictive(), (u_1, u_2, 0, 0, u_1, u_2), circle(u_1, u_2))
    np.testing.assert_allclose(plan, 0.0, atol=0.02)


def cost(law, start, nodes, plan):
    """The cost of a plan by another prediction."""
    states = predicted(start, plan)
    span = np.diff((law.dead_time_s, *PREVIEW_S))
    weight = span * np.where(np.arange(len(span)) == len(span) - 1, law.last_weight, 1.0)
    turn = np.sin(states[:, 2]) * nodes[:, 3] - np.cos(states[:, 2]) * nodes[:, 2]
    deviations = np.column_stack(
        [states[:, :2] - nodes[:, :2], turn, states[:, 3:] + start[2:4] - nodes[:, 4:]]
    )
    needed = np.diff(np.vstack([start[4:], nodes[:, 4:]]), axis=0) / law.intervals_s[:, None]
    efforts = (plan - needed) / law.efforts
    return weight @ np.sum((deviations / law.tolerances) ** 2, axis=1) + span @ np.sum(
        efforts**2, axis=1
    )


@pytest.mark.parametrize("errors", [(5.0, -8.0, 0.05), (-3.0, 6.0, 0.1)])
def test_a_plan_has_the_least_cost_of_all_near_it(errors):
    law = Predictive(acceleration_mm_s2=1e3, turning_acceleration_mm_s2=1e3)
    start = np.array([220.0, 0.1, 0, 0, 250.0, 0.3])
    nodes = circle(250.0, 0.3, *errors)
    plan = converged(law, start, nodes)
    assert np.all(np.abs(plan) < law.most)  # no limit is reached
    least, random = cost(law, start, nodes, plan), np.random.default_rng(0)
    for size in (10.0, 30.0):
        for _ in range(10):
            change = size * random.normal(size=plan.shape) * [1.0, 0.05]
            assert cost(law, start, nodes, plan + change) > least
    assert cost(law, start, nodes, AT_REST) > 1.5 * least


@pytest.mark.parametrize("errors", [(400.0, 0.0, 0.0), (100.0, 300.0, 1.0), (-300.0, -50.0, 0.0)])
def test_every_plan_keeps_the_limits_of_the_robot(errors):
    law, start = Predictive(), (300.0, 0.3, 0, 0, 300.0, 0.3)
    plan = converged(law, start, circle(300.0, 0.3, *errors))
    assert np.all(np.abs(plan) <= law.most_of(np.array(start)))
    u_1, u_2 = predicted(start, plan)[:, 3:].T
    assert np.abs(u_2).max() < 1.5 * 1.001
    assert np.abs(u_1 * u_2).max() < 165.0 * 1.01
    assert u_1.min() > -20.0 * 1.01
    free = Predictive(
        acceleration_mm_s2=1e6,
        yaw_acceleration_rad_s2=1e4,
        yaw_rate_rad_s=1e3,
        lateral_acceleration_mm_s2=1e6,
        reverse_mm_s=1e4,
    )
    u_1, u_2 = predicted(start, converged(free, start, circle(300.0, 0.3, *errors)))[:, 3:].T
    beyond = (np.abs(u_2) / 1.5, np.abs(u_1 * u_2) / 165.0, -u_1 / 20.0, np.diff(u_1) / 19.5)
    assert max(one.max() for one in beyond) > 1.2


def test_from_rest_far_behind_it_accelerates_as_much_as_it_may():
    plan = converged(Predictive(), np.zeros(6), circle(300.0, 0.0, 400.0))
    np.testing.assert_allclose(plan[:5], np.tile([195.0, 0.0], (5, 1)), atol=1e-6)


def test_a_known_slip_is_part_of_the_prediction():
    start, nodes = (300.0, 0.2, 50.0, -0.2, 300.0, 0.2), circle(300.0, 0.2)
    twists = predicted(start, converged(Predictive(), start, nodes))[:, 3:]
    assert np.hypot(*(predicted(start, AT_REST)[-1, :2] - nodes[-1, :2])) > 30.0
    reached = predicted(start, converged(Predictive(), start, nodes))[:, :2] - nodes[:, :2]
    assert np.hypot(*reached[-1]) < 5.0
    assert twists[-1] == pytest.approx((250.0, 0.4), rel=0.1)


def test_a_mirrored_problem_has_the_mirrored_plan():
    law = Predictive()
    start, nodes = (
        np.array([200.0, 0.4, 10.0, 0.1, 250.0, 0.3]),
        circle(250.0, 0.3, 30.0, -40.0, 0.3),
    )
    plan = converged(law, start, nodes)
    mirrored = converged(law, start * [1, -1, 1, -1, 1, -1], nodes * [1, -1, -1, 1, 1, -1])
    np.testing.assert_allclose(plan * [1, -1], mirrored, atol=1e-5)


def test_one_step_from_the_last_plan_is_nearly_the_converged_plan():
    law, start = Predictive(), np.array([220.0, 0.1, 0, 0, 250.0, 0.3])
    last = converged(law, start, circle(250.0, 0.3, 10.0, -15.0, 0.1))
    nodes = circle(250.0, 0.3, 12.0, -11.0, 0.08)
    one, many = converged(law, start, nodes, last, 1), converged(law, start, nodes, last)
    assert np.abs(many - last).max() > 5.0
    assert np.all(np.abs(one - many) < 0.05 * np.abs(many - last).max(axis=0))


def test_near_the_reference_the_speed_may_jump_and_far_from_it_not():
    law = Predictive()
    start, nodes = np.array([270.0, 0.0, 0, 0, 300.0, 0.0]), circle(300.0, 0.0)
    _, jump = law.improved(start, nodes, AT_REST, -100.0, 160.0)
    assert 15.0 < jump < 45.0
    seen = {"present_u_1": 300.0, "granted_u_1": 270.0, "whole_e_1": 0.0, "whole_e_2": 0.0}
    ranges = []
    for e_2 in (0.0, 27.0, 300.0):
        given = {name: np.array([value]) for name, value in (seen | {"whole_e_2": e_2}).items()}
        ranges.append(tuple(float(one[0]) for one in law._jumps(given)))
    assert ranges == [(-100.0, 160.0), (-35.0, 95.0), (0.0, 0.0)]


def test_it_asks_for_its_previews_and_keeps_those_that_are_set():
    fitted = fit_policy("nmpc:bounded+ekf-slip+body", load_scenario())
    assert fitted.scenario.preview_s == PREVIEW_S
    assert len(fitted.policy.law.scales) == len(tracking_entries(PREVIEW_S))
    alone = fit_policy("nmpc", load_scenario())
    assert alone.overrides == {"preview_s": list(PREVIEW_S)}
    assert len(alone.policy.intervals_s) == len(PREVIEW_S)
    own = fit_policy("nmpc+ekf+none", load_scenario(preview_s=(0.2, 0.6)))
    assert own.overrides == {"estimator": "ekf", "broadcast_smoothing_s": 0.0}
    np.testing.assert_allclose(own.policy.law.intervals_s, [0.2, 0.4])
    assert make_policy("nmpc", load_scenario()).memory_size == 2 * len(DEFAULT_PREVIEW_S)


@pytest.mark.parametrize("preview_s", [(), (0.0, 1.0)])
def test_it_needs_previews(preview_s):
    with pytest.raises(ValueError, match=r"^nmpc needs increasing previews above 0, got preview_s"):
        make_policy("nmpc", load_scenario(preview_s=preview_s))


def test_a_missing_casadi_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    for name in ("nmpc", "nmpc:bounded+ekf-slip+body"):
        with pytest.raises(
            ValueError, match=r"^nmpc needs casadi \(.*python -m pip install 'tlf-env\[mpc\]'\)$"
        ):
            fit_policy(name, load_scenario())


def test_a_count_of_steps_below_1_is_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("steps: 0")
    with pytest.raises(ValueError, match=r"steps"):
        make_law("nmpc", str(path), load_scenario())


def test_the_entries_of_a_preview_are_those_of_the_observation():
    assert [f"{name}_in_0.5_s" for name in NODE] == list(tracking_entries((0.5,)))[-len(NODE) :]
