"""Colours and shapes of robots in frames and figures. Needs no optional extra."""

from __future__ import annotations

from typing import NamedTuple

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

FLOOR: Colour = (252, 252, 250)
INK: Colour = (60, 62, 66)
ALARM: Colour = (236, 0, 84)  # slip, lost, touched; no robot has this colour


class Theme(NamedTuple):
    """The colours of a picture. The defaults are the light theme."""

    floor: Colour = FLOOR
    ink: Colour = INK  # text and lines
    grid: Colour = (222, 224, 226)
    half_grid: Colour = (239, 240, 241)
    path: Colour = (188, 190, 193)
    tyre: Colour = (48, 50, 54)
    tread: Colour = (205, 208, 212)
    alarm: Colour = ALARM
    wall: Colour = WALL
    wall_edge: Colour = WALL_EDGE
    crate: Colour = CRATE
    crate_edge: Colour = CRATE_EDGE
    mover: Colour = MOVER
    mover_edge: Colour = MOVER_EDGE
    course: Colour = COURSE
    slippery: Colour = SLIPPERY
    grippy: Colour = GRIPPY
    body: float = (
        0.25  # part of a robot's colour in the inside of its outline, the rest is the floor's
    )
    few: tuple[Colour, ...] = FEW_COLOURS  # of up to seven robots
    dark_end: float = (
        0.0  # part of the map of colours, for more robots, that is too close to the floor
    )
    bright_end: float = LIGHTEST


LIGHT = Theme()
DARK = Theme(
    floor=(27, 29, 33),
    ink=(222, 224, 228),
    grid=(52, 55, 61),
    half_grid=(38, 40, 45),
    path=(96, 100, 108),
    tyre=(186, 190, 197),
    tread=(70, 73, 79),
    alarm=(255, 64, 122),
    wall=(88, 92, 100),
    wall_edge=(150, 154, 162),
    crate=(112, 90, 58),
    crate_edge=(214, 182, 132),
    mover=(150, 130, 20),
    mover_edge=(240, 228, 150),
    course=(168, 156, 80),
    slippery=(34, 62, 84),
    grippy=(82, 62, 34),
    body=0.35,
    few=((240, 240, 240), (230, 159, 0), (38, 140, 208), (126, 203, 246), *FEW_COLOURS[4:]),
    dark_end=0.2,
    bright_end=1.0,
)
THEMES = {"light": LIGHT, "dark": DARK}

DRIVE_WHEEL_WIDTH_MM, CASTOR_WIDTH_MM = 22.0, 14.0  # in pictures; wheels have no width in the model
# A triangle ahead of the axle, in units of the outline's extent ahead of c. Twice as long as wide, so that
# its tip differs clearly from the corners of its base.
NOSE = ((-0.2, 0.15), (0.2, 0.15), (0.0, 0.95))


def robot_colours(robots: int, theme: Theme = LIGHT) -> list[Colour]:
    """Colours (0 to 255) of robots 0 to ``robots`` − 1, distinguishable for colour-blind readers.

    For up to seven robots each number has a fixed colour; more are spread over viridis, from dark to light.
    """
    if robots <= len(theme.few):
        return list(theme.few[:robots])
    low, high = theme.dark_end, theme.bright_end
    share = np.linspace(0, len(VIRIDIS) - 1, robots)
    along = low * (len(VIRIDIS) - 1) + (high - low) * share
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
