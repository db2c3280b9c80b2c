"""Files of one line of JSON for each finished piece of work, on the disk as soon as it is finished."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from tlf_env.common.files import naming, parse_json

KeyT = TypeVar("KeyT")


def read_lines(path: Path, key: Callable[[dict[str, Any]], KeyT]) -> dict[KeyT, dict[str, Any]]:
    """The lines of a JSONL file by their keys; none without a file.

    Complete lines only: what a killed process has left of its last line is not read;
    :func:`append_line` cuts it off.

    Raises
    ------
    ValueError
        naming the first damaged line.
    """
    if not path.exists():
        return {}
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    lines: dict[KeyT, dict[str, Any]] = {}
    for number, text in enumerate(whole.splitlines(), start=1):
        try:
            line = parse_json(text)
            lines[key(line)] = line
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}, line {number} is damaged; remove it") from error
    return lines


def append_line(path: Path, line: dict[str, Any]) -> None:
    """Append one line to a JSONL file; it is on the disk when this returns.

    What a killed process has left of a line is cut off before. If the line cannot be written as a whole (a
    full disk may take a part of it without an error), nothing of it stays.

    Raises
    ------
    OSError
        that names the file.
    """
    data = (json.dumps(line, allow_nan=False) + "\n").encode()
    with naming(path):
        handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            end = _end_of_whole_lines(handle)
            try:
                left = memoryview(data)
                while left:
                    left = left[os.write(handle, left) :]
                os.fsync(handle)
            except OSError:
                os.ftruncate(handle, end)
                raise
        finally:
            os.close(handle)


def _end_of_whole_lines(handle: int) -> int:
    """Cut what follows the last newline of a file; returns the file's size then."""
    size = end = os.fstat(handle).st_size
    while end and os.pread(handle, 1, end - 1) != b"\n":
        end -= 1
    if end < size:
        os.ftruncate(handle, end)
    return end
