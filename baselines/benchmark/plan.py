"""What a benchmark runs: policies × tasks × disturbances × seeds, from options or a plan file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from baselines.runs.nested import with_value
from baselines.runs.seed_ranges import SeedRange
from tlf_env.common.errors import nearest
from tlf_env.common.presets import beside, is_file_name, preset_names, read_preset_or_file
from tlf_env.task.scenario import Scenario, load_scenario


class Episode(NamedTuple):
    """One episode of the table."""

    policy: str
    task: str
    disturbance: str
    level: float
    sweep: float | None  # value of the swept knob
    seed: int

    @classmethod
    def of_line(cls, line: dict[str, Any]) -> Episode:
        """The episode that a line of ``runs.jsonl`` records.

        Raises
        ------
        KeyError
            if a field is missing.
        """
        return cls(*(line[name] for name in cls._fields))


@dataclass(frozen=True)
class Plan:
    """The episodes to be run.

    ``overrides`` are fields of every scenario; ``sweep`` is the path of a knob, a disturbance's parameter.
    """

    unrecorded: ClassVar[tuple[str, ...]] = ("trust",)  # a permission, which changes no result

    policies: tuple[str, ...]
    tasks: tuple[str, ...]
    disturbances: tuple[str, ...]
    seeds: SeedRange
    level: float = 1.0
    sweep: str | None = None
    sweep_values: tuple[float, ...] = ()
    overrides: tuple[tuple[str, Any], ...] = ()
    trust: bool = False

    @property
    def values(self) -> tuple[float | None, ...]:
        """Values of the swept knob; only None without a sweep."""
        return self.sweep_values if self.sweep else (None,)

    def episodes(self) -> list[Episode]:
        """All episodes in the order of the tables; seeds vary slowest, so that early results cover all."""
        return [
            Episode(policy, task, disturbance, self.level, value, seed)
            for seed in range(*self.seeds)
            for task in self.tasks
            for disturbance in self.disturbances
            for value in self.values
            for policy in self.policies
        ]

    def scenario(self, episode: Episode) -> Scenario:
        """The scenario of one episode.

        Raises
        ------
        ValueError
            for an unknown task, disturbance or knob, or a value outside its range.
        """
        overrides = dict(self.overrides)
        disturbance: Any = episode.disturbance
        level = episode.level
        if self.sweep is not None and episode.sweep is not None:
            if self.sweep == "level":
                level = episode.sweep
            else:
                base = load_scenario(episode.task, disturbance=disturbance).disturbance
                try:
                    disturbance = with_value(base.model_dump(), self.sweep, episode.sweep)
                except ValueError as error:
                    raise ValueError(f"sweep: {error}") from error
        return load_scenario(
            episode.task, disturbance=disturbance, disturbance_level=level, **overrides
        )


def parse_sweep(text: str) -> tuple[str, tuple[float, ...]]:
    """``path=first:last:count`` as the path and the values.

    Raises
    ------
    ValueError
        if the text has another form.
    """
    path, _, span = text.partition("=")
    parts = span.split(":")
    try:
        first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
        if len(parts) != 3 or count < 2 or not path:
            raise ValueError
    except (ValueError, IndexError):
        raise ValueError(
            f"sweep {text!r} must be PATH=FIRST:LAST:COUNT with COUNT at least 2, "
            "e.g. slip.delta_1_mm_s=0:40:9"
        ) from None
    return path, tuple(first + (last - first) * i / (count - 1) for i in range(count))


def parse_seeds(text: str) -> SeedRange:
    """``first:end`` as two numbers; ``end`` itself is not run.

    Raises
    ------
    ValueError
        if the text has another form.
    """
    first, _, end = text.partition(":")
    if not (first.isdecimal() and end.isdecimal() and int(first) < int(end)):
        raise ValueError(f"seeds {text!r} must be FIRST:END, e.g. 20000:20050")
    return int(first), int(end)


def read_plan(name: str, fields: Collection[str]) -> dict[str, Any]:
    """The options of ``tlf bench`` that a plan sets, in the form that the command line has.

    Parameters
    ----------
    name
        A plan's name (``board``) or a YAML file that maps options to values; a list means
        comma-separated names.
    fields
        Options that a plan may set.

    Raises
    ------
    ValueError
        for an unknown plan, an unknown field, or a value of the wrong type.
    """
    found = read_preset_or_file("plan", name)
    options = {}
    for field, value in found.items():
        if field not in fields:
            raise ValueError(
                f"plan {name!r} has {field!r}; a plan has {', '.join(sorted(fields))}"
                f"{nearest(field, fields)}"
            )
        if field == "disturbances" and is_file_name(name):
            names = [one.strip() for one in value.split(",")] if isinstance(value, str) else value
            value = beside(Path(name).parent, names)
        options[field] = ",".join(map(str, value)) if isinstance(value, list) else value
        if isinstance(value, bool) or not isinstance(options[field], str | int | float):
            raise ValueError(f"plan {name!r}: {field} must be a text, a number or a list")
    return options


def disturbance_presets() -> list[str]:
    """Names of all disturbance presets."""
    return preset_names("disturbance")
