"""Timed waypoints: reading, validation, and the smooth motion through them.

A waypoint is ``(t_s, x_mm, y_mm)``. Between different waypoints the motion is a cubic spline. Between equal
waypoints the reference is at rest; it stops and starts smoothly.
"""

from __future__ import annotations

import csv
import itertools
import math
import re
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tlf_env.common.errors import path_text, shown
from tlf_env.common.models import as_float, is_number
from tlf_env.common.presets import DECIMAL
from tlf_env.task.actions import FULL_SPEED_MM_S

HEADER = ("t_s", "x_mm", "y_mm")
MAX_POINTS = 100_000
MAX_MAGNITUDE = 1e9  # s, mm
MAX_COORDINATE_MM = 1e10  # of a place: room for every coordinate of the UTM grid
NUMBER = re.compile(DECIMAL)
COMMENT = "#"  # np.savetxt begins its header with it
DEFAULT_ROBOTS = 3
FEW_POINTS = 4  # up to this number free ends are natural: not-a-knot would overshoot
REST_SHARE = 0.25  # a free end is at rest if slower than this share of its chord's speed
HELD_MM = 1.0  # within this distance of a rest the heading is constant: its direction is rounding
SEARCH_PARTS = 64  # of an interval, in the search for that distance

# Times are checked after the first is subtracted: a log may count seconds since 1970, but not
# nanoseconds, which float64 could not tell apart.
COARSEST_TIME_S = 1e-6
LARGEST = {"t_s": sys.float_info.max, "x_mm": MAX_COORDINATE_MM, "y_mm": MAX_COORDINATE_MM}

Point = tuple[float, float, float]


def read_points(path: Path) -> tuple[Point, ...]:
    """The waypoints in a CSV file with the header ``t_s,x_mm,y_mm``; the first time becomes 0.

    Lines that begin with ``#`` are comments. The header may be one, as ``np.savetxt`` writes it.

    Raises
    ------
    ValueError
        in one line with the file, the line, the value and what is allowed.
    """
    name = path_text(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"cannot read {name}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{name} is not UTF-8 text: {error}") from error
    reader = csv.reader(text.splitlines())
    lines: list[int] = []
    rows: list[list[str]] = []
    comment = ""  # the last before the header
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not rows and cells and cells[0].startswith(COMMENT):  # a header or a comment
                comment = f" after the comment {shown(','.join(row))} of line {reader.line_num}"
                cells[0] = cells[0].lstrip(COMMENT).strip()
                if tuple(cells) != HEADER:
                    continue
            if any(cells) and not cells[0].startswith(COMMENT):
                lines.append(reader.line_num)
                rows.append(cells)
    except csv.Error as error:
        raise ValueError(f"{name}, line {reader.line_num}: not CSV: {error}") from error
    if not rows or tuple(rows[0]) != HEADER:
        found = shown(",".join(rows[0])) if rows else "nothing" if comment else "an empty file"
        raise ValueError(
            f"{name}, line {lines[0] if rows else 1}: the header must be {','.join(HEADER)}, "
            f"got {found}{comment}; `tlf path` reads logs with other columns, units and delimiters"
        )
    return checked_points(
        [[_parsed(cell) for cell in row] for row in rows[1:]],
        name,
        lambda index: f"{name}, line {lines[index + 1]}",
    )


def _parsed(cell: str) -> float | str:
    """The number in a cell; the cell itself if there is none, in the digits 0 to 9 as in YAML."""
    return float(cell) if NUMBER.fullmatch(cell) else cell


def checked_points(
    rows: Sequence[Any], whole: str, place: Callable[[int], str]
) -> tuple[Point, ...]:
    """Rows of three numbers as waypoints, minus the first time.

    ``whole`` names the source and ``place(i)`` row i in errors.

    Raises
    ------
    ValueError
        for a row that is not three finite numbers, a time so large that float64 has no steps of 1 µs, fewer
        than two or too many rows, a time that does not increase, no motion, or a distance that no robot
        can cover in the given time.
    """
    if not 2 <= len(rows) <= MAX_POINTS:
        raise ValueError(f"{whole} must have 2 to {MAX_POINTS} waypoints, got {len(rows)}")
    raw = [_numbers(row, place(i)) for i, row in enumerate(rows)]
    for i, (t, _, _) in enumerate(raw):
        if math.ulp(t) > COARSEST_TIME_S:
            raise ValueError(
                f"{place(i)}: t_s {t:.17g} is too large for steps of {COARSEST_TIME_S:g} s; "
                "times must be in seconds"
            )
    points = [(t - raw[0][0], x, y) for t, x, y in raw]
    for i in range(1, len(points)):
        if not points[i][0] <= MAX_MAGNITUDE:
            raise ValueError(
                f"{place(i)}: t_s {raw[i][0]:.17g} must be at most {MAX_MAGNITUDE:g} s after the first "
                f"time, {raw[0][0]:.17g}"
            )
        duration_s = points[i][0] - points[i - 1][0]
        if duration_s <= 0:
            raise ValueError(
                f"{place(i)}: t_s {raw[i][0]:.17g} must be above {raw[i - 1][0]:.17g}, "
                "the previous time"
            )
        distance_mm = math.dist(points[i][1:], points[i - 1][1:])
        if distance_mm > FULL_SPEED_MM_S * duration_s:
            raise ValueError(
                f"{place(i)}: {distance_mm:.6g} mm from the previous waypoint in {duration_s:.6g} s "
                f"is {distance_mm / duration_s:.6g} mm/s; at most {FULL_SPEED_MM_S:g} is allowed"
            )
    if all(point[1:] == points[0][1:] for point in points):
        raise ValueError(
            f"{whole}: all waypoints are at the same position; at least two must differ"
        )
    return tuple(points)


def _numbers(row: Any, place: str) -> Point:
    row = row.tolist() if isinstance(row, np.ndarray) else row
    if not isinstance(row, list | tuple) or len(row) != len(HEADER):
        got = f"{len(row)}" if isinstance(row, list | tuple) else shown(row)
        raise ValueError(f"{place}: must be {len(HEADER)} numbers, {','.join(HEADER)}, got {got}")
    values = []
    for name, cell in zip(HEADER, row, strict=True):
        largest = LARGEST[name]
        value = as_float(cell) if is_number(cell) else math.nan
        if not abs(value) <= largest:
            raise ValueError(
                f"{place}: {name} must be a number within ±{largest:g}, got {shown(cell)}"
            )
        values.append(value)
    return values[0], values[1], values[2]


class Drive(NamedTuple):
    """The motion through waypoints: a piecewise cubic, and the intervals (stretches) of motion."""

    position: Any  # scipy PPoly of (x, y), mm, from 0 to the last time
    velocity: Any
    acceleration: Any
    end_s: float
    from_s: np.ndarray  # (stretch,)
    to_s: np.ndarray
    first_s: np.ndarray  # before it, and after last_s, the heading is constant
    last_s: np.ndarray

    def derivatives(self, t_s: np.ndarray) -> np.ndarray:
        """Position, velocity, acceleration ``(3, 2, ...)``; at rest before 0 and after the end."""
        inside = np.clip(t_s, 0.0, self.end_s)
        out = np.stack([f(inside) for f in (self.position, self.velocity, self.acceleration)])
        out[1:, inside != t_s] = 0.0
        return np.moveaxis(out, -1, 1)

    def heading_time(self, t_s: np.ndarray) -> np.ndarray:
        """The time whose heading applies at ``t_s``: ``t_s`` itself during motion."""
        stretch = np.maximum(np.searchsorted(self.from_s, t_s, side="left") - 1, 0)
        return np.clip(t_s, self.first_s[stretch], self.last_s[stretch])


@lru_cache(maxsize=8)
def drive_through(points: tuple[Point, ...]) -> Drive:
    """The motion through checked waypoints: a cubic spline for every stretch between two rests.

    A stretch starts and ends with zero speed at a rest. The first and last end are free (not-a-knot;
    natural with at most four points). If the resulting speed there is low, or directed against the chord,
    the motion starts or ends at rest instead.

    Raises
    ------
    ValueError
        if SciPy is missing.
    """
    try:
        from scipy.interpolate import CubicSpline, PPoly
    except ModuleNotFoundError as error:
        raise ValueError("waypoints need SciPy (pip install scipy)") from error
    table = np.array(points)
    t, xy = table[:, 0], table[:, 1:]
    stands = np.concatenate([[True], (xy[1:] == xy[:-1]).all(axis=1), [True]])
    first, last = np.flatnonzero(np.diff(stands.astype(np.int8))).reshape(-1, 2).T
    rests = np.stack([first > 0, last < len(t) - 1], axis=1)
    cubic = np.zeros((4, len(t) - 1, 2))
    cubic[3] = xy[:-1]
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        some_t, some_xy = t[a : b + 1], xy[a : b + 1]
        spline = CubicSpline(some_t, some_xy, bc_type=_ends(rests[k], b - a))
        slow = _slow_ends(some_t, some_xy, spline(some_t[[0, -1]], 1))
        if (slow > rests[k]).any():
            rests[k] |= slow
            spline = CubicSpline(some_t, some_xy, bc_type=_ends(rests[k], b - a))
        cubic[:, a:b] = spline.c
    position = PPoly(cubic, t)
    first_s, last_s = t[first], t[last]
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        if rests[k, 0]:
            first_s[k] = _leaves(position, t[a : b + 1])
        if rests[k, 1]:
            last_s[k] = _leaves(position, t[a : b + 1][::-1])
    return Drive(
        position=position,
        velocity=position.derivative(1),
        acceleration=position.derivative(2),
        end_s=float(t[-1]),
        from_s=t[first],
        to_s=t[last],
        first_s=first_s,
        last_s=np.maximum(first_s, last_s),
    )


def _ends(rests: np.ndarray, intervals: int) -> tuple[str, str]:
    free = "natural" if intervals < FEW_POINTS else "not-a-knot"
    left, right = ("clamped" if rest else free for rest in rests)
    return left, right


def _slow_ends(t: np.ndarray, xy: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Which of the two ends are at rest by their velocity (end, 2); otherwise the heading would flip there."""
    chord = np.stack([(xy[1] - xy[0]) / (t[1] - t[0]), (xy[-1] - xy[-2]) / (t[-1] - t[-2])])
    return (velocity * chord).sum(axis=1) < REST_SHARE * (chord**2).sum(axis=1)


def _leaves(position: Any, t: np.ndarray) -> float:
    """The first time with a distance of ``HELD_MM`` to the position at ``t[0]``; else the middle time."""
    start = position(t[0])
    for a, b in itertools.pairwise(t):
        part = np.linspace(a, b, SEARCH_PARTS + 1)[1:]
        far = np.hypot(*(position(part) - start).T) >= HELD_MM
        if far.any():
            return float(part[np.argmax(far)])
    return float((t[0] + t[-1]) / 2)


def scenario_of_waypoints(path: Path, control_period_s: float = 0.02) -> dict[str, Any]:
    """A scenario of three robots on the waypoints of a CSV file, until the last waypoint.

    ``horizon_s`` is rounded up to a multiple of the control period.

    Raises
    ------
    ValueError
        as :func:`read_points`.
    """
    points = read_points(path)
    steps = max(math.ceil(points[-1][0] / control_period_s - 1e-9), 1)
    return {
        "name": path.stem,
        "robots": DEFAULT_ROBOTS,
        "horizon_s": round(steps * control_period_s, 9),
        "trajectory": {"type": "waypoints", "points": points},
    }
