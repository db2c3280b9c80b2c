"""Compiled access to rows: named tuples of numbers, in arrays, rings and tiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tlf_env.numerics.compiled import law, law_in_double
from tlf_env.numerics.memory import like


def replacing(row: type[Any], *names: str) -> Callable[..., Any]:
    """Compiled ``replace(old, name=value, ...)``: a copy of a row with new values in these fields.

    The other fields are copied, so that a field added to the row needs no edit where it does not
    change.

    Raises
    ------
    ValueError
        for a name that is not a field of the row.
    """
    unknown = set(names) - set(row._fields)
    if unknown:
        raise ValueError(f"{row.__name__} has no field {', '.join(sorted(unknown))}")
    fields = ", ".join(
        f"{name}={name}" if name in names else f"{name}=_old.{name}" for name in row._fields
    )
    scope: dict[str, Any] = {"_Row": row}
    exec(f"def replace(_old, {', '.join(names)}):\n    return _Row({fields})\n", scope)
    return law(scope["replace"])


def doubling(row: type[Any]) -> Callable[..., Any]:
    """Compiled ``in_double(row)``: the row with its numbers in double precision."""
    fields = ", ".join(f"like(row.{name}, ONE)" for name in row._fields)
    scope: dict[str, Any] = {"Row": row, "like": like, "ONE": 1.0}
    exec(f"def in_double(row):\n    return Row({fields})\n", scope)
    return law_in_double(scope["in_double"])


def choosing(row: type[Any]) -> Callable[..., Any]:
    """Compiled ``choose(mask, row, other)``: the row where the mask is true, else the other, field by field."""
    # Numba takes no conditional inside so many keywords.
    lines = "\n".join(f"    {name} = a.{name} if m else b.{name}" for name in row._fields)
    fields = ", ".join(row._fields)
    scope: dict[str, Any] = {"Row": row}
    exec(f"def choose(m, a, b):\n{lines}\n    return Row({fields})\n", scope)
    return law(scope["choose"])


def reader(row: type[Any], first: int = 0) -> Callable[..., Any]:
    """Compiled ``read(array, robot, lane)``: a named tuple from ``array[first + field, robot, lane]``."""
    fields = ", ".join(f"a[{first + i}, r, l]" for i in range(len(row._fields)))
    scope: dict[str, Any] = {"Row": row}
    exec(f"def read(a, r, l):\n    return Row({fields})\n", scope)
    return law(scope["read"])


def writer(row: type[Any], first: int = 0) -> Callable[..., Any]:
    """Compiled ``write(array, robot, lane, row)``, the inverse of :func:`reader`."""
    lines = "\n".join(
        f"    a[{first + i}, r, l] = row.{name}" for i, name in enumerate(row._fields)
    )
    scope: dict[str, Any] = {}
    exec(f"def write(a, r, l, row):\n{lines}\n", scope)
    return law(scope["write"])


def entries_writer(row: type[Any], first: int = 0) -> Callable[..., Any]:
    """Compiled ``write(array, lane, robot, row)``: a named tuple into ``array[lane, robot, first + field]``.

    A loop over the fields would jump to a place of its own for each: compiled code has no fields by number.
    """
    lines = "\n".join(
        f"    a[l, r, {first + i}] = row.{name}" for i, name in enumerate(row._fields)
    )
    scope: dict[str, Any] = {}
    exec(f"def write(a, l, r, row):\n{lines}\n", scope)
    return law(scope["write"])


def slot_reader(row: type[Any]) -> Callable[..., Any]:
    """Compiled ``read(ring, slot, robot, lane)`` that gathers a named tuple from a ring of them."""
    fields = ", ".join(f"a[{i}, k, r, l]" for i in range(len(row._fields)))
    scope: dict[str, Any] = {"Row": row}
    exec(f"def read(a, k, r, l):\n    return Row({fields})\n", scope)
    return law(scope["read"])


def slot_writer(row: type[Any]) -> Callable[..., Any]:
    """Compiled ``write(ring, slot, robot, lane, row)``, the inverse of :func:`slot_reader`."""
    lines = "\n".join(f"    a[{i}, k, r, l] = row.{name}" for i, name in enumerate(row._fields))
    scope: dict[str, Any] = {}
    exec(f"def write(a, k, r, l, row):\n{lines}\n", scope)
    return law(scope["write"])


def row_reader(row: type[Any], first: int) -> Callable[..., Any]:
    """Compiled ``read(tile, i)`` that gathers a named tuple from ``tile[first + field, i]``."""
    fields = ", ".join(f"t[{first + i}, i]" for i in range(len(row._fields)))
    scope: dict[str, Any] = {"Row": row}
    exec(f"def read(t, i):\n    return Row({fields})\n", scope)
    return law(scope["read"])


def row_writer(row: type[Any], first: int) -> Callable[..., Any]:
    """Compiled ``write(tile, i, row)``, the inverse of :func:`row_reader`."""
    lines = "\n".join(f"    t[{first + i}, i] = row.{name}" for i, name in enumerate(row._fields))
    scope: dict[str, Any] = {}
    exec(f"def write(t, i, row):\n{lines}\n", scope)
    return law(scope["write"])
