"""Whole scenarios: mappings, files and combinations of their fields."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import yaml
from campaign.fuzzing.cases import changed, damaged
from campaign.fuzzing.checks import (
    REFUSED,
    driven,
    driven_in_a_batch,
    refused,
    small,
    working_folder,
)
from campaign.fuzzing.registry import ViolationError, target
from hypothesis import strategies as st

import tlf_env
from tlf_env.common.presets import preset_names, yaml_text
from tlf_env.task.neutral import scenario_hash
from tlf_env.task.scenario import Scenario, load_scenario, scenario_notes, scenario_warnings

SHORT: dict[str, Any] = {"horizon_s": 2.0, "time_gap_s": 0.2, "preview_s": [0.1], "robots": 2}


def plain(fields: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = load_scenario("infinity", **{**SHORT, **fields}).model_dump(mode="json")
    return found


@functools.cache
def scenario_bases() -> list[Any]:
    found = [load_scenario(name).model_dump(mode="json") for name in preset_names()]
    found = [one for one in found if len(json.dumps(one)) < 30_000]
    found += [
        plain({"action": "tracking_twist", "limiter": "body"}),
        plain({"action": "residual", "residual_fade_mm": 5.0, "estimator": "ekf-slip"}),
        plain({"observation": "sensor", "dtype": "float64"}),
        plain({"action": "torque", "rays": {"count": 8}, "plant": "batch"}),
        plain({"plant": "kinematic", "neighbour": {"range_mm": 900.0}}),
        plain({"plant": "chipmunk", "disturbance": "combined-easy"}),
    ]
    short = []
    for one in found:
        if isinstance(one["robots"], int):
            one = {**one, "robots": 2}
        short.append({**one, "horizon_s": 2.0, "time_gap_s": 0.2, "preview_s": [0.1]})
        short[-1]["broadcast_smoothing_s"] = None
    return short


@target(changed(scenario_bases, most=4), share=1.5)
def scenarios(case: Any) -> None:
    """Mappings of all fields of a scenario."""
    found = refused(lambda: load_scenario(case))
    if found is REFUSED:
        return
    described(found)
    if small(found):
        driven(found, steps=2)


def described(found: Scenario) -> None:
    """What is said of a scenario, and its form as a file."""
    for line in [*scenario_warnings(found), *scenario_notes(found)]:
        if len(line.splitlines()) != 1:
            raise ViolationError("a warning of several lines", line)
    text = yaml_text(found.model_dump(mode="json"))
    again = load_scenario(yaml.safe_load(text)) if "!" not in text else found
    if scenario_hash(again) != scenario_hash(found):
        raise ViolationError("a scenario differs after it was written and read")
    str(found)


@functools.cache
def scenario_texts() -> list[bytes]:
    folder = Path(tlf_env.common.presets.__file__).parents[2] / "configs"
    found = [path.read_bytes() for path in sorted(folder.rglob("*.yaml"))]
    return [one for one in found if len(one) < 3000]


@target(damaged(scenario_texts), share=2.0)
def scenario_files(case: bytes) -> None:
    """Bytes of scenario files."""
    with working_folder() as folder:
        path = folder / "own.yaml"
        path.write_bytes(case)
        found = refused(lambda: load_scenario(path))
        if found is not REFUSED:
            described(found)
        refused(lambda: load_scenario("infinity", disturbance=path))
        refused(lambda: load_scenario("infinity", world=path))


CHOICES: dict[str, list[Any]] = {
    "action": ["twist", "tracking_twist", "residual", "wheel_speed", "torque"],
    "observation": ["tracking", "sensor"],
    "plant": ["pymunk", "batch", "kinematic", "chipmunk"],
    "estimator": ["ekf", "ekf-slip", "ekf-gyro", "truth"],
    "limiter": ["none", "body", "grip", "approach", {"lead_s": 0.1}, {"supervisor": {}}],
    "dtype": ["float32", "float64"],
    "rays": [{}, {"count": 3}, {"count": 1, "range_mm": 1.0}, {"period_s": 0.04}],
    "neighbour": [{}, {"range_mm": 1.0}, {"range_mm": 1e9}],
    "preview_s": [[], [0.0], [0.1], [0.2, 0.0]],
    "broadcast_smoothing_s": [0.0, 0.02, 0.04, 0.1],
    "control_period_s": [0.001, 0.004, 0.02, 0.1],
    "physics_period_s": [0.001, 0.0005, 0.004],
    "time_gap_s": [0.1, 0.2, 0.4, 1.0],
    "robots": [1, 2, 3, 5, [{}, {"mass_kg": 1.4}]],
    "start_ramp_s": [0.0, 0.5, 1e9],
    "start_spacing_mm": [221.0, 300.0, 1e4],
    "horizon_s": [0.1, 0.2, 2.0],
    "end_on": [[], ["lost"], ["touched"]],
    "lost_beyond_mm": [1e-9, 1.0, 1200.0],
    "cooperative": [True],
    "disturbance": [
        "combined-hard",
        "noise",
        "slip",
        "radio",
        "hardware",
        "calibration",
        "fixes-outage",
    ],
    "residual_base": ["linearised", "tuned", "consistent"],
    "residual_fade_mm": [0.0, 10.0],
    "residual_reach_mm": [1.0, 100.0],
    "tracking_fade_mm": [0.0, 5.0],
    "action_range": [[1e-9, 1e-9], [300.0, 3.0], [1e9, 1e9]],
    "world": ["corridor", "warehouse"],
    "reward": [{"fine": 1e6}, {"far": -1e6, "alive": 2.0}],
    "ekf": [{"alpha_1": 0.0}, {"alpha_1": 1e3}],
    "observer": [{}],
    "adversary": [True],
}


@target(
    st.dictionaries(st.sampled_from(list(CHOICES)), st.integers(0, 5), min_size=2, max_size=9),
    share=1.0,
)
def combinations(case: Any) -> None:
    """Fields of a scenario that are each allowed, together."""
    fields = {name: CHOICES[name][i % len(CHOICES[name])] for name, i in case.items()}
    given = {"horizon_s": 2.0, "time_gap_s": 0.2, "preview_s": [], "robots": 2, **fields}
    found = refused(lambda: load_scenario("infinity", **given))
    if found is REFUSED:
        return
    described(found)
    driven(found, steps=3)
    if found.plant in ("batch", "kinematic") and not found.adversary:
        driven_in_a_batch(found)
