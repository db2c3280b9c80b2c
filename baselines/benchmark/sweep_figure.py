"""Figure of a sweep: successful runs and error against the swept knob."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from baselines.benchmark.drawing import (
    LOSS_LINES,
    Board,
    cells_of,
    disturbances_of,
    legend_below,
    new_figure,
    policies,
    policy_style,
    swept,
    tasks_of,
    tidy_panels,
)
from baselines.benchmark.knobs import is_geometric, knob_label
from baselines.runs.style import GREY

ERROR_METRIC, ERROR_LABEL = "position_rmse_mm", "position RMS of the worst robot (mm)"
BAND = 0.12  # opacity of an interval's band


def draw_sweep(board: Board) -> Figure:
    """Successful runs and the median error along a sweep, with each policy's breaking points."""
    rows = [
        (task, disturbance)
        for task in tasks_of(board)
        for disturbance in disturbances_of(cells_of(board, task))
    ]
    figure = new_figure(board, 10.5, 0.9 + 2.9 * len(rows), "95 % intervals")
    grid = figure.subplots(len(rows), 2, sharex=True, squeeze=False)
    for (task, disturbance), (success, error) in zip(rows, grid, strict=True):
        cells = [c for c in cells_of(board, task) if c["disturbance"] == disturbance]
        for policy in policies(board):
            mine = sorted(
                (cell for cell in cells if cell["policy"] == policy), key=lambda cell: cell["sweep"]
            )
            _success_line(board, success, policy, mine)
            _error_line(board, error, policy, mine)
        _breaking_marks(board, success, task, disturbance)
        success.set_title(f"{task}, disturbance {disturbance}", loc="left", fontsize="medium")
        success.set_ylabel("successful runs (%)")
        success.set_ylim(-4, 104)
        error.set_ylabel(ERROR_LABEL)
        error.set_yscale("log")
        tidy_panels(success, error)
    for axes in grid[-1]:
        axes.set_xlabel(knob_label(swept(board) or ""))
        if is_geometric([cell["sweep"] for cell in board["cells"]]):
            axes.set_xscale("log")
    marks = [
        Line2D([], [], color=GREY, ls=ls, label=f"{percent} % fail") for percent, ls in LOSS_LINES
    ]
    legend_below(board, figure, marks)
    return figure


def _success_line(board: Board, axes: Axes, policy: str, cells: Sequence[dict[str, Any]]) -> None:
    values = [cell["sweep"] for cell in cells]
    ends = 100 * np.array([cell["success"]["interval"] for cell in cells])
    style = policy_style(board, policy)
    axes.fill_between(values, *ends.T, color=style["color"], alpha=BAND, lw=0)
    axes.plot(values, [100 * cell["success"]["share"] for cell in cells], **style)


def _error_line(board: Board, axes: Axes, policy: str, cells: Sequence[dict[str, Any]]) -> None:
    """The median error, with a band where it has an interval."""
    rows = [
        (cell["sweep"], cell[ERROR_METRIC]["median"], cell[ERROR_METRIC]["interval"])
        for cell in cells
        if cell[ERROR_METRIC]["median"] is not None
    ]
    style = policy_style(board, policy)
    banded = [(value, *ends) for value, _, ends in rows if ends is not None]
    if banded:
        value, low, high = np.array(banded).T
        axes.fill_between(value, low, high, color=style["color"], alpha=BAND, lw=0)
    axes.plot([row[0] for row in rows], [row[1] for row in rows], **style)


def _breaking_marks(board: Board, axes: Axes, task: str, disturbance: str) -> None:
    """Vertical lines from the axis to the policy's line at 5 % and 50 % failed runs."""
    for point in board["breaking_points"]:
        if (point["task"], point["disturbance"]) != (task, disturbance):
            continue
        if point["policy"] not in board["profiles"]:
            continue
        for percent, line in LOSS_LINES:
            at = point[f"loses_{percent}_percent_at"]
            if at is not None and math.isfinite(at):
                style = policy_style(board, point["policy"])
                ends = [-4, 100 - percent]
                axes.plot(
                    [at, at], ends, color=style["color"], lw=0.8 * style["lw"], ls=line, zorder=1.5
                )
