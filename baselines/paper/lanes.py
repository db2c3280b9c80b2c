"""Many runs side by side, each with its own robot, seed and start, and their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from baselines.paper.formations import LOST_MM, LOST_RMS_MM, SETTLED_FROM, TAIL_FROM
from baselines.runs.run import PolicyDriver
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.readout import info_of
from tlf_env.onboard.parts import Policy
from tlf_env.task.scenario import Scenario
from tlf_env.task.warn import without_warnings


class Ends(NamedTuple):
    """Errors of runs, each array (run, robot)."""

    rms_mm: np.ndarray  # of the position error, from 40 % of the run on
    late_rms_mm: np.ndarray  # in the last 30 %
    largest_mm: np.ndarray  # at any time

    @property
    def gone(self) -> np.ndarray:
        """Which robots are lost, (run, robot): beyond 1200 mm at any time, or above 100 mm RMS at the end."""
        return np.asarray((self.largest_mm > LOST_MM) | (self.late_rms_mm > LOST_RMS_MM))

    @property
    def lost(self) -> np.ndarray:
        """Whether any robot of a run is lost, (run,)."""
        return np.asarray(self.gone.any(axis=1))

    @property
    def worst_mm(self) -> np.ndarray:
        """RMS position error of the worst robot of a run, (run,); infinite if a robot is lost."""
        return np.where(self.lost, np.inf, self.rms_mm.max(axis=1))


def started(
    scenarios: Sequence[Scenario], seeds: Sequence[int], poses: np.ndarray | None = None
) -> BatchPlant:
    """A batch at the start of its runs, one for each seed, without early ends and without contact.

    Run k drives scenario k modulo their number; ``poses`` are start poses ``(run, robot, 3)``.
    """
    with without_warnings():
        free = [one.model_copy(update={"end_on": (), "plant": "batch"}) for one in scenarios]
        plant = BatchPlant(free, len(seeds), threads=None)
    plant.reset(list(seeds), options=None if poses is None else {"poses": poses})
    return plant


def drive(
    scenarios: Sequence[Scenario],
    policy: Policy,
    seeds: Sequence[int],
    poses: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Ends:
    """Drive scenarios that a batch can hold (:class:`BatchPlant`), one run for each seed.

    Parameters
    ----------
    scenarios
        Run k drives scenario k modulo their number.
    poses
        Start poses ``(run, robot, 3)`` in mm, mm, rad; None: as the scenario says.
    progress
        Called with the control steps done and their total.
    """
    plant = started(scenarios, seeds, poses)
    steps, robots = plant.scenario.horizon_steps, plant.scenario.robot_count
    driver = PolicyDriver(policy, plant.scenario, plant.arrays, "reference")
    squares, late = np.zeros((2, len(seeds), robots))
    largest, error = np.zeros_like(squares), info_of(plant.arrays, "position_error_mm")
    for k in range(1, steps + 1):
        plant.step(driver.act())
        np.maximum(largest, error, out=largest)
        if k > SETTLED_FROM * steps:
            squares += error**2
        if k > TAIL_FROM * steps:
            late += error**2
        if progress is not None:
            progress(k, steps)
    counts = [steps - int(share * steps) for share in (SETTLED_FROM, TAIL_FROM)]
    return Ends(np.sqrt(squares / counts[0]), np.sqrt(late / counts[1]), largest)


class Several:
    """A policy that has one for each run, as many rows of the observation as robots for each."""

    def __init__(self, policies: Sequence[Policy]) -> None:
        self._policies = policies

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions of all rows; for laws without a memory."""
        parts = np.split(observation, len(self._policies))
        answers = [one.predict(rows)[0] for one, rows in zip(self._policies, parts, strict=True)]
        return np.concatenate(answers), state


def run_of(ends: Ends, runs: Any) -> Ends:
    """The errors of some runs: a slice, or places."""
    return Ends(*(array[runs] for array in ends))
