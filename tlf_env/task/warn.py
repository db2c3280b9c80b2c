"""Warnings for scenarios: each line once, at the user's own line of code."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from tlf_env.task.scenario import Scenario, scenario_warnings

# Modules and packages between a user's code and a constructor that warns.
MAKERS = ("tlf_env", "gymnasium", "pettingzoo", "baselines.sb3")
MOST_NAMED = 4  # scenarios that a line names


class ReferenceWarning(UserWarning):
    """The reference exceeds limits of the robots or of the observation."""


def callers_level() -> int:
    """``stacklevel`` of a warning by the calling function: the first frame outside :data:`MAKERS`."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and _makes(frame.f_globals.get("__name__", "")):
        level, frame = level + 1, frame.f_back
    return level


def _makes(module: str) -> bool:
    return any(module == maker or module.startswith(f"{maker}.") for maker in MAKERS)


def warning_lines(scenarios: Iterable[tuple[str, Scenario]]) -> list[str]:
    """The warnings for some scenarios, each line once.

    Parameters
    ----------
    scenarios
        Each with its name. A line that does not hold for all of them begins with the names of those
        that it holds for, of at most four.
    """
    named = list(scenarios)
    found: dict[str, list[str]] = {}
    for name, scenario in named:
        for line in scenario_warnings(scenario):
            found.setdefault(line, []).append(name)
    return [
        line if len(names) == len(named) else f"{_listed(names)}: {line}"
        for line, names in found.items()
    ]


def _listed(names: Sequence[str]) -> str:
    names = list(dict.fromkeys(names))
    more = len(names) - MOST_NAMED
    return "; ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def warn_of(scenarios: Sequence[Scenario]) -> None:
    """Give a :class:`ReferenceWarning` for each warning of the scenarios, at the user's line of code."""
    for line in warning_lines((f"scenario {i}", one) for i, one in enumerate(scenarios)):
        warnings.warn(line, ReferenceWarning, stacklevel=callers_level())


@contextmanager
def without_warnings() -> Iterator[None]:
    """No :class:`ReferenceWarning`, for scenarios that have been warned of already."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReferenceWarning)
        yield
