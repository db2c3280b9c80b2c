"""The trials of a search in a folder: Optuna's study, stored so that a search can be resumed."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any

from baselines.runs.jobs import claim
from baselines.runs.provenance import git_revision, simulation_digest, versions
from baselines.runs.trials import TrialStore, optuna_package
from baselines.tuning.config import TuneConfig
from baselines.tuning.trial import Outcome, TrialJob
from tlf_env.task.neutral import scenario_hash

SEARCH_FILE = "search.json"
STUDY_NAME = "tune"
SCORES = "scores"  # attribute of a trial
NOT_CLAIMED = ("versions", "git_revision")  # entries of search.json that may change


def search_record(config: TuneConfig) -> dict[str, Any]:
    """The content of ``search.json``. Every scenario is made.

    Raises
    ------
    ValueError
        if optuna is missing, or a scenario is not valid.
    """
    optuna_package()
    asked = config.model_dump(mode="json")
    del asked["trials"]  # a larger number continues the search
    scenarios = {
        place: scenario_hash(scenario)
        for place, scenario in config.scenarios(config.ekf_slip).items()
    }
    return {
        **asked,
        "scenarios": scenarios,
        "simulation": simulation_digest(),
        "versions": versions(),
        "git_revision": git_revision(),
    }


class StoredStudy:
    """Optuna's study in a folder: it proposes trials and stores their outcomes.

    A proposal depends only on the finished trials, the sampler's seed and its own number, and it is
    stored before it is tried. So a resumed search with one worker has the same trials as a search
    without interruption.

    Raises
    ------
    ValueError
        if optuna is missing, the folder holds another search or one with another
        simulation, or its database cannot be read.
    """

    def __init__(
        self, config: TuneConfig, folder: Path, record: dict[str, Any] | None = None
    ) -> None:
        self.config = config
        optuna = optuna_package()
        record = record or search_record(config)
        folder.mkdir(parents=True, exist_ok=True)
        keys = tuple(key for key in record if key not in NOT_CLAIMED)
        claim(folder / SEARCH_FILE, record, keys, "a search")
        self.store = TrialStore(
            folder,
            STUDY_NAME,
            {
                path: optuna.distributions.FloatDistribution(span.low, span.high, log=span.log)
                for path, span in config.search.items()
            },
            sampler_seed=config.sampler_seed,
            startup_trials=config.startup_trials,
        )

    def trials(self, *states: str) -> list[Any]:
        """Trials in one of the states (without states: all), by number."""
        return self.store.trials(*states)

    def jobs(self) -> Iterator[TrialJob]:
        """The next trials to run: first the interrupted ones, then new proposals, up to ``trials``.

        A proposal is made only when the generator is advanced.
        """
        for cut in self.trials("RUNNING"):
            yield self._job(cut)
        while len(self.trials()) < self.config.trials:
            yield self._job(self.store.propose(self.config.start_values))

    def _job(self, trial: Any) -> TrialJob:
        return TrialJob(
            trial.number, self.values(trial.number), self.config.seeds.all, self._too_many()
        )

    def _too_many(self) -> dict[str, int]:
        """Failed runs at which a trial stops, by stratum; empty until the start has been run."""
        more = self.config.stop_after_failed
        first = [Outcome(**t.user_attrs[SCORES]) for t in self.trials("COMPLETE") if not t.number]
        if more is None or not first:
            return {}
        strata = first[0].strata
        failed = accumulate(int(row["failed"]) for row in strata.values())
        return {place: before + more for place, before in zip(strata, failed, strict=True)}

    def tell(self, outcome: Outcome) -> None:
        """Store the outcome of a trial; it is on the disk when this returns."""
        self.store.tell(
            outcome.number,
            outcome.score,
            {SCORES: outcome._asdict()},
            stopped_at=len(outcome.strata) if outcome.stopped else None,
        )

    def outcomes(self) -> list[Outcome]:
        """Outcomes of the completed trials, the best first."""
        finished = [Outcome(**t.user_attrs[SCORES]) for t in self.trials("COMPLETE")]
        return sorted(finished, key=lambda outcome: (outcome.score, outcome.number))

    def values(self, number: int) -> dict[str, float]:
        """The values of a trial, by path."""
        params = self.trials()[number].params
        return {path: params[path] for path in self.config.search}

    def finalists(self) -> list[int]:
        """Numbers of the best trials and of the start (trial 0)."""
        return self.store.finalists(self.config.choose.finalists)

    def chosen(self) -> dict[int, Outcome]:
        """Outcomes on the choosing seeds of those finalists that have been run there."""
        found = self.store.chosen(self.finalists())
        return {number: Outcome(**kept) for number, kept in found.items()}

    def choose(self, outcome: Outcome) -> None:
        """Store the outcome of a finalist on the choosing seeds."""
        self.store.choose(outcome.number, outcome._asdict())
