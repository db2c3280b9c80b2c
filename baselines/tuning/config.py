"""Configuration of ``tlf tune``: start, ranges, tasks, disturbances, seeds and objective of a search."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Self

from pydantic import (
    BaseModel,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from baselines.policies.laws.catalogue import LAWS
from baselines.policies.reference import ReferencePolicy
from baselines.policies.systems import parse_system
from baselines.runs.nested import value_at, with_value
from baselines.runs.seed_ranges import CHOOSING_SEEDS, TRAINING_SEEDS, check_seeds
from baselines.runs.splits import check_training
from baselines.tuning.start import LawStart, named_start
from tlf_env.common.errors import one_line
from tlf_env.common.models import Frozen, NonNegative, Number, Positive, Switch, Whole
from tlf_env.common.presets import beside, is_file_name, read_preset_or_file
from tlf_env.onboard.controllers import ControllerFile
from tlf_env.onboard.kinds import EstimatorKind
from tlf_env.onboard.limiters import Limiter
from tlf_env.onboard.parts import Policy
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.tracking import Controller
from tlf_env.task.metrics import ERROR_CAP_MM, FORMATION_SETTLE_S, LOST_RMS_MM
from tlf_env.task.scenario import Scenario, load_scenario

DIGITS = 6  # significant digits of a tried value
SMALLEST = 1e-3  # a smaller measure counts as this
# A measure counts up to its cap; in a failed run every measure counts as its cap.
CAPS = {
    "position_rmse_mm": LOST_RMS_MM,
    "settled_formation_rmse_mm": LOST_RMS_MM,
    "error_capped_mean_mm": ERROR_CAP_MM,
    "torque_rms_Nmm": 15.0,
}


class Range(Frozen):
    """Search range of a number, ends included."""

    low: Number
    high: Number
    log: Switch = False  # uniform in the logarithm
    times: str | None = None  # the value is a factor on the number at this path

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.log and self.low <= 0:
            raise ValueError(f"low {self.low:g} must be above 0 with log true")
        return self


class CountedSeeds(Frozen):
    """Seeds ``first`` to ``first + count - 1``."""

    first: Whole = Field(ge=0)
    count: Whole = Field(ge=1, le=1000)

    @property
    def all(self) -> list[int]:
        """The seeds as a list."""
        return list(range(self.first, self.first + self.count))


class Choice(CountedSeeds):
    """Seeds on which the best trials are compared with the start."""

    finalists: Whole = Field(default=5, ge=1)  # without the start


class Objective(Frozen):
    """Weights of the logarithms of a run's measures, and the additional cost of a failed run."""

    position_rmse_mm: NonNegative = 1.0  # of the worst robot
    settled_formation_rmse_mm: NonNegative = 0.5  # of the worst robot
    error_capped_mean_mm: NonNegative = 0.5  # mean over the robots
    torque_rms_Nmm: NonNegative = 0.5  # RMS over the robots
    failed: Positive = 3.0

    def cost(self, measures: dict[str, float], failed: bool) -> float:
        """Cost of a run: the weighted sum of the logarithms of its measures.

        A failed run costs ``failed`` more than the largest possible cost of any other run.
        """
        total = self.failed if failed else 0.0
        for name, cap in CAPS.items():
            value = cap if failed else min(max(measures[name], SMALLEST), cap)
            total += getattr(self, name) * math.log(value)
        return total


class TuneConfig(Frozen):
    """A search.

    Paths are those of :class:`Controller` (``gains.k_1_per_s``) and of ``ekf_slip``; for a law those of its
    file (``law.gain_per_s``) and of its limiter (``limits.yaw_rate_rad_s``).
    """

    start: Controller | LawStart  # or the name of a controller, a law or a system; the first trial
    estimator: EstimatorKind = "ekf-slip"
    broadcast_smoothing_s: NonNegative = 0.0
    ekf_slip: SlipEkfParameters = SlipEkfParameters()
    search: dict[str, Range] = Field(min_length=1)
    tasks: tuple[str, ...] = Field(min_length=1)
    disturbances: tuple[str, ...] = Field(min_length=1)
    seeds: CountedSeeds
    choose: Choice
    horizon_s: Positive
    trials: Whole = Field(ge=1, le=100_000)  # in all, including the start
    startup_trials: Whole = Field(default=20, ge=1)  # random trials before the sampler proposes
    sampler_seed: Whole = Field(default=0, ge=0)
    # A trial stops when so many more of its runs have failed than of the start's; None: never.
    stop_after_failed: Whole | None = Field(default=2, ge=1)
    objective: Objective = Objective()

    @model_validator(mode="before")
    @classmethod
    def _named(cls, values: Any) -> Any:
        given = values.get("start") if isinstance(values, dict) else None
        if isinstance(given, dict):
            kind = LawStart if "law" in given else Controller
            try:
                return {**values, "start": kind.model_validate(given)}
            except ValidationError as error:
                raise ValueError(f"start.{one_line(error, kind)}") from error
        if not isinstance(given, str):
            return values
        start, fields = named_start(given)
        for key, named in fields.items():
            if values.get(key, named) != named:
                raise ValueError(
                    f"start {given!r} names the {key} {named!r}; {key} is {values[key]!r}"
                )
        return {**values, **fields, "start": start}

    @field_validator("seeds", "choose", mode="after")
    @classmethod
    def _in_their_range(cls, value: CountedSeeds) -> CountedSeeds:
        allowed = CHOOSING_SEEDS if isinstance(value, Choice) else TRAINING_SEEDS
        check_seeds("seeds", (value.first, value.first + value.count), allowed)
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._check_paths()
        self._check_ranges()
        for names in (self.tasks, self.disturbances):
            if len(set(names)) < len(names):
                raise ValueError(f"{', '.join(names)}: each must be named once")
        for scenario in self.scenarios(self.ekf_slip).values():
            self.policy(self.start, scenario)
            settled = (scenario.robot_count - 1) * scenario.time_gap_s + FORMATION_SETTLE_S
            if self.objective.settled_formation_rmse_mm and self.horizon_s <= settled:
                raise ValueError(
                    f"horizon_s {self.horizon_s:g} must be above {settled:g}, from when on the last "
                    f"of {scenario.robot_count} robots is in formation"
                )
        return self

    def _check_paths(self) -> None:
        tree = self.tree
        if isinstance(self.start, LawStart):
            if self.ekf_slip != SlipEkfParameters():
                raise ValueError("ekf_slip: a law is searched with the scenario's filter")
            model = LAWS[self.start.law][1]
            paths = [f"law.{path}" for path in _paths(model) if path != "found"]
            paths += _paths(Limiter)
        else:
            paths = _paths(Controller)
            paths += [f"ekf_slip.{path}" for path in _paths(SlipEkfParameters)]
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
                        f"search.{path}: times {span.times!r} must be a path that has no times in its own range"
                    )
                base = value_at(tree, span.times)
                if not base:
                    raise ValueError(
                        f"search.{path}: times {span.times!r} is {base} at the start; it must not be 0 "
                        "or None"
                    )

    def _check_ranges(self) -> None:
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

    @property
    def tree(self) -> dict[str, Any]:
        """The start's numbers as nested mappings, for the paths."""
        if isinstance(self.start, LawStart):
            return {"law": self.start.parameters, **self.start.limits_of_it.model_dump()}
        return {**self.start.model_dump(), "ekf_slip": self.ekf_slip.model_dump()}

    @property
    def start_values(self) -> dict[str, Any]:
        """The start as values of the search: a number for each path, None for a limit left out."""
        tree, values = self.tree, {}
        for path, span in self.search.items():
            value = value_at(tree, path)
            if span.times is not None and value is not None:
                value = _rounded(value / value_at(tree, span.times))
            values[path] = value
        return values

    def built(self, values: dict[str, float]) -> ControllerFile | LawStart:
        """The controller and its on-board parts, or the law, for a value of each path of the search.

        Raises
        ------
        ValueError
            for an invalid value.
        """
        tree = self.tree
        for path in sorted(self.search, key=lambda path: self.search[path].times is not None):
            times = self.search[path].times
            factor = 1.0 if times is None else value_at(tree, times)
            tree = with_value(tree, path, _rounded(values[path] * factor))
        if isinstance(self.start, LawStart):
            parameters = tree.pop("law")
            try:
                return self.start.with_numbers(parameters, tree)
            except ValidationError as error:
                raise ValueError(one_line(error, LawStart)) from error
        own = tree.pop("ekf_slip")
        slip = own if self.estimator == "ekf-slip" else None
        try:
            return ControllerFile.model_validate(
                {
                    "controller": tree,
                    "estimator": self.estimator,
                    "ekf_slip": slip,
                    "broadcast_smoothing_s": self.broadcast_smoothing_s,
                }
            )
        except ValidationError as error:
            raise ValueError(one_line(error, ControllerFile)) from error

    def policy(self, made: Controller | ControllerFile | LawStart, scenario: Scenario) -> Policy:
        """What a trial drives: the controller, or the law behind its limiter.

        Raises
        ------
        ValueError
            for a lead or a law that lacks a preview.
        """
        if isinstance(made, LawStart):
            return made.policy(scenario)
        law = made.controller if isinstance(made, ControllerFile) else made
        return ReferencePolicy(law, scenario.control_period_s, scenario.preview_s)

    def scenarios(self, ekf_slip: SlipEkfParameters | None) -> dict[str, Scenario]:
        """The scenario of every task and disturbance, named ``"task, disturbance"``.

        Raises
        ------
        ValueError
            for an unknown task or disturbance, one that must not tune
            (:mod:`baselines.runs.splits`), or a scenario that the batch plant or the law cannot run.
        """
        made = {}
        asked = self.start.scenario_overrides if isinstance(self.start, LawStart) else {}
        for task in self.tasks:
            for disturbance in self.disturbances:
                scenario = load_scenario(
                    task,
                    disturbance=disturbance,
                    horizon_s=self.horizon_s,
                    plant="batch",
                    **{
                        "estimator": self.estimator,
                        "broadcast_smoothing_s": self.broadcast_smoothing_s,
                        "ekf_slip": None if ekf_slip is None else ekf_slip.model_dump(),
                        **asked,
                    },
                )
                if (scenario.action, scenario.observation) != ("twist", "tracking"):
                    raise ValueError(
                        f"task {task!r} must have action 'twist', observation 'tracking'"
                    )
                check_training(scenario)
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


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _read(source: str, before: tuple[str, ...]) -> dict[str, Any]:
    """The keys of a search, with those of the search that it is like."""
    if source in before:
        raise ValueError(f"like: {' → '.join((*before, source))} goes round in a circle")
    found = read_preset_or_file("search", source)
    folder = Path(source).parent
    if is_file_name(source) and "disturbances" in found:
        found["disturbances"] = beside(folder, found["disturbances"])
    other = found.pop("like", None)
    if other is None:
        return found
    if not isinstance(other, str):
        raise ValueError(f"like must be the name of a search or a .yaml file, got {other!r}")
    other = beside(folder, other) if is_file_name(source) else other
    others = _read(other, (*before, source))
    start = found.get("start")
    if isinstance(start, str) and parse_system(start) is not None:
        for key in ("estimator", "broadcast_smoothing_s"):  # the system names its own
            others.pop(key, None)
    return others | found


def load_tune(source: str | Path, *, trials: int | None = None) -> TuneConfig:
    """A search from a preset's name (``tuned``) or a YAML file; ``trials`` overrides their number.

    With ``like: SEARCH`` a file has all keys of another search that it does not set itself.

    Raises
    ------
    ValueError
        in one line that names the value and what is allowed.
    """
    found = _read(str(source), ())
    try:
        given = {} if trials is None else {"trials": trials}
        return TuneConfig.model_validate(found | given)
    except ValidationError as error:
        raise ValueError(one_line(error, TuneConfig)) from error
