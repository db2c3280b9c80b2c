"""What the figures of a benchmark share: order, style and legend of the policies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from baselines.runs.style import MARKERS, hex_colour, tidy

Board = dict[str, Any]
LEGEND_ROW_IN, LEGEND_KEY_IN, LEGEND_LETTER_IN = 0.22, 0.7, 0.085
LOSS_LINES = ((5, ":"), (50, "--"))  # percent of runs that fail


def policies(board: Board) -> list[str]:
    """Policies in the plan's order."""
    known = board["profiles"]
    return [policy for policy in board["plan"]["plan"]["policies"] if policy in known]


def swept(board: Board) -> str | None:
    """Path of the swept knob; None without a sweep."""
    knob: str | None = board["plan"]["plan"]["sweep"]
    return knob


def cells_of(board: Board, task: str) -> list[dict[str, Any]]:
    """The leaderboard's cells of a task."""
    return [cell for cell in board["cells"] if cell["task"] == task]


def tasks_of(board: Board) -> list[str]:
    """Tasks in the plan's order."""
    return list(dict.fromkeys(cell["task"] for cell in board["cells"]))


def disturbances_of(cells: Iterable[dict[str, Any]]) -> list[str]:
    """Disturbances of some cells, in the plan's order."""
    return list(dict.fromkeys(cell["disturbance"] for cell in cells))


def policy_style(board: Board, policy: str) -> dict[str, Any]:
    """A policy's colour, marker and width; a privileged one's marker is hollow.

    Lines of later policies are on top and thinner, so that coinciding lines are all visible.
    """
    names = policies(board)
    i = names.index(policy)
    colour = hex_colour(i, len(names))
    hollow = policy in _privileged(board)
    under = (len(names) - 1 - i) / max(len(names) - 1, 1)
    return {
        "lw": 1.2 + 1.8 * under,
        "ms": 5.0 + 2.0 * under,
        "color": colour,
        "marker": MARKERS[i % len(MARKERS)],
        "mfc": "white" if hollow else colour,
        "mec": colour,
    }


def _privileged(board: Board) -> set[str]:
    return {row["policy"] for row in board["policies"] if row["privileged"]}


def new_figure(board: Board, width_in: float, height_in: float, note: str) -> Figure:
    """An empty figure with room for its legend below ``height_in``."""
    rows = -(-(len(policies(board)) + len(LOSS_LINES)) // _legend_columns(board, width_in))
    size = (width_in, height_in + rows * LEGEND_ROW_IN)
    figure = Figure(figsize=size, layout="constrained")
    first, end = board["plan"]["plan"]["seeds"]
    figure.suptitle(f"seeds {first} to {end - 1}, same draws for all; {note}", fontsize="medium")
    return figure


def _legend_columns(board: Board, width_in: float) -> int:
    longest = max(map(len, map(_name, board["policies"])), default=1)
    return max(1, int(width_in / (LEGEND_KEY_IN + LEGEND_LETTER_IN * longest)))


def _name(row: dict[str, Any]) -> str:
    return row["policy"] + (" (privileged)" if row["privileged"] else "")


def legend_below(board: Board, figure: Figure, more: Sequence[Line2D] = ()) -> None:
    """A legend of the policies below the figure."""
    names = {row["policy"]: _name(row) for row in board["policies"]}
    handles = [
        Line2D([], [], **{**policy_style(board, policy), "lw": 1.6, "ms": 6.0}, label=names[policy])
        for policy in policies(board)
    ]
    figure.legend(
        handles=[*handles, *more],
        loc="outside lower center",
        ncols=_legend_columns(board, figure.get_figwidth()),
        frameon=False,
        fontsize="small",
    )


def tidy_panels(*panels: Axes) -> None:
    """Tidy panels whose vertical axis has no minor ticks."""
    tidy(*panels)
    for axes in panels:
        axes.yaxis.set_minor_locator(NullLocator())
