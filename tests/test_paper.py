"""``tlf paper``: numbers by another route than the code's, rules and verdicts, and the committed page."""

from __future__ import annotations

import json
import math
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st
from page_tables import DOCS
from scipy.integrate import solve_ivp

pytest.importorskip("control")
pytest.importorskip("matplotlib")

from baselines import cli
from baselines.paper import (
    errors,
    follower,
    formations,
    loop,
    nyquist,
    portrait,
    prbs,
    proofs,
    shaping,
    tracks,
)
from baselines.paper.claims import Above, Below, Claim, Measured, Near, Verdict, judge, shown
from baselines.paper.report import html_page, markdown, plain
from baselines.paper.results import PARTS, Result, command_of, finished, make, read_results
from tlf_env.onboard.tracking import complementary_twist, tracking_twist
from tlf_env.physics.friction import coefficient
from tlf_env.physics.linear import linearise
from tlf_env.task.scenario import load_scenario
from tlf_env.task.trajectories import sample

FOLDER = DOCS / "paper"
MOST_BYTES = 2_500_000  # 18 figures
KAPPA = 1000 / (0.4 * 1.245 * 50**2 + 52.91)  # eq. (6), rad/s² per N·mm
OMEGA = np.geomspace(1e-4, 1e5, 200_001)
ALL_CLAIMS = [claim for part in PARTS.values() for claim in part.claims]


def no_progress(*_: object) -> None:
    """Nothing is shown."""


def committed() -> dict[str, Result]:
    return read_results(FOLDER)


# --- rules and verdicts

GRADES = [Verdict.NOT, Verdict.PARTLY, Verdict.REPRODUCED]


@given(st.floats(0, 10), st.floats(0, 10))
def test_a_number_nearer_to_the_target_has_no_worse_a_verdict(a, b):
    near, far = sorted((a, b))
    for sign in (-1, 1):
        rule = Near(5.0, 0.1, 0.5)
        verdicts = [GRADES.index(rule.verdict(5.0 + sign * off)) for off in (near, far)]
        assert verdicts[0] >= verdicts[1]


@given(st.floats(-100, 100), st.floats(-100, 100))
def test_bounds_are_monotonic(a, b):
    low, high = sorted((a, b))
    below, above = Below(1.0, 20.0), Above(20.0, 1.0)
    assert GRADES.index(below.verdict(low)) >= GRADES.index(below.verdict(high))
    assert GRADES.index(above.verdict(low)) <= GRADES.index(above.verdict(high))


def test_verdicts_follow_from_values():
    assert Near(0.81, 0.03, 0.1).verdict(0.79) is Verdict.REPRODUCED
    assert Near(0.81, 0.03, 0.1).verdict(0.75) is Verdict.PARTLY
    assert Near(0.81, 0.03, 0.1).verdict(0.953) is Verdict.NOT
    assert Below(1).verdict(1.0) is Verdict.NOT
    assert Below(1, 2).verdict(1.0) is Verdict.PARTLY
    assert Above(0.5).verdict(0.51) is Verdict.REPRODUCED
    for rule in (Near(1, 0.1, 0.2), Below(1, 2), Above(1, 0.5)):
        assert rule.verdict(math.nan) is Verdict.NOT
    assert Below(20, 100).verdict(math.inf) is Verdict.NOT  # a lost robot


@given(st.floats(-1e6, 1e6))
def test_a_judged_claim_has_the_verdict_of_its_own_number(value):
    claim = Claim("n", "s", "eq. (0)", "r", "q", "", lambda data: data, Below(1.0, 2.0))
    found = judge(claim, value, "tlf paper")
    assert found.verdict == Below(1.0, 2.0).verdict(value)
    assert found.computed == shown(value)
    assert found.rule == "< 1; partly: < 2"


def test_numbers_are_shown_with_their_digits():
    assert shown(0.19036, digits=4) == "0.1904"
    assert shown(45.5001, digits=4) == "45.50"
    assert shown(1319.3, "mm") == "1319 mm"
    assert shown(math.inf, "mm") == "lost"
    assert shown(math.nan) == "not defined"
    assert shown(3e-12, "mm") == "< 1e-9 mm"
    assert shown(0.0) == "0"


def test_rules_are_written_with_the_unit():
    assert Below(50, 100).text("%") == "< 50 %; partly: < 100 %"
    assert Above(0).text("1/s") == "> 0 1/s"
    assert Below(1e-9).text() == "< 1e-9"
    assert Near(0.81, 0.03, 0.1).text() == "0.81 within 3 %; partly: within 10 %"


def test_claims_are_many_and_have_names_of_their_own():
    assert len(ALL_CLAIMS) >= 40
    assert len({claim.name for claim in ALL_CLAIMS}) == len(ALL_CLAIMS)
    captions = {name for part in PARTS.values() for name in part.captions}
    assert {claim.figure for claim in ALL_CLAIMS if claim.figure} <= captions


# --- the wheel loop: python-control against NumPy


def direct(name: str) -> np.ndarray:
    """A plant's frequency response over OMEGA, from its matrices or its formula."""
    s = 1j * OMEGA
    if name.startswith("eq. (6)"):
        return KAPPA / s
    linear, sign = linearise(), -1.0 if name.startswith("diff") else 1.0
    response = np.empty(len(s), dtype=complex)
    for first in range(0, len(s), 20_000):
        some = s[first : first + 20_000, None, None] * np.eye(3) - linear.A
        state = np.linalg.solve(some, (linear.B @ [sign, 1.0])[None, :, None])
        response[first : first + 20_000] = (np.array([sign, 1.0]) / 2 @ linear.C @ state)[:, 0]
    return response


def numbers(G: np.ndarray, factor: float) -> dict[str, float]:
    """The suprema by evaluation on a dense grid."""
    s = 1j * OMEGA
    L = factor * 150 * (s**2 + 3 * s + 0.3025) / (s * (s + 2)) * G
    S, T = 1 / (1 + L), L / (1 + L)
    np.testing.assert_allclose(S + T, 1, rtol=1e-12)
    robust, nominal = np.abs((s + 1.27) / 2.54 * T), np.abs((s + 0.1) / (1.5 * s) * S)
    return {
        "crossover_rad_s": OMEGA[np.flatnonzero(np.abs(L) >= 1)[-1]],
        "robust": robust.max(),
        "nominal": nominal.max(),
        "both": (robust + nominal).max(),
        "margin": np.abs(1 + L).min(),
    }


@pytest.mark.parametrize("unit", list(loop.UNITS))
@pytest.mark.parametrize("plant", ["eq. (6)", "common mode", "differential mode"])
def test_conditions_are_those_of_a_direct_evaluation(plant, unit):
    found = loop.conditions(loop.plants()[plant], unit)
    for name, value in numbers(direct(plant), loop.UNITS[unit]).items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-4), name


def test_friction_about_rest_is_a_feedback():
    viscosity = loop.equivalent_viscosity()
    for plant in ("eq. (6)", "differential mode"):
        G = direct(plant)
        found = loop.conditions(loop.plants()[f"{plant}, friction about rest"], "running")
        for name, value in numbers(G / (1 + viscosity * G), 1.0).items():
            assert getattr(found, name) == pytest.approx(value, rel=1e-4), name


def test_the_expected_numbers():
    found = loop.conditions(loop.plants()["eq. (6)"], "design")
    assert (found.robust, found.nominal, found.both) == pytest.approx(
        (0.671, 0.759, 1.334), abs=5e-4
    )
    assert found.crossover_rad_s == pytest.approx(0.190, abs=5e-4)
    assert loop.conditions(loop.plants()["eq. (6)"]).crossover_rad_s == pytest.approx(116, abs=0.5)


def test_the_running_loop_tends_to_its_proportional_part():
    """Beyond the crossover W_δ T tends to κ·150/2.54 and W_e S to 2/3."""
    found = loop.conditions(loop.plants()["eq. (6)"])
    assert found.robust == pytest.approx(KAPPA * 150 / 2.54, rel=1e-3)
    assert found.nominal == pytest.approx(2 / 3, rel=1e-3)


def test_straight_on_the_modes_do_not_act_on_each_other():
    linear = linearise()
    assert np.abs(linear.A[0, 1:]).max() < 1e-6
    assert np.abs(linear.A[1:, 0]).max() < 1e-6
    assert linear.B[0, 0] == pytest.approx(linear.B[0, 1], rel=1e-5)
    assert linear.B[1, 0] == pytest.approx(-linear.B[1, 1], rel=1e-5)


def test_kappa_of_the_common_mode_is_that_of_the_rolling_masses():
    robot = loop.ROBOT
    castor = robot.castor_inertia_kg_mm2 / robot.castor_radius_mm**2
    mass = robot.mass_kg + 2 * robot.wheel_inertia_kg_mm2 / robot.wheel_radius_mm**2 + castor
    expected = 2 * 1000 / (mass * robot.wheel_radius_mm**2)
    assert loop.kappa_of(loop.plants()["common mode"]) == pytest.approx(expected, rel=1e-4)
    assert pytest.approx(KAPPA, rel=1e-12) == loop.KAPPA


def test_the_describing_function_is_the_first_harmonic_of_sliding_friction():
    angle = np.linspace(0, 2 * np.pi, 100_001)
    swing = 2.0
    torque = loop.sliding_friction() * np.sign(np.sin(angle))
    harmonic = np.trapezoid(torque * np.sin(angle), angle) / np.pi / swing
    assert loop.equivalent_viscosity(swing) == pytest.approx(harmonic, rel=1e-6)


def test_the_steepest_fall_is_that_of_the_friction_curve():
    joint, load = loop.ROBOT.drive_joint, 0.4 * 1.245 * 9.807
    speeds = np.linspace(0.9, 1.6, 7001)
    mu = [coefficient(v, joint.mu_static, joint.mu_dynamic, 1.0, 1.5) for v in speeds]
    slope = np.min(np.gradient(np.array(mu), speeds)) * joint.pin_radius_mm * load * 50
    assert loop.steepest_fall() == pytest.approx(slope, rel=1e-5)


# --- the experiment


def linear_data(period_s: float, count: int = 60_000, delay: int = 0) -> prbs.Data:
    """Reference and output of K(z) on κ/s, without a limit and without noise."""
    rng = np.random.default_rng(1)
    reference = 0.02 * rng.choice((-1.0, 1.0), count)
    row = prbs.digital_wheel_loop(prbs.WheelLoopParameters(), period_s)
    output, integral, lag, omega = np.empty(count), 0.0, 0.0, 0.0
    waiting = [0.0] * delay
    for k in range(count):
        output[k] = omega + 1e-4 * rng.standard_normal()
        torque, integral, lag = prbs.wheel_torque(reference[k] - output[k], integral, lag, row, 1e9)
        waiting.append(torque / 1000)
        omega += KAPPA * period_s * waiting.pop(0)
    return prbs.Data(reference, output, output, 0.0)


@pytest.mark.parametrize("delay", [0, 1])
def test_the_estimate_of_a_known_loop_lies_in_its_region(delay):
    found = prbs.estimate(linear_data(0.001, delay=delay), 0.001)
    true = prbs.predicted_loop(0.001, delay, KAPPA, found.omega)
    high = found.omega > 60  # below, the window's leakage counts
    inside = np.abs(found.L - true)[high] <= found.radius[high]
    assert 0.9 <= np.mean(inside) <= 0.99
    assert found.margin == pytest.approx(prbs.predicted_margin(0.001, delay, KAPPA), abs=0.01)


def test_the_margin_without_delay_has_a_closed_form():
    """At z = −1 L is −a/2 with a = 150 κT."""
    for period_s in (0.001, 0.002):
        expected = 1 - 150 * KAPPA * period_s / 2
        assert prbs.predicted_margin(period_s, 0, KAPPA) == pytest.approx(expected, abs=2e-3)


def test_an_unstable_loop_has_no_margin():
    """At 10 ms with a sample of delay, and beyond the closed-form limit 150 κT < 2 without delay."""
    assert math.isnan(prbs.predicted_margin(0.010, 1, KAPPA))
    assert prbs.is_stable(0.001, 0, 1.9 * 1000 / 150)
    assert not prbs.is_stable(0.001, 0, 2.1 * 1000 / 150)


def test_the_margin_falls_with_kappa():
    for dead_time in nyquist.DEAD_TIMES.values():
        largest = prbs.predicted_margin(*dead_time, 1.5 * KAPPA)
        assert nyquist.spread(*dead_time) == pytest.approx(largest, abs=0.02)


@pytest.mark.parametrize(("period_s", "delay"), [(0.001, 0), (0.002, 1)])
def test_a_short_experiment_has_the_margin_of_the_linear_loop(period_s, delay):
    trial = prbs.Trial(period_s=period_s, delay=delay, duration_s=20.0)
    data = prbs.run_trial(trial)
    found = prbs.estimate(data, period_s)
    assert data.saturated == 0
    assert np.abs(data.torque).max() < 15
    assert found.margin == pytest.approx(prbs.predicted_margin(period_s, delay, 0.6167), abs=0.03)


def test_a_large_amplitude_saturates_and_hides_the_loop():
    data = prbs.run_trial(prbs.Trial(delay=1, amplitude_rad_s=1.0, duration_s=20.0))
    assert data.saturated > 0.4
    assert prbs.estimate(data, 0.001).margin > 0.95 > prbs.predicted_margin(0.001, 1, 0.6167)


# --- the tracking errors


def rates_17(e: np.ndarray, u_1: float, u_2: float, law: errors.Law) -> np.ndarray:
    """Eq. (17) with the law of the project, for one start."""
    gains = law.gains._replace(eta=law.gains.eta if law.complementary else 0.0)
    v, w = tracking_twist(e[0], e[1], math.sin(e[2]), math.cos(e[2]), u_1, u_2, gains)
    return np.array(
        [-e[1] * w + u_1 * math.cos(e[2]) - v, e[0] * w - u_1 * math.sin(e[2]), u_2 - w]
    )


LAWS = errors.laws()
by_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


@by_law
def test_rates_are_those_of_the_law_on_board(law):
    rng = np.random.default_rng(2)
    e = rng.uniform([[-600], [-600], [-7]], [[600], [600], [7]], (3, 200))
    e[:, ::2] *= 1e-3  # inside the boundary layer
    found = errors.rates(e, 321.0, -0.4, law)
    expected = np.stack([rates_17(one, 321.0, -0.4, law) for one in e.T], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


@untimed
@given(st.floats(-600, 600), st.floats(-1, 1))
def test_the_complementary_law_on_arrays_is_the_law_on_board(e_1, sin_e3):
    gains = LAWS["printed, ϱ on"].gains
    found = errors.complementary(np.array([e_1]), np.array([sin_e3]), gains)
    assert [float(one[0]) for one in found] == pytest.approx(
        complementary_twist(e_1, sin_e3, gains), rel=1e-12, abs=1e-300
    )


@pytest.mark.parametrize("name", ["printed, ϱ off", "consistent, ϱ off"])
def test_paths_are_those_of_an_adaptive_solver(name):
    """Eq. (20) as printed, by scipy."""
    k_1, k_2, k_3, *_ = LAWS[name].gains

    def eq_20(t_s, e):
        u_1, u_2 = errors.infinity(t_s)
        turn = k_2 * math.sin(e[2]) - e[1] * u_1 + k_3 * u_2
        return [
            -e[1] / k_3 * turn - k_1 * e[0],
            e[0] / k_3 * turn - u_1 * math.sin(e[2]),
            -(k_2 * math.sin(e[2]) - e[1] * u_1) / k_3,
        ]

    start = np.array([100.0, -200.0, 1.0])
    exact = solve_ivp(eq_20, (0, 20), start, rtol=1e-10, atol=1e-10).y[:, -1]
    found = errors.paths(start[:, None], LAWS[name], errors.infinity, 20.0).e[-1, :, 0]
    np.testing.assert_allclose(found, exact, atol=1e-3)


def test_the_law_on_board_gives_the_path_with_the_complementary_law():
    law = LAWS["consistent, ϱ on"]
    start = np.array([30.0, 40.0, 0.5])
    exact = solve_ivp(
        lambda t_s, e: rates_17(e, *errors.circle(t_s), law),
        (0, 10),
        start,
        rtol=1e-8,
        max_step=0.01,
    ).y[:, -1]
    found = errors.paths(start[:, None], law, errors.circle, 10.0).e[-1, :, 0]
    np.testing.assert_allclose(found, exact, atol=2e-2)


def test_growth_rates_have_a_closed_form_on_a_straight_line():
    for name in ("printed, ϱ off", "consistent, ϱ off"):
        law = LAWS[name]
        k_1, k_2, k_3, *_ = law.gains
        swing = np.roots([1, k_2 / k_3, 300.0**2 / k_3])
        expected = np.sort_complex(np.array([-k_1, *swing]))
        found = np.sort_complex(errors.growth_rates(0.0, law, errors.straight))
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
        about_pi = np.roots([1, -k_2 / k_3, -(300.0**2) / k_3])
        found = errors.growth_rates(np.pi, law, errors.straight)
        assert found.real.max() == pytest.approx(about_pi.max(), rel=1e-5)


def test_the_twist_of_the_path_is_that_of_the_task():
    t_s = np.linspace(0, 60, 241)
    table = sample(load_scenario("infinity").trajectory, t_s)
    found = np.array([errors.infinity(float(t)) for t in t_s])
    np.testing.assert_allclose(found, table[:, 3:5], rtol=1e-9, atol=1e-9)


def test_a_converged_start_stays_so_and_a_far_one_is_not():
    law = LAWS["consistent, ϱ on"]
    starts = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.01], [400.0, 0.0, 0.0]]).T
    found = errors.convergence(starts, law, errors.straight, 5.0)
    assert found.at_s[:2].tolist() == [0.0, 0.0]
    assert found.at_s[2] == math.inf
    longer = errors.convergence(starts, law, errors.straight, 30.0)
    assert longer.at_s[2] == pytest.approx(math.log(40) / 0.23, abs=0.1)  # e₁ decays with k₁ alone


# --- the proofs


def test_numbers_of_the_proofs():
    data = proofs.compute(no_progress)
    assert data.jump == pytest.approx(1, abs=2e-3)  # towards λ with one component almost 0
    assert 0.4999 < data.layer <= 0.5
    k = min(data.gains.k_1, data.gains.k_2)
    assert data.bound == pytest.approx(k * data.bound_at_mm**2 - data.gains.epsilon / 4)


# --- the observer


def test_the_observers_error_is_that_of_eqs_45_to_47():
    """In the body frame, by an adaptive solver; the start's heading error is below π."""
    t_s = np.arange(2001) * follower.STEP_S
    u_1, u_2 = follower.TWIST

    def rates_45(_, z, b):
        return [
            -z[1] * u_2 + u_1 * (1 - math.cos(z[2])) - b * z[0],
            z[0] * u_2 - u_1 * math.sin(z[2]) - b * z[1],
            -b * z[2],
        ]

    e_x, e_y, e_theta = follower.START
    start = [e_y, e_x, e_theta]  # the predecessor faces +y at first: forward is y, right is x
    for b in follower.GAINS_PER_S:
        z = solve_ivp(rates_45, (0, 2), start, args=(b,), t_eval=t_s, rtol=1e-9, atol=1e-9).y
        found = follower.distance(t_s, b)
        np.testing.assert_allclose(found, np.hypot(z[0], z[1]), atol=3.0)


def test_the_peak_without_smoothing_is_b_times_the_spacing():
    t_s = np.arange(5001) * follower.STEP_S
    without, smooth = (follower.reference_speed(t_s, seconds) for seconds in (0, 5.0))
    assert without.max() == without[0] == pytest.approx(3 * follower.BEHIND_MM)
    # ẏ = ℘ b (d − y) has the solution d (1 − exp(−b ∫℘)).
    share = 0.5 * (1 - np.cos(np.pi * t_s / 5))
    area = 0.5 * (t_s - 5 / np.pi * np.sin(np.pi * t_s / 5))
    np.testing.assert_allclose(smooth, 3 * share * follower.BEHIND_MM * np.exp(-3 * area), atol=1.0)


# --- the simulations


@pytest.fixture(scope="module")
def consistent_20_ms():
    return formations.run(formations.Key("infinity", "complete", "consistent", 0.02))


def test_a_run_is_the_one_of_the_page(consistent_20_ms):
    first, second = committed()["fig11"].tables
    name = "∞, complete, consistent, 20 ms"
    fresh = tracks.tables(
        tracks.Tracks(
            {formations.Key("infinity", "complete", "consistent", 0.02): consistent_20_ms}
        )
    )
    for table, made in zip((first, second), fresh, strict=True):
        assert [row for row in table.rows if row[0] == name] == list(made.rows)


def test_functionals_are_the_integrals_of_the_errors(consistent_20_ms):
    one = consistent_20_ms
    assert np.all(np.abs(one.J_mm_s[-1]) <= one.absolute_J_mm_s[-1])
    assert np.all(np.abs(one.J_theta_rad_s[-1]) <= one.absolute_J_theta_rad_s[-1])
    assert np.all(np.diff(one.absolute_J_mm_s, axis=0) >= 0)
    # |Δx| + |Δy| lies between the distance and √2 times it.
    mean = one.absolute_J_mm_s[-1] / one.t_s[-1]
    whole = np.sqrt((one.early_rms_mm**2 * 20 + one.late_rms_mm**2 * 80) / 100)
    assert np.all(mean <= math.sqrt(2) * whole * 1.001)


def test_every_run_is_driven_with_its_progress(consistent_20_ms, monkeypatch):
    key = formations.Key("infinity", "complete", "consistent", 0.02)
    monkeypatch.setattr(tracks, "every_key", lambda: [key, key._replace(gains="printed")])

    def run(_, progress):
        progress(1, 2)
        progress(2, 2)
        return consistent_20_ms

    monkeypatch.setattr(tracks, "run", run)
    calls = []
    data = tracks.compute(lambda *call: calls.append(call))
    assert data.at("infinity", "complete", "consistent", 0.02) is consistent_20_ms
    assert [call[:2] for call in calls] == [(50, 200), (100, 200), (150, 200), (200, 200)]
    assert calls[-1][2] == "∞, complete, printed, 20 ms"


def test_a_lost_robot_has_no_finite_error(consistent_20_ms):
    lost = consistent_20_ms._replace(lost=np.array([False, True, False]))
    assert lost.worst_mm == math.inf
    assert tracks.result(lost) == "1 of 3 lost"
    assert consistent_20_ms.worst_mm == consistent_20_ms.rms_mm.max()


def test_an_interrupted_run_is_no_result():
    """A run that is interrupted returns what it has; its numbers would be of a shorter run."""

    def stop(done: int, _: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        formations.run(formations.Key("infinity", "complete", "consistent", 0.02), stop)


def test_the_plants_of_the_runs():
    whole, off, ideal = (
        formations.scenario_of(formations.Key("flower", plant, "printed", 0.001))
        for plant in ("complete", "bending off", "kinematic")
    )
    assert whole.robot.steering_joint.bending
    assert not off.robot.steering_joint.bending
    assert (whole.plant, ideal.plant) == ("batch", "kinematic")
    assert {key.plant for key in formations.every_key()} == set(formations.PLANTS)


# --- the page


def assert_same(name: str, fresh: Result) -> None:
    """The committed result of a part, text by text."""
    kept = committed()[name]
    for one, other in zip(kept.findings, fresh.findings, strict=True):
        assert one == other
    assert kept.tables == fresh.tables
    assert kept.figures == fresh.figures


@pytest.mark.parametrize("name", ["fig7ab", "observer", "proofs"])
def test_a_part_of_the_page_is_computed_anew(name, tmp_path):
    assert_same(name, make(PARTS[name], tmp_path, no_progress))


def test_an_experiment_of_the_page_is_run_anew():
    period_s, delay = nyquist.DEAD_TIMES["1 ms, two samples"]
    one = nyquist.experiment(prbs.Trial(period_s=period_s, delay=delay), 0.6166520734)
    made = nyquist.Nyquist({"1 ms, two samples": one}, {}, 0.6166520734, 0.0, {})
    (row,) = nyquist.tables(made)[0].rows
    assert row in committed()["fig7c"].tables[0].rows


def test_a_map_of_the_page_is_computed_anew():
    law, reference = "consistent, ϱ on", "circle"
    found = errors.convergence(
        portrait.grid(), LAWS[law], errors.REFERENCES[reference], portrait.MAPPED_S
    )
    data = portrait.Portrait({}, {(law, reference): found}, {}, {})
    (row,) = portrait.tables(data)[0].rows
    assert row in committed()["fig8"].tables[0].rows


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["fig7c", "fig8", "slip", "ekf", "fig11", "robustness", "unpublished"]
)
def test_the_rest_of_the_page_is_computed_anew(name, tmp_path):
    assert_same(name, make(PARTS[name], tmp_path, no_progress))


def test_the_page_is_made_from_the_results():
    assert (DOCS / "paper.md").read_text(encoding="utf-8") == markdown(committed(), "paper/")


def test_the_page_has_all_claims_and_its_figures_and_is_small():
    results = committed()
    assert list(results) == list(PARTS)
    for name, result in results.items():
        assert [one.claim for one in result.findings] == [one.name for one in PARTS[name].claims]
        assert all(one.command == command_of(name) for one in result.findings)
    figures = {f"{name}.png" for result in results.values() for name in result.figures}
    assert {path.name for path in FOLDER.iterdir()} == figures | {"paper.json"}
    assert sum(path.stat().st_size for path in [*FOLDER.iterdir(), DOCS / "paper.md"]) < MOST_BYTES


def test_verdicts_of_the_page_are_those_of_the_numbers_in_it():
    """Where the number has no unit that the rule lacks, the text alone gives the verdict."""
    rules = {claim.name: claim.rule for claim in ALL_CLAIMS}
    checked = 0
    for result in committed().values():
        for one in result.findings:
            number = re.match(r"-?\d+(\.\d+)?", one.computed)
            value = math.inf if one.computed.startswith("lost") else None
            if number:
                value = float(number[0])
            if value is not None:
                assert rules[one.claim].verdict(value) == one.verdict, one.claim
                checked += 1
    assert checked >= 40


SIGNS = "<b>a & b</b> | W_δ*T < 1 <script>alert(1)</script>"


class Tags(HTMLParser):
    """Tags and text of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data):
        self.text += data


def test_text_with_signs_stays_text(tmp_path):
    claim = Claim("n", SIGNS, SIGNS, SIGNS, SIGNS, "", lambda data: Measured(data, SIGNS), Below(1))
    part = PARTS["proofs"]
    result = Result((judge(claim, 0.5, "tlf paper"),), part.tables(None), ())
    page = Tags()
    page.feed(html_page({"proofs": result}, tmp_path))
    assert page.text.count(SIGNS) >= 4
    assert not {"script", "b"} & set(page.tags)
    for line in markdown({"proofs": result}).splitlines():
        if "alert" in line:
            assert "<" not in line
            assert len(re.findall(r"(?<!\\)\|", line)) == 7  # six cells
    assert plain("a|b<c") == "a\\|b&lt;c"


# --- the command


def test_a_part_is_written_and_others_stay(tmp_path, capsys):
    folder = tmp_path / "paper"
    cli.app(["paper", "--figures", "proofs", "--out", str(folder)], standalone_mode=False)
    assert "4 claims: 0 reproduced, 0 partly, 4 not reproduced." in capsys.readouterr().out
    cli.app(["paper", "--figures", "fig7ab", "--out", str(folder), "--json"], standalone_mode=False)
    assert list(json.loads(capsys.readouterr().out)) == ["fig7ab", "proofs"]
    assert {path.name for path in folder.iterdir()} == {
        "fig7a.png", "fig7b.png", "paper.html", "paper.json", "paper.md",
    }  # fmt: skip
    page = Tags()
    page.feed((folder / "paper.html").read_text(encoding="utf-8"))
    assert page.tags.count("img") == 2
    assert all(source.startswith(("data:", "#")) for source in page.sources)
    assert read_results(folder)["proofs"] == finished(
        PARTS["proofs"], proofs.compute(no_progress), folder
    )


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--figures", "fig7abc"], "did you mean 'fig7ab'?"),
        (["--figures", "fig8,fig8"], "each once"),
        (["--figures", ""], "comma-separated names"),
    ],
)
def test_wrong_input_is_refused_in_one_line(words, named, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("sys.argv", ["tlf", "paper", "--out", str(tmp_path), *words])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == cli.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line


def test_results_that_are_none_are_refused_in_one_line(capsys, monkeypatch, tmp_path):
    (tmp_path / "paper.json").write_text('{"proofs": 3}', encoding="utf-8")
    words = ["tlf", "paper", "--figures", "proofs", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(SystemExit):
        cli.main()
    (line,) = capsys.readouterr().err.splitlines()
    assert "is not a file of the paper's results" in line


def test_without_the_extra_the_command_names_it(capsys, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("baselines.paper")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "baselines.commands.paper", raising=False)
    monkeypatch.setitem(sys.modules, "control", None)
    monkeypatch.setattr("sys.argv", ["tlf", "paper", "--figures", "proofs"])
    with pytest.raises(SystemExit):
        cli.main()
    (line,) = capsys.readouterr().err.splitlines()
    assert "needs control" in line


def test_every_caption_is_of_a_figure_and_shapes_are_drawn():
    data = shaping.compute(no_progress)
    assert set(shaping.draw(data)) == set(shaping.PART.captions)
    for part in PARTS.values():
        for paragraph in part.text:
            assert paragraph.endswith(".")
