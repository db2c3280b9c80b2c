"""Look of the paper's figures: colours that differ in print, lines that differ without colour, files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from baselines.runs.style import METADATA
from tlf_env.common.files import atomic

BLUE, ORANGE, GREEN, RED, PURPLE, BLACK = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#000000",
)
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, BLACK)
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
DPI = 96  # the figures are part of a page


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure with a layout that keeps texts apart."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def write(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures as PNG, each atomically."""
    written = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        with atomic(path, "wb") as file:
            figure.savefig(
                file,
                format="png",
                dpi=DPI,
                facecolor="white",
                metadata=METADATA.get("png"),
                pil_kwargs={"optimize": True},
            )
        written.append(path)
    return written
