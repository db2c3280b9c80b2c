"""``tlf eval``: one policy against another on the same seeds, cell by cell, with a verdict in words."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.benchmark.bench import named_scenarios, run_bench
from baselines.benchmark.comparisons import comparison, in_words, only_one_failed
from baselines.benchmark.lines import grouped, worst
from baselines.benchmark.page import number, span, stratum_name
from baselines.benchmark.plan import Episode, Plan, disturbance_presets, parse_seeds
from baselines.benchmark.replays import headline, record_of
from baselines.benchmark.results import Results
from baselines.benchmark.statistics import median
from baselines.commands.bench import BenchFiles, print_files, write_all
from baselines.commands.compile import compile_before_first_run
from baselines.console import listed, progress_bar, screen, warn_of_scenarios
from baselines.pages.replay import write_comparison
from baselines.runs.folders import LONGEST, NOT_IN_FOLDERS, REPLAY
from baselines.runs.provenance import command_line
from tlf_env.common.trust import Trust
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER

RESULTS = Path("results/eval")
METRIC = "position_rmse_mm"


def eval_command(
    policy: str,
    against: str,
    *,
    tasks: str,
    disturbances: str,
    seeds: str,
    overrides: Mapping[str, Any],
    out: Path | None,
    processes: int,
    wanted: BenchFiles,
    trust: Trust,
) -> None:
    """Run both policies, write the files of a benchmark, and print the comparison.

    Raises
    ------
    ValueError
        for whatever does not fit, before the first run.
    """
    policy, against = full_name(policy), full_name(against)
    if policy == against:
        raise ValueError(
            f"{policy!r} cannot be compared with itself; --against names another policy"
        )
    plan = Plan(
        policies=(against, policy),
        tasks=listed(tasks),
        disturbances=tuple(disturbance_presets())
        if disturbances == "all"
        else listed(disturbances),
        seeds=parse_seeds(seeds),
        overrides=tuple(overrides.items()),
        trust=trust,
    )
    warn_of_scenarios(named_scenarios(plan))
    folder = out or RESULTS / NOT_IN_FOLDERS.sub("_", policy)[-LONGEST:].strip("_.")
    compile_before_first_run()
    with progress_bar("eval") as update:
        results = run_bench(plan, folder, processes=processes, progress=update)
    rows = compared_cells(results)
    write_all(results, wanted, command_line(sys.argv[1:]), rows)
    beside = replay_both(results, folder) if wanted.replays else None
    shown = {"policy": policy, "against": against, "cells": rows}
    if wanted.as_json:
        typer.echo(json.dumps(shown, indent=1, allow_nan=False))
        return
    screen.print(eval_table(rows, f"{policy} against {against}, seeds {seeds}"))
    screen.print(f"{policy}: {summary_of(rows)}", soft_wrap=True)
    print_files(folder)
    if beside is not None:
        screen.print(f"Both side by side, in the worst run of {policy}: {beside}", soft_wrap=True)


def replay_both(results: Results, folder: Path) -> Path:
    """The page of both policies side by side: in the cell and with the seed of the second one's worst run."""
    against, policy = results.plan.policies
    (chosen,) = headline(results.ordered(), [policy, against], 1)
    episode = Episode.of_line(chosen.line)
    records = [record_of(results.plan, episode._replace(policy=one)) for one in (against, policy)]
    return write_comparison(records, folder / REPLAY)


def full_name(policy: str) -> str:
    """The name of a policy; of the reference with its gains."""
    return f"reference:{DEFAULT_CONTROLLER}" if policy == "reference" else policy


def compared_cells(results: Results) -> list[dict[str, Any]]:
    """The second policy of a plan against the first, a row for each task and disturbance.

    As :func:`~baselines.benchmark.comparisons.comparison`, with the medians of both and the verdict.
    """
    groups = grouped(results.ordered())
    against, policy = results.plan.policies
    rows = []
    for stratum, mine in groups[policy].items():
        theirs = groups[against][stratum]
        row = comparison(mine, theirs)
        row["medians"] = [
            median([worst(line, METRIC) for line in lines])["median"] for lines in (mine, theirs)
        ]
        row["verdict"] = in_words(row, only_one_failed(mine, theirs))
        rows.append(row)
    return rows


def eval_table(rows: Sequence[Mapping[str, Any]], title: str) -> Table:
    """The policy and what it is compared with, cell by cell."""
    table = Table(
        title=title,
        caption=f"Failed: of {rows[0]['runs']} runs. Error: position RMS of the worst robot in mm, median over "
        "the seeds. Difference: median over the same seeds, with its 95 % interval; below 0 the first "
        "policy is better.",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("disturbance", no_wrap=True)
    for heading in ("failed", "error", "differ-\nence", "95 %"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    task = None
    for row in rows:
        if row["task"] != task:
            task = row["task"]
            table.add_section()
            table.add_row(f"{task}:")
        found, (mine, theirs) = row[METRIC], row["failed"]
        table.add_row(
            stratum_name(dict(row)),
            f"{mine} / {theirs}",
            " / ".join(number(value, 2) for value in row["medians"]),
            number(found["difference"], 2),
            span(found["interval"], 2),
            row["verdict"].partition(":")[0],
        )
    return table


def summary_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """How many cells have each verdict."""
    counts = Counter(row["verdict"].partition(":")[0] for row in rows)
    first = ("better", "worse", "no difference")
    parts = [f"{name} in {counts[name]}" for name in (*first, *sorted(set(counts) - set(first)))]
    return f"{', '.join(parts)} of {len(rows)} pairs of task and disturbance."
