"""Consoles, progress bars and the parsing of option values for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

screen = Console(highlight=False)
notes = Console(stderr=True, highlight=False)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr; yields ``update(done, total)``."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=notes, transient=True, disable=not notes.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def warn_of_compiling() -> None:
    """Announce the compilation before the first run on a machine."""
    from tlf_env.numerics.compiled import cache_folder

    folder = cache_folder()
    if folder is None or not any(folder.rglob("*control_step*.nbi")):
        notes.print("Compiling the step drivers, once on this machine: about a minute.")


def warn_of_missing(error: ModuleNotFoundError) -> None:
    """Say that figures are left out because a package is missing."""
    notes.print(f"No figures: {error.name} is missing (pip install 'tlf-env[figures]').")


def whole_numbers(name: str, text: str) -> list[int]:
    """Comma-separated whole numbers of an option.

    Raises
    ------
    ValueError
        naming the option, for any other text.
    """
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--{name} {text!r} must be comma-separated whole numbers") from None


def listed(text: str) -> tuple[str, ...]:
    """Comma-separated names.

    Raises
    ------
    ValueError
        if there is no name, or one twice.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{text!r} must be comma-separated names, each once")
    return names


def writable_folder(folder: Path) -> Path:
    """The folder, made if it does not exist.

    Raises
    ------
    ValueError
        if it cannot be made or is not a folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot write to {folder}: {error.strerror}") from error
    return folder
