"""Frozen, validated models, and the types of their numbers."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat


def no_switch(value: Any) -> Any:
    """The value; True and False are refused, which Python would take as 1 and 0.

    Raises
    ------
    ValueError
        for True and False.
    """
    if isinstance(value, bool):
        raise ValueError(f"must be a number, got {value!r}")
    return value


def infinite_if_none(limit: float | None, factor: float = 1.0) -> float:
    """A limit times a factor; infinity for None, where there is no limit."""
    return math.inf if limit is None else limit * factor


Positive = Annotated[FiniteFloat, BeforeValidator(no_switch), Field(gt=0)]
NonNegative = Annotated[FiniteFloat, BeforeValidator(no_switch), Field(ge=0)]


class Frozen(BaseModel):
    """A model with immutable instances that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)
