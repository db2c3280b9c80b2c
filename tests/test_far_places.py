"""Paths far from the origin, as the UTM grid has them, give the same errors as at the origin."""

from __future__ import annotations

import numpy as np
import pytest

import tlf_env
from baselines.policies.reference import ReferencePolicy
from baselines.runs.run import Record, run_policy
from tlf_env.task.scenario import load_scenario, scenario_warnings

PLACES_MM = ((3.3e8, 4.6e9), (8.3e8, 9.99e9), (-9.9e9, -9.9e9))
CIRCLE = {"type": "circle", "radius_mm": 1000.0, "speed_mm_s": 150.0}


def run_at(place_mm: tuple[float, float], trajectory: dict, **fields) -> Record:
    centre = dict(zip(("centre_x_mm", "centre_y_mm"), place_mm, strict=True))
    moved = {**trajectory, **centre}
    if "path" in trajectory:
        moved = {**trajectory, "path": {**trajectory["path"], **centre}}
    scenario = load_scenario({"trajectory": moved, "robots": 3, "horizon_s": 20.0, **fields})
    return run_policy(scenario, ReferencePolicy("consistent", preview_s=scenario.preview_s), 0)


@pytest.mark.parametrize("place_mm", PLACES_MM)
@pytest.mark.parametrize("plant", ["pymunk", "batch", "kinematic"])
@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip", "ekf-gyro", "truth"])
def test_errors_do_not_depend_on_the_place(place_mm, plant, estimator):
    fields = {"plant": plant, "estimator": estimator}
    if (
        estimator == "ekf-slip"
    ):  # on smoothed broadcasts a tyre breaks away, which a last bit decides
        fields["broadcast_smoothing_s"] = 0.0
    here, there = (run_at(place, CIRCLE, **fields) for place in ((0.0, 0.0), place_mm))
    for name, within in (
        ("position_error_mm", 0.02),
        ("formation_error_mm", 0.02),
        ("slip_mm_s", 0.02),
        ("torque_l_Nmm", 0.1),
        ("heading_error_rad", 1e-3),
    ):
        assert there.columns[name] == pytest.approx(here.columns[name], abs=within), name


@pytest.mark.parametrize("place_mm", PLACES_MM)
def test_robots_touch_there_as_they_do_here(place_mm):
    stops = {"type": "stop_and_go", "path": CIRCLE, "drive_s": 6.0, "stop_s": 8.0}
    here, there = (run_at(place, stops, time_gap_s=3.0) for place in ((0.0, 0.0), place_mm))
    assert here.contact
    assert there.touched_at_s == pytest.approx(here.touched_at_s, abs=0.02)


@pytest.mark.parametrize("place_mm", PLACES_MM)
def test_waypoints_there_are_the_same_curve_and_give_the_same_warnings(place_mm):
    points = [(0, 0, 0), (2, 400, 30), (3, 700, 300), (5, 700, 300), (8, 200, 900)]
    moved = [(t, x + place_mm[0], y + place_mm[1]) for t, x, y in points]
    t_s = np.linspace(0, 9, 500)
    scenarios = [
        load_scenario({"trajectory": {"type": "waypoints", "points": one}, "horizon_s": 10.0})
        for one in (points, moved)
    ]
    here, there = (one.trajectory.derivatives(t_s) for one in scenarios)
    assert there[1:] == pytest.approx(here[1:], abs=1e-4)
    assert there[0] - np.array(place_mm)[:, None] == pytest.approx(here[0], abs=1e-5)
    kinds = [[line.split(":")[1][:30] for line in scenario_warnings(one)] for one in scenarios]
    assert len(kinds[0]) == len(kinds[1]) > 0


@pytest.mark.parametrize("place_mm", PLACES_MM)
def test_start_poses_may_be_there(place_mm):
    centre = dict(zip(("centre_x_mm", "centre_y_mm"), place_mm, strict=True))
    env = tlf_env.parallel_env("infinity", trajectory={**CIRCLE, **centre})
    poses = [(place_mm[0] - 300.0 * i, place_mm[1], 0.0) for i in range(3)]
    env.reset(seed=0, options={"poses": poses})
    infos = env.step({agent: np.zeros(2) for agent in env.agents})[-1]
    assert [infos[f"robot_{i}"]["x_mm"] for i in range(3)] == pytest.approx(
        [pose[0] for pose in poses], abs=1.0
    )
