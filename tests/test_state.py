"""The state for critics: exact wherever the path lies, and within the bounds of its space."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from pettingzoo.test.state_test import test_state_space as check_state_space

import tlf_env
from tlf_env.engine.formation import STATE_ROUNDING_MM, STATE_SCALES
from tlf_env.task.info import State

X, Y, REFERENCE_X = (State._fields.index(name) for name in ("x_mm", "y_mm", "reference_x_mm"))


def circle(centre_mm: float, **others: Any) -> Any:
    path = {
        "type": "circle",
        "radius_mm": 1000.0,
        "speed_mm_s": 150.0,
        "centre_x_mm": centre_mm,
        "centre_y_mm": -centre_mm,
    }
    env = tlf_env.parallel_env({"trajectory": path, "robots": 2, "horizon_s": 10.0}, **others)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("centre_mm", [0.0, 1e4, 1.5e5, 2.6e5, 1e6, 3.3e8, -3.3e8, 9e8])
def test_places_are_exact_wherever_the_path_lies(centre_mm):
    env = circle(centre_mm)
    for _ in range(30):
        *_, infos = env.step({agent: [0.3, 0.2] for agent in env.agents})
        state = env.state()
        assert state in env.state_space
        rows = state.reshape(2, -1).astype(np.float64) * STATE_SCALES
        truth = env.formation.state()
        for entry in (X, Y, REFERENCE_X):
            assert np.abs(rows[:, entry] - truth[:, entry]).max() <= STATE_ROUNDING_MM
        assert rows[0, X] == pytest.approx(infos["robot_0"]["x_mm"], abs=STATE_ROUNDING_MM, rel=0)


@pytest.mark.parametrize(
    ("centre_mm", "others", "dtype"),
    [
        (0.0, {}, np.float32),
        (2.5e5, {}, np.float32),
        (2.7e5, {}, np.float64),
        (3.3e8, {}, np.float64),
        (0.0, {"dtype": "float64"}, np.float64),
    ],
)
def test_the_dtype_is_float32_where_that_is_enough(centre_mm, others, dtype):
    env = circle(centre_mm, **others)
    assert env.state().dtype == env.state_space.dtype == dtype


@pytest.mark.parametrize("robots", [1, 3])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_bounds_are_finite_and_pettingzoo_has_nothing_to_warn_of(robots, dtype):
    env = tlf_env.parallel_env("infinity", robots=robots, dtype=dtype)
    env.reset(seed=0)
    assert np.isfinite(env.state_space.low).all()
    assert np.isfinite(env.state_space.high).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_state_space(env)
        check_state_space(tlf_env.aec_env("infinity", robots=robots, dtype=dtype))
    assert env.state_space.sample() in env.state_space


def test_a_violent_drive_stays_within_the_bounds():
    env = tlf_env.parallel_env(
        "infinity", action="torque", disturbance="combined-hard", end_on=(),
        horizon_s=6.0, time_gap_s=1.0, preview_s=(),
    )  # fmt: skip
    env.reset(seed=3)
    while env.agents:
        env.step({agent: [1.0, -1.0] for agent in env.agents})
        assert env.state() in env.state_space
