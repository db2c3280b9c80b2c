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

from baselines.runs.borders import (
    fixed_borders,
    moving_borders,
    patches,
    pushed_borders,
)
from baselines.runs.run import Record
from tlf_env.disturbances.model import PatchRow
from tlf_env.rendering import looks

NEAR_MM = 1500.0  # the plane shows the world so far from paths and robots
FADED = 0.5  # of earlier times


def colour(rgb: looks.Colour, strength: float = 1.0) -> tuple[float, ...]:
    """A renderer's colour for matplotlib, mixed with white."""
    return tuple(1 - strength * (1 - channel / 255) for channel in rgb)


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
