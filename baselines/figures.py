"""Figures of one recorded run: the paper's Fig. 11, and what lies behind it.

Every figure is made by a function of a :class:`~baselines.run.Record` that returns a
:class:`matplotlib.figure.Figure`; :func:`write_figures` writes them all. Robots keep their colour and
their marker across figures. Nothing here touches pyplot or any other global state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator

from baselines.run import Record, atomic

DPI = 150
METADATA: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}

# Okabe and Ito's colours but yellow, which is lost on white; neighbours differ in luminance too.
FEW_COLOURS = ("#0072B2", "#E69F00", "#000000", "#56B4E9", "#D55E00", "#009E73", "#CC79A7")
MANY_COLOURS = colormaps["viridis"]  # from dark to light along the formation
LIGHTEST = 0.92  # of the map; its end is lost on white
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MARKERS_PER_LINE = 7
COMMAND_COLOUR, ACTUAL_COLOUR = "#E69F00", "#0072B2"
GREY = "0.45"

MOST_POINTS = 4000  # per line; more do not show
DECADES_BELOW = 2  # of a log scale under the typical value
ROBOT_ROWS_IN = (1.35, 1.0)  # height of a row of a robot: few robots, many
MANY_ROWS = 8

SNAPSHOTS = 5  # times at which the robots are drawn, at most
SNAPSHOT_ROOM = 1.5  # between robots of different times, in outline diameters
SNAPSHOT_STEPS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
FADED = 0.35
DRIVE_WHEEL_WIDTH_MM, CASTOR_WIDTH_MM = 22.0, 14.0  # for the picture only


def write_figures(
    record: Record, folder: Path, *, formats: tuple[str, ...] = ("png",)
) -> list[Path]:
    """Write every figure of a run into ``folder``, each atomically; returns the paths.

    A formation of one robot has no time gap and gets no ``time_gap`` figure.
    """
    written = []
    for name, draw in FIGURES.items():
        if name == "time_gap" and record.robots == 1:
            continue
        figure = draw(record)
        for kind in formats:
            path = folder / f"{name}.{kind}"
            with atomic(path, "wb") as file:
                figure.savefig(file, format=kind, dpi=DPI, metadata=METADATA.get(kind))
            written.append(path)
    return written


def overview(record: Record) -> Figure:
    """The robots in the plane beside their position and time-gap errors (heading for one robot)."""
    low, high = _extent(record)
    width, height = high - low
    shape = float(np.clip(width / height, 0.55, 1.8))
    figure = _figure(record, 5.6 * shape + 5.6, 6.4)
    panels = figure.subplot_mosaic(
        [["plane", "position"], ["plane", "other"]], width_ratios=[5.6 * shape, 5.0]
    )
    _plane(record, panels["plane"], snapshots=True)
    panels["other"].sharex(panels["position"])
    _position_error(record, panels["position"])
    if record.robots > 1:
        _time_gap_errors(record, panels["other"])
    else:
        _heading_error(record, panels["other"])
    panels["position"].tick_params(labelbottom=False)
    _time_axis(record, panels["other"])
    _settle_label(record, panels["position"])
    _legend(figure, _robot_handles(record, _rms_labels(record)), columns=5)
    return figure


def paths(record: Record) -> Figure:
    """Paths in the plane, as in Fig. 11 (a) and (d): starts as open markers, robots at the end."""
    low, high = _extent(record)
    shape = float(np.clip((high - low)[0] / (high - low)[1], 0.6, 1.8))
    figure = _figure(record, 6.0 * shape + 0.9, 7.4)
    axes = figure.subplots()
    _plane(record, axes, snapshots=False)
    for i in range(record.robots):
        axes.plot(
            record["x_mm"][0, i],
            record["y_mm"][0, i],
            ls="",
            marker=MARKERS[i % len(MARKERS)],
            ms=6,
            mfc="white",
            mec=_colour(record, i),
            zorder=4,
        )
    reference = Line2D([], [], color="0.7", lw=5, label="reference of the leader")
    _legend(figure, [reference, *_robot_handles(record)], columns=4)
    return figure


def errors(record: Record) -> Figure:
    """Position and heading errors to each robot's own reference against time."""
    figure = _figure(record, 8.0, 6.2)
    position, heading = figure.subplots(2, 1, sharex=True)
    _position_error(record, position)
    _heading_error(record, heading)
    _settle_label(record, position)
    _time_axis(record, heading)
    _legend(figure, _robot_handles(record))
    return figure


def functionals(record: Record) -> Figure:
    """J and J_θ of eq. (54), as in Fig. 11 (b, c, e, f); below, what they gained since ``settle_s``."""
    figure = _figure(record, 10.0, 6.2)
    grid = figure.subplots(2, 2, sharex=True)
    settle = int(np.searchsorted(record.t_s, record.scenario.settle_s))
    for (whole, settled), column, symbol, unit in zip(
        grid.T, ("J_mm_s", "J_theta_rad_s"), ("$J$", r"$J_\theta$"), ("mm·s", "rad·s"), strict=True
    ):
        values = record[column]
        for i in range(record.robots):
            _robot_line(record, whole, i, record.t_s, values[:, i])
            late = values[settle:, i] - values[settle, i]
            _robot_line(record, settled, i, record.t_s[settle:], late)
        _signed_scale(whole, np.abs(values).max(axis=0))
        whole.set_ylabel(f"{symbol} ({unit})")
        settled.set_ylabel(f"{symbol} − {symbol}({record.scenario.settle_s:g} s) ({unit})")
        for axes in (whole, settled):
            _tidy(axes)
            _settle_line(record, axes)
        _settle_label(record, whole)
        _time_axis(record, settled)
    _legend(figure, _robot_handles(record))
    return figure


def wheels(record: Record) -> Figure:
    """Wheel speeds, commanded and actual, and torques within their limits, a row for each robot."""
    grid, figure = _robot_rows(record, range(record.robots), 4, width_in=13.0)
    limit = record.scenario.robot.torque_limit_Nmm
    for i, row in enumerate(grid):
        for axes, side in zip(row[:2], "lr", strict=True):
            for column, colour in (("_command", COMMAND_COLOUR), ("", ACTUAL_COLOUR)):
                line = thinned(record.t_s, record[f"omega_{side}{column}_rad_s"][:, i])
                axes.plot(*line, color=colour, lw=0.9)
        for axes, side in zip(row[2:], "lr", strict=True):
            axes.axhspan(-limit, limit, color="0.9", lw=0, zorder=0)
            axes.axhline(0, color=GREY, lw=0.5)
            axes.plot(
                *thinned(record.t_s, record[f"torque_{side}_Nmm"][:, i]),
                color=ACTUAL_COLOUR,
                lw=0.6,
            )
            axes.set_ylim(-1.2 * limit, 1.2 * limit)
        row[0].set_ylabel(f"robot {i}\nspeed (rad/s)")
        row[2].set_ylabel("torque (N·mm)")
    _share_y(axes for row in grid for axes in row[:2])
    for axes in (*grid[:, 1], *grid[:, 3]):
        axes.tick_params(labelleft=False)
    for axes, title in zip(
        grid[0], ("left speed", "right speed", "left torque", "right torque"), strict=True
    ):
        axes.set_title(title, fontsize="medium")
    handles = [
        Line2D([], [], color=COMMAND_COLOUR, label="command"),
        Line2D([], [], color=ACTUAL_COLOUR, label="actual"),
        Patch(color="0.9", label=f"within saturation, ±{limit:g} N·mm"),
    ]
    _legend(figure, handles)
    return figure


def slip(record: Record) -> Figure:
    """Largest slip speed of a drive wheel within each control step, a row for each robot."""
    grid, figure = _robot_rows(record, range(record.robots), 1, width_in=8.0)
    sticks = record.scenario.robot.tyre.stiction_speed_mm_s
    for i, axes in enumerate(grid[:, 0]):
        t_s, speed = thinned(record.t_s, record["slip_mm_s"][:, i])
        axes.fill_between(t_s, speed, color=_colour(record, i), alpha=0.25, lw=0)
        axes.plot(t_s, speed, color=_colour(record, i), lw=0.8)
        axes.axhline(sticks, color=GREY, ls=":", lw=0.9)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_ylim(0, 2 * max(sticks, float(record["slip_mm_s"].max())))
        axes.set_ylabel(f"robot {i}\nslip (mm/s)")
    dots = Line2D(
        [], [], color=GREY, ls=":", label=f"static friction up to $v_s$ = {sticks:g} mm/s"
    )
    _legend(figure, [dots])
    return figure


def time_gap(record: Record) -> Figure:
    """Time-gap error of each follower; positive is late."""
    grid, figure = _robot_rows(record, range(1, record.robots), 1, width_in=8.0)
    for i, axes in enumerate(grid[:, 0], start=1):
        _time_gap_errors(record, axes, [i])
        axes.set_ylabel(f"robot {i}\nerror (s)")
    _settle_label(record, grid[0, 0])
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


def title(record: Record) -> str:
    """Task, policy, disturbance and seed of a run, in one line."""
    disturbance = record.scenario.disturbance
    level = "" if disturbance.level == 1 else f" × {disturbance.level:g}"
    return (
        f"{record.scenario.name}, {record.policy}, disturbance {disturbance.name}{level}, "
        f"seed {record.seed}"
    )


def thinned(t_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most about ``MOST_POINTS`` points of a line, with the extremes of every stretch kept."""
    count = len(values)
    if count <= MOST_POINTS:
        return t_s, values
    block = -(-count // (MOST_POINTS // 2))
    blocks = np.pad(values, (0, -count % block), mode="edge").reshape(-1, block)
    first = np.arange(len(blocks)) * block
    extremes = (first + blocks.argmin(axis=1), first + blocks.argmax(axis=1))
    keep = np.unique(np.minimum(np.concatenate([[0], *extremes, [count - 1]]), count - 1))
    return t_s[keep], values[keep]


def unbroken(angle: np.ndarray) -> np.ndarray:
    """An angle within ±π with NaN after each wrap, so that no line is drawn across."""
    wraps = np.abs(np.diff(angle, prepend=angle[:1])) > np.pi
    return np.where(wraps, np.nan, angle)


def body_polygons(record: Record, k: int, i: int) -> list[np.ndarray]:
    """Outlines of robot ``i`` at row ``k``, to scale, in mm: two drive wheels, castor, fork, nose.

    Body axes e = (cos θ, sin θ) to the right and f = (−sin θ, cos θ) forward; the castor's fork is
    turned by ``castor_rad`` and its wheel trails behind the pivot.
    """
    robot = record.scenario.robot
    centre = np.array([record["x_mm"][k, i], record["y_mm"][k, i]])
    theta, castor = record["theta_rad"][k, i], record["castor_rad"][k, i]
    axes, fork = _body_axes(theta), _body_axes(theta + castor)
    half, radius = robot.axle_width_mm / 2, robot.wheel_radius_mm
    pivot = centre - robot.castor_pivot_mm * axes[1]
    tyre = _rectangle(DRIVE_WHEEL_WIDTH_MM, 2 * radius)
    ahead = robot.outline_radius_mm - robot.outline_offset_mm
    nose = np.array([[-0.25, 0.5], [0.25, 0.5], [0.0, 0.95]]) * [ahead, ahead]
    return [
        centre + (tyre + [-half, 0]) @ axes,
        centre + (tyre + [half, 0]) @ axes,
        pivot
        + (_rectangle(CASTOR_WIDTH_MM, 2 * robot.castor_radius_mm) - [0, robot.castor_trail_mm])
        @ fork,
        centre + nose @ axes,
    ]


def snapshot_rows(record: Record) -> list[int]:
    """Rows at which to draw the robots: the last, then those that lie farthest from the others."""
    every_s = next((s for s in SNAPSHOT_STEPS_S if record.t_s[-1] / s <= 30), SNAPSHOT_STEPS_S[-1])
    step = max(1, round(every_s / record.scenario.control_period_s))
    room_mm = SNAPSHOT_ROOM * 2 * record.scenario.robot.outline_radius_mm
    last = len(record.t_s) - 1
    chosen, candidates = [last], list(range(0, last, step))
    places = np.stack([record["x_mm"], record["y_mm"]], axis=-1)  # (time, robot, 2)
    while candidates and len(chosen) < SNAPSHOTS:
        drawn = places[chosen].reshape(-1, 2)
        apart = [
            float(np.linalg.norm(places[k][:, None] - drawn, axis=-1).min()) for k in candidates
        ]
        if max(apart) < room_mm:
            break
        chosen.append(candidates.pop(int(np.argmax(apart))))
    return chosen


def _body_axes(theta: float) -> np.ndarray:
    """Rows e (right) and f (forward)."""
    return np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])


def _rectangle(width: float, length: float) -> np.ndarray:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, length / 2]


def _figure(record: Record, width_in: float, height_in: float) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    figure.suptitle(title(record), fontsize="medium")
    return figure


def _robot_rows(
    record: Record, robots: Sequence[int], columns: int, *, width_in: float
) -> tuple[np.ndarray, Figure]:
    """A row of axes for each robot, over one time axis."""
    row_in = ROBOT_ROWS_IN[len(robots) > MANY_ROWS]
    figure = _figure(record, width_in, 1.2 + row_in * max(len(robots), 2))
    grid = figure.subplots(len(robots), columns, sharex=True, squeeze=False)
    for axes in grid.flat:
        _tidy(axes)
    for axes in grid[-1]:
        _time_axis(record, axes)
    return grid, figure


def _colour(record: Record, i: int) -> Any:
    if record.robots <= len(FEW_COLOURS):
        return FEW_COLOURS[i]
    return MANY_COLOURS(LIGHTEST * i / (record.robots - 1))


def _robot_line(
    record: Record, axes: Axes, i: int, t_s: np.ndarray, values: np.ndarray, wraps: bool = False
) -> None:
    """One robot's line, its marker now and then, no two robots' at one place."""
    t_s, values = thinned(t_s, values)
    stride = max(1, len(t_s) // MARKERS_PER_LINE)
    axes.plot(
        t_s,
        unbroken(values) if wraps else values,
        color=_colour(record, i),
        lw=1.0,
        marker=MARKERS[i % len(MARKERS)],
        ms=4,
        mew=0.5,
        mec="white",
        markevery=(stride * (i + 1) // (record.robots + 1), stride),
        label=f"robot {i}",
    )


def _robot_handles(record: Record, labels: Sequence[str] | None = None) -> list[Line2D]:
    return [
        Line2D(
            [],
            [],
            color=_colour(record, i),
            marker=MARKERS[i % len(MARKERS)],
            ms=5,
            mew=0.5,
            mec="white",
            label=labels[i] if labels else f"robot {i}",
        )
        for i in range(record.robots)
    ]


def _rms_labels(record: Record) -> list[str]:
    """Each robot with its RMS position error from ``settle_s`` on, and whether it is lost."""
    labels = []
    for i, metrics in enumerate(record.metrics()):
        rms = metrics.position_rmse_mm
        text = f"robot {i}" if rms is None else f"robot {i}: {rms:.3g} mm RMS"
        labels.append(text + (", lost" if metrics.lost else ""))
    return labels


def _legend(figure: Figure, handles: Sequence[Any], columns: int = 7) -> None:
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(columns, len(handles)),
        frameon=False,
        fontsize="small",
    )


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)


def _time_axis(record: Record, axes: Axes) -> None:
    horizon_s = float(record.t_s[-1])
    axes.set_xlim(-0.01 * horizon_s, 1.005 * horizon_s)
    axes.set_xlabel("time (s)")


def _settle_line(record: Record, axes: Axes) -> None:
    axes.axvline(record.scenario.settle_s, color=GREY, ls="--", lw=0.9, zorder=1)


def _settle_label(record: Record, axes: Axes) -> None:
    axes.annotate(
        f"settle time {record.scenario.settle_s:g} s",
        (record.scenario.settle_s, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(0, 2),
        textcoords="offset points",
        ha="center",
        va="bottom",
        color=GREY,
        fontsize="small",
    )


def _position_error(record: Record, axes: Axes) -> None:
    error = record["position_error_mm"]
    for i in range(record.robots):
        _robot_line(record, axes, i, record.t_s, error[:, i])
    axes.set_yscale("log", nonpositive="clip")
    typical = np.median(error[error > 0]) if (error > 0).any() else 1.0
    floor = 10.0 ** (np.floor(np.log10(typical)) - DECADES_BELOW + 1)
    axes.set_ylim(floor, 3 * max(float(error.max()), 10 * floor))
    if error.max() > record.scenario.lost_beyond_mm:
        axes.axhline(record.scenario.lost_beyond_mm, color=GREY, ls=":", lw=0.9)
    axes.set_ylabel("position error (mm)")
    _tidy(axes)
    _settle_line(record, axes)


def _heading_error(record: Record, axes: Axes) -> None:
    error = record["heading_error_rad"]
    for i in range(record.robots):
        _robot_line(record, axes, i, record.t_s, error[:, i], wraps=True)
    _signed_scale(axes, _typical(error))
    axes.set_ylabel("heading error (rad)")
    _tidy(axes)
    _settle_line(record, axes)


def _time_gap_errors(record: Record, axes: Axes, robots: Iterable[int] | None = None) -> None:
    """Lines from one gap on: before, nobody passed where the follower is."""
    defined = record.t_s >= record.scenario.time_gap_s
    error = record["time_gap_error_s"][defined]
    for i in robots or range(1, record.robots):
        _robot_line(record, axes, i, record.t_s[defined], error[:, i])
    _signed_scale(axes, _typical(error[:, 1:]))
    axes.set_ylabel("time-gap error (s)")
    _tidy(axes)
    _settle_line(record, axes)


def _typical(error: np.ndarray) -> np.ndarray:
    """What a signed error is nearly always within, and what it reaches."""
    if not error.size:
        return np.zeros(1)
    size = np.abs(error)
    return np.array([np.percentile(size[len(size) // 2 :], 95), size.max()])


def _signed_scale(axes: Axes, sizes: np.ndarray) -> None:
    """Linear up to the smallest of ``sizes``, logarithmic to the largest; plainly linear if that will do."""
    least, most = max(float(sizes.min()), 1e-4 * float(sizes.max())), float(sizes.max())
    if most <= 4 * least:
        return
    decade = 10.0 ** np.floor(np.log10(least))
    linear = decade * next(digit for digit in (1, 2, 5, 10) if digit * decade >= least)
    decades = 10.0 ** np.arange(np.ceil(np.log10(1.9 * linear)), np.ceil(np.log10(most)) + 1)
    ticks = np.array([linear, *decades])
    axes.set_yscale("symlog", linthresh=linear, linscale=1.0)
    axes.set_yticks(
        [*-ticks[::-1], 0, *ticks],
        [f"{tick:g}".replace("-", "−") for tick in (*-ticks[::-1], 0, *ticks)],
    )
    axes.yaxis.set_minor_locator(NullLocator())
    axes.autoscale_view()


def _share_y(panels: Iterable[Axes]) -> None:
    """The same limits for all, wide enough for each."""
    panels = list(panels)
    limits = np.array([axes.get_ylim() for axes in panels])
    for axes in panels:
        axes.set_ylim(limits[:, 0].min(), limits[:, 1].max())


def _extent(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of everything in the plane, with room for the bodies."""
    places = np.stack([record["x_mm"], record["y_mm"]], axis=-1).reshape(-1, 2)
    everything = np.concatenate([places, record.leader])
    room = 2 * record.scenario.robot.outline_radius_mm
    return everything.min(axis=0) - room, everything.max(axis=0) + room


def _plane(record: Record, axes: Axes, *, snapshots: bool) -> None:
    """Reference of the leader, every path, the robots at the end and, if asked, before."""
    low, high = _extent(record)
    n = record.robots
    stride = max(1, len(record.t_s) // MOST_POINTS)
    axes.plot(*record.leader[::stride].T, color="0.82", lw=3.0 + 2.5 * (n > 1), zorder=1)
    for i in range(n):  # later robots lie on top, thinner, so that coinciding paths all show
        axes.plot(
            record["x_mm"][::stride, i],
            record["y_mm"][::stride, i],
            color=_colour(record, i),
            lw=1.0 + 2.5 * (n - 1 - i) / max(n - 1, 1),
            zorder=1.5,
        )
    rows = snapshot_rows(record) if snapshots else [len(record.t_s) - 1]
    for k in reversed(rows):
        for i in range(n):
            _body(record, axes, k, i, faded=k != rows[0])
    for k in rows if snapshots else []:
        _time_label(record, axes, k, rows)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")
    _tidy(axes)


def _body(record: Record, axes: Axes, k: int, i: int, *, faded: bool) -> None:
    """A robot to scale: outline, wheels, castor and a nose where it heads."""
    robot, theta = record.scenario.robot, record["theta_rad"][k, i]
    colour = np.array(to_rgb(_colour(record, i)))
    strength = FADED if faded else 1.0
    line = 1 - strength * (1 - colour)
    centre = (
        record["x_mm"][k, i] + robot.outline_offset_mm * np.sin(theta),
        record["y_mm"][k, i] - robot.outline_offset_mm * np.cos(theta),
    )
    axes.add_patch(
        Circle(
            centre,
            robot.outline_radius_mm,
            fc=1 - 0.3 * (1 - line),
            ec=line,
            lw=1.0,
            zorder=2 if faded else 3,
        )
    )
    axes.add_collection(
        PolyCollection(
            body_polygons(record, k, i),
            fc=[(*(0.8 * line * (not faded) + line * faded),)],
            zorder=2 if faded else 3,
        )
    )


def _time_label(record: Record, axes: Axes, k: int, rows: Sequence[int]) -> None:
    """The time beside the leader, on whichever side is clearest of robots and paths."""
    places = np.stack([record["x_mm"], record["y_mm"]], axis=-1)
    leader = places[k, 0]
    stride = max(1, len(places) // 500)
    busy = np.concatenate([places[list(rows)].reshape(-1, 2), places[::stride].reshape(-1, 2)])
    turns = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    around = leader + 2.4 * record.scenario.robot.outline_radius_mm * np.stack(
        [np.cos(turns), np.sin(turns)], axis=-1
    )
    apart = np.linalg.norm(around[:, None] - busy, axis=-1).min(axis=1)
    axes.annotate(
        f"{record.t_s[k]:g} s",
        around[int(np.argmax(apart))],
        ha="center",
        va="center",
        fontsize="small",
        weight="bold" if k == rows[0] else "normal",
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
        zorder=5,
    )
