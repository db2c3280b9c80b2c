"""Large named tuples that compiled functions pass to each other by one pointer.

Numba passes a named tuple field by field, and an array as ten numbers and more, so that a function with a
tuple of forty arrays has hundreds of arguments: most of what is compiled would be their copying. Here the
driver that Python calls writes the numbers into memory once, and everything below it gets a pointer and
reads what it needs. Nothing writes there again, which the compiler is told, so that it reads a number
once before a loop.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any, TypeVar

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import NativeValue, models, register_model, typeof_impl, unbox

T = TypeVar("T", bound=type)

SLOT_BYTES = 8  # each number has a place of its own, wide enough for any
BYTES = ir.IntType(8).as_pointer()


class Pointed(types.Type):
    """Type of a named tuple whose class is decorated by :func:`by_pointer`, in compiled code."""

    def __init__(self, of: type[Any], field_types: tuple[types.Type, ...]) -> None:
        self.of = of
        self.field_types = field_types
        fields = ", ".join(str(one) for one in field_types)
        super().__init__(name=f"{of.__module__}.{of.__qualname__}({fields})")

    @property
    def mangling_args(self) -> tuple[str, tuple[()]]:
        """A short name for symbols, another one for every set of field types."""
        digest = hashlib.sha256(self.name.encode()).hexdigest()
        return f"{self.of.__qualname__}_{digest[:16]}", ()


@register_model(Pointed)
class _Pointer(models.OpaqueModel):
    """A pointer without a type: that of the whole tuple would be written out at every use."""


@infer_getattr
class _Fields(AttributeTemplate):
    key = Pointed

    def generic_resolve(self, tuple_type: Pointed, name: str) -> types.Type | None:
        fields = tuple_type.of._fields
        return tuple_type.field_types[fields.index(name)] if name in fields else None


def by_pointer(named_tuple: T) -> T:
    """Let compiled functions get a named tuple by a pointer, and read its fields by their names only.

    Drivers that Python calls may take it, and functions below them. None may return or keep it: it is gone
    when the driver ends.
    """
    if numba.config.DISABLE_JIT:
        return named_tuple

    @typeof_impl.register(named_tuple)
    def typeof(value: Any, context: Any) -> Pointed | None:
        found = tuple(typeof_impl(one, context) for one in value)
        return None if None in found else Pointed(named_tuple, found)

    return named_tuple


def _numbers_in(kind: Any) -> Iterator[tuple[tuple[int, ...], Any]]:
    """The numbers that a value of LLVM consists of: the way to each, and its type."""
    if isinstance(kind, ir.LiteralStructType | ir.ArrayType):
        parts = (
            kind.elements if isinstance(kind, ir.LiteralStructType) else [kind.element] * kind.count
        )
        for i, part in enumerate(parts):
            for way, number in _numbers_in(part):
                yield (i, *way), number
    else:
        yield (), kind


def _slots(context: Any, kind: Pointed) -> list[Any]:
    """For each field its type in LLVM, the number of its first slot, and the number after its last."""
    found, first = [], 0
    for one in kind.field_types:
        value_type = context.get_value_type(one)
        last = first + sum(1 for _ in _numbers_in(value_type))
        found.append((value_type, first, last))
        first = last
    return found


def _slot(builder: Any, memory: Any, number: int, kind: Any) -> Any:
    """Pointer to a slot."""
    place = builder.gep(memory, [ir.IntType(32)(number * SLOT_BYTES)], inbounds=True)
    return builder.bitcast(place, kind.as_pointer())


@unbox(Pointed)
def _unbox(kind: Pointed, value: Any, c: Any) -> NativeValue:
    """Write the fields of a named tuple into memory of the driver's wrapper."""
    builder, slots = c.builder, _slots(c.context, kind)
    block = cgutils.alloca_once(builder, ir.ArrayType(ir.IntType(64), slots[-1][2]))
    memory = builder.bitcast(block, BYTES)
    failed = cgutils.alloca_once_value(builder, cgutils.false_bit)
    natives = []
    for i, (one, (value_type, first, _)) in enumerate(zip(kind.field_types, slots, strict=True)):
        native = c.unbox(one, c.pyapi.tuple_getitem(value, i))
        with builder.if_then(native.is_error, likely=False):
            builder.store(cgutils.true_bit, failed)
        for number, (way, number_type) in enumerate(_numbers_in(value_type), first):
            part = builder.extract_value(native.value, way) if way else native.value
            builder.store(part, _slot(builder, memory, number, number_type))
        natives.append((one, native))

    def cleanup() -> None:
        for one, native in natives:
            if native.cleanup is not None:
                native.cleanup()
            c.context.nrt.decref(builder, one, native.value)

    # The reads below are marked as of memory that never changes. The pointer goes through an empty piece of
    # assembly, so that they cannot be moved to before the writes here.
    same = ir.FunctionType(BYTES, [BYTES])
    written = builder.asm(same, "", "=r,0,~{memory}", [memory], side_effect=True)
    return NativeValue(written, cleanup=cleanup, is_error=builder.load(failed))


@lower_getattr_generic(Pointed)
def _read(context: Any, builder: Any, kind: Pointed, memory: Any, name: str) -> Any:
    """Read a field."""
    i = kind.of._fields.index(name)
    value_type, first, _ = _slots(context, kind)[i]
    value = ir.Constant(value_type, ir.Undefined)
    for number, (way, number_type) in enumerate(_numbers_in(value_type), first):
        part = builder.load(_slot(builder, memory, number, number_type))
        part.set_metadata("invariant.load", builder.module.add_metadata([]))
        value = builder.insert_value(value, part, way) if way else part
    return impl_ret_borrowed(context, builder, kind.field_types[i], value)
