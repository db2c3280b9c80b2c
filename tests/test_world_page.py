"""The page on the world says what the code does: its tables, presets, snippets and numbers."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pymunk
import pytest
import yaml

import tlf_env
from tlf_env.common.presets import preset_names
from tlf_env.physics.parameters import RobotParameters
from tlf_env.physics.world import Wall, World
from tlf_env.task.feasibility import largest_push
from tlf_env.task.scenario import load_scenario, scenario_warnings
from tlf_env.task.world_table import TABLES, allowed, renewed, table

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "world.md").read_text(encoding="utf-8")


def snippets(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


def test_the_committed_tables_are_what_the_code_says():
    assert renewed(PAGE) == PAGE
    with pytest.raises(ValueError, match="no <!-- walls -->"):
        renewed(PAGE.replace("<!-- walls -->\n", ""))


def test_every_field_of_a_world_has_its_row():
    for name, kind in World.model_fields.items():
        model = TABLES[name][0]
        assert model.__name__ in str(kind.annotation)
    model, meanings = TABLES["walls"]
    with pytest.raises(ValueError, match="Wall has the fields"):
        table(model, {key: text for key, text in meanings.items() if key != "closed"})
    outline = {name for name in RobotParameters.model_fields if name.startswith("outline_")}
    assert set(TABLES["robot"][1]) == outline


@pytest.mark.parametrize(
    ("name", "words"),
    [("thickness_mm", "≥ 0"), ("restitution", "0 to 1"), ("closed", "true, false")],
)
def test_bounds_are_those_that_are_checked(name, words):
    assert allowed(Wall.model_fields[name]) == words
    good = {"points_mm": [[0, 0], [1, 0]]}
    if name != "closed":
        with pytest.raises(ValueError, match=f"{name}\n"):
            Wall.model_validate(good | {name: -1e-9})


def test_the_yaml_snippet_is_a_world_without_warnings_about_its_fields():
    (text,) = snippets("yaml")
    scenario = load_scenario("infinity", **yaml.safe_load(text))
    world = scenario.world
    assert all(len(getattr(world, name)) == 1 for name in World.model_fields)
    assert not [line for line in scenario_warnings(scenario) if "pushables" in line]


def test_the_python_snippet_runs():
    (text,) = snippets("python")
    names: dict = {}
    exec(text, names)
    assert tuple(names["body"].position) == (0.0, 2500.0)
    env = names["env"]
    env.step(dict.fromkeys(env.agents, np.zeros(2)))
    assert tuple(names["body"].position) == (0.0, 2500.0)


def test_all_presets_are_listed_and_each_world_has_its_scenario():
    rows = re.findall(r"^\| `(\w+)` \|", PAGE.split("## Presets")[1].split("## Fields")[0], re.M)
    assert sorted(rows) == preset_names("world")
    for name in rows:
        assert load_scenario(name).world == load_scenario("infinity", world=name).world


def test_links_lead_to_files_and_headings():
    titles = re.findall(r"^#+ (.*)$", PAGE, re.M)
    anchors = {title.lower().replace(" ", "-").replace("'", "") for title in titles}
    for target in re.findall(r"(?<!!)\[[^\]]*\]\(([^)]*)\)", PAGE):
        path, _, anchor = target.partition("#")
        assert (ROOT / "docs" / path).exists() if path else anchor in anchors, target


def test_the_numbers_of_a_push_are_those_of_the_model():
    push = largest_push(RobotParameters())
    assert f"{push:.2f} N at a steady speed" in PAGE
    gravity = RobotParameters().gravity_mm_s2 / 1000.0
    light, heavy = re.search(
        r"push\n?([\d.]+) kg.*?or ([\d.]+) kg", PAGE.replace("push\n", "push")
    ).groups()
    assert float(light) == pytest.approx(push / (0.3 * gravity), abs=0.005)
    assert float(heavy) == pytest.approx(push / (0.01 * gravity), rel=0.05)


def test_the_costs_are_measured_as_the_page_says(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "figures")
    make_world = importlib.import_module("make_world")
    monkeypatch.setattr(make_world, "ROUNDS", 1)
    monkeypatch.setattr(make_world, "STEPS", 3)
    measured, printed = (
        re.findall(r"^\| ([^|]*) \|[ \d.]*\|[ \d.]*\|$", text, re.M)
        for text in (make_world.table(), PAGE)
    )
    assert measured == printed == list(make_world.CASES)
    # The cases are what their names say.
    pushing = make_world.driver(make_world.CASES["the leader pushes a box"])
    make_world.timed(pushing)
    assert pushing.pushable_bodies[0].velocity.y > 50.0


# What docs/environment.md says about objects in the space


def at_origin():
    """One robot at the origin, towards +y."""
    env = tlf_env.parallel_env(robots=1, disturbance="none", end_on=())
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    return env


def stepped(env, steps, speed=0.0):
    """The last info after some steps."""
    for _ in range(steps):
        *_, infos = env.step({"robot_0": np.array([speed / 1000.0, 0.0])})
    return infos["robot_0"]


def test_a_force_acts_through_one_control_step_and_is_then_gone():
    """Against the rolling robot: the momentum it takes is force times the step, while the wheels coast."""
    env = tlf_env.parallel_env(
        robots=1, disturbance="none", end_on=(), action="torque", robot={"joint_friction": False}
    )
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    body = env.robot_bodies["robot_0"]
    body.apply_force_at_world_point((0.0, 300.0), body.position)
    places = [stepped(env, 1)["y_mm"] for _ in range(3)]
    assert body.force == (0.0, 0.0)
    robot, dt = env.scenario.robot, env.scenario.control_period_s
    mass = (
        robot.mass_kg
        + 2 * robot.wheel_inertia_kg_mm2 / robot.wheel_radius_mm**2
        + robot.castor_inertia_kg_mm2 / robot.castor_radius_mm**2
    )
    speeds = np.diff(places) / dt
    assert speeds == pytest.approx(300.0 * dt / mass, rel=0.03)


def test_a_place_written_to_a_robots_body_has_no_effect():
    env, other = at_origin(), at_origin()
    env.robot_bodies["robot_0"].position = (500.0, 500.0)
    env.robot_bodies["robot_0"].velocity = (500.0, 500.0)
    assert env.robot_bodies["robot_0"].position == other.robot_bodies["robot_0"].position
    assert stepped(env, 20, 100.0) == stepped(other, 20, 100.0)


def test_a_static_shape_moved_by_hand_is_noticed_when_the_space_is_read():
    env = at_origin()
    space = env.space
    wall = pymunk.Segment(space.static_body, (-500.0, 9000.0), (500.0, 9000.0), 5.0)
    space.add(wall)
    assert stepped(env, 50, 300.0)["touched_by"] == tlf_env.TouchedBy.NOTHING
    y_mm = stepped(env, 1, 300.0)["y_mm"] + 120.0
    wall.unsafe_set_endpoints((-500.0, y_mm), (500.0, y_mm))
    space.reindex_shape(wall)
    assert env.space is space
    info = stepped(env, 50, 300.0)
    assert info["touched_by"] == tlf_env.TouchedBy.WALL
    assert info["y_mm"] < y_mm


def test_new_shapes_have_no_friction_and_no_restitution():
    shape = pymunk.Circle(pymunk.Body(1.0, 1.0), 1.0)
    assert (shape.friction, shape.elasticity) == (0.0, 0.0)
