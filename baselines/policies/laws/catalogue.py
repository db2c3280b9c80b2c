"""The tracking laws by name, and their parameters from presets and files."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from baselines.policies.laws import law as shared
from baselines.policies.laws.disturbance_rejection import (
    DisturbanceRejection,
    DisturbanceRejectionFile,
)
from baselines.policies.laws.law import ErrorBounds, Law, LawFile
from baselines.policies.laws.linear_quadratic import LinearQuadratic, LinearQuadraticFile
from baselines.policies.laws.predictive import Predictive, PredictiveFile
from baselines.policies.laws.sliding_mode import SlidingMode, SlidingModeFile
from baselines.policies.laws.textbook import (
    FeedbackLinearisation,
    FeedbackLinearisationFile,
    Kanayama,
    KanayamaFile,
    PurePursuit,
    PurePursuitFile,
)
from tlf_env.common.errors import one_line
from tlf_env.common.presets import preset_names, preset_or_file, read_preset_or_file
from tlf_env.onboard.limiter import BOUNDS
from tlf_env.task.scenario import Scenario

LAWS: dict[str, tuple[type[Law], type[LawFile]]] = {
    "pure_pursuit": (PurePursuit, PurePursuitFile),
    "feedback_linearisation": (FeedbackLinearisation, FeedbackLinearisationFile),
    "kanayama": (Kanayama, KanayamaFile),
    "lqr": (LinearQuadratic, LinearQuadraticFile),
    "sliding_mode": (SlidingMode, SlidingModeFile),
    "adrc": (DisturbanceRejection, DisturbanceRejectionFile),
    "nmpc": (Predictive, PredictiveFile),
}


def law_names() -> list[str]:
    """Names of the laws: with their default parameters, and with each preset of parameters."""
    return [*LAWS, *(f"{law}:{name}" for law in LAWS for name in preset_names(law))]


def read_law(law: str, parameters: str) -> LawFile:
    """The parameters of a law in a preset (``configs/laws/LAW``) or a ``.yaml`` file; empty: the default.

    Raises
    ------
    ValueError
        in one line, if there is no such preset or file, or a key or value in it is not allowed.
    """
    model = LAWS[law][1]
    if not parameters:
        return model()
    try:
        return model.model_validate(read_preset_or_file(law, parameters))
    except ValidationError as error:
        raise ValueError(f"{parameters}: {one_line(error, model)}") from error


def law_of(law: str, file: LawFile, scenario: Scenario) -> Law:
    """A law of :data:`LAWS` with its parameters, for a scenario's observation and control period.

    Raises
    ------
    ValueError
        in one line, if the law lacks a preview.
    """
    given: dict[str, Any] = file.model_dump(exclude_none=True, exclude={"found"})
    bounds = ErrorBounds(**{name: given.pop(name) for name in BOUNDS if name in given})
    made = LAWS[law][0](
        scenario.preview_s,
        rays=scenario.rays,
        neighbour=scenario.neighbour,
        bounds=bounds,
        **given,
    )
    made.period_s = scenario.control_period_s
    made.files = (Path(inspect.getfile(shared)),)
    return made


def make_law(law: str, parameters: str, scenario: Scenario) -> Law:
    """A law by its name, for a scenario's observation and control period.

    Parameters
    ----------
    law
        A name of :data:`LAWS`.
    parameters
        A preset (``configs/laws/LAW``) or the path of a ``.yaml`` file; empty: the default parameters.

    Raises
    ------
    ValueError
        as :func:`read_law` and :func:`law_of`.
    """
    made = law_of(law, read_law(law, parameters), scenario)
    path = preset_or_file(law, parameters)
    made.files += () if path is None else (path,)
    return made
