"""Figures of one recorded run: the paper's Fig. 11 and what lies behind it.

Each is a function from a :class:`~baselines.runs.run.Record` to a :class:`matplotlib.figure.Figure`;
:func:`write_figures` writes them all. A robot keeps its colour and marker everywhere. Nothing here
touches pyplot or other global state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator

from baselines.runs.run import Record
from tlf_env.common.files import atomic
from tlf_env.rendering.looks import CASTOR_WIDTH_MM, DRIVE_WHEEL_WIDTH_MM, NOSE, robot_colours
from tlf_env.task.measures import TIME_GAP_WINDOW_S

DPI = 150
METADATA: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MARKERS_PER_LINE = 7
COMMAND_COLOUR, ACTUAL_COLOUR = "#E69F00", "#0072B2"
GREY, PALE = "0.45", "0.88"
NOTE: dict[str, Any] = {"textcoords": "offset points", "color": GREY, "fontsize": "small"}

MOST_POINTS = 4000  # per line: more do not show
PLANE_IN = 5.6  # height of the plane
SLIMMEST, WIDEST = 0.6, 1.8  # its width by its height
NARROWEST_IN = 6.0  # of a figure, so that its title takes two lines at most
ROW_IN = 1.25  # height of a robot's row
MOST_SHOWN = 24  # rows of robots, and entries of a legend

SNAPSHOTS = 4  # times at which the robots are drawn, at most
SNAPSHOT_ROOM = 1.5  # between robots of different times, in outline diameters
FADED = 0.5


def write_figures(
    record: Record, folder: Path, *, formats: tuple[str, ...] = ("png",)
) -> list[Path]:
    """Write every figure of a run into ``folder``, each atomically; returns their paths.

    ``time_gap`` is left out where there is none: with one robot, or over before the first gap.
    """
    written = []
    for name, draw in FIGURES.items():
        if name == "time_gap" and not _has_time_gap(record):
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
    width_in = _plane_width_in(record)
    figure = _figure(record, width_in + 5.8, PLANE_IN + 0.9)
    panels = figure.subplot_mosaic(
        [["plane", "position"], ["plane", "other"]], width_ratios=[width_in, 5.0]
    )
    plane, position, other = panels["plane"], panels["position"], panels["other"]
    _plane(record, plane, snapshot_rows(record))
    _position_error(record, position)
    (_time_gap_error if _has_time_gap(record) else _heading_error)(record, other)
    other.sharex(position)
    position.tick_params(labelbottom=False)
    _settle_label(record, position, ", RMS from here")
    _time_axis(record, other)
    _legend(figure, position.get_legend_handles_labels()[0], columns=5)
    return figure


def paths(record: Record) -> Figure:
    """Fig. 11 (a, d): the paths in the plane, from the start (open markers) to the robots' end."""
    figure = _figure(record, 1.2 * _plane_width_in(record) + 0.8, 1.2 * PLANE_IN + 0.8)
    axes = figure.subplots()
    _plane(record, axes, [len(record.t_s) - 1])
    _legend(figure, axes.get_legend_handles_labels()[0])
    return figure


def errors(record: Record) -> Figure:
    """Position and heading errors, each robot to its own reference."""
    figure = _figure(record, 9.5, 6.2)
    position, heading = figure.subplots(2, 1, sharex=True)
    _position_error(record, position)
    _heading_error(record, heading)
    _settle_label(record, position, ", RMS from here")
    _time_axis(record, heading)
    _legend(figure, position.get_legend_handles_labels()[0], columns=4)
    return figure


def functionals(record: Record) -> Figure:
    """Fig. 11 (b, c, e, f): J and J_θ of eq. (54); below, what they gained since ``settle_s``."""
    figure = _figure(record, 10.0, 6.2)
    grid = figure.subplots(2, 2, sharex="row")
    settle = int(np.searchsorted(record.t_s, record.scenario.settle_s))
    late_s = record.t_s[settle:]
    for (whole, late), column, symbol, unit in zip(
        grid.T, ("J_mm_s", "J_theta_rad_s"), ("$J$", r"$J_\theta$"), ("mm·s", "rad·s"), strict=True
    ):
        values = record[column]
        for i in range(record.robots):
            _robot_line(record, whole, i, record.t_s, values[:, i])
            _robot_line(record, late, i, late_s, values[settle:, i] - values[settle, i])
        _signed_scale(whole, np.abs(values).max(axis=0))
        _label(whole, f"{symbol} ({unit})")
        late.set_ylabel(f"{symbol} gained since {late_s[0]:g} s ({unit})")
        _tidy(whole, late)
        _settle_line(record, whole)
        _settle_label(record, whole)
        _time_axis(record, whole)
        _time_axis(record, late, late_s[0])
    _legend(figure, grid[0, 0].get_legend_handles_labels()[0])
    return figure


def wheels(record: Record) -> Figure:
    """Wheel speeds, commanded and actual, and torques within their limits, a row for each robot."""
    figure, rows = _rows(record, 0, 13.0, columns=4)
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
        for axes, side in zip(row[2:], "lr", strict=True):
            torque = thinned(record.t_s, record[f"torque_{side}_Nmm"][:, i])
            axes.axhspan(-limit, limit, color=PALE, lw=0, zorder=0)
            axes.plot(*torque, color=ACTUAL_COLOUR, lw=0.5)
            axes.set_yticks([-limit, 0, limit])
            axes.set_ylim(-1.2 * limit, 1.2 * limit)
            axes.set_ylabel("torque (N·mm)")
    for k, name in enumerate(("left speed", "right speed", "left torque", "right torque")):
        rows[0][k].set_title(name, fontsize="medium")
    where = f"±{limits[0]:g} N·mm" if len(set(limits)) == 1 else "the band's edges"
    handles = [
        Line2D([], [], color=COMMAND_COLOUR, label="command"),
        Line2D([], [], color=ACTUAL_COLOUR, label="actual"),
        Patch(color=PALE, label=f"motors saturate at {where}"),
    ]
    _legend(figure, handles)
    return figure


def slip(record: Record) -> Figure:
    """Slip speed of the drive wheel that slips more, its largest within each control step."""
    figure, rows = _rows(record, 0, 8.0)
    stictions = [robot.tyre.stiction_speed_mm_s for robot in record.scenario.robot_models]
    most = max(2 * float(record["slip_mm_s"].max()), 5 * max(stictions))
    for i, (axes,) in rows.items():
        axes.plot(*thinned(record.t_s, record["slip_mm_s"][:, i]), color=_colour(record, i), lw=0.8)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_yticks([0, 1, 10, 100, 1000], ["0", "1", "10", "100", "1000"])
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylim(-0.1, most)  # so that a line along zero shows
        _label(axes, f"robot {i}\nslip (mm/s)")
        _mark_level(axes, stictions[i], "$v_s$")
    return figure


def time_gap(record: Record) -> Figure:
    """Time-gap error, a row for each follower; positive is late."""
    figure, rows = _rows(record, 1, 8.0, sharey=True)
    for i, (axes,) in rows.items():
        _time_gap_error(record, axes, [i])
        _label(axes, f"robot {i}\nerror (s)")
    _settle_label(record, rows[1][0])
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
    """Task, policy, disturbance and seed of a run."""
    disturbance = record.scenario.disturbance
    level = "" if disturbance.level == 1 else f" × {disturbance.level:g}"
    return (
        f"{record.scenario.name}, policy {record.policy}, disturbance {disturbance.name}{level}, "
        f"seed {record.seed}"
    )


def thinned(t_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most about ``MOST_POINTS`` points of a line, the extremes of every stretch among them."""
    count = len(values)
    if count <= MOST_POINTS:
        return t_s, values
    block = -(-count // (MOST_POINTS // 2))
    blocks = np.pad(values, (0, -count % block), mode="edge").reshape(-1, block)
    first = np.arange(len(blocks)) * block
    extremes = (first + blocks.argmin(axis=1), first + blocks.argmax(axis=1))
    keep = np.unique(np.minimum(np.concatenate([[0], *extremes, [count - 1]]), count - 1))
    return t_s[keep], values[keep]


def hex_colour(i: int, count: int) -> str:
    """The colour of number ``i`` of ``count`` robots or policies, as ``#rrggbb``; the renderer's."""
    return "#{:02x}{:02x}{:02x}".format(*robot_colours(count)[i])


def unbroken(values: np.ndarray, jump: float) -> np.ndarray:
    """Values with NaN after each jump beyond ``jump``, so that no line is drawn across."""
    return np.where(np.abs(np.diff(values, prepend=values[:1])) > jump, np.nan, values)


def body_polygons(record: Record, k: int, i: int) -> list[np.ndarray]:
    """Robot ``i`` at row ``k``, to scale, mm: left wheel, right wheel, castor, nose; each (corner, 2).

    Body axes are e = (cos θ, sin θ), right, and f = (−sin θ, cos θ), forward. The castor's fork is
    turned by ``castor_rad`` and its wheel trails behind the pivot.
    """
    robot = record.scenario.robot_models[i]
    c = np.array([record["x_mm"][k, i], record["y_mm"][k, i]])
    theta = record["theta_rad"][k, i]
    body, fork = _axes_of(theta), _axes_of(theta + record["castor_rad"][k, i])
    half_mm = robot.axle_width_mm / 2
    front_mm = robot.outline_radius_mm - robot.outline_offset_mm
    tyre = _rectangle(DRIVE_WHEEL_WIDTH_MM, 2 * robot.wheel_radius_mm)
    castor = _rectangle(CASTOR_WIDTH_MM, 2 * robot.castor_radius_mm)
    pivot = c - robot.castor_pivot_mm * body[1]
    return [
        c - half_mm * body[0] + tyre @ body,
        c + half_mm * body[0] + tyre @ body,
        pivot + (castor - (0, robot.castor_trail_mm)) @ fork,
        c + front_mm * np.array(NOSE) @ body,
    ]


def snapshot_rows(record: Record) -> list[int]:
    """Rows at which to draw the robots: the last, then those farthest from what is drawn already."""
    every_s = _round_above(record.t_s[-1] / 100)
    every = max(1, round(every_s / record.scenario.control_period_s))
    room_mm = SNAPSHOT_ROOM * 2 * _largest_radius_mm(record)
    places = _places(record)
    last = len(places) - 1
    chosen, candidates = [last], list(range(0, last, every))
    while candidates and len(chosen) < SNAPSHOTS:
        drawn = places[chosen].reshape(-1, 2)
        apart = [np.linalg.norm(places[k][:, None] - drawn, axis=-1).min() for k in candidates]
        if max(apart) < room_mm:
            break
        chosen.append(candidates.pop(int(np.argmax(apart))))
    return chosen


def _axes_of(theta: float) -> np.ndarray:
    return np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])


def _rectangle(width: float, length: float) -> np.ndarray:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, length / 2)


def _places(record: Record) -> np.ndarray:
    """(time, robot, 2), mm."""
    return np.stack([record["x_mm"], record["y_mm"]], axis=-1)


def _largest_radius_mm(record: Record) -> float:
    return max(robot.outline_radius_mm for robot in record.scenario.robot_models)


def _has_time_gap(record: Record) -> bool:
    return record.robots > 1 and bool(record.t_s[-1] > record.scenario.time_gap_s)


def _round_above(value: float) -> float:
    """The smallest of 1, 2, 5, 10, 20, … (or 0.5, 0.2, …) that is not below a positive value."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(d * decade for d in (1, 2, 5, 10) if d * decade >= value * (1 - 1e-9)))


def _figure(record: Record, width_in: float, height_in: float) -> Figure:
    figure = Figure(figsize=(max(width_in, NARROWEST_IN), height_in), layout="constrained")
    figure.suptitle(title(record), fontsize="medium", wrap=True)
    return figure


def _spread(count: int) -> np.ndarray:
    """Numbers below ``count``, all or ``MOST_SHOWN`` of them from first to last."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_SHOWN)).round().astype(int))


def _rows(
    record: Record, first: int, width_in: float, columns: int = 1, sharey: bool = False
) -> tuple[Figure, dict[int, np.ndarray]]:
    """A figure, and a row of axes for each robot from ``first`` on, or for a spread of very many."""
    robots = first + _spread(record.robots - first)
    figure = _figure(record, width_in, 1.2 + ROW_IN * max(len(robots), 2))
    grid = figure.subplots(len(robots), columns, sharex=True, sharey=sharey, squeeze=False)
    _tidy(*grid.flat)
    for axes in grid[-1]:
        _time_axis(record, axes)
    return figure, dict(zip(robots.tolist(), grid, strict=True))


def _colour(record: Record, i: int) -> str:
    return hex_colour(i, record.robots)


def _robot_line(
    record: Record,
    axes: Axes,
    i: int,
    t_s: np.ndarray,
    values: np.ndarray,
    jump: float = np.inf,
    label: str = "",
) -> None:
    """A robot's line with its marker now and then, never where another robot's is."""
    t_s, values = thinned(t_s, values)
    every = max(1, len(t_s) // MARKERS_PER_LINE)
    axes.plot(
        t_s,
        unbroken(values, jump),
        color=_colour(record, i),
        lw=1.0,
        marker=MARKERS[i % len(MARKERS)],
        markevery=(every * (i + 1) // (record.robots + 1), every),
        ms=4.5,
        mew=0.5,
        mec="white",
        label=label or f"robot {i}",
    )


def _legend(figure: Figure, handles: Sequence[Artist], columns: int = 7) -> None:
    """A legend below the axes, in at most ``columns`` columns and in as many as the figure holds."""
    shown = [handles[k] for k in _spread(len(handles))]
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


def _label(axes: Axes, text: str) -> None:
    """Name the vertical axis, and its scale where that is linear in the middle only."""
    axes.set_ylabel(text + ("\nsymlog" if axes.get_yscale() == "symlog" else ""))


def _tidy(*panels: Axes) -> None:
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.92", lw=0.6)
        axes.set_axisbelow(True)


def _time_axis(record: Record, axes: Axes, start_s: float = 0.0) -> None:
    end_s = float(record.t_s[-1])
    margin_s = 0.01 * (end_s - start_s) or 0.01
    axes.set_xlim(start_s - margin_s, end_s + margin_s)
    axes.set_xlabel("time (s)")


def _settle_line(record: Record, axes: Axes) -> None:
    axes.axvline(record.scenario.settle_s, color=GREY, ls="--", lw=0.9, zorder=1)


def _settle_label(record: Record, axes: Axes, more: str = "") -> None:
    settle_s = record.scenario.settle_s
    text, coords = f"settle time {settle_s:g} s{more}", ("data", "axes fraction")
    axes.annotate(text, (settle_s, 1.0), xycoords=coords, xytext=(0, 4), ha="center", **NOTE)


def _mark_level(axes: Axes, level: float, text: str) -> None:
    """A dotted line with its name in the right margin."""
    axes.axhline(level, color=GREY, ls=":", lw=0.9, zorder=1)
    coords = ("axes fraction", "data")
    axes.annotate(text, (1.0, level), xycoords=coords, xytext=(3, 0), va="center", **NOTE)


def _position_error(record: Record, axes: Axes) -> None:
    """On a log scale; each line is named with its RMS from ``settle_s`` on."""
    error = record["position_error_mm"]
    for i, metrics in enumerate(record.metrics()):
        label, rms = f"robot {i}", metrics.position_rmse_mm
        if rms is not None:
            label += f": {rms:.0f} mm RMS" if rms >= 100 else f": {rms:.2g} mm RMS"
        label += ", lost" if metrics.lost else ""
        _robot_line(record, axes, i, record.t_s, error[:, i], label=label)
    axes.set_yscale("log", nonpositive="clip")
    most = error.max() or 1.0
    least = np.percentile(error, 5) / 2
    axes.set_ylim(np.clip(least, 1e-4 * most, 1e-2 * most), 2 * most)
    if error.max() > record.scenario.lost_beyond_mm:
        _mark_level(axes, record.scenario.lost_beyond_mm, "lost")
    axes.set_ylabel("position error (mm)")
    _settle_line(record, axes)
    _tidy(axes)


def _heading_error(record: Record, axes: Axes) -> None:
    error = record["heading_error_rad"]
    for i in range(record.robots):
        _robot_line(record, axes, i, record.t_s, error[:, i], jump=np.pi)
    _signed_scale(axes, _sizes(error))
    _label(axes, "heading error (rad)")
    _settle_line(record, axes)
    _tidy(axes)


def _time_gap_error(record: Record, axes: Axes, robots: Sequence[int] = ()) -> None:
    """From one gap on: before, nobody has been where the follower should be."""
    defined = record.t_s >= record.scenario.time_gap_s
    error = record["time_gap_error_s"][defined]
    for i in robots or range(1, record.robots):
        _robot_line(record, axes, i, record.t_s[defined], error[:, i], jump=TIME_GAP_WINDOW_S)
    _signed_scale(axes, _sizes(error[:, 1:]))
    if np.abs(error).max() > 0.99 * TIME_GAP_WINDOW_S:
        for side in (-TIME_GAP_WINDOW_S, TIME_GAP_WINDOW_S):
            _mark_level(axes, side, "window")
    _label(axes, "time-gap error (s)")
    _settle_line(record, axes)
    _tidy(axes)


def _sizes(error: np.ndarray) -> np.ndarray:
    """What an error is nearly always within during the second half of a run, and what it reaches."""
    size = np.abs(error)
    return np.array([np.percentile(size[len(size) // 2 :], 95), size.max()])


def _signed_scale(axes: Axes, sizes: np.ndarray) -> None:
    """Linear to the least of ``sizes`` and logarithmic to the largest; linear throughout if that does."""
    most = float(sizes.max())
    least = max(float(sizes.min()), 1e-3 * most)
    if most <= 10 * least:
        return
    linear = _round_above(least)
    digits = (1, 2, 5) if most < 30 * linear else (1,)
    decades = np.arange(np.floor(np.log10(linear)), np.ceil(np.log10(most)) + 1)
    logarithmic = [d * 10.0**k for k in decades for d in digits if d * 10.0**k > 2.2 * linear]
    ticks = sorted({s * tick for tick in (0.0, linear, *logarithmic) for s in (-1, 1)})
    axes.set_yscale("symlog", linthresh=linear)
    axes.set_yticks(ticks, [f"{tick + 0.0:g}".replace("-", "−") for tick in ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.autoscale_view()


def _extent(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of the plane, mm: everything, with room for bodies."""
    everything = np.concatenate([_places(record).reshape(-1, 2), record.leader])
    room_mm = 2.5 * _largest_radius_mm(record)
    low, high = everything.min(axis=0) - room_mm, everything.max(axis=0) + room_mm
    width, height = size = high - low
    more = np.maximum(size, (height * SLIMMEST, width / WIDEST)) - size
    return low - more / 2, high + more / 2


def _plane_width_in(record: Record) -> float:
    low, high = _extent(record)
    width, height = high - low
    return float(PLANE_IN * width / height)


def _plane(record: Record, axes: Axes, rows: Sequence[int]) -> None:
    """The leader's reference, every path, and the robots at ``rows``, of which the first is solid."""
    n, low_high = record.robots, np.stack(_extent(record))
    every = max(1, len(record.t_s) // MOST_POINTS)
    axes.plot(*record.leader[::every].T, color="0.8", lw=5.0, zorder=1, label="leader's reference")
    for i in range(n):  # later robots on top and thinner, so that paths that coincide all show
        style: dict[str, Any] = {
            "color": _colour(record, i),
            "marker": MARKERS[i % len(MARKERS)],
            "mfc": "white",
        }
        path = _places(record)[::every, i]
        width = 1.0 + 2.5 * (n - 1 - i) / max(n - 1, 1)
        axes.plot(*path.T, **style, markevery=[0], lw=width, zorder=2, label=f"robot {i}")
        axes.plot(*path[:1].T, **style, zorder=2.2)  # the start again, above all paths
    for k in reversed(rows):
        for i in range(n):
            _draw_body(record, axes, k, i, strength=1.0 if k == rows[0] else FADED)
    for k in rows:
        _time_label(record, axes, k, rows)
    axes.set(xlim=low_high[:, 0], ylim=low_high[:, 1], aspect="equal")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    _tidy(axes)


def _draw_body(record: Record, axes: Axes, k: int, i: int, strength: float) -> None:
    robot = record.scenario.robot_models[i]
    line = 1 - strength * (1 - np.array(to_rgb(_colour(record, i))))
    centre = np.array([0, -robot.outline_offset_mm]) @ _axes_of(record["theta_rad"][k, i])
    x, y = _places(record)[k, i] + centre
    z = 2 + strength
    fill, dark = 1 - 0.3 * (1 - line), 1 - strength * (1 - 0.7 * line)
    axes.add_patch(Circle((x, y), robot.outline_radius_mm, fc=fill, ec=line, zorder=z))
    axes.add_collection(PolyCollection(body_polygons(record, k, i), fc=[dark], zorder=z))


def _time_label(record: Record, axes: Axes, k: int, rows: Sequence[int]) -> None:
    """The time beside the leader, where it is clearest of robots and paths."""
    places, (low, high) = _places(record), _extent(record)
    busy = np.concatenate([places[:: max(1, len(places) // 1000)], places[list(rows)]])
    half_mm = np.array([0.3, 0.12]) * (high - low)[1] / PLANE_IN  # of the text
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    sides = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    radius_mm = record.scenario.robot_models[0].outline_radius_mm
    beside = places[k, 0] + sides * (1.5 * radius_mm + half_mm)
    apart = np.linalg.norm(beside[:, None] - busy.reshape(-1, 2), axis=-1).min(axis=1)
    inside = np.all((beside - half_mm > low) & (beside + half_mm < high), axis=1)
    axes.annotate(
        f"{record.t_s[k]:g} s",
        tuple(beside[np.argmax(np.where(inside, apart, -1.0))]),
        ha="center",
        va="center",
        fontsize="small",
        weight="bold" if k == rows[0] else "normal",
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
        zorder=5,
    )
