"""How learned and classical entries do where no training was: ``docs/generalisation.md``.

Writes the tables of the page, ``docs/generalisation/row.png``, and ``docs/generalisation/runs.jsonl``, the
errors of all runs, from which tables and figure are made. ``python docs/figures/make_generalisation.py``
drives 20 seeds of each cell; that takes about half an hour of a core and needs the extras ``bench`` and
``figures``. It can be interrupted and goes on where it was: runs are kept in ``results/generalisation`` until
the code of the simulation, a scenario or an entry changes. ``--only ENTRY`` drives one entry and keeps the
others, ``--table NAME`` one kind of conditions; ``--drawn`` drives none.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from generalisation_causes import driven as causes
from generalisation_cells import CELLS, ENTRIES, TABLES
from generalisation_kick import KICK, SLIPPING, kicked
from generalisation_runs import KEPT, Line, drive_missing, keep, kept, put_together
from generalisation_tables import Lines, tables
from make_board import DOCS
from make_parts import put
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from baselines.runs.style import MARKERS, METADATA, hex_colour, tidy
from tlf_env.common.files import atomic

PAGE = DOCS / "generalisation.md"
PICTURE = KEPT.parent / "row.png"
DPI = 110
KINDS = (*TABLES, "kick", "causes")
DASHES = ("-", (0, (6, 2)), (0, (1, 1)), (0, (5, 1, 1, 1)), "-", (0, (3, 1)))
TICKS = (1.0, 2.0, 5.0)  # of each decade


class Panel(NamedTuple):
    """A part of the figure."""

    cell: str
    values: str  # the name of the kept numbers, one for each robot
    title: str
    label: str
    limits: tuple[float, float]
    first: int = 0  # robot


RMS, NOMINAL = "position RMS (mm)", "20 robots, nominal"
PANELS = (
    Panel(NOMINAL, "row_mm", "20 robots, to the own reference", RMS, (0.1, 10)),
    Panel(NOMINAL, "path_mm", "20 robots, to the leader's path", RMS, (0.1, 100)),
    Panel(
        KICK,
        "row_mm",
        "10 robots, robot 1 slips once",
        "largest displacement (mm)",
        (5, 50),
        SLIPPING,
    ),
)


def draw_panel(axes: Axes, lines: Lines, panel: Panel) -> None:
    """A line for each entry over the places of a row; later entries are thinner, on top."""
    for number, entry in enumerate(ENTRIES):
        values = lines[panel.cell, entry][panel.values]
        axes.plot(
            range(panel.first, len(values)),
            values[panel.first :],
            color=hex_colour(number, len(ENTRIES)),
            ls=DASHES[number],
            lw=2.2 - 0.2 * number,
            marker=MARKERS[number],
            ms=4.5,
            markevery=(number % 2, 2),
            label=entry,
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=TICKS))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title(panel.title, loc="left", fontsize="medium")
    axes.set_xlabel("place in the row (the leader has 0)")
    axes.set_ylabel(panel.label)
    axes.set_ylim(panel.limits)


def draw(lines: Lines, path: Path) -> None:
    """Errors along a long row, and what one slip does to the robots behind."""
    figure = Figure(figsize=(11.5, 4.4), layout="constrained", facecolor="white")
    panels = list(figure.subplots(1, len(PANELS)))
    for axes, panel in zip(panels, PANELS, strict=True):
        draw_panel(axes, lines, panel)
    tidy(*panels)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    with atomic(path, "wb") as file:
        figure.savefig(file, format="png", dpi=DPI, metadata=METADATA.get("png"))


def keep_more(found: Iterable[Line]) -> None:
    """Keep further lines."""
    lines = kept()
    for line in found:
        lines[line["cell"], line["entry"]] = line
    keep(lines)


def arguments() -> argparse.Namespace:
    """What the command was given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", choices=ENTRIES)
    parser.add_argument("--table", choices=KINDS)
    parser.add_argument("--drawn", action="store_true", help="only tables and figure, without runs")
    parser.add_argument("--processes", type=int, default=1)
    return parser.parse_args()


def drive(options: argparse.Namespace) -> None:
    """Drive what is missing, and keep it."""
    entries = (options.only,) if options.only else tuple(ENTRIES)
    wanted = (options.table,) if options.table else KINDS
    places = [(cell, entry) for cell in CELLS for entry in entries if cell.table in wanted]
    done = drive_missing(places, options.seeds, options.processes)
    put_together(places, done, options.seeds)
    if "kick" in wanted:
        keep_more(kicked(entry) for entry in entries)
    if "causes" in wanted:
        keep_more(causes(entries, options.seeds))


def main() -> None:
    """Drive, and write tables and figure."""
    options = arguments()
    if not options.drawn:
        try:
            drive(options)
        except KeyboardInterrupt:
            raise SystemExit("interrupted; the same command goes on") from None
    lines = kept()
    for name, text in tables(lines).items():
        put(PAGE, text, name)
    draw(lines, PICTURE)


if __name__ == "__main__":
    main()
