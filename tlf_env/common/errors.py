"""Errors as one line that names the key with its path, the value, and what is allowed."""

from __future__ import annotations

import difflib
import re
import shutil
import sys
import types
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import (
    Annotated,
    Any,
    NamedTuple,
    Union,
    get_args,
    get_origin,
)

from pydantic import BaseModel, ValidationError

COMPLETE = ("value_error", "union_tag_invalid", "too_short", "too_long")  # messages with the value
LENGTH_ERRORS = ("too_short", "too_long")
ALLOWED = "Input should be "
PLAINLY = {"dictionary": "mapping", "tuple": "list", "string": "text"}
PYDANTICS = re.compile(
    r"valid (dictionary|tuple|string)(?: or (?:instance of \w+|object to extract fields from))?"
)
QUOTED = re.compile(r"'([^']+)'")  # an allowed name in pydantic's message
MOST_ERRORS = 6  # named in a line
MOST_COMPARED = 200  # errors of one validation that are compared with each other
CLOSENESS = 0.7  # of two names, from 0 to 1, above which one suggests the other
FEW_NAMES = 8  # so many allowed names are all listed
SHOWN = 60  # characters of a value, and of a key


class RepeatedKeyError(ValueError):
    """A mapping in a YAML or JSON file has the same key twice."""


def shown(value: Any) -> str:
    """A value as one line of at most 60 characters; its type, if it cannot be printed."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # an object of any library may come here
        text = f"an object of the type {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def is_one_of(value: object, names: Iterable[str]) -> bool:
    """Whether a value is one of some names. An array, for example, cannot be compared with them."""
    return isinstance(value, str) and value in names


def path_text(path: object) -> str:
    """A file's path in one line: as it is, unless a character of it cannot be printed."""
    text = str(path)
    return text if text.isprintable() else repr(text)


def suggestion(name: object, allowed: Iterable[str]) -> str:
    """What might be meant instead of an unknown name, if one is near: ``"; did you mean 'robots'?"``."""
    if not isinstance(name, str):
        return ""
    lower = {one.lower(): one for one in reversed(list(allowed))}
    close = difflib.get_close_matches(name.lower()[:SHOWN], list(lower), 1, CLOSENESS)
    return f"; did you mean {lower[close[0]]!r}?" if close else ""


def nearest(name: object, allowed: Iterable[str], others: Mapping[str, str] | None = None) -> str:
    """What to say of an unknown name: a :func:`suggestion`, a hint, the names there are, or nothing.

    Parameters
    ----------
    allowed
        The names there are. If none is near and they are few, they are all listed.
    others
        Hints for names that other libraries use.
    """
    names = list(allowed)
    text = str(name)
    if others and text in others:
        return f"; {others[text]}"
    near = suggestion(text, names)
    if near:
        return near
    if 0 < len(names) <= FEW_NAMES:
        return f"; allowed: {', '.join(names)}"
    return ""


def install_command(extra: str) -> str:
    """The command that adds an extra to the installation that is running.

    pip knows an installed package: it needs an index only for the packages that the extra names.
    """
    found = shutil.which("python")
    active = found is not None and Path(found).parent == Path(sys.executable).parent
    python = "python" if active else path_text(sys.executable)
    return f"{python} -m pip install 'tlf-env[{extra}]'"


class _Found(NamedTuple):
    """One error of a validation."""

    keys: tuple[str, ...]  # its place in the user's data
    in_branch: bool  # whether it concerns one branch of a union
    allowed: tuple[str, ...]  # the keys that exist at the place
    item: Any  # pydantic's description


def one_line(error: ValidationError, kind: Any, hints: Mapping[str, str] | None = None) -> str:
    """A validation error as one line: each place, what is wrong there, and the value.

    Parameters
    ----------
    kind
        The model or type that was validated. It shows which parts of pydantic's locations are keys of the
        user's data, and which only name a branch of a union.
    hints
        What to say of an unknown key at the top, by key.
    """
    items = error.errors(include_url=False)
    found = [_placed(kind, item) for item in items[:MOST_COMPARED]]
    merged: dict[Any, tuple[_Found, str]] = {}
    for number, one in enumerate(_relevant(found)):
        message = _in_own_words(one.item)
        same = (one.keys, shown(one.item["input"]))
        if not message.startswith(ALLOWED):
            merged[number] = one, message
        elif same in merged:  # another branch of the union
            before = merged[same][1]
            other = message.removeprefix(ALLOWED)
            if other not in before:
                merged[same] = one, f"{before}, or {other}"
        else:
            merged[same] = one, message
    lines = list(dict.fromkeys(_message(one, text, hints or {}) for one, text in merged.values()))
    more = len(lines) - MOST_ERRORS + max(len(items) - MOST_COMPARED, 0)
    return "; ".join(lines[:MOST_ERRORS]) + (f"; and {more} more errors" if more > 0 else "")


def _in_own_words(item: Any) -> str:
    """Pydantic's message in the words of the files."""
    more = item.get("ctx", {})
    match item["type"]:
        case "too_short":
            return f"must have at least {_entries(more['min_length'])}, got {more['actual_length']}"
        case "too_long":
            got = more["actual_length"]
            return f"must have at most {_entries(more['max_length'])}, got {got or 'more'}"
        case "invalid_key":
            return "keys must be texts"
        case "union_tag_invalid":
            kinds = [one.strip().strip("'") for one in more["expected_tags"].split(",")]
            near = suggestion(more["tag"], kinds)
            return f"type must be one of {', '.join(kinds)}, got {shown(more['tag'])}{near}"
        case "union_tag_not_found":
            return f"the key {more['discriminator']} is missing"
        case _:
            return PYDANTICS.sub(lambda match: PLAINLY[match[1]], item["msg"])


def _entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def _placed(kind: Any, item: Any) -> _Found:
    """An error with the keys of its place, found by following the location through the type.

    Wherever the type is a union of two or more, one part of the location names the branch.
    """
    kinds = _alternatives(kind)
    keys: list[str] = []
    chosen = in_branch = False
    allowed: tuple[str, ...] = ()
    location = list(item["loc"])
    unknown = item["type"] == "extra_forbidden"
    if item["type"] == "string_type" and location[-1:] == ["[key]"]:
        location.pop()  # a key is wrong and not its value
    for number, part in enumerate(location):
        last = number == len(location) - 1
        if len(kinds) > 1 and not chosen and not (unknown and last):
            kinds = [one for one in kinds if _is_branch(one, str(part))] or kinds
            chosen = in_branch = True
            continue
        allowed = tuple(dict.fromkeys(name for one in kinds for name in _fields(one)))
        keys.append(key_text(part))
        kinds, chosen = _children(kinds, part), False
    return _Found(tuple(keys), in_branch, allowed if unknown else (), item)


def key_text(part: object) -> str:
    """A key as it is printed in a path."""
    text = str(part)
    if not text.isprintable() or not text or text != text.strip():
        text = repr(text)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _alternatives(kind: Any) -> list[Any]:
    """The types that a type stands for, without None."""
    origin = get_origin(kind)
    if hasattr(kind, "__value__"):  # a type with a name of its own
        return _alternatives(kind.__value__)
    if origin is Annotated:
        return _alternatives(get_args(kind)[0])
    if origin is Union or origin is types.UnionType:
        return [one for part in get_args(kind) for one in _alternatives(part)]
    return [] if kind is types.NoneType else [kind]


def _is_branch(kind: Any, label: str) -> bool:
    """Whether pydantic's name of a branch is that of a type."""
    if not _is_model(kind):
        origin = get_origin(kind) or kind
        return label.startswith(getattr(origin, "__name__", str(origin)).lower())
    tag = kind.model_fields.get("type")
    return label == kind.__name__ or (tag is not None and label in get_args(tag.annotation))


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _fields(kind: Any) -> list[str]:
    return list(kind.model_fields) if _is_model(kind) else []


def _children(kinds: Sequence[Any], part: object) -> list[Any]:
    """The types of what a key or an index leads to."""
    found: list[Any] = []
    for kind in kinds:
        given, origin = get_args(kind), get_origin(kind)
        if _is_model(kind):
            field = kind.model_fields.get(part)
            found += [] if field is None else _alternatives(field.annotation)
        elif origin is tuple and isinstance(part, int):
            member = given[0] if given[-1] is ... else given[min(part, len(given) - 1)]
            found += _alternatives(member)
        elif origin in (dict, list, Mapping, Sequence) and given:
            found += _alternatives(given[-1])  # of a dict or a list
    return [one for place, one in enumerate(found) if one not in found[:place]]


def _relevant(items: list[_Found]) -> list[_Found]:
    """The errors without those of union branches that the value was not meant for."""
    kept = []
    for one in items:
        wrong_kind = _is_wrong_kind(one)
        key = one.item["loc"][:1]
        others = [
            other
            for other in items
            if other.item["loc"][:1] == key
            and other is not one
            and (not _is_wrong_kind(other) or len(other.item["loc"]) > len(one.item["loc"]))
            and not _miscounted(other, items)
        ]
        if not (wrong_kind and one.in_branch and others) and not _miscounted(one, items):
            kept.append(one)
    return kept


def _is_wrong_kind(one: _Found) -> bool:
    return one.item["type"].endswith("_type")


def _miscounted(one: _Found, items: list[_Found]) -> bool:
    """Whether a length error only reports that members of the sequence are invalid."""
    place = one.item["loc"]
    depth = len(place)
    return one.item["type"] in LENGTH_ERRORS and any(
        len(other.item["loc"]) > depth and other.item["loc"][:depth] == place for other in items
    )


def _message(one: _Found, message: str, hints: Mapping[str, str]) -> str:
    location = ".".join(one.keys)
    message = message.removeprefix("Value error, ")
    value = one.item["input"]
    if one.item["type"] == "extra_forbidden":
        others = hints if len(one.keys) == 1 else {}
        message = f"unknown key{nearest(one.keys[-1], one.allowed, others)}"
    elif one.item["type"] not in COMPLETE and not isinstance(value, dict | list):
        message += f", got {shown(value)}"
        if "did you mean" not in message:
            message += suggestion(value, QUOTED.findall(message.partition(", got ")[0]))
    return f"{location}: {message}" if location else message
