"""What a user gives as a world: a preset's name, a file or a mapping, and one clear line for what is wrong."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from baselines import cli
from tlf_env.common.presets import preset_names, yaml_text
from tlf_env.physics.world import World
from tlf_env.task.feasibility import largest_push
from tlf_env.task.scenario import load_scenario, scenario_warnings

CIRCLE = {"type": "circle", "radius_mm": 10.0}
PATH = [[0.0, 0.0], [100.0, 0.0]]
THREE = [[0.0, 0.0], [10.0, 0.0], [5.0, 8.0]]


def wall(**fields):
    return {"walls": [{"points_mm": PATH} | fields]}


def obstacle(**fields):
    return {"obstacles": [{"shape": CIRCLE, "x_mm": 0.0, "y_mm": 0.0} | fields]}


def polygon(*points):
    return obstacle(shape={"type": "polygon", "points_mm": [list(point) for point in points]})


def pushable(**fields):
    given = {"shape": CIRCLE, "x_mm": 0.0, "y_mm": 0.0, "mass_kg": 1.0} | fields
    return {"pushables": [{key: value for key, value in given.items() if value is not None}]}


def moving(**fields):
    return {"moving": [{"shape": CIRCLE, "points_mm": PATH, "speed_mm_s": 10.0} | fields]}


WRONG = {
    "a preset that does not exist": ("corridr", "did you mean 'corridor'?"),
    "a list": ([1], "world: Input should be a mapping"),
    "a number": (3, "world: Input should be a mapping, got 3"),
    "an unknown part": ({"wals": []}, "world.wals: unknown key; did you mean 'walls'?"),
    "one wall and not a list": (
        {"walls": {"points_mm": PATH}},
        "world.walls: Input should be a list",
    ),
    "an unknown field": (
        wall(thicknes_mm=3.0),
        "thicknes_mm: unknown key; did you mean 'thickness_mm'",
    ),
    "a wall with one point": (
        wall(points_mm=[[0, 0]]),
        "world.walls.0.points_mm: must have at least 2 entries, got 1",
    ),
    "a wall without length": (wall(points_mm=[[1, 1], [1, 1]]), "must not all be the same point"),
    "a point with three coordinates": (
        wall(points_mm=[[0, 0], [1, 2, 3]]),
        "points_mm.1: must have at most 2 entries, got 3",
    ),
    "a text in a point": (
        wall(points_mm=[["a", 0], [1, 1]]),
        "points_mm.0.0: Input should be a number, got 'a'",
    ),
    "no number": (
        wall(points_mm=[[0, math.nan], [1, 1]]),
        "points_mm.0.1: Input should be a finite number, got nan",
    ),
    "a place too far away": (
        wall(points_mm=[[0, 0], [1e14, 1]]),
        "points_mm.1.0: Input should be less than or equal to 10000000000, got 100000000000000",
    ),
    "a negative thickness": (
        wall(thickness_mm=-1.0),
        "thickness_mm: Input should be greater than or equal to 0, got -1",
    ),
    "more than all speed back": (
        wall(restitution=2.0),
        "restitution: Input should be less than or equal to 1, got 2",
    ),
    "a negative friction": (
        wall(friction=-1.0),
        "friction: Input should be greater than or equal to 0, got -1",
    ),
    "a switch as a text": (
        wall(closed="true"),
        "closed: Input should be True or False, got 'true'",
    ),
    "no shape": ({"obstacles": [{"x_mm": 0, "y_mm": 0}]}, "obstacles.0.shape: Field required"),
    "a shape's name": (
        obstacle(shape="circle"),
        "obstacles.0.shape: Input should be a mapping, got 'circle'",
    ),
    "an unknown shape": (
        obstacle(shape={"type": "bocks"}),
        "type must be one of circle, box, polygon, got 'bocks'",
    ),
    "a shape without a type": (
        obstacle(shape={"radius_mm": 3.0}),
        "obstacles.0.shape: the key 'type' is missing",
    ),
    "a circle without a radius": (
        obstacle(shape={"type": "circle", "radius_mm": 0}),
        "obstacles.0.shape.radius_mm: Input should be greater than 0, got 0",
    ),
    "a mass that cannot move": (
        obstacle(mass_kg=3.0),
        "obstacles.0.mass_kg: unknown key; allowed: restitution",
    ),
    "a hollow polygon": (polygon((0, 0), (10, 0), (5, 2), (5, 10)), "a convex polygon, in order"),
    "corners out of order": (
        polygon((0, 0), (10, 10), (10, 0), (0, 10)),
        "a convex polygon, in order",
    ),
    "corners on a line": (polygon((0, 0), (1, 1), (3, 3)), "a convex polygon, in order"),
    "corners on a line, rounded": (
        polygon((0, 0), (0.1, 0.3), (0.3, 0.9)),
        "a convex polygon, in order",
    ),
    "a corner twice": (polygon((0, 0), (0, 0), (10, 0), (5, 8)), "a convex polygon, in order"),
    "two corners": (
        polygon((0, 0), (1, 1)),
        "shape.points_mm: must have at least 3 entries, got 2",
    ),
    "no mass": (pushable(mass_kg=None), "pushables.0.mass_kg: Field required"),
    "a negative mass": (pushable(mass_kg=-1.0), "mass_kg: Input should be greater than 0, got -1"),
    "a mass of 0": (pushable(mass_kg=0.0), "mass_kg: Input should be greater than 0, got 0"),
    "a mass without an inverse": (
        pushable(mass_kg=1e-10),
        "mass_kg: Input should be greater than or equal to 0.000001",
    ),
    "an inertia of 0": (
        pushable(inertia_kg_mm2=0),
        "inertia_kg_mm2: Input should be greater than 0, got 0",
    ),
    "a centre of mass outside": (
        pushable(shape={"type": "polygon", "points_mm": [[100, 0], [110, 0], [105, 10]]}),
        "world.pushables.0: shape.points_mm ((100.0, 0.0), (110.0, 0.0), (105.0, 10.0)) must contain "
        "(0, 0), the centre of mass",
    ),
    "an obstacle that stands": (
        moving(speed_mm_s=0),
        "speed_mm_s: Input should be greater than 0, got 0",
    ),
    "an obstacle too fast": (
        moving(speed_mm_s=1e9),
        "speed_mm_s: Input should be less than or equal to 100000",
    ),
    "a path of one place": (
        moving(points_mm=[[5, 5], [5, 5]]),
        "world.moving.0: points_mm ((5.0, 5.0), (5.0, 5.0)) must not all be the same point",
    ),
    "a pause without an end": (
        moving(closed=True, pause_s=1.0),
        "pause_s 1.0 needs a path with ends",
    ),
    "a patch without a size": (
        {"patches": [{"x_mm": 0, "y_mm": 0, "radius_mm": 0, "friction_scale": 1}]},
        "patches.0.radius_mm: Input should be greater than 0, got 0",
    ),
    "too many walls": (
        {"walls": [{"points_mm": PATH}] * 1001},
        "world.walls: must have at most 1000 entries, got 1001",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_world_gets_one_line_that_names_it(name):
    given, said = WRONG[name]
    with pytest.raises(ValueError, match=r"^world") as caught:
        load_scenario("infinity", world=given)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "a wall with one point",
        "a negative mass",
        "a hollow polygon",
        "a preset that does not exist",
    ],
)
def test_a_file_and_the_command_line_say_the_same(name, tmp_path, monkeypatch, capsys):
    given, said = WRONG[name]
    base = load_scenario("infinity").model_dump(mode="json", exclude={"world"})
    path = tmp_path / "mine.yaml"
    path.write_text(yaml_text(base | {"world": given}), encoding="utf-8")
    with pytest.raises(ValueError, match=r"^world") as caught:
        load_scenario(path)
    assert said in str(caught.value)
    monkeypatch.setattr("sys.argv", ["tlf", "run", str(path)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == cli.BAD_INPUT
    printed = capsys.readouterr().err
    assert str(caught.value) in " ".join(printed.split())
    assert len(printed.splitlines()) == 1


def test_a_broken_world_file_is_named(tmp_path):
    path = tmp_path / "room.yaml"
    for text, said in (("walls: [", "is not YAML"), ("- 1", "must contain a mapping, got list")):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=said) as caught:
            load_scenario("infinity", world=str(path))
        assert "room.yaml" in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"cannot read .*nowhere.yaml"):
        load_scenario("infinity", world=tmp_path / "nowhere.yaml")


def test_a_world_file_may_lie_beside_the_scenario_or_in_the_working_directory(
    tmp_path, monkeypatch
):
    folder, elsewhere = tmp_path / "mine", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    thick, thin = (World(**wall(thickness_mm=mm)) for mm in (50.0, 5.0))
    for place, world in ((folder, thick), (elsewhere, thin)):
        text = yaml_text(world.model_dump(mode="json"))
        (place / "room.yaml").write_text(text, encoding="utf-8")
    (folder / "task.yaml").write_text(
        "trajectory: {type: circle, radius_mm: 900, speed_mm_s: 200}\nworld: room.yaml\n",
        encoding="utf-8",
    )
    monkeypatch.chdir(elsewhere)
    assert load_scenario(folder / "task.yaml").world == thick
    assert load_scenario(Path("..") / "mine" / "task.yaml").world == thick
    assert load_scenario("infinity", world="room.yaml").world == thin
    assert load_scenario("infinity", world=Path("room.yaml")).world == thin
    (folder / "room.yaml").unlink()
    assert load_scenario(folder / "task.yaml").world == thin


def test_preset_mapping_model_and_arrays_are_the_same_world():
    for name in preset_names("world"):
        world = load_scenario("infinity", world=name).world
        assert load_scenario("infinity", world=world).world == world
        assert load_scenario("infinity", world=world.model_dump(mode="json")).world == world
    array = load_scenario("infinity", world=wall(points_mm=np.array(PATH))).world
    assert array == World(**wall())
    assert load_scenario("infinity").world == World()


def test_a_polygon_contains_its_centre_of_mass_only_inside():
    around = [[x - 5.0, y - 3.0] for x, y in THREE]
    for points in (around, around[::-1]):
        load_scenario("infinity", world=pushable(shape={"type": "polygon", "points_mm": points}))
    with pytest.raises(ValueError, match="must contain"):
        load_scenario("infinity", world=pushable(shape={"type": "polygon", "points_mm": THREE}))


def test_a_body_that_all_robots_together_cannot_push_is_named():
    scenario = load_scenario("infinity", robots=3)
    push = 3 * largest_push(scenario.robot)  # N
    assert push == pytest.approx(3 * 0.407, rel=0.01)
    held = push / (0.1 * scenario.robot.gravity_mm_s2 / 1000.0)  # kg
    for share, lines in ((0.99, 0), (1.01, 1)):
        world = pushable(mass_kg=share * held, floor_friction=0.1)
        found = scenario_warnings(load_scenario(scenario, world=world))
        assert (
            len([line for line in found if "world.pushables[0] holds to the floor" in line])
            == lines
        )
    world = pushable(mass_kg=1.0, floor_friction=0.5)
    found = scenario_warnings(load_scenario(scenario, world=world))
    assert any("with 4.9 N" in line and "push with 1.22 N" in line for line in found)
    for name in preset_names():
        assert not [line for line in scenario_warnings(load_scenario(name)) if "pushables" in line]
