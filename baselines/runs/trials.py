"""Trials of a search in a folder: Optuna's study, stored so that a search can be resumed."""

from __future__ import annotations

import errno
import os
import sqlite3
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tlf_env.common.errors import install_command

STUDY_FILE = "study.db"
# What a database that cannot be written answers, as errors of the system.
SQLITE_ERRORS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_CANTOPEN: errno.EACCES,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_BUSY: errno.EBUSY,
}
PRIMARY = 0xFF  # mask of the part of a code of SQLite that names the kind of error
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
        if optuna is missing, or the database is damaged.
    OSError
        if the database cannot be written, as of every method that stores something.
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

        self._path = folder / STUDY_FILE
        self._distributions = dict(distributions)
        self._sampler_seed, self._startup_trials = sampler_seed, startup_trials
        url = URL.create("sqlite", database=str(self._path.absolute()))
        with self._stored():
            self.study = optuna.create_study(
                storage=url.render_as_string(hide_password=False),
                study_name=name,
                load_if_exists=True,
            )
            self.study.get_trials()

    @contextmanager
    def _stored(self) -> Iterator[None]:
        """Report what the database cannot do as an error of the system, or that it is damaged."""
        from sqlalchemy.exc import SQLAlchemyError

        optuna = optuna_package()
        try:
            yield
        except (SQLAlchemyError, RuntimeError, optuna.exceptions.OptunaError) as error:
            number = SQLITE_ERRORS.get(_sqlite_code(error))
            if number is not None:
                raise OSError(number, os.strerror(number), str(self._path)) from error
            raise ValueError(
                f"{self._path} cannot be read; choose another --out, or remove {self._path.parent}"
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
        trial = optuna.trial.create_trial(
            state=optuna.trial.TrialState.RUNNING,
            params=self._proposal(known) if known else dict(start),
            distributions=self._distributions,
        )
        with self._stored():
            self.study.add_trial(trial)
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
        with self._stored():
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
        with self._stored():
            self.study.set_user_attr(CHOSEN.format(number), dict(outcome))


def _sqlite_code(error: BaseException | None) -> int:
    """The primary code of the error of SQLite beneath an error; 0 if there is none."""
    while error is not None:
        code = getattr(error, "sqlite_errorcode", None)
        if code is not None:
            return int(code) & PRIMARY
        error = getattr(error, "orig", None) or error.__cause__ or error.__context__
    return 0


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
