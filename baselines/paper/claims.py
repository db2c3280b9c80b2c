"""A claim of the paper, how its number is computed, and the rule that makes the number a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple


class Verdict(StrEnum):
    """What the computed number says about a claim."""

    REPRODUCED = "reproduced"
    PARTLY = "partly"
    NOT = "not reproduced"


@dataclass(frozen=True)
class Near:
    """Within a share ``close`` of a number: reproduced; within ``loose``: partly."""

    target: float
    close: float
    loose: float

    def verdict(self, value: float) -> Verdict:
        """The verdict on a value."""
        if not math.isfinite(value):
            return Verdict.NOT
        return _graded(abs(value - self.target), self.close, self.loose, abs(self.target))

    def text(self, unit: str = "") -> str:
        """The rule in words, for a number with a unit."""
        return (
            f"{self.target:g} within {_percent(self.close)}; partly: within {_percent(self.loose)}"
        )


@dataclass(frozen=True)
class Below:
    """Less than ``bound``: reproduced; less than ``loose``, if there is one: partly."""

    bound: float
    loose: float | None = None

    def verdict(self, value: float) -> Verdict:
        """The verdict on a value; NaN is not reproduced."""
        if value < self.bound:
            return Verdict.REPRODUCED
        return Verdict.PARTLY if self.loose is not None and value < self.loose else Verdict.NOT

    def text(self, unit: str = "") -> str:
        """The rule in words, for a number with a unit."""
        bounds = (self.bound,) if self.loose is None else (self.bound, self.loose)
        return "; partly: ".join(f"< {_number(bound)} {unit}".strip() for bound in bounds)


@dataclass(frozen=True)
class Above:
    """More than ``bound``: reproduced; more than ``loose``, if there is one: partly."""

    bound: float
    loose: float | None = None

    def verdict(self, value: float) -> Verdict:
        """The verdict on a value; NaN is not reproduced."""
        if value > self.bound:
            return Verdict.REPRODUCED
        return Verdict.PARTLY if self.loose is not None and value > self.loose else Verdict.NOT

    def text(self, unit: str = "") -> str:
        """The rule in words, for a number with a unit."""
        bounds = (self.bound,) if self.loose is None else (self.bound, self.loose)
        return "; partly: ".join(f"> {_number(bound)} {unit}".strip() for bound in bounds)


NOTHING = 1e-9  # what rounding leaves: it differs between machines

Rule = Near | Below | Above


class Measured(NamedTuple):
    """A computed number, with what is worth knowing beside it."""

    value: float
    detail: str = ""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper with a number in it.

    Attributes
    ----------
    name
        Short name, unique in all parts.
    statement
        What the paper says.
    source
        Section, equation or figure.
    reported
        What the paper prints, with its unit.
    quantity, unit
        What is computed, and its unit (empty for a plain number).
    measure
        Computes it from the data of the claim's part.
    rule
        Makes the number a verdict.
    figure
        Name of the figure that shows it, or empty.
    digits
        Significant digits of the number.
    """

    name: str
    statement: str
    source: str
    reported: str
    quantity: str
    unit: str
    measure: Callable[[Any], Measured | float]
    rule: Rule
    figure: str = ""
    digits: int = 3


class Finding(NamedTuple):
    """A claim with its number and verdict; plain values only, as they are kept in a file."""

    claim: str
    statement: str
    source: str
    reported: str
    quantity: str
    computed: str
    rule: str
    verdict: str
    figure: str
    command: str


def judge(claim: Claim, data: Any, command: str) -> Finding:
    """Compute a claim's number from the data of its part, and judge it by the claim's rule."""
    found = claim.measure(data)
    value, detail = found if isinstance(found, Measured) else (float(found), "")
    return Finding(
        claim=claim.name,
        statement=claim.statement,
        source=claim.source,
        reported=claim.reported,
        quantity=claim.quantity,
        computed=shown(value, claim.unit, claim.digits) + (f" ({detail})" if detail else ""),
        rule=claim.rule.text(claim.unit),
        verdict=str(claim.rule.verdict(value)),
        figure=claim.figure,
        command=command,
    )


def shown(value: float, unit: str = "", digits: int = 3) -> str:
    """A number with significant digits and its unit; an infinite error is that of a lost robot."""
    if math.isnan(value):
        return "not defined"
    if math.isinf(value):
        return "lost"
    if 0 < abs(value) < NOTHING:
        return f"< 1e-9 {unit}".strip()
    places = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
    text = f"{value:.{places}f}" if places < 7 else f"{value:.{digits - 1}e}"
    return f"{text} {unit}".strip()


def _graded(distance: float, close: float, loose: float, scale: float) -> Verdict:
    if distance <= close * scale:
        return Verdict.REPRODUCED
    return Verdict.PARTLY if distance <= loose * scale else Verdict.NOT


def _number(value: float) -> str:
    return f"{value:g}".replace("e-0", "e-")


def _percent(share: float) -> str:
    return f"{100 * share:g} %"
