"""The formation from above, to scale, drawn with pygame-ce (the extra ``view``) on surfaces.

Everything is drawn at twice the size and scaled down, which smooths all edges.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tlf_env.common.errors import install_command, is_one_of, shown
from tlf_env.engine.formation import Formation
from tlf_env.physics.shapes import Kind, PlacedShape
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.rendering.camera import Camera
from tlf_env.rendering.drawing import BLOCK, Place, Shapes, View, clipped, mixed
from tlf_env.rendering.looks import ALARM as ALARM
from tlf_env.rendering.looks import (
    CASTOR_WIDTH_MM,
    DRIVE_WHEEL_WIDTH_MM,
    LIGHT,
    NOSE,
    RENDER_MODES,
    Colour,
    Theme,
    front_mm,
    outline_mm,
    robot_colours,
)
from tlf_env.rendering.scene import Scene, patches_of
from tlf_env.rendering.window import Window
from tlf_env.task.metrics import touched_name

OVERSAMPLING = 2
DESIGN_SIZE_PX = (960, 720)  # lengths in px below are for this size and scale with it
SMALLEST_PX = 64

EDGE_LINE_PX = 1.2  # of what stands fast
DASH_PX, COURSE_PX, MOST_DASHES = 7.0, 1.5, 1000

AXLE_MM = 8.0  # in pictures only
TREADS, TREAD_RADII = 4, 0.2  # more would seem to turn backwards at top speed and 20 frames/s
# Slip speeds at which the mark of a slipping wheel begins and is strongest.
SLIP_SHOWN_MM_S, SLIP_FULL_MM_S = 2.0, 60.0

ARM_RADII = 0.25  # arms of the reference's cross
MARGIN_RADII = 3.0  # room around the path, in outline radii
MOST_START_MM = (
    1500.0  # largest extension of the view towards robots that start off the path, and the world
)
WORLD_RADII = 0.6  # room around the world
FOOT_PX = 36  # room below it, for the scale bar
TRAIL_POINTS = 96  # of one trail
PATH_POINTS = 1000
TRAIL_PX, PATH_PX = 5.0, 2.0
CLOSE_UP_PX, CLOSE_UP_RADII = 184, 3.2  # side of the close-up, in px and in outline radii of floor
CLOSE_UP_PEN = 1.3  # width of its lines relative to the others
EDGE_PX, LINE_PX, TABLE_PX = 14, 18, 230
PLATE_ALPHA = 190  # of the background of the table
SMALLEST_TEXT, SMALLEST_CLOSE_UP = 0.6, 0.6  # relative to their size in the design
TEXT_PX, TIME_PX = 19, 27  # of pygame's font, whose letters are two thirds as high
GRID_PX = 90  # smallest side of a grid square
COLUMNS_PX = (18, 140, 208, 218)  # name, error, time gap, flags


class Renderer:
    """Draws scenes of one formation, with trails of the robots' past positions.

    Parameters
    ----------
    robots
        Parameters of each robot.
    path_mm
        The leader's whole reference, ``(k, 2)``. The view contains it, the robots' start and the world
        nearby, and does not move in an episode; a robot outside is shown as an arrow at the edge.
    mode
        ``"rgb_array"``: frames as arrays, without a display. ``"human"``: a window with at most ``fps``
        frames per second; its keys, which change the view only, are listed by the key h.
    fps
        Frames per second.
    size_px
        Width and height of the picture.
    trail_s
        Duration of the robots' trails.
    patches
        Round patches of different friction: mappings of ``x_mm``, ``y_mm``, ``radius_mm`` and ``scale``.
    courses_mm
        Paths of moving obstacles, each ``(k, 2)``.
    close_up
        Number of the robot in the close-up in a corner, at most that of the last robot; None: no close-up.
    theme
        Colours.
    table
        Whether time and errors are written in a corner.
    smallest_text
        Least size of the text, relative to that in a picture of the usual size.

    Attributes
    ----------
    camera
        The part of the floor that is shown; the whole at the start.
    theme
        Colours.
    pg
        The module pygame.

    Raises
    ------
    ImportError
        without pygame, with the command that installs it.
    ValueError
        for an unknown mode or a picture too small to draw on.
    """

    def __init__(
        self,
        robots: Sequence[RobotParameters],
        path_mm: np.ndarray,
        *,
        mode: str,
        fps: float,
        size_px: tuple[int, int] = DESIGN_SIZE_PX,
        trail_s: float = 20.0,
        patches: Sequence[Mapping[str, float]] = (),
        courses_mm: Sequence[np.ndarray] = (),
        close_up: int | None = 1,
        theme: Theme = LIGHT,
        table: bool = True,
        smallest_text: float = SMALLEST_TEXT,
    ) -> None:
        if not is_one_of(mode, RENDER_MODES):
            raise ValueError(f"mode {shown(mode)} is not one of {', '.join(RENDER_MODES)}")
        if min(size_px) < SMALLEST_PX:
            raise ValueError(f"size_px {size_px} must be at least {SMALLEST_PX} each way")
        self.pg = self._pg = import_pygame()
        self.theme = self._theme = theme
        self.camera = Camera()
        self._robots = list(robots)
        self._colours = robot_colours(len(robots), theme)
        self._faded = [
            [mixed(theme.floor, colour, part) for colour in self._colours]
            for part in np.linspace(0.15, 0.85, 32).tolist()
        ]
        # Inside and edge of what else is in the space, and the width of the edge; None: the floor shows.
        self._things: dict[Kind, tuple[Colour | None, Colour, float]] = {
            "loose": (theme.crate, theme.crate_edge, 1.3),
            "moving": (theme.mover, theme.mover_edge, 2.2),
            "zone": (None, theme.wall_edge, 1.3),
            "link": (None, theme.ink, 1.3),
        }
        self._patches = list(patches)
        self._courses_mm = list(courses_mm)
        self._outlines_mm = [outline_mm(robot) for robot in robots]
        self._trail_s, self._table, self._smallest_text = trail_s, table, smallest_text
        self._close_up = None if close_up is None else min(close_up, len(robots) - 1)
        self._size_px = (0, 0)
        self._drawn: np.ndarray  # tiles of the canvas that the last picture was drawn on
        self._view: View  # of the last picture
        self.begin(path_mm)
        self._open = True
        self._window = Window(self, size_px, fps) if mode == "human" else None
        self._resize(size_px)

    def begin(self, path_mm: np.ndarray) -> None:
        """Start an episode: trails and view are reset with the next scene.

        Parameters
        ----------
        path_mm
            The leader's whole reference in this episode, ``(k, 2)``.
        """
        stride = max(1, len(path_mm) // PATH_POINTS)
        self._path_mm = np.concatenate([path_mm[::stride], path_mm[-1:]])
        self._trail: list[tuple[float, np.ndarray]] = []  # time, (robot, 2)
        self._fixed: tuple[PlacedShape, ...] = ()  # what the background shows
        self._fitted: View | None = None
        self._background: Any = None

    def draw(self, scene: Scene) -> np.ndarray | None:
        """Draw a scene; an earlier time than before starts a new episode on the same path.

        Returns a new uint8 array ``(H, W, 3)`` in the mode ``"rgb_array"``, else None. Does nothing after
        :meth:`close`.
        """
        if self._window is not None:
            self._window.handle_events()
            self._open = self._open and self._window.open
        if not self._open:
            return None
        self._remember(scene)
        if self._window is not None:
            self._window.show(lambda: self._paint(scene))
            self._open = self._window.open
            return None
        self._paint(scene)
        return self._pixels()

    def paint(self, scene: Scene) -> Any:
        """Draw a scene; the picture as a surface of pygame, which the next call overwrites."""
        self._remember(scene)
        return self._paint(scene)

    def close(self) -> None:
        """Close the window; :meth:`draw` does nothing afterwards."""
        if self._open and self._window is not None:
            self._window.close()
        self._open = False

    # The view

    @property
    def robots(self) -> int:
        """Number of robots."""
        return len(self._robots)

    @property
    def colours(self) -> list[Colour]:
        """The robots' colours."""
        return list(self._colours)

    @property
    def view(self) -> View:
        """The view of the last picture, on the canvas, which is twice as large as the picture."""
        return self._view

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture."""
        return self._size_px

    @property
    def mm_per_px(self) -> float:
        """Millimetres of floor in a px of the picture."""
        return OVERSAMPLING / self._view.scale

    def place_mm(self, px: tuple[float, float]) -> tuple[float, float]:
        """The place on the floor at a px of the last picture."""
        x_mm, y_mm = self._view.corner_mm
        return x_mm + px[0] * self.mm_per_px, y_mm - px[1] * self.mm_per_px

    def px_of(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """The px of the last picture at a place on the floor."""
        left_mm, top_mm = self._view.corner_mm
        return (x_mm - left_mm) / self.mm_per_px, (top_mm - y_mm) / self.mm_per_px

    def show_patches(self, patches: Sequence[Mapping[str, float]]) -> None:
        """Show other patches of friction from the next picture on."""
        if list(patches) != self._patches:
            self._patches, self._background = list(patches), None

    def resize(self, size_px: tuple[int, int]) -> bool:
        """Draw pictures of another size from now on, if it is not too small; whether anything changed."""
        if size_px == self._size_px or min(size_px) < SMALLEST_PX:
            return False
        self._resize(size_px)
        return True

    # Picture and window

    def _resize(self, size_px: tuple[int, int]) -> None:
        pg = self._pg
        self._size_px = (max(size_px[0], SMALLEST_PX), max(size_px[1], SMALLEST_PX))
        self._canvas = pg.Surface([OVERSAMPLING * side for side in self._size_px], 0, 32)
        self._picture = pg.Surface(self._size_px, 0, 32)
        width, height = self._size_px
        self._unit = min(width / DESIGN_SIZE_PX[0], height / DESIGN_SIZE_PX[1])
        self._text_unit = max(self._unit, self._smallest_text)
        self._focus: int | None = None
        self._font, self._time_font, canvas_font = (
            pg.font.Font(None, round(size * self._text_unit))
            for size in (TEXT_PX, TIME_PX, TEXT_PX * OVERSAMPLING)
        )
        self._shapes = Shapes(pg, self._canvas, canvas_font, self._theme)
        self._fitted = self._background = None

    def _pixels(self) -> np.ndarray:
        width, height = self._size_px
        data = bytearray(self._pg.image.tobytes(self._picture, "RGB"))
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)

    def _paint(self, scene: Scene) -> Any:
        if self._fitted is None:
            self._fitted = self._fit()
        view, focus = self.camera.view(self._fitted, self._trail[-1][1]), self._in_close_up()
        if self._background is None or view != self._view or focus != self._focus:
            self._view, self._focus = view, focus
            self._background = self._draw_background()
            self._drawn = np.ones_like(self._shapes.tiles.take())
        else:
            for part in self._shapes.tiles.rectangles(self._drawn):
                self._canvas.blit(self._background, part[:2], part)
        self._draw_objects(self._view, scene)
        self._draw_robots(self._view, scene)
        self._draw_arrows(scene)
        self._draw_close_up(scene)
        self._scale_down()
        if self._table:
            self._write(scene)
        return self._picture

    def _scale_down(self) -> None:
        """Make the picture of the canvas, where anything was drawn on this one or the one before."""
        tiles, scale = self._shapes.tiles, self._pg.transform.smoothscale
        before, self._drawn = self._drawn, tiles.take()
        for left, top, width, height in tiles.rectangles(before | self._drawn):
            half = left // OVERSAMPLING, top // OVERSAMPLING, width // OVERSAMPLING
            part = self._picture.subsurface((*half, height // OVERSAMPLING))
            scale(self._canvas.subsurface((left, top, width, height)), part.get_size(), part)

    # Memory

    def _remember(self, scene: Scene) -> None:
        """Extend the trails: about ``TRAIL_POINTS`` points, equidistant in time, and the present positions."""
        places = np.stack([scene.x_mm, scene.y_mm], axis=-1)
        if not self._trail or scene.t_s < self._trail[-1][0]:
            self._trail.clear()
            self._start_mm, self._fitted = places, None
            self._world_mm = self._places_of(scene.objects)
        fixed = tuple(one for one in scene.objects if one.kind == "fixed")
        if self._fitted is None or fixed != self._fixed:
            self._fixed, self._background = fixed, None
        spacing_s = self._trail_s / TRAIL_POINTS
        if len(self._trail) > 1 and self._trail[-1][0] - self._trail[-2][0] < spacing_s:
            self._trail.pop()
        self._trail.append((scene.t_s, places))
        while self._trail[0][0] < scene.t_s - self._trail_s:
            self._trail.pop(0)

    def _places_of(self, objects: Sequence[PlacedShape]) -> list[np.ndarray]:
        """Where things are, or will go on their courses; each ``(point, 2)``, mm."""
        places = [one.border_mm() for one in objects]
        moving = [one for one in objects if one.kind == "moving"]
        reach_mm = max((np.ptp(one.border_mm(), axis=0).max() / 2 for one in moving), default=0.0)
        around_mm = reach_mm * np.array([(-1, -1), (1, 1)])
        places += [
            (course_mm[:, None] + around_mm).reshape(-1, 2) for course_mm in self._courses_mm
        ]
        return places

    # Floor

    def _fit(self) -> View:
        """The view of path, start and world: centred, or farther right beside the text."""
        radius = max(robot.outline_radius_mm for robot in self._robots)
        room, world_room = MARGIN_RADII * radius, WORLD_RADII * radius
        low, high = self._path_mm.min(axis=0), self._path_mm.max(axis=0)
        start = self._start_mm[np.isfinite(self._start_mm).all(axis=-1)]
        farthest = low - MOST_START_MM, high + MOST_START_MM
        shown = np.concatenate([self._path_mm, np.clip(start, *farthest)])
        low, high = shown.min(axis=0) - room, shown.max(axis=0) + room
        if self._world_mm:
            world = np.clip(np.concatenate(self._world_mm), *farthest)
            low = np.minimum(low, world.min(axis=0) - world_room)
            high = np.maximum(high, world.max(axis=0) + world_room)
            foot = OVERSAMPLING * self._unit * FOOT_PX / self._canvas.get_height()
            low[1] = min(low[1], world[:, 1].min() - foot * (high[1] - low[1]))
        width, height = self._canvas.get_size()
        scale = min(width / (high[0] - low[0]), height / (high[1] - low[1]))
        pen = OVERSAMPLING * self._unit
        spare = width - (high[0] - low[0]) * scale
        left = low[0] - max(spare / 2, min(spare, TABLE_PX * pen * self._table)) / scale
        top = (low[1] + high[1] + height / scale) / 2
        return View(
            left=0,
            top=0,
            width=width,
            height=height,
            corner_mm=(float(left), float(top)),
            scale=float(scale),
            pen=pen,
        )

    def _draw_background(self) -> Any:
        step_mm = round_length(GRID_PX * self._view.pen / self._view.scale)
        self._draw_floor(self._view, step_mm)
        self._draw_scale_bar(self._view, step_mm)
        if self._focus is not None:
            self._draw_legend()
        return self._canvas.copy()

    def _draw_floor(self, view: View, step_mm: float) -> None:
        self._canvas.fill(self._theme.floor, view.rect)
        for patch in self._patches:
            self._draw_patch(view, patch)
        for colour, phase in ((self._theme.half_grid, 0.5), (self._theme.grid, 0.0)):
            columns, rows = _grid_lines(view, step_mm, phase)
            for x in columns:
                self._canvas.fill(colour, (x, view.top, OVERSAMPLING, view.height))
            for y in rows:
                self._canvas.fill(colour, (view.left, y, view.width, OVERSAMPLING))
        for inside in (False, True):  # all edges first, so that none crosses the pieces of a wall
            for thing in self._fixed:
                self._draw_fixed(view, thing, inside)
        for course_mm in self._courses_mm:
            self._draw_course(view, course_mm)
        width = np.full(len(self._path_mm), PATH_PX * view.pen)
        self._shapes.lines(view, self._path_mm[:, None], width, [[self._theme.path]] * len(width))
        for patch in self._patches if view is self._view else ():
            self._label_patch(view, patch)

    def _draw_patch(self, view: View, patch: Mapping[str, float]) -> None:
        centre = view.place(patch["x_mm"], patch["y_mm"], 0.0)
        colour = self._theme.slippery if patch["scale"] < 1 else self._theme.grippy
        self._shapes.disc(centre, patch["radius_mm"] * view.scale, colour)

    def _label_patch(self, view: View, patch: Mapping[str, float]) -> None:
        centre = view.place(patch["x_mm"], patch["y_mm"], 0.0)
        colour = self._theme.slippery if patch["scale"] < 1 else self._theme.grippy
        self._shapes.label(f"µ × {patch['scale']:g}", colour, center=(centre.x, centre.y))

    def _draw_course(self, view: View, course_mm: np.ndarray) -> None:
        """The path of a moving obstacle, dashed."""
        ways = np.concatenate([[0.0], np.hypot(*np.diff(course_mm, axis=0).T).cumsum()])
        dash_mm = DASH_PX * self._view.pen / self._view.scale
        dashes = min(max(round(ways[-1] / dash_mm / 2), 1), MOST_DASHES)
        starts = np.linspace(0.0, ways[-1], dashes, endpoint=False)
        ends = np.stack([starts, starts + ways[-1] / dashes / 2], axis=-1)
        places = np.stack([np.interp(ends, ways, axis) for axis in course_mm.T], axis=-1)
        px = view.px(places)
        for dash in px[view.shows(px, 50.0 * view.pen).all(axis=-1)].tolist():
            self._shapes.stroke(dash, COURSE_PX * view.pen, self._theme.course)

    def _border_px(self, view: View, thing: PlacedShape, room: float) -> np.ndarray:
        """The border of a shape in the space, on the canvas, cut ``room`` outside the window."""
        low = np.array([view.left - room, view.top - room])
        high = low + np.array([view.width, view.height]) + 2.0 * room
        corners, radius = view.px(np.array(thing.corners_mm)) - 0.5, thing.radius_mm * view.scale
        if (corners.max(axis=0) + radius < low).any() or (
            corners.min(axis=0) - radius > high
        ).any():
            return np.zeros((0, 2))
        return clipped(view.px(thing.border_mm()) - 0.5, low, high)

    def _draw_fixed(self, view: View, thing: PlacedShape, inside: bool) -> None:
        """The inside of what stands fast, or the line around it."""
        width = 2.0 * EDGE_LINE_PX * view.pen
        points = self._border_px(view, thing, 2.0 * width).tolist()
        if inside and len(points) > 2:
            self._shapes.fill(points, self._theme.wall)
        elif points and not inside:
            self._shapes.stroke(points, width, self._theme.wall_edge)

    def _draw_thing(self, view: View, thing: PlacedShape) -> None:
        """What does not stand fast; what can be pushed has its diagonals marked if it has four corners."""
        fill, edge, line = self._things[thing.kind]
        width = line * view.pen
        points = self._border_px(view, thing, 4.0 * width).tolist()
        if not points:
            return
        if fill is not None and len(points) > 2:
            self._shapes.fill(points, fill)
        corners = view.px(np.array(thing.corners_mm)) - 0.5
        if thing.kind == "loose" and len(corners) == len(points) == 4:
            for ends in (corners[::2], corners[1::2]):
                self._shapes.stroke(ends.tolist(), 0.8 * width, mixed(self._theme.crate, edge, 0.5))
        self._shapes.stroke(points, width, edge)

    def _draw_objects(self, view: View, scene: Scene) -> None:
        """Everything in the space that the background does not show."""
        for thing in scene.objects:
            if thing.kind != "fixed":
                self._draw_thing(view, thing)

    def _draw_scale_bar(self, view: View, length_mm: float) -> None:
        pen, length = self._view.pen, length_mm * view.scale
        right, bottom = view.left + view.width, view.top + view.height
        x, y = right - EDGE_PX * pen - length, bottom - EDGE_PX * pen
        self._canvas.fill(self._theme.ink, (x, y - pen, length, 2 * pen))
        for end in (x, x + length - 2 * pen):
            self._canvas.fill(self._theme.ink, (end, y - 4 * pen, 2 * pen, 8 * pen))
        text = f"{length_mm:g} mm" if length_mm < 1000 else f"{length_mm / 1000:g} m"
        self._shapes.label(text, midbottom=(x + length / 2, y - 4 * pen))

    # Robots

    def _draw_robots(self, view: View, scene: Scene) -> None:
        self._draw_trails(view)
        room = 2 * view.scale * max(robot.outline_radius_mm for robot in self._robots)
        for draw, x_mm, y_mm, theta_rad in (
            (self._draw_robot, scene.x_mm, scene.y_mm, scene.theta_rad),
            (self._draw_ghost, scene.ghost_x_mm, scene.ghost_y_mm, scene.ghost_theta_rad),
            (
                self._draw_reference,
                scene.reference_x_mm,
                scene.reference_y_mm,
                scene.reference_theta_rad,
            ),
        ):
            shown = view.shows(view.px(np.stack([x_mm, y_mm], axis=-1)), room)
            for i in np.flatnonzero(shown).tolist():
                draw(view, view.place(x_mm[i], y_mm[i], theta_rad[i]), scene, i)

    def _draw_trails(self, view: View) -> None:
        """Older parts are thinner and paler; the newest parts of all robots are on top."""
        if len(self._trail) < 2:
            return
        points = np.stack([places for _, places in self._trail])
        age_s = self._trail[-1][0] - np.array([t_s for t_s, _ in self._trail])
        recency = 1 - age_s / self._trail_s
        shades = (recency[::BLOCK] * (len(self._faded) - 1)).astype(int).tolist()
        colours = [self._faded[shade] for shade in shades]
        self._shapes.lines(view, points, TRAIL_PX * view.pen * recency, colours)

    def _draw_robot(self, view: View, body: Place, scene: Scene, number: int) -> None:
        robot, colour, pen = self._robots[number], self._colours[number], view.pen
        centre, half = body.at(0, -robot.outline_offset_mm), robot.axle_width_mm / 2
        radius = view.scale * robot.outline_radius_mm
        fill, edge = (
            mixed(self._theme.floor, colour, self._theme.body),
            mixed(self._theme.floor, colour, 0.6),
        )
        if robot.outline_polygon_mm is None:
            self._shapes.disc(centre, radius + 0.6 * pen, edge)
            self._shapes.disc(centre, radius - 0.6 * pen, fill)
        else:
            outline = body.px(self._outlines_mm[number].tolist())
            self._shapes.fill(outline, fill)
            self._shapes.stroke(outline, 1.2 * pen, edge)
        self._shapes.bar(
            body,
            (2 * half * view.scale, AXLE_MM * view.scale),
            mixed(self._theme.floor, colour, 0.6),
        )
        ahead = front_mm(robot)
        self._shapes.fill(body.px((ahead * e, ahead * f) for e, f in NOSE), colour)
        fork = body.at(0, -robot.castor_pivot_mm, scene.castor_rad[number])
        castor = fork.at(0, -robot.castor_trail_mm)
        self._draw_tyre(
            view, castor, CASTOR_WIDTH_MM, robot.castor_radius_mm, scene.slip_c_mm_s[number]
        )
        for e, angle, slip in (
            (-half, scene.wheel_angle_l_rad[number], scene.slip_l_mm_s[number]),
            (half, scene.wheel_angle_r_rad[number], scene.slip_r_mm_s[number]),
        ):
            wheel = body.at(e, 0)
            self._draw_tyre(view, wheel, DRIVE_WHEEL_WIDTH_MM, robot.wheel_radius_mm, slip)
            self._draw_treads(wheel, robot.wheel_radius_mm, angle)
        if scene.touched[number]:
            self._draw_outline(number, body, 2.5 * pen, self._theme.alarm)
        if scene.lost[number]:
            self._shapes.cross(
                centre.at(0, 0, math.pi / 4), 0.9 * radius, 2.5 * pen, self._theme.alarm
            )

    def _draw_outline(self, number: int, body: Place, width: float, colour: Colour) -> None:
        """The line of a robot's outline."""
        robot = self._robots[number]
        if robot.outline_polygon_mm is None:
            centre = body.at(0, -robot.outline_offset_mm)
            self._shapes.ring(centre, robot.outline_radius_mm * body.scale, width, colour)
        else:
            self._shapes.stroke(body.px(self._outlines_mm[number].tolist()), width, colour)

    def _draw_tyre(
        self, view: View, wheel: Place, width_mm: float, radius_mm: float, slip_mm_s: float
    ) -> None:
        """A wheel from above, with a coloured halo if it slips."""
        width, length = width_mm * view.scale, 2 * radius_mm * view.scale
        strength = 0.0
        if slip_mm_s > SLIP_SHOWN_MM_S:
            strength = min(0.45 + 0.55 * slip_mm_s / SLIP_FULL_MM_S, 1.0)
            halo = 4.0 * view.pen
            self._shapes.bar(
                wheel,
                (width + halo, length + halo),
                mixed(self._theme.floor, self._theme.alarm, 0.5 * strength),
            )
        self._shapes.bar(
            wheel, (width, length), mixed(self._theme.tyre, self._theme.alarm, strength)
        )

    def _draw_treads(self, wheel: Place, radius_mm: float, angle: float) -> None:
        """Foreshortened marks on the upper side of a wheel; they move forward when it rolls."""
        for k in range(TREADS):
            turn = angle + 2 * math.pi * k / TREADS
            if math.cos(turn) > 0.3:
                thickness = TREAD_RADII * radius_mm * math.cos(turn) * wheel.scale
                size = DRIVE_WHEEL_WIDTH_MM * wheel.scale, thickness
                self._shapes.bar(wheel.at(0, radius_mm * math.sin(turn)), size, self._theme.tread)

    def _draw_ghost(self, view: View, body: Place, scene: Scene, number: int) -> None:
        """The predecessor's outline one gap ago with a tick at its front, in the follower's colour."""
        robot, line = self._robots[number - 1], 1.3 * view.pen
        radius = robot.outline_radius_mm
        self._draw_outline(number - 1, body, line, self._colours[number])
        front = body.at(0, front_mm(robot) + 0.1 * radius)
        self._shapes.bar(front, (line, 0.2 * radius * view.scale), self._colours[number])

    def _draw_reference(self, view: View, place: Place, scene: Scene, number: int) -> None:
        """A cross with arms along the reference's axes."""
        arm = ARM_RADII * self._robots[number].outline_radius_mm * view.scale
        self._shapes.cross(place, arm, 1.2 * view.pen, self._theme.ink)

    def _draw_arrows(self, scene: Scene) -> None:
        """An arrow and a name at the edge for every robot outside the view."""
        view, pen = self._view, self._view.pen
        places = view.px(np.stack([scene.x_mm, scene.y_mm], axis=-1))
        size = np.array([view.width, view.height])
        for i in np.flatnonzero(np.isfinite(places).all(axis=-1) & ~view.shows(places)).tolist():
            right, down = places[i] - size / 2
            x, y = np.clip(places[i], 5 * pen, size - 5 * pen).tolist()
            arrow = Place(x, y, math.atan2(-right, -down), pen)
            self._shapes.fill(arrow.px([(0, 0), (-7, -16), (7, -16)]), self._colours[i])
            name = arrow.at(0, -28 - 22 * abs(math.sin(arrow.theta)))
            middle = min(max(name.x, 36 * pen), view.width - 36 * pen)
            self._shapes.label(f"robot_{i}", center=(middle, name.y))

    # Close-up

    def _in_close_up(self) -> int | None:
        """The robot in the close-up: the one that is followed, or else the usual one."""
        if self._close_up is None or self._unit < SMALLEST_CLOSE_UP:
            return None
        return self._close_up if self.camera.follow is None else self.camera.follow

    def _close_up_view(self, number: int, scene: Scene) -> View:
        u, robot = self._unit, self._robots[number]
        side = OVERSAMPLING * round(CLOSE_UP_PX * u)
        left = OVERSAMPLING * round(EDGE_PX * u)
        top = self._view.height - side - OVERSAMPLING * round((EDGE_PX + 3 * LINE_PX) * u)
        extent_mm = CLOSE_UP_RADII * robot.outline_radius_mm
        back_mm = robot.outline_offset_mm
        middle_x = float(scene.x_mm[number] + back_mm * np.sin(scene.theta_rad[number]))
        middle_y = float(scene.y_mm[number] - back_mm * np.cos(scene.theta_rad[number]))
        corner_mm = (middle_x - extent_mm / 2, middle_y + extent_mm / 2)
        pen = CLOSE_UP_PEN * self._view.pen
        return View(
            left=left,
            top=top,
            width=side,
            height=side,
            corner_mm=corner_mm,
            scale=side / extent_mm,
            pen=pen,
        )

    def _draw_close_up(self, scene: Scene) -> None:
        i = self._focus
        if i is None or not math.isfinite(scene.x_mm[i] + scene.y_mm[i] + scene.theta_rad[i]):
            return
        view = self._close_up_view(i, scene)
        self._canvas.set_clip(view.rect)
        step_mm = round_length(CLOSE_UP_RADII * self._robots[i].outline_radius_mm / 5)
        self._draw_floor(view, step_mm)
        self._draw_objects(view, scene)
        self._draw_robots(view, scene)
        self._draw_scale_bar(view, step_mm)
        self._shapes.label(
            f"robot_{i}", topleft=(view.left + 6 * self._view.pen, view.top + 6 * self._view.pen)
        )
        self._canvas.set_clip(None)
        self._shapes.tiles.add(self._pg.Rect(view.rect).inflate(4, 4))
        self._pg.draw.rect(
            self._canvas, mixed(self._theme.floor, self._theme.ink, 0.5), view.rect, OVERSAMPLING
        )

    def _draw_legend(self) -> None:
        """The legend under the close-up."""
        pen = self._view.pen
        x, y = (EDGE_PX + 8) * pen, self._view.height - (EDGE_PX + 2.3 * LINE_PX) * pen
        mark, below = Place(x, y, 0.0, 1.0), -LINE_PX * pen
        self._shapes.cross(mark, 6 * pen, 1.3 * pen, self._theme.ink)
        self._shapes.label("reference", midleft=(x + 12 * pen, y))
        mark = mark.at(0, below)
        self._shapes.bar(
            mark, (9 * pen, 14 * pen), mixed(self._theme.floor, self._theme.alarm, 0.5)
        )
        self._shapes.bar(mark, (5 * pen, 10 * pen), self._theme.alarm)
        self._shapes.label("slipping wheel", midleft=(x + 12 * pen, mark.y))
        if len(self._robots) > 1:
            mark = mark.at(0, below)
            colour = self._colours[self._focus or 1]
            self._shapes.ring(mark, 6 * pen, 1.5 * pen, colour)
            self._shapes.label("predecessor one gap ago", midleft=(x + 12 * pen, mark.y))

    # Text

    def _write(self, scene: Scene) -> None:
        u = self._text_unit
        top, bottom = (EDGE_PX + 1.7 * LINE_PX) * u, self._size_px[1] - EDGE_PX * u
        if self._focus is not None:
            bottom -= (CLOSE_UP_PX + 4 * LINE_PX) * u
        rows = min(len(self._robots), max(int((bottom - top) / (LINE_PX * u)), 1))
        plate = self._pg.Surface((TABLE_PX * u, top + rows * LINE_PX * u), self._pg.SRCALPHA)
        plate.fill((*self._theme.floor, PLATE_ALPHA))
        self._put(plate, (0, 0))
        time = self._time_font.render(f"t = {scene.t_s:.2f} s", True, self._theme.ink)
        self._put(time, (EDGE_PX * u, EDGE_PX * u))
        for i in range(rows):
            self._write_robot(scene, i, top + i * LINE_PX * u)

    def _write_robot(self, scene: Scene, number: int, y: float) -> None:
        """One line: colour, name, position error, time-gap error, lost, touched and by what."""
        u = self._text_unit
        x = EDGE_PX * u
        self._pg.draw.aacircle(self._picture, self._colours[number], (x + 5 * u, y + 6 * u), 5 * u)
        gap = f"{scene.time_gap_error_s[number]:+.3f} s" if number > 0 else ""
        flags = ["lost"] if scene.lost[number] else []
        if scene.touched[number]:
            flags.append(f"touched {touched_name(int(scene.touched_by[number])) or ''}".strip())
        texts = (
            f"robot_{number}",
            _length_text(scene.position_error_mm[number]),
            gap,
            ", ".join(flags),
        )
        sides = ("topleft", "topright", "topright", "topleft")
        for text, column, side in zip(texts, COLUMNS_PX, sides, strict=True):
            if not text:
                continue
            colour = self._theme.alarm if column == COLUMNS_PX[-1] else self._theme.ink
            image = self._font.render(text, True, colour)
            self._put(image, image.get_rect(**{side: (x + column * u, y)}))

    def _put(self, image: Any, place: Any) -> None:
        """An image on the picture, in which the next one replaces it."""
        rect = self._picture.blit(image, place)
        scaled = (OVERSAMPLING * side for side in rect)
        tiles = self._shapes.tiles
        tiles.add(self._pg.Rect(*scaled))
        self._drawn |= tiles.take()


def stage_of(formation: Formation) -> dict[str, Any]:
    """What a :class:`Renderer` has to know of a formation after its reset, as keyword arguments; copies."""
    scenario = formation.scenario
    return {
        "robots": scenario.robot_models,
        "path_mm": formation.leader_path().copy(),
        "fps": 1 / scenario.control_period_s,
        "patches": patches_of(formation),
        "courses_mm": [thing.corners_mm() for thing in scenario.world.moving],
    }


def renderer_of(formation: Formation, *, mode: str = "rgb_array", **options: Any) -> Renderer:
    """A renderer for a formation after its reset; ``options`` as of :class:`Renderer`."""
    return Renderer(**{**stage_of(formation), "mode": mode, **options})


def round_length(least: float) -> float:
    """The smallest of 1, 2, 5, 10, 20 … that is at least ``least``."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(digit * power for digit in (1, 2, 5, 10) if digit * power >= least)


def _grid_lines(view: View, step_mm: float, phase: float) -> tuple[list[int], list[int]]:
    """Canvas coordinates of the lines x and y = (k + phase)·step, at whole px of the picture."""
    x_mm, y_mm = view.corner_mm
    columns = np.arange(math.floor(x_mm / step_mm), (x_mm + view.width / view.scale) / step_mm)
    rows = np.arange(
        math.floor(y_mm / step_mm), (y_mm - view.height / view.scale) / step_mm - 1, -1
    )
    x = view.left + ((columns + phase) * step_mm - x_mm) * view.scale
    y = view.top + (y_mm - (rows + phase) * step_mm) * view.scale
    whole = ((axis / OVERSAMPLING).round().astype(int) * OVERSAMPLING for axis in (x, y))
    columns_px, rows_px = (axis.tolist() for axis in whole)
    return columns_px, rows_px


def _length_text(length_mm: float) -> str:
    return f"{length_mm:.1f} mm" if length_mm < 1000 else f"{length_mm / 1000:.2f} m"


def import_pygame() -> Any:
    """The module pygame, with its fonts ready.

    Raises
    ------
    ImportError
        if it is not installed, with the command that installs it.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise ImportError(f"rendering needs pygame: {install_command('view')}") from error
    pygame.font.init()
    return pygame
