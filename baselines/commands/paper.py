"""``tlf paper``: the paper's figures and claims, computed anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.commands.compile import compile_before_first_run
from baselines.console import progress_bar, screen, writable_folder
from baselines.paper.report import counted, in_order, write_pages
from baselines.paper.results import (
    FILE,
    PARTS,
    Result,
    chosen_parts,
    make,
    read_results,
    write_results,
)


def paper_command(names: Sequence[str] | None, out: Path, *, as_json: bool) -> dict[str, Result]:
    """Compute parts, all if no names are given, and write the pages of these and of what the folder had.

    Raises
    ------
    ValueError
        for an unknown name, or a folder that cannot be used.
    """
    parts = chosen_parts(list(PARTS) if names is None else names)
    folder = writable_folder(out)
    results = read_results(folder)
    if any(part.drives for part in parts):
        compile_before_first_run()
    for number, part in enumerate(parts, start=1):
        with progress_bar(f"{part.name}, {number} of {len(parts)}") as update:
            results[part.name] = make(part, folder, update)
        write_results(results, folder)
    write_pages(results, folder)
    if as_json:
        typer.echo((folder / FILE).read_text(encoding="utf-8"), nl=False)
    else:
        screen.print(claims_table(results))
        screen.print(counted(results))
        screen.print(f"In {folder}: paper.html, paper.md, {FILE} and the figures", soft_wrap=True)
    return results


def claims_table(results: dict[str, Result]) -> Table:
    """Claims, numbers and verdicts."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for heading in ("claim", "paper", "computed", "verdict"):
        table.add_column(heading)
    for _, result in in_order(results):
        for one in result.findings:
            table.add_row(one.statement, one.reported, one.computed.partition(" (")[0], one.verdict)
    return table
