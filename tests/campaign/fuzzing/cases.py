"""Cases: their form as JSON values, hostile values, and changes to valid ones."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st

# Cases are JSON values, so that they can be kept as files; bytes and arrays are mappings with the key "!".


def encoded(case: Any) -> Any:
    """A case as JSON values."""
    if isinstance(case, bytes):
        return {"!": "bytes", "value": case.decode("latin-1")}
    if isinstance(case, list | tuple):
        return [encoded(one) for one in case]
    if isinstance(case, dict):
        return {key: encoded(one) for key, one in case.items()}
    return case


def restored(case: Any) -> Any:
    """A case of :func:`encoded`, with its bytes; arrays are made by :func:`real`."""
    if isinstance(case, list):
        return [restored(one) for one in case]
    if isinstance(case, dict):
        if case.get("!") == "bytes":
            return case["value"].encode("latin-1")
        return {key: restored(one) for key, one in case.items()}
    return case


def real(value: Any) -> Any:
    """A value with the objects that its mappings with the key "!" stand for."""
    if isinstance(value, list):
        return [real(one) for one in value]
    if not isinstance(value, dict):
        return value
    kind = value.get("!")
    if kind == "array":
        with contextlib.suppress(Exception):
            return np.array(value["value"], dtype=value["dtype"])
        return np.array(value["value"], dtype=object)
    if kind == "scalar":
        with contextlib.suppress(Exception):
            return np.dtype(value["dtype"]).type(value["value"])
        return value["value"]
    if kind == "tuple":
        return tuple(real(one) for one in value["value"])
    if kind == "object":
        return object()
    return {key: real(one) for key, one in value.items()}


# Hostile values.

NUMBERS: list[Any] = [
    0, -0.0, 1, -1, 2, 0.5, 1e-300, 5e-324, -5e-324, 1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 1e12, 1e16,
    1e100, 1e154, 1e200, 1e308, -1e308, 1.7976931348623157e308, math.nan, math.inf, -math.inf, 3, 7, 1000,
    2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64, 10**400, 0.1, -0.1, 0.001, 0.02, 1.0000000000000002,
]  # fmt: skip

TEXTS = [
    "", " ", "nan", "inf", "0", "1e999", "true", "null", "~", "a:b", "os:abort", "reference:", "../x.yaml",
    "/dev/null", "none", "x" * 2000, "\x00", "\n", "é\u2028\u202e", "<script>alert(1)</script>", "[", "{", "*a",
    "%s%n", "'; --", "\ud800", "💥", "infinity", "slip", "tuned", "-1", "1,2", "NaN:NaN:3", "=", ".", "..",
]  # fmt: skip

number = st.one_of(st.sampled_from(NUMBERS), st.floats(), st.integers(-20, 20), st.integers())

word = st.one_of(st.sampled_from(TEXTS), st.text(max_size=12))

scalar = st.one_of(number, number, st.none(), st.booleans(), word)

anything = st.recursive(
    scalar,
    lambda one: st.lists(one, max_size=4) | st.dictionaries(word, one, max_size=3),
    max_leaves=6,
)

SCALES = (0.0, -1.0, 1e-12, 1e-3, 0.1, 0.5, 0.9, 1.1, 2.0, 10.0, 1e3, 1e12, 1e150)


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to everything inside plain data."""
    yield path
    if isinstance(data, dict):
        for key, value in data.items():
            yield from places(value, (*path, key))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            yield from places(value, (*path, i))


def at(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        data = data[key]
    return data


@st.composite
def changed(draw: Any, bases: Any, most: int = 3, values: Any = anything) -> Any:
    """One of some plain data with changes: other values, missing and unknown keys, scaled numbers."""
    data = copy.deepcopy(draw(st.sampled_from(bases())))
    for _ in range(draw(st.integers(1, most))):
        paths = list(places(data))
        path = paths[draw(st.integers(0, len(paths) - 1))]
        if not path:
            continue
        inner, key = at(data, path[:-1]), path[-1]
        old = inner[key]
        what = draw(st.integers(0, 6))
        if what <= 1:
            inner[key] = draw(values)
        elif what == 2 and isinstance(inner, dict):
            del inner[key]
        elif what == 3 and isinstance(old, dict):
            old[draw(word)] = draw(values)
        elif what == 4 and isinstance(old, list):
            inner[key] = old * draw(st.integers(0, 3))
        elif isinstance(old, int | float) and not isinstance(old, bool):
            scale = draw(st.sampled_from(SCALES))
            with contextlib.suppress(OverflowError):
                inner[key] = old * scale
        elif isinstance(old, str):
            inner[key] = draw(word)
        else:
            inner[key] = draw(number)
    return data


@st.composite
def damaged(draw: Any, bases: Any) -> bytes:
    """One of some files' bytes with changes: other bytes, parts left out, repeated or put elsewhere."""
    data = bytearray(draw(st.sampled_from(bases())))
    for _ in range(draw(st.integers(1, 4))):
        first = draw(st.integers(0, len(data)))
        last = min(len(data), first + draw(st.sampled_from((1, 1, 2, 5, 20, 100))))
        what = draw(st.integers(0, 4))
        if what == 0:
            data[first:last] = draw(st.binary(max_size=6))
        elif what == 1:
            del data[first:last]
        elif what == 2:
            data[first:first] = data[first:last]
        elif what == 3:
            data[first:first] = draw(st.sampled_from(TEXTS)).encode("utf-8", "surrogatepass")
        else:
            data = data[:first] if draw(st.booleans()) else data[first:]
    return bytes(data[:20_000])


dtypes = st.sampled_from(["f2", "f4", "f8", "i8", "u1", "b1", "c8", "U3", "O", "M8[s]", ">f8"])

arrays = st.fixed_dictionaries(
    {
        "!": st.just("array"),
        "dtype": dtypes,
        "value": st.one_of(
            st.lists(number, max_size=3),
            st.lists(st.lists(number, min_size=2, max_size=2), max_size=3),
            number,
        ),
    }
)
