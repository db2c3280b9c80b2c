"""The angular velocity controller (AVC), eq. (13): its digital form, its limits, its design figures."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

import tlf_env
from tlf_env.onboard.wheel_loop import (
    WheelLoopParameters,
    WheelLoopRow,
    digital_wheel_loop,
    wheel_torque,
)

PERIOD_S = 0.001
LIMIT = 15.0  # N·mm, footnote 4
TO_LAW = 1000.0  # the law's torques are in mN·mm
KAPPA = 1 / (0.4 * 1.245 * 50**2 + 52.91)  # eq. (6), 1/(kg·mm²); 7.705e-4
KAPPA_Nmm = 1000 * KAPPA  # rad/s² per N·mm

DIGITAL = digital_wheel_loop(WheelLoopParameters(), PERIOD_S)


def eq_13(s):
    """Eq. (13) as printed."""
    return 150 * (s**2 + 3 * s + 0.3025) / (s * (s + 2))


def feed(loop: WheelLoopRow, errors: np.ndarray, limit: float = math.inf) -> np.ndarray:
    """Torques (N·mm) that the law gives for a sequence of speed errors."""
    integral = lag = 0.0
    torques = np.empty(len(errors))
    for i, error in enumerate(errors):
        torques[i], integral, lag = wheel_torque(error, integral, lag, loop, limit * TO_LAW)
    return torques / TO_LAW


def decaying_response(loop: WheelLoopRow, period_s: float) -> np.ndarray:
    """First difference of the law's impulse response: it ends, within 20 time constants of the lag.

    The impulse response itself does not, for the integrator.
    """
    impulse = np.zeros(round(10 / period_s))
    impulse[0] = 1.0
    return np.diff(feed(loop, impulse), prepend=0.0)


def measured_response(loop: WheelLoopRow, period_s: float, omega: np.ndarray) -> np.ndarray:
    """Frequency response of the law, N·mm per rad/s."""
    _, transform = signal.freqz(decaying_response(loop, period_s), worN=omega * period_s)
    return transform / (1 - np.exp(-1j * omega * period_s))


# The law against eq. (13)


@pytest.mark.parametrize("period_s", [0.001, 0.002])
def test_frequency_response_is_that_of_eq_13(period_s):
    omega = np.geomspace(0.01, 50, 40)
    loop = digital_wheel_loop(WheelLoopParameters(), period_s)
    expected = eq_13(1j * omega)
    error = np.abs(measured_response(loop, period_s, omega) - expected) / np.abs(expected)
    assert error.max() < 2 * period_s  # half a sample on the slow parts, which fade as 1/ω


def test_frequency_response_converges_with_the_period():
    omega = np.geomspace(0.1, 50, 20)
    expected = eq_13(1j * omega)

    def worst(period_s: float) -> float:
        loop = digital_wheel_loop(WheelLoopParameters(), period_s)
        measured = measured_response(loop, period_s, omega)
        return float(np.max(np.abs(measured - expected) / np.abs(expected)))

    assert worst(0.001) < 0.6 * worst(0.002)


def test_partial_fractions_are_exact_and_not_the_rounded_ones():
    numerator, denominator = [150, 450, 150 * 0.3025], [1, 2, 0]
    at_zero = np.polyval(numerator, 0) / 2
    at_pole = np.polyval(numerator, -2) / -2
    assert (at_zero, at_pole) == pytest.approx((22.69, 127.31), abs=0.005)
    assert np.polyval(denominator, 0) == np.polyval(denominator, -2) == 0
    step = feed(DIGITAL, np.ones(10_000))  # 20 time constants of the lag
    late_slope = (step[-1] - step[-2]) / PERIOD_S
    assert late_slope == pytest.approx(at_zero, rel=1e-6)
    lag_part = step[-1] - 150 - at_zero * 10_000 * PERIOD_S
    assert lag_part == pytest.approx(at_pole / 2, rel=1e-6)


def test_first_torque_of_a_step_is_the_gain_of_150():
    assert feed(DIGITAL, np.array([1e-3]))[0] == pytest.approx(0.150, rel=2e-3)


# Limits


@untimed
@given(st.lists(st.floats(-50, 50), min_size=1, max_size=300), st.integers(1, 50))
def test_torque_stays_within_15_and_the_memory_bounded(errors, hold):
    integral = lag = 0.0
    for error in np.repeat(errors, hold):
        torque, integral, lag = wheel_torque(error, integral, lag, DIGITAL, LIMIT * TO_LAW)
        assert abs(torque) <= LIMIT * TO_LAW
        assert abs(integral) <= 2 * LIMIT * TO_LAW
        assert abs(lag) <= 2 * LIMIT * TO_LAW


def test_memory_holds_while_the_limit_is_asked_to_be_passed():
    assert wheel_torque(5.0, 100.0, 200.0, DIGITAL, LIMIT * TO_LAW) == (15000.0, 100.0, 200.0)
    assert wheel_torque(-5.0, 100.0, 200.0, DIGITAL, LIMIT * TO_LAW) == (-15000.0, 100.0, 200.0)


def overshoot(step_rad_s: float, friction_Nmm: float = 4.0) -> float:
    """Overshoot (rad/s) of a wheel κ/s with sliding friction after a step of its reference."""
    integral = lag = omega = 0.0
    peak = -math.inf
    duration_s = 4.0 + step_rad_s / (KAPPA_Nmm * (LIMIT - friction_Nmm))
    for _ in range(round(duration_s / PERIOD_S)):
        error = step_rad_s - omega
        torque, integral, lag = wheel_torque(error, integral, lag, DIGITAL, LIMIT * TO_LAW)
        omega += PERIOD_S * KAPPA_Nmm * (torque / TO_LAW - friction_Nmm)
        peak = max(peak, omega - step_rad_s)
    return peak


def test_saturation_does_not_make_the_overshoot_grow():
    """An integrator that wound up would overshoot in proportion to the time at the limit."""
    unsaturated = overshoot(0.05)
    assert unsaturated < 0.01
    for step_rad_s in (1.0, 5.0, 12.0, 25.0):
        assert overshoot(step_rad_s) <= max(unsaturated, 1e-3)


def test_torque_leaves_the_limit_as_soon_as_the_error_allows():
    """After 5 s at the limit an error of the other sign reverses the torque at once."""
    integral = lag = 0.0
    for _ in range(5000):
        torque, integral, lag = wheel_torque(3.0, integral, lag, DIGITAL, LIMIT * TO_LAW)
        assert torque == LIMIT * TO_LAW
    torque, *_ = wheel_torque(-0.2, integral, lag, DIGITAL, LIMIT * TO_LAW)
    assert torque == -LIMIT * TO_LAW


# Design figures of the paper, with K in kg·mm²/s² per rad/s: the slow loop of Fig. 7


@pytest.fixture(scope="module")
def design():
    """Frequencies, L, S and T of the slow loop, and the weights of eq. (12), by python-control."""
    s = control.tf("s")
    L = KAPPA / s * eq_13(s)
    omega = np.geomspace(1e-3, 1e2, 50_001)
    s_omega = 1j * omega
    return {
        "omega": omega,
        "L": L(s_omega),
        "S": control.feedback(1, L)(s_omega),
        "T": control.feedback(L, 1)(s_omega),
        "W_delta": ((s + 1.27) / 2.54)(s_omega),
        "W_e": ((s + 0.1) / (1.5 * s))(s_omega),
    }


def where_unity(omega, response) -> float:
    """The frequency at which a magnitude passes 1."""
    return float(omega[np.argmin(np.abs(np.log(np.abs(response))))])


def test_crossover_of_the_design_loop(design):
    assert pytest.approx(7.705e-4, rel=1e-4) == KAPPA
    assert where_unity(design["omega"], design["L"]) == pytest.approx(0.190, abs=5e-4)


def test_weights_pass_unity_where_the_paper_puts_them(design):
    assert where_unity(design["omega"], design["W_delta"]) == pytest.approx(2.20, abs=5e-3)
    assert where_unity(design["omega"], design["W_e"]) == pytest.approx(0.0894, abs=5e-5)


def test_robust_stability_and_nominal_performance_hold(design):
    """Eqs (9) and (10)."""
    assert np.abs(design["W_delta"] * design["T"]).max() == pytest.approx(0.671, abs=5e-4)
    assert np.abs(design["W_e"] * design["S"]).max() == pytest.approx(0.759, abs=5e-4)


def test_robust_performance_does_not_hold_with_the_printed_numbers(design):
    """Eq. (11) asks for less than 1."""
    both = np.abs(design["W_e"] * design["S"]) + np.abs(design["W_delta"] * design["T"])
    assert both.max() == pytest.approx(1.334, abs=5e-4)


def test_modulus_margin_of_the_design_loop(design):
    assert np.abs(1 + design["L"]).min() == pytest.approx(0.95, abs=5e-3)


# The loop that runs: K in N·mm per rad/s, digital


def digital_margin(period_s: float, delay: int, kappa: float = KAPPA_Nmm) -> float:
    """Modulus margin with the measured response of the law and a held torque on κ/s."""
    differences = decaying_response(digital_wheel_loop(WheelLoopParameters(), period_s), period_s)
    transform = np.fft.rfft(differences)[1:]  # from 0.6 rad/s to the Nyquist frequency
    z = np.exp(2j * math.pi * np.arange(1, len(transform) + 1) / len(differences))
    K = transform / (1 - 1 / z)
    return float(np.abs(1 + K * kappa * period_s / (z - 1) * z**-delay).min())


@pytest.mark.parametrize(("period_s", "delay"), [(0.001, 1), (0.002, 0)])
def test_modulus_margin_with_the_dead_time_of_the_papers_simulation(period_s, delay):
    """The paper measures 0.81."""
    assert 0.79 <= digital_margin(period_s, delay) <= 0.89


def test_modulus_margin_against_the_closed_form_of_its_proportional_part():
    """K ≈ 150 near the crossover: L = a/(z−1) has the real part −a/2, so the margin is 1 − a/2."""
    a = 150 * KAPPA_Nmm * PERIOD_S
    assert digital_margin(PERIOD_S, 0) == pytest.approx(1 - a / 2, abs=2e-3)


def test_modulus_margin_falls_with_period_and_delay():
    margins = {(T, d): digital_margin(T, d) for T in (0.001, 0.002, 0.005) for d in (0, 1)}
    assert min(margins[0.001, 0], margins[0.001, 1], margins[0.002, 0], margins[0.002, 1]) > 0.5
    for T in (0.001, 0.002, 0.005):
        assert margins[T, 1] < margins[T, 0]
    for d in (0, 1):
        assert margins[0.005, d] < margins[0.002, d] < margins[0.001, d]
    assert margins[0.005, 1] == pytest.approx(0.4, abs=0.05)


def test_sensitivity_of_the_running_robot_is_that_of_the_digital_loop():
    """Both wheels' references swing about 6 rad/s; S = error/reference, κ of the common mode 0.800·κ."""
    env = tlf_env.parallel_env(
        "infinity",
        robots=1,
        action="wheel_speed",
        disturbance="none",
        control_period_s=PERIOD_S,
        horizon_s=30.0,
        end_on=(),
    )
    speed_scale, mean, swing, settle, count = 25.0, 6.0, 0.03, 2000, 1000
    for omega in 2 * math.pi * np.array([3.0, 10.0, 30.0, 100.0, 300.0]):
        env.reset(seed=0)
        errors = np.empty(settle + 2 * count)
        wanted = mean + swing * np.sin(omega * np.arange(len(errors)) * PERIOD_S)
        sensors = env.formation.arrays.rows("sensors")
        for i, one in enumerate(wanted):
            errors[i] = one - sensors[2, 0, 0]
            env.step({"robot_0": np.full(2, one / speed_scale)})
            assert i < settle or abs(env.formation.arrays.rows("trace")[5, 0, 0]) < LIMIT * TO_LAW
        tone = np.exp(-1j * omega * np.arange(len(errors)) * PERIOD_S)[settle:]
        error, reference = errors[settle:] - errors[settle:].mean(), wanted[settle:] - mean
        measured = (error * tone).sum() / (reference * tone).sum()
        z = np.exp(1j * omega * PERIOD_S)
        K = measured_response(DIGITAL, PERIOD_S, np.array([omega]))[0]
        expected = 1 / (1 + K * 0.800 * KAPPA_Nmm * PERIOD_S / (z - 1))
        assert abs(measured - expected) < 0.01
