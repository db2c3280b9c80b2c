"""Colours and shapes of robots in frames and figures. Needs no optional extra."""

from __future__ import annotations

import numpy as np

from tlf_env.physics.shapes import border
from tlf_env.physics.vehicle import RobotParameters

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

# The world, each with its edge: what stands fast, what can be pushed, and what moves by itself. They differ in
# lightness, and in their edges and marks.
WALL: Colour = (172, 175, 180)
WALL_EDGE: Colour = (104, 107, 112)
CRATE: Colour = (228, 208, 176)
CRATE_EDGE: Colour = (128, 96, 58)
MOVER: Colour = (250, 228, 92)
MOVER_EDGE: Colour = (60, 62, 66)
COURSE: Colour = (150, 140, 70)  # the path of what moves by itself
SLIPPERY: Colour = (214, 233, 246)  # patches of the floor
GRIPPY: Colour = (247, 232, 210)

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


def outline_mm(robot: RobotParameters) -> np.ndarray:
    """Points around a robot's outline, ``(point, 2)``: right and forward of c."""
    if robot.outline_polygon_mm is not None:
        return border(np.array(robot.outline_polygon_mm), 0.0)
    return border(np.array([(0.0, -robot.outline_offset_mm)]), robot.outline_radius_mm)


def front_mm(robot: RobotParameters) -> float:
    """How far a robot's outline reaches ahead of c, which a picture's nose fits into."""
    if robot.outline_polygon_mm is None:
        return robot.outline_front_mm
    return max(forward for _, forward in robot.outline_polygon_mm)
