"""Swept knobs: their units, their labels, and whether their values are spaced evenly or by ratios."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

UNITS = {
    "_Nmm": "N·mm",
    "_N": "N",
    "_hz": "Hz",
    "_kg_mm2": "kg·mm²",
    "_rad_s": "rad/s",
    "_mm_s": "mm/s",
    "_rad": "rad",
    "_kg": "kg",
    "_mm": "mm",
    "_s": "s",
}


def is_geometric(values: Sequence[float]) -> bool:
    """Whether values are evenly spaced on a logarithmic scale rather than on a linear one."""
    known = np.unique(values)
    if len(known) < 3 or known[0] <= 0:
        return False
    steps, ratios = np.diff(known), np.diff(np.log(known))
    return bool(np.ptp(ratios) / ratios.mean() < np.ptp(steps) / steps.mean())


def knob_label(path: str) -> str:
    """A knob and the unit at the end of its name: ``slip.delta_1_mm_s`` → ``slip.delta_1 (mm/s)``."""
    unit = unit_of(path)
    if unit is None:
        return path
    suffix = next(suffix for suffix, name in UNITS.items() if name == unit)
    return f"{path.removesuffix(suffix)} ({unit})"


def unit_of(name: str) -> str | None:
    """The unit at the end of a name: ``delta_1_mm_s`` → ``mm/s``; None without one."""
    return next((unit for suffix, unit in UNITS.items() if name.endswith(suffix)), None)
