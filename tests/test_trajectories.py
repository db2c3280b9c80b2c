"""The leader's reference: eqs (52), (53) and what is derived from them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tlf_env.task.scenario import load_scenario
from tlf_env.task.trajectories import REFERENCE_COLUMNS, Lissajous, Rose, sample

PERIODS_S = {"infinity": 16 * math.pi, "flower": 120.0}

paths = pytest.mark.parametrize("name", PERIODS_S)


def printed(name: str, t):
    """Eqs (52) and (53), mm; analytic, so that ``t`` may be complex."""
    if name == "infinity":
        return 2e3 * np.sin(t / 8) + 2.5e3, 2e3 * np.sin(t / 4) + 2.5e3
    return (
        2.5e3 * np.cos(np.pi * t / 30) * np.sin(np.pi * t / 60) + 5e3,
        -2e3 * np.cos(np.pi * t / 30) * np.cos(np.pi * t / 60) + 4e3,
    )


def trajectory(name: str) -> Lissajous | Rose:
    return load_scenario(name).trajectory


def times(name: str, count: int = 2001) -> np.ndarray:
    return np.linspace(0, 2 * PERIODS_S[name], count)


def columns(name: str, t_s: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(REFERENCE_COLUMNS, sample(trajectory(name), t_s).T, strict=True))


@paths
def test_positions_are_the_printed_ones(name):
    t_s = times(name)
    here = columns(name, t_s)
    np.testing.assert_allclose([here["x_mm"], here["y_mm"]], printed(name, t_s), atol=1e-9)


@paths
def test_velocities_are_the_complex_step_of_the_printed_positions(name):
    t_s, step = times(name), 1e-30
    exact = np.imag(printed(name, t_s + 1j * step)) / step
    np.testing.assert_allclose(trajectory(name).derivatives(t_s)[1], exact, atol=1e-9)


@paths
def test_accelerations_are_differences_of_the_velocities(name):
    t_s, step = times(name), 1e-4
    path = trajectory(name)
    slope = (path.derivatives(t_s + step)[1] - path.derivatives(t_s - step)[1]) / (2 * step)
    np.testing.assert_allclose(path.derivatives(t_s)[2], slope, atol=1e-5)


@paths
def test_heading_is_continuous_and_along_the_velocity(name):
    t_s = times(name)
    theta = columns(name, t_s)["theta_rad"]
    v_x, v_y = np.imag(printed(name, t_s + 1e-30j)) / 1e-30
    off = theta - np.arctan2(-v_x, v_y)
    np.testing.assert_allclose(off / (2 * np.pi), np.rint(off / (2 * np.pi)), atol=1e-9)
    assert np.abs(np.diff(theta)).max() < 0.2
    assert abs(theta[0]) <= math.pi


@paths
def test_reference_robot_moves_along_its_heading(name):
    """Eq. (15): ẋ = −u₁ sin θ, ẏ = u₁ cos θ."""
    t_s = times(name)
    here = columns(name, t_s)
    v_x, v_y = np.imag(printed(name, t_s + 1e-30j)) / 1e-30
    np.testing.assert_allclose(-here["u_1_mm_s"] * np.sin(here["theta_rad"]), v_x, atol=1e-8)
    np.testing.assert_allclose(here["u_1_mm_s"] * np.cos(here["theta_rad"]), v_y, atol=1e-8)
    assert here["u_1_mm_s"].min() > 0


@paths
def test_yaw_rate_is_the_derivative_of_the_heading(name):
    t_s = np.arange(0, PERIODS_S[name], 1e-3)
    here = columns(name, t_s)
    slope = (here["theta_rad"][2:] - here["theta_rad"][:-2]) / 2e-3
    np.testing.assert_allclose(here["u_2_rad_s"][1:-1], slope, atol=1e-5)


@paths
def test_path_repeats_after_its_period_and_not_before(name):
    t_s = np.linspace(0, PERIODS_S[name], 777)
    path, period_s = trajectory(name), PERIODS_S[name]
    here = path.derivatives(t_s)
    np.testing.assert_allclose(path.derivatives(t_s + period_s), here, atol=1e-8)
    for part in (2, 3, 4, 5):
        assert np.abs(path.derivatives(t_s + period_s / part)[0] - here[0]).max() > 100


def test_infinity_is_fastest_at_its_start():
    t_s = np.arange(0, PERIODS_S["infinity"], 1e-3)
    speed = columns("infinity", t_s)["u_1_mm_s"]
    assert speed.max() == speed[0] == pytest.approx(math.hypot(250, 500))
    assert speed[0] == pytest.approx(559, abs=0.1)


def test_top_speed_of_the_flower():
    """Through the centre, where cos(πt/30) = 0, it is (π/30)·√(2500² + 2000²)/√2; a little more beside it."""
    t_s = np.arange(0, PERIODS_S["flower"], 1e-3)
    here = columns("flower", t_s)
    centre = columns("flower", np.array([15.0]))
    assert (centre["x_mm"], centre["y_mm"]) == (pytest.approx(5000), pytest.approx(4000))
    through = math.pi / 30 * math.hypot(2500, 2000) / math.sqrt(2)
    assert centre["u_1_mm_s"] == pytest.approx(through) == pytest.approx(237.1, abs=0.1)
    exact = np.hypot(*np.imag(printed("flower", t_s + 1e-30j))) / 1e-30
    assert here["u_1_mm_s"].max() == pytest.approx(exact.max()) == pytest.approx(243.5, abs=0.1)


def test_phase_shifts_the_curve():
    path = trajectory("infinity")
    shifted = path.model_copy(update={"phase_x_rad": 0.25, "phase_y_rad": 0.5})
    t_s = np.linspace(0, 10, 50)
    np.testing.assert_allclose(shifted.derivatives(t_s), path.derivatives(t_s + 2), atol=1e-8)
