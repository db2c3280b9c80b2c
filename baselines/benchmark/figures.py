"""Figures of a benchmark: scores, failures, performance profiles, and what a sweep shows.

Each is a function from a leaderboard (what :func:`baselines.benchmark.aggregate.leaderboard` returns and
``leaderboard.json`` holds) to a :class:`matplotlib.figure.Figure`; :func:`write_bench_figures` writes
them all. A policy keeps its colour and marker everywhere. Nothing here touches pyplot or other global
state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from baselines.runs.figures import DPI, GREY, MARKERS, PALE, hex_colour
from tlf_env.common.files import atomic

Board = dict[str, Any]
ROW_IN, POLICY_IN = 0.3, 0.16  # height of a disturbance, and of each policy within it
PANEL_IN = 4.4
LEGEND_ROW_IN, LEGEND_KEY_IN, LEGEND_LETTER_IN = 0.22, 0.7, 0.085
SPREAD = 0.7  # of the room of a disturbance that its policies share
ERROR_METRIC, ERROR_LABEL = "position_rmse_mm", "position RMS of the worst robot (mm)"
BAND = 0.12  # opacity of an interval's band
LOSS_LINES = ((5, ":"), (50, "--"))  # percent of runs that fail


def write_bench_figures(board: Board, folder: Path) -> list[Path]:
    """Write every figure of a leaderboard into ``folder``, each atomically; returns their paths.

    ``sweep`` is left out where no knob was swept.
    """
    written = []
    for name, draw in FIGURES.items():
        if name == "sweep" and swept(board) is None:
            continue
        path = folder / f"{name}.png"
        with atomic(path, "wb") as file:
            draw(board).savefig(file, format="png", dpi=DPI)
        written.append(path)
    return written


def scores(board: Board) -> Figure:
    """Interquartile mean of the score with its interval, by task, disturbance and policy."""

    def value(cell: dict[str, Any]) -> tuple[float, list[float] | None]:
        return cell["score"]["iqm"], cell["score"]["interval"]

    return _by_stratum(board, value, "score (interquartile mean over runs)")


def failures(board: Board) -> Figure:
    """Share of runs that lose a robot or let two touch, with its Wilson interval."""

    def value(cell: dict[str, Any]) -> tuple[float, list[float] | None]:
        low, high = cell["success"]["interval"]
        return 100 - 100 * cell["success"]["share"], [100 - 100 * high, 100 - 100 * low]

    return _by_stratum(board, value, "failed runs (%)")


def profiles(board: Board) -> Figure:
    """Share of runs above a score, every task and disturbance weighing the same."""
    figure = _figure(board, 7.0, 4.6, "tasks and disturbances weigh alike")
    axes = figure.subplots()
    for policy in policies(board):
        share = 100 * np.asarray(board["profiles"][policy])
        levels = np.linspace(0, 100, len(share))
        style = _style(board, policy)
        axes.plot(levels, share, **style, markevery=10)
    axes.set(xlim=(-1, 101), ylim=(-2, 102))
    axes.set_xlabel("score")
    axes.set_ylabel("runs above that score (%)")
    _tidy(axes)
    _legend(board, figure)
    return figure


def sweep(board: Board) -> Figure:
    """Successful runs and the median error along a sweep, and where each policy breaks."""
    rows = [
        (task, disturbance)
        for task in _tasks(board)
        for disturbance in _disturbances(board, _cells(board, task))
    ]
    figure = _figure(board, 10.5, 0.9 + 2.9 * len(rows), "95 % intervals")
    grid = figure.subplots(len(rows), 2, sharex=True, squeeze=False)
    for (task, disturbance), (success, error) in zip(rows, grid, strict=True):
        cells = [c for c in _cells(board, task) if c["disturbance"] == disturbance]
        for policy in policies(board):
            mine = sorted(
                (cell for cell in cells if cell["policy"] == policy), key=lambda c: c["sweep"]
            )
            _success_line(board, success, policy, mine)
            _error_line(board, error, policy, mine)
        _breaking_marks(board, success, task, disturbance)
        success.set_title(f"{task}, disturbance {disturbance}", loc="left", fontsize="medium")
        success.set_ylabel("successful runs (%)")
        success.set_ylim(-4, 104)
        error.set_ylabel(ERROR_LABEL)
        error.set_yscale("log")
        _tidy(success, error)
    for axes in grid[-1]:
        axes.set_xlabel(knob_label(swept(board) or ""))
    marks = [
        Line2D([], [], color=GREY, ls=ls, label=f"{percent} % fail") for percent, ls in LOSS_LINES
    ]
    _legend(board, figure, marks)
    return figure


FIGURES: dict[str, Callable[[Board], Figure]] = {
    "scores": scores,
    "failures": failures,
    "profiles": profiles,
    "sweep": sweep,
}


def policies(board: Board) -> list[str]:
    """Policies in the order in which they were asked for."""
    known = board["profiles"]
    return [policy for policy in board["plan"]["plan"]["policies"] if policy in known]


def swept(board: Board) -> str | None:
    """Path of the knob that was swept."""
    knob: str | None = board["plan"]["plan"]["sweep"]
    return knob


def knob_label(path: str) -> str:
    """A knob with its unit, which its name ends with: ``slip.delta_1_mm_s`` → ``slip.delta_1 (mm/s)``."""
    for suffix, unit in UNITS.items():
        if path.endswith(suffix):
            return f"{path.removesuffix(suffix)} ({unit})"
    return path


UNITS = {
    "_kg_mm2": "kg·mm²",
    "_rad_s": "rad/s",
    "_mm_s": "mm/s",
    "_rad": "rad",
    "_kg": "kg",
    "_mm": "mm",
    "_s": "s",
}


def _by_stratum(
    board: Board,
    value: Callable[[dict[str, Any]], tuple[float, list[float] | None]],
    label: str,
) -> Figure:
    """A panel for each task, a row for each disturbance (and swept value), a point for each policy."""
    tasks = _tasks(board)
    rows = {task: list(dict.fromkeys(map(_row, _cells(board, task)))) for task in tasks}
    names = policies(board)
    row_in = ROW_IN + POLICY_IN * len(names)
    most = max(map(len, rows.values()), default=1)
    figure = _figure(
        board,
        1.8 + PANEL_IN * max(len(tasks), 1),
        1.1 + row_in * most,
        "95 % intervals",
    )
    grid = figure.subplots(1, max(len(tasks), 1), sharex=True, sharey=False, squeeze=False)[0]
    for axes, task in zip(grid, tasks, strict=False):
        for k in range(0, len(rows[task]), 2):
            axes.axhspan(k - 0.5, k + 0.5, color=PALE, alpha=0.45, lw=0, zorder=0)
        for cell in _cells(board, task):
            part = (names.index(cell["policy"]) + 0.5) / len(names) - 0.5
            middle, ends = value(cell)
            _point(board, axes, cell, middle, ends, rows[task].index(_row(cell)) + SPREAD * part)
        axes.set_yticks(range(len(rows[task])), rows[task])
        axes.set_ylim(len(rows[task]) - 0.5, -0.5)
        axes.set_xlim(-3, 103)
        axes.set_title(task, loc="left", fontsize="medium")
        axes.set_xlabel(label)
        _tidy(axes)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
    _legend(board, figure)
    return figure


def _row(cell: dict[str, Any]) -> str:
    """What a row is called."""
    return cell["disturbance"] + ("" if cell["sweep"] is None else f", {cell['sweep']:.4g}")


def _point(
    board: Board,
    axes: Axes,
    cell: dict[str, Any],
    middle: float,
    ends: Sequence[float] | None,
    y: float,
) -> None:
    style = _style(board, cell["policy"])
    if ends is not None:
        axes.plot(ends, [y, y], color=style["color"], lw=1.8, solid_capstyle="butt", zorder=2)
    axes.plot([middle], [y], **{**style, "ls": "none", "ms": 5.5}, zorder=3, clip_on=False)


def _success_line(board: Board, axes: Axes, policy: str, cells: Sequence[dict[str, Any]]) -> None:
    values = [cell["sweep"] for cell in cells]
    ends = 100 * np.array([cell["success"]["interval"] for cell in cells])
    style = _style(board, policy)
    axes.fill_between(values, *ends.T, color=style["color"], alpha=BAND, lw=0)
    axes.plot(values, [100 * cell["success"]["share"] for cell in cells], **style)


def _error_line(board: Board, axes: Axes, policy: str, cells: Sequence[dict[str, Any]]) -> None:
    """The median error; its band only where there is an interval."""
    rows = [
        (cell["sweep"], cell[ERROR_METRIC]["median"], cell[ERROR_METRIC]["interval"])
        for cell in cells
        if cell[ERROR_METRIC]["median"] is not None
    ]
    style = _style(board, policy)
    banded = [(value, *ends) for value, _, ends in rows if ends is not None]
    if banded:
        value, low, high = np.array(banded).T
        axes.fill_between(value, low, high, color=style["color"], alpha=BAND, lw=0)
    axes.plot([row[0] for row in rows], [row[1] for row in rows], **style)


def _breaking_marks(board: Board, axes: Axes, task: str, disturbance: str) -> None:
    """A vertical line from the axis to the policy's line where 5 % and 50 % of its runs fail."""
    for point in board["breaking_points"]:
        if (point["task"], point["disturbance"]) != (task, disturbance):
            continue
        if point["policy"] not in board["profiles"]:
            continue
        for percent, line in LOSS_LINES:
            at = point[f"loses_{percent}_percent_at"]
            if at is not None and math.isfinite(at):
                style = _style(board, point["policy"])
                ends = [-4, 100 - percent]
                axes.plot(
                    [at, at], ends, color=style["color"], lw=0.8 * style["lw"], ls=line, zorder=1.5
                )


def _cells(board: Board, task: str) -> list[dict[str, Any]]:
    return [cell for cell in board["cells"] if cell["task"] == task]


def _tasks(board: Board) -> list[str]:
    return list(dict.fromkeys(cell["task"] for cell in board["cells"]))


def _disturbances(board: Board, cells: Iterable[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(cell["disturbance"] for cell in cells))


def _style(board: Board, policy: str) -> dict[str, Any]:
    """A policy's colour, marker and width; a privileged one's marker is hollow.

    Later policies lie on top and are thinner, so that lines that coincide all show.
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


def _figure(board: Board, width_in: float, height_in: float, note: str) -> Figure:
    """A figure with room for its legend below ``height_in``."""
    rows = -(-(len(policies(board)) + len(LOSS_LINES)) // _legend_columns(board, width_in))
    size = (width_in, height_in + rows * LEGEND_ROW_IN)
    figure = Figure(figsize=size, layout="constrained")
    first, end = board["plan"]["plan"]["seeds"]
    figure.suptitle(
        f"seeds {first} to {end - 1}, the same draws for all; {note}", fontsize="medium"
    )
    return figure


def _legend_columns(board: Board, width_in: float) -> int:
    longest = max(map(len, map(_name, board["policies"])), default=1)
    return max(1, int(width_in / (LEGEND_KEY_IN + LEGEND_LETTER_IN * longest)))


def _name(row: dict[str, Any]) -> str:
    return row["policy"] + (" (privileged)" if row["privileged"] else "")


def _legend(board: Board, figure: Figure, more: Sequence[Line2D] = ()) -> None:
    names = {row["policy"]: _name(row) for row in board["policies"]}
    handles = [
        Line2D([], [], **{**_style(board, policy), "lw": 1.6, "ms": 6.0}, label=names[policy])
        for policy in policies(board)
    ]
    figure.legend(
        handles=[*handles, *more],
        loc="outside lower center",
        ncols=_legend_columns(board, figure.get_figwidth()),
        frameon=False,
        fontsize="small",
    )


def _tidy(*many: Axes) -> None:
    for axes in many:
        axes.grid(color="0.92", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.yaxis.set_minor_locator(NullLocator())
