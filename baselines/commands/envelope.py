"""``tlf bench --envelope``: from the options of the command line to the printed tables."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.benchmark.envelope import TASK, EnvelopePlan, knob_presets
from baselines.benchmark.envelope_board import (
    BOARD_FILE,
    PAGE_FILE,
    ratio_text,
    text_of,
    write_envelope,
)
from baselines.benchmark.envelope_runs import LEVELS_FILE, run_envelope
from baselines.benchmark.page import policy_label
from baselines.benchmark.plan import parse_seeds
from baselines.commands.compile import compile_before_first_run
from baselines.console import (
    given,
    listed,
    progress_bar,
    screen,
    warn_of_missing,
    warn_of_scenarios,
)
from baselines.runs.provenance import command_line

SEEDS = "20000:20100"
OUT = Path("results/envelope")
OTHERS = ("disturbances", "also", "level", "sweep")  # options that an envelope has no use for


def bench_envelope(ctx: typer.Context, policies: tuple[str, ...]) -> None:
    """Search the envelopes of policies as the options of ``tlf bench`` ask for, write them and print them.

    Raises
    ------
    ValueError
        for an option that does not go with ``--envelope``, an unknown name, or a plan that cannot run.
    """
    options = ctx.params
    if options["test"] or options["test_seed"] is not None:
        raise ValueError(
            "--test cannot be used with --envelope: every case has its own disturbance"
        )
    for name in OTHERS:
        if given(ctx, name):
            raise ValueError(
                f"--{name} {options[name]} does not go with --envelope, whose disturbances are --knobs"
            )
    if options["plant"] not in (None, "batch"):
        raise ValueError(f"--plant {options['plant']}: --envelope runs on the plant batch")
    plan = EnvelopePlan(
        policies=policies,
        tasks=listed(options["tasks"]) if given(ctx, "tasks") else (TASK,),
        knobs=tuple(knob_presets()) if options["knobs"] == "all" else listed(options["knobs"]),
        seeds=parse_seeds(options["seeds"] if given(ctx, "seeds") else SEEDS),
        resolution=options["resolution"],
        horizon_s=options["horizon_s"],
        trust=options["trust"],
    )
    warn_of_scenarios(
        (f"{task}, {knob}", plan.ends(task, knob)[0]) for task in plan.tasks for knob in plan.knobs
    )
    folder: Path = options["out"] or OUT
    compile_before_first_run()
    with progress_bar("envelope") as update:
        results = run_envelope(
            plan,
            folder,
            processes=options["processes"] or os.cpu_count() or 1,
            ray_address=options["ray"],
            progress=update,
        )
    command = command_line(sys.argv[1:])
    board = write_envelope(results, folder, command, _draw if options["figures"] else None)
    if options["as_json"]:
        typer.echo(json.dumps(board, indent=1, allow_nan=False))
        return
    screen.print(_score_table(board))
    screen.print(_level_table(board))
    screen.print(f"In {folder}: {LEVELS_FILE}, {PAGE_FILE}, {BOARD_FILE}", soft_wrap=True)


def _draw(board: dict[str, Any], folder: Path) -> list[Path]:
    try:
        from baselines.benchmark.envelope_figure import write_envelope_figure
    except ModuleNotFoundError as error:
        warn_of_missing(error)
        return []
    return write_envelope_figure(board, folder)


def _score_table(board: dict[str, Any]) -> Table:
    table = Table(title="geometric mean of the envelopes, in levels", box=SIMPLE_HEAD)
    table.add_column("system")
    for heading in ("score", "below the\nfirst level", "median ratio\nto the best"):
        table.add_column(heading, justify="right")
    compared = {row["policy"]: row for row in board["comparisons"]}
    for row in board["policies"]:
        table.add_row(
            policy_label(row),
            f"{row['score']:.2f}",
            f"{row['below_first']} of {row['knobs']}",
            ratio_text(compared.get(row["policy"])).replace("*", ""),
        )
    return table


def _level_table(board: dict[str, Any]) -> Table:
    table = Table(box=SIMPLE_HEAD, title="largest value that holds, and its 95 % interval")
    for heading in ("task", "knob", "system"):
        table.add_column(heading)
    table.add_column("envelope", justify="right")
    for cell in board["cells"]:
        table.add_row(cell["task"], cell["knob"], cell["policy"], text_of(cell))
    return table
