"""The tracking law, eqs (16)–(21), by itself and on the kinematic plant."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import alike, drive, play, untimed
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import tlf_env
from tlf_env.onboard.calibration import Belief, believed_odometry, believed_wheel_speeds
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.tracking import (
    body_errors,
    complementary_twist,
    gains_row,
    nominal_twist,
    tracking_twist,
)
from tlf_env.physics.kinematics import follow_wheels
from tlf_env.physics.parameters import RobotParameters, body
from tlf_env.physics.state import Motion, axle_midpoint
from tlf_env.task.actions import TWIST, WHEEL_SPEED, wheel_command

PRESETS = ("consistent", "printed")
BODY = body(RobotParameters())
BELIEF = Belief(radius_l=1.0, radius_r=1.0, h=BODY.h)
R_MM, L_MM = 50.0, 156.0  # Table I
EQ_1 = np.array([[R_MM / 2, R_MM / 2], [-R_MM / L_MM, R_MM / L_MM]])  # from (ω_l, ω_r)

presets = pytest.mark.parametrize("preset", PRESETS)


def random_errors(count: int = 1000, seed: int = 1) -> np.ndarray:
    """Rows (e₁, e₂, e₃, u₁*, u₂*) over the domain of Proposition 1."""
    rng = np.random.default_rng(seed)
    low, high = (-2000, -2000, -math.pi, 0, -3), (2000, 2000, math.pi, 600, 3)
    return rng.uniform(low, high, (count, 5))


def layer_errors(gains, inside: bool, count: int = 1000, seed: int = 2) -> np.ndarray:
    """As :func:`random_errors`, inside or outside the boundary layer of (21), up to 10 widths of it."""
    rng = np.random.default_rng(seed)
    size = (
        gains.epsilon
        / gains.eta
        * (rng.uniform(0, 1, count) if inside else rng.uniform(1, 10, count))
    )
    share = rng.uniform(0, 1, count)
    signs = rng.choice((-1, 1), (2, count))
    errors = random_errors(count, seed)
    errors[:, 0] = signs[0] * size * share
    errors[:, 2] = np.arcsin(signs[1] * size * (1 - share) / gains.k_3)
    return errors


def error_rates(e, u, u_star, delta=(0.0, 0.0)) -> np.ndarray:
    """Eq. (17)."""
    e_1, e_2, e_3 = e
    v, w = u[0] + delta[0], u[1] + delta[1]
    return np.array(
        [
            -e_2 * w + u_star[0] * math.cos(e_3) - v,
            e_1 * w - u_star[0] * math.sin(e_3),
            u_star[1] - w,
        ]
    )


def lyapunov(e, k_3: float) -> float:
    return 0.5 * (e[0] ** 2 + e[1] ** 2) + k_3 * (1 - math.cos(e[2]))


def lyapunov_rate(e, rates, k_3: float) -> float:
    return e[0] * rates[0] + e[1] * rates[1] + k_3 * math.sin(e[2]) * rates[2]


def lyapunov_scale(e, u, u_star, k_3: float) -> float:
    """Sum of the magnitudes that cancel in :func:`lyapunov_rate`."""
    return (
        abs(e[0]) * (abs(e[1] * u[1]) + u_star[0] + abs(u[0]))
        + abs(e[1]) * (abs(e[0] * u[1]) + u_star[0])
        + k_3 * (abs(u_star[1]) + abs(u[1]))
    )


def law_of(kind, e, u_star, gains):
    """A law at errors e₁, e₂, e₃."""
    return kind(e[0], e[1], math.sin(e[2]), math.cos(e[2]), u_star[0], u_star[1], gains)


# Nominal law (19)


@presets
def test_nominal_law_makes_lyapunov_rate_that_of_proposition_1(preset):
    gains = gains_row(controller(preset).gains)
    for *e, u_1, u_2 in random_errors():
        u = law_of(nominal_twist, e, (u_1, u_2), gains)
        rate = lyapunov_rate(e, error_rates(e, u, (u_1, u_2)), gains.k_3)
        expected = -gains.k_1 * e[0] ** 2 - gains.k_2 * math.sin(e[2]) ** 2
        scale = lyapunov_scale(e, u, (u_1, u_2), gains.k_3)
        assert abs(rate - expected) <= 1e-9 * scale
        assert rate <= 1e-9 * scale


@presets
def test_whole_law_without_slip_never_raises_the_lyapunov_function(preset):
    gains = gains_row(controller(preset).gains)
    rows = np.vstack([random_errors(), layer_errors(gains, True), layer_errors(gains, False)])
    for *e, u_1, u_2 in rows:
        u = law_of(tracking_twist, e, (u_1, u_2), gains)
        rate = lyapunov_rate(e, error_rates(e, u, (u_1, u_2)), gains.k_3)
        assert rate <= 1e-9 * lyapunov_scale(e, u, (u_1, u_2), gains.k_3)


@presets
def test_on_the_reference_the_law_commands_the_references_twist(preset):
    gains = gains_row(controller(preset).gains)
    assert law_of(tracking_twist, (0.0, 0.0, 0.0), (321.0, -0.7), gains) == (321.0, -0.7)


@presets
def test_law_has_the_period_of_the_heading(preset):
    gains = gains_row(controller(preset).gains)
    for *e, u_1, u_2 in random_errors(50):
        here = law_of(tracking_twist, e, (u_1, u_2), gains)
        turned = law_of(tracking_twist, (e[0], e[1], e[2] + 2 * math.pi), (u_1, u_2), gains)
        assert turned == pytest.approx(here, rel=1e-9, abs=1e-9)


def test_presets_differ_in_the_heading_damping_alone():
    consistent, printed = controller("consistent").gains, controller("printed").gains
    assert printed.k_2_mm2_s == 0.83
    assert consistent.k_2_mm2_s / consistent.k_3_mm2 == pytest.approx(0.83, rel=1e-12)
    for gains in (consistent, printed):
        assert (gains.k_1_per_s, gains.k_3_mm2) == (0.23, 12e3)
        assert (gains.eta, gains.epsilon) == (1.9e-3, 0.1)


# Complementary law (21)


@untimed
@given(st.floats(-3000, 3000), st.floats(-1, 1))
def test_complementary_law_opposes_lambda_within_eta(e_1, sin_e3):
    gains = gains_row(controller("consistent").gains)
    rho = complementary_twist(e_1, sin_e3, gains)
    for r, lam in zip(rho, (-e_1, -gains.k_3 * sin_e3), strict=True):
        assert abs(r) <= gains.eta
        assert r * lam <= 0.0


@untimed
@given(st.floats(-3000, 3000), st.floats(-1, 1))
def test_complementary_law_is_odd(e_1, sin_e3):
    gains = gains_row(controller("consistent").gains)
    there = complementary_twist(e_1, sin_e3, gains)
    back = complementary_twist(-e_1, -sin_e3, gains)
    assert back == (-there[0], -there[1])


def test_complementary_law_is_zero_at_zero():
    assert complementary_twist(0.0, 0.0, gains_row(controller("consistent").gains)) == (0.0, 0.0)


def test_complementary_law_is_eta_outside_its_layer_and_linear_inside():
    gains = gains_row(controller("consistent").gains)
    for *e, _, _ in layer_errors(gains, inside=False):
        lam = np.array([-e[0], -gains.k_3 * math.sin(e[2])])
        rho = complementary_twist(e[0], math.sin(e[2]), gains)
        np.testing.assert_allclose(rho, -gains.eta * np.sign(lam), rtol=1e-15)
    for *e, _, _ in layer_errors(gains, inside=True):
        lam = np.array([-e[0], -gains.k_3 * math.sin(e[2])])
        rho = complementary_twist(e[0], math.sin(e[2]), gains)
        np.testing.assert_allclose(rho, -(gains.eta**2) / gains.epsilon * lam, rtol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_complementary_law_jumps_at_the_edge_unless_one_component_is_zero(share):
    """At η‖λ‖₁ = ε each component goes from η|λᵢ|/‖λ‖₁ to η."""
    gains = gains_row(controller("consistent").gains)
    shares = np.array([share, 1 - share])

    def magnitudes(size: float) -> np.ndarray:
        lam = shares * size * gains.epsilon / gains.eta
        return np.abs(complementary_twist(-lam[0], -lam[1] / gains.k_3, gains))

    np.testing.assert_allclose(magnitudes(1 - 1e-9), gains.eta * shares, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(magnitudes(1 + 1e-9), gains.eta * (shares > 0), rtol=1e-12)


@presets
def test_slip_within_eta_is_cancelled_outside_the_layer(preset):
    """Eq. (24), with the nominal part kept: V̇ ≤ −k₁e₁² − k₂ sin²e₃ + (β − η)‖λ‖₁."""
    gains = gains_row(controller(preset).gains)
    rng = np.random.default_rng(3)
    for *e, u_1, u_2 in layer_errors(gains, inside=False):
        delta = rng.uniform(-gains.eta, gains.eta, 2)
        lam = np.abs([e[0], gains.k_3 * math.sin(e[2])]).sum()
        u = law_of(tracking_twist, e, (u_1, u_2), gains)
        rate = lyapunov_rate(e, error_rates(e, u, (u_1, u_2), delta), gains.k_3)
        nominal = -gains.k_1 * e[0] ** 2 - gains.k_2 * math.sin(e[2]) ** 2
        slack = 1e-12 * lyapunov_scale(e, u, (u_1, u_2), gains.k_3)
        assert rate <= nominal + (np.abs(delta).max() - gains.eta) * lam + slack


@presets
def test_slip_within_eta_adds_at_most_half_epsilon_inside_the_layer(preset):
    """Eq. (25) with ‖λ‖₂² in place of its ‖λ‖₁²: ε/2, which is approached, and not ε/4."""
    gains = gains_row(controller(preset).gains)
    largest = 0.0
    errors = layer_errors(gains, inside=True)
    corner = 0.5 * (1 - 1e-9) * gains.epsilon / gains.eta
    errors[0, [0, 2]] = corner, math.asin(corner / gains.k_3)
    for *e, u_1, u_2 in errors:
        lam = np.array([-e[0], -gains.k_3 * math.sin(e[2])])
        delta = gains.eta * np.sign(lam)  # the worst
        u = law_of(tracking_twist, e, (u_1, u_2), gains)
        rate = lyapunov_rate(e, error_rates(e, u, (u_1, u_2), delta), gains.k_3)
        nominal = -gains.k_1 * e[0] ** 2 - gains.k_2 * math.sin(e[2]) ** 2
        slack = 1e-12 * lyapunov_scale(e, u, (u_1, u_2), gains.k_3)
        assert rate <= nominal + 0.5 * gains.epsilon + slack
        largest = max(largest, rate - nominal)
    assert largest == pytest.approx(0.5 * gains.epsilon, rel=1e-4)


# Errors (16), (17) and the kinematics (1)


@untimed
@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-20, 20))
def test_body_errors_are_eq_16(d_x, d_y, theta):
    sin, cos = math.sin(theta), math.cos(theta)
    expected = np.array([[-sin, cos], [cos, sin]]) @ (d_x, d_y)
    np.testing.assert_allclose(body_errors(d_x, d_y, theta), expected, rtol=1e-12, atol=1e-9)


@untimed
@given(st.floats(-20, 20))
def test_body_errors_are_a_reflection(theta):
    columns = np.array([body_errors(1.0, 0.0, theta), body_errors(0.0, 1.0, theta)]).T
    assert np.linalg.det(columns) == pytest.approx(-1.0, rel=1e-12)
    np.testing.assert_allclose(columns @ columns, np.eye(2), atol=1e-12)


def test_body_errors_point_forward_and_to_the_right():
    assert body_errors(0.0, 7.0, 0.0) == (7.0, 0.0)  # heading +y
    assert body_errors(7.0, 0.0, 0.0) == (0.0, 7.0)
    assert body_errors(-7.0, 0.0, math.pi / 2) == pytest.approx((7.0, 0.0), abs=1e-12)  # −x


def at_pose(x_mm: float, y_mm: float, theta: float) -> Motion:
    """A robot whose axle midpoint c is at a pose."""
    x_mm += BODY.d * math.sin(theta)
    y_mm -= BODY.d * math.cos(theta)
    return Motion(x_mm, y_mm, theta, theta, *[0.0] * 9)


def errors_between(robot: Motion, reference: Motion) -> np.ndarray:
    x, y = axle_midpoint(robot, BODY.d)
    x_ref, y_ref = axle_midpoint(reference, BODY.d)
    return np.array(
        [*body_errors(x_ref - x, y_ref - y, robot.theta), reference.theta - robot.theta]
    )


def test_error_rates_on_the_kinematic_plant_are_eq_17():
    rng = np.random.default_rng(4)
    dt = 1e-4
    for _ in range(200):
        robot = at_pose(*rng.uniform(-500, 500, 2), rng.uniform(-4, 4))
        reference = at_pose(*rng.uniform(-500, 500, 2), rng.uniform(-4, 4))
        u, u_star = rng.uniform((-500, -2), (500, 2)), rng.uniform((0, -2), (500, 2))
        delta = rng.uniform((-50, -0.5), (50, 0.5))
        wheels, wheels_star = np.linalg.solve(EQ_1, u), np.linalg.solve(EQ_1, u_star)
        after, before = (
            errors_between(
                follow_wheels(BODY, robot, *wheels, *delta, step),
                follow_wheels(BODY, reference, *wheels_star, 0.0, 0.0, step),
            )
            for step in (dt, -dt)
        )
        measured = (after - before) / (2 * dt)
        expected = error_rates(errors_between(robot, reference), u, u_star, delta)
        np.testing.assert_allclose(measured, expected, rtol=1e-6, atol=1e-3)


def test_the_castor_of_the_kinematic_plant_rolls_without_slip():
    """Its contact moves only along its wheel, wherever the robot heads and however the fork stands."""
    rng = np.random.default_rng(6)
    robot, dt = RobotParameters(), 1e-6

    def contact(motion: Motion) -> np.ndarray:
        x, y = axle_midpoint(motion, BODY.d)
        pivot = robot.castor_pivot_mm * np.array([math.sin(motion.theta), -math.cos(motion.theta)])
        trail = robot.castor_trail_mm * np.array([math.sin(motion.psi), -math.cos(motion.psi)])
        return np.array([x, y]) + pivot + trail

    for _ in range(50):
        before = at_pose(*rng.uniform(-5, 5, 2), rng.uniform(-4, 4))
        before = before._replace(psi=rng.uniform(-4, 4))
        wheels = rng.uniform(-8, 8, 2)
        after = follow_wheels(BODY, before, *wheels, 0.0, 0.0, dt)
        across = np.array([math.cos(before.psi), math.sin(before.psi)])
        velocity = (contact(after) - contact(before)) / dt
        assert abs(velocity @ across) < 0.02  # of hundreds of mm/s
        assert after.psi - before.psi == pytest.approx(dt * after.s, rel=1e-6)


@untimed
@given(st.floats(-1, 1), st.floats(-1, 1))
def test_twist_command_inverts_eq_1(forward, turn):
    wheels = wheel_command(forward, turn, TWIST, BODY, BELIEF)
    np.testing.assert_allclose(EQ_1 @ wheels, (1000 * forward, 8 * turn), rtol=1e-12, atol=1e-12)


@untimed
@given(st.floats(0.9, 1.1), st.floats(0.9, 1.1), st.floats(0.9, 1.1), st.floats(-1, 1))
def test_a_computer_finds_the_twist_that_it_asked_for_whatever_it_believes(left, right, axle, turn):
    """Its odometry is that of wheels with the believed radii on the believed axle, eq. (1)."""
    belief = Belief(radius_l=left, radius_r=right, h=axle * L_MM / 2)
    wheels = believed_wheel_speeds(300.0, turn, BODY, belief)
    radii = R_MM * np.array([left, right])
    rows = np.array([[0.5, 0.5], [-1 / (axle * L_MM), 1 / (axle * L_MM)]]) * radii
    np.testing.assert_allclose(rows @ wheels, (300.0, turn), rtol=1e-12, atol=1e-12)
    found = believed_odometry(*wheels, BODY, belief)
    np.testing.assert_allclose(found, (300.0, turn), rtol=1e-12, atol=1e-12)


def test_wheel_speed_command_is_in_units_of_25_rad_s():
    assert wheel_command(0.5, -1.0, WHEEL_SPEED, BODY, BELIEF) == (12.5, -25.0)


# Closed loop


@presets
@pytest.mark.parametrize("start", [(100.0, -200.0, -0.5), (-80.0, 150.0, 2.5)])
def test_kinematic_closed_loop_follows_the_continuous_solution(preset, start):
    """Law and kinematic plant at 1 ms against an adaptive solution of (17) with (19) and (21)."""
    gains = gains_row(controller(preset).gains)
    u_star, duration, dt = (300.0, 0.4), 20.0, 0.001
    k_1, k_2, k_3, eta, epsilon = gains

    def rates(_, e):
        lam = np.array([-e[0], -k_3 * math.sin(e[2])])
        inside = eta * np.abs(lam).sum() < epsilon
        rho = -(eta**2) * lam / epsilon if inside else -eta * np.sign(lam)
        u_1 = k_1 * e[0] + u_star[0] * math.cos(e[2]) + rho[0]
        u_2 = k_2 / k_3 * math.sin(e[2]) + u_star[1] - e[1] * u_star[0] / k_3 + rho[1]
        return error_rates(e, (u_1, u_2), u_star)

    reference = at_pose(0.0, 0.0, 0.0)
    robot = at_pose(*start)
    start_errors = errors_between(robot, reference)
    exact = solve_ivp(rates, (0, duration), start_errors, rtol=1e-8, atol=1e-8, max_step=0.01).y.T[
        -1
    ]
    wheels_star = tuple(np.linalg.solve(EQ_1, u_star))
    e = start_errors
    peak = v = lyapunov(e, k_3)
    for _ in range(round(duration / dt)):
        wheels = np.linalg.solve(EQ_1, law_of(tracking_twist, e, u_star, gains))
        robot = follow_wheels(BODY, robot, *wheels, 0.0, 0.0, dt)
        reference = follow_wheels(BODY, reference, *wheels_star, 0.0, 0.0, dt)
        e = errors_between(robot, reference)
        v = lyapunov(e, k_3)
        peak = max(peak, v)
    scale = np.array([1.0, 1.0, 1 / math.sqrt(k_3)]) * math.sqrt(2 * lyapunov(start_errors, k_3))
    np.testing.assert_allclose(e / scale, exact / scale, atol=0.02)
    assert peak <= 1.01 * lyapunov(start_errors, k_3)
    assert v < 0.05 * lyapunov(start_errors, k_3)


@pytest.mark.parametrize("gains", PRESETS)
def test_errors_converge_on_the_kinematic_plant_up_to_the_hold_of_the_control(gains):
    """What remains is the hold of one period: half the period leaves half the error."""
    ideal = {"plant": "kinematic", "disturbance": "none", "horizon_s": 60.0}
    coarse = drive("infinity", gains, control_period_s=0.01, **ideal).rms_mm
    fine = drive("infinity", gains, control_period_s=0.005, **ideal).rms_mm
    assert np.all(coarse < 1.0)
    np.testing.assert_allclose(fine[0], coarse[0] / 2, rtol=0.05)
    assert np.all(fine < 0.7 * coarse)


def test_errors_converge_after_a_wrong_start_on_the_kinematic_plant():
    env = tlf_env.parallel_env("infinity", plant="kinematic", disturbance="none", end_on=())
    observations, _ = env.reset(seed=0)
    for _ in range(100):
        observations, *_, infos = env.step(alike(env, (0.1, -0.05)))
    assert infos["robot_0"]["position_error_mm"] > 500
    *_, infos = play(env, observations)[-1]
    assert all(info["position_error_mm"] < 5.0 for info in infos.values())
    assert all(abs(info["heading_error_rad"]) < 0.02 for info in infos.values())
