"""What a user's part, or a policy, remembers from call to call: plain values in, plain values out.

A part may have the methods ``get_state()``, which returns plain values, and ``set_state(state)``, which takes
them back. *Plain* are numbers, texts, True, False and None, arrays of numbers, random generators of NumPy, and
lists, tuples, deques and dictionaries of these; named tuples, too, if their class is in the module of the
part. The state of a part without the methods is its attributes, if all of them are plain, or constants: a
:class:`~tlf_env.physics.parameters.RobotParameters` or another frozen model, functions, classes and modules.
"""

from __future__ import annotations

import inspect
import sys
from collections import deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import BaseModel

from tlf_env.common.errors import shown

HOOK = ("get_state", "set_state")
GENERATORS = ("MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64")
NamedTuples = Mapping[str, Any]  # classes by their names
DTYPES = tuple(
    np.dtype(name)
    for name in ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
)
PLAIN = (bool, int, float, str)
DEEPEST = 40  # lists within lists


class NotPlainError(ValueError):
    """A value is not plain; the message says where and what it is."""


class _Packing:
    """Plain values as JSON values and arrays; an object that is met twice is the same one again afterwards."""

    def __init__(self, numbers: dict[str, np.ndarray], name: str, named: NamedTuples) -> None:
        self._numbers, self._name, self._named = numbers, name, named
        self._places: dict[int, int] = {}  # of the objects that can change, by identity
        self._kept: list[Any] = []  # so that no identity is used twice
        self._arrays: list[np.ndarray] = []
        self._written = 0  # arrays
        self._open: set[int] = set()  # of those that contain the one at hand

    def pack(self, value: Any, place: str, depth: int = 0) -> Any:
        if value is None or type(value) in PLAIN:
            return value
        if depth > DEEPEST:
            raise NotPlainError(f"{place} is nested too deeply")
        if id(value) in self._open:
            raise NotPlainError(f"{place} contains itself")
        if id(value) in self._places:
            return {"again": self._places[id(value)]}
        if isinstance(value, np.generic):
            return {"number": self._array(np.asarray(value), place)}
        self._places[id(value)] = len(self._kept)
        self._kept.append(value)
        self._open.add(id(value))
        found = self._parts(value, place, depth)
        self._open.discard(id(value))
        return found

    def _parts(self, value: Any, place: str, depth: int) -> Any:
        if type(value) is np.ndarray:
            for other in self._arrays:
                if np.may_share_memory(other, value) and np.shares_memory(other, value):
                    raise NotPlainError(f"{place} is an array in the memory of another")
            self._arrays.append(value)
            return {"array": self._array(value, place)}
        if type(value) in (list, tuple):
            rows = [self.pack(one, f"{place}[{i}]", depth + 1) for i, one in enumerate(value)]
            return {type(value).__name__: rows}
        if type(value) is self._named.get(type(value).__name__):
            rows = [
                self.pack(one, f"{place}.{field}", depth + 1)
                for field, one in zip(value._fields, value, strict=True)
            ]
            return {"named": rows, "class": type(value).__name__}
        if type(value) is deque:
            rows = [self.pack(one, f"{place}[{i}]", depth + 1) for i, one in enumerate(value)]
            return {"deque": rows, "longest": value.maxlen}
        if type(value) is dict:
            if any(not isinstance(key, str | int) or isinstance(key, bool) for key in value):
                raise NotPlainError(f"{place} has keys that are neither texts nor whole numbers")
            pairs = [
                [key, self.pack(one, f"{place}[{key!r}]", depth + 1)] for key, one in value.items()
            ]
            return {"dict": pairs}
        if type(value) is np.random.Generator:
            kind = type(value.bit_generator).__name__
            if kind in GENERATORS:
                state = self.pack(value.bit_generator.state, place, depth + 1)
                return {"generator": state}
        raise NotPlainError(f"{place} is {shown(value)}")

    def _array(self, value: np.ndarray, place: str) -> str:
        if value.dtype not in DTYPES:
            raise NotPlainError(f"{place} is an array of {value.dtype}")
        name = f"{self._name}/{len(self._kept)}/{self._written}"
        self._written += 1
        self._numbers[name] = value.copy()
        return name


def named_tuples(user: Any) -> NamedTuples:
    """Named tuples that values of an object may have: those in the modules of its class and of its bases."""
    if user is None:
        return {}
    modules = [sys.modules.get(kind.__module__) for kind in type(user).__mro__[::-1]]
    return {
        one.__name__: one
        for module in modules
        for one in vars(module).values()
        if isinstance(one, type) and issubclass(one, tuple) and hasattr(one, "_fields")
    }


def packed(
    value: Any,
    name: str,
    numbers: dict[str, np.ndarray],
    place: str,
    named: NamedTuples = MappingProxyType({}),
) -> Any:
    """A plain value as JSON values; its arrays are put into ``numbers``, under names that begin with ``name``.

    ``named`` are named tuples that count as plain.

    Raises
    ------
    NotPlainError
        naming the first value that is not plain; ``place`` is the name of the whole.
    """
    return _Packing(numbers, name, named).pack(value, place)


def unpacked(
    tree: Any, numbers: Mapping[str, np.ndarray], named: NamedTuples = MappingProxyType({})
) -> Any:
    """The inverse of :func:`packed`; all objects are new.

    Raises
    ------
    ValueError
        for a tree that :func:`packed` does not make.
    """
    try:
        return _Unpacking(numbers, named).unpack(tree)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("it is no packed value") from error


class _Unpacking:
    """The inverse of :class:`_Packing`."""

    def __init__(self, numbers: Mapping[str, np.ndarray], named: NamedTuples) -> None:
        self._numbers, self._named = numbers, named
        self._made: list[Any] = []

    def unpack(self, tree: Any) -> Any:
        if tree is None or type(tree) in PLAIN:
            return tree
        kind = next(iter(tree), None)
        content = tree[kind]
        if kind == "again":
            return self._made[content]
        if kind == "number":
            return self._numbers[content][()]
        place = len(self._made)
        self._made.append(None)
        self._made[place] = made = self._object(kind, content, tree)
        return made

    def _object(self, kind: Any, content: Any, tree: Any) -> Any:
        if kind == "array":
            return self._numbers[content].copy()
        if kind == "dict":
            return {key: self.unpack(one) for key, one in content}
        if kind == "generator":
            state = self.unpack(content)
            if state["bit_generator"] not in GENERATORS:
                raise KeyError
            bits = getattr(np.random, state["bit_generator"])()
            bits.state = state
            return np.random.Generator(bits)
        rows = [self.unpack(one) for one in content]
        if kind == "named":
            return self._named[tree["class"]](*rows)
        if kind == "deque":
            return deque(rows, maxlen=tree["longest"])
        return {"list": list, "tuple": tuple}[kind](rows)


def has_hook(part: Any) -> bool:
    """Whether a part has ``get_state()`` and ``set_state(state)``.

    Raises
    ------
    ValueError
        if it has only one of them.
    """
    found = [callable(getattr(part, name, None)) for name in HOOK]
    if found[0] != found[1]:
        here, missing = HOOK if found[0] else HOOK[::-1]
        raise ValueError(f"it has {here}() but no {missing}()")
    return found[0]


def state_of(part: Any, what: str, name: str, numbers: dict[str, np.ndarray]) -> Any:
    """The state of a part as JSON values, its arrays in ``numbers``; see the module.

    Raises
    ------
    ValueError
        in one line that names the part (``what``), if its state is not plain.
    """
    try:
        if has_hook(part):
            value, place = part.get_state(), "the value of get_state()"
            return {"hook": packed(value, name, numbers, place, named_tuples(part))}
        if not hasattr(part, "__dict__") or _slots(part):
            raise NotPlainError("its attributes are in slots")
        plain = {key: one for key, one in vars(part).items() if not _is_constant(one)}
        return {"attributes": packed(plain, name, numbers, "attribute", named_tuples(part))}
    except NotPlainError as error:
        raise ValueError(
            f"the state of the {what} cannot be read: {error}; give it the methods get_state() and "
            f"set_state(state), with plain values"
        ) from error
    except ValueError as error:
        raise ValueError(f"the state of the {what} cannot be read: {error}") from error


def give_state(part: Any, tree: Any, what: str, numbers: Mapping[str, np.ndarray]) -> None:
    """Give a part that was just started the state that :func:`state_of` has read.

    Raises
    ------
    ValueError
        in one line that names the part (``what``), if the state is of another kind of part, or if its
        ``set_state`` raises any error.
    """
    try:
        hooked = has_hook(part)
        value = unpacked(tree["hook" if hooked else "attributes"], numbers, named_tuples(part))
        if hooked:
            part.set_state(value)
        else:
            vars(part).update(value)
    except Exception as error:  # a user's method can raise any error
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"the {what} does not take its state: {why}") from error


def caller_state(
    caller: Any, what: str, name: str, numbers: dict[str, np.ndarray], memory: Any = None
) -> Any:
    """What an object that is called once a step, a policy or an adversary, remembers, as JSON values.

    That is the state of its hook if it has one, and ``memory``, what its ``predict`` returned as its state.
    Anything else that it keeps in itself, as a network, is taken as constant.

    Raises
    ------
    ValueError
        in one line that names it (``what``), if its state is not plain.
    """
    try:
        named = named_tuples(caller)
        place = "the state that predict() returned"
        tree = {"memory": packed(memory, f"{name}/memory", numbers, place, named)}
        if has_hook(caller):
            value, place = caller.get_state(), "the value of get_state()"
            tree["hook"] = packed(value, f"{name}/hook", numbers, place, named)
    except ValueError as error:
        raise ValueError(f"the state of the {what} cannot be read: {error}") from error
    return tree


def give_caller_state(caller: Any, tree: Any, what: str, numbers: Mapping[str, np.ndarray]) -> Any:
    """Give an object the state of :func:`caller_state`; returns what its ``predict`` takes next.

    Raises
    ------
    ValueError
        in one line that names it (``what``), if it does not take its state.
    """
    if not isinstance(tree, dict) or "memory" not in tree:
        raise ValueError(f"the {what} does not take its state: there is none")
    memory = unpacked(tree["memory"], numbers, named_tuples(caller))
    if "hook" in tree or has_hook(caller):
        give_state(caller, tree, what, numbers)
    return memory


def _slots(part: Any) -> bool:
    return any(getattr(kind, "__slots__", ()) for kind in type(part).__mro__)


def _is_constant(value: Any) -> bool:
    """Whether a value cannot change while an episode runs."""
    if isinstance(value, BaseModel):
        return bool(value.model_config.get("frozen"))
    compiled = type(value).__module__.startswith("numba.")
    return (
        compiled
        or isinstance(value, type | np.ufunc)
        or inspect.ismodule(value)
        or inspect.isroutine(value)
    )
