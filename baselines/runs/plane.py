"""The plane of a figure of one run: paths, and robots drawn to scale at some times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke

from baselines.runs.bodies import axes_of, body_polygons
from baselines.runs.borders import extent as world_extent
from baselines.runs.borders import occupied
from baselines.runs.panels import MOST_POINTS, robot_colour, round_above
from baselines.runs.run import Record
from baselines.runs.style import MARKERS, tidy
from baselines.runs.world import NEAR_MM, draw_world
from tlf_env.rendering.looks import (
    outline_mm,
)

PLANE_IN = 5.6  # height of the plane
SLIMMEST, WIDEST = 0.6, 1.8  # its width by its height
WORLD_ROOM = 0.3  # of the room around the robots, around the world
SNAPSHOTS = 4  # times at which the robots are drawn, at most
SNAPSHOT_ROOM = 1.5  # between robots of different times, in outline diameters
TEXT_ROOMS = (1.5, 2.5, 3.5, 5.0)  # between a robot and its time, in outline radii
FADED = 0.5


def snapshot_rows(record: Record) -> list[int]:
    """Rows at which to draw the robots: the last, then those farthest from the robots already chosen."""
    every_s = round_above(record.t_s[-1] / 100)
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


def _places(record: Record) -> np.ndarray:
    """(time, robot, 2), mm."""
    return np.stack([record["x_mm"], record["y_mm"]], axis=-1)


def _largest_radius_mm(record: Record) -> float:
    return max(robot.outline_radius_mm for robot in record.scenario.robot_models)


def _extent(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of the plane, mm, with room for the bodies."""
    everything = np.concatenate([_places(record).reshape(-1, 2), record.leader])
    room_mm = 2.5 * _largest_radius_mm(record)
    low, high = everything.min(axis=0), everything.max(axis=0)
    world = np.clip(world_extent(record), low - NEAR_MM, high + NEAR_MM)
    low, high = low - room_mm, high + room_mm
    if len(world):
        low = np.minimum(low, world.min(axis=0) - WORLD_ROOM * room_mm)
        high = np.maximum(high, world.max(axis=0) + WORLD_ROOM * room_mm)
    width, height = size = high - low
    more = np.maximum(size, (height * SLIMMEST, width / WIDEST)) - size
    return low - more / 2, high + more / 2


def plane_width_in(record: Record) -> float:
    """Width of the plane for its height, inches."""
    low, high = _extent(record)
    width, height = high - low
    return float(PLANE_IN * width / height)


def draw_plane(record: Record, axes: Axes, rows: Sequence[int]) -> None:
    """World, leader's reference, every path, and the robots at ``rows``; those at the first row are solid."""
    n, low_high = record.robots, np.stack(_extent(record))
    draw_world(record, axes, rows)
    every = max(1, len(record.t_s) // MOST_POINTS)
    axes.plot(*record.leader[::every].T, color="0.8", lw=5.0, zorder=1, label="leader's reference")
    for i in range(n):  # later robots on top and thinner, so that coinciding paths are all visible
        style: dict[str, Any] = {
            "color": robot_colour(record, i),
            "marker": MARKERS[i % len(MARKERS)],
            "mfc": "white",
        }
        path = _places(record)[::every, i]
        width = 1.0 + 2.5 * (n - 1 - i) / max(n - 1, 1)
        axes.plot(*path.T, **style, markevery=[0], lw=width, zorder=2, label=f"robot {i}")
        axes.plot(*path[:1].T, **style, zorder=2.2)  # the start once more, above all paths
    for k in reversed(rows):
        for i in range(n):
            draw_body(record, axes, k, i, strength=1.0 if k == rows[0] else FADED)
    for k in rows:
        _time_label(record, axes, k, rows)
    axes.set(xlim=low_high[:, 0], ylim=low_high[:, 1], aspect="equal")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    tidy(axes)


def draw_body(record: Record, axes: Axes, row: int, number: int, strength: float) -> None:
    """A robot at a row, to scale, paler with less strength."""
    robot = record.scenario.robot_models[number]
    line = 1 - strength * (1 - np.array(to_rgb(robot_colour(record, number))))
    turned = axes_of(record["theta_rad"][row, number])
    z = 2 + strength
    fill, dark = 1 - 0.3 * (1 - line), 1 - strength * (1 - 0.7 * line)
    if robot.outline_polygon_mm is None:
        x, y = _places(record)[row, number] + np.array([0, -robot.outline_offset_mm]) @ turned
        axes.add_patch(Circle((x, y), robot.outline_radius_mm, fc=fill, ec=line, zorder=z))
    else:
        corners = _places(record)[row, number] + outline_mm(robot) @ turned
        axes.add_patch(Polygon(corners, fc=fill, ec=line, zorder=z))
    axes.add_collection(PolyCollection(body_polygons(record, row, number), fc=[dark], zorder=z))


def _time_label(record: Record, axes: Axes, row: int, rows: Sequence[int]) -> None:
    """The time beside the leader, at the side farthest from robots and paths."""
    places, (low, high) = _places(record), _extent(record)
    things = occupied(record, rows)
    busy = np.concatenate([places[:: max(1, len(places) // 1000)], places[list(rows)]])
    busy = np.concatenate([busy.reshape(-1, 2), things])
    half_mm = np.array([0.3, 0.12]) * (high - low)[1] / PLANE_IN  # of the text
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    sides = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    radius_mm = record.scenario.robot_models[0].outline_radius_mm
    best, most = np.zeros(2), -np.inf
    for room in TEXT_ROOMS if len(things) else TEXT_ROOMS[:1]:
        beside = places[row, 0] + sides * (room * radius_mm + half_mm)
        away = np.abs(beside[:, None] - busy)
        apart = np.linalg.norm(away, axis=-1).min(axis=1)
        inside = np.all((beside - half_mm > low) & (beside + half_mm < high), axis=1)
        chosen = np.argmax(np.where(inside, apart, -1.0))
        free = (away[chosen] / half_mm).max(axis=-1).min()  # 1: nothing is behind the text
        if (inside[chosen] and free > most) or most == -np.inf:
            best, most = beside[chosen], free
        if most >= 1.0:
            break
    axes.annotate(
        f"{record.t_s[row]:g} s",
        (float(best[0]), float(best[1])),
        ha="center",
        va="center",
        fontsize="small",
        weight="bold" if row == rows[0] else "normal",
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
        zorder=5,
    )
