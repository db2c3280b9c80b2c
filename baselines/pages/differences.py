"""What differs between runs: fields of their scenarios, and what came out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from baselines.runs.run import Record
from tlf_env.task.metrics import RobotMetrics

NONE = "–"


def _worst(name: str, digits: int) -> Callable[[Sequence[RobotMetrics]], str]:
    def cell(robots: Sequence[RobotMetrics]) -> str:
        found = [getattr(robot, name) for robot in robots]
        known = [value for value in found if value is not None]
        return f"{max(known):.{digits}f}" if known else NONE

    return cell


RESULTS: dict[str, Callable[[Sequence[RobotMetrics]], str]] = {
    "robots lost": lambda robots: str(sum(robot.lost for robot in robots)),
    "robots that touched something": lambda robots: str(sum(robot.touched for robot in robots)),
    "position RMS of the worst robot, mm": _worst("position_rmse_mm", 2),
    "largest position error, mm": _worst("position_max_mm", 1),
    "formation RMS of the worst robot, mm": _worst("formation_rmse_mm", 2),
    "time-gap RMS of the worst robot, s": _worst("time_gap_rmse_s", 4),
    "heading RMS of the worst robot, rad": _worst("heading_rmse_rad", 4),
    "torque at its limit, % of the time, worst robot": lambda robots: (
        f"{100 * max(robot.saturation_fraction for robot in robots):.1f}"
    ),
    "energy of all robots, J": lambda robots: f"{sum(robot.energy_J for robot in robots):.2f}",
    "mean score": lambda robots: f"{sum(robot.score for robot in robots) / len(robots):.1f}",
}


def differences(records: Sequence[Record]) -> list[tuple[str, list[str]]]:
    """A row for each field that differs, then one for each result, with a cell for each run."""
    settings = [
        {
            "policy": record.policy,
            "seed": str(record.seed),
            "reset options": str(record.options or NONE),
            "simulated, s": f"{record.t_s[-1]:.6g}",
            **dict(_flat(record.scenario.model_dump(mode="json"))),
        }
        for record in records
    ]
    fields = dict.fromkeys(field for one in settings for field in one)
    rows = [(field, [one.get(field, NONE) for one in settings]) for field in fields]
    robots = [record.metrics() for record in records]
    return [
        *((field, cells) for field, cells in rows if len(set(cells)) > 1),
        *((name, [cell(one) for one in robots]) for name, cell in RESULTS.items()),
    ]


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Leaves of nested mappings and lists, with their paths."""
    if isinstance(value, Mapping) and value:
        for key, one in value.items():
            yield from _flat(one, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for number, one in enumerate(value):
            yield from _flat(one, f"{path}.{number}")
    else:
        yield path, NONE if value is None else str(value)
