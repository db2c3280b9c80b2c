"""Errors for people: one line that names the value and what is allowed."""

from __future__ import annotations

import re
from typing import Any

from pydantic import ValidationError

# Parts of a place that name a branch of a union, not a key of the user's.
BRANCH = re.compile(r"[A-Z]\w*|(literal|constrained|tuple|function)[-\[].*|int|str")
COUNTED = ("too_short", "too_long")
WANTED = "Input should be "


class RepeatedKeyError(ValueError):
    """A mapping in a YAML or JSON file has the same key twice."""


def one_line(error: ValidationError) -> str:
    """A validation error as one line: every place, what is wrong there, and the value."""
    told: dict[tuple[tuple[str, ...], str], Any] = {}
    for number, item in enumerate(_relevant(error.errors())):
        if not item["msg"].startswith(WANTED):
            told[(str(number),), ""] = item
            continue
        same = (_place(item), repr(item["input"]))
        if same in told and told[same]["msg"] != item["msg"]:  # another branch of the same union
            other = item["msg"].removeprefix(WANTED)
            told[same] = {**told[same], "msg": f"{told[same]['msg']}, or {other}"}
        else:
            told[same] = item
    return "; ".join(dict.fromkeys(_told(item) for item in told.values()))


def _place(item: Any) -> tuple[str, ...]:
    return tuple(str(part) for part in item["loc"] if not BRANCH.fullmatch(str(part)))


def _relevant(items: list[Any]) -> list[Any]:
    """Where a union refused a value, only the branch that the value was meant for."""
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
    """Whether a sequence was counted without the members that are themselves wrong."""
    depth = len(item["loc"])
    return item["type"] in COUNTED and any(
        len(other["loc"]) > depth and other["loc"][:depth] == item["loc"] for other in items
    )


def _told(item: Any) -> str:
    place = ".".join(_place(item))
    message = item["msg"].removeprefix("Value error, ")
    value = item["input"]
    if item["type"] == "extra_forbidden":
        message = "unknown key"
    elif item["type"] != "value_error" and not isinstance(value, dict | list):
        message += f", got {value!r}"
    return f"{place}: {message}" if place else message
