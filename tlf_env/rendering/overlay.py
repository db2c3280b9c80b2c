"""Text over a picture: plates with lines of text, and lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tlf_env.rendering.drawing import mixed
from tlf_env.rendering.looks import Colour, Theme

TEXT_PX = 19  # of pygame's font, whose letters are two thirds as high
LINE_PX, ROOM_PX, GAP_PX = 21, 12, 18  # between lines, inside a plate, and between columns
PLATE_ALPHA = 238


class Overlay:
    """Draws text on plates.

    Parameters
    ----------
    pg
        The module pygame.
    theme
        Colours.
    """

    def __init__(self, pg: Any, theme: Theme) -> None:
        self._pg, self.theme = pg, theme
        self._fonts: dict[int, Any] = {}

    def text(self, text: str, size_px: int = TEXT_PX, colour: Colour | None = None) -> Any:
        """A surface with a text, in the colour of ink by default."""
        if size_px not in self._fonts:
            self._fonts[size_px] = self._pg.font.Font(None, size_px)
        return self._fonts[size_px].render(text, True, colour or self.theme.ink)

    def plate(
        self,
        surface: Any,
        rows: Sequence[Sequence[str]],
        *,
        chosen: int | None = None,
        title: str = "",
        **anchor: Any,
    ) -> Any:
        """A plate with rows of text in columns; ``anchor`` is a point of it, named as in pygame.

        Parameters
        ----------
        surface
            What is drawn on.
        rows
            Texts, as many in each row.
        chosen
            The number of a row that is marked.
        title
            Over the rows.

        Returns
        -------
        pygame.Rect
            The place of the plate.
        """
        pg, theme = self._pg, self.theme
        images = [[self.text(cell) for cell in row] for row in rows]
        columns = [max(one.get_width() for one in column) for column in zip(*images, strict=True)]
        head = self.text(title, TEXT_PX + 2) if title else None
        width = sum(columns) + GAP_PX * (len(columns) - 1)
        width = max(width, head.get_width() if head else 0) + 2 * ROOM_PX
        top = ROOM_PX + (LINE_PX + 6 if head else 0)
        height = top + LINE_PX * len(rows) - (LINE_PX - TEXT_PX) + ROOM_PX - 4
        plate = pg.Surface((width, height), pg.SRCALPHA)
        edge = mixed(theme.floor, theme.ink, 0.35)
        pg.draw.rect(plate, (*theme.floor, PLATE_ALPHA), plate.get_rect(), border_radius=6)
        pg.draw.rect(plate, edge, plate.get_rect(), 1, border_radius=6)
        if head:
            plate.blit(head, (ROOM_PX, ROOM_PX - 2))
        for number, row in enumerate(images):
            y = top + number * LINE_PX
            if number == chosen:
                mark = pg.Rect(4, y - 4, width - 8, LINE_PX)
                pg.draw.rect(plate, mixed(theme.floor, theme.ink, 0.18), mark, border_radius=4)
            x = ROOM_PX
            for image, column in zip(row, columns, strict=True):
                plate.blit(image, (x, y))
                x += column + GAP_PX
        where = plate.get_rect(**anchor)
        surface.blit(plate, where)
        return where

    def row_at(self, plate: Any, px: tuple[int, int], rows: int, *, title: bool) -> int | None:
        """The row of a plate at a place on the surface, or None."""
        top = plate.top + ROOM_PX + (LINE_PX + 6 if title else 0) - 4
        number = (px[1] - top) // LINE_PX
        return number if plate.collidepoint(px) and 0 <= number < rows else None
