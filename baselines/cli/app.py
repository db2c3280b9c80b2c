"""The application, and what its commands share: completion of names, the version."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

BAD_INPUT, FAILED = 2, 1  # exit status; of a command that was stopped: baselines.runs.stopping

app = typer.Typer(
    help="Time-gap leader-follower formations of wheeled robots that slip.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def completed(kind: str) -> Callable[[str], list[str]]:
    """Completes the names of a kind of :data:`~baselines.commands.catalogue.KINDS` in a shell."""

    def matching(incomplete: str) -> list[str]:
        from baselines.commands.catalogue import catalogue

        return [name for name in catalogue(kind)[kind] if name.startswith(incomplete)]

    return matching


def print_version(wanted: bool) -> None:
    """Print the version and end, if it is wanted."""
    if wanted:
        from importlib.metadata import version

        typer.echo(f"tlf_env {version('tlf-env')}")
        raise typer.Exit


@app.callback()
def everywhere(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version.", is_eager=True, callback=print_version),
    ] = False,
) -> None:
    """Time-gap leader-follower formations of wheeled robots that slip."""
