"""What a search starts from: a controller, or a tracking law behind a limiter."""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple, Self

from pydantic import ValidationError, model_validator

from baselines.policies.laws.catalogue import LAWS, law_of, read_law
from baselines.policies.laws.law import LawFile
from baselines.policies.systems import (
    ESTIMATORS,
    LimitedLaw,
    SystemName,
    asked_by,
    parse_system,
)
from tlf_env.common.errors import one_line
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER
from tlf_env.onboard.limiters import Limiter, behind, load_limiter, own_limiter
from tlf_env.onboard.parts import PYTHON_ESTIMATORS, Policy
from tlf_env.task.scenario import Scenario, load_scenario

SYSTEM_FIELDS = ("estimator", "broadcast_smoothing_s")  # that a system's name sets in a search


class LawStart(Limiter):
    """A tracking law with its parameters, behind a limiter."""

    law: str
    parameters: dict[str, Any]  # of the law's file, with its defaults
    limiter: str | None = None  # name of the limits that it starts with, None: none
    estimator: str | None = None  # as systems name it, if the start is one

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.law not in LAWS:
            raise ValueError(f"law {self.law!r} is not one of {', '.join(LAWS)}")
        if self.estimator is not None and self.estimator not in ESTIMATORS:
            raise ValueError(f"estimator {self.estimator!r} is not one of {', '.join(ESTIMATORS)}")
        if self.estimator in PYTHON_ESTIMATORS:
            raise ValueError(_not_searched(self.estimator))
        law_file(self.law, self.parameters)
        return self

    @property
    def file(self) -> LawFile:
        """The content of the law's file."""
        return law_file(self.law, self.parameters)

    @property
    def limits_of_it(self) -> Limiter:
        """The limiter."""
        return Limiter(
            limits=self.limits,
            spacing=self.spacing,
            supervisor=self.supervisor,
            lead_s=self.lead_s,
        )

    @property
    def scenario_overrides(self) -> dict[str, Any]:
        """The scenario's fields that the law and a named estimator ask for."""
        estimator = ESTIMATORS[self.estimator] if self.estimator is not None else {}
        return {**LAWS[self.law][0].scenario_overrides, **asked_by(self), **estimator}

    def with_numbers(self, parameters: dict[str, Any], limiter: dict[str, Any]) -> LawStart:
        """The same law with other parameters and another limiter.

        Raises
        ------
        ValueError
            for an invalid value.
        """
        kept = {"law": self.law, "limiter": self.limiter, "estimator": self.estimator}
        return LawStart.model_validate({**kept, "parameters": parameters, **limiter})

    def policy(self, scenario: Scenario) -> Policy:
        """The law behind its limiter, for a scenario."""
        made = law_of(self.law, self.file, scenario)
        return LimitedLaw(made, self.limits_of_it, scenario.control_period_s, scenario.preview_s)


class Named(NamedTuple):
    """What a name stands for."""

    start: Any  # a Controller, or a LawStart
    fields: dict[str, Any]  # of the search that the name sets: estimator and smoothing of a system


def _not_searched(estimator: str) -> str:
    """Why there is no search with an estimator in Python."""
    return f"estimator {estimator!r} is a Python object; a search runs on the plant 'batch'"


def law_file(law: str, parameters: dict[str, Any]) -> LawFile:
    """The file of a law with some parameters.

    Raises
    ------
    ValueError
        in one line, for an unknown or invalid one.
    """
    try:
        return LAWS[law][1].model_validate(parameters)
    except ValidationError as error:
        raise ValueError(one_line(error, LAWS[law][1])) from error


def _default(law: str, key: str) -> Any:
    """A parameter's default; one that follows from others has the value that the law gives it."""
    parameters = inspect.signature(LAWS[law][0]).parameters
    if key not in parameters:
        return None  # a bound on errors
    value = parameters[key].default
    if value is not None:
        return value
    return getattr(law_of(law, LAWS[law][1](), load_scenario()), key)


def named_start(name: str) -> Named:
    """The start that a name stands for: a controller, a law, or a system of either.

    Raises
    ------
    ValueError
        in one line, for an unknown part or an invalid file.
    """
    system = parse_system(name) or SystemName(name, "", None)
    head, _, tail = system.controller.partition(":")
    limiter = None if system.limiter is None else load_limiter(system.limiter)
    named = system.estimator or None
    if named in PYTHON_ESTIMATORS:
        raise ValueError(f"start {name!r}: {_not_searched(named)}")
    asked = {} if named is None else ESTIMATORS[named]
    fields: dict[str, Any] = {key: asked[key] for key in SYSTEM_FIELDS if key in asked}
    if head in LAWS:
        given = read_law(head, tail).model_dump(exclude={"found"})
        given |= {key: _default(head, key) for key, value in given.items() if value is None}
        limits = {} if limiter is None else limiter.model_dump()
        made = LawStart(
            law=head, parameters=given, limiter=system.limiter, estimator=named, **limits
        )
        return Named(made, fields)
    if not asked:
        return Named(controller(name), {})
    if asked != fields:
        raise ValueError(
            f"start {name!r}: a controller is searched with the parameters of {fields['estimator']!r}, not "
            f"with those of {named!r}"
        )
    if limiter is not None and limiter.supervisor is not None:
        raise ValueError(f"start {name!r}: a controller is searched without a supervisor")
    known = controller(tail or DEFAULT_CONTROLLER) if head == "reference" else controller(head)
    return Named(behind(known, limiter or own_limiter(known)), fields)
