from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from physics_helpers import DT_S, ROBOT, random_start, run
from pydantic import ValidationError

import tlf_env
from tlf_env.physics.openloop import (
    COLUMNS,
    MAX_MM,
    MAX_RAD,
    OpenLoopScenario,
    OpenLoopStart,
    advance_open_loop,
    initial_rows,
    load_scenarios,
    run_open_loop,
)
from tlf_env.physics.parameters import FrictionCurve, RobotParameters, body_array
from tlf_env.physics.state import Contact

PUSH_OFF = {"torque_l_Nmm": 10.0, "torque_r_Nmm": 10.0}
RUN: dict[str, Any] = {"duration_s": 1.0, "inputs": [PUSH_OFF]}


def scenario(**changes: Any) -> OpenLoopScenario:
    return OpenLoopScenario.model_validate({**RUN, **changes})


def complaint(path: Path) -> str:
    """The one line that a file is refused with; it names the file."""
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        load_scenarios(path)
    message = str(caught.value)
    assert "\n" not in message
    return message.replace(str(path), "")


def refused(tmp_path: Path, data: Any) -> str:
    path = tmp_path / "runs.json"
    path.write_text(json.dumps(data))
    return complaint(path)


def test_a_good_file_is_read(tmp_path):
    path = tmp_path / "runs.json"
    path.write_text(json.dumps({"go": RUN}))
    assert load_scenarios(path) == {"go": scenario()}


def test_a_missing_file_is_refused(tmp_path):
    assert "No such file" in complaint(tmp_path / "none.json")


def test_a_folder_is_refused(tmp_path):
    assert "cannot read" in complaint(tmp_path)


@pytest.mark.parametrize("content", [b"", b"{", b"{'a': 1}", b"\xff\xfe\x00", b'{"a": 1} {}'])
def test_a_file_that_is_not_json_is_refused(tmp_path, content):
    path = tmp_path / "runs.json"
    path.write_bytes(content)
    assert "not JSON" in complaint(path)


@pytest.mark.parametrize("data", [[], [RUN], 3, "text", None, {}])
def test_a_file_without_named_scenarios_is_refused(tmp_path, data):
    assert "must contain an object of named scenarios" in refused(tmp_path, data)


@pytest.mark.parametrize("name", ["", ".", "..", "../up", "a/b", ".hidden"])
def test_a_name_that_cannot_name_a_file_is_refused(tmp_path, name):
    assert repr(name) in refused(tmp_path, {"good": RUN, name: RUN})


@pytest.mark.parametrize(
    ("changes", "place", "value"),
    [
        ({"speed": 3}, "go.speed", "unknown key"),
        ({"start": {"x": 3.0}}, "go.start.x", "unknown key"),
        ({"inputs": [{**PUSH_OFF, "torque_Nmm": 1}]}, "go.inputs.0.torque_Nmm", "unknown key"),
        ({"duration_s": -1.5}, "go.duration_s", "-1.5"),
        ({"duration_s": 0}, "go.duration_s", "0"),
        ({"duration_s": math.nan}, "go.duration_s", "nan"),
        ({"duration_s": math.inf}, "go.duration_s", "inf"),
        ({"duration_s": "long"}, "go.duration_s", "'long'"),
        ({"duration_s": None}, "go.duration_s", "None"),
        ({"start": {"yaw_rad_s": math.inf}}, "go.start.yaw_rad_s", "inf"),
        ({"start": {"yaw_rad_s": 1e200}}, "go.start.yaw_rad_s", "1e+200"),
        ({"start": {"castor_rad": -1e300}}, "go.start.castor_rad", "-1e+300"),
        ({"start": {"forward_mm_s": 1e10}}, "go.start.forward_mm_s", "10000000000.0"),
        ({"duration_s": 1e-9}, "duration_s", "1e-09"),
        ({"duration_s": 0.05}, "duration_s", "0.05"),
        ({"inputs": [{**PUSH_OFF, "from_s": 1e308}]}, "go.inputs.0.from_s", "1e+308"),
        ({"start": 7}, "go.start", "7"),
        ({"joint_friction": "perhaps"}, "go.joint_friction", "'perhaps'"),
        ({"inputs": []}, "go.inputs", "at least 1"),
        ({"inputs": [{"torque_l_Nmm": 1.0}]}, "go.inputs.0.torque_r_Nmm", "required"),
        ({"inputs": [{**PUSH_OFF, "from_s": -0.25}]}, "go.inputs.0.from_s", "-0.25"),
        ({"inputs": [{**PUSH_OFF, "torque_l_Nmm": math.nan}]}, "torque_l_Nmm", "nan"),
    ],
    ids=str,
)
def test_an_impossible_value_is_refused_by_name(tmp_path, changes, place, value):
    message = refused(tmp_path, {"go": {**RUN, **changes}})
    assert place in message
    assert value in message


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    "names", [[one] for one in OpenLoopStart.model_fields] + [list(OpenLoopStart.model_fields)]
)
def test_a_start_at_its_bounds_stays_finite(names, sign):
    bounds = {name: sign * (MAX_RAD if "rad" in name else MAX_MM) for name in names}
    assert np.isfinite(run_open_loop(scenario(start=bounds, duration_s=0.3))).all()


@pytest.mark.parametrize(
    "text", ['{"go": 1, "go": 2}', '{"go": {"duration_s": 1, "duration_s": 2}}']
)
def test_a_key_that_stands_twice_is_refused(tmp_path, text):
    path = tmp_path / "runs.json"
    path.write_text(text)
    assert re.search("the key '(go|duration_s)' is repeated", complaint(path))


@pytest.mark.parametrize("missing", ["duration_s", "inputs"])
def test_a_missing_field_is_refused_by_name(tmp_path, missing):
    data = {key: value for key, value in RUN.items() if key != missing}
    assert f"go.{missing}" in refused(tmp_path, {"go": data})


@pytest.mark.parametrize("times", [[0.0, 1.0, 0.5], [0.5, 0.5]])
def test_inputs_out_of_order_are_refused(tmp_path, times):
    inputs = [{**PUSH_OFF, "from_s": time} for time in times]
    message = refused(tmp_path, {"go": {**RUN, "inputs": inputs}})
    assert "from_s must increase" in message
    assert str(times) in message


@pytest.mark.parametrize("dt_s", [0.003, 0.0007, 0.2, 0.15, -0.001, math.inf])
def test_a_step_that_does_not_divide_a_tenth_of_a_second_is_refused(dt_s):
    with pytest.raises(ValueError, match=f"dt_s {dt_s} must divide the 0.1 s between rows"):
        run_open_loop(scenario(), dt_s=dt_s)


@pytest.mark.parametrize("dt_s", [0.1, 0.05, 0.001, 0.0001])
def test_rows_come_every_tenth_of_a_second(dt_s):
    rows = run_open_loop(scenario(duration_s=0.5), dt_s=dt_s)
    assert rows.shape == (6, len(COLUMNS))
    assert rows[:, 0] == pytest.approx(np.arange(6) / 10)
    assert np.isfinite(rows).all()


def column(rows: np.ndarray, name: str) -> np.ndarray:
    return rows[:, COLUMNS.index(name)]


@pytest.mark.parametrize("row", range(1, 10))
def test_nothing_acts_before_the_first_input(row):
    rows = run_open_loop(scenario(inputs=[{**PUSH_OFF, "from_s": row / 10}]))
    assert not rows[: row + 1, 1:].any()
    assert column(rows, "forward_mm_s")[row + 1] > 1


def test_an_input_holds_from_its_time_until_the_next():
    brake = {"torque_l_Nmm": -10.0, "torque_r_Nmm": -10.0}
    whole = run_open_loop(scenario(inputs=[PUSH_OFF, {**brake, "from_s": 0.6}]))
    steady = run_open_loop(scenario())
    assert np.array_equal(whole[:7], steady[:7])
    speed = column(whole, "forward_mm_s")
    assert (np.diff(speed[:7]) > 0).all()
    assert speed[7] < speed[6]


def test_an_input_at_the_end_changes_nothing():
    rows = run_open_loop(scenario(inputs=[PUSH_OFF, {**PUSH_OFF, "from_s": 1.0}]))
    assert np.array_equal(rows, run_open_loop(scenario()))


def test_torques_are_not_limited():
    """There is no wheel loop: the limit of the motors belongs to it."""
    strong = {"torque_l_Nmm": 20.0, "torque_r_Nmm": 20.0}
    rows = run_open_loop(scenario(inputs=[strong]))
    assert column(rows, "forward_mm_s")[-1] > 400


START = {
    "x_mm": 120.0,
    "y_mm": -40.0,
    "theta_rad": 0.7,
    "castor_rad": -0.3,
    "forward_mm_s": 250.0,
    "right_mm_s": 12.0,
    "yaw_rad_s": 0.5,
    "omega_l_rad_s": 4.2,
    "omega_r_rad_s": 5.8,
}


def test_the_first_row_is_the_start():
    rows = run_open_loop(scenario(start=START))
    assert rows[0, 0] == 0
    for name, value in START.items():
        assert column(rows, name)[0] == pytest.approx(value, rel=1e-12), name


def test_a_start_places_the_centre_of_mass_behind_the_axle():
    motion, contact = initial_rows(OpenLoopStart(**START, castor_spin_rad_s=9.0), 20.0)
    x, y, theta, psi, v_x, v_y, w, s, *_, spin, _, _ = motion[:, 0, 0]
    assert (x, y) == pytest.approx((120 + 20 * math.sin(0.7), -40 - 20 * math.cos(0.7)))
    assert psi - theta == pytest.approx(-0.3)
    assert w == s == 0.5
    assert spin == 9.0
    right = v_x * math.cos(theta) + v_y * math.sin(theta)
    assert right == pytest.approx(12.0 + 0.5 * 20.0)
    assert not contact.any()


def test_joint_friction_of_the_scenario_overrides_the_robots():
    robot = RobotParameters(joint_friction=False)
    with_friction = run_open_loop(scenario())
    assert np.array_equal(run_open_loop(scenario(), robot), with_friction)
    without = run_open_loop(scenario(joint_friction=False))
    assert column(without, "y_mm")[-1] > column(with_friction, "y_mm")[-1]


# The parameters


@pytest.mark.parametrize(
    "changes",
    [
        {"com_offset_mm": 25.0},
        {"castor_pivot_mm": 90.0},
        {"castor_trail_mm": 5.0},
        {"castor_load_share": 0.3, "drive_load_share": 0.35},
    ],
    ids=str,
)
def test_loads_that_do_not_fit_the_centre_of_mass_are_refused(changes):
    with pytest.raises(ValidationError, match=r"com_offset_mm .* does not fit castor_load_share"):
        RobotParameters(**changes)


def test_the_refusal_names_the_offset_that_fits():
    with pytest.raises(ValidationError, match=r"castor_trail_mm\) = 18"):
        RobotParameters(castor_trail_mm=5.0)
    assert RobotParameters(castor_trail_mm=5.0, com_offset_mm=18.0).com_offset_mm == 18


def test_loads_that_do_not_add_up_are_refused():
    with pytest.raises(ValidationError, match="it must be 1"):
        RobotParameters(drive_load_share=0.45)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"mu_static": -0.1}, "mu_static"),
        ({"mu_dynamic": -0.01}, "mu_dynamic"),
        ({"mu_dynamic": 0.1}, "mu_dynamic 0.1 must be at most mu_static 0.073"),
        ({"mu_static": math.nan}, "mu_static"),
        ({"stiction_speed_mm_s": 0.0}, "stiction_speed_mm_s"),
        ({"dynamic_speed_mm_s": 2.0}, "dynamic_speed_mm_s 2.0 must be above stiction_speed_mm_s"),
        ({"mu": 0.1}, "mu"),
    ],
    ids=str,
)
def test_impossible_friction_is_refused(changes, name):
    with pytest.raises(ValidationError, match=name):
        FrictionCurve(**{**ROBOT.tyre.model_dump(), **changes})


@pytest.mark.parametrize(
    "name", [name for name, one in RobotParameters.model_fields.items() if one.annotation is float]
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number_may_be_infinite_or_missing(name, value):
    with pytest.raises(ValidationError, match=name):
        RobotParameters(**{name: value})


@pytest.mark.parametrize(
    "name",
    ["mass_kg", "wheel_radius_mm", "axle_width_mm", "wheel_inertia_kg_mm2", "body_inertia_kg_mm2"],
)
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_sizes_and_inertias_are_positive(name, value):
    with pytest.raises(ValidationError, match=name):
        RobotParameters(**{name: value})


def test_an_unknown_parameter_is_refused():
    with pytest.raises(ValidationError, match="wheel_radius"):
        RobotParameters(wheel_radius=50.0)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ({"wheel_radius": 50.0}, "robot.wheel_radius: unknown key"),
        ({"mass_kg": -2.5}, "robot.mass_kg: Input should be greater than 0, got -2.5"),
        ({"tyre": {"mu_static": -0.5}}, "robot.tyre.mu_static: .*-0.5"),
        ({"com_offset_mm": 25.0}, "robot: com_offset_mm 25.0 does not fit castor_load_share 0.2"),
    ],
    ids=str,
)
def test_a_scenario_refuses_an_impossible_robot_in_one_line(robot, message):
    with pytest.raises(ValueError, match=message) as caught:
        tlf_env.load_scenario("infinity", robot=robot)
    assert "\n" not in str(caught.value)


def test_parameters_never_change():
    with pytest.raises(ValidationError):
        RobotParameters().mass_kg = 2.0


def test_a_start_without_fields_rests_at_the_origin():
    assert set(OpenLoopStart().model_dump().values()) == {0.0}
    rows = run_open_loop(
        scenario(start={}, inputs=[{"from_s": 0.0, "torque_l_Nmm": 0.0, "torque_r_Nmm": 0.0}])
    )
    assert not rows[:, 1:].any()


def test_the_floor_stands_still_and_has_its_whole_grip():
    """A robot that slides goes on as on a floor that is given."""
    start = random_start(np.random.default_rng(0))
    motions = np.array(start).reshape(-1, 1, 1).copy()
    contacts = np.zeros((len(Contact._fields), 1, 1))
    torques = np.tile([9000.0, -4000.0], (20, 1))
    advance_open_loop(
        body_array([RobotParameters()]), motions, contacts, torques, np.zeros(3), DT_S
    )
    other = run(start=start, seconds=0.02, torques_Nmm=(9.0, -4.0), floor=(0.0, 0.0, 1.0, 1.0, 1.0))
    assert np.array_equal(motions[:, 0, 0], np.array(other.motion)[:, -1])
    assert np.array_equal(contacts[:, 0, 0], np.array(other.contact)[:, -1])
