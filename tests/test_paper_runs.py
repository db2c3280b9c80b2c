"""``tlf paper``: parts that drive many runs side by side, and what they make of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from page_tables import DOCS
from scipy.stats import chi2

pytest.importorskip("control")
pytest.importorskip("matplotlib")
pytest.importorskip("SALib")

from baselines.paper import ekf, errors, lanes, robustness, screening, slip, unpublished
from baselines.paper.results import read_results
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from tlf_env.engine.formation import Formation
from tlf_env.onboard.tracking import tracking_twist
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.scenario import load_scenario

SHORT_S = 4.0


def short(task: str = "infinity", **fields: object) -> lanes.Scenario:
    """The first seconds of a simulation of the paper."""
    return load_scenario(
        task,
        plant="batch",
        estimator="ekf",
        broadcast_smoothing_s=0.0,
        time_gap_s=2.0,
        horizon_s=SHORT_S,
        **fields,
    )


def same(one: lanes.Ends, other: lanes.Ends) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


# --- runs side by side


def test_errors_are_those_of_recorded_runs():
    scenario = short()
    policy = fit_policy("reference:consistent", scenario).policy
    ends = lanes.drive([scenario], policy, [7, 8])
    for run, seed in enumerate((7, 8)):
        error = run_policy(scenario, policy, seed)["position_error_mm"]
        steps = len(error) - 1  # the record has the start, too
        settled, late = error[1 + int(0.4 * steps) :], error[1 + int(0.7 * steps) :]
        np.testing.assert_allclose(ends.rms_mm[run], np.sqrt((settled**2).mean(axis=0)), rtol=1e-12)
        np.testing.assert_allclose(
            ends.late_rms_mm[run], np.sqrt((late**2).mean(axis=0)), rtol=1e-12
        )
        np.testing.assert_array_equal(ends.largest_mm[run], error[1:].max(axis=0))


def test_a_run_does_not_depend_on_those_beside_it():
    """Other robots, gains and seeds beside it change no bit."""
    scenario, heavy = short(), short(robot=robustness.heavy(0.5))
    policies = [slip.policy("printed"), slip.policy("consistent", eta=0.0)]
    together = lanes.drive([scenario, heavy], lanes.Several(policies), [3, 4])
    for run, (one, policy) in enumerate(zip((scenario, heavy), policies, strict=True)):
        assert same(lanes.drive([one], policy, [3 + run]), lanes.run_of(together, [run]))
    assert not np.array_equal(together.rms_mm[0], together.rms_mm[1])


def test_a_long_row_begins_with_the_short_one():
    policy = fit_policy("reference:consistent", short()).policy
    long = lanes.drive([short(robots=5)], policy, [1])
    few = lanes.drive([short(robots=2)], policy, [1])
    for name in lanes.Ends._fields:
        np.testing.assert_array_equal(getattr(long, name)[:, :2], getattr(few, name), name)


def test_a_lost_robot_loses_its_run():
    error = np.array([[5.0, 8.0], [5.0, 150.0], [5.0, 8.0]])
    largest = np.array([[50.0, 80.0], [50.0, 400.0], [1300.0, 80.0]])
    ends = lanes.Ends(error, error, largest)
    assert ends.lost.tolist() == [False, True, True]
    assert ends.worst_mm.tolist() == [8.0, math.inf, math.inf]
    assert ends.gone.tolist() == [[False, False], [False, True], [True, False]]


# --- slip in ideal kinematics


def rest_error(eta: float, epsilon: float, size: float, k_1: float) -> float:
    """|e₁| at rest of eq. (17) with (19) and (21) on a straight line, by hand."""
    inside = size / (k_1 + eta**2 / epsilon)
    return inside if eta * inside < epsilon else max(epsilon / eta, (size - eta) / k_1)


@pytest.mark.parametrize("eta", [0.19, 1.9])
def test_forward_slip_leaves_the_error_at_rest(eta):
    k_1 = slip.law_of(eta, 1.0).gains.k_1
    pairs = slip.inside_errors(eta)
    assert len(pairs) > 8
    for epsilon, error in pairs:
        assert error == pytest.approx(rest_error(eta, epsilon, eta, k_1), rel=1e-5)


def test_slip_beyond_eta_leaves_what_eta_does_not_cover():
    k_1 = slip.law_of(1.9, 1.0).gains.k_1
    for size in (0.5, 4.0, 20.0):
        (found,) = slip.left(slip.law_of(1.9, 1.0), size)[0]
        assert found == pytest.approx(rest_error(1.9, 1.0, size, k_1), rel=1e-4)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_the_bound_holds_for_the_forward_error_and_is_reached(eta, epsilon):
    k_1 = 0.23
    bound = math.sqrt(epsilon / (4 * k_1))
    assert rest_error(eta, epsilon, eta, k_1) <= bound * (1 + 1e-12)
    assert rest_error(math.sqrt(k_1 * epsilon), epsilon, math.sqrt(k_1 * epsilon), k_1) == (
        pytest.approx(bound)
    )


def test_a_law_that_is_off_leaves_slip_over_the_gain():
    law = slip.law_of(0.0, 0.1)
    assert not law.complementary
    assert slip.left(law, 5.0)[0] == pytest.approx(5.0 / law.gains.k_1, rel=1e-5)


def test_yaw_slip_leaves_an_error_to_the_side_that_no_eta_changes():
    with_law, without, formula = slip.yaw_error()
    assert with_law == pytest.approx(formula, rel=1e-6)
    assert without == pytest.approx(formula, rel=1e-6)


def test_rates_with_slip_are_those_of_the_law_on_board():
    law = errors.laws()["consistent, ϱ on"]
    rng = np.random.default_rng(3)
    for e in rng.uniform([-300, -300, -3], [300, 300, 3], (50, 3)):
        v, w = tracking_twist(e[0], e[1], math.sin(e[2]), math.cos(e[2]), 321.0, -0.4, law.gains)
        v, w = v + 7.0, w - 0.2
        expected = [-e[1] * w + 321 * math.cos(e[2]) - v, e[0] * w - 321 * math.sin(e[2]), -0.4 - w]
        found = errors.rates(e[:, None], 321.0, -0.4, law, (7.0, -0.2))[:, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


# --- κ and the row


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.5])
def test_a_heavy_robot_has_the_kappa_of_its_name(factor):
    def kappa(robot: RobotParameters) -> float:
        return 1 / (0.4 * robot.mass_kg * robot.wheel_radius_mm**2 + robot.wheel_inertia_kg_mm2)

    robot, ours = robustness.heavy(factor), RobotParameters()
    assert kappa(robot) / kappa(ours) == pytest.approx(factor, rel=1e-12)
    assert robot.body_inertia_kg_mm2 / robot.mass_kg == pytest.approx(
        ours.body_inertia_kg_mm2 / ours.mass_kg
    )


def test_the_middle_variant_is_the_nominal_loop():
    scenario = load_scenario("infinity")
    assert robustness.variants()["K × 1"]["wheel_loop"] == scenario.wheel_loop


@given(arrays(np.bool_, (4, 6)))
def test_more_robots_lose_no_fewer_runs(gone):
    error = np.where(gone, 500.0, 1.0)
    ends = lanes.Ends(error, error, error)
    shares = robustness.share_lost(ends)
    assert (np.diff(shares) >= 0).all()
    assert shares[-1] == ends.lost.mean()
    assert robustness.longest(ends) == int((~gone.any(axis=0)).cumprod().sum())
    assert robustness.steps(shares)[0] == (1, shares[0])
    assert robustness.steps(shares)[-1] == (6, shares[-1])


# --- the filter


def test_nees_and_nis_of_a_known_filter_have_their_means():
    """A course of Gaussian errors with the covariance that the filter gives has means of 3 and 2."""
    rng = np.random.default_rng(5)
    shape = (3000, 2, 3)
    nees, nis = (chi2.rvs(n, size=shape, random_state=rng) for n in (3, 2))
    t_s = 0.02 * (1 + np.arange(shape[0]))
    one = ekf.Course(t_s, np.zeros(shape), np.ones(shape), nees, nis, np.zeros(shape))
    by_name = {claim.name: claim for claim in ekf.CLAIMS}
    data = ekf.Filter({"∞": one, "flower": one}, {})
    for name, mean in (("ekf-nees", 3), ("ekf-nis", 2)):
        found = by_name[name].measure(data)
        assert found.value == pytest.approx(mean, rel=0.03)
        assert by_name[name].rule.verdict(found.value) == "reproduced"


def test_the_return_from_a_skid_is_the_last_time_it_was_far():
    t_s = np.arange(0.5, 100.0, 0.5)
    for end, expected in ((45.0, 3.0), (41.0, 0.0), (200.0, math.inf)):
        off = np.where((t_s > ekf.SKID_AT_S) & (t_s < end), 0.1, 0.001)[:, None, None]
        one = ekf.Course(t_s, off, off, off, off, off)
        assert ekf.back_after_s(one) == expected


def test_a_course_has_the_errors_of_the_recorded_run():
    scenario = short()
    found = ekf.course(scenario)
    policy = fit_policy("reference:consistent", scenario).policy
    record = run_policy(scenario, policy, ekf.SEEDS[0])
    turn = record["estimated_theta_rad"] - record["theta_rad"]
    np.testing.assert_allclose(found.heading_rad[:, 0], turn[1:], atol=1e-12)
    np.testing.assert_array_equal(found.position_mm[:, 0], record["position_error_mm"][1:])
    moved = found.sigma_rad > 0  # at the true pose and at rest nothing is uncertain
    assert moved[:, :, 0].all()
    assert not moved[0, :, 1].any()
    np.testing.assert_array_equal(np.isfinite(found.nees), moved)


# --- what is not published


def test_a_robot_without_other_values_is_ours():
    assert screening.robot_with({}) == RobotParameters()


@pytest.mark.parametrize("end", ["low", "high"])
def test_every_factor_reaches_the_robot_and_the_load_shares_stay(end):
    for factor in screening.ROBOT:
        value = getattr(factor, end)
        robot = screening.robot_with({factor.name: value})
        held = robot.tyre if factor.name == "dynamic_speed_mm_s" else robot
        assert getattr(held, factor.name) == value
        assert robot.castor_load_share == RobotParameters().castor_load_share
        assert robot != RobotParameters()


def test_starts_without_other_values_are_the_usual_ones():
    formation = Formation(load_scenario("infinity"))
    formation.reset(0)
    info = formation.info()
    usual = np.stack([info.x_mm, info.y_mm, info.theta_rad], axis=-1)
    np.testing.assert_allclose(screening.start_poses({}), usual, atol=1e-9)


def test_other_starts_are_behind_aside_and_turned():
    poses, usual = (
        screening.start_poses({"behind_mm": 30.0, "aside_mm": 40.0, "turned_rad": 0.1}),
        screening.start_poses({}),
    )
    off = poses - usual
    np.testing.assert_allclose(np.hypot(off[:, 0], off[:, 1]), 50.0, rtol=1e-9)
    np.testing.assert_allclose(off[:, 2], [0.1, -0.1, 0.1])
    np.testing.assert_allclose(off[0, :2] + off[1, :2], off[1, :2] + off[2, :2], atol=1e-9)


def test_runs_come_in_the_order_of_their_cases(monkeypatch):
    """Also if they are driven in groups of the same control period."""
    monkeypatch.setattr(screening, "HORIZON_S", 5.0)
    cases = [
        {"period": 1.0, "castor_trail_mm": 5.0},
        {"period": 2 / 3, "noise": 1.0},
        {"period": 1.0, "noise": 1 / 3},
    ]
    shares: list[float] = []
    found = screening.runs("consistent", cases, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    for place, case in enumerate(cases):
        alone = screening.runs("consistent", [case], lambda share: None)
        assert same(alone, lanes.run_of(found, [place]))


def test_a_screening_finds_the_factor_that_acts(monkeypatch):
    """With errors that depend on two of three factors, by a known law."""

    def runs(gains, cases, progress):
        log = np.array(
            [2 * (case["body_inertia_kg_mm2"] - 2000) / 7000 + case["period"] for case in cases]
        )
        error = np.repeat(10.0 ** log[:, None], 3, axis=1)
        return lanes.Ends(error, np.zeros_like(error), np.zeros_like(error))

    monkeypatch.setattr(screening, "runs", runs)
    factors = (screening.ROBOT[0], *screening.OTHERS[:2])
    found = screening.screen(factors, "printed", lambda share: None)
    np.testing.assert_allclose(found.mu_star, [2.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.sigma, 0.0, atol=1e-9)
    assert unpublished.strongest(found, 2) == "yaw inertia 2.0, control period 1.0"


# --- numbers of the committed page


def committed_rows(part: str, table: int) -> tuple[tuple[str, ...], ...]:
    return read_results(DOCS / "paper")[part].tables[table].rows


def test_runs_with_kappa_are_those_of_the_page():
    place = ("flower", "consistent")
    made = robustness.Robustness({place: robustness.with_kappa(*place)}, {})
    (row,) = robustness.tables(made)[0].rows
    assert row in committed_rows("robustness", 0)


def test_runs_with_slip_are_those_of_the_page():
    key = slip.Key("infinity", "consistent", "none", "truth")
    made = slip.Slip({}, [], (0.0, 0.0, 0.0), {key: slip.with_and_without(key)}, np.zeros(0), 0.0)
    (row,) = slip.tables(made)[0].rows
    assert row in committed_rows("slip", 0)
