"""Panels of the figures of one run: errors over time, and the parts that all panels share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator

from baselines.runs.run import Record
from baselines.runs.style import GREY, MARKERS, hex_colour, tidy
from tlf_env.task.measures import TIME_GAP_WINDOW_S

MARKERS_PER_LINE = 7
LINES = ("-", "--", "-.", ":")  # the next after as many robots as there are markers
MOST_POINTS = 4000  # per line: more are not visible
NARROWEST_IN = 6.0  # of a figure, so that its title takes two lines at most
ROW_IN = 1.25  # height of a robot's row
MOST_SHOWN = 24  # rows of robots, and entries of a legend
NOTE: dict[str, Any] = {"textcoords": "offset points", "color": GREY, "fontsize": "small"}


def thinned(t_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most about ``MOST_POINTS`` points of a line, with the extremes of every section."""
    count = len(values)
    if count <= MOST_POINTS:
        return t_s, values
    block = -(-count // (MOST_POINTS // 2))
    blocks = np.pad(values, (0, -count % block), mode="edge").reshape(-1, block)
    first = np.arange(len(blocks)) * block
    extremes = (first + blocks.argmin(axis=1), first + blocks.argmax(axis=1))
    keep = np.unique(np.minimum(np.concatenate([[0], *extremes, [count - 1]]), count - 1))
    return t_s[keep], values[keep]


def unbroken(values: np.ndarray, jump: float) -> np.ndarray:
    """Values with NaN after each jump larger than ``jump``, so that no line crosses it."""
    return np.where(np.abs(np.diff(values, prepend=values[:1])) > jump, np.nan, values)


def has_time_gap(record: Record) -> bool:
    """Whether time-gap errors are defined: two robots, and a run longer than the gap."""
    return record.robots > 1 and bool(record.t_s[-1] > record.scenario.time_gap_s)


def round_above(value: float) -> float:
    """The smallest of 1, 2, 5, 10, 20, … (or 0.5, 0.2, …) that is not below a positive value."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(d * decade for d in (1, 2, 5, 10) if d * decade >= value * (1 - 1e-9)))


def new_figure(record: Record, width_in: float, height_in: float) -> Figure:
    """An empty figure with the run's title."""
    figure = Figure(figsize=(max(width_in, NARROWEST_IN), height_in), layout="constrained")
    figure.suptitle(record.title, fontsize="medium", wrap=True)
    return figure


def some_of(count: int) -> np.ndarray:
    """Numbers below ``count``: all, or ``MOST_SHOWN`` of them evenly from first to last."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_SHOWN)).round().astype(int))


def robot_rows(
    record: Record, first: int, width_in: float, columns: int = 1, sharey: bool = False
) -> tuple[Figure, dict[int, np.ndarray]]:
    """A figure, and a row of axes for each robot from ``first`` on; of very many robots, for some."""
    robots = first + some_of(record.robots - first)
    figure = new_figure(record, width_in, 1.2 + ROW_IN * max(len(robots), 2))
    grid = figure.subplots(len(robots), columns, sharex=True, sharey=sharey, squeeze=False)
    tidy(*grid.flat)
    for axes in grid[-1]:
        time_axis(record, axes)
    return figure, dict(zip(robots.tolist(), grid, strict=True))


def robot_colour(record: Record, robot: int) -> str:
    """Colour of a robot, by its number."""
    return hex_colour(robot, record.robots)


def robot_line(
    record: Record,
    axes: Axes,
    robot: int,
    t_s: np.ndarray,
    values: np.ndarray,
    jump: float = np.inf,
    label: str = "",
) -> None:
    """A robot's line with some markers, at other times than the markers of the other robots."""
    t_s, values = thinned(t_s, values)
    every = max(1, len(t_s) // MARKERS_PER_LINE)
    axes.plot(
        t_s,
        unbroken(values, jump),
        color=robot_colour(record, robot),
        lw=1.0,
        ls=LINES[robot // len(MARKERS) % len(LINES)],
        marker=MARKERS[robot % len(MARKERS)],
        markevery=(every * (robot + 1) // (record.robots + 1), every),
        ms=4.5,
        mew=0.5,
        mec="white",
        label=label or f"robot {robot}",
    )


def legend_below(figure: Figure, handles: Sequence[Artist], columns: int = 7) -> None:
    """A legend below the axes, in at most ``columns`` columns that fit into the figure."""
    shown = [handles[k] for k in some_of(len(handles))]
    renderer = FigureCanvasAgg(figure).get_renderer()
    while True:
        rows = -(-len(shown) // columns)
        legend = figure.legend(
            handles=shown,
            loc="outside lower center",
            ncols=-(-len(shown) // rows),
            frameon=False,
            fontsize="small",
        )
        if columns == 1 or legend.get_window_extent(renderer).width <= figure.bbox.width:
            return
        legend.remove()
        columns -= 1


def name_axis(axes: Axes, text: str) -> None:
    """Label the vertical axis, and say where its scale is linear if it is logarithmic beyond."""
    named_before = bool(axes.get_ylabel())
    axes.set_ylabel(text)
    if axes.get_yscale() == "symlog" and not named_before:
        linear = getattr(axes.yaxis.get_transform(), "linthresh", 0.0)
        axes.annotate(
            f"scale: linear within ±{linear:g}, log beyond",
            (0.995, 0.98),
            xycoords="axes fraction",
            ha="right",
            va="top",
            fontsize="x-small",
            color=GREY,
            path_effects=[withStroke(linewidth=2, foreground="white")],
        )


def time_axis(record: Record, axes: Axes, start_s: float = 0.0) -> None:
    """Label the time axis and set its limits."""
    end_s = float(record.t_s[-1])
    margin_s = 0.01 * (end_s - start_s) or 0.01
    axes.set_xlim(start_s - margin_s, end_s + margin_s)
    axes.set_xlabel("time (s)")


def settle_line(record: Record, axes: Axes) -> None:
    """A dashed line at the settle time."""
    axes.axvline(record.scenario.settle_s, color=GREY, ls="--", lw=0.9, zorder=1)


def settle_label(record: Record, axes: Axes, more: str = "") -> None:
    """A text above the settle line."""
    settle_s = record.scenario.settle_s
    text, coords = f"settle time {settle_s:g} s{more}", ("data", "axes fraction")
    axes.annotate(text, (settle_s, 1.0), xycoords=coords, xytext=(0, 4), ha="center", **NOTE)


def mark_level(axes: Axes, level: float, text: str) -> None:
    """A dotted line with a text in the right margin."""
    axes.axhline(level, color=GREY, ls=":", lw=0.9, zorder=1)
    coords = ("axes fraction", "data")
    axes.annotate(text, (1.0, level), xycoords=coords, xytext=(3, 0), va="center", **NOTE)


def position_error(record: Record, axes: Axes) -> None:
    """Position errors on a log scale; the legend gives each RMS from ``settle_s`` on."""
    error = record["position_error_mm"]
    for i, metrics in enumerate(record.metrics()):
        label, rms = f"robot {i}", metrics.position_rmse_mm
        if rms is not None:
            label += f": {rms:.0f} mm RMS" if rms >= 100 else f": {rms:.2g} mm RMS"
        label += ", lost" if metrics.lost else ""
        robot_line(record, axes, i, record.t_s, error[:, i], label=label)
    axes.set_yscale("log", nonpositive="clip")
    most = error.max() or 1.0
    least = np.percentile(error, 5) / 2
    axes.set_ylim(np.clip(least, 1e-4 * most, 1e-2 * most), 2 * most)
    if error.max() > record.scenario.lost_beyond_mm:
        mark_level(axes, record.scenario.lost_beyond_mm, "lost")
    axes.set_ylabel("position error (mm)")
    settle_line(record, axes)
    tidy(axes)


def heading_error(record: Record, axes: Axes) -> None:
    """Heading errors of all robots."""
    error = record["heading_error_rad"]
    for i in range(record.robots):
        robot_line(record, axes, i, record.t_s, error[:, i], jump=np.pi)
    signed_scale(axes, _sizes(error))
    name_axis(axes, "heading error (rad)")
    settle_line(record, axes)
    tidy(axes)


def time_gap_error(record: Record, axes: Axes, robots: Sequence[int] = ()) -> None:
    """Time-gap errors from one gap on; before, they are not defined."""
    defined = record.t_s >= record.scenario.time_gap_s
    error = record["time_gap_error_s"][defined]
    for i in robots or range(1, record.robots):
        robot_line(record, axes, i, record.t_s[defined], error[:, i], jump=TIME_GAP_WINDOW_S)
    signed_scale(axes, _sizes(error[:, 1:]))
    if np.abs(error).max() > 0.99 * TIME_GAP_WINDOW_S:
        for side in (-TIME_GAP_WINDOW_S, TIME_GAP_WINDOW_S):
            mark_level(axes, side, "window")
    name_axis(axes, "time-gap error (s)")
    settle_line(record, axes)
    tidy(axes)


def _sizes(error: np.ndarray) -> np.ndarray:
    """95th percentile of an error's size in the second half of a run, and its maximum."""
    size = np.abs(error)
    return np.array([np.percentile(size[len(size) // 2 :], 95), size.max()])


def signed_scale(axes: Axes, sizes: np.ndarray) -> None:
    """Scale that is linear up to the smallest of ``sizes`` and logarithmic beyond it, if they differ much."""
    most = float(sizes.max())
    least = max(float(sizes.min()), 1e-3 * most)
    if most <= 10 * least:
        return
    linear = round_above(least)
    digits = (1, 2, 5) if most < 30 * linear else (1,)
    decades = np.arange(np.floor(np.log10(linear)), np.ceil(np.log10(most)) + 1)
    logarithmic = [d * 10.0**k for k in decades for d in digits if d * 10.0**k > 2.2 * linear]
    ticks = sorted({s * tick for tick in (0.0, linear, *logarithmic) for s in (-1, 1)})
    axes.set_yscale("symlog", linthresh=linear)
    axes.set_yticks(ticks, [f"{tick + 0.0:g}".replace("-", "−") for tick in ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.autoscale_view()
