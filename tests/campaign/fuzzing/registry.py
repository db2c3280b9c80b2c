"""What a target of the fuzzing is, and the list of all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from hypothesis import strategies as st


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
