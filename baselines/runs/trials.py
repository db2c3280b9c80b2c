"""Trials of a search in a folder: Optuna's study, stored so that a search can be resumed."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tlf_env.common.errors import install_command

STUDY_FILE = "study.db"
CHOSEN = "choose_{}"  # attribute of the study for each finalist


class TrialStore:
    """Optuna's study in a folder: it proposes trials and stores their outcomes.

    A proposal depends only on the finished trials, the sampler's seed and its own number, and it is
    stored before it is tried. So a resumed search that runs one trial at a time has the same trials as a
    search without interruption.

    Parameters
    ----------
    folder
        Holds the study's database, ``study.db``.
    name
        Name of the study in it.
    distributions
        Optuna's distribution of each value, by path.
    sampler_seed, startup_trials
        Of Optuna's tree-structured Parzen estimator: its seed, and how many trials it draws at random first.

    Raises
    ------
    ValueError
        if optuna is missing, or the database cannot be read.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        distributions: Mapping[str, Any],
        *,
        sampler_seed: int,
        startup_trials: int,
    ) -> None:
        optuna = optuna_package()
        from sqlalchemy import URL
        from sqlalchemy.exc import SQLAlchemyError

        self._distributions = dict(distributions)
        self._sampler_seed, self._startup_trials = sampler_seed, startup_trials
        url = URL.create("sqlite", database=str((folder / STUDY_FILE).absolute()))
        try:
            self.study = optuna.create_study(
                storage=url.render_as_string(hide_password=False),
                study_name=name,
                load_if_exists=True,
            )
            self.study.get_trials()
        except (SQLAlchemyError, RuntimeError, optuna.exceptions.OptunaError) as error:
            raise ValueError(
                f"{folder / STUDY_FILE} cannot be read; choose another --out, or remove {folder}"
            ) from error

    def trials(self, *states: str) -> list[Any]:
        """Trials in one of the states (without states: all), by number."""
        kept = [
            trial
            for trial in self.study.get_trials(deepcopy=False)
            if not states or trial.state.name in states
        ]
        return sorted(kept, key=lambda trial: trial.number)

    def propose(self, start: Mapping[str, Any]) -> Any:
        """The next trial, stored as running; the first has the values of the start."""
        optuna = optuna_package()
        known = self.trials()
        self.study.add_trial(
            optuna.trial.create_trial(
                state=optuna.trial.TrialState.RUNNING,
                params=self._proposal(known) if known else dict(start),
                distributions=self._distributions,
            )
        )
        return self.trials()[-1]

    def _proposal(self, known: list[Any]) -> dict[str, Any]:
        """Values of the next trial, proposed by a study in memory that contains all trials so far."""
        optuna = optuna_package()
        entropy = np.random.SeedSequence([self._sampler_seed, len(known)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            sampler = optuna.samplers.TPESampler(
                multivariate=True,
                constant_liar=True,
                n_startup_trials=self._startup_trials,
                seed=int(entropy.generate_state(1)[0]),
            )
        mirror = optuna.create_study(sampler=sampler)
        mirror.add_trials(known)
        values: dict[str, Any] = mirror.ask(self._distributions).params
        return values

    def tell(
        self, number: int, score: float, notes: Mapping[str, Any], stopped_at: int | None = None
    ) -> None:
        """Store the score of a trial and notes on it; it is on the disk when this returns.

        ``stopped_at`` is the step at which a trial was stopped before its end; None: it was not.
        """
        optuna = optuna_package()
        handle = optuna.trial.Trial(self.study, self.trials()[number]._trial_id)
        for name, value in notes.items():
            handle.set_user_attr(name, value)
        if stopped_at is None:
            self.study.tell(number, score)
        else:  # Optuna takes the last intermediate value of a pruned trial
            handle.report(score, stopped_at)
            self.study.tell(number, state=optuna.trial.TrialState.PRUNED)

    def finalists(self, count: int) -> list[int]:
        """Numbers of the completed trials with the smallest scores, and of the start (trial 0)."""
        done = sorted(self.trials("COMPLETE"), key=lambda trial: (trial.value, trial.number))
        best = [trial.number for trial in done[:count]]
        return best if 0 in best else [*best, 0]

    def chosen(self, numbers: Iterable[int]) -> dict[int, dict[str, Any]]:
        """What :meth:`choose` has stored of some finalists, by number."""
        kept = self.study.user_attrs
        keys = {number: CHOSEN.format(number) for number in numbers}
        return {number: kept[key] for number, key in keys.items() if key in kept}

    def choose(self, number: int, outcome: Mapping[str, Any]) -> None:
        """Store the outcome of a finalist on the seeds that choose."""
        self.study.set_user_attr(CHOSEN.format(number), dict(outcome))


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
