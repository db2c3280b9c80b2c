"""Memory that begins at a cache line."""

from __future__ import annotations

import numpy as np
import pytest

from tlf_env.engine.arrays import make_arrays
from tlf_env.engine.formation import reference_table
from tlf_env.numerics.compiled import driver
from tlf_env.numerics.memory import CACHE_LINE_BYTES, copy_line, prefetch, shaped, table, zeros
from tlf_env.task.scenario import load_scenario


@driver
def place_of_a_table(numbers: np.ndarray) -> int:
    t = table(5, 8)
    for i in range(5):
        for j in range(8):
            t[i, j] = numbers[i, j]
    same = shaped(t, 5, 8)
    for i in range(5):
        for j in range(8):
            numbers[i, j] = 2.0 * same[i, j]
    return t.ctypes.data


@driver
def copy_one(to: np.ndarray, row: int, first: int, of: np.ndarray, field: int, column: int) -> None:
    copy_line(to, row, first, of, field, column)


@driver
def ask_for_all(numbers: np.ndarray) -> float:
    total = 0.0
    for i in range(numbers.shape[0]):
        for j in range(numbers.shape[1]):
            prefetch(numbers, i, j)
            total += numbers[i, j]
    return total


def test_a_table_holds_numbers_and_begins_at_a_cache_line():
    numbers = np.arange(40.0).reshape(5, 8)
    assert place_of_a_table(numbers) % CACHE_LINE_BYTES == 0
    assert (numbers == 2.0 * np.arange(40.0).reshape(5, 8)).all()


def test_asking_ahead_changes_nothing():
    numbers = np.arange(40.0).reshape(5, 8)
    assert ask_for_all(numbers) == 780.0
    assert (numbers == np.arange(40.0).reshape(5, 8)).all()


@pytest.mark.parametrize("to", [np.float64, np.float32])
@pytest.mark.parametrize("of", [np.float64, np.float32])
def test_a_line_is_copied_in_the_precision_of_its_place(to, of):
    numbers = (np.random.default_rng(0).normal(size=(4, 40)) * 1e3).astype(of)
    width = 8 if to == of == np.float64 else 16
    found = np.full((3, 40), 7.0, dtype=to)
    wanted = found.copy()
    wanted[2, 5 : 5 + width] = numbers[1, 3 : 3 + width]
    copy_one(found, 2, 5, numbers, 1, 3)
    assert found.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("shape", [(3,), (2, 3, 5), (0, 4)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_zeros_begin_at_a_cache_line(shape, dtype):
    made = zeros(shape, dtype)
    assert made.shape == shape
    assert made.dtype == dtype
    assert made.flags.c_contiguous
    assert made.flags.writeable
    assert not made.any()
    assert made.size == 0 or made.ctypes.data % CACHE_LINE_BYTES == 0


def test_the_engine_s_rows_begin_at_cache_lines():
    scenario = load_scenario("infinity", plant="batch")
    arrays = make_arrays([scenario], reference_table(scenario), 100)
    for name in ("constants", "states"):
        array = getattr(arrays, name)
        assert array.ctypes.data % CACHE_LINE_BYTES == 0
        assert all(stride % CACHE_LINE_BYTES == 0 for stride in array.strides[:-1])
