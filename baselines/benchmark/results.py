"""The folder of a benchmark's results: ``plan.json``, and a line of ``runs.jsonl`` per episode."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from baselines.benchmark.plan import Episode, Plan
from baselines.policies.registry import fit_policy, policy_hash
from baselines.runs.jobs import claim
from baselines.runs.jsonl import append_line, read_lines
from baselines.runs.provenance import (
    git_revision,
    physics_digest,
    simulation_digest,
    versions,
)
from tlf_env.numerics.philox import checked_seed
from tlf_env.task.neutral import scenario_hash
from tlf_env.task.scenario import Scenario

KeyT = TypeVar("KeyT")

RUNS_FILE, PLAN_FILE, BOARD_FILE, PAGE_FILE = (
    "runs.jsonl",
    "plan.json",
    "leaderboard.json",
    "leaderboard.md",
)

CLAIMED = ("plan", "policies", "scenarios", "simulation")  # what must not change in a folder


def plan_record(plan: Plan) -> dict[str, Any]:
    """The content of ``plan.json``. Every scenario is loaded and every policy is made.

    Raises
    ------
    ValueError
        for an unknown name, a knob outside its range, a seed too large, or a policy that does not fit.
    """
    checked_seed(plan.seeds[1] - 1)
    scenarios: dict[str, str] = {}
    policies: dict[str, str | None] = {}
    last: dict[str, Scenario] = {}  # of each task
    for task, disturbance in plan.places:
        for value in plan.values:
            episode = Episode("", task, disturbance, plan.level, value, plan.seeds[0])
            swept = () if value is None else (f"{value:g}",)
            last[task] = plan.scenario(episode)
            scenarios[", ".join((task, disturbance, *swept))] = scenario_hash(last[task])
    for scenario in last.values():
        for name in plan.policies:
            policies[name] = policy_hash(name, fit_policy(name, scenario, trust=plan.trust).policy)
    asked = asdict(plan)
    for field in plan.unrecorded:
        del asked[field]
    return {
        "plan": json.loads(json.dumps(asked)),
        "policies": policies,
        "scenarios": scenarios,
        "physics": physics_digest(),
        "simulation": simulation_digest(),
        "versions": versions(),
        "git_revision": git_revision(),
    }


class Results:
    """The lines of finished episodes in a folder, and which episodes are missing.

    Raises
    ------
    ValueError
        if the plan cannot run, or the folder holds results of another plan, of other policies or of
        another simulation.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self.plan = folder, plan
        record = plan_record(plan)
        folder.mkdir(parents=True, exist_ok=True)
        claim(folder / PLAN_FILE, record, CLAIMED, "results")
        self.lines: dict[Episode, dict[str, Any]] = {}
        self.read()

    def read(self) -> None:
        """Read the lines that are in the folder now."""
        self.lines = read_lines(self.folder / RUNS_FILE, Episode.of_line)

    def add(self, line: dict[str, Any]) -> None:
        """Append one episode; it is on the disk when this returns."""
        append_line(self.folder / RUNS_FILE, line)
        self.lines[Episode.of_line(line)] = line

    def missing(self) -> list[Episode]:
        """Episodes that have not been run."""
        return [episode for episode in self.plan.episodes() if episode not in self.lines]

    def ordered(self) -> list[dict[str, Any]]:
        """The finished lines in the plan's order."""
        return [self.lines[episode] for episode in self.plan.episodes() if episode in self.lines]
