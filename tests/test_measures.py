"""The search of the time gap leaves out most of the path, and must find the same as a search of all of it."""

import math

import numpy as np
import pytest

from tlf_env.engine.batch import BatchPlant
from tlf_env.task.measures import nearest_on_segment, steps_within, time_gap_error

GAP, WINDOW, PERIOD_S = 50, 40, 0.02
SLOTS = GAP + WINDOW + 1


def infinity(t):
    return 700.0 * np.sin(t), 350.0 * np.sin(2.0 * t)


def paths(steps=400):
    """Points (2, step) of paths of many kinds, mm."""
    rng = np.random.default_rng(3)
    t = np.arange(steps) * 0.02
    walk = np.cumsum(rng.normal(0.0, 5.0, (2, steps)), axis=1)
    jumps = np.cumsum(rng.normal(0.0, 5.0, (2, steps)) * (rng.random(steps) < 0.05) * 50.0, axis=1)
    stop = np.maximum.accumulate(np.where(np.sin(3.0 * t) > 0.0, t, 0.0))
    return {
        "line": np.array([550.0 * t, np.zeros(steps)]),
        "infinity": np.array(infinity(0.8 * t)),
        "many turns": np.array([100.0 * np.cos(9.0 * t), 100.0 * np.sin(9.0 * t)]),
        "walk": walk,
        "jumps": jumps,
        "stop and go": np.array([550.0 * stop, 20.0 * np.sin(stop)]),
        "at rest": np.full((2, steps), 7.0),
        "back and forth": np.array([200.0 * np.sin(7.0 * t), np.zeros(steps)]),
        "far away": np.array([550.0 * t + 1e7, np.full(steps, -1e7)]),
    }


def ring_at(points, step):
    """The ring (x y way, slot) when ``step`` is the last control step."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))])
    ring = np.zeros((3, SLOTS))
    for k in range(max(step - SLOTS + 1, 0), step + 1):
        ring[:, k % SLOTS] = *points[:, k], way[k]
    return ring


def by_all_segments(x, y, points, step):
    """The first nearest point of all segments in the window: the error in s, and the distance in mm."""
    first, last = max(step - GAP - WINDOW, 0), min(step - GAP + WINDOW, step)
    found = [nearest_on_segment(x, y, *points[:, k], *points[:, k + 1]) for k in range(first, last)]
    squares = [square for _, square in found]
    k = int(np.argmin(squares))
    return (step - (first + k + found[k][0]) - GAP) * PERIOD_S, math.sqrt(squares[k])


@pytest.mark.parametrize("kind", paths())
def test_the_search_finds_what_a_search_of_all_segments_finds(kind):
    points = paths()[kind]
    rng = np.random.default_rng(5)
    far = 0
    for step in range(GAP, points.shape[1], 3):
        for off in (0.0, 1.0, 30.0, 3000.0):
            follower = points[:, step - GAP] + off * rng.normal(size=2)
            given = ring_at(points, step)
            found = time_gap_error(*follower, given, step, GAP, WINDOW, PERIOD_S)
            wanted, away = by_all_segments(*follower, points, step)
            assert found == wanted, (step, off)
            far += away > 100.0
    assert far  # some were far from the path


def test_the_error_is_the_delay_of_a_follower_on_the_same_path():
    t = np.arange(400) * PERIOD_S
    points = np.array(infinity(0.8 * t))
    for late_s in (-0.4, -0.013, 0.0, 0.2, 0.77):
        step = 300
        follower = infinity(0.8 * (t[step] - GAP * PERIOD_S - late_s))
        found = time_gap_error(*follower, ring_at(points, step), step, GAP, WINDOW, PERIOD_S)
        assert found == pytest.approx(late_s, abs=1e-4)  # chords of 20 ms


def test_the_error_is_0_until_one_gap_has_passed():
    points = paths()["line"]
    assert time_gap_error(0.0, 0.0, ring_at(points, 49), 49, GAP, WINDOW, PERIOD_S) == 0.0


@pytest.mark.parametrize("direction", [1, -1])
def test_steps_left_out_take_less_way_than_allowed(direction):
    rng = np.random.default_rng(6)
    ways = np.cumsum(rng.exponential(5.0, 3 * SLOTS))
    at = SLOTS + 20
    ring = np.zeros(SLOTS)
    span = range(at - WINDOW, at + WINDOW + 1)
    ring[[k % SLOTS for k in span]] = ways[span.start : span.stop]
    for room in (-1.0, 0.0, 3.0, 40.0, 1e9):
        steps = steps_within(ring, at % SLOTS, WINDOW, direction, room)
        assert 0 <= steps <= WINDOW
        assert steps == 0 or abs(ways[at + direction * steps] - ways[at]) < room
    assert steps == WINDOW


def test_time_gaps_that_are_not_asked_for_are_not_computed():
    plant, other = (BatchPlant("infinity", 2, horizon_s=8.0) for _ in range(2))
    other.compute_time_gap_of([2])
    for one in (plant, other):
        one.reset(seed=0)
        for _ in range(300):
            one.step(np.zeros(one.arrays.actions.shape))
    late, of_one = plant.info("time_gap_error_s"), other.info("time_gap_error_s")
    assert np.isfinite(late).all()
    assert (late[:, 1:] != 0.0).all()
    assert np.isnan(of_one[:, :2]).all()
    np.testing.assert_array_equal(of_one[:, 2], late[:, 2])
    np.testing.assert_array_equal(plant.observations, other.observations)
    np.testing.assert_array_equal(plant.rewards, other.rewards)
    with pytest.raises(ValueError, match=r"robots \[3\] must be at least 0 and less than 3"):
        plant.compute_time_gap_of([3])
