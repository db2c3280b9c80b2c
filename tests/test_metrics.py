"""Metrics on made-up columns with known answers."""

import json
import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from baselines.policies.reference import ReferencePolicy
from baselines.runs.run import run_policy
from baselines.tables import metrics_table
from tlf_env.task.metrics import (
    RobotMetrics,
    StringMetrics,
    deviation_mm,
    nearest_mm,
    rms,
    robot_metrics,
    score,
    settling_time_s,
    string_metrics,
    track_errors,
)
from tlf_env.task.scenario import load_scenario

DOCS = Path(__file__).parent.parent / "docs" / "metrics.md"
PERIOD_S = 0.02
NAMES = (
    "x_mm",
    "y_mm",
    "reference_x_mm",
    "reference_y_mm",
    "reference_theta_rad",
    "position_error_mm",
    "formation_error_mm",
    "heading_error_rad",
    "time_gap_error_s",
    "J_mm_s",
    "J_theta_rad_s",
    "torque_rms_Nmm",
    "energy_mJ",
    "saturation_fraction",
    "slip_mm_s",
    "slid_mm",
)


def scenario(horizon_s=100.0, robots=3, time_gap_s=5.0):
    return load_scenario(
        "infinity", horizon_s=horizon_s, robots=robots, time_gap_s=time_gap_s, preview_s=()
    )


def times(of):
    return np.arange(of.horizon_steps + 1) * PERIOD_S


def metrics(of, lost_at_s=None, touched_at_s=None, touched_by=None, **columns):
    """Metrics of a run whose columns are zero but for those given, ``(time,)`` or ``(time, robot)``."""
    t_s, n = times(of), of.robot_count
    rows = {name: np.zeros((len(t_s), n)) for name in NAMES}
    rows["x_mm"] += 1000.0 * np.arange(n)  # apart
    for name, values in columns.items():
        values = np.asarray(values, dtype=float)
        rows[name] = rows[name] * 0 + (values[:, None] if values.ndim == 1 else values)
    never = np.full(n, math.inf)
    return robot_metrics(
        of,
        t_s,
        rows,
        never if lost_at_s is None else np.array(lost_at_s),
        never if touched_at_s is None else np.array(touched_at_s),
        touched_by,
    )


def from_to(of, start_s, end_s, value, otherwise=0.0):
    t_s = times(of)
    return np.where((t_s >= start_s - 1e-9) & (t_s < end_s - 1e-9), value, otherwise)


def test_rms_is_the_root_of_the_mean_square_and_none_of_nothing():
    assert rms(np.array([3.0, -4.0])) == pytest.approx(math.sqrt(12.5))
    assert rms(np.array([])) is None


def test_position_errors_count_from_the_settling_time_on():
    of = scenario()
    error = from_to(of, 0, 40, 400.0, 6.0)
    error[-1] = 50.0
    for found in metrics(of, position_error_mm=error):
        count = np.sum(times(of) >= 40)
        assert found.position_rmse_mm == pytest.approx(
            math.sqrt((36.0 * (count - 1) + 2500) / count)
        )
        assert found.position_max_mm == 50.0


def test_formation_error_counts_once_a_robots_own_gap_and_5_s_have_passed():
    of = scenario()
    for i, found in enumerate(metrics(of, formation_error_mm=times(of))):
        counted = times(of)[times(of) >= 5 * i + 5]
        assert found.formation_rmse_mm == pytest.approx(np.sqrt((counted**2).mean()))
        counted = times(of)[times(of) >= 40]
        assert found.settled_formation_rmse_mm == pytest.approx(np.sqrt((counted**2).mean()))


def test_settled_formation_error_of_a_late_robot_counts_from_its_own_start():
    of = scenario(robots=12)
    found = metrics(of, formation_error_mm=from_to(of, 0, 60, 100.0, 2.0))
    assert found[10].settled_formation_rmse_mm > 2.0
    assert found[11].settled_formation_rmse_mm == pytest.approx(2.0)


def test_capped_mean_runs_over_the_whole_run_and_stops_at_500():
    of = scenario()
    error = from_to(of, 0, 25, 1e6, 100.0)
    expected = (1250 * 500 + 3751 * 100) / 5001
    assert metrics(of, position_error_mm=error)[0].error_capped_mean_mm == pytest.approx(expected)


@given(st.floats(-10, 10), st.floats(-100, 100), st.floats(-100, 100))
def test_track_errors_are_along_and_across_the_references_heading(theta, along, across):
    forward, right = (-math.sin(theta), math.cos(theta)), (math.cos(theta), math.sin(theta))
    columns = {
        "reference_theta_rad": np.array([[theta]]),
        "reference_x_mm": np.array([[7.0]]),
        "reference_y_mm": np.array([[-3.0]]),
        "x_mm": np.array([[7.0 + along * forward[0] + across * right[0]]]),
        "y_mm": np.array([[-3.0 + along * forward[1] + across * right[1]]]),
    }
    found = track_errors(columns, 0)
    assert found[0][0] == pytest.approx(along, abs=1e-9)
    assert found[1][0] == pytest.approx(across, abs=1e-9)


def test_along_and_cross_track_errors_add_up_to_the_position_error():
    of = scenario()
    theta = 0.1 * times(of)
    x, y = 3 * np.sin(theta), 5 * np.cos(2 * theta)
    (found, *_) = metrics(
        of, x_mm=x, y_mm=y, reference_theta_rad=theta, position_error_mm=np.hypot(x, y)
    )
    both = math.hypot(found.along_track_rmse_mm, found.cross_track_rmse_mm)
    assert both == pytest.approx(found.position_rmse_mm)


def test_heading_error_counts_from_the_settling_time_on():
    of = scenario()
    found = metrics(of, heading_error_rad=from_to(of, 40, 70, -0.2))
    assert found[0].heading_rmse_rad == pytest.approx(0.2 * math.sqrt(1500 / 3001))


def test_time_gap_error_is_of_followers_only():
    of = scenario()
    found = metrics(of, time_gap_error_s=from_to(of, 0, 40, 9.0, 0.25))
    assert found[0].time_gap_rmse_s is None
    assert [m.time_gap_rmse_s for m in found[1:]] == pytest.approx([0.25, 0.25])


def test_time_gap_error_counts_only_once_a_gap_has_passed():
    of = scenario(horizon_s=20.0, time_gap_s=10.0)  # settled from 8 s on
    found = metrics(of, time_gap_error_s=from_to(of, 0, 10, 9.0, 0.5))
    assert found[1].time_gap_rmse_s == pytest.approx(0.5)
    of = scenario(horizon_s=5.0, time_gap_s=10.0)
    assert metrics(of)[1].time_gap_rmse_s is None


def test_settling_time_is_when_the_error_stays_below_20_mm():
    t_s = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    assert settling_time_s(t_s, np.array([50.0, 5.0, 20.0, 19.9, 0.0])) == 3.0
    assert settling_time_s(t_s, np.full(5, 19.9)) == 0.0
    assert settling_time_s(t_s, np.array([0.0, 0.0, 0.0, 0.0, 20.0])) is None


def test_functionals_are_their_last_value():
    of = scenario()
    found = metrics(of, J_mm_s=-times(of), J_theta_rad_s=0.1 * times(of))[1]
    assert found.J_mm_s == pytest.approx(-100.0)
    assert found.J_theta_rad_s == pytest.approx(10.0)


def test_torque_saturation_and_energy_count_the_steps_that_were_driven():
    of = scenario()
    driven = np.ones(5001)
    driven[0] = 0.0  # the start is no step
    found = metrics(
        of, torque_rms_Nmm=3 * driven, saturation_fraction=0.25 * driven, energy_mJ=2 * driven
    )[0]
    assert found.torque_rms_Nmm == pytest.approx(3.0)
    assert found.saturation_fraction == pytest.approx(0.25)
    assert found.energy_J == pytest.approx(10.0)


def test_slip_is_its_maximum_and_the_sum_of_its_ways():
    of = scenario()
    slip = from_to(of, 10, 20, 30.0)
    found = metrics(of, slip_mm_s=slip, slid_mm=slip * PERIOD_S)[2]
    assert found.slip_max_mm_s == 30.0
    assert found.slip_distance_mm == pytest.approx(300.0)


def test_nearest_is_the_smallest_distance_to_any_other_robot():
    x = np.array([[0.0, 300.0, 1000.0], [0.0, 250.0, 600.0]])
    y = np.array([[0.0, 400.0, 0.0], [0.0, 0.0, 0.0]])
    assert nearest_mm({"x_mm": x, "y_mm": y}) == pytest.approx([250.0, 250.0, 350.0])
    assert nearest_mm({"x_mm": x[:, :1], "y_mm": y[:, :1]}) == [None]


@pytest.mark.parametrize(("error_mm", "points"), [(0.0, 100.0), (10.0, 50.0), (90.0, 10.0)])
def test_score_of_a_constant_error(error_mm, points):
    t_s = np.arange(101) * PERIOD_S
    assert score(t_s, np.full(101, error_mm), math.inf) == pytest.approx(points)


def test_score_is_zero_from_the_moment_of_lost_or_touched():
    of = scenario()
    found = metrics(of, lost_at_s=[50.0, math.inf, 80.0], touched_at_s=[math.inf, 20.0, 60.0])
    expected = [100 * steps / 5001 for steps in (2500, 1000, 3000)]
    assert [m.score for m in found] == pytest.approx(expected)
    assert [m.lost for m in found] == [True, False, True]
    assert [m.touched for m in found] == [False, True, True]


def test_what_was_touched_has_a_name_and_counts_alike():
    of = scenario(robots=4)
    touched = {"touched_at_s": [20.0, 20.0, 20.0, math.inf]}
    found = metrics(of, touched_by=np.array([1, 2, 3, 0], dtype=np.int8), **touched)
    assert [m.touched_by for m in found] == ["robot", "wall", "obstacle", None]
    assert [m.touched for m in found] == [True, True, True, False]
    assert len({m.score for m in found[:3]}) == 1
    assert [m._replace(touched_by=None) for m in found] == metrics(of, **touched)


def test_lost_is_also_an_rms_above_100_mm_in_the_last_30_percent():
    of = scenario()
    assert not metrics(of, position_error_mm=from_to(of, 0, 70, 1e3, 99.9))[0].lost
    assert metrics(of, position_error_mm=from_to(of, 0, 70, 0, 100.1))[0].lost
    (found, *_) = metrics(of, position_error_mm=from_to(of, 0, 70, 0, 100.1))
    assert found.score == 100.0  # its time is not known: only the score's own error counts


def test_nothing_is_ever_nan():
    for horizon_s in (PERIOD_S, 1.0, 5.0, 100.0):
        for robots in (1, 3):
            of = scenario(horizon_s, robots, time_gap_s=1.0)
            found = metrics(of)
            string = string_metrics(
                of,
                {name: np.zeros((of.horizon_steps + 1, robots)) for name in ("x_mm", "y_mm")},
                np.zeros((of.horizon_steps + 1, 2)),
            )
            json.dumps([*(m._asdict() for m in found), string._asdict()], allow_nan=False)
    found = metrics(scenario(PERIOD_S, 3, time_gap_s=1.0))
    assert found[2].formation_rmse_mm is None
    assert found[2].settled_formation_rmse_mm is None


# --- string of robots ------------------------------------------------------------------------------

SPEED_MM_S = 200.0


def string(gains, frequencies_Hz=(0.2,), *, horizon_s=200.0, noise_mm=0.0, gap_s=5.0):
    """A string of robots on a straight path along +y whose deviations are sinusoids of the path's time.

    Robot i's is its predecessor's, times ``gains(i, frequency)``, with a shift of 0.3 rad.
    """
    robots = 4
    of = scenario(horizon_s, robots, gap_s)
    t_s = times(of)
    leader = np.column_stack([np.zeros_like(t_s), SPEED_MM_S * t_s])
    x, y = np.zeros((len(t_s), robots)), np.zeros((len(t_s), robots))
    rng = np.random.default_rng(1)
    for i in range(robots):
        path_s = t_s - i * gap_s
        y[:, i] = SPEED_MM_S * np.maximum(path_s, 0)
        for frequency in frequencies_Hz:
            size = 10 * math.prod(gains(j, frequency) for j in range(1, i + 1))
            x[:, i] += size * np.sin(2 * np.pi * frequency * path_s - 0.3 * i)
        x[:, i] += noise_mm * rng.normal(size=len(t_s))
    return string_metrics(of, {"x_mm": x, "y_mm": y}, leader)


@pytest.mark.parametrize("gain", [0.5, 1.0, 1.7])
def test_string_gains_of_a_chain_of_sinusoids(gain):
    found = string(lambda i, f: gain, noise_mm=0.1)
    assert found.time_gain == pytest.approx(gain, rel=0.02)
    assert found.frequency_gain == pytest.approx(gain, rel=0.02)


def test_string_gains_are_those_of_the_worst_pair():
    found = string(lambda i, f: (0, 0.5, 1.4, 0.9)[i], noise_mm=0.1)
    assert found.time_gain == pytest.approx(1.4, rel=0.02)
    assert found.frequency_gain == pytest.approx(1.4, rel=0.02)


def test_frequency_gain_finds_the_frequency_that_grows():
    found = string(lambda i, f: 1.5 if f == 0.6 else 0.7, (0.2, 0.6), noise_mm=0.2)
    assert found.frequency_gain == pytest.approx(1.5, rel=0.03)
    assert found.frequency_Hz == pytest.approx(0.6, abs=0.05 + 1e-9)
    assert 0.7 < found.time_gain < 1.5


def test_what_is_faster_than_1_hz_is_sensor_noise():
    found = string(lambda i, f: 3.0 if f == 2.0 else 0.8, (0.2, 2.0), noise_mm=0.2)
    assert found.frequency_gain == pytest.approx(0.8, rel=0.05)
    assert found.frequency_Hz <= 1.0


def test_incoherent_deviations_have_no_frequency_gain():
    found = string(lambda i, f: 1.0, frequencies_Hz=(), noise_mm=1.0, horizon_s=1000.0)
    assert found.time_gain == pytest.approx(1.0, rel=0.05)
    assert found.frequency_gain is None
    assert found.frequency_Hz is None


def test_a_perfect_string_has_no_gains():
    assert string(lambda i, f: 1.0, frequencies_Hz=()) == StringMetrics(None, None, None)


def test_a_follower_without_error_has_the_gain_zero():
    found = string(lambda i, f: 0.0)
    assert found.time_gain == pytest.approx(0.0)


def test_one_robot_has_no_string():
    of = scenario(robots=1)
    rows = {name: np.random.default_rng(0).normal(size=(5001, 1)) for name in ("x_mm", "y_mm")}
    assert string_metrics(of, rows, np.zeros((5001, 2))) == StringMetrics(None, None, None)


def test_deviation_is_the_distance_to_the_left_of_the_path_by_the_paths_own_time():
    t_s = np.arange(0, 10, PERIOD_S)
    angle = 0.3 * t_s
    leader = 1000 * np.column_stack([np.cos(angle), np.sin(angle)])  # counter-clockwise
    lag = 50
    columns = {"x_mm": np.zeros((len(t_s), 2)), "y_mm": np.zeros((len(t_s), 2))}
    columns["x_mm"][lag:, 1] = 0.98 * leader[:-lag, 0]  # 20 mm nearer to the centre: left
    columns["y_mm"][lag:, 1] = 0.98 * leader[:-lag, 1]
    found = deviation_mm(columns, leader, 1, lag)
    assert found.shape == (len(t_s) - lag,)
    assert found[1:-1] == pytest.approx(20.0, abs=1e-6)


def test_deviation_from_a_reference_that_stands_is_zero():
    columns = {"x_mm": np.ones((10, 1)), "y_mm": np.ones((10, 1))}
    assert (deviation_mm(columns, np.zeros((10, 2)), 0, 0) == 0).all()


# --- documentation ---------------------------------------------------------------------------------


def test_the_documentation_defines_every_metric_in_order():
    defined = re.findall(r"^\| `(\w+)` \|", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    assert defined == [*RobotMetrics._fields, *StringMetrics._fields]


class Still:
    """A policy that does nothing."""

    def predict(self, rows, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(rows), 2)), state


def test_a_start_is_no_loss_on_a_short_run():
    """In 6 s the leader is still catching up with a reference that began at full speed."""
    scenario = load_scenario("infinity", horizon_s=6.0)
    record = run_policy(scenario, ReferencePolicy(), 0)
    assert np.sqrt(np.mean(record["position_error_mm"][-90:, 0] ** 2)) > 100
    found = record.metrics()
    assert not any(robot.lost for robot in found)
    set_out = [i * scenario.time_gap_s < 6.0 for i in range(3)]
    cells = list(metrics_table(record).columns[-1].cells)
    assert cells == ["held" if one else "waits" for one in set_out]
    assert cells.count("waits") == 1
    standing = run_policy(load_scenario("infinity", horizon_s=20.0, lost_beyond_mm=1e6), Still())
    assert standing.metrics()[0].lost  # the errors after 10 s count


@pytest.mark.parametrize("horizon_s", [0.02, 0.04, 0.1, 1.0, 4.0, 5.0, 6.0, 10.0, 12.0])
@pytest.mark.parametrize("robots", [1, 3])
def test_metrics_of_a_short_run_give_no_warning(horizon_s, robots):
    """Robots that have not moved yet have a spectrum of zeros, and a coherence that is not defined."""
    scenario = load_scenario("infinity", horizon_s=horizon_s, robots=robots)
    policy = ReferencePolicy(preview_s=scenario.preview_s)
    record = run_policy(scenario, policy, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(record.metrics()) == robots
        string = record.string()
    assert all(value is None or np.isfinite(value) for value in string)
