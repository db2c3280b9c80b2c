"""Files that are read: what YAML values mean, suffixes, depth, and forms of CSV."""

from __future__ import annotations

import datetime
import json
import math

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from baselines.benchmark.envelope import load_knob
from baselines.benchmark.plan import read_plan
from baselines.policies.learned import SHIPPED, load_policy, shipped_policies
from baselines.runs.jobs import claim
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env.common.files import read_json
from tlf_env.common.presets import KINDS, preset_names, presets_folder, read_yaml, yaml_text
from tlf_env.onboard.controllers import load_controller
from tlf_env.physics.openloop import load_scenarios
from tlf_env.task.scenario import load_scenario
from tlf_env.task.waypoints import read_points

READERS = {
    "scenario": load_scenario,
    "disturbance": lambda path: load_scenario("infinity", disturbance=str(path)),
    "controller": load_controller,
    "training": load_config,
    "search": load_tune,
    "knob": lambda path: load_knob(str(path)),
    "plan": lambda path: read_plan(str(path), ("seeds", "level", "policies")),
}
NUMBERS = {
    "5e-1": 0.5, "2e3": 2000.0, "1E+2": 100.0, "-1.5e-3": -0.0015, ".5": 0.5, "5.": 5.0, "+3": 3,
    "12": 12, "0": 0, "-0": 0, "0.010": 0.01, "1.0e+3": 1000.0,
}  # fmt: skip
AMBIGUOUS = (
    "yes", "no", "on", "off", "Yes", "NO", "On", "OFF", "010", "-010", "0o17", "0x1F", "0b11",
    "1_0", "1_000.5", "1:30", "10:59", "1:30:00.5", "2026-11-28", "2026-11-28 10:00:00",
)  # fmt: skip
TEXTS = ("y", "n", "none", "noise", "1.2.3", "e5", "10000:10016", "a_1", "_1", "1e", "0:40:9", "~a")


def yaml_file(tmp_path, text, name="mine.yaml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("text", NUMBERS)
def test_numbers_are_those_of_yaml_1_2(tmp_path, text):
    value = read_yaml(yaml_file(tmp_path, f"a: {text}\n"))["a"]
    assert value == NUMBERS[text]
    assert type(value) is type(NUMBERS[text])


@pytest.mark.parametrize("text", TEXTS)
def test_other_values_are_texts(tmp_path, text):
    assert read_yaml(yaml_file(tmp_path, f"a: {text}\n"))["a"] == text


@pytest.mark.parametrize("text", [".nan", ".inf", "-.inf", "true", "false", "null", "~", ""])
def test_the_other_words_of_yaml_1_2_mean_what_they_did(tmp_path, text):
    value = read_yaml(yaml_file(tmp_path, f"a: {text}\n"))["a"]
    before = yaml.safe_load(f"a: {text}\n")["a"]
    assert value is before or value == before or math.isnan(value) == math.isnan(before)


@pytest.mark.parametrize("form", ["a: {}\n", "a: [1, {}]\n", "{}: 1\n", "- {}\n", "a: {{b: {}}}\n"])
@pytest.mark.parametrize("text", AMBIGUOUS)
def test_what_two_versions_of_yaml_read_differently_is_refused(tmp_path, text, form):
    path = yaml_file(tmp_path, form.format(text))
    with pytest.raises(ValueError, match=r"mine\.yaml, line 1: .* is ambiguous in YAML") as caught:
        read_yaml(path)
    assert text in str(caught.value)
    quoted = yaml_file(tmp_path, f"a: '{text}'\n")
    assert read_yaml(quoted) == {"a": text}


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("text", ["on", "010", "1:30", "2026-11-28"])
def test_every_kind_of_file_refuses_it(tmp_path, kind, text):
    with pytest.raises(ValueError, match=r"line 1: .* is ambiguous"):
        READERS[kind](yaml_file(tmp_path, f"level: {text}\n"))


@pytest.mark.parametrize("kind", KINDS)
def test_the_presets_mean_what_they_did(kind):
    for name in preset_names(kind):
        path = presets_folder(kind) / f"{name}.yaml"
        assert read_yaml(path) == yaml.safe_load(path.read_text(encoding="utf-8"))


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**9), 10**9),
    st.floats(allow_nan=False),
    st.text(max_size=12),
    st.sampled_from([*AMBIGUOUS, *NUMBERS, *TEXTS, "true", "null", "<<", "="]),
    st.from_regex(r"\A[-+0-9.eE_:x]{1,8}\Z"),
)
KEYS = st.from_regex(r"\A[a-zäß0-9]{1,6}\Z")


@given(data=st.dictionaries(KEYS, st.lists(SCALARS, max_size=3), max_size=3))
@example(data={"a": ["\x85", "x\u2028y"], "b\u2029c": "d\x85"})
def test_what_is_written_is_read_back(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("yaml") / "a.yaml"
    path.write_text(yaml_text(data), encoding="utf-8")
    assert read_yaml(path) == data


def test_no_date_is_made(tmp_path):
    quoted = read_yaml(yaml_file(tmp_path, "a: '2026-11-28'\n"))["a"]
    assert not isinstance(quoted, datetime.date)


# Depth


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("depth", [60, 400, 3000, 100_000])
@pytest.mark.parametrize("form", ["mapping", "list"])
def test_a_deep_yaml_file_is_one_line(tmp_path, kind, depth, form):
    start, end = ("{a: ", "}") if form == "mapping" else ("[", "]")
    path = yaml_file(tmp_path, f"level: {start * depth}1{end * depth}\n")
    with pytest.raises(
        ValueError, match=r"mine\.yaml is nested more than 50 levels deep"
    ) as caught:
        READERS[kind](path)
    assert "\n" not in str(caught.value)


def test_a_usual_depth_is_no_error(tmp_path):
    path = yaml_file(tmp_path, f"level: {'{a: ' * 40}1{'}' * 40}\n")
    value = read_yaml(path)["level"]
    for _ in range(40):
        value = value["a"]
    assert value == 1


@pytest.mark.parametrize("form", ['{"a": ', "["])
def test_a_deep_json_file_is_one_line(tmp_path, form):
    depth = 100_000
    text = form * depth + "1" + ("}" if "{" in form else "]") * depth
    path = tmp_path / "deep.json"
    path.write_text(text, encoding="utf-8")
    weights = tmp_path / "deep.safetensors"
    weights.write_bytes(b"")
    for read in (
        read_json,
        load_scenarios,
        lambda one: load_policy(weights),
        lambda one: claim(one, {"a": 1}, ["a"], "results"),
    ):
        with pytest.raises(ValueError, match=r"deep\.json") as caught:
            read(path)
        assert "\n" not in str(caught.value)


# Suffixes


CIRCLE = "trajectory: {type: circle, radius_mm: 2000, speed_mm_s: 250}\n"
PATH = "t_s,x_mm,y_mm\n0,0,0\n4,600,100\n8,1200,0\n"


@pytest.mark.parametrize("suffix", [".YAML", ".Yml", ".YML", ".yaml"])
def test_yaml_files_may_have_capital_suffixes(tmp_path, suffix):
    scenario = load_scenario(yaml_file(tmp_path, CIRCLE, f"Task{suffix}"))
    assert scenario.trajectory.radius_mm == 2000
    assert scenario.name == "Task"
    gains = presets_folder("controller") / "tuned.yaml"
    copied = yaml_file(tmp_path, gains.read_text(encoding="utf-8"), f"Gains{suffix}")
    assert load_controller(copied).controller == load_controller("tuned").controller
    slip = yaml_file(tmp_path, "slip: {delta_1_mm_s: 3}\n", f"Slip{suffix}")
    assert load_scenario("circle", disturbance=str(slip)).disturbance.name == "Slip"


@pytest.mark.parametrize("suffix", [".CSV", ".Csv"])
def test_waypoints_may_have_capital_suffixes(tmp_path, suffix):
    scenario = load_scenario(yaml_file(tmp_path, PATH, f"Path{suffix}"))
    assert len(scenario.trajectory.points) == 3


@pytest.mark.parametrize("card", [".json", ".JSON"])
def test_policies_may_have_capital_suffixes(tmp_path, card):
    name = shipped_policies()[0]
    weights = tmp_path / "POLICY.SAFETENSORS"
    weights.write_bytes((SHIPPED / f"{name}.safetensors").read_bytes())
    weights.with_suffix(card).write_bytes((SHIPPED / f"{name}.json").read_bytes())
    assert load_policy(weights).card == load_policy(name).card


# Waypoints


def waypoints(tmp_path, text):
    return read_points(yaml_file(tmp_path, text, "path.csv"))


def test_a_header_of_savetxt_is_a_header(tmp_path):
    path = tmp_path / "path.csv"
    rows = [[0, 0, 0], [4, 600, 100], [8, 1200, 0]]
    for header in ("t_s,x_mm,y_mm", "logged\nt_s, x_mm, y_mm"):
        np.savetxt(path, rows, delimiter=",", header=header, footer="end")
        assert read_points(path) == tuple(map(tuple, rows))


def test_comments_are_left_out_and_lines_are_counted(tmp_path):
    points = waypoints(tmp_path, f"# from a log\n{PATH}# end\n")
    assert len(points) == 3
    with pytest.raises(ValueError, match="line 4: x_mm must be a number"):
        waypoints(tmp_path, "# from a log\nt_s,x_mm,y_mm\n0,0,0\n1,a,0\n")


@pytest.mark.parametrize("text", ["# t_s,x_mm\n0,0\n", "# a\n# b\n", "#\n0,0,0\n1,1,1\n"])
def test_without_the_header_the_file_is_refused(tmp_path, text):
    with pytest.raises(ValueError, match="the header must be t_s,x_mm,y_mm"):
        waypoints(tmp_path, text)


@pytest.mark.parametrize("first_s", [1.7e9, -1.7e9, 8e9])
def test_times_of_any_epoch_give_the_same_path(tmp_path, first_s):
    rows = [(k / 2, 800 * math.cos(k / 10), 800 * math.sin(k / 10)) for k in range(40)]
    text = "t_s,x_mm,y_mm\n" + "".join(f"{first_s + t:.3f},{x!r},{y!r}\n" for t, x, y in rows)
    found = np.array(waypoints(tmp_path, text))
    assert found == pytest.approx(np.array(rows), abs=1e-3)


def test_a_time_far_after_the_first_is_refused(tmp_path):
    with pytest.raises(
        ValueError, match=r"line 3: t_s 2e\+09 must be at most|t_s 2000000000 must be"
    ):
        waypoints(tmp_path, "t_s,x_mm,y_mm\n0,0,0\n2e9,1,0\n")


@pytest.mark.parametrize("place_mm", [(5e8, 9.3e9), (-1e10 + 900, 1e10 - 900)])
def test_any_place_of_the_utm_grid_is_allowed(tmp_path, place_mm):
    x_mm, y_mm = place_mm
    points = waypoints(tmp_path, f"t_s,x_mm,y_mm\n0,{x_mm},{y_mm}\n4,{x_mm + 500},{y_mm}\n")
    assert points[1] == (4, x_mm + 500, y_mm)


@pytest.mark.parametrize("place_mm", [2e10, -1.1e10])
def test_places_farther_away_are_refused(tmp_path, place_mm):
    with pytest.raises(ValueError, match=r"within ±1e\+10"):
        waypoints(tmp_path, f"t_s,x_mm,y_mm\n0,{place_mm},0\n4,{place_mm},9\n")


def test_points_of_a_mapping_are_numbers_and_not_texts():
    trajectory = {"type": "waypoints", "points": [(0, 0, 0), (1, "5", 5)]}
    with pytest.raises(ValueError, match=r"points\[1\]: x_mm must be a number .* got '5'"):
        load_scenario({"trajectory": trajectory})
    numpys = [(np.int64(0), np.float32(0.5), 0), (np.float64(1), 5, np.int8(5))]
    points = load_scenario({"trajectory": {**trajectory, "points": numpys}}).trajectory.points
    assert points == ((0, 0.5, 0), (1, 5, 5))
    assert json.dumps(points)


def curve(points):
    return load_scenario({"trajectory": {"type": "waypoints", "points": points}}).trajectory.points


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.int8])
def test_points_may_be_numbers_and_arrays_of_numpy(kind):
    rows = [[0, 0, 0], [1, 5, 0]]
    array = np.array(rows, dtype=kind)
    for points in (array, list(array), [[kind(0), 0, 0], [1, 5, kind(0)]]):
        found = curve(points)
        assert found == ((0, 0, 0), (1, 5, 0))
        assert json.dumps(found)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((2, 3), dtype=bool),
        np.zeros((2, 3), dtype=complex),
        np.zeros((2, 2)),
        np.array(1.0),
        np.full((2, 3), "1"),
        {"t_s": np.zeros((9, 9))},
    ],
    ids=lambda points: str(getattr(points, "dtype", "mapping")),
)
def test_other_points_are_refused_in_one_line(points):
    with pytest.raises(ValueError, match="points") as caught:
        curve(points)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cell", ["1_0", "\u0663", "\uff11", "0x1", "infinity", "1e", "."])
def test_cells_are_numbers_as_in_yaml(tmp_path, cell):
    with pytest.raises(ValueError, match=f"line 3: t_s must be a number .*'{cell}'"):
        waypoints(tmp_path, f"t_s,x_mm,y_mm\n0,0,0\n{cell},1,0\n")


@pytest.mark.parametrize("first_s", [1.7e12, 1.7e18, -1.7e15])
def test_times_that_float64_cannot_tell_apart_are_refused(tmp_path, first_s):
    with pytest.raises(ValueError, match=r"line 2: t_s .* times must be in seconds"):
        waypoints(tmp_path, f"t_s,x_mm,y_mm\n{first_s},0,0\n{first_s + 1e6},1,0\n")


def test_a_header_with_other_delimiters_is_quoted_with_its_line(tmp_path):
    path = tmp_path / "path.csv"
    np.savetxt(path, [[0, 0, 0], [4, 600, 100]], header="a log\nt_s x_mm y_mm")
    with pytest.raises(
        ValueError, match=r"line 3: the header .* the comment '# t_s x_mm y_mm' of line 2"
    ):
        read_points(path)
