"""The page on a scenario's fields says what the models and the options of ``reset`` are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import BaseModel, Field

from tlf_env.common.models import Frozen
from tlf_env.task import scenario_table
from tlf_env.task.reward import DEFAULT_WEIGHTS
from tlf_env.task.scenario import Scenario, load_scenario, scenario_with
from tlf_env.task.scenario_table import (
    BY_NAME,
    GROUPS,
    MEANINGS,
    PLACES,
    PLACES_OF_FIELDS,
    RESET_OPTIONS,
    SECTIONS,
    bounds,
    compact,
    default_text,
    described,
    page,
    scenario_models,
)
from tlf_env.task.start import OPTIONS, start_options

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
TITLES = re.findall(r"^## (.*)$", PAGE, re.M)
TITLE_OF = {one.model.__name__: one.title for one in SECTIONS}


def rows(title):
    """The rows of a section, by the field: type and range, unit, default, meaning, place."""
    text = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("| `")]
    cells = [re.split(r" (?<!\\)\| ", line.removeprefix("| ").removesuffix(" |")) for line in lines]
    assert all(len(one) == 6 for one in cells)
    assert len({one[0] for one in cells}) == len(cells)
    return {name.strip("`"): others for name, *others in cells}


def rows_of(model):
    """The rows of a model; those of the scenario are in several sections."""
    if model is Scenario:
        return {name: row for title in GROUPS for name, row in rows(title).items()}
    return rows(TITLE_OF[model.__name__])


def parsed(text):
    """The value that a default's cell stands for."""
    if text.startswith("["):
        inner = text[1:-1]
        return tuple(parsed(one) for one in inner.split(", ")) if inner else ()
    if text.startswith("`"):
        return text.strip("`")
    words = {"null": None, "true": True, "false": False}
    return words[text] if text in words else float(text)


def models_in_schema(schema):
    """Names of the models that a part of a JSON schema refers to."""
    return set(re.findall(r"'#/\$defs/(\w+)'", str(schema)))


def test_the_committed_page_is_what_the_code_says():
    assert page() == PAGE


def test_every_field_of_every_nested_model_has_its_row():
    for model in scenario_models():
        assert list(rows_of(model)) == (
            [name for names in GROUPS.values() for name in names]
            if model is Scenario
            else list(MEANINGS[model.__name__])
        )
        assert set(rows_of(model)) == set(model.model_fields)


def test_the_models_are_those_of_the_json_schema():
    """Pydantic's own walk finds the same models, but for the subtrees of world and disturbance."""
    whole = Scenario.model_json_schema(mode="validation")
    apart = ("world", "disturbance")
    own = {name: one for name, one in whole["properties"].items() if name not in apart}
    found, waiting = {"Scenario"}, models_in_schema(own)
    while waiting:
        found |= waiting
        waiting = models_in_schema([whole["$defs"][name] for name in waiting]) - found
    assert found == {model.__name__ for model in scenario_models()}


@pytest.mark.parametrize(
    ("title", "name", "allowed", "unit", "default"),
    [
        ("Task", "time_gap_s", "number > 0", "s", "5"),
        ("Task", "start_ramp_s", "number 0 to 1e9", "s", "0"),
        (
            "Plant and robots",
            "robots",
            "whole number 1 to 1000, or list of 1 to 1000 map",
            "1",
            "3",
        ),
        (
            "Plant and robots",
            "plant",
            "one of `pymunk`, `batch`, `kinematic`, `chipmunk`",
            "–",
            "`pymunk`",
        ),
        ("On board", "broadcast_smoothing_s", "number ≥ 0 or null", "s", "null"),
        ("Action", "action_range", "pair of numbers > 0 or null", "mm/s, rad/s", "null"),
        ("Observation", "preview_s", "list of numbers ≥ 0", "s", "[0.5, 1]"),
        ("End", "end_on", "list of `lost`, `touched`", "–", "[`lost`, `touched`]"),
        ("Reward", "cooperative", "true or false", "–", "false"),
        ("Robot", "drive_load_share", "number > 0, ≤ 0.5", "1", "0.4"),
        ("Robot", "castor_load_share", "number ≥ 0, < 1", "1", "0.2"),
        ("Robot", "wheel_inertia_kg_mm2", "number 1e-6 to 1e15", "kg·mm²", "52.91"),
        ("Robot", "gravity_mm_s2", "number 0.001 to 1e7", "mm/s²", "9807"),
        ("Robot", "torque_limit_Nmm", "number 1e-6 to 1e9", "N·mm", "15"),
        (
            "Robot",
            "outline_polygon_mm",
            "list of 3 to 100 pairs of numbers −1e6 to 1e6 or null",
            "mm",
            "null",
        ),
        ("Tyre", "mu_static", "number 0 to 1e6", "1", "0.073"),
        ("Joints", "pin_radius_mm", "number 0 to 1e6", "mm", "8 / 3.025 / 2.5"),
        ("Wheel loop", "gain_Nmm_s", "number > 0", "N·mm/(rad/s)", "150"),
        ("Wheel loop", "speed_observer_rad_s", "number > 0, ≤ 10000, or null", "rad/s", "null"),
        ("Filter ekf", "alpha_3", "number ≥ 0", "rad/mm", "0.01"),
        ("Filter ekf_slip", "heading_noise_rad2_s", "number ≥ 0", "rad²/s", "9e-6"),
        ("Filter ekf_slip", "delta_1_walk_mm2_s3", "number ≥ 0", "mm²/s³", "440"),
        ("Filter ekf_slip", "yaw_grip_rad_s2", "number ≥ 0", "rad/s²", "5"),
        ("Filter ekf_gyro", "gyro_walk_rad2_s3", "number ≥ 0", "rad²/s³", "1e-5"),
        ("Filter ekf_gyro", "forward_noise_mm2_s", "number ≥ 0", "mm²/s", "1"),
        ("Filter ekf_gyro", "fix_variance_mm2", "number > 0", "mm²", "0.2"),
        ("Observer", "gain_per_s", "number > 0", "1/s", "3"),
        ("Limits", "cancel_slip", "true or false", "–", "false"),
        ("Rays", "count", "whole number 1 to 360", "1", "16"),
        ("Neighbour", "range_mm", "number > 0, ≤ 5000", "mm", "2000"),
        ("Lissajous", "phase_x_rad", "number −1e9 to 1e9", "rad", "0"),
        ("Waypoints", "points", "list of triples of numbers", "s, mm, mm", "[]"),
        ("Stop and go", "ramp_s", "number 1e-6 to 1e9", "s", "2"),
        ("Reward terms", "action_change", "number", "1", "-0.02"),
    ],
)
def test_units_ranges_and_defaults_are_as_written_here(title, name, allowed, unit, default):
    words, *others = rows(title)[name][:3]
    assert words.startswith(allowed)
    assert len(words) == len(allowed) or name == "robots"
    assert others == [unit, default]


@pytest.mark.parametrize(
    ("path", "good", "bad"),
    [
        ("robot.outline_restitution", 1.0, 1.0 + 1e-9),
        ("neighbour.range_mm", 5000.0, 5000.0 + 1e-9),
        ("wheel_loop.speed_observer_rad_s", 10000.0, 10000.1),
        ("rays.count", 360, 361),
        ("limiter.limits.reverse_mm_s", 0.0, -1e-9),
        ("broadcast_smoothing_s", 0.0, -0.02),
    ],
)
def test_the_ends_of_ranges_are_those_that_are_checked(path, good, bad):
    scenario_with("infinity", {}, settings={path: good})
    with pytest.raises(ValueError, match=path.rpartition(".")[2]):
        scenario_with("infinity", {}, settings={path: bad})


def test_the_defaults_on_the_page_are_those_of_the_models():
    for model in scenario_models():
        given = next((one.given for one in SECTIONS if one.model is model), ())
        for name, (_, _, text, _, _) in rows_of(model).items():
            field = model.model_fields[name]
            if given:
                values = tuple(getattr(one, name) for one in given)
                shown = tuple(map(parsed, text.split(" / ")))
                assert shown in (values, values[:1]), (model, name)
                assert len(shown) == len(values) or len(set(values)) == 1, (model, name)
            elif field.is_required():
                assert text == "required", (model, name)
            elif text in ("see below", "empty", "nominal"):
                default = field.get_default(call_default_factory=True)
                assert isinstance(default, BaseModel | dict), (model, name)
            else:
                default = field.get_default(call_default_factory=True)
                assert parsed(text) == default, (model, name)
                assert (default is None) == (text == "null"), (model, name)


def test_default_world_and_disturbance_are_what_their_words_say():
    scenario = load_scenario("infinity")
    assert rows("Plant and robots")["world"][2] == "empty"
    assert not any(scenario.world.model_dump().values())
    assert rows("Disturbance")["disturbance"][2] == "nominal"
    same = {"name": "custom"}
    nominal = load_scenario("infinity", disturbance="nominal").disturbance
    default = Scenario.model_fields["disturbance"].default
    assert nominal.model_copy(update=same) == default


def test_the_weights_are_those_of_the_reward():
    assert {
        name: float(row[2]) for name, row in rows("Reward terms").items()
    } == DEFAULT_WEIGHTS._asdict()


def test_a_missing_meaning_and_a_superfluous_one_are_refused():
    observer = MEANINGS["ObserverParameters"]
    fewer = {"gain_per_s": observer["gain_per_s"]}
    with pytest.raises(ValueError, match=r"ObserverParameters: missing \['smoothing_s'\]"):
        page(MEANINGS | {"ObserverParameters": fewer})
    more = observer | {"gain_per_h": "no field"}
    with pytest.raises(ValueError, match=r"ObserverParameters: .*superfluous \['gain_per_h'\]"):
        page(MEANINGS | {"ObserverParameters": more})
    with pytest.raises(
        ValueError, match=r"meanings of models: missing \[\], superfluous \['Wing'\]"
    ):
        page(MEANINGS | {"Wing": {}})
    without = {name: meanings for name, meanings in MEANINGS.items() if name != "Rays"}
    with pytest.raises(ValueError, match=r"meanings of models: missing \['Rays'\]"):
        page(without)


def test_a_field_without_group_or_place_and_a_model_without_section_are_refused(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(GROUPS, "End", ("end_on",))
        with pytest.raises(ValueError, match=r"groups of Scenario: missing \['lost_beyond_mm'\]"):
            page()
    with monkeypatch.context() as patch:
        patch.delitem(PLACES_OF_FIELDS["Scenario"], "dtype")
        with pytest.raises(ValueError, match=r"places of Scenario: missing \['dtype'\]"):
            page()
    with monkeypatch.context() as patch:
        patch.setattr(scenario_table, "SECTIONS", SECTIONS[1:])
        with pytest.raises(ValueError, match=r"sections of models: missing \['RobotParameters'\]"):
            page()
    with monkeypatch.context() as patch:
        patch.setattr(scenario_table, "OPTIONS", (*OPTIONS, "speed_mm_s"))
        with pytest.raises(ValueError, match=r"options of reset: missing \['speed_mm_s'\]"):
            page()


def test_every_meaning_says_something_and_ends_like_the_others():
    for name, meanings in MEANINGS.items():
        for field, meaning in meanings.items():
            assert meaning.strip() == meaning, (name, field)
            assert not meaning.endswith("."), (name, field)
            assert "\n" not in meaning, (name, field)
            assert meaning != field.replace("_", " "), (name, field)


def test_every_place_is_a_room_or_a_file():
    places = {row[4] for title in TITLES for row in rows(title).values()}
    assert len(places) > 20
    for place in places:
        assert (ROOT / "tlf_env" / place.strip("`")).exists(), place
    assert set(PLACES) | set(PLACES_OF_FIELDS) == set(MEANINGS)


def test_every_option_of_reset_is_on_the_page_with_its_bound():
    options = rows("Options of reset")
    assert tuple(options) == OPTIONS == tuple(RESET_OPTIONS)
    assert options["poses"][:2] == [
        "a row of 3 numbers for each robot, each within ±1e10",
        "mm, mm, rad",
    ]
    assert options["phase_s"][:3] == ["number within ±1e9", "s", "0"]
    start_options({"poses": [[1e10, 0.0, 0.0]], "phase_s": -1e9}, 1)
    for name, value in {"poses": [[1.1e10, 0.0, 0.0]], "phase_s": -1.1e9}.items():
        with pytest.raises(ValueError, match=f"reset option {name}"):
            start_options({name: value}, 1)
    each = start_options({"poses": [[[0.0] * 3]] * 2, "phase_s": [1.0, 2.0]}, 1, formations=2)
    assert each.poses.shape == (2, 1, 3)
    assert list(each.phases_s) == [1.0, 2.0]


def test_fields_that_a_name_may_stand_for_are_those_that_read_one():
    """Validators that run before a field's own, except that of the reward, which completes weights."""
    found = {
        field
        for one in Scenario.__pydantic_decorators__.field_validators.values()
        if one.info.mode == "before"
        for field in one.info.fields
    }
    assert found - {"reward"} == set(BY_NAME)
    for name in BY_NAME:
        assert rows_of(Scenario)[name][0].startswith("preset, file or mapping")
        with pytest.raises(ValueError, match="no-such-preset"):
            load_scenario("infinity", **{name: "no-such-preset"})


def test_what_the_introduction_says_holds():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(code.replace("tlf_env.parallel_env", "tlf_env.load_scenario"), names)
    scenario = names["env"]
    assert (scenario.robot_count, scenario.robot.mass_kg) == (5, 1.5)
    assert scenario.disturbance.name == "slip"
    pairs = dict(one.split("=") for one in re.findall(r"--set (\S+=[\d.]+)", PAGE))
    assert len(pairs) == 2
    set_by_path = scenario_with(
        "infinity", {}, settings={path: float(value) for path, value in pairs.items()}
    )
    assert set_by_path.robot.mass_kg == 1.5
    assert set_by_path.disturbance.constant("slip.delta_1_mm_s") == 20.0
    with pytest.raises(ValueError, match=r"robot\.mas_kg: unknown key; did you mean 'mass_kg'"):
        load_scenario("infinity", robot={"mas_kg": 1.0})
    with pytest.raises(ValueError, match="trajectory"):
        load_scenario({"robots": 2})
    assert load_scenario({"base": "infinity", "robots": 2}).trajectory == scenario.trajectory


def test_links_lead_to_files_and_headings():
    def anchors(text):
        titles = re.findall(r"^#+ (.*)$", text, re.M)
        return {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}

    links = re.findall(r"(?<!!)\[[^\]]*\]\(([^)]*)\)", PAGE)
    assert len(links) > 40
    for target in links:
        path, _, anchor = target.partition("#")
        text = (ROOT / "docs" / path).read_text(encoding="utf-8") if path else PAGE
        assert not anchor or anchor in anchors(text), target


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.5, "0.5"),
        (1e9, "1e9"),
        (9e-6, "9e-6"),
        (1234567.25, "1234567.25"),
        (-1e10, "-1e10"),
        (1, "1"),
        (1e-10, "1e-10"),
    ],
)
def test_numbers_are_short_and_exact(value, text):
    assert compact(value) == text
    assert float(text) == value


def test_the_narrower_of_two_bounds_counts():
    both = [Field(gt=0).metadata[0], Field(ge=1e-6).metadata[0], Field(le=5).metadata[0]]
    assert bounds(both) == {"ge": 1e-6, "le": 5}
    assert bounds([*both, Field(gt=2).metadata[0], Field(lt=5).metadata[0]]) == {"gt": 2, "lt": 5}
    assert bounds([Field(gt=0).metadata[0], Field(ge=0).metadata[0]]) == {"gt": 0}


def test_an_unknown_kind_of_value_is_refused():
    with pytest.raises(ValueError, match="complex"):
        described(complex)


def test_a_default_of_a_model_is_in_its_own_table():
    class Empty(Frozen):
        """A model without fields."""

    assert default_text(Empty()) == "see below"
