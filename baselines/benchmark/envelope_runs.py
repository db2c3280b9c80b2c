"""The runs of an envelope: levels tested here or on a Ray cluster; interrupted and resumed like a benchmark.

A level is finished when it is known to hold, or when so many seeds have failed that no end of the interval
depends on the rest. Finished levels go to ``levels.jsonl``, one line each.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from baselines.benchmark.envelope import (
    EnvelopePlan,
    Probe,
    Search,
    most_left,
    untested,
)
from baselines.benchmark.lines import BESIDE, beside
from baselines.policies.registry import fit_policy, policy_hash
from baselines.runs.jobs import alone_in, claim, spread
from baselines.runs.jsonl import append_line, read_lines
from baselines.runs.outcome import failed
from baselines.runs.provenance import git_revision, physics_digest, simulation_digest, versions
from baselines.runs.run import run_seeds, seed_blocks
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import check_trust
from tlf_env.task.neutral import scenario_hash

LEVELS_FILE, PLAN_FILE = "levels.jsonl", "envelope_plan.json"
CLAIMED = ("plan", "knobs", "policies", "scenarios", "simulation")
SECONDS_DIGITS = 2


def middle(values: Sequence[float | None]) -> float | None:
    """Median of the values that are not None."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def run_probe(plan: EnvelopePlan, probe: Probe) -> dict[str, Any]:
    """Run one level; the line that it adds to ``levels.jsonl``.

    ``failed`` counts the failed runs. With ``stopped`` it is a lower bound: the level was left when neither the
    envelope nor its interval depended on more.
    """
    since = time.process_time()
    fitted = fit_policy(probe.policy, plan.scenario(probe), trust=plan.trust)
    most = plan.counts.held if plan.counts.high is None else plan.counts.high
    lost, stopped = 0, False
    robots_of_runs: list[list[dict[str, Any]]] = []
    for seeds in seed_blocks(range(*plan.seeds)):
        runs = 0
        for record in run_seeds(
            fitted.scenario,
            fitted.policy,
            seeds,
            name=probe.policy,
            most_failed=most - lost,
            trust=plan.trust,
        ):
            runs += 1
            metrics = record.metrics()
            lost += failed(metrics)
            robots_of_runs.append([robot._asdict() for robot in metrics])
            if lost > most:
                break
        if not runs:  # more than most - lost runs of the block have failed
            lost = most + 1
        if lost > most:
            lost, stopped = most + 1, True
            break
    return {
        **probe._asdict(),
        "failed": lost,
        "stopped": stopped,
        **{
            metric: None if stopped else middle([beside(run, metric) for run in robots_of_runs])
            for metric in BESIDE
        },
        "scenario_hash": scenario_hash(fitted.scenario),
        "physics": physics_digest(),
        "privileged": fitted.scenario.privileged
        or bool(getattr(fitted.policy, "privileged", False)),
        "overrides": fitted.overrides,
        "seconds": round(time.process_time() - since, SECONDS_DIGITS),
    }


def plan_record(plan: EnvelopePlan) -> dict[str, Any]:
    """The content of ``envelope_plan.json``. Every knob is loaded at both ends, and every policy is made.

    Raises
    ------
    ValueError
        for an unknown name, a knob outside its range, a seed too large, a policy that does not fit, or code
        without permission.
    """
    checked_seed(plan.seeds[1] - 1)
    scenarios, policies = {}, {}
    for task in plan.tasks:
        for knob in plan.knobs:
            for scenario in plan.ends(task, knob):
                scenarios[f"{task}, {knob}, {scenario.disturbance.level:g}"] = scenario_hash(
                    scenario
                )
        for name in plan.policies:
            fitted = fit_policy(name, scenario, trust=plan.trust)
            check_trust(fitted.scenario.code, plan.trust)
            policies[name] = policy_hash(name, fitted.policy)
    asked = asdict(plan)
    del asked["trust"]  # a permission, which changes no result
    return {
        "plan": json.loads(json.dumps(asked)),
        "knobs": {name: knob.model_dump(mode="json") for name, knob in plan.loaded.items()},
        "policies": policies,
        "scenarios": scenarios,
        "physics": physics_digest(),
        "simulation": simulation_digest(),
        "versions": versions(),
        "git_revision": git_revision(),
    }


class EnvelopeResults:
    """The finished levels in a folder, and which are to be tested next.

    Raises
    ------
    ValueError
        if the plan cannot run, or the folder holds results of another plan, of other policies or of
        another simulation.
    """

    def __init__(self, folder: Path, plan: EnvelopePlan) -> None:
        self.folder, self.plan = folder, plan
        record = plan_record(plan)
        folder.mkdir(parents=True, exist_ok=True)
        claim(folder / PLAN_FILE, record, CLAIMED, "envelopes")
        self.lines: dict[Probe, dict[str, Any]] = {}
        self.read()

    def read(self) -> None:
        """Read the lines that are in the folder now."""
        self.lines = read_lines(self.folder / LEVELS_FILE, _probe_of)

    def add(self, line: dict[str, Any]) -> None:
        """Append one level; it is on the disk when this returns."""
        append_line(self.folder / LEVELS_FILE, line)
        self.lines[_probe_of(line)] = line

    def failed(self, search: Search) -> dict[int, int]:
        """Failed seeds at the tested places of a search's grid."""
        levels = self.plan.grids[search.knob].levels
        return {
            place: self.lines[probe]["failed"]
            for place, level in enumerate(levels)
            if (probe := Probe(*search, level)) in self.lines
        }

    def untested(self, search: Search) -> list[Probe]:
        """The levels of a search that are to be tested next."""
        found = self.plan.grids[search.knob]
        places = untested(found, self.failed(search), self.plan.counts)
        return [Probe(*search, found.levels[place]) for place in places]

    def most_left(self) -> int:
        """Largest number of levels that are still to be tested."""
        return sum(
            most_left(self.plan.grids[search.knob], self.failed(search), self.plan.counts)
            for search in self.plan.searches()
        )


def _probe_of(line: dict[str, Any]) -> Probe:
    return Probe(*(line[name] for name in Probe._fields))


class _Ready(Iterator[Probe]):
    """Levels to test, as far as they are known: it stops where answers are missing, and goes on after them."""

    def __init__(self, results: EnvelopeResults) -> None:
        self._results = results
        self._open = results.plan.searches()
        self._drawn: set[Probe] = set()

    def __next__(self) -> Probe:
        for search in list(self._open):
            todo = self._results.untested(search)
            if not todo:
                self._open.remove(search)
            for probe in todo:
                if probe not in self._drawn:
                    self._drawn.add(probe)
                    return probe
        raise StopIteration


def run_envelope(
    plan: EnvelopePlan,
    folder: Path,
    *,
    processes: int = 1,
    ray_address: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> EnvelopeResults:
    """Test the levels that the envelopes of a plan still need, here or on a Ray cluster.

    Raises
    ------
    ValueError
        for a plan that cannot run, or a folder in which another process works, before anything is run.
    """
    if processes < 1:
        raise ValueError(f"processes {processes} must be at least 1")
    results = EnvelopeResults(folder, plan)

    def report() -> None:
        if progress is not None:
            progress(len(results.lines), len(results.lines) + results.most_left())

    with alone_in(folder):
        results.read()
        report()
        for line in spread(
            run_probe, plan, _Ready(results), processes=processes, ray_address=ray_address
        ):
            results.add(line)
            report()
    return results
