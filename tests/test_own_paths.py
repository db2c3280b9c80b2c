"""``tlf path``: logs in any usual form become paths that robots can follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from baselines import ReferencePolicy, cli
from baselines.commands import path as path_module
from baselines.paths.read import read_log
from baselines.paths.retime import (
    ACCELERATION_MM_S2,
    LATERAL_MM_S2,
    TURN_RAD_S,
    retimed,
    smoothed,
)
from baselines.runs.run import run_policy
from tlf_env.task.scenario import load_scenario, scenario_warnings

T_S = np.arange(0.0, 60.0, 0.05)
EIGHT = np.stack([2000 * np.sin(0.125 * T_S), 2000 * np.sin(0.25 * T_S)], axis=1)


def log_file(folder: Path, content: str | bytes) -> Path:
    path = folder / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def said(path: Path, **options) -> str:
    with pytest.raises(ValueError, match=r".") as error:
        read_log(path, **options)
    text = str(error.value)
    assert "\n" not in text
    return text


WANTED = ([0.0, 1.0, 2.5], [[0.0, 0.0], [500.0, -250.0], [1000.0, 0.0]])


@pytest.mark.parametrize(
    ("content", "options"),
    [
        ("t_s,x_mm,y_mm\n0,0,0\n1,500,-250\n2.5,1000,0\n", {}),
        ("t;x_m;y_m\n0;0;0\n1;0,5;-0,25\n2,5;1,0;0\n", {}),
        ("time\tx [cm]\ty [cm]\n7\t0\t0\n8\t50\t-25\n9.5\t100\t0\n", {}),
        ("Time  X(mm)  Y(mm)\n0 0 0\n1 5e2 -2.5E2\n2.5 1000 0\n", {}),
        ("0,0 0,0 0,0\n1,0 0,5 -0,25\n2,5 1,0 0,0\n", {"units": "m"}),
        ("id|stamp|easting|northing\na|0|0|0\nb|1|500|-250\nc|2.5|1000|0\n", {"units": "mm"}),
        ("# by a camera\n\n% more\ntime,x,y\n0,0,0\n1,.5,-.25\n\n2.5,1,0\n", {"units": "m"}),
        ('"t","x_m","y_m"\r\n"0","0","0"\r\n"1","0.5","-0.25"\r\n"2.5","1","0"\r\n', {}),
        ("\ufefft_ms,x_m,y_m\n1000,0,0\n2000,0.5,-0.25\n3500,1,0\n", {}),
        ("t_s,x_mm,y_mm\n0,0,0\n1,500,-250\n2.5,1000,0\n".encode("utf-16"), {}),
        (
            "timestamp_ns,x_m,y_m\n1700000000000000001,0,0\n1700000001000000001,0.5,-0.25\n"
            "1700000002500000001,1,0\n",
            {},
        ),
        (
            "time,.pose.pose.position.x,.pose.pose.position.y,.pose.pose.position.z\n"
            "1.7e9,0,0,0\n1700000001,0.5,-0.25,0\n1700000002.5,1,0,0\n",
            {"units": "m"},
        ),
        ("a,b,c,d\n9,0,0,0\n9,0.5,1,-0.25\n9,1,2.5,0\n", {"columns": "c,b,d", "units": "m"}),
        ("9,0,0,0\n9,0.5,1,-0.25\n9,1,2.5,0\n", {"columns": "3,2,4", "units": "m"}),
        ("t,x_mm,y_mm\n0,0,0\n1,0.5,-0.25\n2.5,1,0\n", {"units": "m"}),  # the option counts
        (
            "1700000000,900000000,odom,0,0\n1700000001,900000000,odom,.5,-.25\n"
            "1700000003,400000000,odom,1,0\n",
            {"columns": "1+2,4,5", "units": "m"},
        ),
    ],
)  # fmt: skip
def test_every_usual_form_is_read(content, options, tmp_path):
    log = read_log(log_file(tmp_path, content), **options)
    np.testing.assert_allclose(log.t_s, WANTED[0], atol=1e-9)
    np.testing.assert_allclose(log.xy_mm, WANTED[1], atol=1e-9)


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        ("", {}, "log.csv has no rows"),
        ("a,b\n1,2\n", {}, "line 1: no rows of at least three numbers"),
        ("t,x,y\n0,0,0\n1,500,0\n", {}, "nothing says the unit of x and y (the path is 500 wide"),
        ("t_s,x_mm,y_mm\n0,0,0\n1,2,0\n", {}, "the whole path is 2 mm wide or high by its header"),
        ("t_s,x_mm,y_mm\n0,0,0\n1,500,0\n1,600,0\n", {}, "line 4: its time 1 is the same time as that of line"),
        ("t_s,x_mm,y_mm\n0,0,0\n# c\n2,500,0\n1,600,0\n", {}, "line 5: its time 1 is before that of line 4, 2"),
        ("t_s,x_mm,y_mm\n0,0,0\n1,5oo,0\n2,6,6\n3,4,5\n", {}, "line 3: '5oo' in column 2 is no number"),
        ("t_s,x_mm,y_mm\n0,0,0\n1,nan,0\n2,6,6\n3,4,5\n", {}, "line 3: 'nan' in column 2 is no number"),
        ("t_s,x_mm,y_mm\n0,0,0\n1,2\n2,6,6\n3,4,5\n", {}, "line 3: '' in column 3 is no number"),
        ("t_s,x_mm,y_mm\n0,0,0\n", {}, "at least two rows of numbers, got 1"),
        ("t,x_mm,x,y\n0,0,0,0\n1,1,1,1\n", {}, "2 columns for x in the header t, x_mm, x, y"),
        ("t,a,b\n0,0,0\n1,1,1\n", {}, "no column for x in the header t, a, b; --columns names"),
        ("1,2,3,4\n2,3,4,5\n", {}, "4 columns and no header; --columns says"),
        ("t,x,y\n0,0,0\n1,1,1\n", {"columns": "t,x"}, "must name three columns"),
        ("t,x,y\n0,0,0\n1,1,1\n", {"columns": "t,x,z"}, "has no column 'z'; the columns are t, x, y"),
        ("1,2,3\n2,3,4\n", {"columns": "1,2,4"}, "has no column '4'; the columns are 1 to 3"),
        ("t,x,y\n0,0,0\n1,1,1\n", {"units": "ft"}, "--units 'ft' must be one of mm, cm, m, km"),
        (b"t,x,y\n0,0,\xff\n", {}, "is not UTF-8 text"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_told_by_its_place(content, options, words, tmp_path):
    assert words in said(log_file(tmp_path, content), **options)


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        ("log\nt;x;y\n0,0;0,0;0,0\n0,1;0,1;0,0\n0,2;0,2;0,1\n", {"columns": "1,2,3"}, "'t' in column 1 is no"),
        ("t,x_mm,y_mm\n0,0,0\n1,11e99950,0\n", {}, "line 3: '11e99950' in column 2 must be within ±1e+20"),
        ("t,x_mm,y_mm\n0,0,0\n9e999999999,1,0\n", {}, "line 3: '9e999999999' in column 1 must be within"),
        ("t,x_mm,y_mm\n0,0,0\n1,-1e19,0\n", {}, "line 3: x and y must be within ±1e+10 mm, got -1e+19, 0"),
        ("t,x_mm,y_mm\n0,0,0\n1,200,0\n1.00000000000000000001,9,0\n", {}, "line 4: its time"),
        ("a," * 3000 + "b\n0,0,0\n1,1,0\n", {}, "no column for time in the header a, a, "),
    ],
)  # fmt: skip
def test_hostile_numbers_and_headers_are_refused(content, options, words, tmp_path):
    text = said(log_file(tmp_path, content), **options)
    assert words in text
    assert len(text) < 600


def test_a_log_that_is_too_long_is_thinned(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(path_module, "MAX_POINTS", 50)
    monkeypatch.chdir(tmp_path)
    noisy(tmp_path, 0.0)
    tlf(monkeypatch, "path", "log.csv", "--no-figures")
    assert "Thinned to 50 points" in capsys.readouterr().out
    points = np.array(load_scenario("path.csv").trajectory.points)
    assert len(points) == 50
    assert points[-1, 0] == pytest.approx(T_S[-1])
    nearest = [np.hypot(*(EIGHT - point).T).min() for point in points[:, 1:]]
    assert max(nearest) < 20.0


def test_a_missing_file_is_named(tmp_path):
    assert "cannot read" in said(tmp_path / "nowhere.csv")
    assert "cannot read" in said(tmp_path)


def noisy(folder: Path, noise_mm: float, decimals: str = ".") -> Path:
    rng = np.random.default_rng(1)
    rows = np.column_stack(
        [1.7e9 + T_S, EIGHT / 1000 + noise_mm / 1000 * rng.normal(size=EIGHT.shape)]
    )
    text = "\n".join(";".join(f"{value:.6f}" for value in row) for row in rows)
    return log_file(folder, "t;x_m;y_m\n" + text.replace(".", decimals))


def test_smoothing_recovers_the_path_under_the_noise(tmp_path):
    log = read_log(noisy(tmp_path, 5.0, ","))
    times, points, deviation = smoothed(log, 5.0)
    assert deviation.rms_mm == pytest.approx(5.0 * np.sqrt(2), rel=0.05)
    truth = np.stack([2000 * np.sin(0.125 * times), 2000 * np.sin(0.25 * times)], axis=1)
    apart = np.hypot(*(points - truth).T)
    assert np.sqrt(np.mean(apart**2)) < 2.5


def test_retiming_keeps_to_its_limits():
    times, points = retimed(EIGHT, 300.0)
    velocity = np.gradient(points, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    speed = np.hypot(*velocity.T)
    assert speed.max() < 301.0
    assert speed.max() > 290.0
    assert speed[[0, -1]].max() < 15.0  # from rest to rest
    moving = speed > 30.0
    cross = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    along = (velocity * acceleration).sum(axis=1)
    assert (np.abs(cross)[moving] / speed[moving]).max() < 1.1 * LATERAL_MM_S2
    assert (np.abs(along)[moving] / speed[moving]).max() < 1.2 * ACCELERATION_MM_S2
    assert (np.abs(cross)[moving] / speed[moving] ** 2).max() < 1.1 * TURN_RAD_S
    nearest = [np.hypot(*(EIGHT - point).T).min() for point in points]
    assert max(nearest) < 20.0  # the same path


def test_a_speed_limit_needs_a_path_with_length():
    with pytest.raises(ValueError, match="the path has no length"):
        retimed(np.zeros((5, 2)), 100.0)


def test_a_path_that_is_too_long_is_refused(tmp_path):
    """Its points every 5 mm, or every 0.1 s, would not fit into the memory."""
    log = read_log(log_file(tmp_path, "t,x_m,y_m\n0,0,0\n1,4e6,0\n2,4e6,4e6\n1e8,0,0\n"))
    with pytest.raises(
        ValueError, match=r"the path is 1\.\d+e\+10 mm long; at most 1e\+07 mm can be timed"
    ):
        retimed(log.xy_mm, 400.0)
    with pytest.raises(
        ValueError, match=r"the path takes 1e\+08 s; at most 200000 s can be smoothed"
    ):
        smoothed(log, 5.0)


def tlf(monkeypatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    cli.main()


def test_a_noisy_log_at_20_hz_is_followed(tmp_path, monkeypatch, capsys):
    """Without the options it is not: every cause is named with its place and its cure."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    noisy(tmp_path, 5.0)
    tlf(monkeypatch, "path", "log.csv", "--no-figures")
    answer = capsys.readouterr()
    assert "warnings; run it with" in answer.out
    assert "cure: --smooth" in answer.err
    assert "mm: " in answer.err
    tlf(monkeypatch, "path", "log.csv", "--smooth", "5", "--speed-limit", "400", "--out", "own.csv")
    answer = capsys.readouterr()
    assert answer.err == "" or "matplotlib" in answer.err
    assert "own.csv: robots can follow it; run it with\ntlf run own.csv" in answer.out
    scenario = load_scenario("own.csv")
    assert scenario_warnings(scenario) == []
    assert scenario.disturbance == load_scenario("infinity").disturbance
    record = run_policy(scenario, ReferencePolicy())
    assert all(not robot.lost and robot.position_rmse_mm < 5.0 for robot in record.metrics())


@pytest.mark.parametrize(
    "words",
    [
        ["--smooth", "0"],
        ["--smooth", "inf"],
        ["--smooth", "nan"],
        ["--speed-limit", "-1"],
        ["--units", "ft"],
    ],
)
def test_values_that_are_not_allowed_are_refused(words, tmp_path, monkeypatch, capsys):
    noisy(tmp_path, 0.0)
    with pytest.raises(SystemExit) as stopped:
        tlf(monkeypatch, "path", str(tmp_path / "log.csv"), *words)
    assert stopped.value.code == cli.BAD_INPUT
    assert words[0] in capsys.readouterr().err


def test_the_strict_reader_names_the_command(tmp_path):
    with pytest.raises(ValueError, match="`tlf path` reads logs with other columns"):
        load_scenario(noisy(tmp_path, 0.0))
