from __future__ import annotations

import math

import numpy as np
import pytest

from tlf_env.numerics.compiled import driver
from tlf_env.numerics.trig import LARGEST_ANGLE_RAD, log, sincos

DRAWS = 200_000
# Where long doubles are no longer than doubles the comparison itself is half a unit off.
WORST_ULP = 1.0 if np.finfo(np.longdouble).eps < np.finfo(np.float64).eps else 1.5


@driver
def fill_sincos(x: np.ndarray, sin: np.ndarray, cos: np.ndarray) -> None:
    for i in range(x.size):
        sin[i], cos[i] = sincos(x[i])


@driver
def fill_log(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(x.size):
        out[i] = log(x[i])


def sines(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sin, cos = np.empty_like(x), np.empty_like(x)
    fill_sincos(x, sin, cos)
    return sin, cos


def logs(x: np.ndarray) -> np.ndarray:
    out = np.empty_like(x)
    fill_log(x, out)
    return out


def ulps(got: np.ndarray, exact: np.ndarray) -> float:
    """Largest error in units in the last place of the exact value."""
    return float(np.max(np.abs(got - exact) / np.spacing(np.abs(exact.astype(np.float64)))))


@pytest.mark.parametrize("largest", [1e-3, math.pi / 4, 4.0, 100.0, 1e5, LARGEST_ANGLE_RAD])
def test_sine_and_cosine_are_good_to_one_unit_in_the_last_place(largest):
    x = np.random.default_rng(1).uniform(-largest, largest, DRAWS)
    sin, cos = sines(x)
    assert ulps(sin, np.sin(x.astype(np.longdouble))) <= WORST_ULP
    assert ulps(cos, np.cos(x.astype(np.longdouble))) <= WORST_ULP


def test_the_floats_nearest_to_multiples_of_a_quarter_turn_keep_their_last_bits():
    x = np.arange(1, 1_000_001, 7) * (math.pi / 2)
    sin, cos = sines(x)
    assert ulps(sin, np.sin(x.astype(np.longdouble))) <= WORST_ULP
    assert ulps(cos, np.cos(x.astype(np.longdouble))) <= WORST_ULP


def test_no_angle_gives_more_than_one_by_more_than_rounding():
    x = np.random.default_rng(2).uniform(-1e5, 1e5, DRAWS)
    sin, cos = sines(x)
    assert np.abs(sin * sin + cos * cos - 1).max() < 1e-15


def test_special_angles():
    assert sincos(0.0) == (0.0, 1.0)
    assert sincos(5e-324) == (5e-324, 1.0)
    for nothing in (math.nan, math.inf, -math.inf):
        assert np.isnan(sincos(nothing)).all()


def test_logarithm_is_good_to_one_unit_in_the_last_place():
    rng = np.random.default_rng(3)
    for x in (
        1.0 - rng.integers(0, 2**53, DRAWS) * 2.0**-53,
        2.0 ** -rng.uniform(0, 53, DRAWS),
        1.0 - 2.0 ** -rng.uniform(1, 53, DRAWS),
        10.0 ** rng.uniform(-300, 300, DRAWS),
    ):
        x = x[x != 1.0]
        assert ulps(logs(x), np.log(x.astype(np.longdouble))) <= WORST_ULP


def test_special_logarithms():
    assert log(1.0) == 0.0
    assert log(2.0**-53) == pytest.approx(-53 * math.log(2.0), rel=1e-16)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7, 8, 9, 15, 17, 64])
def test_a_lane_alone_gives_the_bits_that_it_gives_among_others(count):
    x = np.random.default_rng(count).uniform(-1e4, 1e4, count)
    sin, cos = sines(x)
    assert [sincos(value) for value in x] == list(zip(sin, cos, strict=True))
    assert [log(value) for value in np.abs(x)] == list(logs(np.abs(x)))
