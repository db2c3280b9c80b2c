"""Validation errors as one line that names the value and what is allowed."""

from __future__ import annotations

import re
from typing import Any

from pydantic import ValidationError

# Parts of a location that name a branch of a union and are not keys of the user's data.
BRANCH = re.compile(r"[A-Z]\w*|(literal|constrained|tuple|function)[-\[].*|int|str")
LENGTH_ERRORS = ("too_short", "too_long")
ALLOWED = "Input should be "


class RepeatedKeyError(ValueError):
    """A mapping in a YAML or JSON file has the same key twice."""


def one_line(error: ValidationError) -> str:
    """A validation error as one line: each location, what is wrong there, and the value."""
    merged: dict[tuple[tuple[str, ...], str], Any] = {}
    for number, item in enumerate(_relevant(error.errors())):
        if not item["msg"].startswith(ALLOWED):
            merged[(str(number),), ""] = item
            continue
        same = (_location(item), repr(item["input"]))
        if same in merged and merged[same]["msg"] != item["msg"]:  # another branch of the union
            other = item["msg"].removeprefix(ALLOWED)
            merged[same] = {**merged[same], "msg": f"{merged[same]['msg']}, or {other}"}
        else:
            merged[same] = item
    return "; ".join(dict.fromkeys(_message(item) for item in merged.values()))


def _location(item: Any) -> tuple[str, ...]:
    return tuple(str(part) for part in item["loc"] if not BRANCH.fullmatch(str(part)))


def _relevant(items: list[Any]) -> list[Any]:
    """The errors without those of union branches that the value was not meant for."""
    kept = []
    for item in items:
        wrong_kind = item["type"].endswith("_type")
        key = item["loc"][:1]
        others = [
            other
            for other in items
            if other["loc"][:1] == key
            and other is not item
            and (not other["type"].endswith("_type") or len(other["loc"]) > len(item["loc"]))
            and not _miscounted(other, items)
        ]
        in_branch = any(BRANCH.fullmatch(str(part)) for part in item["loc"])
        if not (wrong_kind and in_branch and others) and not _miscounted(item, items):
            kept.append(item)
    return kept


def _miscounted(item: Any, items: list[Any]) -> bool:
    """Whether a length error only reports that members of the sequence are invalid."""
    depth = len(item["loc"])
    return item["type"] in LENGTH_ERRORS and any(
        len(other["loc"]) > depth and other["loc"][:depth] == item["loc"] for other in items
    )


def _message(item: Any) -> str:
    location = ".".join(_location(item))
    message = item["msg"].removeprefix("Value error, ")
    value = item["input"]
    if item["type"] == "extra_forbidden":
        message = "unknown key"
    elif item["type"] != "value_error" and not isinstance(value, dict | list):
        message += f", got {value!r}"
    return f"{location}: {message}" if location else message
