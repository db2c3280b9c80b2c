"""Figures of a benchmark: scores, failures, performance profiles, and the sweep.

Each is a function from a leaderboard (what :func:`baselines.benchmark.aggregate.leaderboard` returns and
``leaderboard.json`` holds) to a :class:`matplotlib.figure.Figure`; :func:`write_bench_figures` writes
them all. A policy has the same colour and marker everywhere. Neither pyplot nor other global state is
used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.benchmark.drawing import (
    Board,
    cells_of,
    legend_below,
    new_figure,
    policies,
    policy_style,
    swept,
    tasks_of,
    tidy_panels,
)
from baselines.benchmark.sweep_figure import draw_sweep
from baselines.runs.style import DPI, PALE
from tlf_env.common.files import atomic

ROW_IN, POLICY_IN = 0.25, 0.09  # height of a disturbance, and of each policy within it
PANEL_IN = 4.4
SPREAD = 0.7  # share of a disturbance's row that its policies use


def write_bench_figures(board: Board, folder: Path) -> list[Path]:
    """Write every figure of a leaderboard into ``folder``, each atomically; returns their paths.

    ``sweep`` is left out if no knob was swept.
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
    """Share of failed runs (a robot lost, or two touched) with its Wilson interval."""

    def value(cell: dict[str, Any]) -> tuple[float, list[float] | None]:
        low, high = cell["success"]["interval"]
        return 100 - 100 * cell["success"]["share"], [100 - 100 * high, 100 - 100 * low]

    return _by_stratum(board, value, "failed runs (%)")


def profiles(board: Board) -> Figure:
    """Share of runs above a score; every task and disturbance has the same weight."""
    figure = new_figure(board, 7.0, 4.6, "equal weight per task and disturbance")
    axes = figure.subplots()
    for policy in policies(board):
        share = 100 * np.asarray(board["profiles"][policy])
        levels = np.linspace(0, 100, len(share))
        style = policy_style(board, policy)
        axes.plot(levels, share, **style, markevery=10)
    axes.set(xlim=(-1, 101), ylim=(-2, 102))
    axes.set_xlabel("score")
    axes.set_ylabel("runs above that score (%)")
    tidy_panels(axes)
    legend_below(board, figure)
    return figure


def _by_stratum(
    board: Board,
    value: Callable[[dict[str, Any]], tuple[float, list[float] | None]],
    label: str,
) -> Figure:
    """A panel for each task, a row for each disturbance (and swept value), a point for each policy."""
    tasks = tasks_of(board)
    rows = {task: list(dict.fromkeys(map(_row, cells_of(board, task)))) for task in tasks}
    names = policies(board)
    columns = _columns({task: len(rows[task]) for task in tasks})
    most = max((sum(len(rows[task]) for task in column) for column in columns), default=1)
    figure = new_figure(
        board,
        1.8 + PANEL_IN * max(len(columns), 1),
        1.1 + (ROW_IN + POLICY_IN * len(names)) * most,
        "95 % intervals",
    )
    grid = []
    outer = figure.add_gridspec(1, max(len(columns), 1))
    for place, column in enumerate(columns):
        heights = [len(rows[task]) for task in column]
        spare = [most - sum(heights)] if sum(heights) < most else []
        inner = outer[place].subgridspec(len(heights + spare), 1, height_ratios=heights + spare)
        grid += [figure.add_subplot(inner[i]) for i in range(len(column))]
    for axes, task in zip(grid, chain.from_iterable(columns), strict=True):
        for k in range(0, len(rows[task]), 2):
            axes.axhspan(k - 0.5, k + 0.5, color=PALE, alpha=0.45, lw=0, zorder=0)
        for cell in cells_of(board, task):
            part = (names.index(cell["policy"]) + 0.5) / len(names) - 0.5
            middle, ends = value(cell)
            _point(board, axes, cell, middle, ends, rows[task].index(_row(cell)) + SPREAD * part)
        axes.set_yticks(range(len(rows[task])), rows[task])
        axes.set_ylim(len(rows[task]) - 0.5, -0.5)
        axes.set_xlim(-3, 103)
        axes.set_title(task, loc="left", fontsize="medium")
        axes.set_xlabel(label)
        tidy_panels(axes)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
    legend_below(board, figure)
    return figure


def _columns(rows: dict[str, int]) -> list[list[str]]:
    """Tasks in columns, one below the other where they fit beside the one with the most rows."""
    columns: list[list[str]] = []
    for task, count in rows.items():
        if not columns or sum(rows[one] for one in columns[-1]) + count > max(rows.values()):
            columns.append([])
        columns[-1].append(task)
    return columns


def _row(cell: dict[str, Any]) -> str:
    """Label of a cell's row."""
    return cell["disturbance"] + ("" if cell["sweep"] is None else f", {cell['sweep']:.4g}")


def _point(
    board: Board,
    axes: Axes,
    cell: dict[str, Any],
    middle: float,
    ends: Sequence[float] | None,
    height: float,
) -> None:
    style = policy_style(board, cell["policy"])
    if ends is not None:
        axes.plot(
            ends, [height, height], color=style["color"], lw=1.8, solid_capstyle="butt", zorder=2
        )
    axes.plot([middle], [height], **{**style, "ls": "none", "ms": 5.5}, zorder=3, clip_on=False)


FIGURES: dict[str, Callable[[Board], Figure]] = {
    "scores": scores,
    "failures": failures,
    "profiles": profiles,
    "sweep": draw_sweep,
}
