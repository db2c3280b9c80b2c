"""The world around the robots: walls, obstacles, bodies that can be pushed, and patches of the floor.

Lengths in mm, angles in rad, masses in kg. All are frozen models, read from the field ``world`` of a scenario.
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from tlf_env.common.models import Frozen, NonNegative, Number, Positive, Switch
from tlf_env.numerics.compiled import law
from tlf_env.physics.parameters import convex

MAX_PIECES = 1000  # of a world
FARTHEST_MM = 1e10  # of a coordinate, as of trajectories
FASTEST_MM_S = 1e5
Share = Annotated[Number, Field(ge=0, le=1)]
Place = Annotated[Number, Field(ge=-FARTHEST_MM, le=FARTHEST_MM)]
Length = Annotated[Positive, Field(le=FARTHEST_MM)]
Duration = Annotated[NonNegative, Field(le=1e9)]
Mass = Annotated[Positive, Field(ge=1e-6, le=1e6)]
Inertia = Annotated[Positive, Field(ge=1e-6, le=1e15)]
Point = tuple[Place, Place]


class Surface(Frozen):
    """What a contact depends on: Chipmunk takes the product of both surfaces' values.

    With 1, the other surface decides: a robot's ``outline_restitution`` and ``outline_friction``.
    """

    restitution: Share = 1.0
    friction: NonNegative = 1.0  # coefficient of Coulomb friction


class CircleShape(Frozen):
    """A disc."""

    type: Literal["circle"]
    radius_mm: Length


class BoxShape(Frozen):
    """A rectangle around its place, ``width_mm`` along x and ``length_mm`` along y at angle 0."""

    type: Literal["box"]
    width_mm: Length
    length_mm: Length


class PolygonShape(Frozen):
    """A convex polygon, its corners relative to its place, in order; the outline is closed."""

    type: Literal["polygon"]
    points_mm: Annotated[tuple[Point, ...], Field(min_length=3, max_length=MAX_PIECES)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not convex(self.points_mm):
            raise ValueError(
                f"points_mm {self.points_mm} must be the corners of a convex polygon, in order"
            )
        return self


Shape = Annotated[CircleShape | BoxShape | PolygonShape, Field(discriminator="type")]


class Wall(Surface):
    """A wall along a polyline, ``thickness_mm`` thick with round ends; 0 is a line."""

    points_mm: Annotated[tuple[Point, ...], Field(min_length=2, max_length=MAX_PIECES)]
    thickness_mm: Annotated[NonNegative, Field(le=FARTHEST_MM)] = 20.0
    closed: Switch = False  # whether the last point is joined to the first

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_apart(self.points_mm)
        return self


def _check_apart(points_mm: tuple[Point, ...]) -> None:
    if len(set(points_mm)) == 1:
        raise ValueError(f"points_mm {points_mm} must not all be the same point")


class Obstacle(Surface):
    """A shape that stands fast."""

    shape: Shape
    x_mm: Place
    y_mm: Place
    angle_rad: Number = 0.0


class Pushable(Surface):
    """A body that can be pushed. On the floor it rubs by Coulomb's law, as a whole and in turning.

    Its place is its centre of mass, which a polygon must contain.
    Floor friction transmits at most ``floor_friction``·mass·g through the centre, and that times the mean
    distance of the shape's area from the centre in turning. ``damping_per_s`` is the rate at which
    velocities decrease besides.
    """

    shape: Shape
    x_mm: Place
    y_mm: Place
    angle_rad: Number = 0.0
    mass_kg: Mass
    inertia_kg_mm2: Inertia | None = None  # about the centre; None: that of a uniform plate
    restitution: Share = 0.0
    floor_friction: NonNegative = 0.3
    damping_per_s: NonNegative = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if isinstance(self.shape, PolygonShape) and not contains_origin(self.shape.points_mm):
            raise ValueError(
                f"shape.points_mm {self.shape.points_mm} must contain (0, 0), the centre of mass"
            )
        return self


class MovingObstacle(Surface):
    """A shape that moves along a polyline at a constant speed, whatever it meets.

    Along the path it goes there and back, and pauses ``pause_s`` at each end; on a ``closed`` path
    it goes round. ``start_s`` is its time on that course at the start of an episode; with ``random_start``
    a time is drawn in each episode and added.
    """

    shape: Shape
    points_mm: Annotated[tuple[Point, ...], Field(min_length=2, max_length=MAX_PIECES)]
    speed_mm_s: Annotated[Positive, Field(le=FASTEST_MM_S)]
    closed: Switch = False
    pause_s: Duration = 0.0
    start_s: Duration = 0.0
    random_start: Switch = False
    angle_rad: Number = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.closed and self.pause_s:
            raise ValueError(f"pause_s {self.pause_s} needs a path with ends; closed must be false")
        _check_apart(self.points_mm)
        return self

    @property
    def lap_s(self) -> float:
        """Time after which the course repeats."""
        length = float(np.hypot(*np.diff(self.corners_mm(), axis=0).T).sum())
        once = length / self.speed_mm_s
        return once if self.closed else 2.0 * (once + self.pause_s)

    def corners_mm(self) -> np.ndarray:
        """Corners of the path, ``(corner, 2)``; of a closed one the first again at the end."""
        points = np.array(self.points_mm, dtype=np.float64)
        return np.concatenate([points, points[:1]]) if self.closed else points

    def course(self) -> Course:
        """The corners over the time of one lap."""
        corners = self.corners_mm()
        ways = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
        times = ways / self.speed_mm_s
        if not self.closed:
            back = times[-1] + self.pause_s
            times = np.concatenate([times, back + times, [self.lap_s]])
            corners = np.concatenate([corners, corners[::-1], corners[:1]])
        return Course(times, corners[:, 0].copy(), corners[:, 1].copy(), self.lap_s)


class Course(NamedTuple):
    """Corners of a moving obstacle's path and the times at which it is there; it repeats after a lap."""

    times_s: np.ndarray
    x_mm: np.ndarray
    y_mm: np.ndarray
    lap_s: float

    def at(self, time_s: float) -> tuple[float, float]:
        """Place at a time, mm."""
        t = time_s % self.lap_s
        return (
            float(np.interp(t, self.times_s, self.x_mm)),
            float(np.interp(t, self.times_s, self.y_mm)),
        )


class Patch(Frozen):
    """A disc on the floor where the tyres' friction is scaled."""

    x_mm: Place
    y_mm: Place
    radius_mm: Length
    friction_scale: NonNegative


class World(Frozen):
    """Everything around the robots."""

    walls: Annotated[tuple[Wall, ...], Field(max_length=MAX_PIECES)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], Field(max_length=MAX_PIECES)] = ()
    pushables: Annotated[tuple[Pushable, ...], Field(max_length=MAX_PIECES)] = ()
    moving: Annotated[tuple[MovingObstacle, ...], Field(max_length=MAX_PIECES)] = ()
    patches: Annotated[tuple[Patch, ...], Field(max_length=MAX_PIECES)] = ()

    @property
    def fixed(self) -> tuple[Wall | Obstacle, ...]:
        """Everything that stands fast."""
        return (*self.walls, *self.obstacles)


class Capsule(NamedTuple):
    """All points within ``radius`` of a segment, mm; a static shape consists of such."""

    x_1: float
    y_1: float
    x_2: float
    y_2: float
    radius: float


def corners_of(shape: Any) -> np.ndarray:
    """Corners of a box or a polygon about its place at angle 0, ``(corner, 2)``, mm."""
    if isinstance(shape, BoxShape):
        half_x, half_y = shape.width_mm / 2, shape.length_mm / 2
        return np.array(
            [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
        )
    return np.array(shape.points_mm, dtype=np.float64)


def placed(points: np.ndarray, x_mm: float, y_mm: float, angle_rad: float) -> np.ndarray:
    """Points turned by an angle and moved to a place, ``(point, 2)``."""
    sin, cos = math.sin(angle_rad), math.cos(angle_rad)
    turned = points @ np.array([[cos, sin], [-sin, cos]])
    return turned + np.array([x_mm, y_mm])


def capsules_of(thing: Wall | Obstacle) -> list[Capsule]:
    """The capsules of a wall or of an obstacle's border."""
    if isinstance(thing, Wall):
        corners, radius, closed = (
            np.array(thing.points_mm, dtype=np.float64),
            thing.thickness_mm / 2,
            thing.closed,
        )
    elif isinstance(thing.shape, CircleShape):
        return [Capsule(thing.x_mm, thing.y_mm, thing.x_mm, thing.y_mm, thing.shape.radius_mm)]
    else:
        corners, radius, closed = (
            placed(corners_of(thing.shape), thing.x_mm, thing.y_mm, thing.angle_rad),
            0.0,
            True,
        )
    ends = np.concatenate([corners, corners[:1]]) if closed else corners
    return [
        Capsule(x_1, y_1, x_2, y_2, radius)
        for (x_1, y_1), (x_2, y_2) in itertools.pairwise(ends.tolist())
    ]


def capsule_rows(world: World) -> np.ndarray:
    """The static world, ``(capsule, Capsule)``."""
    found = [one for thing in world.fixed for one in capsules_of(thing)]
    return np.array(found, dtype=np.float64).reshape(-1, len(Capsule._fields))


@law
def gap_to_capsule(capsules: np.ndarray, number: int, x: float, y: float) -> float:
    """Distance of a point (mm) from a capsule; negative inside."""
    x_1, y_1 = capsules[number, 0], capsules[number, 1]
    along_x, along_y = capsules[number, 2] - x_1, capsules[number, 3] - y_1
    d_x, d_y = x - x_1, y - y_1
    length_2 = along_x * along_x + along_y * along_y
    share = 0.0
    if length_2 > 0.0:
        share = min(max((d_x * along_x + d_y * along_y) / length_2, 0.0), 1.0)
    d_x -= share * along_x
    d_y -= share * along_y
    return math.sqrt(d_x * d_x + d_y * d_y) - capsules[number, 4]


def gaps_to_capsule(capsule: Capsule, points: np.ndarray) -> np.ndarray:
    """:func:`gap_to_capsule` of many points, ``(point, 2)``."""
    first = np.array([capsule.x_1, capsule.y_1])
    along = np.array([capsule.x_2, capsule.y_2]) - first
    away = points - first
    length_2 = float(along @ along)
    share = np.clip(away @ along / length_2, 0.0, 1.0) if length_2 > 0.0 else np.zeros(len(points))
    away = away - share[:, None] * along
    gaps: np.ndarray = np.hypot(*away.T) - capsule.radius
    return gaps


@law
def gap_to_walls(capsules: np.ndarray, x: float, y: float) -> float:
    """Distance of a point (mm) from the nearest capsule; infinity if there is none."""
    nearest = math.inf
    for number in range(capsules.shape[0]):
        nearest = min(nearest, gap_to_capsule(capsules, number, x, y))
    return nearest


def contains_origin(points_mm: tuple[Point, ...]) -> bool:
    """Whether (0, 0) lies in a convex polygon, its border excluded."""
    corners = np.array(points_mm, dtype=np.float64)
    after = np.roll(corners, -1, axis=0)
    sides = corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]
    return bool((sides > 0).all() or (sides < 0).all())


def mean_distance(shape: Any) -> float:
    """Mean distance of a shape's area from its place, mm: the lever of floor friction in turning."""
    if isinstance(shape, CircleShape):
        return 2.0 / 3.0 * shape.radius_mm
    corners = corners_of(shape)
    low, high = corners.min(axis=0), corners.max(axis=0)
    cells = 64
    x, y = (
        (low[i] + (np.arange(cells) + 0.5) * (high[i] - low[i]) / cells).astype(np.float64)
        for i in (0, 1)
    )
    grid_x, grid_y = np.meshgrid(x, y)
    edges = np.roll(corners, -1, axis=0) - corners
    sides = [
        edge[0] * (grid_y - corner[1]) - edge[1] * (grid_x - corner[0])
        for corner, edge in zip(corners, edges, strict=True)
    ]
    inside = np.all([side >= 0 for side in sides], axis=0) | np.all(
        [side <= 0 for side in sides], axis=0
    )
    return float(np.hypot(grid_x, grid_y)[inside].mean())
