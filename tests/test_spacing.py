"""The distance kept from a predecessor: the law, what is heard of the predecessor, and the whole loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st

from baselines import ReferencePolicy
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.formation import Formation
from tlf_env.onboard.spacing import Predecessor, Spacing, approach_speed, spaced_twist, spacing_row
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking
from tlf_env.task.scenario import load_scenario

SPACING = Spacing()
ROW = spacing_row(SPACING)
BEHIND_MM = SPACING.outline_offset_mm
FIRST = Tracking._fields.index("predecessor_forward")
SCALES = np.array([entry.scale for entry in TRACKING_ENTRIES.values()])

places = st.floats(-800, 800)
turns = st.floats(-math.pi, math.pi)
twists = st.tuples(st.floats(-1000, 1000), st.floats(-8, 8))


def heard(forward: float, right: float, turn: float, twist: tuple[float, float]) -> Predecessor:
    return Predecessor(forward, right, math.sin(turn), math.cos(turn), *twist)


def centres(h: Predecessor) -> np.ndarray:
    """From the robot's outline centre to the predecessor's, forward and right, mm."""
    return np.array(
        [h.forward - BEHIND_MM * h.cos_turn + BEHIND_MM, h.right + BEHIND_MM * h.sin_turn]
    )


def centre_speed(u: tuple[float, float]) -> np.ndarray:
    """Of a robot's outline centre in its own frame, mm/s."""
    return np.array([u[0], BEHIND_MM * u[1]])


def approach(u: tuple[float, float], h: Predecessor) -> tuple[float, float, float]:
    """Distance of the centres (mm), own speed towards the other one and its speed away (mm/s)."""
    between = centres(h)
    distance = float(np.hypot(*between))
    turned = np.array([[h.cos_turn, h.sin_turn], [-h.sin_turn, h.cos_turn]])
    away = turned @ centre_speed((h.u_1, h.u_2))
    return distance, *(float(v @ between / distance) for v in (centre_speed(u), away))


# The law


@pytest.mark.parametrize("gain_per_s", [0.5, 2.0, 6.0])
def test_an_approach_decelerates_at_most_as_the_brakes_can(gain_per_s):
    """Towards a centre that stands: speed times slope is the deceleration; far away it is the brakes'."""
    row = spacing_row(Spacing(gain_per_s=gain_per_s, braking_mm_s2=80.0))
    room = np.geomspace(1e-3, 1e4, 400)
    step = 1e-5 * room

    def speed(at: np.ndarray) -> np.ndarray:
        return np.array([approach_speed(one, 0.0, row) for one in at.tolist()])

    slope = (speed(room + step) - speed(room - step)) / (2.0 * step)
    deceleration = speed(room) * slope
    assert slope[0] == pytest.approx(gain_per_s, rel=1e-6)
    assert (np.diff(slope) < 1e-6 * gain_per_s).all()
    assert (deceleration < 80.0 * (1.0 + 1e-5)).all()
    assert deceleration[-60:] == pytest.approx(80.0, rel=1e-5)


@untimed
@given(twists, places, places, turns, twists)
def test_the_twist_approaches_no_faster_than_allowed_and_otherwise_is_left(u, x, y, turn, other):
    h = heard(x, y, turn, other)
    if np.hypot(*centres(h)) < 1.0:
        return
    distance, own, away = approach(u, h)
    allowed = approach_speed(distance - SPACING.distance_mm, away, ROW)
    found = spaced_twist(*u, h, ROW)
    if own <= allowed - 1e-6:
        assert found == u
    else:
        assert approach(found, h)[1] == pytest.approx(min(own, allowed), rel=1e-9, abs=1e-6)


@untimed
@given(twists, places, places, turns, twists)
def test_left_and_right_are_alike(u, x, y, turn, other):
    v_1, v_2 = spaced_twist(*u, heard(x, y, turn, other), ROW)
    mirrored = heard(x, -y, -turn, (other[0], -other[1]))
    assert spaced_twist(u[0], -u[1], mirrored, ROW) == (v_1, -v_2)


@untimed
@given(st.floats(-500, 3000), st.floats(-1000, 1000), st.floats(0, 500))
def test_more_room_or_a_faster_predecessor_allow_no_less(room, leaving, more):
    speed = approach_speed(room, leaving, ROW)
    assert approach_speed(room + more, leaving, ROW) >= speed - 1e-9
    assert approach_speed(room, leaving + more, ROW) >= speed - 1e-9


@untimed
@given(st.floats(0, 3000), st.floats(0, 500))
def test_who_brakes_as_told_stops_in_time_behind_one_that_brakes(room, leaving):
    """A predecessor that brakes as hard leaves the room and its stopping distance."""
    speed = approach_speed(room, leaving, ROW)
    assert speed**2 / (2 * ROW.braking) <= room + leaving**2 / (2 * ROW.braking) + 1e-6


def test_a_robot_at_the_same_place_is_left_alone():
    h = Predecessor(0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    assert spaced_twist(100.0, 1.0, h, ROW) == (100.0, 1.0)


@pytest.mark.parametrize("field", sorted(Spacing.model_fields))
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_impossible_numbers_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        Spacing(**{field: value})


# What a robot hears


def test_what_is_heard_is_the_predecessors_estimate_as_it_stands():
    scenario = load_scenario("infinity", estimator="ekf-slip", dtype="float64", end_on=())
    formation = Formation(scenario)
    formation.reset(0)
    a, policy = formation.arrays, ReferencePolicy("tuned")
    for _ in range(200):
        a.actions[0] = policy.predict(a.observations[0])[0]
        formation.step()
        seen = a.observations[0, :, FIRST : FIRST + 6] * SCALES[FIRST : FIRST + 6]
        assert not seen[0].any()
        x, y, theta = a.rows("estimate")[:3, :, 0]
        for r in (1, 2):
            d_x, d_y = x[r - 1] - x[r], y[r - 1] - y[r]
            sin, cos = math.sin(theta[r]), math.cos(theta[r])
            turn = theta[r - 1] - theta[r]
            expected = (
                -sin * d_x + cos * d_y,
                cos * d_x + sin * d_y,
                *(np.sin(turn), np.cos(turn)),
            )
            np.testing.assert_allclose(seen[r, :4], expected, rtol=1e-9, atol=1e-9)


def test_what_is_lost_on_the_air_goes_on_by_dead_reckoning():
    """A predecessor at rest is heard where it stands, however late and whatever is lost."""
    radio = {"radio": {"dropout": 0.5, "jitter_s": 0.1}}
    plant = BatchPlant("infinity", 4, disturbance=radio, estimator="truth", end_on=())
    plant.reset(seed=0)
    there = plant.observations[:, 1:, FIRST : FIRST + 2].copy()
    for _ in range(100):
        plant.step(np.zeros((4, 3, 2)))
    assert np.abs(plant.observations[:, 1:, FIRST : FIRST + 2] - there).max() * 500.0 < 1.0


# The whole loop


def least_gap_mm(plant: str, gains: str, steps: int = 500) -> float:
    """Least distance of neighbours' axle midpoints while the second robot's leader stands still."""
    scenario = load_scenario(
        "flower", plant=plant, estimator="truth", end_on=(), robots=2, disturbance="none"
    )
    formation = Formation(scenario)
    formation.reset(0)
    a, policy, least = formation.arrays, ReferencePolicy(gains), math.inf
    for _ in range(steps):
        a.actions[0] = policy.predict(a.observations[0])[0]
        a.actions[0, 0] = 0.0
        formation.step()
        x, y = a.infos[0, :, 12], a.infos[0, :, 13]
        least = min(least, math.hypot(x[0] - x[1], y[0] - y[1]))
    return least


@pytest.mark.parametrize("plant", ["kinematic", "pymunk"])
def test_behind_a_robot_that_does_not_move_the_distance_is_kept(plant):
    assert least_gap_mm(plant, "tuned") > SPACING.distance_mm - 5.0
    assert least_gap_mm(plant, "consistent") < 225.0


def test_one_gap_behind_on_the_slowest_preset_nothing_is_held_back():
    """300 mm apart at 60 mm/s, as the flower starts."""
    h = Predecessor(300.0, 0.0, 0.0, 1.0, 60.0, 0.0)
    assert spaced_twist(60.0, 0.1, h, ROW) == (60.0, 0.1)


@pytest.mark.parametrize("task", ["infinity", "flower"])
def test_nobody_is_touched_from_scattered_starts(task):
    plant = BatchPlant(
        task, 40, disturbance="start", estimator="ekf-slip", horizon_s=16.0, end_on=()
    )
    plant.reset(seed=10000)
    policy, (lanes, robots, _) = ReferencePolicy("tuned"), plant.arrays.actions.shape
    for _ in range(800):
        actions, _ = policy.predict(plant.observations.reshape(lanes * robots, -1))
        plant.step(actions.reshape(lanes, robots, 2))
    assert not plant.touched.any()
