"""Where a scenario comes from: presets, YAML files, paths, and how one is built on another.

Everything here is plain mappings and lists. :mod:`tlf_env.task.scenario` validates them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tlf_env.common.errors import path_text, shown
from tlf_env.common.models import is_number
from tlf_env.common.presets import beside, is_file_name, is_path_file, read_preset_or_file
from tlf_env.onboard.limiters import load_limiter
from tlf_env.task.waypoints import read_points, scenario_of_waypoints

DEFAULT_CONTROL_PERIOD_S = 0.02
BASE = "base"  # key of a scenario and of a disturbance: what it is built on
NAMES_A_FILE = (BASE, "disturbance", "trajectory", "world")  # may name a file beside the scenario's
MOST_BASES = 20  # built on each other
NOT_IN_NAMES = re.compile(r"^[^\w]+|[^\w.+-]")


def name_of(path: Path) -> str:
    """The name of a scenario from its file's name; characters that are not allowed become ``_``."""
    return NOT_IN_NAMES.sub("_", path.stem)[:100]


def merged(old: Any, new: Any) -> Any:
    """``new`` over ``old``: mappings are merged, unless the new one has a ``type``; all else is replaced."""
    if isinstance(old, Mapping) and isinstance(new, Mapping) and "type" not in new:
        return {**old, **{key: merged(old.get(key), value) for key, value in new.items()}}
    return new


def scenario_data(
    source: str | Path | Mapping[str, Any], control_period_s: Any = None
) -> dict[str, Any]:
    """The fields of a scenario from a preset's name, a file or a mapping, over those of its ``base``.

    Parameters
    ----------
    control_period_s
        Of the scenario, s: a path's horizon is a multiple of it. 0.02 for None and whatever is no number.

    Raises
    ------
    ValueError
        for a source that is none of these or cannot be read, and for bases that never end.
    """

    def read(one: Any) -> dict[str, Any]:
        return _scenario_alone(one, control_period_s)

    return _with_bases("scenario", source, read)


def disturbance_data(source: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """A disturbance from a preset's name, a file or a mapping, over the channels of its ``base``.

    Raises
    ------
    ValueError
        as :func:`scenario_data`.
    """
    return _with_bases("disturbance", source, _disturbance_alone)


def trajectory_data(source: str | Path) -> dict[str, Any]:
    """The trajectory of a scenario, by a preset's name or a file, or the waypoints of a path.

    Raises
    ------
    ValueError
        as :func:`scenario_data`; for a scenario without a trajectory.
    """
    named: Any = source
    for _ in range(MOST_BASES):
        if is_path_file(named):
            return {"type": "waypoints", "points": read_points(Path(named))}
        named = scenario_data(named).get("trajectory")
        if isinstance(named, Mapping):
            return dict(named)
        if not isinstance(named, str | Path):
            raise ValueError(f"scenario {path_text(source)} has no trajectory")
    raise ValueError(f"{path_text(source)}: more than {MOST_BASES} scenarios name each other")


def _with_bases(kind: str, source: Any, read: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
    """What a source has over what its base has, and so on."""
    layers = [read(source)]
    while (base := layers[-1].pop(BASE, None)) is not None:
        if not isinstance(base, str | Path):
            raise ValueError(f"{BASE} {shown(base)} must be the name of a {kind}, or a file")
        if len(layers) > MOST_BASES:
            raise ValueError(
                f"{BASE} {path_text(base)}: more than {MOST_BASES} of them are built on each other"
            )
        layers.append(read(base))
    found: dict[str, Any] = {}
    for layer in reversed(layers):
        found = {**found, **{key: merged(found.get(key), value) for key, value in layer.items()}}
    return found


def _scenario_alone(source: Any, control_period_s: Any) -> dict[str, Any]:
    """A scenario's own fields."""
    if isinstance(source, Mapping):
        return dict(source)
    if not isinstance(source, str | Path):
        raise ValueError(
            f"scenario {shown(source)} must be a preset's name, a file, a mapping or a Scenario"
        )
    path = Path(source)
    if is_path_file(path):
        given = is_number(control_period_s) and 0 < control_period_s < math.inf
        found = scenario_of_waypoints(
            path, float(control_period_s) if given else DEFAULT_CONTROL_PERIOD_S
        )
        return {**found, "name": name_of(path), "disturbance": "nominal"}
    found = read_preset_or_file("scenario", source, ", nor a .csv file of waypoints")
    if not is_file_name(source):
        return {"name": str(source), **found}
    found |= {key: beside(path.parent, found[key]) for key in NAMES_A_FILE if key in found}
    return {"name": name_of(path), **found}


def _disturbance_alone(source: Any) -> dict[str, Any]:
    """A disturbance's own channels, with the name that it has by its source."""
    if isinstance(source, Mapping):
        return dict(source)
    found = read_preset_or_file("disturbance", source, ", nor a mapping")
    if list(found) == ["disturbance"]:
        raise ValueError(
            f"{path_text(source)} has the key disturbance; a disturbance's file has its channels at the top"
        )
    path = Path(source)
    if not is_file_name(source):
        return {"name": str(source), **found}
    if BASE in found:
        found[BASE] = beside(path.parent, found[BASE])
    return {"name": name_of(path), **found}


def set_field(data: dict[str, Any], path: str, value: Any) -> None:
    """Set one field of a scenario's plain data by its path, as ``disturbance.slip.delta_1_mm_s``.

    What a path leads through may be missing, or may be a name: the named disturbance, trajectory, world or
    limiter is then put in its place. The number of an entry leads into a list (``robots.0.mass_kg``).

    Raises
    ------
    ValueError
        for a path through a value that has no parts, or an entry that a list does not have.
    """
    keys = path.split(".")
    if not all(keys):
        raise ValueError(
            f"{shown(path)} must be a field, as time_gap_s, or a path of them with dots"
        )
    part: Any = data
    for depth, key in enumerate(keys[:-1]):
        inner = _entry(part, key, path)
        if isinstance(inner, str) and depth == 0 and key in NAMED:
            inner = NAMED[key](inner)
        inner = {} if inner is None else inner
        if not isinstance(inner, Mapping | list | tuple):
            place = ".".join(keys[: depth + 1])
            raise ValueError(f"{path}: {place} is {shown(inner)}, which has no parts")
        # Copied, as it may belong to the caller.
        part = _put(part, key, dict(inner) if isinstance(inner, Mapping) else list(inner))
    _entry(part, keys[-1], path)
    _put(part, keys[-1], value)


def _entry(part: Any, key: str, path: str) -> Any:
    """What a mapping or a list holds at a key; None for a key that a mapping does not have."""
    if isinstance(part, dict):
        return part.get(key)
    if not key.isdecimal() or int(key) >= len(part):
        raise ValueError(f"{path}: {shown(key)} must be a number from 0 to {len(part) - 1}")
    return part[int(key)]


def _put(part: Any, key: str, value: Any) -> Any:
    part[key if isinstance(part, dict) else int(key)] = value
    return value


# Fields that may be a name, and what gives the mapping that the name stands for.
NAMED: dict[str, Callable[[str], dict[str, Any]]] = {
    "disturbance": disturbance_data,
    "trajectory": trajectory_data,
    "world": lambda name: read_preset_or_file("world", name, ", nor a mapping"),
    "limiter": lambda name: load_limiter(name).model_dump(),
}
