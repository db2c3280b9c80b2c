"""The median and the worst run of each cell of a leaderboard, and the command that runs each of them again."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from baselines.benchmark.lines import Line, Stratum, worst
from baselines.benchmark.plan import Episode, Plan
from baselines.policies.registry import runs_code
from baselines.runs.outcome import failed
from tlf_env.common.presets import parsed_yaml
from tlf_env.task.scenario import Scenario, scenario_with

METRIC = "position_rmse_mm"  # of the worst robot: by it the runs of a cell are ordered


class Notable(NamedTuple):
    """Two lines of the runs of a cell."""

    median: Line
    worst: Line


def notable(lines: Sequence[Line]) -> Notable:
    """The median and the worst of the runs of one cell.

    The median run is the one with the lower median of the position RMS of its worst robot, failed runs
    included. The worst run is one that failed, if any; among these the one with the largest position RMS.
    Among equals it is the smallest seed. An undefined error counts as infinite for the median, and as below
    all others for the worst.
    """

    def error(line: Line, undefined: float) -> float:
        value = worst(line, METRIC)
        return undefined if value is None else value

    ranked = sorted(lines, key=lambda line: (error(line, math.inf), line["seed"]))
    most = max(
        lines, key=lambda line: (failed(line["robots"]), error(line, -math.inf), -line["seed"])
    )
    return Notable(ranked[(len(ranked) - 1) // 2], most)


class Commands:
    """The commands ``tlf run`` of the episodes of a plan. Each is checked: it asks for the same scenario."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._place = cache(self._place_of)

    def words(self, episode: Episode) -> list[str] | None:
        """The words of the command, without ``tlf``; None if no command asks for exactly this run."""
        place = self._place(episode.task, episode.disturbance, episode.sweep)
        if place is None:
            return None
        code = runs_code(episode.policy) or self._plan.scenario(episode).code
        trust = ["--trust"] if self._plan.trust and code else []
        policy = ["--policy", episode.policy, "--seed", str(episode.seed)]
        return ["run", *place, *policy, *trust]

    def _place_of(self, task: str, disturbance: str, sweep: float | None) -> list[str] | None:
        """The words of task, disturbance, sweep and the plan's options; the first that fit."""
        plan = self._plan
        wanted = plan.scenario(Episode("", task, disturbance, plan.level, sweep, plan.seeds[0]))
        fields = dict(plan.overrides)
        base = [task, "--disturbance", disturbance]
        base += [
            word
            for key, value in fields.items()
            for word in (
                f"--{key.replace('_', '-')}",
                plain(value) if isinstance(value, float) else value,
            )
        ]
        fields["disturbance"] = disturbance
        swept, level = _swept(plan, sweep)
        for settings, asked in itertools.product(swept, (None, level)):
            if _same(wanted, task, fields, asked, settings):
                words = [word for one in settings.items() for word in ("--set", "=".join(one))]
                return [*base, *words, *([] if asked is None else ["--level", plain(asked)])]
        return None


def _swept(plan: Plan, sweep: float | None) -> tuple[list[dict[str, str]], float]:
    """Settings that may stand for the swept value, as texts by path, and the disturbance's level."""
    if plan.sweep is None or sweep is None:
        return [{}], plan.level
    if plan.sweep == "level":
        return [{}], sweep
    value = plain(sweep)
    return [{f"disturbance.{plan.sweep}": value}, {plan.sweep: value}], plan.level


def _same(
    wanted: Scenario,
    task: str,
    fields: Mapping[str, Any],
    level: float | None,
    settings: Mapping[str, str],
) -> bool:
    """Whether options of ``tlf run`` give a scenario, and leave a policy the same fields to ask for."""
    values = {path: parsed_yaml(text, path) for path, text in settings.items()}
    try:
        found = scenario_with(task, fields, level, values)
    except ValueError:
        return False
    return found == wanted and found.model_fields_set == wanted.model_fields_set


def plain(value: float) -> str:
    """A number that YAML reads as the same number; a whole one without a point."""
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    mantissa, e, exponent = repr(value).partition("e")
    return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else repr(value)


def key_of(row: Mapping[str, Any]) -> tuple[str, Stratum]:
    """Policy and stratum of a cell or of a line."""
    return row["policy"], (row["task"], row["disturbance"], row["sweep"])
