"""How much of a residual counts, near the reference and far from it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tlf_env import load_scenario
from tlf_env.engine.formation import Formation
from tlf_env.task.actions import residual_share
from tlf_env.task.observation import tracking_entries

ENTRIES = tracking_entries(())
SCALES = np.array([entry.scale for entry in ENTRIES.values()])
SHORT = {"horizon_s": 6.0, "time_gap_s": 1.0, "preview_s": (0.5,), "estimator": "ekf-slip"}


def share(e_1: float, e_2: float, fade: float, reach: float) -> float:
    observation = np.zeros(len(SCALES))
    observation[:2] = e_1 / 500.0, e_2 / 500.0
    return residual_share.py_func(observation, SCALES, fade, reach)


@given(st.floats(-2000, 2000), st.floats(-2000, 2000))
def test_without_bounds_everything_counts(e_1: float, e_2: float):
    assert share(e_1, e_2, 0.0, math.inf) == 1.0


@given(st.floats(1e-3, 2000), st.floats(0.1, 50), st.floats(60, 1000), st.floats(0, 6.3))
def test_it_is_a_share_and_halves_at_its_bounds(e: float, fade: float, reach: float, turn: float):
    found = share(e * math.cos(turn), e * math.sin(turn), fade, reach)
    expected = e / (e + fade) * reach**4 / (e**4 + reach**4)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert 0.0 <= found <= 1.0
    assert share(fade, 0.0, fade, math.inf) == pytest.approx(0.5)
    assert share(0.0, -reach, 0.0, reach) == pytest.approx(0.5)


@pytest.mark.parametrize("fade", [0.0, 5.0])
def test_without_an_error_all_or_nothing_counts(fade: float):
    assert share(0.0, 0.0, fade, 80.0) == (1.0 if fade == 0.0 else 0.0)


def run(action: np.ndarray, **fields: object) -> Formation:
    scenario = load_scenario(
        "infinity", action="residual", residual_base="tuned", end_on=(), **SHORT, **fields
    )
    formation = Formation(scenario)
    formation.reset(0)
    for _ in range(scenario.horizon_steps):
        formation.arrays.actions[0] = action
        formation.step()
    return formation


def test_a_residual_that_never_counts_leaves_the_base_as_it_is():
    base = run(np.zeros((3, 2))).arrays.rows("motion")
    full = np.full((3, 2), 0.7)
    for fields in (
        {"residual_fade_mm": 1e15},
        {"residual_fade_mm": 1.0, "residual_reach_mm": 1e-9},
    ):
        np.testing.assert_allclose(run(full, **fields).arrays.rows("motion"), base, atol=1e-6)
    assert np.abs(run(full).arrays.rows("motion") - base).max() > 1.0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"residual_fade_mm": -1.0}, "residual_fade_mm"),
        ({"residual_reach_mm": 0.0}, "residual_reach_mm"),
        ({"residual_fade_mm": math.nan}, "residual_fade_mm"),
    ],
)
def test_impossible_bounds_are_refused(fields: dict, said: str):
    with pytest.raises(ValueError, match=said):
        load_scenario("infinity", **fields)
