"""Controllers from files: gains and limits in YAML, with what they need on board."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError, field_validator

from tlf_env.common.errors import one_line
from tlf_env.common.models import Frozen
from tlf_env.common.presets import read_yaml
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.tracking import Controller, controller

SUFFIXES = (".yaml", ".yml")


class ControllerFile(Frozen):
    """What a controller file holds: the law's numbers, and fields that it asks of the scenario."""

    controller: Controller  # or the name of a preset
    estimator: Literal["ekf", "ekf-slip", "truth"] | None = None  # None leaves it to the controller
    ekf_slip: SlipEkfParameters | None = None
    found: dict[str, Any] | None = None  # how the numbers were found; nothing reads it

    @field_validator("controller", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return controller(value) if isinstance(value, str) else value

    @property
    def scenario_overrides(self) -> dict[str, Any]:
        """What the file asks of the scenario: ``estimator``, ``ekf_slip``, or neither."""
        asked: dict[str, Any] = {}
        if self.estimator is not None:
            asked["estimator"] = self.estimator
        if self.ekf_slip is not None:
            asked["ekf_slip"] = self.ekf_slip.model_dump()
        return asked


def load_controller(path: str | Path) -> ControllerFile:
    """A controller file.

    Raises
    ------
    ValueError
        in one line, if the file cannot be read, or a key or a value in it is not allowed.
    """
    try:
        return ControllerFile.model_validate(read_yaml(Path(path)))
    except ValidationError as error:
        raise ValueError(f"{path}: {one_line(error)}") from error
