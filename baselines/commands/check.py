"""``tlf bench --check TASK:DISTURBANCE``: a cell of the published board, run again and compared."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.benchmark.check import (
    Checked,
    check,
    checked_plan,
    digits,
    published_board,
)
from baselines.commands.compile import compile_before_first_run
from baselines.console import notes, progress_bar, screen

SHOWN = 5  # differences of an entry that are printed


def check_command(
    cell: str, policies: tuple[str, ...] | None, out: Path | None, processes: int
) -> bool:
    """Run and compare a cell, and print the verdicts; whether all agree in every digit.

    Raises
    ------
    ValueError
        as :func:`~baselines.benchmark.check.checked_plan`.
    """
    board = published_board()
    plan = checked_plan(board, cell, policies)
    folder = out or Path("results/check") / cell.replace(":", "-")
    compile_before_first_run()
    with progress_bar(f"check {cell}") as update:
        found = check(board, plan, folder, processes=processes, progress=update)
    first, end = plan.seeds
    screen.print(checked_table(found, f"{cell}, seeds {first} to {end - 1}"))
    for one in found:
        for difference in one.differences[:SHOWN]:
            notes.print(
                f"tlf: {one.policy}: {difference.name} is {digits(difference.here)} here, published "
                f"{digits(difference.published)}",
                soft_wrap=True,
            )
    agree = not any(one.differences for one in found)
    screen.print(
        "All values agree with the published board, in every digit."
        if agree
        else "Some values differ from the published board. Other processors may round differently; a changed "
        "law changes far more digits."
    )
    return agree


def checked_table(found: list[Checked], title: str) -> Table:
    """A row for each entry."""
    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("entry")
    table.add_column("values", justify="right")
    table.add_column("verdict")
    for one in found:
        verdict = f"{len(one.differences)} differ" if one.differences else "agrees"
        table.add_row(one.policy, str(one.values), verdict)
    return table
