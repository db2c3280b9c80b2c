"""Commands for a first look: the demo, what there is, what a scenario holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from baselines.cli.options import (
    DISTURBANCE,
    LEVEL,
    SCENARIO,
    SETTINGS,
)
from baselines.commands.examples import examples

commands = typer.Typer()


@commands.command(epilog=examples("demo"))
def demo(
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the picture and the data.")] = Path(
        "results/demo"
    ),
    figures: Annotated[bool, typer.Option(help="Draw the picture.")] = True,
) -> None:
    """Compare the paper's loop, the default and a learned policy, with and without slip: a first look."""
    from baselines.commands.compile import compile_before_first_run
    from baselines.commands.demo import demo_command
    from tlf_env.numerics.philox import checked_seed

    compile_before_first_run()
    demo_command(checked_seed(seed), out, figures=figures)


@commands.command("list", epilog=examples("list"))
def list_(
    kind: Annotated[
        str | None,
        typer.Argument(help="tasks, disturbances, policies, ...; all kinds if it is left out."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the names as JSON.")] = False,
) -> None:
    """List what can be named: tasks, disturbances, policies, estimators, trainings, plans, ..."""
    from baselines.commands.catalogue import catalogue, print_catalogue

    found = catalogue(kind)
    if as_json:
        typer.echo(json.dumps(found, indent=1, ensure_ascii=False))
    else:
        print_catalogue(found)


@commands.command(epilog=examples("show"))
def show(
    scenario: Annotated[str, SCENARIO],
    disturbance: Annotated[str | None, DISTURBANCE] = None,
    level: Annotated[float | None, LEVEL] = None,
    settings: Annotated[list[str] | None, SETTINGS] = None,
    changes: Annotated[
        bool, typer.Option("--changes", help="Print only what differs from the defaults.")
    ] = False,
) -> None:
    """Print a scenario as YAML: `tlf show infinity > own.yaml`, or `tlf show infinity | tlf run -`."""
    from baselines.commands.scenarios import asked_scenario, shown_scenario

    chosen = asked_scenario(scenario, {"disturbance": disturbance}, level, settings or ())
    typer.echo(str(chosen) if changes else shown_scenario(chosen), nl=False)
