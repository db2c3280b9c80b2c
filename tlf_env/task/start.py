"""Start of an episode as the caller wants it: the options of ``reset``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tlf_env.common.errors import shown
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.waypoints import MAX_COORDINATE_MM, MAX_MAGNITUDE

START_POSE_LIMIT_MM = MAX_COORDINATE_MM
PHASE_LIMIT_S = MAX_MAGNITUDE
OPTIONS = ("poses", "phase_s")


class Start(NamedTuple):
    """Start poses and phases of formations; None where an episode starts as usual."""

    poses: np.ndarray | None  # (formation, robot, 3) of c, at rest; mm, mm, rad
    phases_s: (
        np.ndarray | None
    )  # (formation,): where on its trajectory the leader's reference starts


def same_start(a: Start, b: Start) -> bool:
    """Whether two starts are the same."""
    return all(
        one is other or (one is not None and other is not None and np.array_equal(one, other))
        for one, other in zip(a, b, strict=True)
    )


def joined(starts: Sequence[Start]) -> Start:
    """One start of as many formations from starts of one formation each; NaN where poses are drawn."""
    poses = phases_s = None
    given = next((one.poses for one in starts if one.poses is not None), None)
    if given is not None:
        drawn = np.full_like(given, np.nan)
        poses = np.concatenate([drawn if one.poses is None else one.poses for one in starts])
    if any(one.phases_s is not None for one in starts):
        phases_s = np.array([0.0 if one.phases_s is None else one.phases_s[0] for one in starts])
    return Start(poses, phases_s)


def start_options(
    options: Mapping[str, Any] | None, robots: int, formations: int | None = None
) -> Start:
    """The options of a reset, ``poses`` and ``phase_s``, for each of the formations.

    Parameters
    ----------
    options
        ``poses``: ``(robots, 3)``; x and y of c in mm, θ in rad. ``phase_s``: a time in s within
        ±1e9. With several formations also one for each, in the first dimension.
    robots
        Number of robots in a formation.
    formations
        Number of formations; None for one alone.

    Raises
    ------
    ValueError
        for an unknown option or an invalid value.
    """
    if not isinstance(options, Mapping | None):
        raise ValueError(f"reset options must be a mapping, got {_described(options)}")
    given = options or {}
    unknown = [name for name in given if name not in OPTIONS]
    if unknown:
        raise ValueError(
            f"reset option {shown(unknown[0])} is unknown; the options are {', '.join(OPTIONS)}"
        )
    poses = phases_s = None
    each = "" if formations is None else f", or that for each of {formations} formations"
    if "poses" in given:
        poses = _stacked(given["poses"], (robots, 3), formations)
        if poses is None or not (np.abs(poses) <= START_POSE_LIMIT_MM).all():
            raise ValueError(
                f"reset option poses must be {robots} finite rows (x mm, y mm, θ rad) within "
                f"±{START_POSE_LIMIT_MM:g}{each}, got {_described(given['poses'])}"
            )
    if "phase_s" in given:
        phases_s = _stacked(given["phase_s"], (), formations)
        if phases_s is None or not (np.abs(phases_s) <= PHASE_LIMIT_S).all():
            raise ValueError(
                f"reset option phase_s must be a finite number of seconds{each}, got "
                f"{_described(given['phase_s'])}; at most ±{PHASE_LIMIT_S:g} is allowed"
            )
    return Start(poses, phases_s)


def _stacked(value: Any, shape: tuple[int, ...], formations: int | None) -> np.ndarray | None:
    """The numbers of each formation, ``(formation, *shape)``; None if they do not fit."""
    numbers = real_numbers(value)
    if numbers is None:
        return None
    count = 1 if formations is None else formations
    if numbers.shape == shape or (formations is not None and numbers.shape == (count, *shape)):
        return np.broadcast_to(numbers, (count, *shape)).copy()
    return None


def _described(value: Any) -> str:
    """A value in one short line, with its shape if it has one."""
    numbers = real_numbers(value)
    shape = f"the shape {numbers.shape}: " if numbers is not None and numbers.ndim else ""
    return shape + shown(value)
