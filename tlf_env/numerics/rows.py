"""Compiled helpers for rows: named tuples of numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tlf_env.numerics.compiled import law


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
