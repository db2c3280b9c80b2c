"""Figures of one recorded run: the paper's Fig. 11, and wheels, slip and time gaps.

Each is a function from a :class:`~baselines.runs.run.Record` to a :class:`matplotlib.figure.Figure`;
:func:`write_figures` writes them all. A robot has the same colour and marker everywhere. Neither pyplot
nor other global state is used.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator
from scipy.ndimage import uniform_filter1d

from baselines.runs.panels import (
    has_time_gap,
    heading_error,
    legend_below,
    mark_level,
    name_axis,
    new_figure,
    position_error,
    robot_colour,
    robot_line,
    robot_rows,
    settle_label,
    settle_line,
    signed_scale,
    thinned,
    time_axis,
    time_gap_error,
)
from baselines.runs.plane import PLANE_IN, draw_plane, plane_width_in, snapshot_rows
from baselines.runs.run import Record
from baselines.runs.style import DPI, METADATA, PALE, tidy
from baselines.runs.world import world_handles
from tlf_env.common.files import atomic

SATURATION_WINDOW_S = 1.0
COMMAND_COLOUR, ACTUAL_COLOUR = "#E69F00", "#0072B2"


def write_figures(
    record: Record, folder: Path, *, formats: tuple[str, ...] = ("png",)
) -> list[Path]:
    """Write every figure of a run into ``folder``, each atomically; returns their paths.

    ``time_gap`` is left out if it is not defined: with one robot, or if the run is shorter than the gap.
    """
    written = []
    for name, draw in FIGURES.items():
        if name == "time_gap" and not has_time_gap(record):
            continue
        figure = draw(record)
        for kind in formats:
            path = folder / f"{name}.{kind}"
            with atomic(path, "wb") as file:
                figure.savefig(file, format=kind, dpi=DPI, metadata=METADATA.get(kind))
            written.append(path)
    return written


def overview(record: Record) -> Figure:
    """The robots in the plane, their position errors, and their time-gap (or heading) errors."""
    width_in = plane_width_in(record)
    figure = new_figure(record, width_in + 5.8, PLANE_IN + 0.9)
    panels = figure.subplot_mosaic(
        [["plane", "position"], ["plane", "other"]], width_ratios=[width_in, 5.0]
    )
    plane, position, other = panels["plane"], panels["position"], panels["other"]
    draw_plane(record, plane, snapshot_rows(record))
    position_error(record, position)
    (time_gap_error if has_time_gap(record) else heading_error)(record, other)
    other.sharex(position)
    position.tick_params(labelbottom=False)
    settle_label(record, position, ", RMS from here")
    time_axis(record, other)
    handles = [*position.get_legend_handles_labels()[0], *world_handles(record)]
    legend_below(figure, handles, columns=5)
    return figure


def paths(record: Record) -> Figure:
    """Fig. 11 (a, d): the paths in the plane, from the start (open markers) to the robots' end."""
    figure = new_figure(record, 1.2 * plane_width_in(record) + 0.8, 1.2 * PLANE_IN + 0.8)
    axes = figure.subplots()
    draw_plane(record, axes, [len(record.t_s) - 1])
    legend_below(figure, [*axes.get_legend_handles_labels()[0], *world_handles(record)])
    return figure


def errors(record: Record) -> Figure:
    """Position and heading errors, each robot to its own reference."""
    figure = new_figure(record, 9.5, 6.2)
    position, heading = figure.subplots(2, 1, sharex=True)
    position_error(record, position)
    heading_error(record, heading)
    settle_label(record, position, ", RMS from here")
    time_axis(record, heading)
    legend_below(figure, position.get_legend_handles_labels()[0], columns=4)
    return figure


def functionals(record: Record) -> Figure:
    """Fig. 11 (b, c, e, f): J and J_θ of eq. (54); below, what they gained since ``settle_s``."""
    figure = new_figure(record, 10.0, 6.2)
    grid = figure.subplots(2, 2, sharex="row")
    settle = int(np.searchsorted(record.t_s, record.scenario.settle_s))
    late_s = record.t_s[settle:]
    for (whole, late), column, symbol, unit in zip(
        grid.T, ("J_mm_s", "J_theta_rad_s"), ("$J$", r"$J_\theta$"), ("mm·s", "rad·s"), strict=True
    ):
        values = record[column]
        for i in range(record.robots):
            robot_line(record, whole, i, record.t_s, values[:, i])
            robot_line(record, late, i, late_s, values[settle:, i] - values[settle, i])
        signed_scale(whole, np.abs(values).max(axis=0))
        name_axis(whole, f"{symbol} ({unit})")
        late.set_ylabel(f"{symbol} gained since {late_s[0]:g} s ({unit})")
        tidy(whole, late)
        settle_line(record, whole)
        settle_label(record, whole)
        time_axis(record, whole)
        time_axis(record, late, late_s[0])
    legend_below(figure, grid[0, 0].get_legend_handles_labels()[0])
    return figure


def wheels(record: Record) -> Figure:
    """Wheel speeds, commanded and actual, torques within their limits, and how often they are at them."""
    figure, rows = robot_rows(record, 0, 15.5, columns=5)
    window = max(1, round(SATURATION_WINDOW_S / record.scenario.control_period_s))
    columns = [f"omega_{side}{kind}_rad_s" for kind in ("_command", "") for side in "lr"]
    speeds = np.stack([record[column] for column in columns])
    margin = 0.05 * max(float(np.ptp(speeds)), 1e-3)
    limits = [robot.torque_limit_Nmm for robot in record.scenario.robot_models]
    for i, row in rows.items():
        limit = limits[i]
        for axes, side, command, actual in zip(row[:2], "lr", speeds[:2], speeds[2:], strict=True):
            axes.plot(*thinned(record.t_s, command[:, i]), color=COMMAND_COLOUR, lw=0.9)
            axes.plot(*thinned(record.t_s, actual[:, i]), color=ACTUAL_COLOUR, lw=0.9)
            axes.set_ylim(speeds.min() - margin, speeds.max() + margin)
            axes.set_ylabel(f"robot {i}\nspeed (rad/s)" if side == "l" else "speed (rad/s)")
        for axes, side in zip(row[2:4], "lr", strict=True):
            torque = thinned(record.t_s, record[f"torque_{side}_Nmm"][:, i])
            axes.axhspan(-limit, limit, color=PALE, lw=0, zorder=0)
            axes.plot(*torque, color=ACTUAL_COLOUR, lw=0.5)
            axes.set_yticks([-limit, 0, limit])
            axes.set_ylim(-1.2 * limit, 1.2 * limit)
            axes.set_ylabel("torque (N·mm)")
        share = uniform_filter1d(100.0 * record["saturation_fraction"][:, i], window)
        row[4].plot(*thinned(record.t_s, share), color=ACTUAL_COLOUR, lw=0.9)
        row[4].set_ylim(-5, 105)
        row[4].set_ylabel("saturated (%)")
    names = ("left speed", "right speed", "left torque", "right torque", "saturated, mean over 1 s")
    for k, name in enumerate(names):
        rows[0][k].set_title(name, fontsize="medium")
    where = f"±{limits[0]:g} N·mm" if len(set(limits)) == 1 else "the band's edges"
    handles = [
        Line2D([], [], color=COMMAND_COLOUR, label="command"),
        Line2D([], [], color=ACTUAL_COLOUR, label="actual"),
        Patch(color=PALE, label=f"motors saturate at {where}"),
    ]
    legend_below(figure, handles)
    return figure


def slip(record: Record) -> Figure:
    """Slip speed of the drive wheel that slips more, the largest value within each control step."""
    figure, rows = robot_rows(record, 0, 8.0)
    stictions = [robot.tyre.stiction_speed_mm_s for robot in record.scenario.robot_models]
    most = max(2 * float(record["slip_mm_s"].max()), 5 * max(stictions))
    for i, (axes,) in rows.items():
        axes.plot(
            *thinned(record.t_s, record["slip_mm_s"][:, i]), color=robot_colour(record, i), lw=0.8
        )
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_yticks([0, 1, 10, 100, 1000], ["0", "1", "10", "100", "1000"])
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylim(-0.1, most)  # so that a line at zero is visible
        name_axis(axes, f"robot {i}\nslip (mm/s)")
        mark_level(axes, stictions[i], "$v_s$")
    return figure


def time_gap(record: Record) -> Figure:
    """Time-gap error, a row for each follower; positive is late."""
    figure, rows = robot_rows(record, 1, 8.0, sharey=True)
    for i, (axes,) in rows.items():
        time_gap_error(record, axes, [i])
        name_axis(axes, f"robot {i}\nerror (s)")
    settle_label(record, rows[1][0])
    return figure


FIGURES: dict[str, Callable[[Record], Figure]] = {
    "overview": overview,
    "paths": paths,
    "errors": errors,
    "functionals": functionals,
    "wheels": wheels,
    "slip": slip,
    "time_gap": time_gap,
}
