"""Keys and mouse of a window that change what is shown and how fast, and never the episode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tlf_env.rendering.camera import ZOOM_STEP

if TYPE_CHECKING:
    from tlf_env.rendering.renderer import Renderer

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # of real time
LEFT_BUTTON, RIGHT_BUTTON = 1, 3
MOVE_PX = 60  # of a key

# The keys, and what they do.
TIME_KEYS = (
    ("space", "pause, run"),
    (".", "one step"),
    ("[  ]", "slower, faster"),
)
VIEW_KEYS = (
    ("wheel, + -", "zoom"),
    ("drag", "move the view"),
    ("f", "follow the next robot"),
    ("0", "whole view"),
    ("h  ?", "show or hide the keys"),
)


def character(event: Any) -> str:
    """The character of a key that is pressed, in lower case; empty for a key without one."""
    text = str(getattr(event, "unicode", ""))
    return text.lower() if text.isprintable() else ""


class Controls:
    """What the keys and the mouse of a window have set.

    Parameters
    ----------
    pg
        The module pygame.
    origin_px
        Where the picture begins in the window.
    """

    def __init__(self, pg: Any, origin_px: tuple[int, int] = (0, 0)) -> None:
        self._pg, self._origin_px = pg, origin_px
        self.paused = False
        self.steps = 0  # that are still to be done while paused
        self.help = False
        self.mouse_px = (0, 0)
        self._place = SPEEDS.index(1.0)
        self._dragging = False

    @property
    def speed(self) -> float:
        """Wanted speed, relative to real time."""
        return SPEEDS[self._place]

    @property
    def waits(self) -> bool:
        """Whether nothing is to be simulated now."""
        return self.paused and not self.steps

    def take(self, event: Any, renderer: Renderer) -> bool:
        """Take an event; whether it was one of these keys or of the mouse in the picture."""
        pg = self._pg
        if event.type == pg.KEYDOWN:
            return self._take_key(event, renderer)
        if event.type == pg.MOUSEWHEEL:
            notches = event.y
            at_mm = renderer.place_mm(self.mouse_px)
            renderer.camera.zoom_by(ZOOM_STEP**notches, renderer.view, at_mm)
            return True
        if event.type == pg.MOUSEMOTION:
            self.mouse_px = self.in_picture(event.pos)
            if self._dragging:
                self._move(renderer, *event.rel)
            return self._dragging
        if event.type == pg.MOUSEBUTTONDOWN:
            self.mouse_px = self.in_picture(event.pos)
            self._dragging = event.button == LEFT_BUTTON
            return self._dragging
        if event.type == pg.MOUSEBUTTONUP and event.button == LEFT_BUTTON:
            was, self._dragging = self._dragging, False
            return was
        return False

    def in_picture(self, px: tuple[int, int]) -> tuple[int, int]:
        """A place in the window as one in the picture."""
        return px[0] - self._origin_px[0], px[1] - self._origin_px[1]

    def stop_dragging(self) -> None:
        """End a drag of the view, for example because another control takes the mouse."""
        self._dragging = False

    def _take_key(self, event: Any, renderer: Renderer) -> bool:
        pg, camera = self._pg, renderer.camera
        match character(event):
            case "h" | "?":
                self.help = not self.help
            case " ":
                self.paused, self.steps = not self.paused, 0
            case ".":
                self.paused, self.steps = True, self.steps + 1
            case "[":
                self.change_speed(-1)
            case "]":
                self.change_speed(1)
            case "+" | "=":
                camera.zoom_by(ZOOM_STEP, renderer.view)
            case "-":
                camera.zoom_by(1 / ZOOM_STEP, renderer.view)
            case "0":
                camera.reset()
            case "f":
                camera.follow_next(renderer.robots)
            case _:
                if event.key not in (pg.K_PAGEUP, pg.K_PAGEDOWN):
                    return False
                self.change_speed(1 if event.key == pg.K_PAGEUP else -1)
        return True

    def change_speed(self, by: int) -> None:
        """The next speed up or down."""
        self._place = min(max(self._place + by, 0), len(SPEEDS) - 1)

    def _move(self, renderer: Renderer, right_px: float, down_px: float) -> None:
        mm = renderer.mm_per_px
        renderer.camera.move_by(-right_px * mm, down_px * mm, renderer.view)
