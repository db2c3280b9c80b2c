"""Parts of one's own on board: an estimator, a wheel loop or an observer as a Python object.

A part is made by a *factory*, once per robot and once more at every reset: a class, a function, or
the string ``"module:factory"``. It is called as ``factory(robot, period_s)`` with the robot's
:class:`~tlf_env.physics.parameters.RobotParameters` and the period (s) at which the part will run.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tlf_env.onboard.observer import Message, Reference

PART_PATTERN = r"^[A-Za-z_][\w.]*:[A-Za-z_<][\w.<>]*$"  # <locals>, <lambda>: given as objects
Factory = Callable[..., Any]


class Estimator(Protocol):
    """Estimates the pose of c; runs at the physics period."""

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose ``(x mm, y mm, θ rad)``."""

    def update(self, steps_rad: np.ndarray, fix_mm: np.ndarray) -> np.ndarray:
        """Pose ``(3,)`` after one period.

        ``steps_rad`` are the angle increments of the left and right wheel, ``fix_mm`` the position fix.
        """


class WheelLoop(Protocol):
    """Turns wanted wheel speeds into torques; runs at the physics period."""

    def reset(self) -> None:
        """Start from rest."""

    def torque(self, wanted_rad_s: np.ndarray, measured_rad_s: np.ndarray) -> np.ndarray:
        """Torques ``(left, right)`` in N·mm; the motors clip them at the robot's limit."""


class Observer(Protocol):
    """Makes a follower's reference from what its predecessor broadcast one gap ago; control period."""

    def reset(self, pose: np.ndarray) -> None:
        """Start at the follower's own pose ``(x mm, y mm, θ rad)``."""

    def update(self, message: Message, t_s: float) -> Reference:
        """The reference for time ``t_s`` given the delayed message for that time."""


class Policy(Protocol):
    """Whatever acts: the signature of SB3's ``predict``."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions for a batch of observations, and the next state."""


def load_part(path: str) -> Factory:
    """The object that ``"module:factory"`` names; modules beside the working directory are found too.

    Raises
    ------
    ValueError
        if there is no such module or name.
    """
    module_name, _, name = path.partition(":")
    here = str(Path.cwd())
    added = here not in sys.path
    if added:
        sys.path.insert(0, here)
    try:
        target: Any = importlib.import_module(module_name)
        for part in name.split("."):
            target = getattr(target, part)
    except ImportError as error:
        raise ValueError(f"cannot import {module_name!r} of {path!r}: {error}") from error
    except AttributeError as error:
        raise ValueError(f"module {module_name!r} has no {name!r}") from error
    finally:
        if added:
            sys.path.remove(here)
    if not callable(target):
        raise ValueError(f"{path!r} is not callable; it must be a factory")
    return target


def part_name(factory: Factory) -> str:
    """``module:name`` of a factory, for the record."""
    return f"{factory.__module__}:{getattr(factory, '__qualname__', type(factory).__qualname__)}"


def finite(value: Any, size: int, what: str) -> np.ndarray:
    """What a part returned, as floats.

    Raises
    ------
    ValueError
        naming the part, if the shape is wrong or a number is not finite.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{what} must return {size} finite numbers, got {value!r}")
    return array
