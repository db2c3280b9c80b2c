"""The trials of a search in a folder: Optuna's study, stored so that a search can be resumed."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from baselines.runs.jobs import claim
from baselines.runs.provenance import git_revision, simulation_digest, versions
from baselines.tuning.config import TuneConfig
from baselines.tuning.trial import Outcome, TrialJob
from tlf_env.common.errors import install_command
from tlf_env.task.neutral import scenario_hash

SEARCH_FILE, STUDY_FILE = "search.json", "study.db"
STUDY_NAME = "tune"
SCORES, CHOSEN = "scores", "choose_{}"  # attributes of a trial, and of the study for each finalist


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

    def __init__(self, config: TuneConfig, folder: Path) -> None:
        self.config = config
        optuna = optuna_package()
        from sqlalchemy import URL
        from sqlalchemy.exc import SQLAlchemyError

        asked = config.model_dump(mode="json")
        del asked["trials"]  # a larger number continues the search
        scenarios = {
            place: scenario_hash(scenario)
            for place, scenario in config.scenarios(config.ekf_slip).items()
        }
        record = {**asked, "scenarios": scenarios, "simulation": simulation_digest()}
        folder.mkdir(parents=True, exist_ok=True)
        keys = tuple(record)
        record |= {"versions": versions(), "git_revision": git_revision()}
        claim(folder / SEARCH_FILE, record, keys, "a search")
        url = URL.create("sqlite", database=str((folder / STUDY_FILE).absolute()))
        try:
            self._study = optuna.create_study(
                storage=url.render_as_string(hide_password=False),
                study_name=STUDY_NAME,
                load_if_exists=True,
            )
            self._study.get_trials()
        except (SQLAlchemyError, RuntimeError, optuna.exceptions.OptunaError) as error:
            raise ValueError(
                f"{folder / STUDY_FILE} cannot be read; choose another --out, or remove {folder}"
            ) from error
        self._distributions = {
            path: optuna.distributions.FloatDistribution(span.low, span.high, log=span.log)
            for path, span in config.search.items()
        }

    def trials(self, *states: str) -> list[Any]:
        """Trials in one of the states (without states: all), by number."""
        kept = [
            trial
            for trial in self._study.get_trials(deepcopy=False)
            if not states or trial.state.name in states
        ]
        return sorted(kept, key=lambda trial: trial.number)

    def jobs(self) -> Iterator[TrialJob]:
        """The next trials to run: first the interrupted ones, then new proposals, up to ``trials``.

        A proposal is made only when the generator is advanced.
        """
        optuna = optuna_package()
        for cut in self.trials("RUNNING"):
            yield self._job(cut)
        while len(known := self.trials()) < self.config.trials:
            self._study.add_trial(
                optuna.trial.create_trial(
                    state=optuna.trial.TrialState.RUNNING,
                    params=self._proposal(known) if known else self.config.start_values,
                    distributions=self._distributions,
                )
            )
            yield self._job(self.trials()[-1])

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

    def _proposal(self, known: list[Any]) -> dict[str, float]:
        """Values of the next trial, proposed by a study in memory that contains all trials so far."""
        optuna = optuna_package()
        entropy = np.random.SeedSequence([self.config.sampler_seed, len(known)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            sampler = optuna.samplers.TPESampler(
                multivariate=True,
                constant_liar=True,
                n_startup_trials=self.config.startup_trials,
                seed=int(entropy.generate_state(1)[0]),
            )
        mirror = optuna.create_study(sampler=sampler)
        mirror.add_trials(known)
        values: dict[str, float] = mirror.ask(self._distributions).params
        return values

    def tell(self, outcome: Outcome) -> None:
        """Store the outcome of a trial; it is on the disk when this returns."""
        optuna = optuna_package()
        handle = optuna.trial.Trial(self._study, self.trials()[outcome.number]._trial_id)
        handle.set_user_attr(SCORES, outcome._asdict())
        if outcome.stopped:  # Optuna takes the last intermediate value of a pruned trial
            handle.report(outcome.score, len(outcome.strata))
            self._study.tell(outcome.number, state=optuna.trial.TrialState.PRUNED)
        else:
            self._study.tell(outcome.number, outcome.score)

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
        best = [outcome.number for outcome in self.outcomes()[: self.config.choose.finalists]]
        return best if 0 in best else [*best, 0]

    def chosen(self) -> dict[int, Outcome]:
        """Outcomes on the choosing seeds of those finalists that have been run there."""
        attributes = self._study.user_attrs
        keys = {number: CHOSEN.format(number) for number in self.finalists()}
        return {n: Outcome(**attributes[key]) for n, key in keys.items() if key in attributes}

    def choose(self, outcome: Outcome) -> None:
        """Store the outcome of a finalist on the choosing seeds."""
        self._study.set_user_attr(CHOSEN.format(outcome.number), outcome._asdict())


def optuna_package() -> Any:
    """The package optuna, with its log messages below warnings switched off.

    Raises
    ------
    ValueError
        if it is missing.
    """
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise ValueError(f"the search needs optuna ({install_command('tune')})") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
