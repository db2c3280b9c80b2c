"""Courses of the trainings that scripts of *Learning* run themselves: kept beside the policies, and drawn."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from make_algorithms import Entry, draw_scores
from make_figures import STYLE
from matplotlib.figure import Figure

COURSE_FILE = "course.json"
SIGNIFICANT = 4  # digits that are kept


class Course:
    """A quantity in the course of a training, and the minutes of a core that it took."""

    def __init__(self) -> None:
        self._began_s = time.process_time()
        self._along: list[float] = []
        self._values: list[float] = []

    def note(self, along: float, value: float) -> None:
        """Keep a value at a place of the training, such as a number of robot steps."""
        self._along.append(along)
        self._values.append(float(f"{value:.{SIGNIFICANT}g}"))

    def keep(self, folder: Path) -> None:
        """Write the course."""
        minutes = round((time.process_time() - self._began_s) / 60, 2)
        found = {"along": self._along, "values": self._values, "minutes": minutes}
        (folder / COURSE_FILE).write_text(json.dumps(found) + "\n", encoding="utf-8")


def courses_of(trained: Path, arm: str) -> list[dict[str, Any]]:
    """The kept courses of an arm's trainings, ``seed_N`` in its folder."""
    return [
        {"arm": arm, "seed": path.parent.name, **json.loads(path.read_text(encoding="utf-8"))}
        for path in sorted(trained.glob(f"seed_*/{COURSE_FILE}"))
    ]


def draw_courses(
    courses: Sequence[dict[str, Any]],
    entries: Sequence[Entry],
    path: Path,
    *,
    along: str,
    values: str,
    scale: float = 1.0,
) -> None:
    """Draw every arm: the median of its training seeds, and their range; ``scale`` of ``along`` is 1."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.2), layout="constrained")
        panel = figure.subplots()
        for entry in entries:
            mine = [one for one in courses if one["arm"] == entry.name]
            if mine:
                places = np.array(mine[0]["along"], dtype=float) / scale
                draw_scores(panel, places, np.array([one["values"] for one in mine]), entry, "")
        panel.set(xlabel=along, ylabel=values)
        panel.legend(fontsize="small", loc="lower right")
        figure.savefig(path, dpi=110)
