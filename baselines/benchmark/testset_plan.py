"""What a benchmark on the test set runs: policies × cases, and the log of who has looked at the cases."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from baselines.benchmark.draws import words_of
from baselines.benchmark.plan import Episode, Plan
from baselines.benchmark.testset import NAME, VERSION, case_scenario
from baselines.runs.jsonl import append_line
from baselines.runs.provenance import git_revision, simulation_digest, versions
from baselines.runs.seed_ranges import FIRST_TABLE_SEED, SeedRange
from tlf_env.common.files import parse_json
from tlf_env.common.trust import Trust
from tlf_env.task.scenario import Scenario

PUBLISHED: SeedRange = (FIRST_TABLE_SEED, FIRST_TABLE_SEED + 200)
LOOKS_FILE = "looks.jsonl"


@dataclass(frozen=True)
class TestPlan(Plan):
    """A plan whose scenario is another one for each seed: the case of the test set with this number.

    Made by :func:`plan_of_test`. ``key`` makes a set of cases of its own; it is not written to any file,
    only ``fingerprint``, from which it cannot be computed.
    """

    __test__ = False  # for pytest
    unrecorded: ClassVar[tuple[str, ...]] = ("trust", "key")

    key: str = ""
    version: int = VERSION
    fingerprint: str = ""

    @property
    def published(self) -> bool:
        """Whether the cases are the published ones."""
        return not self.key

    def scenario(self, episode: Episode) -> Scenario:
        """The case with the episode's seed as its number."""
        return case_scenario(episode.seed, self.key)


def plan_of_test(
    policies: tuple[str, ...],
    seeds: SeedRange = PUBLISHED,
    key: str = "",
    *,
    trust: Trust = False,
) -> TestPlan:
    """The plan of a benchmark on the test set.

    Parameters
    ----------
    seeds
        Numbers of the cases, first and the one after the last; from 20000 on.
    key
        A secret text that makes a set of cases of its own; empty: the published set.

    Raises
    ------
    ValueError
        for a case below 20000.
    """
    if seeds[0] < FIRST_TABLE_SEED:
        raise ValueError(
            f"seeds {seeds[0]}:{seeds[1]}: the cases of the test set begin at {FIRST_TABLE_SEED}"
        )
    return TestPlan(
        policies=policies,
        tasks=(NAME,),
        disturbances=("own" if key else "published",),
        seeds=seeds,
        trust=trust,
        key=key,
        fingerprint=fingerprint(key),
    )


def fingerprint(key: str) -> str:
    """Twelve hexadecimal digits by which a set of cases is recognised."""
    if not key:
        return f"published-{VERSION}"
    return "".join(f"{word:08x}" for word in words_of(f"fingerprint {VERSION} {key}"))[:12]


def log_look(plan: TestPlan, folder: Path) -> None:
    """Append a look at the published cases to ``looks.jsonl``; nothing for cases of one's own."""
    if not plan.published:
        return
    look = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "version": plan.version,
        "cases": list(plan.seeds),
        "policies": list(plan.policies),
        "simulation": simulation_digest(),
        "git_revision": git_revision(),
        "versions": versions(),
    }
    append_line(folder / LOOKS_FILE, look)


def looks_of(folder: Path) -> list[dict[str, Any]]:
    """The logged looks, first to last.

    Raises
    ------
    ValueError
        naming a damaged line.
    """
    path = folder / LOOKS_FILE
    if not path.exists():
        return []
    found = []
    for number, text in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            found.append(dict(parse_json(text)))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}, line {number} is damaged; remove it") from error
    return found
