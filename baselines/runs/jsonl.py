"""Files of one line of JSON for each finished piece of work, on the disk as soon as it is finished."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from tlf_env.common.files import atomic, parse_json

KeyT = TypeVar("KeyT")


def read_lines(path: Path, key: Callable[[dict[str, Any]], KeyT]) -> dict[KeyT, dict[str, Any]]:
    """The lines of a JSONL file by their keys; none without a file.

    Complete lines only: a half-written last line of a killed process is removed from the file.

    Raises
    ------
    ValueError
        naming the first damaged line.
    """
    if not path.exists():
        return {}
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        with atomic(path, "wb") as file:
            file.write(whole)
    lines: dict[KeyT, dict[str, Any]] = {}
    for number, text in enumerate(whole.splitlines(), start=1):
        try:
            line = parse_json(text)
            lines[key(line)] = line
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}, line {number} is damaged; remove it") from error
    return lines


def append_line(path: Path, line: dict[str, Any]) -> None:
    """Append one line to a JSONL file; it is on the disk when this returns."""
    text = json.dumps(line, allow_nan=False) + "\n"
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(handle, text.encode())
        os.fsync(handle)
    finally:
        os.close(handle)
