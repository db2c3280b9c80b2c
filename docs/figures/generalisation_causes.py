"""Why an error grows: one thing is changed and the same seeds are driven, for ``make_generalisation.py``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from generalisation_cells import CELLS, ENTRIES, LEARNED, scenario_of
from generalisation_runs import Job, Line, line_of, records, seeds_of, together

from baselines.policies.registry import FittedPolicy, fit_policy
from tlf_env.onboard.parts import Policy
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import Scenario

UNLIMITED = "kanayama:searched+ekf-gyro-smoothed+none"
SMALLER_TORQUES = {"torque_l": 0.1, "torque_r": 0.1}
NEARER = {"predecessor_forward": 5 / 8, "predecessor_right": 5 / 8}


class Cause(NamedTuple):
    """A change of entries in a cell."""

    name: str
    cell: str
    entries: tuple[str, ...] = LEARNED
    factors: dict[str, float] = {}  # on entries of the observation
    policy: str | None = None  # in place of the entry's own


CAUSES = (
    Cause("no limiter", "2 s, nominal", ("kanayama",), policy=UNLIMITED),
    Cause("place of the predecessor × 5/8", "8 s, nominal", factors=NEARER),
    Cause("torques × 0.1", "6 kg, `own_robot.yaml`, nominal", factors=SMALLER_TORQUES),
    Cause("torques × 0.1", "6 kg, `own_robot.yaml`, combined-medium", factors=SMALLER_TORQUES),
)


class Scaled:
    """A policy whose observation has some entries multiplied."""

    def __init__(self, policy: Policy, scenario: Scenario, factors: Mapping[str, float]) -> None:
        names = tracking_entries(scenario.preview_s, scenario.rays, scenario.neighbour)
        self._policy = policy
        self._factors = np.array([factors.get(name, 1.0) for name in names])

    def predict(self, observation: np.ndarray, *rest: Any) -> tuple[np.ndarray, Any]:
        """The policy's answer to the changed observation."""
        changed = (observation * self._factors).astype(observation.dtype)
        return self._policy.predict(changed, *rest)


def key_of(cause: Cause) -> str:
    """The name of a cause's kept lines."""
    return f"{cause.cell}: {cause.name}"


def changed(cause: Cause, entry: str) -> FittedPolicy:
    """The entry with the change, and its scenario."""
    (cell,) = [one for one in CELLS if one.name == cause.cell]
    found = fit_policy(cause.policy or ENTRIES[entry], scenario_of(cell))
    if not cause.factors:
        return found
    return found._replace(policy=Scaled(found.policy, found.scenario, cause.factors))


def lines_of(cause: Cause, entry: str, count: int) -> Line:
    """The kept line of a change and an entry."""
    (cell,) = [one for one in CELLS if one.name == cause.cell]
    seeds = tuple(seeds_of(cell, count))
    job = Job(cell, entry, seeds)
    runs = [line_of(job, "", record) for record in records(changed(cause, entry), seeds)]
    return {**together(cell, entry, runs), "table": "causes", "cell": key_of(cause)}


def driven(entries: tuple[str, ...], count: int) -> Iterator[Line]:
    """The kept lines of all changes of some entries."""
    for cause in CAUSES:
        for entry in cause.entries:
            if entry in entries:
                yield lines_of(cause, entry, count)
