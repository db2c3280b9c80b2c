"""Commands that find policies and gains: training and search."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from baselines.cli.app import completed
from baselines.cli.options import (
    RAY,
)
from baselines.commands.examples import examples
from baselines.console import (
    given,
    progress_bar,
    screen,
    warn_of_scenarios,
    whole_numbers,
)

commands = typer.Typer()


@commands.command(epilog=examples("train"))
def train(
    ctx: typer.Context,
    config: Annotated[
        str,
        typer.Argument(
            help="Training: a preset (see `tlf list trainings`) or a YAML file.",
            autocompletion=completed("trainings"),
        ),
    ],
    seeds: Annotated[str, typer.Option(help="Training seeds, comma-separated.")] = "0",
    robot_steps: Annotated[
        int | None, typer.Option(help="Control steps × robots; overrides the file's.")
    ] = None,
    processes: Annotated[
        int,
        typer.Option(
            help="Seeds, or trials of a search, at a time on this machine; 0: one per core. A search is "
            "repeatable with 1 only."
        ),
    ] = 0,
    ray: Annotated[str | None, RAY] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results; default results/train/CONFIG, of a search results/search/CONFIG."
        ),
    ] = None,
    search: Annotated[
        bool,
        typer.Option(
            "--search", help="Search for better numbers: the ranges of its section `search`."
        ),
    ] = False,
    trials: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of trials of a search, those of earlier calls included.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the evaluations as JSON instead of the table.")
    ] = False,
) -> None:
    """Train one policy per seed. Interrupt it, and call it again to continue to the same result."""
    from baselines.training.config import load_config, with_trials

    if trials is not None and not search:
        raise ValueError("--trials goes with --search")
    if search and (given(ctx, "seeds") or given(ctx, "robot_steps")):
        raise ValueError(
            "--seeds and --robot-steps do not go with --search: its section `search` has its own"
        )
    loaded = load_config(config, robot_steps=robot_steps)
    numbers = whole_numbers("seeds", seeds)
    try:
        from baselines.commands.train import search_command, train_command
    except ModuleNotFoundError as error:
        from tlf_env.common.errors import install_command

        raise ValueError(f"training needs {error.name} ({install_command('train')})") from error
    if search:
        search_command(
            with_trials(loaded, trials),
            Path(config).stem,
            out=out,
            processes=processes or os.cpu_count() or 1,
            ray=ray,
            as_json=as_json,
        )
        return
    train_command(
        loaded,
        Path(config).stem,
        numbers,
        out=out,
        processes=processes or os.cpu_count() or 1,
        ray=ray,
        as_json=as_json,
    )


@commands.command(epilog=examples("tune"))
def tune(
    config: Annotated[
        str,
        typer.Argument(
            help="Search: a preset (see `tlf list searches`) or a YAML file.",
            autocompletion=completed("searches"),
        ),
    ],
    trials: Annotated[
        int | None, typer.Option(help="Number of trials, including those of earlier calls.")
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            help="Processes on this machine; 0: one per core. Results are reproducible with 1 only."
        ),
    ] = 1,
    ray: Annotated[str | None, RAY] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default results/tune/CONFIG.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON instead of the table.")
    ] = False,
) -> None:
    """Search a controller's or a law's numbers. Interrupt it, and call it again to continue."""
    from baselines.commands.compile import compile_before_first_run
    from baselines.runs.provenance import command_line
    from baselines.tables import tune_table
    from baselines.tuning.config import load_tune
    from baselines.tuning.search import RESULT_FILE, run_tune, use_of

    search = load_tune(config, trials=trials)
    folder = out or Path("results") / "tune" / Path(config).stem
    warn_of_scenarios(search.scenarios(search.ekf_slip).items())
    compile_before_first_run()
    with progress_bar("tune") as update:
        result = run_tune(
            search,
            folder,
            workers=workers or os.cpu_count() or 1,
            ray_address=ray,
            command=command_line(sys.argv[1:]),
            progress=update,
        )
    if as_json:
        typer.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    screen.print(tune_table(result["found"]))
    screen.print(f"In {folder}: {RESULT_FILE}; run it with", soft_wrap=True)
    use = use_of(search, folder)
    how = use.replace("reference:", "--gains ", 1) if "+" not in use else f"--policy {use}"
    screen.print(f"tlf run {search.tasks[0]} {how}", soft_wrap=True)
