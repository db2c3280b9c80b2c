"""Circles, stop-and-go, waypoints, and the warnings about what a reference asks of a robot."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from tlf_env.common.errors import one_line
from tlf_env.common.presets import preset_names
from tlf_env.physics.openloop import OpenLoopInput, OpenLoopScenario, run_open_loop
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.feasibility import grip_acceleration, motor_acceleration, start_note, warnings_for
from tlf_env.task.scenario import Scenario, load_scenario, scenario_warnings
from tlf_env.task.trajectories import (
    Circle,
    Lissajous,
    Rose,
    StopAndGo,
    Trajectory,
    Waypoints,
    sample,
)
from tlf_env.task.waypoints import drive_through, read_points, scenario_of_waypoints

ROBOT = RobotParameters()
SLALOM = Path(__file__).parent.parent / "examples" / "paths" / "slalom.csv"
TRAJECTORY: TypeAdapter[Trajectory] = TypeAdapter(Trajectory)

INFINITY = Lissajous(
    amplitude_x_mm=2000, amplitude_y_mm=2000, rate_x_rad_s=0.125, rate_y_rad_s=0.25
)
LISSAJOUS = Lissajous(
    amplitude_x_mm=900,
    amplitude_y_mm=1500,
    rate_x_rad_s=0.3,
    rate_y_rad_s=0.2,
    phase_x_rad=0.4,
    phase_y_rad=-1.0,
    centre_x_mm=50,
)
FLOWER = Rose(amplitude_x_mm=2500, amplitude_y_mm=2000, period_s=120, centre_x_mm=5000)
ODD_ROSE = Rose(amplitude_x_mm=1000, amplitude_y_mm=1200, petals_k=0.7, period_s=40)
CIRCLE = Circle(radius_mm=800, speed_mm_s=200, centre_x_mm=100, centre_y_mm=-50, phase_rad=0.3)
CLOCKWISE = Circle(radius_mm=500, period_s=20, direction="clockwise")
POINTS = [(3, 0, 0), (4, 150, 20), (5.5, 300, 150), (6, 330, 250), (8, 200, 400), (9, 20, 420)]
CURVE = Waypoints(points=POINTS)
PAUSE = Waypoints(
    points=[(0, 0, 0), (2, 0, 0), (4, 200, 0), (5, 400, 80), (7, 400, 80), (9, 250, 200)]
)
STOP_AND_GO = StopAndGo(path=CIRCLE, drive_s=7, stop_s=3, ramp_s=1.5)
STOPS_ON_ROSE = StopAndGo(path=FLOWER, drive_s=5, stop_s=2, ramp_s=2.5)
STOPS_ON_POINTS = StopAndGo(path=CURVE, drive_s=4, stop_s=1, ramp_s=1)

ALL = {
    "infinity": INFINITY,
    "lissajous": LISSAJOUS,
    "flower": FLOWER,
    "odd rose": ODD_ROSE,
    "circle": CIRCLE,
    "clockwise": CLOCKWISE,
    "waypoints": CURVE,
    "pause": PAUSE,
    "stop and go": STOP_AND_GO,
    "stops on a rose": STOPS_ON_ROSE,
    "stops on waypoints": STOPS_ON_POINTS,
}
every = pytest.mark.parametrize("trajectory", ALL.values(), ids=ALL.keys())


def message(build, *args, **kwargs) -> str:
    with pytest.raises(ValueError, match=r"\S") as caught:
        build(*args, **kwargs)
    error = caught.value
    text = one_line(error, Trajectory) if isinstance(error, ValidationError) else str(error)
    assert "\n" not in text
    return text


class TestEveryTrajectory:
    @every
    def test_derivatives_are_those_of_the_position(self, trajectory):
        t, h = np.linspace(0.1, 30, 997), 1e-4
        before, here, after = (trajectory.derivatives(t + step) for step in (-h, 0, h))
        kinks = np.abs(after[2] - before[2]).max(axis=0) > 0.5  # where waypoints begin and end
        assert kinks.sum() <= 6
        for order in (0, 1):
            slope = (after[order] - before[order]) / (2 * h)
            assert slope[:, ~kinks] == pytest.approx(here[order + 1][:, ~kinks], abs=2e-2)

    @every
    def test_twist_is_that_of_the_pose(self, trajectory):
        t = np.linspace(0, 30, 3001)
        theta, u_1, u_2 = sample(trajectory, t)[:, 2:].T
        velocity = trajectory.derivatives(t)[1]
        moving = u_1 > 20
        tolerance = 0.05 if trajectory is PAUSE else 1e-6  # within 1 mm of a rest it is held
        ahead = u_1 * np.stack([-np.sin(theta), np.cos(theta)])
        assert ahead[:, moving] == pytest.approx(velocity[:, moving], abs=tolerance)
        assert (u_1 >= 0).all()
        smooth = moving[2:] & moving[1:-1] & moving[:-2]
        rate = (theta[2:] - theta[:-2]) / (t[2:] - t[:-2])
        assert rate[smooth] == pytest.approx(u_2[1:-1][smooth], abs=0.02)

    @every
    def test_heading_does_not_jump(self, trajectory):
        theta = sample(trajectory, np.arange(0, 60, 0.0037))[:, 2]
        limit = 2.6 if trajectory is PAUSE else 0.05  # PAUSE leaves its stop in another direction
        jumps = np.abs(np.diff(theta))
        assert jumps.max() < limit
        assert (jumps > 0.05).sum() <= (trajectory is PAUSE)

    @every
    def test_one_time_gives_what_many_give(self, trajectory):
        t = np.linspace(-3, 40, 87)
        together = sample(trajectory, t)
        alone = np.concatenate([sample(trajectory, t[k : k + 1]) for k in range(len(t))])
        together[:, 2] = np.angle(np.exp(1j * (together[:, 2] - alone[:, 2])))
        alone[:, 2] = 0
        assert together == pytest.approx(alone, abs=1e-9)

    @every
    def test_json_round_trip(self, trajectory):
        again = TRAJECTORY.validate_json(trajectory.model_dump_json())
        assert again == trajectory
        t = np.linspace(0, 20, 50)
        assert (sample(again, t) == sample(trajectory, t)).all()

    def test_velocity_that_turns_back_on_the_spot(self):
        line = Lissajous(amplitude_x_mm=100, amplitude_y_mm=100, rate_x_rad_s=1, rate_y_rad_s=1)
        t = np.array([0.0, np.pi / 2 - 1e-3, np.pi / 2, np.pi / 2 + 1e-3])
        theta, u_2 = sample(line, t)[:, 2], sample(line, t)[:, 4]
        assert theta[:3] == pytest.approx(-np.pi / 4)
        assert abs(theta[3] - theta[2]) == pytest.approx(np.pi)
        assert np.isfinite(u_2).all()

    def test_start_in_a_cusp_takes_the_first_heading(self):
        line = Lissajous(
            amplitude_x_mm=100,
            amplitude_y_mm=100,
            rate_x_rad_s=1,
            rate_y_rad_s=1,
            phase_x_rad=np.pi / 2,
            phase_y_rad=np.pi / 2,
        )
        theta = sample(line, np.array([0.0, 0.01, 0.02]))[:, 2]
        assert theta == pytest.approx(theta[1])


class TestHarmonics:
    @given(k=st.floats(0.05, 9), s=st.floats(0, 20))
    def test_rose_is_eq_53_for_every_k(self, k, s):
        rose = Rose(amplitude_x_mm=2500, amplitude_y_mm=2000, petals_k=k, period_s=120)
        x, y = rose.derivatives(np.array([s * 120 / (2 * np.pi)]))[0, :, 0]
        assert x == pytest.approx(2500 * np.cos(k * s) * np.sin(s), abs=1e-8)
        assert y == pytest.approx(-2000 * np.cos(k * s) * np.cos(s), abs=1e-8)

    def test_infinity_is_eq_52(self):
        t = np.linspace(0, 100, 501)
        x, y = INFINITY.derivatives(t)[0]
        assert x == pytest.approx(2000 * np.sin(t / 8), abs=1e-8)
        assert y == pytest.approx(2000 * np.sin(t / 4), abs=1e-8)

    def test_top_speeds_of_the_presets(self):
        for name, speed in (("infinity", 559.0), ("flower", 243.5)):
            s = load_scenario(name)
            u_1 = sample(s.trajectory, np.arange(0, s.horizon_s, 0.01))[:, 3]
            assert u_1.max() == pytest.approx(speed, abs=0.1)


class TestCircle:
    def test_stays_on_the_radius_at_constant_speed(self):
        r = sample(CIRCLE, np.linspace(0, 60, 400))
        assert np.hypot(r[:, 0] - 100, r[:, 1] + 50) == pytest.approx(800)
        assert r[:, 3] == pytest.approx(200)
        assert r[:, 4] == pytest.approx(0.25)

    def test_arc_length_of_a_period(self):
        r = sample(CLOCKWISE, np.linspace(0, 20, 20001))
        assert np.hypot(*np.diff(r[:, :2], axis=0).T).sum() == pytest.approx(np.pi * 1000, rel=1e-6)
        assert r[-1, 2] - r[0, 2] == pytest.approx(-2 * np.pi)

    def test_starts_at_its_phase_facing_along(self):
        assert sample(Circle(radius_mm=10, period_s=1), np.array([0.0]))[0, :3] == pytest.approx(
            [10, 0, 0]
        )

    def test_period_and_speed_are_two_ways_to_say_it(self):
        by_period = Circle(radius_mm=500, period_s=20)
        by_speed = Circle(radius_mm=500, speed_mm_s=np.pi * 50)
        t = np.linspace(0, 30, 100)
        assert sample(by_period, t) == pytest.approx(sample(by_speed, t), abs=1e-9)

    @pytest.mark.parametrize("both", [{}, {"period_s": 3, "speed_mm_s": 4}])
    def test_needs_exactly_one_of_them(self, both):
        assert "either period_s or speed_mm_s" in message(Circle, radius_mm=10, **both)


class TestStopAndGo:
    def test_lies_on_the_path(self):
        t = np.linspace(0, 100, 5001)
        x, y = STOP_AND_GO.derivatives(t)[0]
        assert np.hypot(x - 100, y + 50) == pytest.approx(800)

    def test_stands_exactly(self):
        t = np.concatenate([np.linspace(10 * k + 7, 10 * k + 9.999, 50) for k in range(5)])
        position, velocity, acceleration = STOP_AND_GO.derivatives(t)
        assert (velocity == 0).all()
        assert np.abs(acceleration).max() < 1e-9
        stops = position.reshape(2, 5, 50)
        assert (stops == stops[:, :, :1]).all()
        r = sample(STOP_AND_GO, t)
        assert (r[:, 3:] == 0).all()
        assert np.ptp(r[:, 2].reshape(5, 50), axis=1) == pytest.approx(0, abs=1e-12)

    def test_a_cycle_covers_the_drive_less_a_ramp(self):
        q, rate, slope = STOP_AND_GO.warp(np.array([0, 3.5, 10.0, 30.0]))
        assert q == pytest.approx([0, 3.5 - 0.75, 5.5, 16.5])
        assert rate == pytest.approx([0, 1, 0, 0])
        assert slope == pytest.approx([0, 0, 0, 0], abs=1e-12)

    def test_acceleration_is_continuous(self):
        t = np.arange(0, 40, 1e-4)
        for trajectory in (STOP_AND_GO, STOPS_ON_ROSE):
            steps = np.abs(np.diff(trajectory.derivatives(t)[2], axis=1))
            assert steps.max() < 0.12  # mm/s² in 0.1 ms

    def test_never_faster_than_the_path(self):
        assert sample(STOP_AND_GO, np.arange(0, 40, 0.01))[:, 3].max() == pytest.approx(200)

    def test_heading_is_the_path_s(self):
        t = np.arange(0, 40, 0.013)
        q, rate, _ = STOPS_ON_ROSE.warp(t)
        on_path, stopping = sample(FLOWER, q), sample(STOPS_ON_ROSE, t)
        assert (stopping[:, :3] == on_path[:, :3]).all()
        assert stopping[:, 4] == pytest.approx(on_path[:, 4] * rate, abs=1e-12)

    def test_ramps_must_fit(self):
        text = message(StopAndGo, path=CIRCLE, drive_s=3, stop_s=1, ramp_s=2)
        assert "ramp_s 2.0 must be at most half of drive_s 3.0" in text


class TestWaypoints:
    @pytest.mark.parametrize("trajectory", [CURVE, PAUSE], ids=["curve", "pause"])
    def test_passes_through_its_points(self, trajectory):
        t, x, y = np.array(trajectory.points).T
        assert t[0] == 0
        assert trajectory.derivatives(t)[0] == pytest.approx(np.stack([x, y]), abs=1e-9)

    def test_velocity_is_continuous_and_acceleration_within_a_stretch(self):
        t = np.arange(0, CURVE.end_s, 1e-4)
        _, velocity, acceleration = CURVE.derivatives(t)
        assert np.abs(np.diff(velocity)).max() < 0.2
        assert np.abs(np.diff(acceleration)).max() < 0.2

    def test_points_of_a_circle_give_the_circle(self):
        t = np.arange(0, 30.5, 0.5)
        x, y = CIRCLE.derivatives(t)[0]
        drawn = Waypoints(points=np.stack([t, x, y], axis=1).tolist())
        fine = np.linspace(0, 30, 3001)
        error = np.abs(sample(drawn, fine) - sample(CIRCLE, fine)).max(axis=0)
        assert (error < [0.01, 0.01, 5e-4, 0.02, 5e-3]).all()

    def test_two_points_are_a_straight_line(self):
        r = sample(Waypoints(points=[(0, 0, 0), (10, 300, 400)]), np.linspace(0, 10, 11))
        assert r[:, 0] == pytest.approx(np.linspace(0, 300, 11))
        assert r[:, 3] == pytest.approx(50)

    def test_rests_before_and_after(self):
        r = sample(CURVE, np.array([-2.0, -1e-9, CURVE.end_s + 1e-9, 99.0]))
        assert r[:2, :2] == pytest.approx(np.zeros((2, 2)))
        assert r[2:, :2] == pytest.approx(np.array([[20, 420]] * 2))
        assert (r[:, 3:] == 0).all()
        inside = sample(CURVE, np.array([0.0, CURVE.end_s]))[:, 2]
        assert r[[0, 3], 2] == pytest.approx(inside)

    def test_stands_at_a_repeated_point(self):
        r = sample(PAUSE, np.linspace(5, 7, 101))
        assert r[:, :2] == pytest.approx(np.array([[400, 80]] * 101), abs=1e-9)
        assert r[:, 3:] == pytest.approx(np.zeros((101, 2)), abs=1e-9)
        assert np.ptp(r[:, 2]) == 0
        start = sample(PAUSE, np.linspace(0, 2, 50))
        assert np.ptp(start[:, 2]) == 0
        assert start[0, 2] == pytest.approx(sample(PAUSE, np.array([2.15]))[0, 2], abs=0.1)

    @pytest.mark.parametrize("power", [2, 3, 4])
    def test_a_recorded_start_from_rest_faces_where_it_goes(self, power):
        t = np.linspace(0, 4, 21)
        s = np.round(600 * (t / 4) ** power, 1)
        r = sample(Waypoints(points=np.stack([t, s, s], axis=1).tolist()), np.linspace(0, 4, 401))
        assert r[:, 2] == pytest.approx(-np.pi / 4, abs=1e-6)
        assert r[0, 3] < 1

    def test_a_recorded_stop_does_not_turn_the_heading(self):
        t = np.linspace(0, 4, 21)
        s = np.round(600 * (1 - (1 - t / 4) ** 2), 1)
        theta = sample(
            Waypoints(points=np.stack([t, s, -s], axis=1).tolist()), np.linspace(0, 6, 601)
        )[:, 2]
        assert theta == pytest.approx(-3 * np.pi / 4, abs=1e-6)

    @given(
        st.lists(
            st.tuples(
                st.floats(0.5, 3),
                st.sampled_from([-300.0, -1.0, 0.0, 0.3, 200.0]),
                st.sampled_from([-250.0, 0.0, 0.0, 1e-9, 300.0]),
            ),
            min_size=2,
            max_size=8,
        )
    )
    def test_is_always_finite(self, steps):
        points = np.cumsum(np.array([(0, 0, 0), *steps]), axis=0)
        if np.ptp(points[:, 1:]) == 0:
            return
        w = Waypoints(points=points.tolist())
        t = np.unique(np.concatenate([np.linspace(-1, w.end_s + 1, 200), [p[0] for p in w.points]]))
        r = sample(w, t)
        assert np.isfinite(r).all()
        through = w.derivatives(np.array(w.points)[:, 0])[0].T
        assert through == pytest.approx(points[:, 1:], abs=1e-6)

    def test_file_is_read_once(self, tmp_path):
        path = tmp_path / "path.csv"
        path.write_text("t_s,x_mm,y_mm\n10,1,2\n11.5,3,4.5\n", encoding="utf-8")
        model = Waypoints(file=str(path))
        path.unlink()
        assert model.points == ((0, 1, 2), (1.5, 3, 4.5))
        assert json.loads(model.model_dump_json())["file"] is None
        assert TRAJECTORY.validate_json(model.model_dump_json()) == model

    def test_file_name_starts_from_the_context_s_folder(self, tmp_path):
        (tmp_path / "a.csv").write_text("t_s,x_mm,y_mm\n0,1,2\n1,3,4\n", encoding="utf-8")
        data = {"type": "waypoints", "file": "a.csv"}
        model = TRAJECTORY.validate_python(data, context={"folder": tmp_path})
        assert len(model.points) == 2

    def test_spreadsheets_files(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_bytes(b'\xef\xbb\xbf"t_s","x_mm","y_mm"\r\n0, 1 ,2\r\n\r\n1,3,4e1\r\n,,\r\n')
        assert read_points(path) == ((0, 1, 2), (1, 3, 40))

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("", "line 1: the header must be t_s,x_mm,y_mm, got an empty file"),
            ("t,x,y\n0,0,0\n1,1,1\n", "line 1: the header must be t_s,x_mm,y_mm, got 't,x,y'"),
            ("t_s;x_mm;y_mm\n0;0;0\n", "got 't_s;x_mm;y_mm'"),
            ("0,0,0\n1,1,1\n", "header must be"),
            ("t_s,x_mm,y_mm\n", "must have 2 to 100000 waypoints, got 0"),
            ("t_s,x_mm,y_mm\n0,0,0\n", "must have 2 to 100000 waypoints, got 1"),
            ("t_s,x_mm,y_mm\n0,0,0\n1,5\n", "line 3: must be 3 numbers, t_s,x_mm,y_mm, got 2"),
            ("t_s,x_mm,y_mm\n0,0,0\n\n1,a b,0\n", "line 4: x_mm must be a number within"),
            ("t_s,x_mm,y_mm\n0,0,0\n1,nan,0\n", "line 3: x_mm must be a number"),
            ("t_s,x_mm,y_mm\n0,0,0\n1,1,inf\n", "line 3: y_mm must be a number"),
            ("t_s,x_mm,y_mm\n0,0,0\n1,,1\n", "got ''"),
            ("t_s,x_mm,y_mm\n0,0,0\n0,5,0\n", "line 3: t_s 0 must be above 0"),
            (
                "t_s,x_mm,y_mm\n2,0,0\n1.5,5,0\n",
                "line 3: t_s 1.5 must be above 2, the previous time",
            ),
            ("t_s,x_mm,y_mm\n0,0,0\n1,800,900\n", "is 1204.16 mm/s; at most 1000 is allowed"),
            ("t_s,x_mm,y_mm\n0,7,7\n1,7,7\n", "all waypoints are at the same position"),
        ],
    )
    def test_a_bad_file_is_reported_in_one_line(self, tmp_path, text, said):
        path = tmp_path / "bad.csv"
        path.write_text(text, encoding="utf-8")
        assert said in message(read_points, path)
        assert "bad.csv" in message(Waypoints, file=str(path))

    def test_a_missing_or_binary_file(self, tmp_path):
        assert "no.csv: No such file" in message(read_points, tmp_path / "no.csv")
        assert "Is a directory" in message(read_points, tmp_path)
        path = tmp_path / "binary.csv"
        path.write_bytes(b"t_s,x_mm,y_mm\n0,\xff\xfe,0\n")
        assert "binary.csv is not UTF-8 text" in message(read_points, path)

    @pytest.mark.parametrize(
        ("data", "said"),
        [
            ({}, "either points or file"),
            ({"points": [(0, 0, 0), (1, 1, 1)], "file": "a.csv"}, "either points or file"),
            ({"points": "0,0,0"}, "points must be a list"),
            ({"points": [(0, 0, 0), 5]}, "points[1]: must be 3 numbers"),
            ({"points": [(0, 0, 0), (1, None, 5)]}, "points[1]: x_mm must be a number"),
            ({"points": [(0, 0, 0), (1, True, 5)]}, "points[1]: x_mm must be a number"),
            ({"points": [(0, 0, 0), (1, 2e10, 5)]}, "within ±1e+10, got 20000000000.0"),
            (
                {"points": [(0, 0, 0), (2e9, 5, 5)]},
                "points[1]: t_s 2000000000 must be at most 1e+09",
            ),
            ({"points": [(0, 0, 0), (0, 1, 5)]}, "points[1]: t_s 0 must be above 0"),
            ({"file": 5}, "file must be a path, got 5"),
            ({"points": [(0, 0, 0), (1, 1, 1)], "speed": 3}, "unknown key"),
        ],
    )
    def test_bad_points_are_told_in_one_line(self, data, said):
        assert said in message(TRAJECTORY.validate_python, {"type": "waypoints", **data})

    def test_without_scipy(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "scipy.interpolate", None)
        drive_through.cache_clear()
        assert "need SciPy" in message(Waypoints, points=[(0, 0, 0), (1, 5, 5)])


class TestScenarioOfWaypoints:
    def test_is_a_scenario_of_three_robots(self):
        s = Scenario.model_validate(scenario_of_waypoints(SLALOM))
        assert (s.name, s.robots, s.horizon_s) == ("slalom", 3, 60.0)
        assert s.trajectory.points[-1][0] == 60
        assert Scenario.model_validate_json(s.model_dump_json()) == s

    @given(end_s=st.floats(0.001, 5000))
    def test_horizon_is_rounded_up(self, end_s, tmp_path_factory):
        path = tmp_path_factory.mktemp("paths") / "p.csv"
        path.write_text(f"t_s,x_mm,y_mm\n0,0,0\n{end_s!r},0.5,0\n", encoding="utf-8")
        horizon_s = scenario_of_waypoints(path)["horizon_s"]
        assert end_s - 1e-7 <= horizon_s < end_s + 0.02
        assert horizon_s == pytest.approx(round(horizon_s / 0.02) * 0.02, abs=1e-9)

    def test_the_slalom_is_within_the_limits(self):
        data = scenario_of_waypoints(SLALOM)
        slalom = Waypoints(**data["trajectory"])
        assert warnings_for(slalom, ROBOT, data["horizon_s"], robots=3) == []
        assert start_note(slalom, ROBOT) is None


class TestLimits:
    def test_motor_acceleration_is_the_plant_s(self):
        push = OpenLoopInput(torque_l_Nmm=15, torque_r_Nmm=15)
        rows = run_open_loop(OpenLoopScenario(duration_s=2, inputs=(push,)))
        speed = np.array(rows)[:, 5]
        assert (speed[-1] - speed[-11]) / 1.0 == pytest.approx(motor_acceleration(ROBOT), rel=1e-3)

    def test_motor_acceleration_without_joint_friction(self):
        free = ROBOT.model_copy(update={"joint_friction": False})
        mass = 1.245 + 2 * 52.91 / 50**2 + 4 / 20**2
        assert motor_acceleration(free) == pytest.approx(600 / mass)

    def test_grip_is_the_drive_wheels(self):
        assert grip_acceleration(ROBOT) == pytest.approx((572.7, 431.5), abs=0.05)


def said(trajectory, horizon_s=50.0, **options) -> str:
    lines = warnings_for(trajectory, ROBOT, horizon_s, **options)
    assert all("\n" not in line and line.startswith("t = ") for line in lines)
    return "\n".join(lines)


class TestWarnings:
    @pytest.mark.parametrize("name", ["infinity", "flower", "circle"])
    def test_none_for_the_presets(self, name):
        s = load_scenario(name)
        lines = warnings_for(
            s.trajectory, ROBOT, s.horizon_s, robots=s.robots, time_gap_s=s.time_gap_s
        )
        assert lines == []

    def test_only_the_stops_for_stop_and_go(self):
        s = load_scenario("stop_and_go")
        (line,) = said(s.trajectory, s.horizon_s, robots=3).splitlines()
        assert "assumption 2" in line
        assert "t = 11.9" in line
        assert "until t = 13.5" in line
        assert "7 times" in line

    def test_resting_at_the_end_is_no_stop(self):
        gentle = Waypoints(points=[(0, 0, 0), (10, 1000, 0), (20, 2000, 0), (21, 2000, 0)])
        assert "at rest" not in said(gentle, 40.0)

    def test_speed(self):
        text = said(Circle(radius_mm=9000, speed_mm_s=1100))
        assert "speed 1100 mm/s is above 1000 mm/s" in text

    def test_yaw_rate(self):
        assert "yaw rate 10.0 rad/s is above 8 rad/s" in said(Circle(radius_mm=20, speed_mm_s=200))

    def test_sideways_grip(self):
        assert said(Circle(radius_mm=1000, speed_mm_s=650)) == ""
        above_dynamic = said(Circle(radius_mm=1000, speed_mm_s=700))
        assert "acceleration 490 mm/s² (490 of it sideways) is above 432 mm/s²" in above_dynamic
        above_static = said(Circle(radius_mm=1000, speed_mm_s=800))
        assert "acceleration 640 mm/s²" in above_static
        assert "above 573 mm/s², the static grip limit of the drive wheels" in above_static

    @pytest.mark.parametrize(("share", "warned"), [(0.95, False), (1.05, True)])
    def test_motors_on_a_straight(self, share, warned):
        t = np.linspace(0, 3, 31)
        y = share * motor_acceleration(ROBOT) / 2 * t**2
        points = np.stack([t, 0 * t, y], axis=1).tolist()
        assert ("N·mm of a motor, above 15" in said(Waypoints(points=points), 3.0)) is warned

    def test_motors_in_a_turn_that_changes(self):
        weave = Lissajous(
            amplitude_x_mm=9000, amplitude_y_mm=60, rate_x_rad_s=0.05, rate_y_rad_s=1.5
        )
        assert "N·mm of a motor" in said(weave)

    def test_a_reference_that_stops_dead(self):
        text = said(Waypoints(points=[(0, 0, 0), (10, 0, 4000)]), 15.0)
        assert "t = 9.9" in text or "t = 10.0" in text
        assert "changing speed by -" in text

    def test_turning_on_the_spot(self):
        back = Waypoints(
            points=[(0, 0, 0), (10, 1000, 0), (12, 1000, 0), (22, 0, 100), (23, 0, 100)]
        )
        text = said(back, 23.0)
        assert "at (1000, 0) mm: the heading turns by" in text
        assert "on the spot" in text
        line = Lissajous(amplitude_x_mm=500, amplitude_y_mm=500, rate_x_rad_s=0.3, rate_y_rad_s=0.3)
        assert "turns by 3.14 rad on the spot" in said(line)

    def test_robots_that_meet_at_the_crossing(self):
        s = load_scenario("infinity")
        assert said(s.trajectory, 100.0, robots=5) == ""
        text = said(s.trajectory, 100.0, robots=6)
        assert "t = 25.1" in text
        assert "(250" in text
        assert "robot_0 and robot_5 are" in text
        assert "below 220 mm" in text

    @pytest.mark.parametrize("name", preset_names())
    def test_shipped_rows_do_not_meet(self, name):
        assert not any("apart, below" in line for line in scenario_warnings(load_scenario(name)))

    @pytest.mark.parametrize(
        ("name", "most", "behind"), [("infinity", 5, 5), ("flower", 6, 6), ("long_circle", 23, 23)]
    )
    def test_one_robot_too_many_meets_another(self, name, most, behind):
        """Half a period of the ∞, 25.1 s, three quarters of a loop of the flower, a whole long circle."""
        assert not scenario_warnings(load_scenario(name, robots=most))
        (line,) = scenario_warnings(load_scenario(name, robots=most + 1))
        assert f"robot_0 and robot_{behind} are" in line

    def test_robots_closer_than_their_outlines(self):
        slow = Circle(radius_mm=1000, speed_mm_s=40)
        assert "robot_0 and robot_1 are" in said(slow, robots=2)
        assert said(slow, robots=2, time_gap_s=8.0) == ""

    def test_robots_that_still_wait_in_line(self):
        # A small circle comes back to its start before the line behind it has left.
        loop = Circle(radius_mm=400, speed_mm_s=200, direction="clockwise")
        assert "robot_0 and robot_3" in said(loop, 12.0, robots=4)

    def test_followers_run_into_a_leader_that_stops_for_a_gap(self):
        stops = StopAndGo(path=CIRCLE, drive_s=8, stop_s=5, ramp_s=2)
        assert "robot_0 and robot_1 are 0 mm apart" in said(stops, robots=2)

    def test_a_horizon_shorter_than_a_sample(self):
        assert said(INFINITY, 0.005, robots=3) == ""


class TestStart:
    def test_the_paper_s_start_at_speed_is_a_note(self):
        note = start_note(load_scenario("infinity").trajectory, ROBOT)
        assert "starts at 559 mm/s" in note
        assert "498 mm behind" in note

    def test_none_from_rest(self):
        assert start_note(STOP_AND_GO, ROBOT) is None


def test_every_example_of_the_page_loads():
    page = (SLALOM.parents[2] / "docs" / "trajectories.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)
    kinds = set()
    for block in blocks:
        data = yaml.safe_load(block)["trajectory"]
        kinds.add(TRAJECTORY.validate_python(data, context={"folder": SLALOM.parent}).type)
    assert kinds == {"lissajous", "rose", "circle", "stop_and_go", "waypoints"}
