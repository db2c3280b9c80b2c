"""Large named tuples that compiled functions get by one pointer.

Numba passes a named tuple field by field, and an array as ten numbers and more, so that a function with a
tuple of forty arrays has hundreds of arguments: most of what is compiled would be their copying. Here the
numbers lie in memory, and compiled functions read what they need. Nothing writes there again, and the
reads are marked so, so that the compiler moves them to before a loop. A program that calls a driver often
keeps what :func:`packed` returns, and gives that: then a call costs no time for the fields.
"""

from __future__ import annotations

import array
import hashlib
import struct
from collections.abc import Iterator
from typing import Any, TypeVar

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.types.containers import BaseTuple
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import NativeValue, models, register_model, typeof_impl, unbox

T = TypeVar("T", bound=type)
V = TypeVar("V")

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


class Packed:
    """The numbers of a named tuple in memory, where drivers read them; its arrays may change, but not move."""

    __slots__ = ("_numba_type_", "address", "memory", "values")

    def __init__(self, values: Any) -> None:
        self.values = values  # kept, as the memory has the addresses of its arrays
        self._numba_type_ = numba.typeof(values)
        self.memory = array.array("q")
        for one, kind in zip(values, self._numba_type_.field_types, strict=True):
            self.memory.extend(_words(one, kind))
        self.address, _ = self.memory.buffer_info()

    def packed(self) -> Packed:
        """Itself, as a driver takes both this and the named tuple."""
        return self

    def __reduce__(self) -> Any:
        return Packed, (self.values,)  # a copy has addresses of its own


def packed(values: V) -> V:
    """A named tuple for drivers: what they would make of it at every call, for as long as its arrays stay."""
    given: Any = values if numba.config.DISABLE_JIT else Packed(values)
    found: V = given
    return found


def _words(value: Any, kind: types.Type) -> Iterator[int]:
    """A value as Numba lays it out, each number in a word of 64 bits."""
    if isinstance(kind, types.Array):
        no_owner = (0, 0)  # compiled code counts no references to this memory
        yield from (*no_owner, value.size, value.itemsize, value.ctypes.data)
        yield from (*value.shape, *value.strides)
    elif isinstance(kind, BaseTuple):
        for one, part in zip(value, kind, strict=True):
            yield from _words(one, part)
    elif isinstance(kind, types.Float):
        layout = "fxxxx" if kind == types.float32 else "d"
        yield struct.unpack("q", struct.pack(layout, value))[0]
    else:
        yield int(value)


def by_pointer(named_tuple: T) -> T:
    """Let compiled functions get a named tuple by a pointer, and read its fields by their names only.

    Drivers that Python calls may take it, and functions below them. None may return or keep it. Its fields
    are arrays, numbers, switches, and tuples of numbers and switches.
    """
    if numba.config.DISABLE_JIT:
        return named_tuple

    @typeof_impl.register(named_tuple)
    def typeof(value: Any, context: Any) -> Pointed | None:
        found = tuple(typeof_impl(one, context) for one in value)
        return None if None in found else Pointed(named_tuple, found)

    named_tuple.packed = lambda self: Packed(self)  # type: ignore[attr-defined]
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
    """The address of the numbers, which are packed for this call if the caller has not kept them."""
    builder = c.builder
    held = c.pyapi.call_method(value, "packed", ())
    failed = cgutils.is_null(builder, held)
    address = cgutils.alloca_once_value(builder, ir.Constant(BYTES, None))
    with builder.if_then(builder.not_(failed), likely=True):
        number = c.pyapi.object_getattr_string(held, "address")
        builder.store(c.pyapi.long_as_voidptr(number), address)
        c.pyapi.decref(number)
    return NativeValue(builder.load(address), is_error=failed, cleanup=lambda: c.pyapi.decref(held))


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
