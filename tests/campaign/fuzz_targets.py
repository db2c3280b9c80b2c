"""What is fuzzed: for each target the cases, and what a case must not do. ``fuzz.py`` runs them."""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import json
import math
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import yaml
from hypothesis import strategies as st

import tlf_env
from baselines import cli
from baselines.benchmark.envelope import load_knob
from baselines.benchmark.plan import parse_pairs, parse_seeds, parse_sweep, read_plan
from baselines.cli import PLAN_OPTIONS
from baselines.paths.read import read_log
from baselines.paths.retime import retimed, smoothed
from baselines.policies import entry_process
from baselines.policies.card import read_policy
from baselines.policies.entries import load_entry
from baselines.policies.entry_process import EntryProcess
from baselines.policies.laws.catalogue import LAWS
from baselines.policies.learned import SHIPPED, LearnedPolicy
from baselines.policies.registry import fit_policy, make_policy, policy_names
from baselines.runs.files import read_record
from baselines.runs.folders import Identity, check_room
from baselines.runs.jsonl import read_lines
from baselines.runs.run import run_policy
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env.common.presets import preset_names, read_preset_or_file, yaml_text
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.disturbances.signals import Signal
from tlf_env.engine.snapshot import Snapshot
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.onboard.limiters import load_limiter
from tlf_env.physics.openloop import load_scenarios, run_open_loop
from tlf_env.task.neutral import scenario_hash
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import Scenario, load_scenario, scenario_notes, scenario_warnings
from tlf_env.task.trajectories import reference_from
from tlf_env.task.waypoints import read_points

MOST_LINE = 3000  # characters of an error
REFUSED = object()


class ViolationError(Exception):
    """A case has shown something that is not allowed; ``what`` is the same for the same cause."""

    def __init__(self, what: str, detail: str = "") -> None:
        super().__init__(f"{what}: {detail}" if detail else what)
        self.what = what


class Target(NamedTuple):
    """What is fuzzed."""

    cases: st.SearchStrategy[Any]
    check: Callable[[Any], Any]
    share: float = 1.0  # of the cases of a campaign


TARGETS: dict[str, Target] = {}


def target(cases: st.SearchStrategy[Any], share: float = 1.0) -> Callable[[Any], Any]:
    """Register a check as the target of its name."""

    def register(check: Callable[[Any], Any]) -> Callable[[Any], Any]:
        TARGETS[check.__name__] = Target(cases, check, share)
        return check

    return register


# Cases are JSON values, so that they can be kept as files; bytes and arrays are mappings with the key "!".


def encoded(case: Any) -> Any:
    """A case as JSON values."""
    if isinstance(case, bytes):
        return {"!": "bytes", "value": case.decode("latin-1")}
    if isinstance(case, list | tuple):
        return [encoded(one) for one in case]
    if isinstance(case, dict):
        return {key: encoded(one) for key, one in case.items()}
    return case


def restored(case: Any) -> Any:
    """A case of :func:`encoded`, with its bytes; arrays are made by :func:`real`."""
    if isinstance(case, list):
        return [restored(one) for one in case]
    if isinstance(case, dict):
        if case.get("!") == "bytes":
            return case["value"].encode("latin-1")
        return {key: restored(one) for key, one in case.items()}
    return case


def real(value: Any) -> Any:
    """A value with the objects that its mappings with the key "!" stand for."""
    if isinstance(value, list):
        return [real(one) for one in value]
    if not isinstance(value, dict):
        return value
    kind = value.get("!")
    if kind == "array":
        with contextlib.suppress(Exception):
            return np.array(value["value"], dtype=value["dtype"])
        return np.array(value["value"], dtype=object)
    if kind == "scalar":
        with contextlib.suppress(Exception):
            return np.dtype(value["dtype"]).type(value["value"])
        return value["value"]
    if kind == "tuple":
        return tuple(real(one) for one in value["value"])
    if kind == "object":
        return object()
    return {key: real(one) for key, one in value.items()}


# Hostile values.

NUMBERS: list[Any] = [
    0, -0.0, 1, -1, 2, 0.5, 1e-300, 5e-324, -5e-324, 1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 1e12, 1e16,
    1e100, 1e154, 1e200, 1e308, -1e308, 1.7976931348623157e308, math.nan, math.inf, -math.inf, 3, 7, 1000,
    2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64, 10**400, 0.1, -0.1, 0.001, 0.02, 1.0000000000000002,
]  # fmt: skip
TEXTS = [
    "", " ", "nan", "inf", "0", "1e999", "true", "null", "~", "a:b", "os:abort", "reference:", "../x.yaml",
    "/dev/null", "none", "x" * 2000, "\x00", "\n", "é\u2028\u202e", "<script>alert(1)</script>", "[", "{", "*a",
    "%s%n", "'; --", "\ud800", "💥", "infinity", "slip", "tuned", "-1", "1,2", "NaN:NaN:3", "=", ".", "..",
]  # fmt: skip
number = st.one_of(st.sampled_from(NUMBERS), st.floats(), st.integers(-20, 20), st.integers())
word = st.one_of(st.sampled_from(TEXTS), st.text(max_size=12))
scalar = st.one_of(number, number, st.none(), st.booleans(), word)
anything = st.recursive(
    scalar,
    lambda one: st.lists(one, max_size=4) | st.dictionaries(word, one, max_size=3),
    max_leaves=6,
)
SCALES = (0.0, -1.0, 1e-12, 1e-3, 0.1, 0.5, 0.9, 1.1, 2.0, 10.0, 1e3, 1e12, 1e150)


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to everything inside plain data."""
    yield path
    if isinstance(data, dict):
        for key, value in data.items():
            yield from places(value, (*path, key))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            yield from places(value, (*path, i))


def at(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        data = data[key]
    return data


@st.composite
def changed(draw: Any, bases: Any, most: int = 3, values: Any = anything) -> Any:
    """One of some plain data with changes: other values, missing and unknown keys, scaled numbers."""
    data = copy.deepcopy(draw(st.sampled_from(bases())))
    for _ in range(draw(st.integers(1, most))):
        paths = list(places(data))
        path = paths[draw(st.integers(0, len(paths) - 1))]
        if not path:
            continue
        inner, key = at(data, path[:-1]), path[-1]
        old = inner[key]
        what = draw(st.integers(0, 6))
        if what <= 1:
            inner[key] = draw(values)
        elif what == 2 and isinstance(inner, dict):
            del inner[key]
        elif what == 3 and isinstance(old, dict):
            old[draw(word)] = draw(values)
        elif what == 4 and isinstance(old, list):
            inner[key] = old * draw(st.integers(0, 3))
        elif isinstance(old, int | float) and not isinstance(old, bool):
            scale = draw(st.sampled_from(SCALES))
            with contextlib.suppress(OverflowError):
                inner[key] = old * scale
        elif isinstance(old, str):
            inner[key] = draw(word)
        else:
            inner[key] = draw(number)
    return data


@st.composite
def damaged(draw: Any, bases: Any) -> bytes:
    """One of some files' bytes with changes: other bytes, parts left out, repeated or put elsewhere."""
    data = bytearray(draw(st.sampled_from(bases())))
    for _ in range(draw(st.integers(1, 4))):
        first = draw(st.integers(0, len(data)))
        last = min(len(data), first + draw(st.sampled_from((1, 1, 2, 5, 20, 100))))
        what = draw(st.integers(0, 4))
        if what == 0:
            data[first:last] = draw(st.binary(max_size=6))
        elif what == 1:
            del data[first:last]
        elif what == 2:
            data[first:first] = data[first:last]
        elif what == 3:
            data[first:first] = draw(st.sampled_from(TEXTS)).encode("utf-8", "surrogatepass")
        else:
            data = data[:first] if draw(st.booleans()) else data[first:]
    return bytes(data[:20_000])


# What is allowed.


def in_one_line(error: BaseException) -> None:
    """Check that an error says something, in one line."""
    said = str(error)
    kind = type(error).__name__
    if not said.strip():
        raise ViolationError(f"a {kind} without a message")
    if len(said.splitlines()) > 1:
        raise ViolationError(f"a {kind} of several lines", repr(said[:500])) from error
    if len(said) > MOST_LINE:
        raise ViolationError(f"a {kind} of more than {MOST_LINE} characters", said[:200]) from error


def refused(make: Callable[[], Any], *more: type[BaseException]) -> Any:
    """What a function returns; REFUSED if it raises a documented error in one line."""
    try:
        return make()
    except (ValueError, *more) as error:
        in_one_line(error)
        return REFUSED


def finite(what: str, values: Any, limit: float = math.inf) -> None:
    """Check numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise ViolationError(f"{what} are no numbers", str(array.dtype))
    if not np.isfinite(array).all():
        raise ViolationError(f"{what} are not finite", repr(values)[:300])
    if array.size and np.abs(array.astype(np.float64)).max() > limit:
        raise ViolationError(f"{what} are out of their bounds", repr(values)[:300])


def small(scenario: Scenario) -> bool:
    """Whether a few steps of a scenario take little time and memory."""
    rays = 0 if scenario.rays is None else scenario.rays.count
    return (
        scenario.robot_count <= 8
        and scenario.substeps <= 200
        and scenario.horizon_steps <= 20_000
        and scenario.gap_steps <= 5_000
        and scenario.smoothing_steps <= 2_000
        and rays <= 64
        and len(scenario.preview_s) <= 20
        and not scenario.code
        and sum(len(getattr(scenario.world, name)) for name in type(scenario.world).model_fields)
        <= 40
    )


def driven(scenario: Scenario, steps: int = 3, action: float = 0.2) -> None:
    """Drive a scenario for a few steps in the parallel environment; all that it returns must be finite."""
    env = refused(lambda: tlf_env.parallel_env(scenario))
    if env is REFUSED:
        return
    started = refused(lambda: env.reset(seed=3))
    if started is REFUSED:
        return
    observed("at the start", env, *started)
    for k in range(steps):
        if not env.agents:
            break
        actions = {agent: np.array([action, 0.1 * (k - 1)]) for agent in env.agents}
        seen, rewards, ended, cut, infos = env.step(actions)
        finite("rewards", list(rewards.values()))
        observed("in a step", env, seen, infos)
        for flags in (ended, cut):
            if any(type(flag) is not bool for flag in flags.values()):
                raise ViolationError("flags are no switches")


def observed(when: str, env: Any, seen: Any, infos: Any) -> None:
    """Check what an environment has returned."""
    for agent, row in seen.items():
        finite(f"observations {when}", row, OBSERVATION_LIMIT)
        if not env.observation_space(agent).contains(row):
            raise ViolationError(f"observations {when} are not in their space", repr(row)[:200])
    finite(f"states {when}", env.state())
    for info in infos.values():
        for key, value in info.items():
            finite(f"infos {when}: {key}", value)


def driven_in_a_batch(scenario: Scenario, steps: int = 3) -> None:
    """As :func:`driven`, on the batch plant."""
    plant = refused(lambda: tlf_env.BatchPlant(scenario, 2))
    if plant is REFUSED or refused(lambda: plant.reset(seed=3)) is REFUSED:
        return
    for _ in range(steps):
        finite("observations in a batch", plant.observations, OBSERVATION_LIMIT)
        finite("rewards in a batch", plant.rewards)
        if plant.ended.any():
            break
        plant.step(np.full(plant.arrays.actions.shape, 0.2))


@contextlib.contextmanager
def working_folder() -> Iterator[Path]:
    """An empty folder to work in."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        try:
            yield Path(name)
        finally:
            os.chdir(before)


# Scenarios and what is in them.

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


def fields_of(signal: Any) -> st.SearchStrategy[Any]:
    """A signal of a class; most fields are there, with any numbers."""
    fields = [name for name in signal.model_fields if name != "type"]
    given = dict.fromkeys(fields, st.one_of(st.floats(0, 10), number))
    kind = {"type": st.just(signal.model_fields["type"].default)}
    return st.fixed_dictionaries(kind | given) | st.fixed_dictionaries(kind, optional=given)


signals = st.one_of(number, *map(fields_of, get_args(get_args(Signal)[0])))


@st.composite
def within_ranges(draw: Any) -> Any:
    """Channels with values at and within their ranges: valid, and as extreme as allowed."""
    found: dict[str, Any] = {}
    for _ in range(draw(st.integers(1, 5))):
        channel = draw(st.sampled_from(CHANNELS))
        group, name = channel.path.split(".")
        value = draw(
            st.one_of(
                st.sampled_from([channel.low, channel.high, channel.nominal, 0.0]),
                st.floats(channel.low, channel.high),
            )
        )
        high = draw(st.floats(value, channel.high)) if value < channel.high else value
        kind = draw(st.sampled_from(["plain", "uniform", "step", "sine", "pulse"]))
        signal: Any = value
        if kind == "uniform":
            every = draw(st.sampled_from([None, 1e-9, 0.001, 0.02, 1.0, 1e9]))
            signal = {"type": "uniform", "low": value, "high": high, "every_s": every}
        elif kind == "step":
            signal = {
                "type": "step",
                "value": value,
                "at_s": draw(st.sampled_from([0.0, 0.01, 1e9])),
            }
        elif kind == "sine":
            rate = draw(st.sampled_from([1e-9, 1.0, 1e3, 1e12]))
            amplitude = (high - value) / 2
            mean = value + amplitude
            signal = {"type": "sine", "amplitude": amplitude, "frequency_hz": rate, "mean": mean}
        elif kind == "pulse":
            signal = {"type": "impulse", "value": value, "at_s": 0.01, "duration_s": 0.02}
        found.setdefault(group, {})[name] = signal
    return {**found, "level": draw(st.sampled_from([1.0, 0.0, 0.5, 1.5]))}


@functools.cache
def disturbance_bases() -> list[Any]:
    return [
        load_scenario("infinity", disturbance=name).disturbance.model_dump(mode="json")
        for name in preset_names("disturbance")
        if name not in ("none",)
    ]


@target(st.one_of(within_ranges(), changed(disturbance_bases, values=signals)), share=1.5)
def disturbances(case: Any) -> None:
    """Channels and their signals."""
    for plant in ("pymunk", "batch"):
        found = refused(lambda: load_scenario("infinity", **SHORT, disturbance=case, plant=plant))
        if found is REFUSED:
            return
        if plant == "batch":
            driven_in_a_batch(found, steps=6)
        else:
            driven(found, steps=4)


coordinate = st.one_of(
    st.floats(-3000, 3000), st.sampled_from([0.0, 1e10, -1e10, 1e-300, 2500.0, 1e5]), number
)
point = st.lists(coordinate, min_size=2, max_size=2)
shapes = st.one_of(
    st.fixed_dictionaries({"type": st.just("circle"), "radius_mm": coordinate}),
    st.fixed_dictionaries(
        {"type": st.just("box"), "width_mm": coordinate, "length_mm": coordinate}
    ),
    st.fixed_dictionaries(
        {"type": st.just("polygon"), "points_mm": st.lists(point, min_size=3, max_size=6)}
    ),
)
surface = {"restitution": st.floats(0, 1) | number, "friction": st.floats(0, 2) | number}
worlds = st.fixed_dictionaries(
    {},
    optional={
        "walls": st.lists(
            st.fixed_dictionaries(
                {"points_mm": st.lists(point, min_size=2, max_size=4)},
                optional={"thickness_mm": coordinate, "closed": st.booleans(), **surface},
            ),
            max_size=2,
        ),
        "obstacles": st.lists(
            st.fixed_dictionaries(
                {"shape": shapes, "x_mm": coordinate, "y_mm": coordinate},
                optional={"angle_rad": number, **surface},
            ),
            max_size=2,
        ),
        "pushables": st.lists(
            st.fixed_dictionaries(
                {"shape": shapes, "x_mm": coordinate, "y_mm": coordinate, "mass_kg": coordinate},
                optional={
                    "angle_rad": number,
                    "inertia_kg_mm2": number,
                    "floor_friction": number,
                    "damping_per_s": number,
                    **surface,
                },
            ),
            max_size=3,
        ),
        "moving": st.lists(
            st.fixed_dictionaries(
                {
                    "shape": shapes,
                    "points_mm": st.lists(point, min_size=2, max_size=4),
                    "speed_mm_s": coordinate,
                },
                optional={
                    "closed": st.booleans(),
                    "pause_s": number,
                    "start_s": number,
                    "random_start": st.booleans(),
                    "angle_rad": number,
                    **surface,
                },
            ),
            max_size=2,
        ),
        "patches": st.lists(
            st.fixed_dictionaries(
                {
                    "x_mm": coordinate,
                    "y_mm": coordinate,
                    "radius_mm": coordinate,
                    "friction_scale": number,
                }
            ),
            max_size=2,
        ),
    },
)


@functools.cache
def world_bases() -> list[Any]:
    found = [
        load_scenario("infinity", world=name).world.model_dump(mode="json")
        for name in preset_names("world")
    ]
    box = {"type": "box", "width_mm": 200, "length_mm": 150}
    found.append(
        {
            "walls": [{"points_mm": [[2200, 2300], [2800, 2300]]}],
            "obstacles": [{"shape": box, "x_mm": 2900, "y_mm": 2500}],
            "pushables": [{"shape": box, "x_mm": 2500.0, "y_mm": 2690.0, "mass_kg": 1.0}],
            "moving": [
                {
                    "shape": {"type": "circle", "radius_mm": 100},
                    "points_mm": [[2000, 2700], [2600, 2700]],
                    "speed_mm_s": 500,
                }
            ],
            "patches": [{"x_mm": 2500, "y_mm": 2500, "radius_mm": 300, "friction_scale": 0.1}],
        }
    )
    return found


@target(st.one_of(worlds, changed(world_bases, values=coordinate)), share=1.0)
def world(case: Any) -> None:
    """Walls, obstacles, things to push and moving obstacles."""
    for fields in ({}, {"plant": "batch", "rays": {"count": 8}}, {"plant": "chipmunk"}):
        found = refused(lambda: load_scenario("infinity", **SHORT, world=case, **fields))
        if found is not REFUSED:
            refused(lambda: scenario_warnings(found))
            driven(found, steps=4, action=1.0)


@functools.cache
def robot_bases() -> list[Any]:
    found = [load_scenario("infinity").robot.model_dump(mode="json")]
    found += [one.model_dump(mode="json") for one in load_scenario("mixed").robot_models]
    polygon = {**found[0], "outline_polygon_mm": [[-90, -90], [90, -90], [90, 90], [-90, 90]]}
    return [*found, polygon]


@target(changed(robot_bases, most=3, values=number))
def robots(case: Any) -> None:
    """Parameters of a robot."""
    for plant in ("pymunk", "batch", "kinematic", "chipmunk"):
        found = refused(lambda: load_scenario("infinity", **SHORT, robot=case, plant=plant))
        if found is not REFUSED:
            driven(found, steps=2)


PATHS: list[Any] = [
    load_scenario(name).trajectory.model_dump(mode="json", exclude_none=True)
    for name in ("infinity", "flower", "circle", "stop_and_go")
]
PATHS.append(
    {
        "type": "waypoints",
        "points": [[0, 0, 0], [1, 100, 0], [2, 100, 100], [3, 100, 100], [9, 0, 0]],
    }
)


@target(changed(lambda: PATHS, values=number))
def trajectories(case: Any) -> None:
    """Trajectories, from rest, at speed, and later on."""
    found = refused(lambda: load_scenario("infinity", trajectory=case, **SHORT))
    if found is REFUSED:
        return
    times = np.array([0.0, 1e-9, 0.01, 1.0, 3.0, 1e3])
    for ramp_s in (0.0, 2.0):
        for phase_s in (0.0, 1e9, -1e9):
            finite("references", reference_from(found.trajectory, times, ramp_s, phase_s))
    described(found)
    driven(found, steps=2)


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


# Files of paths and torques.

LOGS = [
    b"t_s,x_mm,y_mm\n0,0,0\n1,100,0\n2,200,50\n3,300,150\n4,300,150\n5,500,200\n",
    b"# log\ntime;x [m];y [m]\n0,0;0,0;0,0\n0,1;0,1;0,0\n0,2;0,2;0,05\n0,3;0,35;0,1\n",
    b"sec nanosec x y\n1 0 0 0\n1 500000000 1 0\n2 0 2 1\n2 500000000 3 1\n",
    b"\xef\xbb\xbftimestamp\tpose_x\tpose_y\r\n1e9\t0\t0\r\n1.0000001e9\t1\t0\r\n1.0000002e9\t2\t1\r\n",
]


@target(
    st.tuples(
        damaged(lambda: LOGS),
        st.sampled_from(
            [None, None, "1,2,3", "t_s,x_mm,y_mm", "sec+nanosec,x,y", "9,9,9", "a", "1+2,3,4"]
        ),
        st.sampled_from([None, "m", "mm", "cm", "km", "x"]),
    ),
    share=2.0,
)
def paths(case: Any) -> None:
    """Logs, and files of waypoints."""
    data, columns, units = case
    with working_folder() as folder:
        path = folder / "log.csv"
        path.write_bytes(data)
        refused(lambda: read_points(path))
        found = refused(lambda: load_scenario(path))
        if found is not REFUSED and small(found):
            driven(found, steps=1)
        log = refused(lambda: read_log(path, columns, units))
        if log is not REFUSED:
            finite("times of a log", log.t_s)
            finite("places of a log", log.xy_mm)
            for noise in (0.0, 5.0):
                made = refused(lambda: smoothed(log, noise))
                if made is not REFUSED:
                    finite("smoothed times and places", np.column_stack(made[:2]))
            again = refused(lambda: retimed(log.xy_mm, 400.0))
            if again is not REFUSED:
                finite("times and places anew", np.column_stack(again))


TORQUES: list[Any] = [
    {
        "roll": {
            "duration_s": 0.2,
            "start": {"x_mm": 1.0, "theta_rad": 0.5, "castor_rad": 0.1, "forward_mm_s": 100.0},
            "inputs": [
                {"torque_l_Nmm": 1.0, "torque_r_Nmm": 1.0, "from_s": 0.0},
                {"torque_l_Nmm": -1.0, "torque_r_Nmm": 2.0, "from_s": 0.1},
            ],
            "joint_friction": True,
        }
    }
]


@target(
    st.tuples(
        changed(lambda: TORQUES, most=4),
        st.sampled_from(["kernel", "kernel", "chipmunk", "x"]),
        st.sampled_from([0.001, 0.1, 0.0005, 0.003, 0.0, -1.0, math.nan]),
    ),
    share=1.5,
)
def open_loops(case: Any) -> None:
    """Files of torques, run."""
    data, plant, dt_s = case
    with working_folder() as folder:
        path = folder / "open.json"
        path.write_text(json.dumps(data))
        found = refused(lambda: load_scenarios(path))
        if found is REFUSED:
            return
        for one in found.values():
            if one.duration_s > 1.0:
                continue
            rows = refused(lambda: run_open_loop(one, dt_s=dt_s, plant=plant))
            if rows is not REFUSED:
                finite("rows of an open loop", rows)


@target(damaged(lambda: [json.dumps(one).encode() for one in TORQUES]), share=2.0)
def open_loop_files(case: bytes) -> None:
    """Bytes of files of torques."""
    with working_folder() as folder:
        (folder / "open.json").write_bytes(case)
        refused(lambda: load_scenarios(folder / "open.json"))


# Controllers, laws, limiters, learned policies, entries.


@functools.cache
def law_bases() -> list[Any]:
    found = [
        {"kind": "reference", "data": read_preset_or_file("controller", name)}
        for name in preset_names("controller")
    ]
    for law in LAWS:
        if law == "nmpc":
            continue
        found += [
            {"kind": law, "data": read_preset_or_file(law, name)} for name in preset_names(law)
        ]
        found.append(
            {"kind": law, "data": LAWS[law][1]().model_dump(mode="json", exclude_none=True)}
        )
    found += [
        {"kind": "limiter", "data": read_preset_or_file("limiter", name)}
        for name in preset_names("limiter")
    ]
    return found


@functools.cache
def rows_seen() -> np.ndarray:
    width = len(tlf_env.parallel_env("infinity").observation_space("robot_0").low)
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (6, width))
    rows[1], rows[2], rows[3] = 0.0, OBSERVATION_LIMIT, -OBSERVATION_LIMIT
    return rows.astype(np.float32)


def asked(policy: Any, rows: np.ndarray) -> None:
    """A policy's actions must be finite; ±1 is not demanded, as the environment clips."""
    state, starts = None, np.ones(len(rows), dtype=np.bool_)
    for _ in range(2):
        actions, state = policy.predict(rows, state, starts, True)
        finite("actions of a policy", actions)
        starts = np.zeros(len(rows), dtype=np.bool_)


@target(changed(law_bases, most=3, values=number), share=1.5)
def controllers(case: Any) -> None:
    """Files of controllers, laws and limiters."""
    kind, data = case.get("kind"), case.get("data")
    if kind not in ("limiter", "reference", *LAWS):
        return
    scenario = load_scenario("infinity")
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(data))
        if kind == "limiter":
            limiter = refused(lambda: load_limiter("own.yaml"))
            if limiter is not REFUSED:
                fields = {"action": "tracking_twist", "limiter": "own.yaml", **SHORT}
                limited = refused(lambda: load_scenario("infinity", **fields))
                if limited is not REFUSED:
                    driven(limited, steps=2)
            return
        policy = refused(lambda: make_policy(f"{kind}:own.yaml", scenario))
        if policy is not REFUSED:
            asked(policy, rows_seen())


@functools.cache
def cards() -> list[Any]:
    return [json.loads(path.read_text("utf-8")) for path in sorted(SHIPPED.glob("*.json"))]


@target(st.tuples(changed(cards, most=2), st.integers(0, 3)), share=0.7)
def policy_cards(case: Any) -> None:
    """Cards of learned policies."""
    card, which = case
    name = sorted(SHIPPED.glob("*.safetensors"))[which % len(list(SHIPPED.glob("*.safetensors")))]
    with working_folder() as folder:
        (folder / "own.safetensors").symlink_to(name)
        (folder / "own.json").write_text(json.dumps(card))
        loaded = refused(lambda: read_policy(folder / "own.safetensors"))
        if loaded is REFUSED:
            return
        policy = LearnedPolicy(loaded)
        fitted = refused(lambda: fit_policy("own.safetensors", load_scenario("infinity")))
        if fitted is not REFUSED:
            env = refused(lambda: tlf_env.parallel_env(fitted.scenario))
            if env is not REFUSED:
                seen, _ = env.reset(seed=0)
                asked(fitted.policy, np.stack(list(seen.values())))
        refused(lambda: asked(policy, rows_seen()))


def tensors(header: bytes, body: bytes) -> bytes:
    return len(header).to_bytes(8, "little") + header + body


@functools.cache
def weights() -> list[bytes]:
    from safetensors.numpy import save

    return [save({"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros(2, np.float64)})]


@target(damaged(weights), share=2.0)
def weight_files(case: bytes) -> None:
    """Bytes of weights, with a card of their digest."""
    import hashlib

    with working_folder() as folder:
        card = {**cards()[0], "weights_sha256": hashlib.sha256(case).hexdigest()}
        (folder / "own.safetensors").write_bytes(case)
        (folder / "own.json").write_text(json.dumps(card))
        refused(lambda: read_policy(folder / "own.safetensors"))
        refused(lambda: Snapshot.load(folder / "own.safetensors"))


@target(
    st.one_of(
        word,
        st.lists(word, max_size=3).map("+".join),
        st.tuples(
            st.sampled_from(["adrc", "reference", "kanayama", "nmpc", "entry", "residual", "x"]),
            word,
        ).map(":".join),
    ),
    share=1.0,
)
def policy_names_(case: str) -> None:
    """Names of policies; nothing is imported."""
    before = set(sys.modules)
    with working_folder():
        made = refused(lambda: make_policy(case, load_scenario("infinity")))
    if (
        made is not REFUSED
        and ":" in case
        and not case.startswith(tuple(one.partition(":")[0] for one in policy_names()))
    ):
        raise ViolationError("a name has made a policy without permission", case)
    del before


ENTRIES: list[Any] = [
    {
        "name": "a",
        "authors": ["b"],
        "kind": "code",
        "command": ["python", "entry.py"],
        "scenario": {"action": "twist", "observation": "tracking", "preview_s": [0.5]},
    },
    {"name": "a", "authors": ["b"], "kind": "weights", "file": "own.safetensors"},
]


@target(changed(lambda: ENTRIES, most=3), share=1.0)
def entries(case: Any) -> None:
    """Cards of competition entries; no program is started."""
    with working_folder() as folder:
        (folder / "entry.yaml").write_text(yaml_text(case))
        refused(lambda: load_entry(folder))
        refused(lambda: make_policy(f"entry:{folder}", load_scenario("infinity")))


ANSWERS = """
import sys
data = bytes.fromhex(sys.argv[1])
out = sys.stdout.buffer
while data:
    size = int.from_bytes(sys.stdin.buffer.read(4), "little")
    if not size:
        break
    sys.stdin.buffer.read(size)
    length = data[0]
    out.write(data[1 : 1 + length])
    out.flush()
    data = data[1 + length :]
"""
HELLO = b'\x0f\x00\x00\x00{"protocol": 1}'
answer = st.one_of(
    st.just(HELLO),
    st.binary(max_size=40),
    st.binary(min_size=16, max_size=16).map(lambda body: b"\x10\x00\x00\x00" + body),
)


@target(st.lists(answer, min_size=1, max_size=3), share=0.02)
def entry_programs(case: Any) -> None:
    """Answers of an entry's program."""
    data = b"".join(bytes([len(one)]) + one for one in case)
    with working_folder() as folder:
        (folder / "entry.py").write_text(ANSWERS)

        entry_process.START_LIMIT_S = 2.0  # for the first answer: 60 s

        def spoken() -> None:
            command = ("python", "entry.py", data.hex())
            process = EntryProcess("entry", command, folder, {"dtype": "<f4"}, (2, 3))
            try:
                for _ in range(2):
                    finite("actions of an entry", process.act(np.zeros((2, 3), np.float32)))
            finally:
                process.close()

        refused(spoken)


# Snapshots.


@functools.cache
def moment() -> tuple[Any, Snapshot]:
    fields = {**SHORT, "disturbance": "combined-hard", "world": world_bases()[-1], "end_on": []}
    env = tlf_env.parallel_env("infinity", **fields)
    env.reset(seed=1)
    for _ in range(12):
        env.step({agent: [0.8, 0.1] for agent in env.agents})
    return env, env.get_state()


@functools.cache
def batch_moment() -> tuple[Any, Snapshot]:
    plant = tlf_env.BatchPlant("infinity", 2, **SHORT, disturbance="combined-hard")
    plant.reset(seed=1, options={"phase_s": 1.0})
    for _ in range(8):
        plant.step(np.full(plant.arrays.actions.shape, 0.3))
    return plant, plant.get_state()


@target(
    st.tuples(
        st.booleans(),
        st.lists(
            st.tuples(
                st.integers(0, 200), st.integers(0, 5000), st.one_of(number, st.integers(-3, 30))
            ),
            min_size=1,
            max_size=3,
        ),
    ),
    share=1.5,
)
def snapshots(case: Any) -> None:
    """Numbers in a snapshot: refused, or the simulation goes on with finite numbers."""
    of_batch, changes = case
    thing, taken = batch_moment() if of_batch else moment()
    numbers = {name: array.copy() for name, array in taken.numbers.items()}
    names = sorted(numbers)
    for which, place, value in changes:
        array = numbers[names[which % len(names)]].reshape(-1)
        if not array.size:
            continue
        with contextlib.suppress(OverflowError, ValueError, TypeError), np.errstate(all="ignore"):
            array[place % array.size] = value
    changed_ = Snapshot(taken.kind, taken._fits, taken._memory, numbers)
    try:
        went = refused(lambda: thing.set_state(changed_)) is not REFUSED
        for _ in range(2 * went):
            if of_batch:
                if (thing.arrays.clock[:, 1] >= thing.arrays.clock[:, 3]).any():
                    break
                thing.step(np.full(thing.arrays.actions.shape, 0.1))
                finite("observations after a snapshot", thing.observations, OBSERVATION_LIMIT)
                finite("rewards after a snapshot", thing.rewards)
            elif thing.agents:
                seen, rewards, *_ = thing.step({agent: [0.1, 0.0] for agent in thing.agents})
                finite("observations after a snapshot", list(seen.values()), OBSERVATION_LIMIT)
                finite("rewards after a snapshot", list(rewards.values()))
        thing.set_state(taken)
    except BaseException:
        (batch_moment if of_batch else moment).cache_clear()  # it may be left half changed
        raise


@functools.cache
def snapshot_bytes() -> list[bytes]:
    with working_folder() as folder:
        env = tlf_env.parallel_env(
            "infinity", horizon_s=0.2, time_gap_s=0.1, preview_s=(), robots=1
        )
        env.reset(seed=0)
        env.get_state().save(folder / "moment")
        data = (folder / "moment").read_bytes()
    return [data[:20_000]] if len(data) > 20_000 else [data]


@target(
    st.one_of(damaged(snapshot_bytes), changed(lambda: [moment()[1]._memory], values=anything)),
    share=1.0,
)
def snapshot_files(case: Any) -> None:
    """Bytes of files of snapshots, and what a snapshot remembers."""
    if isinstance(case, dict):
        env, taken = moment()
        try:
            refused(lambda: env.set_state(Snapshot(taken.kind, taken._fits, case, taken.numbers)))
        finally:
            env.set_state(taken)
        return
    with working_folder() as folder:
        (folder / "moment").write_bytes(case)
        refused(lambda: Snapshot.load(folder / "moment"))


# Actions and resets.

dtypes = st.sampled_from(["f2", "f4", "f8", "i8", "u1", "b1", "c8", "U3", "O", "M8[s]", ">f8"])
arrays = st.fixed_dictionaries(
    {
        "!": st.just("array"),
        "dtype": dtypes,
        "value": st.one_of(
            st.lists(number, max_size=3),
            st.lists(st.lists(number, min_size=2, max_size=2), max_size=3),
            number,
        ),
    }
)
action = st.one_of(
    st.lists(number, min_size=2, max_size=2),
    st.lists(st.floats(-2, 2), min_size=2, max_size=2),
    arrays,
    anything,
    st.fixed_dictionaries({"!": st.just("tuple"), "value": st.lists(number, max_size=3)}),
    st.fixed_dictionaries({"!": st.just("object")}),
)
moves = st.one_of(
    st.fixed_dictionaries(
        {"do": st.just("step"), "actions": st.lists(action, min_size=2, max_size=2)}
    ),
    st.fixed_dictionaries(
        {"do": st.just("step"), "actions": st.lists(action, min_size=2, max_size=2)}
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("agents"),
            "actions": st.dictionaries(
                word | st.sampled_from(["robot_0", "robot_1"]), action, max_size=3
            ),
        }
    ),
    st.fixed_dictionaries({"do": st.just("raw"), "actions": action}),
    st.fixed_dictionaries(
        {"do": st.just("reset"), "seed": scalar, "options": anything | st.none()}
    ),
    st.fixed_dictionaries(
        {"do": st.just("reset"), "seed": st.integers(0, 9), "options": st.none()}
    ),
    st.fixed_dictionaries({"do": st.just("mutate")}),
    st.fixed_dictionaries({"do": st.just("end")}),
)


@functools.cache
def parallel(kind: int) -> Any:
    fields = [
        {},
        {"action": "torque", "dtype": "float64", "observation": "sensor"},
        {"action": "tracking_twist", "plant": "batch"},
        {"action": "residual", "estimator": "ekf-slip", "disturbance": "combined-hard"},
    ][kind]
    return tlf_env.parallel_env("infinity", **{**SHORT, "horizon_s": 0.4, **fields})


@target(st.tuples(st.integers(0, 3), st.lists(moves, min_size=1, max_size=6)), share=2.0)
def actions(case: Any) -> None:
    """Streams of actions and resets in the parallel environment."""
    kind, stream = case
    env = parallel(kind)
    env.reset(seed=0)
    for move in stream:
        before = env.formation.step_count
        if move["do"] == "reset":
            done = refused(
                lambda: env.reset(seed=real(move["seed"]), options=real(move["options"])), TypeError
            )
            if done is not REFUSED:
                observed("at the start", env, *done)
            elif not env.agents and before == 0:
                raise ViolationError("a refused reset has ended the episode")
            continue
        if move["do"] == "mutate":
            given = {agent: np.zeros(2, np.float32) for agent in env.agents}
            result = env.step(given)
            for one in given.values():
                one[:] = np.nan
            for seen in result[0].values():
                seen[:] = np.nan
            if env.agents:
                result = env.step({agent: np.zeros(2) for agent in env.agents})
                observed("after arrays of the caller were changed", env, result[0], result[4])
            continue
        if move["do"] == "end":
            for _ in range(25):
                if env.agents:
                    env.step({agent: [0.0, 0.0] for agent in env.agents})
            if env.step({}) != ({}, {}, {}, {}, {}):
                raise ViolationError("a step after the end returns something")
            continue
        given = real(move["actions"])
        if move["do"] == "step":
            given = dict(zip(env.possible_agents, given, strict=True))
        done = refused(lambda: env.step(given))
        if done is REFUSED:
            if env.formation.step_count != before:
                raise ViolationError("a refused action has changed the episode")
            continue
        observed("after an action", env, done[0], done[4])
        finite("rewards after an action", list(done[1].values()))


@functools.cache
def batches(kind: int) -> Any:
    fields: dict[str, Any] = [{}, {"action": "tracking_twist"}, {"plant": "kinematic"}][kind]
    return tlf_env.BatchPlant("infinity", 2, **{**SHORT, "horizon_s": 0.4, **fields})


@functools.cache
def vectors(kind: int) -> FormationVectorEnv:
    mode = ["NextStep", "SameStep", "Disabled"][kind]
    return FormationVectorEnv("infinity", 2, autoreset_mode=mode, **{**SHORT, "horizon_s": 0.4})


batch_moves = st.one_of(
    st.fixed_dictionaries({"do": st.just("step"), "actions": action}),
    st.fixed_dictionaries(
        {
            "do": st.just("step"),
            "actions": st.lists(
                st.lists(st.lists(number, min_size=2, max_size=2), min_size=2, max_size=2),
                min_size=2,
                max_size=2,
            ),
        }
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("step"),
            "actions": st.lists(st.lists(number, min_size=2, max_size=2), min_size=2, max_size=2),
        }
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("reset"),
            "seed": scalar | st.lists(scalar, max_size=3),
            "mask": st.none() | arrays | st.lists(st.booleans(), max_size=3) | anything,
            "options": st.none()
            | anything
            | st.fixed_dictionaries(
                {},
                optional={
                    "poses": anything,
                    "phase_s": number | st.lists(number, max_size=2),
                    "reset_mask": anything | arrays,
                },
            ),
        }
    ),
    st.fixed_dictionaries({"do": st.just("shares"), "value": anything}),
)


@target(st.tuples(st.integers(0, 2), st.lists(batch_moves, min_size=1, max_size=5)), share=1.5)
def batch_actions(case: Any) -> None:
    """Streams of actions and resets on the batch plant and in the vector environment."""
    kind, stream = case
    plant, envs = batches(kind), vectors(kind)
    plant.reset(seed=0)
    envs.reset(seed=0)
    for move in stream:
        if move["do"] == "shares":
            refused(lambda: plant.set_shares(real(move["value"])))
        elif move["do"] == "reset":
            seed, mask, options = (real(move[one]) for one in ("seed", "mask", "options"))
            refused(lambda: plant.reset(seed, mask, options))
            done = refused(lambda: envs.reset(seed=seed, options=options), TypeError)
            if done is not REFUSED:
                finite("observations of a vector environment", done[0], OBSERVATION_LIMIT)
        else:
            given = real(move["actions"])
            if refused(lambda: plant.step(given), RuntimeError) is not REFUSED:
                finite("observations of a batch", plant.observations, OBSERVATION_LIMIT)
                finite("rewards of a batch", plant.rewards)
            done = refused(lambda: envs.step(given), RuntimeError)
            if done is not REFUSED:
                finite("observations of a vector environment", done[0], OBSERVATION_LIMIT)
                finite("rewards of a vector environment", done[1])


@functools.cache
def single() -> Any:
    return FormationEnv("infinity", **{**SHORT, "horizon_s": 0.4})


@functools.cache
def turns() -> Any:
    return tlf_env.aec_env("infinity", **{**SHORT, "horizon_s": 0.4})


@target(st.lists(action, min_size=1, max_size=4), share=1.5)
def single_actions(case: Any) -> None:
    """Streams of actions in the Gymnasium environment and in the turn-based one."""
    env, aec = single(), turns()
    env.reset(seed=0)
    aec.reset(seed=0)
    for one in case:
        given = real(one)
        done = refused(lambda: env.step(given), RuntimeError)
        if done is not REFUSED:
            finite("an observation of the learner", done[0], OBSERVATION_LIMIT)
            finite("a reward of the learner", done[1])
            if done[2] or done[3]:
                env.reset(seed=0)
        if not aec.agents:
            aec.reset(seed=0)
        if refused(lambda: aec.step(given), RuntimeError) is REFUSED:
            aec.reset(seed=0)
            continue
        finite("an observation of a turn", aec.observe(aec.agent_selection), OBSERVATION_LIMIT)


poses = st.lists(
    st.lists(st.one_of(st.floats(-1e4, 1e4), number), min_size=3, max_size=3),
    min_size=2,
    max_size=2,
)


@target(
    st.fixed_dictionaries(
        {"kind": st.integers(0, 3), "seed": st.integers(0, 99)},
        optional={"poses": poses, "phase_s": number},
    ),
    share=1.0,
)
def starts(case: Any) -> None:
    """Start poses, far, near and inside each other, and phases."""
    env = parallel(case["kind"])
    options = {name: case[name] for name in ("poses", "phase_s") if name in case}
    done = refused(lambda: env.reset(seed=case["seed"], options=options))
    if done is REFUSED:
        return
    observed("at a given start", env, *done)
    for _ in range(2):
        if env.agents:
            seen, rewards, _, _, infos = env.step({agent: [0.5, 0.1] for agent in env.agents})
            observed("after a given start", env, seen, infos)
            finite("rewards after a given start", list(rewards.values()))


@functools.cache
def attacked() -> tuple[Any, dict[str, Any]]:
    given: dict[str, Any] = {}
    env = tlf_env.parallel_env(
        "infinity", adversary=lambda _: given["values"], **{**SHORT, "end_on": []}
    )
    return env, given


@target(
    st.one_of(
        st.dictionaries(
            st.sampled_from([one.path for one in CHANNELS]),
            st.one_of(number, st.lists(number, min_size=2, max_size=2), arrays, anything),
            max_size=3,
        ),
        st.lists(st.tuples(st.integers(0, len(CHANNELS) - 1), st.floats(0, 1)), max_size=4),
        anything,
    ),
    share=1.0,
)
def adversaries(case: Any) -> None:
    """What an adversary returns, hostile or within the channels' ranges."""
    env, given = attacked()
    env.reset(seed=0)
    values = real(case)
    pairs = isinstance(case, list) and all(isinstance(one, list) and len(one) == 2 for one in case)
    if pairs and all(type(which) is int and type(share) is float for which, share in case):
        values = {}
        for which, share in case:
            channel = CHANNELS[which % len(CHANNELS)]
            values[channel.path] = channel.low + min(max(float(share), 0.0), 1.0) * (
                channel.high - channel.low
            )
    given["values"] = values
    for _ in range(3):
        done = refused(lambda: env.step({agent: [0.4, 0.1] for agent in env.agents}))
        if done is REFUSED:
            return
        observed("with an adversary", env, done[0], done[4])
        finite("rewards with an adversary", list(done[1].values()))


# Plans, trainings, searches, results.


@functools.cache
def plan_bases() -> list[Any]:
    return [read_preset_or_file("plan", name) for name in preset_names("plan")]


@functools.cache
def training_bases() -> list[Any]:
    return [load_config(name).model_dump(mode="json") for name in ("quick", "residual", "scratch")]


@functools.cache
def search_bases() -> list[Any]:
    return [
        read_preset_or_file("search", name) for name in preset_names("search") if name != "nmpc"
    ]


@functools.cache
def knob_bases() -> list[Any]:
    return [read_preset_or_file("knob", name) for name in preset_names("knob")]


@target(changed(plan_bases), share=1.5)
def plans(case: Any) -> None:
    """Plans of a benchmark, and the texts of its options."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        found = refused(lambda: read_plan("own.yaml", PLAN_OPTIONS))
    if found is REFUSED:
        return
    for name, parse in (("seeds", parse_seeds), ("sweep", parse_sweep), ("also", parse_pairs)):
        if name in found:
            refused(lambda: parse(str(found[name])))


@target(st.one_of(word, st.text(alphabet="0123456789:=.,logeE+-x", max_size=20)), share=2.0)
def option_texts(case: str) -> None:
    """Texts of seeds, sweeps and pairs."""
    for parse in (parse_seeds, parse_sweep, parse_pairs):
        found = refused(lambda: parse(case))
        if parse is parse_sweep and found is not REFUSED:
            finite("values of a sweep", found[1])


@target(changed(training_bases, most=3), share=0.5)
def trainings(case: Any) -> None:
    """Configurations of trainings."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        refused(lambda: load_config("own.yaml"))


@target(changed(search_bases, most=3), share=0.3)
def searches(case: Any) -> None:
    """Configurations of searches."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        refused(lambda: load_tune("own.yaml"))


@target(changed(knob_bases, most=3), share=1.0)
def knobs(case: Any) -> None:
    """Knobs of envelopes."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        found = refused(lambda: load_knob("own.yaml"))
        if found is not REFUSED:
            for level in (found.levels[0], found.levels[-1]):
                refused(lambda: found.scenario("infinity", level, 2.0))


@functools.cache
def run_files() -> tuple[Any, bytes]:
    from baselines.runs.files import summary, write_record

    scenario = load_scenario("infinity", **{**SHORT, "horizon_s": 0.4})
    record = run_policy(scenario, make_policy("reference", scenario), name="reference")
    with working_folder() as folder:
        write_record(record, folder)
        data = (folder / "trajectory.npz").read_bytes()
    return json.loads(json.dumps(summary(record))), data


@target(
    st.one_of(changed(lambda: [run_files()[0]], most=2), damaged(lambda: [run_files()[1]])),
    share=0.7,
)
def results(case: Any) -> None:
    """Folders of runs: their summaries and arrays."""
    about, data = run_files()
    if isinstance(case, bytes):
        data = case
    else:
        about = case
    with working_folder() as folder:
        (folder / "summary.json").write_text(json.dumps(about))
        (folder / "trajectory.npz").write_bytes(data)
        found = refused(lambda: read_record(folder))
        if found is not REFUSED:
            finite("times of a record", found.t_s)
        identity = Identity("0" * 12, "reference", None, 0, "{}")
        refused(lambda: check_room(folder, identity, overwrite=False))


@functools.cache
def array_files() -> list[dict[str, Any]]:
    with np.load(io.BytesIO(run_files()[1])) as file:
        return [{name: list(file[name].shape) for name in file.files}]


@target(
    st.tuples(
        st.integers(0, 60),
        st.sampled_from(["nan", "shape", "dtype", "text", "object", "missing", "long"]),
    ),
    share=0.1,
)
def result_arrays(case: Any) -> None:
    """Arrays of a run with another type, shape or number, shown on a page."""
    from baselines.pages.replay import write_replay

    which, what = case
    with np.load(io.BytesIO(run_files()[1])) as file:
        found = {name: file[name] for name in file.files}
    name = sorted(found)[which % len(found)]
    old = found[name]
    if what == "missing":
        del found[name]
    elif what == "nan":
        found[name] = np.full(old.shape, np.nan)
    elif what == "shape":
        found[name] = old[..., None]
    elif what == "dtype":
        found[name] = old.astype(np.complex64)
    elif what == "text":
        found[name] = old.astype("U5")
    elif what == "object":
        found[name] = np.array([object()], dtype=object)
    else:
        found[name] = np.concatenate([old, old])
    with working_folder() as folder:
        (folder / "summary.json").write_text(json.dumps(run_files()[0]))
        with (folder / "trajectory.npz").open("wb") as file:
            np.savez(file, **found)
        record = refused(lambda: read_record(folder))
        if record is not REFUSED:
            refused(lambda: write_replay(record, folder / "replay.html"))
            refused(record.metrics)


@target(damaged(lambda: [b'{"seed": 1, "policy": "a"}\n{"seed": 2, "policy": "b"}\n']), share=2.0)
def result_lines(case: bytes) -> None:
    """Files of a line for each finished piece of work."""
    with working_folder() as folder:
        (folder / "runs.jsonl").write_bytes(case)
        refused(lambda: read_lines(folder / "runs.jsonl", lambda line: line["seed"]))


@functools.cache
def data_sets() -> list[bytes]:
    from baselines.data.episodes import entry_names, robots_of
    from baselines.data.files import About, write_parquet

    scenario = load_scenario("infinity", **{**SHORT, "horizon_s": 0.2})
    robots_ = robots_of(scenario, make_policy("reference", scenario), 0)
    about = About(
        policy="reference",
        action=scenario.action,
        observation=scenario.observation,
        entries=entry_names(scenario),
        control_period_s=scenario.control_period_s,
        scenario=str(scenario),
        versions={},
        noise=0.0,
    )
    with working_folder() as folder:
        write_parquet(robots_, about, folder / "own.parquet")
        return [(folder / "own.parquet").read_bytes()]


@st.composite
def damaged_set(draw: Any) -> bytes:
    data = bytearray(data_sets()[0])
    for _ in range(draw(st.integers(1, 6))):
        place = draw(st.integers(0, len(data) - 1))
        data[place] = draw(st.integers(0, 255))
    return bytes(data)


@target(damaged_set(), share=0.5)
def datasets(case: bytes) -> None:
    """Data sets for offline learning."""
    from baselines.data.files import fitting_rows

    with working_folder() as folder:
        (folder / "own.parquet").write_bytes(case)
        refused(lambda: fitting_rows(folder / "own.parquet", load_scenario("infinity", **SHORT)))


# Constructors, and the command line.

ARGUMENTS: dict[str, Any] = {
    name: st.one_of(anything, arrays, st.fixed_dictionaries({"!": st.just("object")}))
    for name in (
        "scenario", "render_mode", "adversary", "infos", "learner", "others", "trust", "formations", "threads",
        "mixture", "staggered", "autoreset_mode", "max_episode_steps", "num_envs", "residual_base", "estimator",
        "wheel_loop", "observer", "disturbance_level", "no_such_field", *Scenario.model_fields,
    )
}  # fmt: skip


@target(
    st.tuples(
        st.sampled_from(
            [
                "parallel_env",
                "aec_env",
                "BatchPlant",
                "FormationEnv",
                "FormationVectorEnv",
                "load_scenario",
            ]
        ),
        st.lists(st.sampled_from(list(ARGUMENTS)), max_size=3, unique=True).flatmap(
            lambda names: st.fixed_dictionaries({name: ARGUMENTS[name] for name in names})
        ),
    ),
    share=1.5,
)
def constructors(case: Any) -> None:
    """Arguments of everything that makes an environment."""
    name, fields = case
    given = {key: real(value) for key, value in fields.items()}
    if isinstance(given.get("render_mode"), str) and given["render_mode"] == "human":
        return
    for key in ("formations", "num_envs", "threads", "robots"):
        if isinstance(given.get(key), int) and given[key] > 50:
            return
    made: Any = {"FormationEnv": FormationEnv, "FormationVectorEnv": FormationVectorEnv}.get(name)
    made = made or getattr(tlf_env, name)
    scenario = given.pop("scenario", "infinity")
    usual = {key: value for key, value in SHORT.items() if key not in given}
    if name == "load_scenario":
        refused(lambda: made(scenario, **usual, **given), TypeError)
        return
    if name == "BatchPlant":
        given.setdefault("formations", 1)
    with working_folder():
        checked = refused(
            lambda: load_scenario(
                scenario,
                **{
                    key: value
                    for key, value in {**usual, **given}.items()
                    if key in Scenario.model_fields
                },
            ),
            TypeError,
        )
        if isinstance(checked, Scenario) and not small(checked):
            return
        env = refused(lambda: made(scenario, **usual, **given), TypeError)
        if env is REFUSED or name in ("BatchPlant", "FormationVectorEnv"):
            return
        refused(lambda: env.reset(seed=0), ImportError, TypeError)


@target(
    st.lists(
        st.one_of(
            st.tuples(
                st.sampled_from([".".join(map(str, path)) for path in places(plain({})) if path]),
                st.one_of(word, number.map(str)),
            ).map("=".join),
            word,
        ),
        min_size=1,
        max_size=2,
    ),
    share=2.0,
)
def settings(case: Any) -> None:
    """Texts of ``--set``."""
    from baselines.commands.scenarios import asked_scenario

    with working_folder():
        found = refused(lambda: asked_scenario("infinity", SHORT, None, case))
    if found is not REFUSED:
        described(found)


WORDS: dict[str, list[str]] = {
    "show": ["infinity", "--disturbance", "--level", "--set", "--changes"],
    "list": ["tasks", "policies", "--json"],
    "run": [
        "infinity", "--disturbance", "--level", "--set", "--policy", "--gains", "--estimator", "--wheel-loop",
        "--observer", "--seed", "--robots", "--plant", "--control-period-s", "--horizon-s", "--phase-s",
        "--poses", "--out", "--video", "--video-fps", "--video-speed", "--mat", "--parquet", "--json",
    ],
    "path": ["log.csv", "--out", "--columns", "--units", "--smooth", "--speed-limit"],
    "openloop": ["open.json", "--out", "--dt-s", "--plant", "--json"],
    "compare": ["a", "b", "--out", "--video", "--video-fps"],
    "bench": [
        "--policies", "--tasks", "--disturbances", "--also", "--seeds", "--level", "--sweep", "--knobs",
        "--plan", "--plant", "--processes", "--horizon-s", "--entry", "--check", "--test-seed", "--replays",
    ],
    "eval": ["residual", "--against", "--disturbances", "--tasks", "--seeds", "--horizon-s"],
    "export": ["infinity", "--policy", "--seeds", "--horizon-s", "--noise", "--form", "--name", "--joint"],
    "train": ["quick", "--seeds", "--robot-steps", "--processes", "--search", "--trials"],
    "tune": ["adrc", "--trials", "--workers"],
    "speed": ["--formations", "--steps", "--threads"],
    "demo": ["--seed", "--out"],
    "compile": ["--all"],
    "paper": ["--figures"],
    "view": ["infinity", "--theme", "--policy"],
    "play": ["infinity", "--horizon-s", "--out"],
    "nothing": [],
}  # fmt: skip
# One hostile word at least: what is left over is a valid command, which would run for long.
WRONG = st.sampled_from(
    [
        "nan",
        "inf",
        "-1",
        "",
        "x",
        "1e999",
        "a:b",
        "\x00",
        "../..",
        "[",
        "0",
        "1,,2",
        "=",
        "é",
        "-",
        "--",
        "--no-such",
        "10:5",
    ]
)


@st.composite
def command_lines(draw: Any) -> list[str]:
    name = draw(st.sampled_from(list(WORDS)))
    words = [name]
    positional = [one for one in WORDS[name] if not one.startswith("--")]
    words += positional[: draw(st.integers(0, 2))]
    for _ in range(draw(st.integers(1, 3))):
        options = [one for one in WORDS[name] if one.startswith("--")]
        if options:
            words.append(draw(st.sampled_from(options)))
        words.append(draw(st.one_of(WRONG, word)))
    return words


SLOW = ("paper", "compile", "demo", "speed", "train", "tune", "bench", "eval")


@target(command_lines(), share=0.7)
def commands(case: list[str]) -> None:
    """Words of the command line: a status, and one line for what is wrong."""
    if any("\x00" in one for one in case):
        return  # no shell can give it
    if (
        case[0] in SLOW
    ):  # what is left of a wrong command may run for long: only its check is of interest
        case = [*case, "--out", "/dev/null/none"]
    ran(["tlf", *case], case)


def ran(words: list[str], case: list[str]) -> None:
    out, err = io.StringIO(), io.StringIO()
    before = sys.argv
    status: Any = 0
    with working_folder() as folder:
        (folder / "log.csv").write_bytes(LOGS[0])
        (folder / "open.json").write_text(json.dumps(TORQUES[0]))
        sys.argv = words
        os.environ["COLUMNS"] = "500"
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                import baselines.console as console

                for one in (console.notes, console.screen):
                    one.file = err if one is console.notes else out
                cli.main()
        except SystemExit as left:
            status = left.code
        finally:
            sys.argv = before
            for one in (console.notes, console.screen):
                one.file = None
    said = err.getvalue()
    if status not in (None, 0, 1, 2, 130):
        raise ViolationError(f"status {status!r}", shlex.join(case))
    if "Traceback" in said:
        raise ViolationError("a traceback on the command line", said[-300:])
    if status in (1, 2):
        lines = [one for one in said.splitlines() if one.startswith("tlf: ")]
        if not lines:
            raise ViolationError(f"status {status} without a line that says why", said[-300:])
