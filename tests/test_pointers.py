"""Named tuples that compiled functions get by a pointer: what they read, from the tuple or packed."""

from __future__ import annotations

import copy
import pickle
from typing import NamedTuple

import numba
import numpy as np
import pytest

import tlf_env
from tlf_env.numerics.compiled import driver, law
from tlf_env.numerics.pointers import by_pointer, packed


class Pair(NamedTuple):
    left: float
    right: bool


@by_pointer
class Things(NamedTuple):
    wide: np.ndarray
    count: int
    small: np.ndarray
    share: float
    on: bool
    pair: Pair
    off: bool


@law
def weighed(things: Things, i: int) -> float:
    return things.share * things.wide[i, 0, 1] + things.small[i]


@driver
def numbers_of(things: Things, out: np.ndarray) -> None:
    out[0], out[1], out[2] = things.count, things.share, things.on
    out[3], out[4], out[5] = things.pair.left, things.pair.right, things.off
    out[6], out[7] = things.wide.size, things.small.strides[0]
    for i in range(things.small.shape[0]):
        out[8 + i] = weighed(things, i)
        things.small[i] += 1


@driver
def unknown(things: Things) -> float:
    return things.absent


def made() -> Things:
    wide = np.arange(24.0).reshape(3, 2, 4)
    small = np.array([5, 7, 9], dtype=np.int32)
    return Things(wide, -3, small, 0.5, True, Pair(-2.5, True), False)


FIRST = [-3.0, 0.5, 1.0, -2.5, 1.0, 0.0, 24.0, 4.0, 5.5, 11.5, 17.5]
NEXT = [*FIRST[:8], 6.5, 12.5, 18.5]


def read(things: Things) -> list[float]:
    out = np.zeros(11)
    numbers_of(things, out)
    return out.tolist()


def test_a_driver_reads_the_tuple_and_what_is_packed_of_it():
    things = made()
    held = packed(things)
    assert [read(things), read(held), read(held)] == [FIRST, NEXT, [*FIRST[:8], 7.5, 13.5, 19.5]]
    assert things.small.tolist() == [8, 10, 12]
    assert len(numbers_of.overloads) == 1


def test_arrays_of_other_kinds_are_other_types():
    things = made()._replace(small=np.array([5.0, 7.0, 9.0])[::1], wide=made().wide[:, :, ::2])
    out = np.zeros(11)
    numbers_of(packed(things), out)
    assert out[8:].tolist() == [0.5 * 2 + 5, 0.5 * 10 + 7, 0.5 * 18 + 9]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_has_arrays_of_its_own(copied):
    things = made()
    held = packed(things)
    other = copied(held)
    assert read(other) == FIRST
    assert things.small.tolist() == [5, 7, 9]
    del held, things
    assert read(other) == NEXT


def test_an_unknown_field_is_an_error_of_the_compiler():
    with pytest.raises(numba.TypingError, match="absent"):
        unknown(made())


def test_anything_else_is_refused():
    read(made())
    with pytest.raises((TypeError, numba.TypingError)):
        numbers_of((1.0, 2), np.zeros(11))


def test_arrays_put_in_the_place_of_others_are_seen_by_the_next_step():
    env, same = (tlf_env.parallel_env("infinity", disturbance="nominal") for _ in range(2))
    actions = {agent: np.zeros(2) for agent in env.possible_agents}
    for one in (env, same):
        one.reset(seed=0)
    formation = env.formation
    formation.arrays = copy.deepcopy(formation.arrays)
    for one in (env, same):
        one.step(actions)
    assert formation.arrays.clock[0, 1] == 1
    assert np.array_equal(formation.arrays.infos, same.formation.arrays.infos)
