"""Errors for people: one line that names the value and what is allowed."""

from __future__ import annotations

from pydantic import ValidationError


def one_line(error: ValidationError) -> str:
    """A validation error as one line: every place, what is wrong there, and the value."""
    parts = []
    for item in error.errors():
        place = ".".join(str(part) for part in item["loc"])
        message = item["msg"].removeprefix("Value error, ")
        value = item["input"]
        if item["type"] == "extra_forbidden":
            message = "unknown key"
        elif item["type"] != "value_error" and not isinstance(value, dict | list):
            message += f", got {value!r}"
        parts.append(f"{place}: {message}" if place else message)
    return "; ".join(parts)
