"""Which part of the floor a picture shows: the whole, or a part that is zoomed, moved or follows a robot."""

from __future__ import annotations

import numpy as np

from tlf_env.rendering.drawing import View

MOST_ZOOM, LEAST_ZOOM = 40.0, 0.1  # relative to the whole view
ZOOM_STEP = 1.25  # of a key or of a notch of the wheel


class Camera:
    """Zoom, place and the robot that is followed; without a change it shows the whole view."""

    def __init__(self) -> None:
        self.zoom = 1.0
        self.centre_mm: tuple[float, float] | None = None  # None: that of the whole view
        self.follow: int | None = None  # number of a robot

    @property
    def is_whole(self) -> bool:
        """Whether the whole view is shown."""
        return self.zoom == 1.0 and self.centre_mm is None and self.follow is None

    def reset(self) -> None:
        """Show the whole view."""
        self.zoom, self.centre_mm, self.follow = 1.0, None, None

    def view(self, whole: View, places_mm: np.ndarray) -> View:
        """The part of the whole view that is shown, with the robots at ``places_mm`` ``(robot, 2)``."""
        if self.is_whole:
            return whole
        scale = whole.scale * self.zoom
        if self.follow is not None and np.isfinite(places_mm[self.follow]).all():
            self.centre_mm = (
                float(places_mm[self.follow, 0]),
                float(places_mm[self.follow, 1]),
            )
        x_mm, y_mm = self.centre_mm or centre_of(whole)
        corner_mm = (x_mm - whole.width / scale / 2, y_mm + whole.height / scale / 2)
        return whole._replace(corner_mm=corner_mm, scale=scale)

    def zoom_by(self, factor: float, shown: View, at_mm: tuple[float, float] | None = None) -> None:
        """Zoom by a factor about a place of the floor, or about the centre of the view ``shown``."""
        before = self.zoom
        self.zoom = min(max(before * factor, LEAST_ZOOM), MOST_ZOOM)
        if at_mm is None or self.follow is not None:
            self.centre_mm = centre_of(shown)
            return
        share = 1.0 - before / self.zoom
        x_mm, y_mm = centre_of(shown)
        self.centre_mm = (x_mm + share * (at_mm[0] - x_mm), y_mm + share * (at_mm[1] - y_mm))

    def move_by(self, x_mm: float, y_mm: float, shown: View) -> None:
        """Move the centre of the view ``shown``; no robot is followed any more."""
        centre_x, centre_y = centre_of(shown)
        self.follow, self.centre_mm = None, (centre_x + x_mm, centre_y + y_mm)

    def follow_next(self, robots: int) -> None:
        """Follow robot 0, then the next ones, then none."""
        following = -1 if self.follow is None else self.follow
        self.follow = following + 1 if following + 1 < robots else None


def centre_of(view: View) -> tuple[float, float]:
    """The place (mm) in the middle of a view."""
    x_mm, y_mm = view.corner_mm
    return x_mm + view.width / view.scale / 2, y_mm - view.height / view.scale / 2
