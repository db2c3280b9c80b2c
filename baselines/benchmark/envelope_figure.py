"""Figure of envelopes: the largest level that each system holds, knob by knob."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from baselines.runs.style import DPI, GREY, MARKERS, hex_colour, tidy
from tlf_env.common.files import atomic

WIDTH_IN, ROW_IN, MARGIN_IN = 8.6, 0.42, 1.3
SPREAD = 0.62  # share of a knob's row that its systems use
FIGURE = "envelope.png"


def write_envelope_figure(board: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write ``envelope.png`` into a folder, atomically; returns its path."""
    path = folder / FIGURE
    with atomic(path, "wb") as file:
        draw_envelopes(board).savefig(file, format="png", dpi=DPI)
    return [path]


def draw_envelopes(board: Mapping[str, Any]) -> Figure:
    """A row for each knob, with the level that each system holds and its interval; a panel for each task.

    An arrow to the left: not even the first level holds; to the right: the last level holds.
    """
    tasks = list(dict.fromkeys(cell["task"] for cell in board["cells"]))
    knobs = list(dict.fromkeys(cell["knob"] for cell in board["cells"]))
    names = board["plan"]["plan"]["policies"]
    height_in = MARGIN_IN + 0.2 * len(names) + len(tasks) * ROW_IN * len(knobs)
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    first, end = board["plan"]["plan"]["seeds"]
    few = " (too few seeds for a low end)" if board["counts"]["low"] is None else ""
    figure.suptitle(
        f"largest level that {end - first - board['counts']['held']} of {end - first} runs hold, with 95 % "
        f"intervals{few}",
        fontsize="medium",
    )
    panels = figure.subplots(len(tasks), 1, sharex=True, squeeze=False)[:, 0]
    for task, axes in zip(tasks, panels, strict=True):
        for cell in board["cells"]:
            if cell["task"] == task:
                number = names.index(cell["policy"])
                shift = SPREAD * ((number + 0.5) / len(names) - 0.5)
                _mark(axes, cell, knobs.index(cell["knob"]) + shift, number, len(names))
        axes.axvline(1.0, color=GREY, lw=0.9, zorder=1)
        axes.set_xscale("log")
        axes.set_yticks(range(len(knobs)), knobs)
        axes.set_ylim(len(knobs) - 0.5, -0.5)
        axes.set_title(task, loc="left", fontsize="medium")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        tidy(axes)
        axes.grid(axis="y", visible=False)
        for row in range(1, len(knobs)):
            axes.axhline(row - 0.5, color="0.92", lw=0.6, zorder=0)
    panels[-1].set_xlabel("level (1: the disturbance of the knob's file)")
    handles = [
        Line2D(
            [],
            [],
            ls="",
            marker=MARKERS[i % len(MARKERS)],
            color=hex_colour(i, len(names)),
            label=name,
        )
        for i, name in enumerate(names)
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize="small"
    )
    return figure


def _mark(axes: Any, cell: Mapping[str, Any], place: float, number: int, count: int) -> None:
    """The mark of one envelope, and its interval as a line."""
    colour = hex_colour(number, count)
    level = cell["counted"]
    low = level if cell["low"] is None else cell["low"]
    high = level if cell["high"] is None else cell["high"]
    axes.plot([min(low, level), max(high, level)], [place, place], color=colour, lw=1.6, zorder=2)
    marker = MARKERS[number % len(MARKERS)]
    open_end = cell["level"] is None or cell["beyond"]
    face = "white" if open_end else colour
    axes.plot([level], [place], marker=marker, ms=5, color=colour, mfc=face, ls="", zorder=3)
    if open_end:
        away = -9 if cell["level"] is None else 9
        axes.annotate(
            "", (level, place), (away, 0), textcoords="offset points",
            arrowprops={"arrowstyle": "<-", "color": colour, "lw": 1.1, "shrinkA": 0, "shrinkB": 2},
        )  # fmt: skip
