"""Compiled access to rows: named tuples of numbers, in arrays, rings and tiles.

The fields of a row lie along the first axis of an array. One place is computed for all of them, as compiling
an indexing for each would take most of the time that these functions take. Indices must not be negative.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

from numba.core import types
from numba.core.types.containers import BaseTuple
from numba.extending import intrinsic
from numba.np.arrayobj import load_item, make_array, store_item

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


def _steps(context: Any, builder: Any, array_type: Any, made: Any) -> list[Any]:
    """How many numbers lie between neighbours along each axis of an array."""
    axes = range(array_type.ndim)
    if array_type.layout != "C":
        size = context.get_constant(types.intp, context.get_abi_sizeof(made.data.type.pointee))
        return [builder.sdiv(builder.extract_value(made.strides, axis), size) for axis in axes]
    steps = [context.get_constant(types.intp, 1)]
    for axis in reversed(axes[1:]):  # from the shape, which the compiler may know
        steps.append(builder.mul(steps[-1], builder.extract_value(made.shape, axis)))
    return steps[::-1]


def _places(
    context: Any, builder: Any, kinds: Any, array: Any, index: Any, first: int
) -> Iterator[Any]:
    """Pointers to the fields of a row at an index of the axes after the first, from field ``first`` on."""
    array_type, index_type = kinds
    made = make_array(array_type)(context, builder, array)
    field_step, *steps = _steps(context, builder, array_type, made)
    place = context.get_constant(types.intp, 0)
    for axis, step in enumerate(steps):
        part = builder.extract_value(index, axis)
        part = context.cast(builder, part, index_type[axis], types.intp)
        place = builder.add(place, builder.mul(part, step))
    for field in itertools.count(first):
        offset = builder.mul(context.get_constant(types.intp, field), field_step)
        yield builder.gep(made.data, [builder.add(place, offset)])


def _getter(row: type[Any], first: int) -> Callable[..., Any]:
    """In compiled code ``get(array, index)``: the row at an index of the axes after the first."""

    @intrinsic
    def get(_context: Any, array: Any, index: Any) -> Any:
        result = BaseTuple.from_types((array.dtype,) * len(row._fields), row)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            places = _places(context, builder, signature.args, args[0], args[1], first)
            values = [load_item(context, builder, array, next(places)) for _ in row._fields]
            return context.make_tuple(builder, result, values)

        return result(array, index), generate

    found: Callable[..., Any] = get
    return found


def _setter(first: int) -> Callable[..., Any]:
    """In compiled code ``put(array, index, row)``, the inverse of :func:`_getter`."""

    @intrinsic
    def put(_context: Any, array: Any, index: Any, row: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            places = _places(context, builder, signature.args[:2], args[0], args[1], first)
            for i, kind in enumerate(row):
                value = context.cast(builder, builder.extract_value(args[2], i), kind, array.dtype)
                store_item(context, builder, array, value, next(places))
            return context.get_dummy_value()

        return types.void(array, index, row), generate

    found: Callable[..., Any] = put
    return found


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
    get = _getter(row, first)
    return law(lambda array, robot, lane: get(array, (robot, lane)))


def writer(row: type[Any], first: int = 0) -> Callable[..., Any]:
    """Compiled ``write(array, robot, lane, row)``, the inverse of :func:`reader`."""
    put = _setter(first)
    return law(lambda array, robot, lane, row: put(array, (robot, lane), row))


def slot_reader(row: type[Any]) -> Callable[..., Any]:
    """Compiled ``read(ring, slot, robot, lane)`` that gathers a named tuple from a ring of them."""
    get = _getter(row, 0)
    return law(lambda ring, slot, robot, lane: get(ring, (slot, robot, lane)))


def slot_writer(row: type[Any]) -> Callable[..., Any]:
    """Compiled ``write(ring, slot, robot, lane, row)``, the inverse of :func:`slot_reader`."""
    put = _setter(0)
    return law(lambda ring, slot, robot, lane, row: put(ring, (slot, robot, lane), row))


def row_reader(row: type[Any], first: int) -> Callable[..., Any]:
    """Compiled ``read(tile, i)`` that gathers a named tuple from ``tile[first + field, i]``."""
    get = _getter(row, first)
    return law(lambda tile, i: get(tile, (i,)))


def row_writer(row: type[Any], first: int) -> Callable[..., Any]:
    """Compiled ``write(tile, i, row)``, the inverse of :func:`row_reader`."""
    put = _setter(first)
    return law(lambda tile, i, row: put(tile, (i,), row))
