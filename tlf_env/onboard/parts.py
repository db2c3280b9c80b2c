"""User-defined parts on board: an estimator, a wheel loop or an observer as a Python object.

A part is made by a *factory*, for each robot and again at every reset. A factory is a class, a function,
or the string ``"module:factory"``. It is called as ``factory(robot, period_s)`` with the robot's
:class:`~tlf_env.physics.vehicle.RobotParameters` and the period (s) at which the part runs.

A string may come from a file, so that a module is imported only if the caller allows it: with ``trust=True``
into this process, with ``trust="isolated"`` into one of its own (:mod:`tlf_env.hosting`). An object is code of
the caller and needs no permission.
"""

from __future__ import annotations

import importlib
import inspect
import math
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from tlf_env.common.errors import is_one_of, shown
from tlf_env.common.models import as_float, is_number
from tlf_env.common.trust import ISOLATED, Trust
from tlf_env.onboard.observer import Message, Reference

PART_PATTERN = r"^[A-Za-z_][\w.]*:[A-Za-z_<][\w.<>]*$"  # <locals>, <lambda>: given as objects
Factory = Callable[..., Any]

# Estimators in Python that are shipped with the package, by their names in systems. They need no permission.
PYTHON_ESTIMATORS = {
    "ukf": "baselines.policies.estimators.unscented:UnscentedEstimator",
    "moving-horizon": "baselines.policies.estimators.moving_horizon:MovingHorizonEstimator",
}

# Methods of each role, with their arguments.
METHODS: dict[str, dict[str, tuple[str, ...]]] = {
    "estimator": {"reset": ("pose",), "update": ("readings",)},
    "wheel_loop": {"reset": (), "torque": ("wanted_rad_s", "measured_rad_s")},
    "observer": {"reset": ("pose",), "update": ("message", "t_s")},
}
NO_SLIP, NO_COVARIANCE = np.zeros(2), np.zeros((3, 3))
ASYMMETRY = 1e-6  # of a covariance by rounding, relative to the standard deviations
PREDICT = {"predict": ("observation", "state", "episode_start", "deterministic")}


class Readings(NamedTuple):
    """Sensor readings of one physics period, and what was commanded in it."""

    t_s: float  # end of the period, from the start of the episode
    steps_rad: (
        np.ndarray
    )  # (2,) angle increments of the left and the right wheel, from the encoders
    fix_mm: np.ndarray | None  # (2,) position fix of c; None if none has arrived in this period
    fix_t_s: float | None  # the time at which that fix was taken; None without a fix
    gyro_rad_s: float  # yaw rate, at the end of the period
    wanted_rad_s: np.ndarray  # (2,) wheel speeds commanded; 0 with the action `torque`
    torques_Nmm: (
        np.ndarray
    )  # (2,) torques commanded, within the motors' limit; 0 on plant `kinematic`


class Estimated(NamedTuple):
    """What an estimator may return in place of the pose alone."""

    pose: Any  # (3,) of c: x and y (mm), heading (rad)
    twist: Any = None  # (2,) u₁ (mm/s) and u₂ (rad/s); None: wheels' odometry and the slip
    slip: Any = None  # (2,) δ₁ (mm/s) and δ₂ (rad/s) of eq. (14); None: 0
    covariance: Any = None  # (3, 3) of the pose: mm², mm·rad, rad²; None: 0
    nis: Any = None  # normalised innovation squared of the fix of this period; None: 0


class Estimator(Protocol):
    """Estimates the pose of c, and if it can, twist, slip and covariance; runs at the physics period."""

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose ``(x mm, y mm, θ rad)``."""

    def update(self, readings: Readings) -> np.ndarray | Estimated:
        """The pose ``(3,)`` at the end of a period, or an :class:`Estimated`."""


class WheelLoop(Protocol):
    """Turns wanted wheel speeds into torques; runs at the physics period."""

    def reset(self) -> None:
        """Start from rest."""

    def torque(self, wanted_rad_s: np.ndarray, measured_rad_s: np.ndarray) -> np.ndarray:
        """Torques ``(left, right)`` in N·mm; the motors clip them at the robot's limit."""


class Observer(Protocol):
    """Makes a follower's reference from its predecessor's broadcast of one gap ago; control period."""

    def reset(self, pose: np.ndarray) -> None:
        """Start at the follower's own pose ``(x mm, y mm, θ rad)``."""

    def update(self, message: Message, t_s: float) -> Reference:
        """The reference at time ``t_s`` from the delayed message for that time."""


class Policy(Protocol):
    """A policy, with the signature of SB3's ``predict``."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions for a batch of observations, and the next state."""


def check_trust(code: Mapping[str, str], trust: Trust) -> None:
    """Check that the modules of some parts may be imported.

    Parameters
    ----------
    code
        ``"module:factory"`` by role.
    trust
        Whether the user allows code of any module, True or ``"isolated"``; :data:`PYTHON_ESTIMATORS` are always
        allowed.

    Raises
    ------
    ValueError
        in one line that names the first part and how to allow it.
    """
    if not isinstance(trust, bool) and not is_one_of(trust, [ISOLATED]):
        raise ValueError(f"trust {shown(trust)} must be True, False or {ISOLATED!r}")
    for role, path in code.items():
        if not trust and path not in PYTHON_ESTIMATORS.values():
            raise ValueError(
                f"{role} {path!r} runs code of the module {path.partition(':')[0]!r}; allow that with "
                "--trust, in Python with trust=True"
            )


def runs_apart(path: str, trust: Trust) -> bool:
    """Whether the code that a name stands for runs in a process of its own."""
    return trust == ISOLATED and path not in PYTHON_ESTIMATORS.values()


def load_part(role: str, path: str, *, trust: Trust) -> Factory:
    """The object that ``"module:factory"`` names; modules in the working directory are found too.

    Parameters
    ----------
    role
        What the part is for, for errors.
    trust
        As of :func:`check_trust`.

    Raises
    ------
    ValueError
        in one line, if it may not be imported, if there is no such module or name, or the module raises
        any error when it is imported.
    """
    check_trust({role: path}, trust)
    module_name, _, name = path.partition(":")
    here = str(Path.cwd())
    # A file of the same name in the working directory must not take the place of a shipped module.
    added = here not in sys.path and path not in PYTHON_ESTIMATORS.values()
    if added:
        sys.path.insert(0, here)
    try:
        target: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a user's module can raise any error
        kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
        why = " ".join(f"{kind}{error}".split())
        raise ValueError(f"cannot import {module_name!r} of {path!r}: {why}") from error
    finally:
        if added and here in sys.path:
            sys.path.remove(here)
    try:
        for part in name.split("."):
            target = getattr(target, part)
    except AttributeError as error:
        raise ValueError(f"module {module_name!r} has no {name!r}") from error
    if not callable(target):
        raise ValueError(f"{path!r} is not callable; it must be a factory")
    return target


def make_part(role: str, name: str, factory: Factory, *given: Any) -> Any:
    """A part of a role, ``factory(*given)``: a robot and a period (s), or nothing for a policy.

    Parameters
    ----------
    role
        ``estimator``, ``wheel_loop`` or ``observer``; any other role (``policy``, ``others``) needs
        SB3's ``predict``.
    name
        Name of the factory, for errors.

    Raises
    ------
    ValueError
        in one line with role, factory and the required methods, if the factory raises a TypeError, or
        if its result lacks a method or has one that does not accept the arguments.
    """
    what = f"{role} {name!r}"
    call = "factory(robot, period_s)" if given else "factory()"
    try:
        part = factory(*given)
    except TypeError as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{what} cannot be made by {call}: {why}") from error
    methods = METHODS.get(role, PREDICT)
    wanted = " and ".join(f"{one}({', '.join(names)})" for one, names in methods.items())
    for method, names in methods.items():
        found = getattr(part, method, None)
        if isinstance(part, type) or not callable(found):
            made = f"the class {part.__name__}" if isinstance(part, type) else type(part).__name__
            raise ValueError(
                f"{what} has no {method}(): {call} made {made}; the result needs {wanted}"
            )
        try:
            signature = inspect.signature(found)
        except (TypeError, ValueError):  # a built-in without a signature
            continue
        try:
            signature.bind(*names)
        except TypeError as error:
            hint = "; readings is a tlf_env.Readings" if names == ("readings",) else ""
            raise ValueError(
                f"{what}: {method}{signature} cannot be called as {method}({', '.join(names)}): "
                f"{error}{hint}"
            ) from error
    return part


def is_part(name: str | None) -> bool:
    """Whether a name is ``module:factory``: code that is run, in place of a preset or a file of numbers."""
    return name is not None and re.match(PART_PATTERN, name) is not None


def part_name(factory: Factory) -> str:
    """``module:name`` of a factory, for the scenario."""
    return f"{factory.__module__}:{getattr(factory, '__qualname__', type(factory).__qualname__)}"


def real_numbers(value: Any) -> np.ndarray | None:
    """The value as float64, or None if it contains anything but real numbers, as text or True."""
    if type(value) is np.ndarray:  # the usual case, in half the time
        return value.astype(np.float64) if value.dtype.kind in "iuf" else None
    try:
        array = np.asarray(value)
        fits = array.dtype.kind in "iuf" and not _has_switch(value)
        return array.astype(np.float64) if fits else None
    except Exception:  # a tensor raises any kind, for example if it has a gradient
        return None


def _has_switch(value: Any) -> bool:
    """Whether True or False is among the values of a list; NumPy would make it a number."""
    if isinstance(value, list | tuple):
        return any(_has_switch(one) for one in value)
    return isinstance(value, bool) or getattr(getattr(value, "dtype", None), "kind", "") == "b"


def predicted(answer: Any, shape: tuple[int, ...], policy: str) -> tuple[np.ndarray, Any]:
    """The result of a policy's ``predict``: actions, float64 in ``shape``, and the next state.

    Raises
    ------
    ValueError
        naming the policy, if it is not a pair, or the actions are not real numbers in that shape.
    """
    if not isinstance(answer, tuple) or len(answer) != 2:
        size = f" of {len(answer)}" if isinstance(answer, tuple) else ""
        raise ValueError(
            f"{policy}: predict() must return a pair, (actions, state), got {type(answer).__name__}{size}"
        )
    actions = real_numbers(answer[0])
    if actions is None:
        raise ValueError(
            f"{policy}: the actions must be real numbers in the shape {shape}, got {shown(answer[0])}"
        )
    if actions.shape != shape:
        raise ValueError(f"{policy}: the actions must have the shape {shape}, got {actions.shape}")
    return actions, answer[1]


def finite(value: Any, size: int, what: str, quantity: str = "") -> np.ndarray:
    """The result of a part, as floats.

    Parameters
    ----------
    what
        Robot and part, for errors.
    quantity
        Which of several quantities it is, for errors.

    Raises
    ------
    ValueError
        naming the part, if the shape is wrong or a number is not finite.
    """
    array = real_numbers(value)
    if array is None or array.shape != (size,) or not np.isfinite(array).all():
        named = f"{quantity} of " if quantity else ""
        raise ValueError(f"{what} must return {named}{size} finite numbers, got {shown(value)}")
    return array


def checked_estimate(answer: Any, what: str) -> Estimated:
    """The result of an estimator as arrays of floats; ``twist`` stays None if it is not given.

    Raises
    ------
    ValueError
        naming the part and the quantity, if a shape is wrong, a number is not finite, the covariance is
        not symmetric or has a negative variance, or the normalised innovation squared is negative.
    """
    given = answer if isinstance(answer, Estimated) else Estimated(answer)
    return Estimated(
        pose=finite(given.pose, 3, what),
        twist=None if given.twist is None else finite(given.twist, 2, what, "a twist"),
        slip=NO_SLIP if given.slip is None else finite(given.slip, 2, what, "a slip"),
        covariance=NO_COVARIANCE
        if given.covariance is None
        else checked_covariance(given.covariance, what),
        nis=0.0 if given.nis is None else checked_nis(given.nis, what),
    )


def checked_nis(value: Any, what: str) -> float:
    """A normalised innovation squared, as a float.

    Raises
    ------
    ValueError
        naming the part, for anything but one finite number of at least 0.
    """
    if is_number(value) and 0.0 <= as_float(value) < math.inf:
        return as_float(value)
    raise ValueError(
        f"{what} must return a normalised innovation squared of at least 0, got {shown(value)}"
    )


def checked_covariance(value: Any, what: str) -> np.ndarray:
    """A covariance of the pose, ``(3, 3)``, as floats.

    Raises
    ------
    ValueError
        naming the part, for another shape, a number that is not finite, a negative variance, or a matrix
        that is not symmetric.
    """
    array = real_numbers(value)
    if array is None or array.shape != (3, 3) or not np.isfinite(array).all():
        wrong = "a covariance of 3 × 3 finite numbers"
    elif (array.diagonal() < 0.0).any():
        wrong = "a covariance without negative variances"
    else:
        deviations = np.sqrt(array.diagonal())
        rounding = ASYMMETRY * np.outer(deviations, deviations)
        if not (np.abs(array - array.T) > rounding).any():
            return array
        wrong = "a symmetric covariance"
    raise ValueError(f"{what} must return {wrong}, got {shown(value)}")
