"""Consoles, progress bars and the parsing of option values for the command line."""

from __future__ import annotations

import codecs
import io
import sys
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console

if TYPE_CHECKING:
    from tlf_env.task.scenario import Scenario

# Texts are printed as they are: a bracket is no markup, and a colon begins no emoji.
screen = Console(highlight=False, markup=False, emoji=False)
notes = Console(stderr=True, highlight=False, markup=False, emoji=False)

# What is printed where an encoding lacks a character: mostly one character, so that columns stay in line.
PLAIN = {
    "–": "-", "—": "-", "−": "-", "‑": "-", "·": ".", "×": "x", "…": "...", "→": "->", "≤": "<=",
    "≥": ">=", "±": "+-", "∞": "inf", "θ": "theta", "δ": "delta", "ψ": "psi", "ω": "omega",
    "“": '"', "”": '"', "‘": "'", "’": "'", "•": "*", "━": "-", "─": "-", "╸": "-", "╺": "-",
    "ß": "ss", "°": "deg", "µ": "u", "μ": "u",
}  # fmt: skip


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Plain characters for those that cannot be encoded: of :data:`PLAIN`, without accents, or ``?``."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    replaced = [
        PLAIN.get(one)
        or unicodedata.normalize("NFKD", one).encode("ascii", "ignore").decode()
        or "?"
        for one in error.object[error.start : error.end]
    ]
    return "".join(replaced), error.end


codecs.register_error("tlf.plain", _plain)


def print_on_any_terminal() -> None:
    """Let standard output and error replace what their encoding lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="tlf.plain")


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[..., None]]:
    """A progress bar on stderr; yields ``update(done, total)``, with a third argument for what is done now."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=notes, transient=True, disable=not notes.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total, now=what: bar.update(
            task, description=now, completed=done, total=total
        )


def warn_of_scenarios(scenarios: Iterable[tuple[str, Scenario]]) -> None:
    """Print the warnings for some scenarios, each with its name; every line once."""
    from tlf_env.task.warn import warning_lines

    for line in warning_lines(scenarios):
        notes.print(f"tlf: warning: {line}", soft_wrap=True)


def warn_of_missing(error: ModuleNotFoundError) -> None:
    """Say that figures are left out because a package is missing."""
    from tlf_env.common.errors import install_command

    hint = f"No figures: {error.name} is missing ({install_command('figures')})."
    notes.print(hint, soft_wrap=True)


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


def given(ctx: typer.Context, option: str) -> bool:
    """Whether an option has another source than its default: the command line or a plan."""
    source = ctx.get_parameter_source(option)
    return source is not None and source.name in ("COMMANDLINE", "DEFAULT_MAP")


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
