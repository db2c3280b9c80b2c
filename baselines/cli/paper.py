"""The paper's figures and claims, and compiling ahead."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from baselines.commands.examples import examples
from baselines.console import (
    listed,
)

commands = typer.Typer()


@commands.command("paper", epilog=examples("paper"))
def paper(
    figures: Annotated[
        str,
        typer.Option(
            help="fig7ab, fig7c, fig8, slip, ekf, observer, proofs, fig11, robustness and unpublished, "
            "comma-separated; or all. What the folder has of the others stays on its page."
        ),
    ] = "all",
    out: Annotated[Path, typer.Option(help="Folder of the page and the figures.")] = Path(
        "results/paper"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print paper.json instead of the table.")
    ] = False,
) -> None:
    """Compute the paper's figures and claims anew; write a page with a verdict on each claim."""
    try:
        from baselines.commands.paper import paper_command
    except ModuleNotFoundError as error:
        from tlf_env.common.errors import install_command

        raise ValueError(f"tlf paper needs {error.name} ({install_command('figures')})") from error
    paper_command(None if figures == "all" else listed(figures), out, as_json=as_json)


@commands.command("compile", epilog=examples("compile"))
def compile_(
    everything: Annotated[
        bool,
        typer.Option("--all", help="Also the drivers of scenarios in float64, and of tlf speed."),
    ] = False,
) -> None:
    """Compile the step drivers ahead of the first run, on two cores; nothing is done twice."""
    from baselines.commands.compile import ALL, USUAL, compile_drivers

    compile_drivers(ALL if everything else USUAL)
