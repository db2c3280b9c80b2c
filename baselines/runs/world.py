"""The world in the plane of a figure: walls, obstacles, things to push, moving obstacles, patches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from baselines.runs.run import Record
from tlf_env.disturbances.model import PatchRow, patch_rows
from tlf_env.physics.shapes import border
from tlf_env.physics.world import CircleShape, Obstacle, Wall, capsules_of, corners_of, placed
from tlf_env.rendering import looks

NEAR_MM = 1500.0  # the plane shows the world so far from paths and robots
FADED = 0.5  # of earlier times
POINTS_EVERY_MM = 100.0  # of a thing's area, for the places of texts
SHRUNK = np.linspace(0.0, 1.0, 5)  # of a border, towards its middle


def colour(rgb: looks.Colour, strength: float = 1.0) -> tuple[float, ...]:
    """A renderer's colour for matplotlib, mixed with white."""
    return tuple(1 - strength * (1 - channel / 255) for channel in rgb)


def fixed_borders(record: Record) -> list[np.ndarray]:
    """Borders of walls, piece by piece, and of obstacles, each ``(point, 2)``, mm."""
    return [piece for thing in record.scenario.world.fixed for piece in _pieces(thing)]


def _pieces(thing: Wall | Obstacle) -> list[np.ndarray]:
    if isinstance(thing, Obstacle):
        return [shape_border(thing.shape, thing.x_mm, thing.y_mm, thing.angle_rad)]
    return [
        border(np.array([(one.x_1, one.y_1), (one.x_2, one.y_2)]), one.radius)
        for one in capsules_of(thing)
    ]


def shape_border(shape: Any, x_mm: float, y_mm: float, angle_rad: float) -> np.ndarray:
    """Border of a shape at a pose, ``(point, 2)``, mm."""
    if isinstance(shape, CircleShape):
        return border(np.array([(x_mm, y_mm)]), shape.radius_mm)
    return placed(corners_of(shape), x_mm, y_mm, angle_rad)


def pushed_borders(record: Record, row: int) -> list[np.ndarray]:
    """Borders of the things that can be pushed, at a row of the record."""
    things = record.scenario.world.pushables
    poses = _poses(record, row)[: len(things)]
    return [shape_border(thing.shape, *pose) for thing, pose in zip(things, poses, strict=True)]


def moving_borders(record: Record, row: int) -> list[np.ndarray]:
    """Borders of the moving obstacles, at a row of the record."""
    world = record.scenario.world
    poses = _poses(record, row)[len(world.pushables) :]
    return [
        shape_border(thing.shape, *pose) for thing, pose in zip(world.moving, poses, strict=True)
    ]


def _poses(record: Record, row: int) -> list[list[float]]:
    poses: list[list[float]] = [] if record.objects is None else record.objects[row].tolist()
    return poses


def patches(record: Record) -> list[PatchRow]:
    """Patches of the floor whose friction differs."""
    scenario = record.scenario
    rows = patch_rows(scenario.disturbance, scenario.world.patches).tolist()
    return [patch for patch in map(PatchRow._make, rows) if patch.scale != 1]


def extent(record: Record) -> np.ndarray:
    """Points that the plane should show beside paths and robots, ``(point, 2)``, mm."""
    found = fixed_borders(record)
    for row in (0, -1):
        found += pushed_borders(record, row)
    for moving in record.scenario.world.moving:
        found += [
            shape_border(moving.shape, x, y, moving.angle_rad) for x, y in moving.corners_mm()
        ]
    return np.concatenate(found) if found else np.zeros((0, 2))


def occupied(record: Record, rows: Sequence[int]) -> np.ndarray:
    """Points all over the things, ``(point, 2)``, mm, which texts should stay clear of."""
    found = fixed_borders(record) + pushed_borders(record, 0) + pushed_borders(record, -1)
    for row in rows:
        found += moving_borders(record, row)
    return np.concatenate([np.zeros((0, 2)), *map(_filled, found)])


def _filled(around: np.ndarray) -> np.ndarray:
    closed = np.concatenate([around, around[:1]])
    ways = np.concatenate([[0.0], np.hypot(*np.diff(closed, axis=0).T).cumsum()])
    count = int(min(ways[-1] / POINTS_EVERY_MM, 200)) + 2
    along = np.linspace(0.0, ways[-1], count)
    points = np.stack([np.interp(along, ways, axis) for axis in closed.T], axis=-1)
    middle = around.mean(axis=0)
    return (middle + SHRUNK[:, None, None] * (points - middle)).reshape(-1, 2)


def draw_world(record: Record, axes: Axes, rows: Sequence[int]) -> None:
    """Everything of the world; moving obstacles at ``rows``, the first of which is solid."""
    for patch in patches(record):
        place = (patch.x, patch.y)
        axes.add_patch(Circle(place, patch.radius, fc=_patch_colour(patch), lw=0, zorder=0.3))
    fixed = fixed_borders(record)
    if fixed:  # all edges first, so that none crosses the pieces of a wall
        _polygons(axes, fixed, looks.WALL, looks.WALL_EDGE, 1.0, lw=2.0, zorder=1.5)
        axes.add_collection(PolyCollection(fixed, fc=colour(looks.WALL), lw=0, zorder=1.51))
    if record.scenario.world.pushables:
        start, end = (pushed_borders(record, row) for row in (0, -1))
        _polygons(axes, start, looks.CRATE, looks.CRATE_EDGE, FADED, lw=0.8, zorder=1.6)
        _polygons(axes, end, looks.CRATE, looks.CRATE_EDGE, 1.0, lw=1.0, zorder=1.7)
    for moving in record.scenario.world.moving:
        axes.plot(*moving.corners_mm().T, **COURSE, zorder=1.4)
    for row in reversed(rows):
        strength = 1.0 if row == rows[0] else FADED
        things = moving_borders(record, row)
        z = 1.9 + strength / 20
        _polygons(axes, things, looks.MOVER, looks.MOVER_EDGE, strength, lw=1.2, zorder=z)


COURSE: dict[str, Any] = {"color": colour(looks.COURSE), "ls": (0, (4, 3)), "lw": 1.0}


def _polygons(
    axes: Axes,
    borders: list[np.ndarray],
    fill: looks.Colour,
    edge: looks.Colour,
    strength: float,
    **style: Any,
) -> None:
    if borders:
        style |= {"fc": colour(fill, strength), "ec": colour(edge, strength)}
        axes.add_collection(PolyCollection(borders, **style))


def _patch_colour(patch: PatchRow) -> tuple[float, ...]:
    return colour(looks.SLIPPERY if patch.scale < 1 else looks.GRIPPY)


def world_handles(record: Record) -> list[Artist]:
    """Entries of a legend for what the world contains."""
    world = record.scenario.world
    handles: list[Artist] = []
    if world.fixed:
        handles.append(
            Patch(fc=colour(looks.WALL), ec=colour(looks.WALL_EDGE), label="wall or obstacle")
        )
    if world.pushables:
        handles += [
            Patch(
                fc=colour(looks.CRATE, strength),
                ec=colour(looks.CRATE_EDGE, strength),
                label=f"can be pushed, at the {when}",
            )
            for strength, when in ((FADED, "start"), (1.0, "end"))
        ]
    if world.moving:
        marker: dict[str, Any] = {"mfc": colour(looks.MOVER), "mec": colour(looks.MOVER_EDGE)}
        handles.append(
            Line2D([], [], **COURSE, marker="o", ms=8, **marker, label="moving obstacle, its path")
        )
    by_scale = {patch.scale: patch for patch in patches(record)}
    handles += [
        Patch(fc=_patch_colour(patch), label=f"tyre friction × {scale:g}")
        for scale, patch in by_scale.items()
    ]
    return handles
