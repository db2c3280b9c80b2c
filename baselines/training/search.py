"""The search for better numbers of a training, by trainings; it can be interrupted and resumed.

Optuna's tree-structured Parzen estimator proposes values of some entries of the configuration. A trial is a
short training with each of the search's seeds; it stops when it is worse than the median of the trials before
it. The best trials and the start are then trained with other seeds, and the best of them is the result: a
configuration for ``tlf train``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from baselines.runs.jobs import alone_in, claim, spread
from baselines.runs.nested import value_at
from baselines.runs.provenance import git_revision, simulation_digest, versions
from baselines.runs.trials import TrialStore, optuna_package
from baselines.training.config import SearchConfig, TrainConfig
from baselines.training.curve import CURVE_FILE, kept_evaluation
from baselines.training.train import train
from tlf_env.common.files import atomic, read_json
from tlf_env.common.presets import yaml_text
from tlf_env.task.neutral import scenario_hash

SEARCH_FILE, FOUND_FILE = "search.json", "found.yaml"
STUDY_NAME = "train"
COURSES = "courses"  # attribute of a trial


class TrialJob(NamedTuple):
    """A trial to be trained."""

    number: int
    values: dict[str, Any]  # by path
    seeds: tuple[int, ...]
    folder: str  # below that of the search
    medians: tuple[
        float, ...
    ]  # best logarithm of the score so far, at each evaluation; empty: none


class Trained(NamedTuple):
    """What a trial came to."""

    number: int
    courses: list[list[float]]  # of each seed: scores at the evaluations, mm
    failed: (
        int  # runs of the kept policies' evaluations in which a robot was lost or touched another
    )
    stopped: bool

    @property
    def score_mm(self) -> float:
        """Geometric mean over the seeds of the best score, mm; less is better."""
        return math.exp(float(np.mean([math.log(min(course)) for course in self.courses])))


class Shared(NamedTuple):
    """What all trials share."""

    config: TrainConfig
    folder: Path
    threads: int


class _StoppedError(Exception):
    """A trial is worse than the median."""


def search_of(config: TrainConfig) -> SearchConfig:
    """The search of a configuration.

    Raises
    ------
    ValueError
        if it has none.
    """
    if config.search is None:
        raise ValueError(
            "--search needs a section `search` in the training, with `ranges` and `robot_steps`; the preset "
            "scratch has one"
        )
    return config.search


def trial_config(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """The training of a trial: with its values, the search's robot steps and its evaluations."""
    search = search_of(config)
    evaluation = config.evaluation.model_dump(mode="json")
    return config.with_values(
        values,
        robot_steps=search.robot_steps,
        checkpoint_every=search.robot_steps,
        evaluation=evaluation | {"every": max(1, search.robot_steps // search.evaluations)},
    )


def run_trial(shared: Shared, job: TrialJob) -> Trained:
    """Train a trial with each of its seeds, from checkpoints if there are any."""
    config, courses, failed = trial_config(shared.config, job.values), [], 0
    for seed in job.seeds:
        place = shared.folder / job.folder / f"seed_{seed}"
        place.mkdir(parents=True, exist_ok=True)
        course = evaluations_in(place)  # of a training that was interrupted
        try:
            curve = train(
                config, seed, place, threads=shared.threads, evaluated=_watch(course, job.medians)
            )
        except _StoppedError:
            return Trained(job.number, [[one["score_mm"] for one in course]], failed, True)
        courses.append([one["score_mm"] for one in curve["evaluations"]])
        failed += kept_evaluation(curve)["failed"]
    return Trained(job.number, courses, failed, False)


def evaluations_in(place: Path) -> list[dict[str, Any]]:
    """The evaluations of a training up to its last checkpoint."""
    path = place / CURVE_FILE
    return list(read_json(path)["evaluations"]) if path.exists() else []


def _watch(
    course: list[dict[str, Any]], medians: tuple[float, ...]
) -> Callable[[dict[str, Any]], None]:
    """Keep the evaluations of a training, and stop it where its best is worse than the median of others."""

    def evaluated(one: dict[str, Any]) -> None:
        course.append(one)
        best = math.log(min(each["score_mm"] for each in course))
        if 1 < len(course) < len(medians) and best > medians[len(course) - 1]:
            raise _StoppedError

    return evaluated


class TrainingSearch:
    """The trials of a search in a folder.

    Raises
    ------
    ValueError
        if the training has no search or optuna is missing; if the folder holds another search, or its
        database cannot be read.
    """

    def __init__(self, config: TrainConfig, folder: Path) -> None:
        self.config, self.search, self.folder = config, search_of(config), folder
        optuna = optuna_package()
        asked = config.model_dump(mode="json")
        del asked["search"]["trials"]  # a larger number continues the search
        record = {
            **asked,
            "scenarios": [
                f"{place}: {scenario_hash(one)}" for place, one in config.named_scenarios()
            ],
            "simulation": simulation_digest(),
            "torch": torch.__version__,
        }
        folder.mkdir(parents=True, exist_ok=True)
        keys = tuple(record)
        record |= {"versions": versions(), "git_revision": git_revision()}
        claim(folder / SEARCH_FILE, record, keys, "a search")
        self.store = TrialStore(
            folder,
            STUDY_NAME,
            {path: _distribution(optuna, span) for path, span in self.search.ranges.items()},
            sampler_seed=self.search.sampler_seed,
            startup_trials=self.search.startup_trials,
        )

    @property
    def start(self) -> dict[str, Any]:
        """The values of the configuration itself, as Optuna keeps them."""
        data = self.config.model_dump(mode="json")
        return {
            path: _stored(span, value_at(data, path)) for path, span in self.search.ranges.items()
        }

    def values(self, number: int) -> dict[str, Any]:
        """The values of a trial, by path."""
        params = self.store.trials()[number].params
        return {path: _taken(span, params[path]) for path, span in self.search.ranges.items()}

    def outcomes(self, *states: str) -> list[Trained]:
        """Outcomes of the trials in some states (without states: the completed ones), the best first."""
        found = [
            Trained(**trial.user_attrs[COURSES])
            for trial in self.store.trials(*(states or ("COMPLETE",)))
        ]
        return sorted(found, key=lambda one: (one.score_mm, one.number))

    def jobs(self) -> Iterator[TrialJob]:
        """The next trials to train: first the interrupted ones, then new proposals."""
        for cut in self.store.trials("RUNNING"):
            yield self._job(cut.number)
        while len(self.store.trials()) < self.search.trials:
            yield self._job(self.store.propose(self.start).number)

    def _job(self, number: int) -> TrialJob:
        return TrialJob(
            number,
            self.values(number),
            self.search.seeds,
            f"trial_{number:03d}",
            self._medians() if number >= self.search.startup_trials else (),
        )

    def _medians(self) -> tuple[float, ...]:
        """Median over the completed trials of the best logarithm of the score so far, at each evaluation."""
        courses = [np.log(course) for one in self.outcomes() for course in one.courses]
        if not courses:
            return ()
        count = min(len(course) for course in courses)
        best = [np.minimum.accumulate(course[:count]) for course in courses]
        return tuple(float(value) for value in np.median(best, axis=0))

    def tell(self, outcome: Trained) -> None:
        """Store the outcome of a trial."""
        steps = max(map(len, outcome.courses))
        self.store.tell(
            outcome.number,
            math.log(outcome.score_mm),
            {COURSES: outcome._asdict()},
            stopped_at=steps if outcome.stopped else None,
        )

    def finalists(self) -> list[int]:
        """Numbers of the best trials and of the start."""
        return self.store.finalists(self.search.finalists)

    def chosen(self) -> dict[int, Trained]:
        """What came of those finalists that were trained with the other seeds."""
        found = self.store.chosen(self.finalists())
        return {number: Trained(**kept) for number, kept in found.items()}

    def choose(self, outcome: Trained) -> None:
        """Store what came of a finalist."""
        self.store.choose(outcome.number, outcome._asdict())


def run_search(
    config: TrainConfig,
    folder: Path,
    *,
    processes: int = 1,
    ray_address: str | None = None,
    command: str = "",
    progress: Callable[[int, int], None] | None = None,
    finished: Callable[[Trained, dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Search, train the finalists with other seeds, and write ``found.yaml``.

    Parameters
    ----------
    folder
        Folder of ``search.json`` (the configuration), ``study.db`` (Optuna's), a folder for each training,
        and ``found.yaml``.
    processes
        Trials at a time. With more than one, the proposals depend on which trial ends first.
    progress
        Called with the number of trials done and their total, the finalists included.
    finished
        Called with each outcome and the trial's values.

    Returns
    -------
    dict
        What was found: ``values``, and the scores of every finalist.

    Raises
    ------
    ValueError
        as :class:`TrainingSearch`; if another process works in the folder.
    KeyboardInterrupt
        after an interrupt, once the trainings have written their checkpoints.
    """
    search_of(config)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        return _search(
            TrainingSearch(config, folder),
            processes,
            ray_address,
            command,
            progress or (lambda done, total: None),
            finished or (lambda outcome, values: None),
        )


def _search(
    found: TrainingSearch,
    processes: int,
    ray_address: str | None,
    command: str,
    update: Callable[[int, int], None],
    finished: Callable[[Trained, dict[str, Any]], None],
) -> dict[str, Any]:
    def outcomes(jobs: Iterable[TrialJob]) -> Iterator[Trained]:
        shared = Shared(found.config, found.folder, threads=1)
        for outcome in spread(
            run_trial, shared, jobs, processes=processes, ray_address=ray_address
        ):
            finished(outcome, found.values(outcome.number))
            yield outcome

    done = len(found.store.trials("COMPLETE", "PRUNED"))
    total = max(found.search.trials, done) + found.search.finalists + 1
    update(done, total)
    for outcome in outcomes(found.jobs()):
        found.tell(outcome)
        done += 1
        update(done, total)
    chosen = found.chosen()
    left = [number for number in found.finalists() if number not in chosen]
    for outcome in outcomes(_final(found, number) for number in left):
        found.choose(outcome)
        chosen[outcome.number] = outcome
        update(done + len(chosen), done + len(found.finalists()))
    return _write(found, chosen, command)


def _final(found: TrainingSearch, number: int) -> TrialJob:
    """The training of a finalist with the other seeds."""
    return TrialJob(
        number, found.values(number), found.search.choose_seeds, f"trial_{number:03d}", ()
    )


def _write(found: TrainingSearch, chosen: dict[int, Trained], command: str) -> dict[str, Any]:
    """Write the configuration of the best finalist, and say what was found."""
    ranking = sorted(chosen.values(), key=lambda one: (one.score_mm, one.number))
    best = ranking[0].number
    tried = {one.number: one for one in found.outcomes("COMPLETE", "PRUNED")}
    result: dict[str, Any] = {
        "trial": best,
        "values": found.values(best),
        "trials": len(tried),
        "stopped": sum(one.stopped for one in tried.values()),
        "finalists": [
            {
                "trial": one.number,
                "search_mm": tried[one.number].score_mm,
                "choose_mm": one.score_mm,
                "failed": one.failed,
                "values": found.values(one.number),
            }
            for one in ranking
        ],
    }
    file = found.config.with_values(result["values"]).model_dump(mode="json", exclude_none=True)
    with atomic(found.folder / FOUND_FILE, encoding="utf-8") as out:
        out.write(f"# Found by: {command or 'tlf train --search'}\n")
        out.write(f"# {json.dumps(result, ensure_ascii=False)}\n")
        out.write(yaml_text(file))
    return result


def _distribution(optuna: Any, span: Any) -> Any:
    """Optuna's distribution of a range; values of ``one_of`` are kept as their JSON."""
    kinds = optuna.distributions
    if span.one_of is not None:
        return kinds.CategoricalDistribution([json.dumps(value) for value in span.one_of])
    low, high = span.ends
    kind = kinds.IntDistribution if span.whole else kinds.FloatDistribution
    return kind(low, high, log=span.log)


def _stored(span: Any, value: Any) -> Any:
    """A value as Optuna keeps it.

    Raises
    ------
    ValueError
        for the start's value outside its range.
    """
    if span.one_of is not None:
        value = list(value) if isinstance(value, tuple) else value
        choices = [json.dumps(one) for one in span.one_of]
        if json.dumps(value) not in choices:
            raise ValueError(
                f"the training's own value {value} must be one of {', '.join(choices)}"
            )
        return json.dumps(value)
    if not span.low <= value <= span.high:
        raise ValueError(
            f"the training's own value {value} must lie within {span.low:g} to {span.high:g}"
        )
    return value


def _taken(span: Any, value: Any) -> Any:
    """A value of Optuna as the configuration has it; with six significant digits."""
    if span.one_of is not None:
        return json.loads(value)
    return value if span.whole else float(f"{value:.6g}")
