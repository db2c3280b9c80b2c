"""Frozen, validated models, and the types of their numbers."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat
from pydantic_core import PydanticCustomError

# No quantity of a robot needs larger numbers, or smaller ones above 0. Products and squares of such numbers are
# far from the limits of a float, beyond which results are no numbers.
LARGEST, SMALLEST = 1e15, 1e-15


def is_number(value: Any) -> bool:
    """Whether a value is one real number, of Python or NumPy; True, False and texts are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def as_float(value: Any) -> float:
    """A number as a float of Python; infinity if it is too large, of either sign."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _number(value: Any) -> float:
    if not is_number(value):
        raise PydanticCustomError("number_type", "Input should be a number")
    found = as_float(value)
    if LARGEST < abs(found) < math.inf:
        raise PydanticCustomError("number_size", f"Input should be within ±{LARGEST:g}")
    return found


def _not_tiny(value: float) -> float:
    if 0.0 < value < SMALLEST:
        raise PydanticCustomError("number_size", f"Input should be at least {SMALLEST:g}")
    return value


def _whole_number(value: Any) -> Any:
    if is_number(value) and isinstance(value, Integral):
        return int(value)
    if is_number(value) and as_float(value).is_integer():
        return int(value)
    raise PydanticCustomError("whole_number_type", "Input should be a whole number")


def _switch(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise PydanticCustomError("switch_type", "Input should be True or False")
    return bool(value)


def infinite_if_none(limit: float | None, factor: float = 1.0) -> float:
    """A limit times a factor; infinity for None, where there is no limit."""
    return math.inf if limit is None else limit * factor


# Numbers of Python and NumPy. Switches (which Python would take as 1 and 0), texts and arrays are refused.
Number = Annotated[FiniteFloat, BeforeValidator(_number)]
Positive = Annotated[Number, Field(gt=0), AfterValidator(_not_tiny)]
NonNegative = Annotated[Number, Field(ge=0)]
Whole = Annotated[int, BeforeValidator(_whole_number)]
Switch = Annotated[bool, BeforeValidator(_switch)]


class Frozen(BaseModel):
    """A model with immutable instances that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)
