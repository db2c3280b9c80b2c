"""Recorded states and actions of formations, so that a timing starts in the middle of their episodes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tlf_env.engine.arrays import Arrays, make_arrays
from tlf_env.engine.batch import BatchPlant
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.actions import REFERENCE

THREADS = (1, 2)  # of a vector environment
SEEDS = 32  # formations that are recorded
# The reference that drives them, with the estimator that it is tuned for: no robot gets lost.
DRIVEN: dict[str, Any] = {
    "residual_base": "tuned",
    "estimator": "ekf-slip",
    "broadcast_smoothing_s": 0.0,
}
BEGUN_STEPS = 1000  # all robots move by then
MOMENTS = 16
STEPS_BETWEEN_MOMENTS = 100
STEPS_KEPT = 1500  # of the learner's actions, from each moment on


class Moments:
    """States of some formations under the reference at several moments of a lap, and all their actions.

    Parameters
    ----------
    robots
        In each formation.
    kept
        Control steps of actions that are kept from the last moment on.
    **fields
        Further fields of the scenario.
    """

    def __init__(self, robots: int, kept: int = STEPS_KEPT, **fields: Any) -> None:
        self.fields = {"robots": robots, "end_on": (), **DRIVEN, **fields}
        plant = BatchPlant("infinity", SEEDS, **self.fields)
        plant.reset(seed=0)
        plant.arrays.kinds[:] = REFERENCE
        idle = np.zeros(plant.arrays.actions.shape)
        last = BEGUN_STEPS + (MOMENTS - 1) * STEPS_BETWEEN_MOMENTS
        self.robots = robots
        self.kept = kept
        self.arrays: list[Arrays] = []
        self.actions = np.empty((last + kept - BEGUN_STEPS, *idle.shape))  # (step, lane, robot, 2)
        for step in range(last + kept):
            if BEGUN_STEPS <= step <= last and (step - BEGUN_STEPS) % STEPS_BETWEEN_MOMENTS == 0:
                self.arrays.append(Arrays(*(array.copy() for array in plant.arrays)))
            plant.step(idle)
            if step >= BEGUN_STEPS:
                self.actions[step - BEGUN_STEPS] = plant.arrays.actions
        self.lanes = np.flatnonzero(~plant.lost.any(axis=1))  # a lost robot may turn on the spot

    def places(self, formations: int) -> tuple[np.ndarray, np.ndarray]:
        """Moment and recorded lane of the state that each formation takes, both ``(formation,)``."""
        rows = np.arange(formations)
        return rows // len(self.lanes) % MOMENTS, self.lanes[rows % len(self.lanes)]

    def spread(self, plant: BatchPlant) -> None:
        """Copy the recorded states into a plant's formations, whatever their number; seeds, too."""
        rows = np.arange(plant.formations)
        moment, lanes = self.places(plant.formations)
        for name, axis in lane_axes(plant).items():
            if name == "kinds":
                continue
            into = np.moveaxis(getattr(plant.arrays, name), axis, 0)
            for number, arrays in enumerate(self.arrays):
                chosen = rows[moment == number]
                into[chosen] = np.moveaxis(getattr(arrays, name), axis, 0)[lanes[chosen]]

    def actions_of(self, formations: int, step: int) -> np.ndarray:
        """The reference's actions ``step`` steps later, (formation, robot, 2)."""
        moment, lanes = self.places(formations)
        return self.actions[moment * STEPS_BETWEEN_MOMENTS + step, lanes]


def lane_axes(plant: BatchPlant) -> dict[str, int]:
    """The axis that counts the lanes, for each array that has one."""
    one, two = (make_arrays(plant.scenarios, plant.arrays.tables[0], lanes) for lanes in (1, 2))
    axes = {}
    for name in Arrays._fields:
        few, more = getattr(one, name).shape, getattr(two, name).shape
        if few != more:
            axes[name] = next(i for i in range(len(few)) if few[i] != more[i])
    return axes


class VectorRun:
    """A vector environment in the middle of its episodes, stepped with recorded actions."""

    def __init__(self, moments: Moments, formations: int) -> None:
        self.moments, self.formations = moments, formations
        self.env = FormationVectorEnv(
            "infinity", formations, threads=max(THREADS), **moments.fields
        )
        self.env.reset(seed=0)
        self._next = moments.kept

    def drive(self, steps: int, threads: int) -> float:
        """Time of so many steps, s: robot_1 takes recorded actions, the reference drives the others."""
        moments = self.moments
        if steps > moments.kept:
            raise ValueError(f"steps {steps} must be at most {moments.kept}")
        if self._next + steps > moments.kept:
            moments.spread(self.env.plant)
            self._next = 0
        learner = min(1, moments.robots - 1)
        actions = [
            moments.actions_of(self.formations, self._next + k)[:, learner].astype(np.float32)
            for k in range(steps)
        ]
        self._next += steps
        self.env.plant.threads = threads
        start = time.perf_counter()
        for action in actions:
            self.env.step(action)
        return time.perf_counter() - start
