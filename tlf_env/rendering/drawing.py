"""Geometry of a picture, and antialiased shapes, lines and text on a pygame surface. Lengths in canvas px."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from tlf_env.rendering.looks import FLOOR as FLOOR
from tlf_env.rendering.looks import LIGHT, Colour, Theme

SOFT_PX = 0.7  # width of an antialiased edge
SMOOTH_TURN = 0.9  # cosine of a turn between two lines up to which their ends need no rounding
BLOCK = 6  # segments of a line with the same colour
CIRCLE = np.stack([f(np.linspace(0, 2 * np.pi, 37)) for f in (np.cos, np.sin)], axis=-1)


class View(NamedTuple):
    """A window of the canvas and the floor in it; lengths in canvas px unless noted."""

    left: int
    top: int
    width: int
    height: int
    corner_mm: tuple[float, float]  # x of the left edge, y of the top edge
    scale: float  # px per mm
    pen: float  # canvas px per px at the design size

    def px(self, points_mm: np.ndarray) -> np.ndarray:
        """Canvas coordinates of points ``(..., 2)``, plus half a px since pygame truncates."""
        offset = (self.left + 0.5, self.top + 0.5)
        return (points_mm - self.corner_mm) * (self.scale, -self.scale) + offset

    def place(self, x_mm: float, y_mm: float, theta_rad: float) -> Place:
        """A pose on the canvas."""
        x = self.left + (x_mm - self.corner_mm[0]) * self.scale
        y = self.top + (self.corner_mm[1] - y_mm) * self.scale
        return Place(x, y, theta_rad, self.scale)

    def shows(self, px: np.ndarray, room: float = 0.0) -> np.ndarray:
        """Which canvas points are in the window or less than ``room`` outside; NaN never is."""
        x, y = px[..., 0] - self.left, px[..., 1] - self.top
        return (x > -room) & (x < self.width + room) & (y > -room) & (y < self.height + room)

    @property
    def rect(self) -> tuple[int, int, int, int]:
        """The window as a pygame rectangle."""
        return self.left, self.top, self.width, self.height


class Place(NamedTuple):
    """A pose on the canvas and its scale; its axes are e (right) and f (forward), in mm."""

    x: float  # canvas px, to the right
    y: float  # canvas px, down
    theta: float  # from up, counter-clockwise
    scale: float  # px per mm

    def px(self, points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
        """Canvas coordinates of points (e, f)."""
        sin, cos = self.scale * math.sin(self.theta), self.scale * math.cos(self.theta)
        x, y = self.x, self.y
        return [(x + e * cos - f * sin, y - e * sin - f * cos) for e, f in points]

    def at(self, e: float, f: float, turn: float = 0.0) -> Place:
        """A pose relative to this one."""
        ((x, y),) = self.px([(e, f)])
        return Place(x, y, self.theta + turn, self.scale)


class Tiles:
    """Which parts of a canvas have been drawn on: squares of 64 px.

    Parameters
    ----------
    size_px
        Width and height of the canvas.
    """

    SHIFT = 6  # of a px, to its tile

    def __init__(self, size_px: tuple[int, int]) -> None:
        self._size_px = size_px
        width, height = (-(-side >> self.SHIFT) for side in size_px)
        self.drawn = np.zeros((height, width), dtype=np.bool_)

    def add(self, rect: Any) -> None:
        """Note that a rectangle (of pygame) has been drawn on."""
        if rect.width and rect.height:
            left, right = max(rect.left, 0) >> self.SHIFT, (rect.right - 1) >> self.SHIFT
            top, bottom = max(rect.top, 0) >> self.SHIFT, (rect.bottom - 1) >> self.SHIFT
            self.drawn[top : bottom + 1, left : right + 1] = True

    def take(self) -> np.ndarray:
        """The tiles that were drawn on since the last call, ``(row, column)``."""
        drawn, self.drawn = self.drawn, np.zeros_like(self.drawn)
        return drawn

    def rectangles(self, tiles: np.ndarray) -> list[tuple[int, int, int, int]]:
        """Rectangles of the canvas that cover some tiles, each tile once: left, top, width, height."""
        found: dict[tuple[int, int], tuple[int, int]] = {}  # of the row before: columns, rows
        done = []
        width, height = self._size_px
        padded = np.zeros((len(tiles), tiles.shape[1] + 2), dtype=np.bool_)
        padded[:, 1:-1] = tiles
        runs: list[list[int]] = [[] for _ in range(len(tiles) + 1)]  # of each row: ends of its runs
        for row, column in np.argwhere(padded[:, 1:] != padded[:, :-1]).tolist():
            runs[row].append(column)
        for row, ends in enumerate(runs):
            now: dict[tuple[int, int], tuple[int, int]] = {}
            for left, right in zip(ends[::2], ends[1::2], strict=True):
                first, _ = found.pop((left, right), (row, row))
                now[left, right] = first, row
            done += [(*columns, *rows) for columns, rows in found.items()]
            found = now
        return [
            (
                left << self.SHIFT,
                top << self.SHIFT,
                min(right << self.SHIFT, width) - (left << self.SHIFT),
                min((bottom + 1) << self.SHIFT, height) - (top << self.SHIFT),
            )
            for left, right, top, bottom in done
        ]


class Shapes:
    """Draws on a canvas in the px of :class:`View` and :class:`Place`.

    Parameters
    ----------
    pg
        The module pygame.
    canvas
        The surface to draw on.
    font
        Font of the labels.
    theme
        Its colours of text and floor are those of labels.
    """

    def __init__(self, pg: Any, canvas: Any, font: Any, theme: Theme = LIGHT) -> None:
        self._pg, self._canvas, self._font, self._theme = pg, canvas, font, theme
        self.tiles = Tiles(canvas.get_size())

    def label(self, text: str, ground: Colour | None = None, **anchor: Any) -> None:
        """Text on the canvas; ``anchor`` is a point of the text's rectangle, named as in pygame."""
        image = self._font.render(text, True, self._theme.ink, ground or self._theme.floor)
        self.tiles.add(self._canvas.blit(image, image.get_rect(**anchor)))

    def fill(self, points: Sequence[tuple[float, float]], colour: Colour) -> None:
        """A polygon, plus half a px since pygame truncates."""
        polygon = [(x + 0.5, y + 0.5) for x, y in points]
        self.tiles.add(self._pg.draw.polygon(self._canvas, colour, polygon))

    def _smooth(self, points: Sequence[tuple[float, float]], colour: Colour) -> None:
        """A polygon with an antialiased edge, about 0.7 px wide."""
        self.fill(points, colour)
        self._edge(points, colour, closed=True)

    def bar(self, place: Place, size: tuple[float, float], colour: Colour) -> None:
        """A rectangle around a place with sides along e and f."""
        e, f = (max(side / 2 - SOFT_PX, 0.3) / place.scale for side in size)
        self._smooth(place.px([(-e, -f), (e, -f), (e, f), (-e, f)]), colour)

    def cross(self, place: Place, arm: float, width: float, colour: Colour) -> None:
        """Two bars through the place, along e and f, ``arm`` to each side."""
        self.bar(place, (2 * arm, width), colour)
        self.bar(place, (width, 2 * arm), colour)

    def stroke(self, points: Sequence[tuple[float, float]], width: float, colour: Colour) -> None:
        """The line around a polygon, or between two points, with round corners."""
        last = points[-1]
        heading = math.atan2(last[0] - points[-2][0], last[1] - points[-2][1])
        for x, y in points:
            before, heading = heading, math.atan2(x - last[0], y - last[1])
            middle = Place((x + last[0]) / 2, (y + last[1]) / 2, heading, 1.0)
            length = math.hypot(x - last[0], y - last[1]) + 2 * SOFT_PX
            self.bar(middle, (width, length), colour)
            if math.cos(heading - before) < SMOOTH_TURN:
                self.disc(Place(*last, 0.0, 1.0), width / 2, colour)
            last = (x, y)

    def disc(self, place: Place, radius: float, colour: Colour) -> None:
        """A filled circle."""
        points = (radius - SOFT_PX) * CIRCLE + (place.x, place.y)
        self._smooth(points.tolist(), colour)

    def ring(self, place: Place, radius: float, width: float, colour: Colour) -> None:
        """The line of a circle as one polygon: along the outside, and back along the inside."""
        half, middle = max(width / 2 - SOFT_PX, 0.3), (place.x, place.y)
        outside = ((radius + half) * CIRCLE + middle).tolist()
        inside = ((radius - half) * CIRCLE[::-1] + middle).tolist()
        self._smooth(outside + inside, colour)

    def lines(
        self,
        view: View,
        points_mm: np.ndarray,
        width: np.ndarray,
        colours: Sequence[Sequence[Colour]],
    ) -> None:
        """Lines through ``(point, line, 2)`` with the ``width`` at each point, drawn from the first block on.

        A block has ``BLOCK`` segments; ``colours`` contains one colour per block and line.
        """
        points = view.px(points_mm)
        along = np.gradient(points, axis=0)
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        along = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
        side = along[..., ::-1] * (-0.5, 0.5) * width[:, None, None]
        left, right = points + side, points - side
        starts = np.arange(0, len(points) - 1, BLOCK)
        near = np.logical_or.reduceat(view.shows(points, view.width / 2), starts)
        possible = np.logical_and.reduceat(view.shows(points, 8 * view.width), starts)
        for block, i in np.argwhere(near & possible).tolist():
            here = slice(starts[block], starts[block] + BLOCK + 1)
            outline = np.concatenate([left[here, i], right[here, i][::-1]]).tolist()
            colour, half = colours[block][i], len(outline) // 2
            self.fill(outline, colour)
            self._edge(outline[:half], colour, closed=False)
            self._edge(outline[half:], colour, closed=False)

    def _edge(self, points: Sequence[Sequence[float]], colour: Colour, *, closed: bool) -> None:
        """An antialiased line through points."""
        drawn = self._pg.draw.aalines(self._canvas, colour, closed, points)
        self.tiles.add(drawn.inflate(2, 2))


def clipped(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The part of a convex polygon ``(corner, 2)`` in a rectangle, given by two corners."""
    for axis, bound, sign in ((0, low, 1.0), (1, low, 1.0), (0, high, -1.0), (1, high, -1.0)):
        if not len(points):
            break
        depth = sign * (points[:, axis] - bound[axis])
        if (depth >= 0).all():
            continue
        ends, ends_depth = np.roll(points, -1, axis=0), np.roll(depth, -1)
        kept = []
        for point, end, here, there in zip(points, ends, depth, ends_depth, strict=True):
            if here >= 0:
                kept.append(point)
            if (here >= 0) != (there >= 0):
                kept.append(point + here / (here - there) * (end - point))
        points = np.array(kept).reshape(-1, 2)
    return points


def mixed(of: Colour, with_: Colour, part: float) -> Colour:
    """A colour between two others."""
    r, g, b = (round(a + part * (c - a)) for a, c in zip(of, with_, strict=True))
    return r, g, b
