"""The picture of a path: the log, what is made of it, and the places that robots cannot follow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from baselines.paths.read import Log
from baselines.paths.retime import Deviation
from baselines.runs.style import DPI, GREY, tidy
from tlf_env.common.files import atomic

LINE, MARK = "#0072B2", "#D55E00"


def draw_path(
    log: Log,
    points: np.ndarray,
    places: Sequence[tuple[float, float]],
    deviation: Deviation | None,
    path: Path,
) -> None:
    """Write the picture.

    Parameters
    ----------
    points
        (point, 2), mm: the path that is written.
    places
        Where a warning holds, mm.
    deviation
        Of the smoothed path from its log; None: it was not smoothed.
    """
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(*log.xy_mm.T, ".", color="0.7", ms=3, label="log")
    words = "path" if deviation is None else f"path, {deviation.rms_mm:.2g} mm from the log"
    axes.plot(*points.T, color=LINE, lw=1.5, label=words)
    axes.plot(*points[:1].T, "o", color=LINE, mfc="white", label="start")
    if places:
        axes.plot(
            *np.array(places).T, "X", color=MARK, ms=11, mec="white", label="robots cannot follow"
        )
    axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    axes.margins(0.08)
    axes.tick_params(colors=GREY)
    tidy(axes)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    with atomic(path, "wb") as file:
        figure.savefig(file, format="png", dpi=DPI)
