"""Memory that begins at a cache line: arrays, and tables of a compiled function's own on the stack."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

CACHE_LINE_BYTES = 64  # of all processors that are common
DOUBLE_BYTES = 8


def _array_at(context: Any, builder: Any, array: Any, memory: Any, shape: tuple[int, int]) -> Any:
    """An array struct of a constant shape over some memory that it does not own."""
    made = context.make_array(array)(context, builder)
    size = array.dtype.bitwidth // 8
    context.populate_array(
        made,
        data=builder.bitcast(memory, made.data.type),
        shape=[context.get_constant(types.intp, one) for one in shape],
        strides=[context.get_constant(types.intp, one) for one in (shape[1] * size, size)],
        itemsize=context.get_constant(types.intp, size),
        meminfo=None,
    )
    return made._getvalue()


def zeros(shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    """As ``np.zeros``, with the first number at the beginning of a cache line."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(size + CACHE_LINE_BYTES, dtype=np.uint8)
    first = -memory.ctypes.data % CACHE_LINE_BYTES
    return memory[first : first + size].view(dtype).reshape(shape)


@intrinsic(prefer_literal=True)
def table(_context: Any, rows: Any, columns: Any) -> Any:
    """An array ``(rows, columns)`` of floats that lasts as long as the call; its size is known when compiling.

    It begins at a cache line, so that a row of eight is one line: a vector that lies across two lines takes
    twice as long to load or store. The compiler also knows that no other array overlaps it.
    """
    array = types.Array(types.float64, 2, "C")
    shape = rows.literal_value, columns.literal_value

    def build(context: Any, builder: Any, _signature: Any, _values: Any) -> Any:
        with builder.goto_entry_block():
            memory = builder.alloca(ir.ArrayType(ir.DoubleType(), shape[0] * shape[1]))
            memory.align = CACHE_LINE_BYTES
        return _array_at(context, builder, array, memory, shape)

    return array(rows, columns), build


@intrinsic(prefer_literal=True)
def table_of(_context: Any, number: Any, rows: Any) -> Any:
    """As :func:`table`, of numbers such as ``number``, each row a cache line."""
    return _lines(types.Array(number, 2, "C"), number, rows)


@intrinsic(prefer_literal=True)
def integers_beside(_context: Any, number: Any, rows: Any) -> Any:
    """Whole numbers (int64), as many in each row as in those of :func:`table_of`."""
    return _lines(types.Array(types.int64, 2, "C"), number, rows)


@intrinsic(prefer_literal=True)
def doubles_beside(_context: Any, number: Any, rows: Any) -> Any:
    """Doubles, as many in each row as in those of :func:`table_of`."""
    return _lines(types.Array(types.float64, 2, "C"), number, rows)


def _lines(array: Any, number: Any, rows: Any) -> Any:
    """What an intrinsic returns that makes a table with as many columns as numbers fit into a cache line."""
    shape = rows.literal_value, CACHE_LINE_BYTES * 8 // number.bitwidth
    bits = ir.IntType(array.dtype.bitwidth)

    def build(context: Any, builder: Any, _signature: Any, _values: Any) -> Any:
        with builder.goto_entry_block():
            memory = builder.alloca(ir.ArrayType(bits, shape[0] * shape[1]))
            memory.align = CACHE_LINE_BYTES
        return _array_at(context, builder, array, memory, shape)

    return array(number, rows), build


@intrinsic
def like(_context: Any, value: Any, number: Any) -> Any:
    """A number in the precision of another one."""

    def build(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return context.cast(builder, values[0], value, number)

    return number(value, number), build


@intrinsic(prefer_literal=True)
def shaped(_context: Any, array: Any, rows: Any, columns: Any) -> Any:
    """The same table of floats ``(rows, columns)``, of a size that is known when compiling; not checked.

    For a function that is called rather than inlined: without it, its loops would not become vectors.
    """
    shape = rows.literal_value, columns.literal_value

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = context.make_array(array)(context, builder, value=values[0]).data
        return _array_at(context, builder, signature.return_type, data, shape)

    return array(array, rows, columns), build


@intrinsic
def prefetch(_context: Any, array: Any, _row: Any, _column: Any) -> Any:
    """Have the cache line of an element of a two-dimensional array brought to the cache, to be read later."""
    place = types.intp

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = signature.args[0]
        made = context.make_array(kind)(context, builder, value=values[0])
        where = cgutils.get_item_pointer(context, builder, kind, made, values[1:])
        bytes_at = builder.bitcast(where, ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kinds = [bytes_at.type, number, number, number]
        ask = builder.module.declare_intrinsic(
            "llvm.prefetch", [bytes_at.type], ir.FunctionType(ir.VoidType(), kinds)
        )
        builder.call(ask, [bytes_at, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.none(array, place, place), build


@intrinsic
def copy_line(
    _context: Any,
    to: Any,
    _row: Any,
    _first: Any,
    of: Any,
    _field: Any,
    _column: Any,
) -> Any:
    """Copy a cache line of neighbours of a row to neighbours of another one, as one vector.

    A cache line of the shorter numbers: 8, or 16 if one of the arrays is of single precision.

    ``to[row, first + i] = of[field, column + i]``, in the precision of ``to``. Written as a loop, each number
    would be copied alone, since the compiler cannot know that the arrays do not overlap. Indices are not
    checked.
    """
    index = types.intp
    width = CACHE_LINE_BYTES * 8 // min(to.dtype.bitwidth, of.dtype.bitwidth)

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        def at(kind: Any, value: Any, place: Any) -> Any:
            made = context.make_array(kind)(context, builder, value=value)
            where = cgutils.get_item_pointer(context, builder, kind, made, place)
            return builder.bitcast(where, _vector(kind, width).as_pointer())

        kinds = signature.args
        found = builder.load(at(kinds[3], values[3], values[4:6]), align=DOUBLE_BYTES)
        if kinds[0].dtype.bitwidth < kinds[3].dtype.bitwidth:
            found = builder.fptrunc(found, _vector(kinds[0], width))
        elif kinds[0].dtype.bitwidth > kinds[3].dtype.bitwidth:
            found = builder.fpext(found, _vector(kinds[0], width))
        builder.store(found, at(kinds[0], values[0], values[1:3]), align=DOUBLE_BYTES)
        return context.get_dummy_value()

    return types.none(to, index, index, of, index, index), build


def _vector(array: Any, width: int) -> Any:
    """LLVM's type of so many numbers of an array."""
    number = ir.DoubleType() if array.dtype == types.float64 else ir.FloatType()
    return ir.VectorType(number, width)
