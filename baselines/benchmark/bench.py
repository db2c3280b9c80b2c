"""The benchmark: runs a plan's missing episodes, here or on a Ray cluster; it can be interrupted and resumed.

Every policy meets the same draws: a seed fixes noise, slip and starts, whatever the policy does.
Finished episodes go to ``runs.jsonl``, one line each, flushed to disk. They are not run again, and the
tables are made from the lines in a fixed order. So neither the number of processes nor an interruption
changes the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from baselines.benchmark.plan import Episode, Plan
from baselines.benchmark.results import Results
from baselines.policies.entries import step_statistics
from baselines.policies.registry import FittedPolicy, fit_policy
from baselines.runs.jobs import alone_in, spread
from baselines.runs.provenance import physics_digest
from baselines.runs.run import Record, run_policy, run_seeds, seed_blocks
from tlf_env.common.errors import install_command
from tlf_env.onboard.parts import check_trust
from tlf_env.task.neutral import scenario_hash
from tlf_env.task.scenario import Scenario, load_scenario

IN_FLIGHT_PER_PROCESS = 4


def run_episode(plan: Plan, episode: Episode) -> dict[str, Any]:
    """Run one episode; the line that it adds to ``runs.jsonl``.

    The scenario is the plan's with the fields that the policy asks for.
    """
    fitted = fit_policy(episode.policy, plan.scenario(episode), trust=plan.trust)
    record = run_policy(
        fitted.scenario, fitted.policy, episode.seed, name=episode.policy, trust=plan.trust
    )
    return _line(episode, fitted, record)


def run_block(plan: Plan, episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Run the episodes of a block, side by side if their plant is ``batch``; their lines."""
    first = episodes[0]
    scenario = plan.scenario(first)
    if scenario.plant != "batch":  # no policy may ask for another plant
        return [run_episode(plan, episode) for episode in episodes]
    fitted = fit_policy(first.policy, scenario, trust=plan.trust)
    seeds = [episode.seed for episode in episodes]
    records = run_seeds(fitted.scenario, fitted.policy, seeds, name=first.policy, trust=plan.trust)
    return [
        _line(episode, fitted, record) for episode, record in zip(episodes, records, strict=True)
    ]


def _line(episode: Episode, fitted: FittedPolicy, record: Record) -> dict[str, Any]:
    scenario = record.scenario
    times = getattr(fitted.policy, "step_times_s", None)  # of an entry that is a process of its own
    return {
        **episode._asdict(),
        "scenario_hash": scenario_hash(scenario),
        "physics": physics_digest(),
        "overrides": fitted.overrides,
        "privileged": scenario.privileged or bool(getattr(fitted.policy, "privileged", False)),
        "contact": record.contact,
        "string": record.string()._asdict(),
        "robots": [metrics._asdict() for metrics in record.metrics()],
        **({"step_ms": step_statistics(times, scenario.control_period_s)} if times else {}),
    }


def named_scenarios(plan: Plan) -> list[tuple[str, Scenario]]:
    """Every scenario of a plan with its task and disturbance, as the policies ask for it.

    Raises
    ------
    ValueError
        as :meth:`Plan.scenario` and :func:`~baselines.policies.registry.fit_policy`, and for code without
        permission.
    """
    named = []
    asked: dict[tuple[str, str], dict[str, Any]] = {}
    for task, disturbance in plan.places:
        for value in plan.values:
            episode = Episode("", task, disturbance, plan.level, value, plan.seeds[0])
            scenario = plan.scenario(episode)
            for policy in plan.policies:
                if (task, policy) not in asked:
                    fitted = fit_policy(policy, scenario, trust=plan.trust)
                    asked[task, policy] = fitted.overrides
                changed = load_scenario(scenario, **asked[task, policy])
                check_trust(changed.code, plan.trust)
                named.append((f"{task}, {disturbance}", changed))
    return named


def blocks(plan: Plan, episodes: Sequence[Episode]) -> list[tuple[Episode, ...]]:
    """Episodes that are run and written together: one by one, or on the batch plant up to 50 seeds.

    A block's episodes differ in their seeds only. Blocks come in the order of their first episodes.
    """
    if dict(plan.overrides).get("plant") != "batch":
        return [(episode,) for episode in episodes]
    alike: dict[Episode, list[Episode]] = {}
    for episode in episodes:
        alike.setdefault(episode._replace(seed=0), []).append(episode)
    parts = [tuple(part) for group in alike.values() for part in seed_blocks(group)]
    place = {episode: i for i, episode in enumerate(episodes)}
    return sorted(parts, key=lambda part: place[part[0]])


def need_tables() -> None:
    """Check that what the tables are made with is installed.

    Raises
    ------
    ValueError
        with the command that installs it.
    """
    if find_spec("arch") is None:
        raise ValueError(f"the tables need arch ({install_command('bench')})")


def run_bench(
    plan: Plan,
    folder: Path,
    *,
    processes: int = 1,
    ray_address: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    begin: Callable[[], None] = lambda: None,
) -> Results:
    """Run what is missing of a plan, here or on a Ray cluster.

    Parameters
    ----------
    begin
        Called once before the first episode, after the plan has been found to be valid.

    Raises
    ------
    ValueError
        for a plan that cannot run, or a folder in which another process works, before anything is run.
    """
    if processes < 1:
        raise ValueError(f"processes {processes} must be at least 1")
    need_tables()
    results = Results(folder, plan)
    with alone_in(folder):
        results.read()
        begin()
        todo = results.missing()
        total = len(plan.episodes())
        if progress is not None:
            progress(total - len(todo), total)
        finished = spread(
            run_block,
            plan,
            blocks(plan, todo),
            processes=processes,
            ray_address=ray_address,
            ahead=IN_FLIGHT_PER_PROCESS,
        )
        for lines in finished:
            for line in lines:
                results.add(line)
            if progress is not None:
                progress(len(results.lines), total)
    return results
