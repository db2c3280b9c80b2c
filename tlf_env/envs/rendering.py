"""The formation from above, to scale, drawn with pygame-ce (the extra ``view``) onto plain surfaces.

Everything is drawn twice as large as it is shown and scaled down: that smooths every edge.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from tlf_env.onboard.observer import Reference
from tlf_env.physics.parameters import RobotParameters
from tlf_env.physics.state import Contact, Motion
from tlf_env.task.arrays import Info, State
from tlf_env.task.formation import Formation

Mode = Literal["rgb_array", "human"]
Colour = tuple[int, int, int]

RENDER_MODES: tuple[Mode, ...] = ("rgb_array", "human")
OVERSAMPLING = 2
DESIGN_SIZE_PX = (960, 720)  # lengths in px below are for this size and grow with it
SMALLEST_PX = 64

FLOOR: Colour = (252, 252, 250)
GRID: Colour = (222, 224, 226)
HALF_GRID: Colour = (239, 240, 241)
PATH: Colour = (188, 190, 193)
INK: Colour = (60, 62, 66)
TYRE: Colour = (48, 50, 54)
TREAD: Colour = (205, 208, 212)
ALARM: Colour = (236, 0, 84)  # slip, lost, touched: no robot has it
SLIPPERY: Colour = (214, 233, 246)
GRIPPY: Colour = (247, 232, 210)
# Okabe and Ito's colours but yellow; more robots go along viridis. The figures have the same.
FEW_COLOURS: tuple[Colour, ...] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 0, 0),
    (86, 180, 233),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
)
VIRIDIS = np.array(
    [
        (68, 1, 84),
        (71, 44, 122),
        (59, 81, 139),
        (44, 113, 142),
        (33, 144, 141),
        (39, 173, 129),
        (92, 200, 99),
        (170, 220, 50),
        (253, 231, 37),
    ]
)
LIGHTEST = 0.92  # of the map; its end is lost on white

DRIVE_WHEEL_WIDTH_MM, CASTOR_WIDTH_MM = 22.0, 14.0  # for the picture only
TREADS = 4  # few: more would seem to turn backwards at top speed and 20 frames/s
SLIP_SHOWN_MM_S, SLIP_FULL_MM_S = 2.0, 60.0  # where a wheel's mark begins, and where it is strongest

MARGIN_RADII = 3.0  # room around the path, in outline radii
MOST_START_MM = 1500.0  # how far the view grows towards robots that start off the path
TRAIL_POINTS = 120
PATH_POINTS = 1500
TRAIL_PX, PATH_PX = 5.0, 2.0
CLOSE_UP_PX, CLOSE_UP_RADII = 208, 4.0  # side of the close-up; how much floor, in outline radii
EDGE_PX = 14
GRID_PX = 90  # least side of a grid square
TEXT_PX, TIME_PX = 15, 22
LINE_PX = 19


class Scene(NamedTuple):
    """Everything that one frame shows. A row of each array is a robot; units mm, rad, s.

    Poses are those of the axle midpoint c; headings counter-clockwise from +y.
    """

    t_s: float
    x_mm: np.ndarray
    y_mm: np.ndarray
    theta_rad: np.ndarray
    castor_rad: np.ndarray  # fork angle relative to the body
    wheel_angle_l_rad: np.ndarray
    wheel_angle_r_rad: np.ndarray
    reference_x_mm: np.ndarray  # each robot's own reference
    reference_y_mm: np.ndarray
    reference_theta_rad: np.ndarray
    ghost_x_mm: np.ndarray  # the predecessor one gap ago; NaN where there is none
    ghost_y_mm: np.ndarray
    ghost_theta_rad: np.ndarray
    slip_l_mm_s: np.ndarray
    slip_r_mm_s: np.ndarray
    slip_c_mm_s: np.ndarray
    position_error_mm: np.ndarray
    time_gap_error_s: np.ndarray
    lost: np.ndarray  # bool
    touched: np.ndarray  # bool


def scene_of(formation: Formation) -> Scene:
    """The scene of a formation as it is now: the truth, in fresh arrays."""
    a = formation.arrays
    motion = Motion(*a.motions[:, :, 0].copy())
    contact = Contact(*a.contacts[:, :, 0].copy())
    state = State(*formation.state().T)
    slot = formation.step_count % a.references.shape[1]
    reference = Reference(*a.references[:, slot, :, 0].copy())
    info = Info(*a.infos[0].T.copy())
    return Scene(
        formation.time_s,
        state.x_mm,
        state.y_mm,
        motion.theta,
        state.castor_rad,
        motion.angle_l,
        motion.angle_r,
        reference.x,
        reference.y,
        reference.theta,
        *_ghosts(formation, motion.theta),
        contact.slip_l,
        contact.slip_r,
        contact.slip_c,
        info.position_error_mm,
        info.time_gap_error_s,
        a.lost[0].copy(),
        a.touched[0].copy(),
    )


def _ghosts(formation: Formation, theta: np.ndarray) -> np.ndarray:
    """Pose of every robot's predecessor one gap ago, ``(3, robot)``.

    Its heading is the direction it went; where it stood still, the one it has now.
    """
    paths = formation.arrays.paths[:, :, :-1, 0]  # of the predecessors
    ghosts = np.full((3, len(theta)), np.nan)
    step = formation.step_count - formation.scenario.gap_steps
    if step < 0 or len(theta) == 1:
        return ghosts
    slots = paths.shape[1]
    went_x, went_y = paths[:, (step + 1) % slots] - paths[:, max(step - 1, 0) % slots]
    ghosts[:2, 1:] = paths[:, step % slots]
    moved = np.hypot(went_x, went_y) > 1e-3
    ghosts[2, 1:] = np.where(moved, np.arctan2(-went_x, went_y), theta[:-1])
    return ghosts


def robot_colours(robots: int) -> list[Colour]:
    """Colours that colour-blind eyes can tell apart, as in the figures of a run."""
    if robots <= len(FEW_COLOURS):
        return list(FEW_COLOURS[:robots])
    along = LIGHTEST * np.linspace(0, len(VIRIDIS) - 1, robots)
    channels = [np.interp(along, np.arange(len(VIRIDIS)), channel) for channel in VIRIDIS.T]
    return [(round(r), round(g), round(b)) for r, g, b in zip(*channels, strict=True)]


class View(NamedTuple):
    """Where the floor lies on the canvas: a window of it, all lengths in canvas px unless said."""

    left: int
    top: int
    width: int
    height: int
    corner_mm: tuple[float, float]  # x of the left edge, y of the top edge
    scale: float  # px per mm
    pen: float  # px per px of the finished picture

    def px(self, points_mm: np.ndarray) -> np.ndarray:
        """Canvas coordinates of points ``(..., 2)``; half a px on, since pygame cuts fractions off."""
        offset = np.array([self.left, self.top]) + 0.5
        return (points_mm - self.corner_mm) * [self.scale, -self.scale] + offset

    def mm(self, length_px: float) -> float:
        """Length on the floor of a length in the finished picture."""
        return length_px * self.pen / self.scale

    def shows(self, px: np.ndarray, room: float) -> np.ndarray:
        """Which canvas points lie in the window or at most ``room`` px beside it; NaN never does."""
        x, y = px[..., 0] - self.left, px[..., 1] - self.top
        return (x > -room) & (x < self.width + room) & (y > -room) & (y < self.height + room)

    @property
    def rect(self) -> tuple[int, int, int, int]:
        """The window, as pygame takes rectangles."""
        return self.left, self.top, self.width, self.height


class Renderer:
    """Draws scenes of one formation, and remembers where the robots were.

    Parameters
    ----------
    robots
        Each robot's measures.
    path_mm
        The leader's whole reference, ``(k, 2)``. The view is fixed to it and to the robots' start;
        a robot that leaves the view shows as an arrow at its edge.
    mode
        ``"rgb_array"`` returns frames and needs no display; ``"human"`` shows them in a window, at
        ``fps`` frames per second at most.
    fps
        Frames per second.
    size_px
        Width and height of the picture.
    trail_s
        How long the robots' trails are.
    patches
        Round patches of other friction: mappings of ``x_mm``, ``y_mm``, ``radius_mm`` and ``scale``.
    close_up
        The robot to draw large in a corner, or None. Where there is no such robot, the last.

    Raises
    ------
    ImportError
        without pygame, saying how to install it.
    ValueError
        for an unknown mode or a size too small to draw on.
    """

    def __init__(
        self,
        robots: Sequence[RobotParameters],
        path_mm: np.ndarray,
        *,
        mode: Mode,
        fps: float,
        size_px: tuple[int, int] = DESIGN_SIZE_PX,
        trail_s: float = 20.0,
        patches: Sequence[Mapping[str, float]] = (),
        close_up: int | None = 1,
    ) -> None:
        if mode not in RENDER_MODES:
            raise ValueError(f"mode {mode!r} is not one of {', '.join(RENDER_MODES)}")
        if min(size_px) < SMALLEST_PX:
            raise ValueError(f"size_px {size_px} must be at least {SMALLEST_PX} each way")
        self._pg = _pygame()
        self._robots = list(robots)
        self._shapes = [_shapes(robot) for robot in robots]
        self._colours = robot_colours(len(robots))
        stride = max(1, len(path_mm) // PATH_POINTS)
        self._path_mm = np.concatenate([path_mm[::stride], path_mm[-1:]])[:, None]
        self._patches = list(patches)
        self._mode, self._fps, self._trail_s = mode, fps, trail_s
        self._focus = None if close_up is None else min(close_up, len(robots) - 1)
        self._trail: list[tuple[float, np.ndarray]] = []  # time, (robot, 2)
        self._start_mm = np.empty((0, 2))
        self._open = True
        self._window: Any = None
        if mode == "human":
            self._open_window(size_px)
        self._resize(size_px)

    def draw(self, scene: Scene) -> np.ndarray | None:
        """Draw a scene.

        A scene whose time goes back begins a new episode. Returns a fresh uint8 ``(H, W, 3)`` in the
        mode ``"rgb_array"``, else None; also None, and nothing happens, once closed.
        """
        if self._window is not None:
            self._handle_events()
        if not self._open:
            return None
        self._remember(scene)
        if self._background is None:
            self._background = self._draw_background()
        self._canvas.blit(self._background, (0, 0))
        self._draw_robots(self._view, scene)
        if self._focus is not None:
            self._draw_close_up(self._focus, scene)
        self._pg.transform.smoothscale(self._canvas, self._size_px, self._frame)
        self._write(scene)
        if self._window is None:
            return self._pixels()
        self._window.blit(self._frame, (0, 0))
        self._pg.display.flip()
        self._clock.tick(self._fps)
        return None

    def close(self) -> None:
        """Close the window. Drawing does nothing from now on."""
        self._open = False
        if self._window is not None:
            self._window = None
            self._pg.display.quit()

    # The window

    def _open_window(self, size_px: tuple[int, int]) -> None:
        self._pg.display.init()
        self._window = self._pg.display.set_mode(size_px, self._pg.RESIZABLE)
        self._pg.display.set_caption("tlf_env")
        self._clock = self._pg.time.Clock()

    def _handle_events(self) -> None:
        for event in self._pg.event.get():
            if event.type == self._pg.QUIT:
                self.close()
                return
            if event.type == self._pg.VIDEORESIZE:
                self._window = self._pg.display.get_surface()
                self._resize(self._window.get_size())

    def _resize(self, size_px: tuple[int, int]) -> None:
        pg = self._pg
        self._size_px = (max(size_px[0], SMALLEST_PX), max(size_px[1], SMALLEST_PX))
        width, height = (OVERSAMPLING * side for side in self._size_px)
        self._canvas = pg.Surface((width, height), 0, 32)
        self._frame = pg.Surface(self._size_px, 0, 32)
        size = np.array(self._size_px) / DESIGN_SIZE_PX
        self._unit = float(size.min())  # px per px of the design
        self._font = pg.font.Font(None, max(9, round(TEXT_PX * 1.25 * self._unit)))
        self._time_font = pg.font.Font(None, max(11, round(TIME_PX * 1.25 * self._unit)))
        self._large_font = pg.font.Font(
            None, OVERSAMPLING * max(9, round(TEXT_PX * 1.15 * self._unit))
        )
        self._background: Any = None

    def _pixels(self) -> np.ndarray:
        width, height = self._size_px
        flat = np.frombuffer(bytearray(self._pg.image.tobytes(self._frame, "RGB")), np.uint8)
        return flat.reshape(height, width, 3)

    # Memory

    def _remember(self, scene: Scene) -> None:
        """Add to the trails; one point in each of ``TRAIL_POINTS`` parts of a trail's time stays."""
        places = np.stack([scene.x_mm, scene.y_mm], axis=-1)
        if not self._trail or scene.t_s < self._trail[-1][0]:
            self._trail.clear()
            self._start_mm = places
            self._background = None
        every_s = self._trail_s / TRAIL_POINTS
        if len(self._trail) > 1 and self._trail[-1][0] - self._trail[-2][0] < every_s:
            self._trail.pop()
        self._trail.append((scene.t_s, places))
        while self._trail[0][0] < scene.t_s - self._trail_s:
            self._trail.pop(0)

    # The floor

    def _fit(self) -> View:
        """The view of the path and of the start; spare width is left of it, where the text is."""
        room = MARGIN_RADII * max(robot.outline_radius_mm for robot in self._robots)
        path = self._path_mm[:, 0]
        low, high = path.min(axis=0), path.max(axis=0)
        start = np.clip(self._start_mm, low - MOST_START_MM, high + MOST_START_MM)
        low = np.minimum(low, start.min(axis=0)) - room
        high = np.maximum(high, start.max(axis=0)) + room
        size = OVERSAMPLING * np.array(self._size_px)
        scale = float((size / (high - low)).min())
        spare_mm = size / scale - (high - low)
        corner = (float(low[0] - spare_mm[0]), float(high[1] + spare_mm[1] / 2))
        return View(0, 0, int(size[0]), int(size[1]), corner, scale, OVERSAMPLING * self._unit)

    def _draw_background(self) -> Any:
        self._view = view = self._fit()
        step_m = _round_length_m(view.mm(GRID_PX))
        self._draw_floor(view, step_m)
        self._draw_scale_bar(view, step_m)
        if self._focus is not None:
            self._draw_legend()
        return self._canvas.copy()

    def _draw_floor(self, view: View, step_m: float) -> None:
        canvas = self._canvas
        canvas.fill(FLOOR, view.rect)
        for patch in self._patches:
            self._draw_patch(view, patch)
        step_mm = 1000 * step_m
        for colour, phase in ((HALF_GRID, 0.5), (GRID, 0.0)):
            for x in view.px(_grid(view, step_mm, phase)[0])[:, 0].astype(int).tolist():
                canvas.fill(colour, (x, view.top, OVERSAMPLING, view.height))
            for y in view.px(_grid(view, step_mm, phase)[1])[:, 1].astype(int).tolist():
                canvas.fill(colour, (view.left, y, view.width, OVERSAMPLING))
        width_mm = np.full(len(self._path_mm), view.mm(PATH_PX))
        self._ribbons(view, self._path_mm, width_mm, lambda j, i: PATH)

    def _draw_patch(self, view: View, patch: Mapping[str, float]) -> None:
        centre = np.array([patch["x_mm"], patch["y_mm"]])
        colour = SLIPPERY if patch["scale"] < 1 else GRIPPY
        self._fill(view, centre + patch["radius_mm"] * CIRCLE, colour)
        if view.shows(view.px(centre), 0):
            label = self._large_font.render(f"µ × {patch['scale']:g}", True, INK)
            self._canvas.blit(label, label.get_rect(center=view.px(centre).tolist()))

    def _draw_scale_bar(self, view: View, length_m: float) -> None:
        pen, length = view.pen, 1000 * length_m * view.scale
        x, y = view.width - EDGE_PX * pen - length, view.height - EDGE_PX * pen
        self._canvas.fill(INK, (x, y - pen, length, 2 * pen))
        for end in (x, x + length - 2 * pen):
            self._canvas.fill(INK, (end, y - 4 * pen, 2 * pen, 8 * pen))
        label = self._large_font.render(f"{length_m:g} m", True, INK)
        self._canvas.blit(label, label.get_rect(midbottom=(x + length / 2, y - 4 * pen)))

    # Robots

    def _draw_robots(self, view: View, scene: Scene) -> None:
        """Trails first, then the robots, then what they should cover."""
        self._draw_trails(view)
        places = np.stack([scene.x_mm, scene.y_mm], axis=-1)
        room = 2 * view.scale * max(robot.outline_radius_mm for robot in self._robots)
        shown = view.shows(view.px(places), room)
        for i in np.flatnonzero(shown)[::-1].tolist():
            self._draw_robot(view, scene, i)
        for i in range(len(self._robots)):
            self._draw_ghost(view, scene, i)
            self._draw_reference(view, scene, i)

    def _draw_trails(self, view: View) -> None:
        """Coloured at the robot, thinner and paler the older; the youngest on top."""
        points = np.stack([places for _, places in self._trail])
        if len(points) < 2:
            return
        times = np.array([t_s for t_s, _ in self._trail])
        youth = 1 - (times[-1] - times) / self._trail_s
        colours = [
            [_mixed(FLOOR, colour, 0.15 + 0.7 * y) for colour in self._colours]
            for y in youth[1:].tolist()
        ]
        self._ribbons(view, points, view.mm(TRAIL_PX) * youth, lambda j, i: colours[j][i])

    def _draw_robot(self, view: View, scene: Scene, i: int) -> None:
        robot, shapes, colour = self._robots[i], self._shapes[i], self._colours[i]
        at = _placement(scene.x_mm[i], scene.y_mm[i], scene.theta_rad[i])
        line = view.mm(1.4)
        self._fill(view, at(shapes.outline(line / 2)), _mixed(FLOOR, colour, 0.85))
        self._fill(view, at(shapes.outline(-line / 2)), _mixed(FLOOR, colour, 0.25))
        self._fill(view, at(shapes.axle), _mixed(FLOOR, colour, 0.6))
        self._fill(view, at(shapes.nose), colour)
        fork = at(shapes.pivot).reshape(2)
        castor = _placement(fork[0], fork[1], scene.theta_rad[i] + scene.castor_rad[i])
        self._draw_wheel(view, castor(shapes.castor), scene.slip_c_mm_s[i])
        half = robot.axle_width_mm / 2
        wheels = (
            (-half, scene.wheel_angle_l_rad[i], scene.slip_l_mm_s[i]),
            (half, scene.wheel_angle_r_rad[i], scene.slip_r_mm_s[i]),
        )
        for across, angle, slip in wheels:
            tyre = _rectangle(DRIVE_WHEEL_WIDTH_MM, 2 * robot.wheel_radius_mm) + [across, 0]
            self._draw_wheel(view, at(tyre), slip)
            for tread in _treads(robot.wheel_radius_mm, angle):
                self._fill(view, at(tread + [across, 0]), TREAD)
        if scene.touched[i]:
            self._fill(view, at(shapes.ring(view.mm(3.0))), ALARM)
        if scene.lost[i]:
            for bar in _cross(1.1 * robot.outline_radius_mm, view.mm(3.0), turn=np.pi / 4):
                self._fill(view, at(bar + shapes.centre), ALARM)

    def _draw_wheel(self, view: View, tyre: np.ndarray, slip_mm_s: float) -> None:
        if not slip_mm_s > SLIP_SHOWN_MM_S:
            self._fill(view, tyre, TYRE)
            return
        strength = min(0.45 + 0.55 * slip_mm_s / SLIP_FULL_MM_S, 1.0)
        middle = tyre.mean(axis=0)
        away = tyre - middle
        halo = middle + away + view.mm(2.5) * np.sign(away @ _axes(tyre)) @ _axes(tyre).T
        self._fill(view, halo, _mixed(FLOOR, ALARM, 0.45 * strength))
        self._fill(view, tyre, _mixed(TYRE, ALARM, strength))

    def _draw_ghost(self, view: View, scene: Scene, i: int) -> None:
        place = scene.ghost_x_mm[i], scene.ghost_y_mm[i]
        if i == 0 or not view.shows(view.px(np.array(place)), 0):
            return
        at = _placement(*place, scene.ghost_theta_rad[i])
        shapes, colour = self._shapes[i - 1], _mixed(FLOOR, self._colours[i], 0.8)
        self._fill(view, at(shapes.ring(view.mm(1.2))), colour)

    def _draw_reference(self, view: View, scene: Scene, i: int) -> None:
        place = scene.reference_x_mm[i], scene.reference_y_mm[i]
        if not view.shows(view.px(np.array(place)), 0):
            return
        at = _placement(*place, scene.reference_theta_rad[i])
        arm = 0.35 * self._robots[i].outline_radius_mm
        for width, colour in ((view.mm(3.0), FLOOR), (view.mm(1.3), INK)):
            for bar in _cross(arm, width):
                self._fill(view, at(bar), colour)

    # Close-up

    @property
    def _close_up_px(self) -> tuple[int, int, int]:
        """Left, top and side of the close-up in the finished picture."""
        side, edge = round(CLOSE_UP_PX * self._unit), round(EDGE_PX * self._unit)
        return edge, self._size_px[1] - edge - side - round(3 * LINE_PX * self._unit), side

    def _draw_close_up(self, i: int, scene: Scene) -> None:
        robot = self._robots[i]
        left, top, side = (OVERSAMPLING * px for px in self._close_up_px)
        extent = CLOSE_UP_RADII * robot.outline_radius_mm
        centre = _placement(scene.x_mm[i], scene.y_mm[i], scene.theta_rad[i])(
            self._shapes[i].centre
        ).reshape(2)
        corner = (float(centre[0]) - extent / 2, float(centre[1]) + extent / 2)
        view = View(left, top, side, side, corner, side / extent, 1.3 * self._view.pen)
        self._canvas.set_clip(view.rect)
        self._draw_floor(view, 0.1)
        self._draw_robots(view, scene)
        self._canvas.set_clip(None)
        self._pg.draw.rect(self._canvas, _mixed(FLOOR, INK, 0.5), view.rect, OVERSAMPLING)

    def _draw_legend(self) -> None:
        pass

    # Text

    def _write(self, scene: Scene) -> None:
        edge, line = EDGE_PX * self._unit, LINE_PX * self._unit
        self._frame.blit(self._time_font.render(f"t = {scene.t_s:.2f} s", True, INK), (edge, edge))
        y = edge + 1.6 * line
        for i, _ in enumerate(self._robots):
            self._write_robot(scene, i, y)
            y += line

    def _write_robot(self, scene: Scene, i: int, y: float) -> None:
        u, edge = self._unit, EDGE_PX * self._unit
        self._pg.draw.aacircle(self._frame, self._colours[i], (edge + 5 * u, y + 6 * u), 5 * u)
        columns = [(f"robot_{i}", 18, "left"), (f"{scene.position_error_mm[i]:.1f} mm", 140, "right")]
        if i > 0:
            columns.append((f"{scene.time_gap_error_s[i]:+.3f} s", 205, "right"))
        for text, x, side in columns:
            image = self._font.render(text, True, INK)
            self._frame.blit(image, image.get_rect(**{f"top{side}": (edge + x * u, y)}))

    # Shapes

    def _fill(self, view: View, points_mm: np.ndarray, colour: Colour) -> None:
        self._pg.draw.polygon(self._canvas, colour, view.px(points_mm).tolist())

    def _ribbons(self, view: View, points_mm: np.ndarray, width_mm: np.ndarray, colour: Any) -> None:
        """Lines through ``(point, line, 2)``, piece by piece, in the order of the points."""
        along = np.gradient(points_mm, axis=0)
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        along = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
        side = np.stack([-along[..., 1], along[..., 0]], axis=-1) * width_mm[:, None, None] / 2
        left, right = view.px(points_mm + side), view.px(points_mm - side)
        shown = view.shows(left, view.width)
        shown = (shown[:-1] | shown[1:]) & np.isfinite(left[:-1] + left[1:]).all(axis=-1)
        quads = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=2)
        polygon = self._pg.draw.polygon
        pieces = zip(*(k.tolist() for k in np.nonzero(shown)), quads[shown].tolist(), strict=True)
        for j, i, quad in pieces:
            polygon(self._canvas, colour(j, i), quad)


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise ImportError("rendering needs pygame: pip install 'tlf-env[view]'") from error
    pygame.font.init()
    return pygame
