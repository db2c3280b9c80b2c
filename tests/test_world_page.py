"""The page on the world says what the code does: its tables, presets, snippets and numbers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

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
