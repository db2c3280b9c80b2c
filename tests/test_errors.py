"""Error messages: every unknown key is named with its path, and numbers are numbers everywhere."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from fractions import Fraction
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

import tlf_env
from baselines.benchmark.plan import read_plan
from baselines.policies.card import Card
from baselines.policies.learned import SHIPPED
from baselines.training.config import TrainConfig, load_config
from baselines.tuning.config import TuneConfig
from tlf_env.common.errors import nearest, one_line, shown
from tlf_env.common.presets import preset_names, read_preset_or_file
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.onboard.controllers import ControllerFile, load_controller
from tlf_env.physics.openloop import OpenLoopScenario
from tlf_env.task.scenario import OTHER_NAMES, Scenario, load_scenario


class Unprintable:
    """An object that cannot be printed."""

    def __repr__(self) -> str:
        raise RuntimeError("no")


FREE = {"settings", "found", "scores", "training", "versions", "entries", "seeds", "disturbances"}

SIGNALS = (
    {"type": "constant", "value": 1.0},
    {"type": "step", "value": 1.0, "at_s": 2.0, "before": 0.5},
    {"type": "impulse", "value": 1.0, "at_s": 2.0, "duration_s": 1.0, "rest": 0.0},
    {"type": "sine", "amplitude": 1.0, "frequency_hz": 1.0, "mean": 0.0},
    {"type": "uniform", "low": 0.0, "high": 1.0, "every_s": 1.0},
    {"type": "gaussian", "std": 1.0, "mean": 0.0, "every_s": 1.0},
    {"type": "ornstein_uhlenbeck", "std": 1.0, "time_constant_s": 1.0, "mean": 0.0},
)


@cache
def examples() -> dict[str, tuple[Any, Any]]:
    """Valid data of every model that is read from a file or a mapping, with its type."""
    found: dict[str, tuple[Any, Any]] = {}
    for name in preset_names():
        found[name] = Scenario, load_scenario(name).model_dump(mode="json")
    circle = {"type": "circle", "radius_mm": 1000.0, "speed_mm_s": 100.0}
    for number, signal in enumerate(SIGNALS):
        found[f"signal {signal['type']}"] = (
            Scenario,
            load_scenario(
                {"trajectory": circle, "robots": [{}, {"mass_kg": 1.3}], "preview_s": [0.5]},
                disturbance={
                    "slip": {"delta_1_mm_s": signal},
                    "tyre": {
                        "patches": [
                            {"x_mm": 1, "y_mm": 2, "radius_mm": 9 + number, "friction_scale": 1}
                        ]
                    },
                },
            ).model_dump(mode="json"),
        )
    limits = dict.fromkeys(("acceleration_mm_s2", "reverse_mm_s", "forward_error_mm"), 100.0)
    for name in preset_names("controller"):
        file = load_controller(name).model_dump(mode="json")
        file["controller"]["limits"] |= limits
        file["controller"]["spacing"] = {"distance_mm": 300.0}
        found[f"controller {name}"] = ControllerFile, file
    training = load_config("residual").model_dump(mode="json")
    training |= {"tasks": {"circle": {}}, "disturbances": {"slip": 1.0}, "levels": [1.0]}
    training["evaluation"]["disturbances"] = ["slip"]
    found["training"] = TrainConfig, training
    search = read_preset_or_file("search", "tuned")
    found["search"] = TuneConfig, search | {"tasks": ["circle"], "disturbances": ["slip"]}
    card = next(iter(sorted(SHIPPED.glob("*.json"))))
    found["card"] = Card, json.loads(card.read_text(encoding="utf-8"))
    torque = {"torque_l_Nmm": 1.0, "torque_r_Nmm": 1.0, "from_s": 0.0}
    start = {"x_mm": 1.0, "theta_rad": 0.5}
    found["open loop"] = (
        dict[str, OpenLoopScenario],
        {"roll": {"duration_s": 1.0, "start": start, "inputs": [torque], "joint_friction": True}},
    )
    return found


def complaint(kind: Any, data: Any) -> str | None:
    """The message on invalid data, in one line; None for valid data."""
    try:
        if kind is Card:
            Card.model_validate_json(json.dumps(data), strict=True)
        else:
            TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        line = one_line(error, kind)
        assert line.isprintable()  # so it is one line
        assert line == line.strip()
        return line
    return None


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Paths to everything inside plain data, with the value there."""
    yield path, data
    if isinstance(data, dict):
        for key, value in data.items():
            if key not in FREE:
                yield from places(value, (*path, key))
    elif isinstance(data, list):
        for index, value in enumerate(data):
            yield from places(value, (*path, index))


def changed(data: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at a path."""
    out = copy.deepcopy(data)
    inner = out
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return out


MAPPINGS = [
    (name, path)
    for name, (_, data) in examples().items()
    for path, value in places(data)
    if isinstance(value, dict)
]
SPELLINGS = (
    "INT", "int", "str", "float", "Robot", "N", "literal[x]", "constrained-int", "tuple[x]", "[key]",
    "function-before", "circle", "RobotParameters", "nullable", "two words", "3", "größe", "type_",
)  # fmt: skip


@pytest.mark.parametrize("name", examples())
def test_the_examples_are_valid(name):
    assert complaint(*examples()[name]) is None


@pytest.mark.parametrize("key", SPELLINGS)
def test_an_unknown_key_is_named_with_its_path_at_every_depth(key):
    unnamed = []
    for name, path in MAPPINGS:
        kind, data = examples()[name]
        line = complaint(kind, changed(data, (*path, key), 1.0))
        whole = ".".join(map(str, (*path, key)))
        if line is None or whole not in line:
            unnamed.append((name, whole, line))
    # Reward terms, paths of a search and fields of a task have messages of their own, which name the key.
    own = ("reward", "search", "scenario", "tasks")
    odd = [
        (name, whole, line)
        for name, whole, line in unnamed
        if not (set(whole.split(".")) & set(own) and line is not None and key in line)
        and not (name == "card" and whole.startswith("scenario."))  # a record, read by no code
    ]
    assert odd == []


@given(key=st.text(min_size=1, max_size=40), data=st.data())
def test_any_unknown_key_is_named(key, data):
    name, path = data.draw(
        st.sampled_from([one for one in MAPPINGS if one[0] in ("infinity", "controller tuned")])
    )
    kind, valid = examples()[name]
    inside = valid
    for part in path:
        inside = inside[part]
    if key in inside or path == ("reward",):
        return
    line = complaint(kind, changed(valid, (*path, key), 1.0))
    assert line is not None
    printed = key if key.isprintable() and key == key.strip() else repr(key)
    assert ".".join(map(str, (*path, printed)))[:50].strip() in line or repr(printed) in line


@pytest.mark.parametrize("key", [" 0", "0 ", " ", "\u2003x", ""])
def test_a_key_with_blanks_at_its_ends_is_quoted(key):
    """Otherwise the message would not show what is wrong with it."""
    line = complaint(Scenario, {**load_scenario("circle").model_dump(), key: 3})
    assert line is not None
    assert line.startswith(f"{key!r}: unknown key")


@pytest.mark.parametrize(
    ("key", "meant"),
    [("robot_", "robot"), ("ROBOTS", "robots"), ("time_gap", "time_gap_s"), ("Reward", "reward")],
)
def test_the_nearest_key_is_suggested(key, meant):
    with pytest.raises(ValueError, match=f"{key}: unknown key; did you mean '{meant}'"):
        load_scenario({**load_scenario("circle").model_dump(), key: 3})


def test_few_keys_are_all_listed():
    assert nearest("zz", ["alpha", "beta"]) == "; allowed: alpha, beta"
    assert nearest("zz", [f"name_{i}" for i in range(20)]) == ""


@pytest.mark.parametrize("key", ["robtos", "Scenario", "int"])
def test_keys_of_the_parts_of_a_training_are_named(key):
    whole = read_preset_or_file("training", "quick")
    task = next(iter(whole["tasks"]))
    for change, place in (
        ({"scenario": {key: 3}}, f"scenario.{key}"),
        ({"scenario": {"robot": {key: 3}}}, f"scenario.robot.{key}"),
        ({"tasks": {task: {key: 3}}}, f"tasks.{task}.{key}"),
        ({"tasks": {task: {"robot": {"tyre": {key: 3}}}}}, f"tasks.{task}.robot.tyre.{key}"),
    ):
        with pytest.raises(ValueError, match=f"{place}: unknown key"):
            load_config({**whole, **change})


@pytest.mark.parametrize("place", ["scenario", "tasks"])
def test_a_training_has_its_disturbances_in_one_place(place):
    whole = read_preset_or_file("training", "quick")
    fields = {"disturbance": "slip"}
    change = {"scenario": fields} if place == "scenario" else {"tasks": {"infinity": fields}}
    with pytest.raises(ValueError, match=rf"{place}\S*disturbance must be left out"):
        load_config({**whole, **change})


def test_keys_of_a_plan_are_named(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text("Tasks: [infinity]\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"'Tasks'.*did you mean 'tasks'"):
        read_plan(str(path), ("tasks", "policies"))


# Keywords


def keyword_doors() -> dict[str, Any]:
    import gymnasium

    from tlf_env.envs.single import FormationEnv
    from tlf_env.envs.vector import FormationVectorEnv

    doors = {
        "load_scenario": lambda **given: load_scenario("infinity", **given),
        "parallel_env": lambda **given: tlf_env.parallel_env("infinity", **given),
        "aec_env": lambda **given: tlf_env.aec_env("infinity", **given),
        "FormationEnv": lambda **given: FormationEnv("infinity", **given),
        "gymnasium.make": lambda **given: gymnasium.make("tlf_env/Infinity-v0", **given),
        "make_vec": lambda **given: gymnasium.make_vec("tlf_env/Infinity-v0", 2, **given),
        "FormationVectorEnv": lambda **given: FormationVectorEnv("infinity", 2, **given),
        "BatchPlant": lambda **given: tlf_env.BatchPlant("infinity", 2, **given),
    }
    try:
        from baselines.sb3 import FormationVecEnv
    except ModuleNotFoundError:
        return doors
    return doors | {"FormationVecEnv": lambda **given: FormationVecEnv("infinity", 2, **given)}


DOORS = keyword_doors()


@pytest.mark.parametrize("name", ["N", "frameskip", "max_cycles", "robtos", "int", "wind"])
@pytest.mark.parametrize("door", DOORS)
def test_an_unknown_keyword_is_a_type_error_that_names_it(door, name):
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'") as caught:
        DOORS[door](**{name: 3})
    assert "\n" not in str(caught.value)
    assert OTHER_NAMES.get(name, "") in str(caught.value)


@pytest.mark.parametrize("door", DOORS)
def test_an_unknown_key_in_a_mapping_is_a_value_error(door):
    with pytest.raises(ValueError, match=r"robot\.wheels: unknown key"):
        DOORS[door](robot={"wheels": 4})


@pytest.mark.parametrize("name", OTHER_NAMES)
def test_names_of_other_libraries_have_a_hint(name):
    whole = load_scenario("circle").model_dump()
    with pytest.raises(ValueError, match=re.escape(f"{name}: unknown key; {OTHER_NAMES[name]}")):
        load_scenario({**whole, name: 3})


# Numbers


NUMBERS = [
    (name, path, value)
    for name, (kind, data) in examples().items()
    for path, value in places(data)
    if isinstance(value, int | float)
    and (kind is not Scenario or name == "infinity" or path[0] in ("trajectory", "disturbance"))
    and not isinstance(value, bool)
    and not (name == "card" and path[0] in ("scenario", "format_version"))
    and path[:1] != ("tasks",)
]
SWITCHES = [
    (name, path)
    for name, (_, data) in examples().items()
    for path, value in places(data)
    if isinstance(value, bool) and not (name == "card" and path[0] == "scenario")
]
assert len(NUMBERS) > 300
assert len(SWITCHES) > 20


@pytest.mark.parametrize("wrong", [True, False, "3", "0.5", "inf", np.bool_(True), np.array(3.0)])
def test_what_is_no_number_is_refused_wherever_a_number_is(wrong):
    accepted = []
    for name, path, _ in NUMBERS:
        kind, data = examples()[name]
        if kind is Card and not isinstance(wrong, bool | str):
            continue
        if complaint(kind, changed(data, path, wrong)) is None:
            accepted.append((name, path))
    assert accepted == []


@pytest.mark.parametrize("make", [np.float64, np.float32, np.int64, np.uint8, Fraction])
def test_numbers_of_other_kinds_are_taken_wherever_a_number_is(make):
    refused = []
    for name, path, value in NUMBERS:
        kind, data = examples()[name]
        other = np.array(value).astype(make) if make is not Fraction else Fraction(value)
        other = other[()] if make is not Fraction else other
        if kind is not Card and float(other) == value:
            line = complaint(kind, changed(data, path, other))
            if line is not None:
                refused.append((name, path, line))
    assert refused == []


@pytest.mark.parametrize("wrong", [1, 0, "yes", "on", "true", 1.0])
def test_what_is_no_switch_is_refused_wherever_a_switch_is(wrong):
    for name, path in SWITCHES:
        kind, data = examples()[name]
        line = complaint(kind, changed(data, path, wrong))
        assert line is not None, (name, path)
        assert repr(wrong) in line


def test_numpys_numbers_make_the_same_scenario():
    numpys = load_scenario(
        "infinity",
        robots=np.int64(2),
        horizon_s=np.float32(20.0),
        disturbance={
            "slip": {"delta_1_mm_s": np.float32(0.5), "delta_2_rad_s": np.int32(1)},
            "tyre": {"friction_scale": {"type": "uniform", "low": np.float16(0.5), "high": 1}},
        },
        disturbance_level=np.float32(0.5),
        reward={"fine": np.float32(2.0)},
    )
    plain = load_scenario(
        "infinity",
        robots=2,
        horizon_s=20.0,
        disturbance={
            "slip": {"delta_1_mm_s": 0.5, "delta_2_rad_s": 1},
            "tyre": {"friction_scale": {"type": "uniform", "low": 0.5, "high": 1}},
        },
        disturbance_level=0.5,
        reward={"fine": 2.0},
    )
    assert numpys == plain
    assert numpys.model_dump_json() == plain.model_dump_json()


@pytest.mark.parametrize("value", [np.array(3.0), "3", True, None, [1.0]])
def test_a_channel_that_is_no_number_and_no_signal_says_what_is_wanted(value):
    with pytest.raises(
        ValueError, match=r"slip\.delta_1_mm_s: Input should be a number or a signal"
    ):
        load_scenario("infinity", disturbance={"slip": {"delta_1_mm_s": value}})


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (
            {"disturbance": {"slip": {"delta_1_mm_s": {}}}},
            "delta_1_mm_s: the key 'type' is missing",
        ),
        ({"trajectory": {"radius_mm": 3.0}}, "trajectory: the key 'type' is missing"),
        ({"trajectory": 3}, "trajectory: Input should be a mapping, got 3"),
        ({"wheel_loop": 3}, "wheel_loop: Input should be a mapping, or a text, got 3"),
        ({"robots": "3"}, "robots: Input should be a whole number, or a list, got '3'"),
        ({"name": 3}, "name: Input should be a text, got 3"),
    ],
)
def test_what_is_wanted_is_said_in_words_of_the_files(fields, said):
    data = {**load_scenario("circle").model_dump(), **fields}
    with pytest.raises(ValueError, match=re.escape(said)):
        load_scenario(data)


@pytest.mark.parametrize(
    "value", [Unprintable(), 10**5000, "x" * 999, "two\nlines"], ids=["bad", "big", "long", "lines"]
)
def test_every_value_is_shown_in_one_short_line(value):
    text = shown(value)
    assert 0 < len(text) <= 60
    assert "\n" not in text


@pytest.mark.parametrize(
    "fields", [{"horizon_s": Unprintable()}, {"robots": Unprintable()}, {"dtype": Unprintable()}]
)
def test_an_object_that_cannot_be_printed_is_refused_with_its_type(fields):
    (key,) = fields
    with pytest.raises(ValueError, match=f"{key}: .*an object of the type Unprintable"):
        load_scenario("infinity", **fields)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"robots": []}, "robots: must have at least 1 entry, got 0"),
        ({"robots": [{}] * 1001}, "robots: must have at most 1000 entries, got 1001"),
        ({"robots": Fraction(10**400, 3)}, "robots: Input should be a whole number"),
        (
            {"trajectory": {"type": "circel"}},
            "trajectory: type must be one of lissajous, rose, circle, waypoints, stop_and_go, "
            "got 'circel'; did you mean 'circle'?",
        ),
        (
            {"disturbance": {"slip": {"delta_1_mm_s": {"type": "sin"}}}},
            "got 'sin'; did you mean 'sine'?",
        ),
        ({"disturbance": "slipp"}, "did you mean 'slip'?"),
        ({"reward": {"coars": 1.0}}, "did you mean 'coarse'?"),
    ],
)
def test_a_refusal_has_the_words_of_the_files_and_a_suggestion(fields, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        load_scenario("infinity", **fields)


def test_a_key_that_is_no_text_is_refused():
    with pytest.raises(ValueError, match=r"1: keys must be texts, got 1$"):
        load_scenario({**load_scenario("circle").model_dump(), 1: 2})
    with pytest.raises(ValueError, match="unknown term 5; the terms are"):
        load_scenario("infinity", reward={5: 1.0, "x": 1.0})


def test_a_misspelt_preset_is_suggested():
    with pytest.raises(ValueError, match="did you mean 'infinity'"):
        load_scenario("infinity2")


@pytest.mark.parametrize("name", ["threads", "zzz"])
def test_a_name_far_from_all_others_is_not_suggested(name):
    assert "did you mean" not in nearest(name, Scenario.model_fields)


@pytest.mark.parametrize("source", ["a\nb.yaml", "a\nb.csv", "a\nb"])
def test_a_path_of_two_lines_is_shown_in_one(source):
    with pytest.raises(ValueError, match=r"a\\nb") as caught:
        load_scenario(source)
    assert "\n" not in str(caught.value)


def test_very_many_errors_are_one_short_line_at_once():
    with pytest.raises(ValueError, match="more errors") as error:
        load_scenario("infinity", preview_s=[True] * 20_000)
    assert len(str(error.value)) < 2000
    assert str(error.value).endswith("and 19994 more errors")  # than the six that are shown


WIDE = np.full((3, 3), -1e308)  # printed in several lines
CONSTRUCTORS = {
    "parallel_env": (tlf_env.parallel_env, ("adversary", "render_mode", "infos")),
    "BatchPlant": (partial(tlf_env.BatchPlant, formations=2), ("trust", "precision")),
    "FormationEnv": (FormationEnv, ("learner", "others", "render_mode")),
    "FormationVectorEnv": (
        FormationVectorEnv,
        ("num_envs", "learner", "others", "render_mode", "autoreset_mode", "trust", "precision"),
    ),
}


@pytest.mark.parametrize(
    ("door", "name"), [(door, one) for door in CONSTRUCTORS for one in CONSTRUCTORS[door][1]]
)
@pytest.mark.parametrize("value", [WIDE, "a\nb"], ids=["array", "text"])
def test_an_argument_that_is_printed_in_several_lines_is_shown_in_one(door, name, value):
    with pytest.raises(ValueError, match=f"^{name} ") as caught:
        CONSTRUCTORS[door][0]("circle", **{name: value})
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("seed", [WIDE, "a\nb"], ids=["array", "text"])
def test_a_seed_that_is_printed_in_several_lines_is_shown_in_one(seed):
    env = tlf_env.parallel_env("circle")
    with pytest.raises(ValueError, match="seed") as caught:
        env.reset(seed=seed)
    assert len(str(caught.value).splitlines()) == 1


def test_a_part_of_a_plan_that_cannot_be_printed_is_quoted(tmp_path):
    path = tmp_path / "own.yaml"
    names = {"controllers": ["tuned"], "estimators": ["ekf"], "limiters": ["none"], "a\rb": ["c"]}
    path.write_text(json.dumps({"policies": names}))
    with pytest.raises(ValueError, match=r"policies\.'a\\rb' is \['c'\]") as caught:
        read_plan(str(path), ["policies"])
    assert len(str(caught.value).splitlines()) == 1
