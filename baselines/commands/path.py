"""``tlf path``: a user's own log as a path that robots can follow."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from baselines.console import notes, screen, warn_of_missing, writable_folder
from baselines.paths.read import Log, read_log
from baselines.paths.retime import Deviation, retimed, smoothed
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario, scenario_warnings
from tlf_env.task.waypoints import HEADER, MAX_POINTS

PLACE = re.compile(r"^t = (?P<t>[\d.]+) s at \((?P<x>-?\d+), (?P<y>-?\d+)\) mm")
# Words of a warning, and what cures it.
CURES = {
    "mm/s": "--speed-limit",
    "torque": "--speed-limit",
    "grip": "--speed-limit",
    "tyres": "--speed-limit",
    "yaw": "--smooth or --speed-limit",
    "turn": "--smooth or --speed-limit",
    "rest": "--speed-limit, which drives without stops",
    "outline": "a path that does not cross itself within the time gaps, or a larger start spacing",
}


def path_command(
    log_file: Path,
    out: Path,
    *,
    columns: str | None,
    units: str | None,
    smooth_mm: float | None,
    speed_limit_mm_s: float | None,
    figures: bool,
) -> None:
    """Read a log, write a path, and print what robots cannot follow on it.

    Raises
    ------
    ValueError
        for a file that cannot be read, and for values that are not positive.
    """
    for option, value in (("smooth", smooth_mm), ("speed-limit", speed_limit_mm_s)):
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"--{option} {value:g} must be above 0 and finite")
    log = read_log(log_file, columns, units)
    for note in log.notes:
        screen.print(f"{log_file.name}: {note}", soft_wrap=True)
    times, points, deviation = log.t_s, log.xy_mm, None
    if smooth_mm is not None:
        times, points, deviation = smoothed(log, smooth_mm)
        screen.print(
            f"Smoothed: {deviation.rms_mm:.3g} mm from the log (root mean square), at most "
            f"{deviation.largest_mm:.3g} mm"
        )
    if speed_limit_mm_s is not None:
        times, points = retimed(points, speed_limit_mm_s)
        screen.print(
            f"Timed anew: {times[-1]:.4g} s in place of {log.t_s[-1]:.4g} s, from rest to rest"
        )
    if len(times) > MAX_POINTS:
        fewer = np.linspace(times[0], times[-1], MAX_POINTS)
        points = np.stack([np.interp(fewer, times, values) for values in points.T], axis=1)
        times = fewer
        screen.print(f"Thinned to {MAX_POINTS} points, the most that a path may have")
    writable_folder(out.parent)
    write_path(out, times, points)
    _report(log, out, points, deviation, figures=figures)


def write_path(out: Path, times: np.ndarray, points: np.ndarray) -> None:
    """Write waypoints as a CSV file that ``tlf run`` reads."""
    with atomic(out, encoding="utf-8") as file:
        file.write(",".join(HEADER) + "\n")
        np.savetxt(file, np.column_stack([times, points]), fmt="%.6f", delimiter=",")


def _report(
    log: Log, out: Path, points: np.ndarray, deviation: Deviation | None, *, figures: bool
) -> None:
    """Print what robots cannot follow, where, and what cures it; and the command that runs the path."""
    scenario = load_scenario(out)
    lines = scenario_warnings(scenario)
    for line in lines:
        cures = [cure for word, cure in CURES.items() if word in line]
        hint = f"; cure: {cures[0]}" if cures else ""
        notes.print(f"tlf: warning: {line}{hint}", soft_wrap=True)
    if figures:
        try:
            from baselines.paths.figure import draw_path
        except ModuleNotFoundError as error:
            warn_of_missing(error)
        else:
            places = [(float(hit["x"]), float(hit["y"])) for hit in map(PLACE.match, lines) if hit]
            picture = out.with_suffix(".png")
            draw_path(log, points, places, deviation, picture)
            screen.print(f"Picture: {picture}", soft_wrap=True)
    said = "robots can follow it" if not lines else f"{len(lines)} warning{'s' * (len(lines) > 1)}"
    screen.print(f"{out}: {said}; run it with", soft_wrap=True)
    screen.print(f"tlf run {out}", soft_wrap=True)
