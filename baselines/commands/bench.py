"""``tlf bench``: what is written and printed when the runs are finished."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import typer

from baselines.benchmark.aggregate import write_leaderboard
from baselines.benchmark.replays import Replay, headline, write_replays
from baselines.benchmark.report import REPORT_FILE, write_report
from baselines.benchmark.results import BOARD_FILE, PAGE_FILE, RUNS_FILE, Results
from baselines.console import notes, progress_bar, screen, warn_of_missing
from baselines.pages.replay import write_replay
from baselines.tables import board_table


class BenchFiles(NamedTuple):
    """What is written and printed."""

    figures: bool = True
    replays: int = 0
    as_json: bool = False


def finish(results: Results, wanted: BenchFiles, command: str) -> None:
    """Write the tables, the figures, the replays and the report, and print the leaderboard."""
    board = write_all(results, wanted, command)
    if wanted.as_json:
        typer.echo(json.dumps(board, indent=1, allow_nan=False))
        return
    screen.print(board_table(board))
    print_files(results.folder)


def write_all(
    results: Results, wanted: BenchFiles, command: str, compared: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """Write everything into the folder of the results; returns the leaderboard.

    Parameters
    ----------
    compared
        As of :func:`~baselines.benchmark.report.write_report`.
    """
    board = write_leaderboard(
        results, results.folder, command, draw_bench if wanted.figures else None
    )
    replays = replay_some(results, board, wanted.replays)
    write_report(results, board, results.folder, replays, compared)
    return board


def print_files(folder: Path) -> None:
    """Say where the results are."""
    files = ", ".join((RUNS_FILE, PAGE_FILE, BOARD_FILE, REPORT_FILE))
    screen.print(f"In {folder}: {files}", soft_wrap=True)
    screen.print(f"Open {folder / REPORT_FILE} in a browser.", soft_wrap=True)


def replay_some(results: Results, board: Mapping[str, Any], count: int) -> list[Replay]:
    """Replays of the most telling runs, written; a note for each that is not the run in the table."""
    if count < 1:
        return []
    ranked = [row["policy"] for row in board["policies"]]
    chosen = headline(results.ordered(), ranked, count)
    with progress_bar("replays") as update:
        made = write_replays(results.plan, chosen, results.folder, write_replay, update)
    for one in made:
        for difference in one.differences[:1]:
            notes.print(f"tlf: warning: {one.file} differs: {difference}", soft_wrap=True)
    return made


def draw_bench(board: dict[str, Any], folder: Path) -> list[Path]:
    """The benchmark's figures; none, and a note, if matplotlib is missing."""
    try:
        from baselines.benchmark.figures import write_bench_figures
    except ModuleNotFoundError as error:
        warn_of_missing(error)
        return []
    return write_bench_figures(board, folder)
