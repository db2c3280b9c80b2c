"""The hash of a scenario: what counts, what does not, and that it stays the same when fields are added."""

import itertools
import json
import typing
from pathlib import Path
from typing import Any, Literal

import pytest
from pydantic import BaseModel, create_model

from tlf_env.common.models import NonNegative, Positive
from tlf_env.common.presets import preset_names
from tlf_env.disturbances import channels
from tlf_env.disturbances.channels import CHANNELS, PATHS, Channel
from tlf_env.disturbances.model import Disturbance, SlipChannels
from tlf_env.disturbances.signals import Constant
from tlf_env.physics.parameters import JointFriction, RobotParameters
from tlf_env.task import neutral
from tlf_env.task.neutral import ALWAYS, NEUTRAL, difference, neutral_values, scenario_hash
from tlf_env.task.scenario import Scenario, load_scenario

GOLDEN = Path(__file__).parent / "golden" / "neutral.json"
ROUND = {"trajectory": {"type": "circle", "radius_mm": 800.0, "speed_mm_s": 200.0}}


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """All models that an annotation names, and those in their fields."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        fields = annotation.model_fields.values()
        return {annotation}.union(*(models_in(field.annotation) for field in fields))
    return set().union(*(models_in(part) for part in typing.get_args(annotation)))


def pinned(value: Any) -> Any:
    """A part of the table as JSON has it."""
    if isinstance(value, dict):
        return {name: pinned(part) for name, part in value.items()}
    return "ALWAYS" if value is ALWAYS else value


def test_every_field_of_a_scenario_has_a_neutral_value_or_always_counts():
    groups = {path.split(".")[0] for path in PATHS}
    channel_models = {type(getattr(Disturbance(), group)): group for group in groups}
    models = models_in(Scenario)
    assert {RobotParameters, JointFriction, Constant, SlipChannels} <= models
    for model in models:
        named: dict[str, Any] = {}
        for base in model.__mro__:
            named |= NEUTRAL.get(base.__name__, {})
        for field in model.model_fields:
            path = f"{channel_models.get(model)}.{field}"
            assert field in named or path in PATHS, (
                f"{model.__name__}.{field} is new: add it to NEUTRAL in tlf_env/task/neutral.py, with the "
                'value that means "as before", or ALWAYS'
            )


def test_the_table_names_no_field_that_is_gone():
    fields = {model.__name__: set(model.model_fields) for model in models_in(Scenario)}
    bases = {base for model in models_in(Scenario) for base in model.__mro__}
    fields |= {b.__name__: set(b.model_fields) for b in bases if issubclass(b, BaseModel)}
    for name, values in NEUTRAL.items():
        assert set(values) <= fields[name]


def test_no_neutral_value_ever_changes():
    """Add a new entry to the golden file once results with it are published; an entry there must stay."""
    table = pinned(NEUTRAL)
    known = json.loads(GOLDEN.read_text("utf-8"))
    for name, values in known["models"].items():
        for field, value in values.items():
            assert table[name][field] == value, f"{name}.{field}"
    nominal = {channel.path: channel.nominal for channel in CHANNELS}
    for path, value in known["channels"].items():
        assert nominal[path] == value, path


def test_today_every_other_default_is_neutral():
    """Where a default is changed on purpose, leave the table alone and name the field here."""
    found = difference(Scenario.model_validate(ROUND))
    changed = {"estimator", "broadcast_smoothing_s", "residual_base"}
    assert set(found) == {"name", "trajectory", "disturbance"} | changed
    assert found["trajectory"] == ROUND["trajectory"]
    assert found["disturbance"] == {"name": "custom"}


def test_every_task_and_disturbance_has_a_hash_of_its_own():
    tasks, disturbances = preset_names("scenario"), preset_names("disturbance")
    places = list(itertools.product(tasks, disturbances))
    hashes = {
        scenario_hash(load_scenario(task, disturbance=disturbance)) for task, disturbance in places
    }
    assert len(hashes) == len(places) > 10


CHANGES: list[dict[str, Any]] = [
    {"time_gap_s": 4.0},
    {"robots": 4},
    {"robots": [{}, {}, {}]},
    {"robots": [{}, {"wheel_radius_mm": 55.0}, {}]},
    {"robots": [{}, {}, {"wheel_radius_mm": 55.0}]},
    {"robot": {"wheel_radius_mm": 55.0}},
    {"robot": {"joint_friction": False}},
    {"robot": {"tyre": {"mu_static": 0.08}}},
    {"robot": {"drive_joint": {"bending": False}}},
    {"robot": {"castor_joint": {"bending": False}}},
    {"wheel_loop": {"pole_rad_s": 3.0}},
    {"wheel_loop": "mine:Loop"},
    {"observer": "mine:Loop"},
    {"estimator": "truth"},
    {"ekf": {"alpha_1": 0.0}},
    {"ekf_slip": {"surprise_threshold": None}},
    {"ekf_slip": {"fix_variance_time_s": None}},
    {"preview_s": ()},
    {"preview_s": (1.0, 0.5)},
    {"rays": {}},
    {"rays": {"count": 8}},
    {"rays": {"period_s": 0.1}},
    {"neighbour": {}},
    {"neighbour": {"range_mm": 900.0}},
    {"end_on": ()},
    {"end_on": ("lost",)},
    {"residual_reach_mm": 30.0},
    {"reward": {"slip": 0.0}},
    {"cooperative": True},
    {"dtype": "float64"},
    {"disturbance": "slip"},
    {"disturbance": "slip", "disturbance_level": 0.5},
    {"disturbance": "slip", "disturbance_level": 0.0},
    {"disturbance": {"slip": {"delta_1_mm_s": 5.0}}},
    {"disturbance": {"slip": {"delta_2_rad_s": 5.0}}},
    {"disturbance": {"slip": {"delta_1_mm_s": {"type": "step", "value": 0.0, "at_s": 1.0}}}},
    {"disturbance": {"slip": {"delta_1_mm_s": {"type": "step", "value": 5.0, "at_s": 1.0}}}},
    {
        "disturbance": {
            "slip": {"delta_1_mm_s": {"type": "step", "value": 5.0, "at_s": 1.0, "before": 1.0}}
        }
    },
    {"disturbance": {"slip": {"delta_1_mm_s": {"type": "gaussian", "std": 5.0}}}},
    {"disturbance": {"slip": {"delta_1_mm_s": {"type": "gaussian", "std": 5.0, "every_s": 1.0}}}},
    {"disturbance": {"tyre": {"friction_scale": 0.5}}},
    {"disturbance": {"position": {"noise_std_mm": 0.0}}},
    *(
        {
            "disturbance": {
                "tyre": {
                    "patches": [{"x_mm": x, "y_mm": 0.0, "radius_mm": 9.0, "friction_scale": 0.5}]
                }
            }
        }
        for x in (0.0, 1.0)
    ),
    {"trajectory": {"type": "circle", "radius_mm": 800.0, "period_s": 30.0}},
    {"trajectory": {**ROUND["trajectory"], "direction": "clockwise"}},
    {"trajectory": {"type": "waypoints", "points": [[0, 0, 0], [5, 0, 1000]]}},
    {"trajectory": {"type": "waypoints", "points": [[0, 0, 0], [5, 0, 1001]]}},
    {
        "trajectory": {
            "type": "stop_and_go",
            "path": ROUND["trajectory"],
            "drive_s": 9.0,
            "stop_s": 1.0,
        }
    },
    {"name": "other"},
]


def test_every_change_counts():
    hashes = [scenario_hash(load_scenario(ROUND, **change)) for change in [{}, *CHANGES]]
    assert len(set(hashes)) == len(hashes)
    for one in hashes:
        assert len(one) == 12
        int(one, 16)


def test_a_value_that_is_written_out_is_the_value_that_is_left_out():
    nominal = {"slip": {"delta_1_mm_s": 0.0}, "tyre": {"friction_scale": 1, "patches": []}}
    written = load_scenario(
        ROUND,
        robots=3,
        time_gap_s=5,
        preview_s=[0.5, 1.0],
        disturbance=nominal,
        reward={"far": 0.0},
    )
    assert scenario_hash(written) == scenario_hash(load_scenario(ROUND))
    whole = Scenario.model_validate_json(load_scenario(ROUND).model_dump_json())
    assert scenario_hash(whole) == scenario_hash(load_scenario(ROUND))


def with_field(base: type[BaseModel], monkeypatch, name: str, kind: Any, value: Any, entry: Any):
    """The model with one field more, and the table with its entry."""
    monkeypatch.setitem(NEUTRAL, base.__name__, NEUTRAL.get(base.__name__, {}) | {name: entry})
    return create_model(base.__name__, __base__=base, **{name: (kind, value)})


@pytest.mark.parametrize("change", [{}, *CHANGES])
def test_a_new_field_at_its_neutral_value_changes_no_hash(change, monkeypatch):
    before = scenario_hash(load_scenario(ROUND, **change))
    later = with_field(Scenario, monkeypatch, "wind_mm_s", NonNegative, 0.0, 0.0)
    data = load_scenario(ROUND, **change).model_dump()
    assert scenario_hash(later.model_validate(data)) == before
    assert scenario_hash(later.model_validate(data | {"wind_mm_s": 1.0})) != before


def test_a_new_field_of_a_nested_model_changes_no_hash(monkeypatch):
    plain = load_scenario(ROUND)
    joint = with_field(JointFriction, monkeypatch, "grease", NonNegative, 0.0, 0.0)
    robot = create_model(
        "RobotParameters",
        __base__=RobotParameters,
        drive_joint=(joint, joint.model_validate(RobotParameters().drive_joint.model_dump())),
    )
    for grease in (0.0, 0.5):
        data = robot()
        data = data.model_copy(
            update={"drive_joint": data.drive_joint.model_copy(update={"grease": grease})}
        )
        found = difference(plain.model_copy(update={"robot": data}))
        expected = {"robot": {"drive_joint": {"grease": 0.5}}} if grease else {}
        assert found == difference(plain) | expected


def test_a_new_channel_needs_no_entry(monkeypatch):
    before = scenario_hash(load_scenario(ROUND))
    gust = Channel("slip.gust_mm_s", 999, "substep", 2.0, (0.0, 9.0), "a gust")
    monkeypatch.setattr(neutral, "CHANNELS", (*CHANNELS, gust))
    assert "slip.gust_mm_s" not in channels.PATHS
    group = create_model(
        "SlipChannels", __base__=SlipChannels, gust_mm_s=(Constant, Constant(value=2.0))
    )
    for value in (2.0, 3.0):
        scenario = load_scenario(ROUND)
        slip = group(gust_mm_s=Constant(value=value))
        changed = scenario.disturbance.model_copy(update={"slip": slip})
        assert (scenario_hash(scenario.model_copy(update={"disturbance": changed})) == before) == (
            value == 2.0
        )


def test_a_changed_default_changes_the_hash_of_a_scenario_that_omits_the_field():
    class Changed(Scenario):
        time_gap_s: Positive = 4.0
        plant: Literal["pymunk", "batch", "kinematic"] = "kinematic"

    found = difference(Changed.model_validate(ROUND))
    assert (found["time_gap_s"], found["plant"]) == (4.0, "kinematic")
    before = Changed.model_validate(ROUND | {"time_gap_s": 5.0, "plant": "pymunk"})
    assert scenario_hash(before) == scenario_hash(load_scenario(ROUND))


def test_a_field_without_an_entry_always_counts():
    class Longer(Scenario):
        wind_mm_s: NonNegative = 0.0

    assert neutral_values(Longer)["wind_mm_s"] is ALWAYS
    assert difference(Longer.model_validate(ROUND))["wind_mm_s"] == 0.0


def test_a_new_reward_term_changes_no_hash_at_weight_0():
    scenario = load_scenario(ROUND)
    for weight in (0.0, 0.1):
        reward = {**scenario.reward, "energy": weight}
        found = scenario_hash(scenario.model_copy(update={"reward": reward}))
        assert (found == scenario_hash(scenario)) == (weight == 0.0)
