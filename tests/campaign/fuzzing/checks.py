"""What is allowed: an error in one line, or a valid result with finite numbers."""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from campaign.fuzzing.registry import ViolationError

import baselines
import tlf_env
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import Scenario

MOST_LINE = 3000  # characters of an error

REFUSED = object()
PACKAGES = [Path(str(one.__file__)).parent for one in (tlf_env, baselines)]


def in_one_line(error: BaseException) -> None:
    """Check that an error says something, in one line, and that it was raised on purpose."""
    said = str(error)
    kind = type(error).__name__
    place = accidental(error)
    if place:
        raise ViolationError(f"a {kind} that nothing raises, {place}", said[:500]) from error
    if not said.strip():
        raise ViolationError(f"a {kind} without a message")
    if len(said.splitlines()) > 1:
        raise ViolationError(f"a {kind} of several lines", repr(said[:500])) from error
    if len(said) > MOST_LINE:
        raise ViolationError(f"a {kind} of more than {MOST_LINE} characters", said[:200]) from error


def accidental(error: BaseException) -> str:
    """Where an error came up in the package without a ``raise``; empty if it was raised, or came up elsewhere.

    It is the error of a library in C, or of Python, and does not say which value is wrong.
    """
    frames = traceback.extract_tb(error.__traceback__)
    if not frames or not any(Path(frames[-1].filename).is_relative_to(one) for one in PACKAGES):
        return ""
    last = frames[-1]
    is_raised = (last.line or "").startswith("raise")
    return "" if is_raised else f"{Path(last.filename).name}: {last.line}"


def refused(make: Callable[[], Any], *more: type[BaseException]) -> Any:
    """What a function returns; REFUSED if it raises a documented error in one line."""
    try:
        return make()
    except (ValueError, *more) as error:
        in_one_line(error)
        return REFUSED


def finite(what: str, values: Any, limit: float = math.inf) -> None:
    """Check numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise ViolationError(f"{what} are no numbers", str(array.dtype))
    if not np.isfinite(array).all():
        raise ViolationError(f"{what} are not finite", repr(values)[:300])
    if array.size and np.abs(array.astype(np.float64)).max() > limit:
        raise ViolationError(f"{what} are out of their bounds", repr(values)[:300])


def small(scenario: Scenario) -> bool:
    """Whether a few steps of a scenario take little time and memory."""
    rays = 0 if scenario.rays is None else scenario.rays.count
    return (
        scenario.robot_count <= 8
        and scenario.substeps <= 200
        and scenario.horizon_steps <= 20_000
        and scenario.gap_steps <= 5_000
        and scenario.smoothing_steps <= 2_000
        and rays <= 64
        and len(scenario.preview_s) <= 20
        and not scenario.code
        and sum(len(getattr(scenario.world, name)) for name in type(scenario.world).model_fields)
        <= 40
    )


def driven(scenario: Scenario, steps: int = 3, action: float = 0.2) -> None:
    """Drive a scenario for a few steps in the parallel environment; all that it returns must be finite."""
    env = refused(lambda: tlf_env.parallel_env(scenario))
    if env is REFUSED:
        return
    started = refused(lambda: env.reset(seed=3))
    if started is REFUSED:
        return
    observed("at the start", env, *started)
    for k in range(steps):
        if not env.agents:
            break
        actions = {agent: np.array([action, 0.1 * (k - 1)]) for agent in env.agents}
        seen, rewards, ended, cut, infos = env.step(actions)
        finite("rewards", list(rewards.values()))
        observed("in a step", env, seen, infos)
        for flags in (ended, cut):
            if any(type(flag) is not bool for flag in flags.values()):
                raise ViolationError("flags are no switches")


def observed(when: str, env: Any, seen: Any, infos: Any) -> None:
    """Check what an environment has returned."""
    for agent, row in seen.items():
        finite(f"observations {when}", row, OBSERVATION_LIMIT)
        if not env.observation_space(agent).contains(row):
            raise ViolationError(f"observations {when} are not in their space", repr(row)[:200])
    finite(f"states {when}", env.state())
    for info in infos.values():
        for key, value in info.items():
            finite(f"infos {when}: {key}", value)


def driven_in_a_batch(scenario: Scenario, steps: int = 3) -> None:
    """As :func:`driven`, on the batch plant."""
    plant = refused(lambda: tlf_env.BatchPlant(scenario, 2))
    if plant is REFUSED or refused(lambda: plant.reset(seed=3)) is REFUSED:
        return
    for _ in range(steps):
        finite("observations in a batch", plant.observations, OBSERVATION_LIMIT)
        finite("rewards in a batch", plant.rewards)
        if plant.ended.any():
            break
        plant.step(np.full(plant.arrays.actions.shape, 0.2))


@contextlib.contextmanager
def working_folder() -> Iterator[Path]:
    """An empty folder to work in."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        try:
            yield Path(name)
        finally:
            os.chdir(before)
