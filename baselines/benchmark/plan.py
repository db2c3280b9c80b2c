"""What a benchmark runs: policies × tasks × disturbances × seeds, from options or a plan file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from baselines.runs.nested import with_value
from baselines.runs.seed_ranges import SeedRange
from tlf_env.common.errors import key_text, nearest, shown
from tlf_env.common.presets import beside, is_file_name, preset_names, read_preset_or_file
from tlf_env.common.trust import Trust
from tlf_env.disturbances.model import Disturbance
from tlf_env.task.scenario import Scenario, load_scenario

MOST_SEEDS = 1_000_000
MOST_SWEPT = 10_000  # values of a sweep
SWEEP_DIGITS = 6  # of values that are not given but computed on a logarithmic scale


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

    ``also`` are pairs of a task and a disturbance that are run beside all pairs of ``tasks`` and
    ``disturbances``. ``overrides`` are fields of every scenario; ``sweep`` is the path of a knob: a parameter
    of the disturbance, its ``level``, or a field of the scenario.
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
    trust: Trust = False
    also: tuple[tuple[str, str], ...] = ()

    @property
    def places(self) -> tuple[tuple[str, str], ...]:
        """Every pair of a task and a disturbance, in the order of the tables."""
        pairs = itertools.product(self.tasks, self.disturbances)
        return tuple(dict.fromkeys((*pairs, *self.also)))

    @property
    def values(self) -> tuple[float | None, ...]:
        """Values of the swept knob; only None without a sweep."""
        return self.sweep_values if self.sweep else (None,)

    def episodes(self) -> list[Episode]:
        """All episodes in the order of the tables; seeds vary slowest, so that early results cover all."""
        return [
            Episode(policy, task, disturbance, self.level, value, seed)
            for seed in range(*self.seeds)
            for task, disturbance in self.places
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
            head = self.sweep.partition(".")[0]
            if self.sweep == "level":
                level = episode.sweep
            else:
                base = load_scenario(episode.task, disturbance=disturbance, **overrides)
                of_disturbance = (
                    head in Disturbance.model_fields or head not in Scenario.model_fields
                )
                tree = (base.disturbance if of_disturbance else base).model_dump()
                try:
                    changed = with_value(tree, self.sweep, episode.sweep)
                except ValueError as error:
                    raise ValueError(f"sweep: {error}") from error
                if of_disturbance:
                    disturbance = changed
                else:
                    overrides[head] = changed[head]
        return load_scenario(
            episode.task, disturbance=disturbance, disturbance_level=level, **overrides
        )


def parse_sweep(text: str) -> tuple[str, tuple[float, ...]]:
    """A path and its values: ``path=first:last:count``, geometric with ``:log``, or ``path=value,value,...``.

    Raises
    ------
    ValueError
        if the text has another form.
    """
    path, _, span = text.partition("=")
    try:
        values = _values(span)
        if not path or len(values) < 2 or not all(map(math.isfinite, values)):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"sweep {text!r} must be PATH=FIRST:LAST:COUNT with COUNT from 2 to {MOST_SWEPT}, "
            "e.g. slip.delta_1_mm_s=0:40:9; PATH=FIRST:LAST:COUNT:log with FIRST and LAST above 0; or "
            "PATH=VALUE,VALUE,..."
        ) from None
    return path, values


def _values(span: str) -> tuple[float, ...]:
    if ":" not in span:
        return tuple(map(float, span.split(",")))
    ends = span.removesuffix(":log")
    first, last, count = (
        kind(part) for kind, part in zip((float, float, int), ends.split(":"), strict=True)
    )
    if count > MOST_SWEPT:
        raise ValueError
    shares = [i / (count - 1) for i in range(count)] if count > 1 else []
    if ends == span:
        return tuple(first + (last - first) * share for share in shares)
    if min(first, last) <= 0:
        raise ValueError
    return tuple(float(f"{first * (last / first) ** share:.{SWEEP_DIGITS}g}") for share in shares)


def parse_pairs(text: str) -> tuple[tuple[str, str], ...]:
    """``task:disturbance,task:disturbance,...`` as pairs; none for an empty text.

    Raises
    ------
    ValueError
        if a part has another form.
    """
    pairs = []
    for part in filter(None, map(str.strip, text.split(","))):
        task, _, disturbance = part.rpartition(":")
        if not task or not disturbance:
            raise ValueError(
                f"also {part!r} must be TASK:DISTURBANCE, e.g. infinity_hardware:hardware"
            )
        pairs.append((task, disturbance))
    return tuple(pairs)


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
    if int(end) - int(first) > MOST_SEEDS:
        raise ValueError(f"seeds {text!r} are more than {MOST_SEEDS}, the most of a plan")
    return int(first), int(end)


def read_plan(name: str, fields: Collection[str]) -> dict[str, Any]:
    """The options of ``tlf bench`` that a plan sets, in the form that the command line has.

    ``policies`` may be a mapping of ``controllers``, ``estimators`` and ``limiters``, which stands for all
    systems of these parts.

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
        if field == "policies" and isinstance(value, dict):
            value = crossed(name, value)
        options[field] = ",".join(map(str, value)) if isinstance(value, list) else value
        if isinstance(value, bool) or not isinstance(options[field], str | int | float):
            raise ValueError(f"plan {name!r}: {field} must be a text, a number or a list")
    return options


def crossed(plan: str, parts: dict[str, Any]) -> list[str]:
    """The names of all systems of some controllers, estimators and limiters, by controller first.

    Raises
    ------
    ValueError
        for a missing or an unknown part, or one that is not a list of names.
    """
    wanted = ("controllers", "estimators", "limiters")
    for part in (*wanted, *parts):
        names = parts.get(part)
        if part not in wanted or not (names and isinstance(names, list)):
            raise ValueError(
                f"plan {plan!r}: policies.{key_text(part)} is {shown(names)}; policies is a list of names, "
                f"or a mapping of {', '.join(wanted)} to one list of names each"
            )
    return ["+".join(map(str, names)) for names in itertools.product(*(parts[w] for w in wanted))]


def disturbance_presets() -> list[str]:
    """Names of all disturbance presets."""
    return preset_names("disturbance")
