"""Envelopes: how strong a disturbance may be before a system fails; the knobs, the levels and the search.

A *knob* is a disturbance whose level is raised. A level *holds* if at least 95 % of the runs, one for each
seed, do not fail. The envelope is the largest level that holds together with all tested levels below it.

All levels have the same seeds. If each seed fails from a level of its own on, the envelope is a quantile of
these levels: the one that 5 % of the seeds have reached. Its interval is the distribution-free one of a
quantile, between two order statistics, which are two more counts of failed seeds (G. J. Hahn and W. Q. Meeker,
Statistical Intervals, 1991, chapter 5).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

from pydantic import ValidationError, model_validator
from scipy.stats import binom

from baselines.runs.nested import value_at
from baselines.runs.seed_ranges import SeedRange
from tlf_env.common.errors import one_line
from tlf_env.common.models import Frozen, NonNegative, Positive, is_number
from tlf_env.common.presets import beside, is_file_name, preset_names, read_preset_or_file
from tlf_env.common.trust import Trust
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.disturbances.model import Disturbance
from tlf_env.task.scenario import Scenario, load_scenario

HELD_SHARE = 0.95  # of the seeds, at a level that holds
CONFIDENCE = 0.95
RESOLUTION = 0.05
COARSE_FACTOR = 2.0  # largest ratio of the levels that are tested first
LEVEL_DIGITS = 4
START_RAMP_S = 6.0  # envelopes are of driving; without a ramp many end with the first two seconds
PATCHES = "tyre.patches."
TASK = "infinity"


class Knob(Frozen):
    """A disturbance, and the levels between which its envelope is searched."""

    disturbance: Disturbance
    shown: str  # path of the number in the disturbance that tables show
    levels: tuple[Positive, Positive]  # the first and the last; geometric between them
    start_ramp_s: NonNegative = START_RAMP_S

    @model_validator(mode="before")
    @classmethod
    def _disturbance_of_a_name(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and isinstance(data.get("disturbance"), str):
            return {**data, "disturbance": disturbance_of(data["disturbance"])}
        return data

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.levels[0] >= self.levels[1]:
            raise ValueError(f"levels {list(self.levels)} must increase")
        if self.disturbance.level != 1.0:
            raise ValueError(
                f"disturbance.level {self.disturbance.level:g} must be 1: the knob is its level"
            )
        try:
            self.value(1.0)
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(
                f"shown {self.shown!r} must be the path of a number in the disturbance"
            ) from None
        return self

    def value(self, level: float) -> float:
        """The shown number at a level: the level acts on the deviation from nominal."""
        tree = self.disturbance.model_dump()
        nominals = {channel.path: channel.nominal for channel in CHANNELS}
        if self.shown in nominals:
            nominal, full = nominals[self.shown], value_at(tree, f"{self.shown}.value")
        elif self.shown.startswith(PATCHES):
            number, _, name = self.shown.removeprefix(PATCHES).partition(".")
            nominal, full = 1.0, tree["tyre"]["patches"][int(number)][name]
        else:
            # A field of a signal: an amplitude or a standard deviation is 0 without a disturbance; a value
            # and the end of a range deviate from the channel's nominal value.
            channel, _, field = self.shown.rpartition(".")
            nominal = nominals[channel] if field in ("low", "high", "value", "mean") else 0.0
            full = value_at(tree, self.shown)
        if not is_number(full):
            raise ValueError(self.shown)
        return float(nominal + level * (full - nominal))

    def scenario(self, task: str, level: float, horizon_s: float | None = None) -> Scenario:
        """The scenario of a level: the task with the knob's disturbance in place of its own.

        Raises
        ------
        ValueError
            for an unknown task, or a level at which a channel leaves its range.
        """
        return load_scenario(
            task,
            disturbance=self.disturbance.model_dump(),
            disturbance_level=level,
            start_ramp_s=self.start_ramp_s,
            horizon_s=horizon_s,
            plant="batch",
        )


def disturbance_of(name: str) -> Disturbance:
    """A disturbance by its preset's name or file.

    Raises
    ------
    ValueError
        for an unknown name or an invalid file.
    """
    return load_scenario(TASK, disturbance=name).disturbance


def load_knob(source: str) -> Knob:
    """A knob by its preset's name (``configs/knobs``) or from a YAML file.

    Raises
    ------
    ValueError
        in one line, for an unknown name, a file that cannot be read, or a value that is not allowed.
    """
    found = read_preset_or_file("knob", source)
    if is_file_name(source) and "disturbance" in found:
        found = {**found, "disturbance": beside(Path(source).parent, found["disturbance"])}
    try:
        return Knob.model_validate(found)
    except ValidationError as error:
        raise ValueError(f"{source}: {one_line(error, Knob)}") from error


def knob_presets() -> list[str]:
    """Names of the shipped knobs."""
    return preset_names("knob")


class Counts(NamedTuple):
    """Largest numbers of failed seeds, for the envelope and for the ends of its interval; None: no such end."""

    held: int
    low: int | None
    high: int | None


def allowed_failures(seeds: int) -> Counts:
    """How many of so many seeds may fail.

    Suppose that runs fail with a probability of 5 %. The low end allows so few failures that samples with as
    few, or fewer, have a probability of at most 2.5 %; the high end so many that samples with more have.
    20 seeds are too few for a low end; 72 are enough.
    """
    fails, tail = 1 - HELD_SHARE, (1 - CONFIDENCE) / 2
    few = [k for k in range(seeds + 1) if binom.cdf(k, seeds, fails) <= tail]
    many = [k for k in range(seeds) if binom.sf(k, seeds, fails) <= tail]
    return Counts(
        held=math.floor(fails * seeds + 1e-9),
        low=max(few, default=None),
        high=min(many, default=None),
    )


class Grid(NamedTuple):
    """Levels from the easiest to the hardest; every ``coarse``-th is tested, the others by bisection."""

    levels: tuple[float, ...]
    coarse: int

    @property
    def first(self) -> list[int]:
        """Places of the levels that are tested in any case."""
        return list(range(0, len(self.levels), self.coarse))

    @property
    def usual(self) -> float:
        """The largest of these levels up to 1, at which the disturbance is as its file has it; or the first."""
        return max(
            (one for i in self.first if (one := self.levels[i]) <= 1), default=self.levels[0]
        )


def grid(levels: tuple[float, float], resolution: float) -> Grid:
    """A geometric grid whose neighbours differ by at most ``resolution``, e.g. 0.05.

    Raises
    ------
    ValueError
        for a resolution that is not between 0.001 and 1.
    """
    if not 1e-3 <= resolution <= 1:
        raise ValueError(f"resolution {resolution:g} must be 0.001 to 1")
    first, last = levels
    steps = max(1, math.ceil(math.log(last / first, COARSE_FACTOR) - 1e-9))
    ratio = math.log(last / first) / steps
    halvings = max(0, math.ceil(math.log2(ratio / math.log1p(resolution)) - 1e-9))
    count = steps << halvings
    found = [first * (last / first) ** (i / count) for i in range(count + 1)]
    found[-1] = last
    return Grid(tuple(float(f"{level:.{LEVEL_DIGITS}g}") for level in found), 1 << halvings)


def bracket(failed: Mapping[int, int], allowed: int, count: int) -> tuple[int, int]:
    """The place of the largest level below the first that failed, and the place of that one.

    Parameters
    ----------
    failed
        Failed seeds at the tested places.
    allowed
        How many may fail at a level that holds.
    count
        Number of levels; the second place if no level fails. The first is -1 if the lowest tested level fails.
    """
    bad = min((i for i, number in failed.items() if number > allowed), default=count)
    good = max((i for i in failed if i < bad), default=-1)
    return good, bad


def untested(found: Grid, failed: Mapping[int, int], counts: Counts) -> list[int]:
    """Places of the levels to test next: first the coarse ones, then those that halve a bracket."""
    coarse = [i for i in found.first if i not in failed]
    if coarse:
        return coarse
    middles = []
    for allowed in counts:
        if allowed is not None:
            good, bad = bracket(failed, allowed, len(found.levels))
            if good >= 0 and bad - good > 1 and bad < len(found.levels):
                middles.append((good + bad) // 2)
    return list(dict.fromkeys(middles))


def most_left(found: Grid, failed: Mapping[int, int], counts: Counts) -> int:
    """Largest number of levels that are still to be tested."""
    coarse = [i for i in found.first if i not in failed]
    if coarse:
        halvings = found.coarse.bit_length() - 1
        return len(coarse) + halvings * sum(allowed is not None for allowed in counts)
    brackets = [bracket(failed, one, len(found.levels)) for one in counts if one is not None]
    return sum(
        math.ceil(math.log2(bad - good))
        for good, bad in brackets
        if good >= 0 and bad < len(found.levels)
    )


class Envelope(NamedTuple):
    """The envelope of one system and knob, in levels."""

    level: float | None  # None: not even the first level holds
    beyond: bool  # whether the last level holds, so that the envelope is at least that
    low: (
        float | None
    )  # ends of the interval; None: below the first level, beyond the last, or too few seeds
    high: float | None
    holds_again: tuple[float, ...]  # tested levels that hold although a lower one failed


def envelope(found: Grid, failed: Mapping[int, int], counts: Counts) -> Envelope:
    """The envelope, from the failed seeds of all tested levels."""
    count = len(found.levels)
    good, bad = bracket(failed, counts.held, count)
    low = high = None
    if counts.low is not None:
        place = bracket(failed, counts.low, count)[0]
        low = found.levels[place] if place >= 0 else None
    if counts.high is not None:
        place = bracket(failed, counts.high, count)[1]
        high = found.levels[place] if place < count else None
    return Envelope(
        level=found.levels[good] if good >= 0 else None,
        beyond=bad == count,
        low=low,
        high=high,
        holds_again=tuple(
            found.levels[i] for i in sorted(failed) if i > bad and failed[i] <= counts.held
        ),
    )


class Search(NamedTuple):
    """What has one envelope."""

    policy: str
    task: str
    knob: str


class Probe(NamedTuple):
    """One level of a search."""

    policy: str
    task: str
    knob: str
    level: float

    @property
    def search(self) -> Search:
        """The search that it belongs to."""
        return Search(*self[:3])


@dataclass(frozen=True)
class EnvelopePlan:
    """Whose envelopes are searched, and how."""

    policies: tuple[str, ...]
    tasks: tuple[str, ...]
    knobs: tuple[str, ...]
    seeds: SeedRange
    resolution: float = RESOLUTION
    horizon_s: float | None = None
    trust: Trust = False

    @cached_property
    def loaded(self) -> dict[str, Knob]:
        """The knobs by name."""
        return {name: load_knob(name) for name in self.knobs}

    @cached_property
    def counts(self) -> Counts:
        """How many seeds may fail."""
        return allowed_failures(self.seeds[1] - self.seeds[0])

    @cached_property
    def grids(self) -> dict[str, Grid]:
        """The levels of each knob."""
        return {name: grid(knob.levels, self.resolution) for name, knob in self.loaded.items()}

    def searches(self) -> list[Search]:
        """All searches in the order of the tables."""
        return [
            Search(policy, task, knob)
            for knob in self.knobs
            for task in self.tasks
            for policy in self.policies
        ]

    def scenario(self, probe: Probe) -> Scenario:
        """The scenario of a probe, before the policy asks for its own estimator.

        Raises
        ------
        ValueError
            as :meth:`Knob.scenario`.
        """
        return self.loaded[probe.knob].scenario(probe.task, probe.level, self.horizon_s)

    def ends(self, task: str, knob: str) -> Sequence[Scenario]:
        """The scenarios of the first and the last level.

        Raises
        ------
        ValueError
            as :meth:`Knob.scenario`.
        """
        levels = self.grids[knob].levels
        return [self.scenario(Probe("", task, knob, level)) for level in (levels[0], levels[-1])]
