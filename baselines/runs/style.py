"""Look of the figures, shared by the figures of runs and of benchmarks."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes

from tlf_env.rendering.looks import robot_colours

DPI = 150
METADATA: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
GREY, PALE = "0.45", "0.88"


def hex_colour(number: int, count: int) -> str:
    """Colour of one of ``count`` robots or policies, as ``#rrggbb``; the same as the renderer's."""
    return "#{:02x}{:02x}{:02x}".format(*robot_colours(count)[number])


def tidy(*panels: Axes) -> None:
    """Remove the frame on two sides, and draw a light grid behind the data."""
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.92", lw=0.6)
        axes.set_axisbelow(True)
