"""Messages between this process and one that runs code of others: JSON and numbers, never pickled objects."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from tlf_env.onboard.memory import DTYPES

HEAD = struct.Struct("<I")  # bytes of the JSON, which comes before the numbers
NO_NUMBERS: Mapping[str, np.ndarray] = MappingProxyType({})
DTYPE_NAMES = {one.str: one for one in DTYPES}

# The first byte of what is asked. The rows of numbers are those of :mod:`tlf_env.hosting.crew`.
CALL, ESTIMATE, TORQUE, OBSERVE = b"C", b"E", b"T", b"O"
# The first byte of an answer.
DONE, REFUSED = b"=", b"!"


class DamagedError(ValueError):
    """A message is not as agreed."""


def encoded(value: Any, numbers: Mapping[str, np.ndarray] = NO_NUMBERS) -> bytes:
    """A JSON value and some arrays as bytes; :func:`decoded` is the inverse."""
    arrays = {name: np.ascontiguousarray(one) for name, one in numbers.items()}
    layout = [[name, one.dtype.str, one.shape] for name, one in arrays.items()]
    # `ascontiguousarray` makes a number an array of one: its shape is that of the original.
    for row, one in zip(layout, numbers.values(), strict=True):
        row[2] = list(one.shape)
    text = json.dumps([value, layout], separators=(",", ":")).encode()
    return b"".join([HEAD.pack(len(text)), text, *(one.tobytes() for one in arrays.values())])


def decoded(data: bytes) -> tuple[Any, dict[str, np.ndarray]]:
    """The value and the arrays of a message.

    Raises
    ------
    DamagedError
        for anything but what :func:`encoded` makes.
    """
    try:
        (length,) = HEAD.unpack_from(data)
        begin = HEAD.size + length
        value, layout = json.loads(data[HEAD.size : begin].decode())
        numbers = {}
        for name, kind, shape in layout:
            dtype, sizes = DTYPE_NAMES[kind], [_size(one) for one in shape]
            count = int(np.prod(sizes, dtype=object))
            end = begin + count * dtype.itemsize
            if not isinstance(name, str) or end > len(data):
                raise ValueError
            numbers[name] = np.frombuffer(data[begin:end], dtype).reshape(sizes).copy()
            begin = end
    except (
        ValueError,
        LookupError,
        TypeError,
        OverflowError,
        RecursionError,
        struct.error,
    ) as error:
        raise DamagedError from error
    if begin != len(data) or len(numbers) != len(layout):
        raise DamagedError
    return value, numbers


def _size(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError
    return value
