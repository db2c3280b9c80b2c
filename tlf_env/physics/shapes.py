"""Shapes of a pymunk space where they are now, in the coordinates of the floor; for pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import pymunk

from tlf_env.physics.world import placed

# fixed: on a static body; moving: on a kinematic one; loose: on a dynamic one; zone: a sensor, which nothing
# bumps into; link: a joint or spring between two places
Kind = Literal["fixed", "moving", "loose", "zone", "link"]
Pose = tuple[float, float, float]  # x and y, mm; angle, rad

KINDS: dict[int, Kind] = {
    pymunk.Body.STATIC: "fixed",
    pymunk.Body.KINEMATIC: "moving",
    pymunk.Body.DYNAMIC: "loose",
}
LINKS = (pymunk.PinJoint, pymunk.SlideJoint, pymunk.DampedSpring)
STRAIGHT_RAD = 1e-9  # so that rounding does not make a full circle of a straight corner
ARC_RAD = math.pi / 18  # largest turn between two corners of a drawn arc


class PlacedShape(NamedTuple):
    """All points within ``radius_mm`` of the convex hull of some corners.

    One corner makes a circle, two make a segment with round ends.
    """

    kind: Kind
    corners_mm: tuple[tuple[float, float], ...]
    radius_mm: float

    def border_mm(self) -> np.ndarray:
        """Points around the shape, in order, ``(point, 2)``."""
        return border(np.array(self.corners_mm), self.radius_mm)


def border(corners: np.ndarray, radius: float) -> np.ndarray:
    """Points of the border of all places within ``radius`` of a convex hull, in order, ``(point, 2)``.

    ``corners`` ``(corner, 2)`` are those of the hull in order, either way round.
    """
    if radius <= 0.0:
        return corners
    if len(corners) == 2 and (corners[0] == corners[1]).all():
        corners = corners[:1]
    if len(corners) > 2 and signed_area(corners) < 0.0:
        corners = corners[::-1]
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.arctan2(-edges[:, 0], edges[:, 1])  # of each edge, to its right: outwards
    if len(corners) == 1:
        first, turns = np.zeros(1), np.array([2.0 * math.pi])
    else:
        first = np.roll(normals, 1)
        turns = (normals - first + STRAIGHT_RAD) % (2.0 * math.pi)
    points = []
    for corner, start, turn in zip(corners, first, turns, strict=True):
        angles = start + np.linspace(0.0, turn, max(2, math.ceil(turn / ARC_RAD) + 1))
        points.append(corner + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    return np.concatenate(points)


def signed_area(corners: np.ndarray) -> float:
    """Area of a polygon; negative if its corners go round clockwise."""
    x, y = (corners - corners.mean(axis=0)).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def placed_shape(shape: pymunk.Shape, pose: Pose) -> PlacedShape | None:
    """A shape with its body at a pose; None if it is neither circle, segment nor polygon, or nowhere."""
    points: Sequence[Sequence[float]]
    if isinstance(shape, pymunk.Circle):
        points, radius = [shape.offset], shape.radius
    elif isinstance(shape, pymunk.Segment):
        points, radius = [shape.a, shape.b], shape.radius
    elif isinstance(shape, pymunk.Poly):
        points, radius = shape.get_vertices(), shape.radius
    else:
        return None
    body = shape.body
    kind: Kind = "zone" if shape.sensor else KINDS[body.body_type if body else pymunk.Body.STATIC]
    return _somewhere(kind, _placed(points, pose), radius)


def placed_link(joint: pymunk.Constraint, pose_a: Pose, pose_b: Pose) -> PlacedShape | None:
    """The line between the anchors of a joint or spring with its bodies at two poses; None if it has none."""
    if not isinstance(joint, LINKS):
        return None
    ends = [_placed([joint.anchor_a], pose_a), _placed([joint.anchor_b], pose_b)]
    return _somewhere("link", np.concatenate(ends), 0.0)


def _placed(points: Sequence[Sequence[float]], pose: Pose) -> np.ndarray:
    local = np.array(points, dtype=np.float64)
    return placed(local, *pose) if all(map(math.isfinite, pose)) else np.full_like(local, np.nan)


def _somewhere(kind: Kind, corners_mm: np.ndarray, radius_mm: float) -> PlacedShape | None:
    """None for a body whose place is not a number."""
    if not (np.isfinite(corners_mm).all() and math.isfinite(radius_mm)):
        return None
    return PlacedShape(kind, tuple((x, y) for x, y in corners_mm.tolist()), float(radius_mm))
