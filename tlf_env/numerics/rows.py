"""Compiled access to large named tuples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tlf_env.numerics.compiled import law


def replacing(row: type[Any], *names: str) -> Callable[..., Any]:
    """Compiled ``replace(row, *values)``: the named tuple with the fields ``names`` replaced, in order.

    All other fields are copied, so that a law that changes a few fields need not list the others. Numba
    has no ``_replace``.

    Raises
    ------
    ValueError
        for a name that is not a field.
    """
    unknown = [name for name in names if name not in row._fields]
    if unknown:
        raise ValueError(f"{row.__name__} has no field {unknown[0]!r}; it has {row._fields}")
    fields = ", ".join(
        f"{name}=v{names.index(name)}" if name in names else f"{name}=row.{name}"
        for name in row._fields
    )
    values = ", ".join(f"v{i}" for i in range(len(names)))
    scope: dict[str, Any] = {"Row": row}
    exec(f"def replace(row, {values}):\n    return Row({fields})\n", scope)
    return law(scope["replace"])
