"""Several runs of one task in one figure: their paths side by side, each with its verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.runs.panels import MOST_POINTS, robot_colour
from baselines.runs.plane import draw_body
from baselines.runs.run import Record
from baselines.runs.style import DPI, GREY
from tlf_env.common.files import atomic

PLANE_IN = 3.4  # width and height of each plane
ROOM_MM = 450.0  # around the leader's reference
GOOD, BAD = "#0072B2", "#D55E00"


def draw_comparison(
    rows: Sequence[Sequence[Record]],
    row_names: Sequence[str],
    column_names: Sequence[str],
    title: str,
    path: Path,
) -> None:
    """Write a figure with the paths of runs of one task, a plane for each run.

    Parameters
    ----------
    rows
        The runs by row and column.
    """
    figure = Figure(
        figsize=(PLANE_IN * len(column_names) + 0.6, PLANE_IN * len(rows) + 1.0),
        layout="constrained",
    )
    grid = figure.subplots(len(rows), len(column_names), squeeze=False)
    for records, line, row_name in zip(rows, grid, row_names, strict=True):
        for record, axes, column_name in zip(records, line, column_names, strict=True):
            _draw_run(record, axes)
            if axes in grid[0]:
                axes.set_title(column_name, fontsize="large", weight="bold")
        line[0].set_ylabel(row_name, fontsize="large", weight="bold")
    first = rows[0][0]
    handles = grid[0, 0].get_legend_handles_labels()[0][: first.robots + 1]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle(title, fontsize="x-large")
    with atomic(path, "wb") as file:
        figure.savefig(file, format="png", dpi=DPI)


def _draw_run(record: Record, axes: Axes) -> None:
    """Reference, paths, robots at the end, and the verdict in large letters."""
    every = max(1, len(record.t_s) // MOST_POINTS)
    low, high = record.leader.min(axis=0) - ROOM_MM, record.leader.max(axis=0) + ROOM_MM
    low[1] -= ROOM_MM  # for the verdict
    axes.plot(*record.leader[::every].T, color="0.8", lw=6.0, zorder=1, label="leader's reference")
    for i in range(record.robots):
        colour = robot_colour(record, i)
        path = np.stack([record["x_mm"][::every, i], record["y_mm"][::every, i]])
        width = 0.9 + 1.6 * (record.robots - 1 - i) / max(record.robots - 1, 1)
        axes.plot(*path, color=colour, lw=width, zorder=2 + 0.01 * i, label=f"robot {i}")
        draw_body(record, axes, len(record.t_s) - 1, i, strength=1.0)
    text, colour = verdict_of(record)
    axes.annotate(
        text,
        (0.5, 0.02),
        xycoords="axes fraction",
        ha="center",
        va="bottom",
        fontsize="x-large",
        weight="bold",
        color=colour,
        bbox={"boxstyle": "round,pad=0.25", "fc": "white", "ec": colour, "lw": 1.5},
        zorder=10,
    )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(GREY)


def verdict_of(record: Record) -> tuple[str, str]:
    """How a run ended, in a few words, and the colour for it."""
    robots = record.metrics()
    lost = sum(robot.lost or robot.touched for robot in robots)
    if lost:
        return f"{'all' if lost == len(robots) else lost} lost", BAD
    errors = [robot.position_rmse_mm for robot in robots if robot.position_rmse_mm is not None]
    return (f"error {max(errors):.1f} mm" if errors else "held"), GOOD
