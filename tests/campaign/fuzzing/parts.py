"""Parts of scenarios: disturbances, worlds, robots and trajectories."""

from __future__ import annotations

import functools
from typing import Any, get_args

import numpy as np
from campaign.fuzzing.cases import changed, number
from campaign.fuzzing.checks import REFUSED, driven, driven_in_a_batch, finite, refused
from campaign.fuzzing.registry import target
from campaign.fuzzing.scenarios import SHORT, described
from hypothesis import strategies as st

from tlf_env.common.presets import preset_names
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.disturbances.signals import Signal
from tlf_env.task.scenario import load_scenario, scenario_warnings
from tlf_env.task.trajectories import reference_from


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
