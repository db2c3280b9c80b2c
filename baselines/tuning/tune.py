"""The search for a controller's gains, limits and filter parameters, interrupted and resumed at will.

A configuration names a start, ranges, tasks, disturbances and seeds. Optuna's tree-structured Parzen
estimator proposes; every trial drives all tasks and disturbances on the batch plant. The best trials
and the start then meet seeds that the search has not seen, and the best of them is the result: a
controller file with the scores of both beside it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np
import yaml
from pydantic import (
    BaseModel,
    Field,
    FiniteFloat,
    ValidationError,
    field_validator,
    model_validator,
)

from baselines.benchmark.bench import (
    FIRST_CHOOSING_SEED,
    FIRST_TABLE_SEED,
    SEEDS_PER_BLOCK,
    git_revision,
    scenario_hash,
    with_value,
)
from baselines.policies.reference import ReferencePolicy
from baselines.runs.jobs import alone_in, claim, spread
from baselines.runs.run import Record, run_seeds, versions
from tlf_env.common.errors import one_line
from tlf_env.common.files import atomic
from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.common.presets import read_preset_or_file
from tlf_env.numerics.compiled import sources_digest
from tlf_env.onboard.controllers import ControllerFile, controller
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.tracking import Controller, controller_row
from tlf_env.task.metrics import ERROR_CAP_MM, FORMATION_SETTLE_S, LOST_RMS_MM
from tlf_env.task.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    pass

SEARCH, STUDY, RESULT = "search.json", "study.db", "tuned.yaml"
STUDY_NAME = "tune"
SCORES, CHOSEN = "scores", "choose_{}"  # attributes of a trial, and of the study for each finalist
DIGITS = 6  # of a value that is tried, and so of one that is found
SMALLEST = 1e-3  # a measure below it counts as it
# A measure counts up to its cap; a failed run has every measure at its cap, and more on top.
CAPS = {
    "position_rmse_mm": LOST_RMS_MM,
    "settled_formation_rmse_mm": LOST_RMS_MM,
    "error_capped_mean_mm": ERROR_CAP_MM,
    "torque_rms_Nmm": 15.0,
}


class Range(Frozen):
    """Where a number is looked for, ends included."""

    low: FiniteFloat
    high: FiniteFloat
    log: bool = False  # evenly in the logarithm
    times: str | None = None  # the number is this many times the one at that path

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.log and self.low <= 0:
            raise ValueError(f"low {self.low:g} must be above 0 with log true")
        return self


class Seeds(Frozen):
    """Seeds ``first`` to ``first + count - 1``."""

    first: int = Field(ge=0)
    count: int = Field(ge=1, le=1000)

    @property
    def all(self) -> list[int]:
        """The seeds themselves."""
        return list(range(self.first, self.first + self.count))


class Choice(Seeds):
    """Seeds on which the best trials and the start are compared."""

    finalists: int = Field(default=5, ge=1)  # and the start


class Objective(Frozen):
    """Weights of the logarithms of a run's measures, and what a failed run costs on top."""

    position_rmse_mm: NonNegative = 1.0  # of the worst robot
    settled_formation_rmse_mm: NonNegative = 0.5  # of the worst robot
    error_capped_mean_mm: NonNegative = 0.5  # mean over the robots
    torque_rms_Nmm: NonNegative = 0.5  # RMS over the robots
    failed: Positive = 3.0

    def cost(self, measures: dict[str, float], failed: bool) -> float:
        """Cost of a run: the weighted sum of its measures' logarithms.

        A failed run costs ``failed`` more than the most that any other may cost.
        """
        total = self.failed if failed else 0.0
        for name, cap in CAPS.items():
            value = cap if failed else min(max(measures[name], SMALLEST), cap)
            total += getattr(self, name) * math.log(value)
        return total


class TuneConfig(Frozen):
    """A search. Paths are those of :class:`Controller` (``gains.k_1_per_s``) and of ``ekf_slip``."""

    start: Controller  # or the name of a preset; the first trial
    estimator: Literal["ekf-slip", "ekf", "truth"] = "ekf-slip"
    ekf_slip: SlipEkfParameters = SlipEkfParameters()
    search: dict[str, Range] = Field(min_length=1)
    tasks: tuple[str, ...] = Field(min_length=1)
    disturbances: tuple[str, ...] = Field(min_length=1)
    seeds: Seeds
    choose: Choice
    horizon_s: Positive
    trials: int = Field(ge=1, le=100_000)  # in all, the start among them
    startup_trials: int = Field(default=20, ge=1)  # drawn at random before the estimator proposes
    sampler_seed: int = Field(default=0, ge=0)
    stop_after_failed: int | None = Field(default=2, ge=1)  # runs more than the start; None: never
    objective: Objective = Objective()

    @field_validator("start", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return controller(value) if isinstance(value, str) else value

    @field_validator("seeds", "choose", mode="after")
    @classmethod
    def _in_their_range(cls, value: Seeds) -> Seeds:
        choosing = isinstance(value, Choice)
        low, end = (FIRST_CHOOSING_SEED, FIRST_TABLE_SEED) if choosing else (0, FIRST_CHOOSING_SEED)
        last = value.first + value.count - 1
        if not low <= value.first <= last < end:
            raise ValueError(
                f"seeds {value.first} to {last} must lie within {low} to {end - 1}: 0-9999 train and "
                "tune, 10000-19999 choose, 20000 and above are for tables"
            )
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        tree = self.tree
        paths = [*_paths(Controller), *(f"ekf_slip.{path}" for path in _paths(SlipEkfParameters))]
        for path, span in self.search.items():
            for named in (path, span.times):
                if named is not None and named not in paths:
                    raise ValueError(f"search: {named!r} is not one of {', '.join(paths)}")
                if named and named.startswith("ekf_slip.") and self.estimator != "ekf-slip":
                    raise ValueError(f"search: {named!r} needs estimator 'ekf-slip'")
            if span.times is not None:
                other = self.search.get(span.times)
                if span.times == path or (other is not None and other.times is not None):
                    raise ValueError(
                        f"search.{path}: times {span.times!r} must be a path whose own range has no times"
                    )
                if not _at(tree, span.times):
                    raise ValueError(
                        f"search.{path}: times {span.times!r} is {_at(tree, span.times)} at the start"
                    )
        for path, span in self.search.items():
            begun = self.start_values[path]
            if not isinstance(begun, float) or not span.low <= begun <= span.high:
                raise ValueError(
                    f"search.{path}: the start has {begun}; it must lie within {span.low:g} and "
                    f"{span.high:g}"
                )
        for end in ("low", "high"):
            for path, span in self.search.items():
                try:
                    self.built({**self.start_values, path: getattr(span, end)})
                except ValueError as error:
                    raise ValueError(f"search.{path}, {end}: {error}") from error
        for names in (self.tasks, self.disturbances):
            if len(set(names)) < len(names):
                raise ValueError(f"{', '.join(names)}: each must be named once")
        for scenario in self.scenarios(self.ekf_slip).values():
            controller_row(self.start, scenario.control_period_s, scenario.preview_s)
            settled = (scenario.robot_count - 1) * scenario.time_gap_s + FORMATION_SETTLE_S
            if self.objective.settled_formation_rmse_mm and self.horizon_s <= settled:
                raise ValueError(
                    f"horizon_s {self.horizon_s:g} must be above {settled:g}, from when on the last of "
                    f"{scenario.robot_count} robots is in formation"
                )
        return self

    @property
    def tree(self) -> dict[str, Any]:
        """The start's numbers, nested as the paths say."""
        return {**self.start.model_dump(), "ekf_slip": self.ekf_slip.model_dump()}

    @property
    def start_values(self) -> dict[str, Any]:
        """The start as values of the search: a number for each path, None for a limit left out."""
        tree, values = self.tree, {}
        for path, span in self.search.items():
            value = _at(tree, path)
            if span.times is not None and value is not None:
                value = _rounded(value / _at(tree, span.times))
            values[path] = value
        return values

    def built(self, values: dict[str, float]) -> ControllerFile:
        """The controller, and what it needs on board, for a value of each path of the search.

        Raises
        ------
        ValueError
            for a value that there cannot be.
        """
        tree = self.tree
        for path in sorted(self.search, key=lambda path: self.search[path].times is not None):
            times = self.search[path].times
            factor = 1.0 if times is None else _at(tree, times)
            tree = with_value(tree, path, _rounded(values[path] * factor))
        slip = tree.pop("ekf_slip") if self.estimator == "ekf-slip" else None
        try:
            return ControllerFile.model_validate(
                {"controller": tree, "estimator": self.estimator, "ekf_slip": slip}
            )
        except ValidationError as error:
            raise ValueError(one_line(error)) from error

    def scenarios(self, ekf_slip: SlipEkfParameters | None) -> dict[str, Scenario]:
        """The scenario of every task and disturbance, named ``"task, disturbance"``.

        Raises
        ------
        ValueError
            for an unknown task or disturbance, or a scenario that the batch plant or the law cannot run.
        """
        made = {}
        for task in self.tasks:
            for disturbance in self.disturbances:
                scenario = load_scenario(
                    task,
                    disturbance=disturbance,
                    estimator=self.estimator,
                    ekf_slip=None if ekf_slip is None else ekf_slip.model_dump(),
                    horizon_s=self.horizon_s,
                    plant="batch",
                )
                if (scenario.action, scenario.observation) != ("twist", "tracking"):
                    raise ValueError(
                        f"task {task!r} must have action 'twist', observation 'tracking'"
                    )
                made[f"{task}, {disturbance}"] = scenario
        return made


def _paths(model: type[BaseModel], before: str = "") -> list[str]:
    """Dotted paths of a model's numbers."""
    found: list[str] = []
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            found += _paths(kind, f"{before}{name}.")
        elif kind is not bool and kind is not str:
            found.append(before + name)
    return found


def _at(tree: Any, path: str) -> Any:
    """The value at a dotted path of nested mappings."""
    for name in path.split("."):
        tree = tree[name]
    return tree


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def load_tune(source: str | Path, *, trials: int | None = None) -> TuneConfig:
    """A search from a preset's name (``tuned``) or a YAML file; ``trials`` in all, if it is given.

    Raises
    ------
    ValueError
        in one line that names the value and what is allowed.
    """
    found = read_preset_or_file("search", source)
    try:
        given = {} if trials is None else {"trials": trials}
        return TuneConfig.model_validate(found | given)
    except ValidationError as error:
        raise ValueError(one_line(error)) from error


class Job(NamedTuple):
    """A trial to be driven."""

    number: int
    values: dict[str, float]  # by path
    seeds: list[int]
    # Runs that must not fail by then, by "task, disturbance": the trial is stopped there.
    too_many: dict[str, int]


class Outcome(NamedTuple):
    """What a trial came to."""

    number: int
    score: float  # mean over the strata of the mean cost over seeds; less is better
    failed: int  # runs in which a robot was lost or touched another
    runs: int
    stopped: bool  # before all strata were driven
    strata: dict[str, dict[str, float]]  # by "task, disturbance": cost, failed, medians of measures


def evaluate(config: TuneConfig, job: Job) -> Outcome:
    """Drive a trial through all tasks and disturbances, a block of seeds at once."""
    file = config.built(job.values)
    strata: dict[str, dict[str, float]] = {}
    failed = 0
    scenarios = config.scenarios(file.ekf_slip)
    for place, scenario in scenarios.items():
        policy = ReferencePolicy(file.controller, scenario.control_period_s, scenario.preview_s)
        rows = [
            measured(record)
            for i in range(0, len(job.seeds), SEEDS_PER_BLOCK)
            for record in run_seeds(scenario, policy, job.seeds[i : i + SEEDS_PER_BLOCK])
        ]
        here = sum(ended for _, ended in rows)
        failed += here
        strata[place] = {
            "cost": float(np.mean([config.objective.cost(*row) for row in rows])),
            "failed": here,
            **{name: float(np.median([m[name] for m, _ in rows])) for name in CAPS},
        }
        if failed >= job.too_many.get(place, math.inf):
            break
    return Outcome(
        number=job.number,
        score=float(np.mean([row["cost"] for row in strata.values()])),
        failed=failed,
        runs=len(strata) * len(job.seeds),
        stopped=len(strata) < len(scenarios),
        strata=strata,
    )


def measured(record: Record) -> tuple[dict[str, float], bool]:
    """A run's measures by name, each at most its cap, and whether a robot was lost or touched another."""
    robots = record.metrics()

    def of(name: str) -> np.ndarray:
        values = [getattr(robot, name) for robot in robots]
        return np.array([CAPS[name] if v is None else min(v, CAPS[name]) for v in values])

    return {
        "position_rmse_mm": float(of("position_rmse_mm").max()),
        "settled_formation_rmse_mm": float(of("settled_formation_rmse_mm").max()),
        "error_capped_mean_mm": float(of("error_capped_mean_mm").mean()),
        "torque_rms_Nmm": float(np.sqrt(np.mean(of("torque_rms_Nmm") ** 2))),
    }, any(robot.lost or robot.touched for robot in robots)


class Study:
    """Optuna's study in a folder: it asks, is told, and knows which trials were cut short.

    A proposal depends on the finished trials, the sampler's seed and its own number alone, and is
    stored whole before it is tried. So a search by one worker that is resumed is the search that was
    never interrupted, trial by trial.

    Raises
    ------
    ValueError
        if optuna is missing, or the folder holds another search, one with other sources of the
        simulation, or a database that is none.
    """

    def __init__(self, config: TuneConfig, folder: Path) -> None:
        self.config = config
        optuna = _optuna()
        from sqlalchemy import URL
        from sqlalchemy.exc import SQLAlchemyError

        asked = config.model_dump(mode="json")
        del asked["trials"]  # more of them go on where the search ended
        scenarios = {
            place: scenario_hash(scenario)
            for place, scenario in config.scenarios(config.ekf_slip).items()
        }
        record = {**asked, "scenarios": scenarios, "simulation": sources_digest()}
        folder.mkdir(parents=True, exist_ok=True)
        keys = tuple(record)
        record |= {"versions": versions(), "git_revision": git_revision()}
        claim(folder / SEARCH, record, keys, "a search")
        url = URL.create("sqlite", database=str((folder / STUDY).absolute()))
        try:
            self._study = optuna.create_study(
                storage=url.render_as_string(hide_password=False),
                study_name=STUDY_NAME,
                load_if_exists=True,
            )
            self._study.get_trials()
        except (SQLAlchemyError, RuntimeError, optuna.exceptions.OptunaError) as error:
            raise ValueError(
                f"{folder / STUDY} cannot be read; take another --out, or remove {folder}"
            ) from error
        self._distributions = {
            path: optuna.distributions.FloatDistribution(span.low, span.high, log=span.log)
            for path, span in config.search.items()
        }

    def trials(self, *states: str) -> list[Any]:
        """Trials in a state (all without one), by number."""
        kept = [
            trial
            for trial in self._study.get_trials(deepcopy=False)
            if not states or trial.state.name in states
        ]
        return sorted(kept, key=lambda trial: trial.number)

    def jobs(self) -> Iterator[Job]:
        """What is to be driven next: first what was cut short, then new proposals, up to ``trials``.

        The next one is made only when it is asked for.
        """
        optuna = _optuna()
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

    def _job(self, trial: Any) -> Job:
        return Job(trial.number, self.values(trial.number), self.config.seeds.all, self._too_many())

    def _too_many(self) -> dict[str, int]:
        """With how many failed runs a trial is stopped, by stratum; empty until the start is known."""
        more = self.config.stop_after_failed
        first = [Outcome(**t.user_attrs[SCORES]) for t in self.trials("COMPLETE") if not t.number]
        if more is None or not first:
            return {}
        strata = first[0].strata
        failed = accumulate(int(row["failed"]) for row in strata.values())
        return {place: before + more for place, before in zip(strata, failed, strict=True)}

    def _proposal(self, known: list[Any]) -> dict[str, float]:
        """Values for the next trial, drawn in a study in memory that has all trials so far."""
        optuna = _optuna()
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
        """Store what a trial came to; it is on the disk when this returns."""
        optuna = _optuna()
        handle = optuna.trial.Trial(self._study, self.trials()[outcome.number]._trial_id)
        handle.set_user_attr(SCORES, outcome._asdict())
        if outcome.stopped:  # Optuna takes the last intermediate value of a pruned trial
            handle.report(outcome.score, len(outcome.strata))
            self._study.tell(outcome.number, state=optuna.trial.TrialState.PRUNED)
        else:
            self._study.tell(outcome.number, outcome.score)

    def outcomes(self) -> list[Outcome]:
        """The trials that were driven to the end, the best first."""
        finished = [Outcome(**t.user_attrs[SCORES]) for t in self.trials("COMPLETE")]
        return sorted(finished, key=lambda outcome: (outcome.score, outcome.number))

    def values(self, number: int) -> dict[str, float]:
        """The values of a trial, by path."""
        params = self.trials()[number].params
        return {path: params[path] for path in self.config.search}

    def finalists(self) -> list[int]:
        """Numbers of the best trials, and of the start."""
        best = [outcome.number for outcome in self.outcomes()[: self.config.choose.finalists]]
        return best if 0 in best else [*best, 0]

    def chosen(self) -> dict[int, Outcome]:
        """The finalists so far that were driven on the seeds for choosing."""
        attributes = self._study.user_attrs
        keys = {number: CHOSEN.format(number) for number in self.finalists()}
        return {n: Outcome(**attributes[key]) for n, key in keys.items() if key in attributes}

    def choose(self, outcome: Outcome) -> None:
        """Store what a finalist came to."""
        self._study.set_user_attr(CHOSEN.format(outcome.number), outcome._asdict())


def _optuna() -> Any:
    """The package, told to be quiet.

    Raises
    ------
    ValueError
        if it is missing.
    """
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise ValueError("the search needs optuna (pip install 'tlf-env[tune]')") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def run_tune(
    config: TuneConfig,
    folder: Path,
    *,
    workers: int = 1,
    ray_address: str | None = None,
    command: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Search up to ``config.trials`` in all, choose, and write ``tuned.yaml``; what it holds.

    Parameters
    ----------
    folder
        Has ``search.json`` (what was asked for), ``study.db`` (Optuna's) and ``tuned.yaml``.
    workers
        Processes that drive trials. With more than one, what is proposed depends on which trial ends
        first.
    ray_address
        Address of a Ray cluster that drives them instead.
    progress
        Called with the trials driven and their number in all, the finalists' second drive included.

    Raises
    ------
    ValueError
        for a folder that holds another search or in which another process is at work, a missing package,
        or no worker, before anything is run.
    """
    if workers < 1:
        raise ValueError(f"workers {workers} must be at least 1")
    study = Study(config, folder)
    with alone_in(folder):
        chosen = _search(study, workers, ray_address, progress or (lambda done, total: None))
        result = _result(study, chosen, command)
        _write(result, folder / RESULT)
    return result


def _search(
    study: Study, workers: int, ray_address: str | None, progress: Callable[[int, int], None]
) -> dict[int, Outcome]:
    """Drive what is left of the search, then the finalists on the seeds for choosing; their outcomes."""
    config = study.config

    def driven(jobs: Iterable[Job]) -> Iterator[Outcome]:
        return spread(evaluate, config, jobs, processes=workers, ray_address=ray_address)

    done = len(study.trials("COMPLETE", "PRUNED"))
    total = max(config.trials, done) + config.choose.finalists
    progress(done, total)
    for outcome in driven(study.jobs()):
        study.tell(outcome)
        done += 1
        progress(done, total)
    finalists, chosen = study.finalists(), study.chosen()
    left = [number for number in finalists if number not in chosen]
    for outcome in driven(Job(n, study.values(n), config.choose.all, {}) for n in left):
        study.choose(outcome)
        chosen[outcome.number] = outcome
        progress(done + len(chosen), done + len(finalists))
    return chosen


def _result(study: Study, chosen: dict[int, Outcome], command: str) -> dict[str, Any]:
    """What ``tuned.yaml`` holds: a controller file, and how it was found."""
    config = study.config
    ranking = sorted(chosen.values(), key=lambda outcome: (outcome.score, outcome.number))
    best = ranking[0].number
    tuned = {outcome.number: outcome for outcome in study.outcomes()}
    file = config.built(study.values(best)).model_dump(mode="json", exclude={"found"})
    return {
        **{key: value for key, value in file.items() if value is not None},
        "found": {
            "command": command,
            "trial": best,
            "trials": {
                "finished": len(study.trials("COMPLETE")),
                "stopped": len(study.trials("PRUNED")),
            },
            "tune": {"found": _told(tuned[best]), "start": _told(tuned[0])},
            "choose": {"found": _told(chosen[best]), "start": _told(chosen[0])},
            "finalists": [
                {
                    "trial": outcome.number,
                    "tune": tuned[outcome.number].score,
                    "choose": outcome.score,
                    "failed": outcome.failed,
                }
                for outcome in ranking
            ],
            "search": config.model_dump(mode="json"),
            "simulation": sources_digest(),
            "versions": versions() | {"optuna": _optuna().__version__},
            "git_revision": git_revision(),
        },
    }


def _told(outcome: Outcome) -> dict[str, Any]:
    kept = outcome._asdict()
    del kept["number"], kept["stopped"]
    return kept


def _write(result: dict[str, Any], path: Path) -> None:
    text = yaml.safe_dump(result, sort_keys=False, allow_unicode=True, width=100)
    with atomic(path, encoding="utf-8") as file:
        file.write("# Found by tlf tune; --policy reference:FILE drives it.\n" + text)
