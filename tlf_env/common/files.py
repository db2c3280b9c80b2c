"""Files that are written completely or not at all, and JSON files without repeated keys."""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from tlf_env.common.errors import RepeatedKeyError, path_text

# Answers of file systems without files that have no name, and of kernels that know none.
NO_UNNAMED = (errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL, errno.ENOENT)
STREAMS = (Path("/dev"), Path("/dev/fd"), Path("/proc/self/fd"))  # folders of links to what is open
FILE_NAME = re.compile(r"\w[\w.+-]{0,99}")  # a name that can be a file's or a folder's


@contextmanager
def atomic(
    path: Path, mode: str = "w", *, exclusive: bool = False, durable: bool = True, **options: Any
) -> Iterator[IO[Any]]:
    """Open a file for writing; it appears under its name only when it is complete.

    Where the system has files without a name (Linux, on most file systems) a killed writer leaves nothing
    behind; elsewhere it leaves a hidden file. A device or a pipe, as ``/dev/null``, is written into: a file in
    its place would end it for all.

    Parameters
    ----------
    exclusive
        Write no file where there is one: of several writers at once the first one's file stays.
    durable
        Wait until the content is on the disk, so that a power cut leaves the old file or the new one.

    Raises
    ------
    OSError
        that names the file, for a full disk or a folder that cannot be written.
    FileExistsError
        if it is exclusive, and there is such a file.
    """
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}"
    if _is_device(path) and not exclusive:
        with (
            naming(path),
            os.fdopen(os.open(path, os.O_WRONLY | os.O_APPEND), mode, **options) as file,
        ):
            yield file
        return
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = _unnamed(path.parent)
        unnamed = handle is not None
        if handle is None:
            handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(handle, mode, **options) as file:
                yield file
                file.flush()
                os.fchmod(handle, 0o644)
                if durable:
                    os.fsync(handle)
                if unnamed:
                    try:
                        _name(handle, path)
                        return
                    except FileExistsError:
                        if exclusive:
                            raise
                    _name(handle, temporary)
            if exclusive:
                os.link(temporary, path)
                temporary.unlink()
            else:
                temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def _is_device(path: Path) -> bool:
    """Whether there is a device, a pipe, or the like; ``/dev/stdout`` is one, too, wherever it leads."""
    if path.is_symlink() and path.absolute().parent in STREAMS:
        return path.exists()
    return path.exists() and not path.is_file() and not path.is_dir()


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an error of the system in this block name the file that was written."""
    try:
        yield
    except OSError as error:
        if error.errno is None or (error.filename is not None and not _is_temporary(error, path)):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error


def _is_temporary(error: OSError, path: Path) -> bool:
    """Whether an error names what only :func:`atomic` knows: a hidden file, or the folder itself."""
    named = str(error.filename)
    return named == str(path.parent) or Path(named).name.startswith(f".{path.name}.")


def _unnamed(folder: Path) -> int | None:
    """A new file in a folder, without a name; None where there are no such files."""
    if not (hasattr(os, "O_TMPFILE") and Path("/proc/self/fd").is_dir()):
        return None
    try:
        return os.open(folder, os.O_TMPFILE | os.O_WRONLY, 0o600)
    except OSError as error:
        if error.errno in NO_UNNAMED:
            return None
        raise


def _name(handle: int, path: Path) -> None:
    """Give a file without a name its name, which must be free."""
    folder = os.open(path.parent, os.O_RDONLY)
    try:  # with a folder Python calls linkat, which follows the link to the file
        os.link(f"/proc/self/fd/{handle}", path.name, dst_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)


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
