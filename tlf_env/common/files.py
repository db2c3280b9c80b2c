"""Files that are written completely or not at all, and JSON files without repeated keys."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from tlf_env.common.errors import RepeatedKeyError, path_text

FILE_NAME = re.compile(r"\w[\w.+-]{0,99}")  # a name that can be a file's or a folder's


@contextmanager
def atomic(path: Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a file for writing; it appears under its name only when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, mode, **options) as file:
            yield file
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises
    ------
    ValueError
        if the text is not JSON, is nested too deeply, or repeats a key.
    """
    try:
        return json.loads(text, object_pairs_hook=_without_repeats)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_json(path: Path) -> Any:
    """The value of a JSON file.

    Raises
    ------
    ValueError
        in one line that names the file, if it is missing or as :func:`parse_json`.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"cannot read {path_text(path)}: {error.strerror}") from error
    except RepeatedKeyError as error:
        raise ValueError(f"{path_text(path)}: {error}") from error
    except ValueError as error:
        raise ValueError(
            f"{path_text(path)} is not JSON: {' '.join(str(error).split())}"
        ) from error


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; the standard reader keeps the last of two equal keys without an error."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise RepeatedKeyError(f"the key {key!r} is repeated")
        found[key] = value
    return found
