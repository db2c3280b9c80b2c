"""The window of ``render_mode="human"``: in real time, with keys that change the view only."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tlf_env.rendering.controls import TIME_KEYS, VIEW_KEYS, Controls
from tlf_env.rendering.overlay import Overlay

if TYPE_CHECKING:
    from tlf_env.rendering.renderer import Renderer

WAITING_FPS = 30.0  # while paused
EDGE_PX = 14
CAPTION = "tlf_env - h: keys"


class Window:
    """A window that shows the pictures of a renderer.

    Parameters
    ----------
    renderer
        What draws the pictures.
    size_px
        Width and height.
    fps
        Frames per second in real time.
    """

    def __init__(self, renderer: Renderer, size_px: tuple[int, int], fps: float) -> None:
        pg = renderer.pg
        self._pg, self._renderer, self._fps = pg, renderer, fps
        pg.display.init()
        pg.display.set_mode(size_px, pg.RESIZABLE)
        pg.display.set_caption(CAPTION)
        self._clock = pg.time.Clock()
        self.controls = Controls(pg)
        self._overlay = Overlay(pg, renderer.theme)
        self.open = True

    def handle_events(self) -> bool:
        """Take what the user has done since the last call; whether anything may look different."""
        pg = self._pg
        if not self.open:
            return False
        if not pg.display.get_init() or pg.event.get(pg.QUIT):
            self.close()
            return False
        events = pg.event.get()
        taken = [self.controls.take(event, self._renderer) for event in events]
        size_px = pg.display.get_window_size()
        return self._renderer.resize(size_px) or any(taken) or bool(events)

    def show(self, paint: Callable[[], Any]) -> None:
        """Show a picture until its time is over; while paused, until the next step is wanted."""
        controls = self.controls
        controls.steps = max(controls.steps - 1, 0)
        self._present(paint())
        while controls.waits and self.open:
            self._clock.tick(WAITING_FPS)
            if self.handle_events() and self.open:
                self._present(paint())
        self._clock.tick(self._fps * controls.speed)

    def close(self) -> None:
        """Close the window."""
        if self.open:
            self._pg.display.quit()
        self.open = False

    def _present(self, picture: Any) -> None:
        surface = self._pg.display.get_surface()
        surface.blit(picture, (0, 0))
        if self.controls.help:
            right = surface.get_width() - EDGE_PX
            keys = (*TIME_KEYS, *VIEW_KEYS)
            self._overlay.plate(surface, keys, title="Keys", topright=(right, EDGE_PX))
        self._pg.display.flip()
