"""The world of a run as borders and points in the plane: what stands, what is pushed, what moves, patches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from baselines.runs.run import Record
from tlf_env.disturbances.model import PatchRow, patch_rows
from tlf_env.physics.shapes import border
from tlf_env.physics.world import CircleShape, Obstacle, Wall, capsules_of, corners_of, placed

POINTS_EVERY_MM = 100.0  # of a thing's area, for the places of texts
SHRUNK = np.linspace(0.0, 1.0, 5)  # of a border, towards its middle


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
