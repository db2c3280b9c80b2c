"""Colours and shapes of robots in frames and figures. Needs no optional extra."""

from __future__ import annotations

import numpy as np

Colour = tuple[int, int, int]

RENDER_MODES = ("human", "rgb_array")

# Okabe and Ito's colours without yellow, which is hard to see on white; neighbours also differ in luminance.
FEW_COLOURS: tuple[Colour, ...] = (
    (0, 0, 0),
    (230, 159, 0),
    (0, 114, 178),
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
LIGHTEST = 0.92  # of the map; its end is hard to see on white

DRIVE_WHEEL_WIDTH_MM, CASTOR_WIDTH_MM = 22.0, 14.0  # in pictures; wheels have no width in the model
# A triangle ahead of the axle, in units of the outline's extent ahead of c. Twice as long as wide, so that
# its tip differs clearly from the corners of its base.
NOSE = ((-0.2, 0.15), (0.2, 0.15), (0.0, 0.95))


def robot_colours(robots: int) -> list[Colour]:
    """Colours (0 to 255) of robots 0 to ``robots`` − 1, distinguishable for colour-blind readers.

    For up to seven robots each number has a fixed colour; more are spread over viridis, from dark to light.
    """
    if robots <= len(FEW_COLOURS):
        return list(FEW_COLOURS[:robots])
    along = LIGHTEST * np.linspace(0, len(VIRIDIS) - 1, robots)
    channels = [np.interp(along, np.arange(len(VIRIDIS)), channel) for channel in VIRIDIS.T]
    return [(round(r), round(g), round(b)) for r, g, b in zip(*channels, strict=True)]
