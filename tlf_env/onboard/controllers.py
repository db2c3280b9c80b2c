"""Controllers from YAML: presets and files of gains and limits, with the estimator that they need."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from pydantic import ValidationError, field_validator

from tlf_env.common.errors import one_line
from tlf_env.common.models import Frozen, NonNegative
from tlf_env.common.presets import is_file_name, preset_names, read_preset_or_file
from tlf_env.onboard.gyro_estimator import GyroEkfParameters
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER, EstimatorKind
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.tracking import Controller, can_lead

SCENARIO_FIELDS = ("estimator", "ekf_slip", "ekf_gyro", "broadcast_smoothing_s")


class ControllerFile(Frozen):
    """Contents of a controller file: numbers of the law, and fields of the scenario that it requires."""

    controller: Controller  # or the name of a preset
    estimator: EstimatorKind | None = None  # None: not required
    ekf_slip: SlipEkfParameters | None = None
    ekf_gyro: GyroEkfParameters | None = None
    broadcast_smoothing_s: NonNegative | None = None
    found: dict[str, Any] | None = None  # how the numbers were found; not used by the code

    @field_validator("controller", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return controller(value) if isinstance(value, str) else value

    @property
    def scenario_overrides(self) -> dict[str, Any]:
        """Fields of the scenario that the file sets, of the estimator and the broadcasts; or none.

        Parameters of a filter name this filter, if the file names none.
        """
        given = self.model_dump(include=set(SCENARIO_FIELDS), exclude_none=True)
        named = {}
        for field, kind in (("ekf_slip", "ekf-slip"), ("ekf_gyro", "ekf-gyro")):
            if field in given:
                given[field] = getattr(self, field).model_dump()  # with its fields that are None
                named["estimator"] = kind
        return named | given


def controller_names() -> list[str]:
    """Names of the controller presets."""
    return preset_names("controller")


def load_controller(source: str | Path) -> ControllerFile:
    """A controller file, by the name of a preset (a YAML file shipped in ``configs/``) or its path.

    Raises
    ------
    ValueError
        in one line, if there is no such preset or file, or a key or value in it is not allowed.
    """
    if is_file_name(source):  # a file may change between two calls
        return _loaded(source)
    return _preset(str(source))


@functools.cache
def _preset(name: str) -> ControllerFile:
    return _loaded(name)


def _loaded(source: str | Path) -> ControllerFile:
    try:
        return ControllerFile.model_validate(read_preset_or_file("controller", source))
    except ValidationError as error:
        raise ValueError(f"{source}: {one_line(error, ControllerFile)}") from error


def controller(source: str | Path) -> Controller:
    """Gains and limits of a preset or a controller file; errors as in :func:`load_controller`."""
    return load_controller(source).controller


def controller_for(source: str | Path, preview_s: tuple[float, ...]) -> Controller:
    """As :func:`controller`, for an observation with previews (s).

    The default controller can do without its lead, so that it drives observations without previews, too.
    """
    found = controller(source)
    if source == DEFAULT_CONTROLLER and not can_lead(preview_s):
        return found.model_copy(update={"lead_s": 0.0})
    return found
