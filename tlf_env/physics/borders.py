"""Borders of the shapes in a pymunk space as capsules, for rays to meet."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pymunk

from tlf_env.physics.world import Capsule

Ends = tuple[tuple[float, float], tuple[float, float]]


class Borders:
    """Borders of some shapes, for any poses of their bodies.

    Attributes
    ----------
    bodies : list of pymunk.Body
        The bodies of the shapes, each once.
    body_of : ndarray of int64
        For each capsule the place of its body in ``bodies``.
    """

    def __init__(self, shapes: Sequence[pymunk.Shape]) -> None:
        self.bodies: list[pymunk.Body] = []
        ends: list[Ends] = []
        radii: list[float] = []
        places: list[int] = []
        for shape in shapes:
            if shape.body is None:
                continue
            if shape.body not in self.bodies:
                self.bodies.append(shape.body)
            of_shape = list(ends_of(shape))
            ends += of_shape
            radii += [float(getattr(shape, "radius", 0.0))] * len(of_shape)
            places += [self.bodies.index(shape.body)] * len(of_shape)
        self.body_of = np.array(places, dtype=np.int64)
        self._ends = np.array(ends, dtype=np.float64).reshape(-1, 2, 2)
        self._radii = np.array(radii, dtype=np.float64)

    def capsules(self, poses: Sequence[tuple[float, float, float]]) -> np.ndarray:
        """Capsules ``(number, Capsule)`` with the bodies at poses (x, y in mm, angle in rad)."""
        x, y, angle = np.array(poses, dtype=np.float64).reshape(-1, 3)[self.body_of].T
        sin, cos = np.sin(angle), np.cos(angle)
        out = np.empty((len(self.body_of), len(Capsule._fields)))
        for end in range(2):
            right, ahead = self._ends[:, end].T
            out[:, 2 * end] = x + cos * right - sin * ahead
            out[:, 2 * end + 1] = y + sin * right + cos * ahead
        out[:, 4] = self._radii
        return out


def ends_of(shape: pymunk.Shape) -> list[Ends]:
    """Ends of the capsules that are a shape, or its border, relative to its body."""
    if isinstance(shape, pymunk.Circle):
        return [(shape.offset, shape.offset)]
    if isinstance(shape, pymunk.Segment):
        return [(shape.a, shape.b)]
    corners = shape.get_vertices() if isinstance(shape, pymunk.Poly) else []
    return list(itertools.pairwise([*corners, *corners[:1]]))
