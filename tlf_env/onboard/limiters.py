"""Limiters from YAML: what any controller, or any action, may command, and at what distance."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError, field_validator

from tlf_env.common.errors import one_line, shown
from tlf_env.common.models import Frozen, NonNegative
from tlf_env.common.presets import beside, preset_or_file, read_preset_or_file
from tlf_env.onboard.limiter import BOUNDS, TwistLimits
from tlf_env.onboard.spacing import Spacing
from tlf_env.onboard.supervisor import Supervisor
from tlf_env.onboard.tracking import Controller

DEFAULT_LIMITER = "approach"


class Limiter(Frozen):
    """Contents of a limiter: limits on the twist, distance keeping, supervisor and lead, for any controller.

    The file of a limiter may also have ``base``, another limiter, whose values count where it has none.
    Bounds on errors are part of a controller: they change what its law sees, not what it may command.
    """

    limits: TwistLimits = TwistLimits()
    spacing: Spacing | None = None
    supervisor: Supervisor | None = None
    lead_s: NonNegative = 0.0

    @field_validator("limits")
    @classmethod
    def _of_the_command(cls, limits: TwistLimits) -> TwistLimits:
        for name in BOUNDS:
            if getattr(limits, name) is not None:
                raise ValueError(
                    f"{name} belongs to a controller; a limiter has no bound on errors"
                )
        return limits


def load_limiter(source: str | Path) -> Limiter:
    """A limiter, by the name of a preset (``configs/limiters``) or the path of a ``.yaml`` file.

    Raises
    ------
    ValueError
        in one line, if there is no such preset or file, or a key or value in it is not allowed.
    """
    own = read_preset_or_file("limiter", source)
    base = _base_of(source, own)
    inherited = {} if base is None else read_preset_or_file("limiter", base)
    if "base" in inherited:
        raise ValueError(f"{source}: base {base!r} has a base itself; one level is allowed")
    values = inherited | {key: value for key, value in own.items() if key != "base"}
    for key, value in values.items():
        if isinstance(value, Mapping) and isinstance(inherited.get(key), Mapping):
            values[key] = {**inherited[key], **value}
    try:
        return Limiter.model_validate(values)
    except ValidationError as error:
        raise ValueError(f"{source}: {one_line(error, Limiter)}") from error


def _base_of(source: str | Path, own: Mapping[str, Any]) -> str | None:
    """The base that a limiter's file names, a preset or a path; None without one."""
    base = own.get("base")
    path = preset_or_file("limiter", str(source))
    if base is None or path is None:
        return None
    if not isinstance(base, str):
        raise ValueError(f"{source}: base {shown(base)} must be a limiter's name or its file")
    return str(beside(path.parent, base))


def limiter_files(source: str) -> list[Path]:
    """The files that a limiter is made from: its own and that of its base, if any."""
    base = _base_of(source, read_preset_or_file("limiter", source))
    paths = [preset_or_file("limiter", one) for one in (source, base) if one is not None]
    return [path for path in paths if path is not None]


def own_limiter(law: Controller) -> Limiter:
    """What a controller's own file limits, apart from errors: the limiter of ``CONTROLLER+ESTIMATOR``."""
    unbounded = law.limits.model_copy(update=dict.fromkeys(BOUNDS))
    return Limiter(limits=unbounded, spacing=law.spacing, lead_s=law.lead_s)


def behind(law: Controller, limiter: Limiter) -> Controller:
    """A controller with its gains and bounds on errors, behind a limiter in place of its own limits."""
    bounds = {name: getattr(law.limits, name) for name in BOUNDS}
    return law.model_copy(
        update={
            "limits": limiter.limits.model_copy(update=bounds),
            "spacing": limiter.spacing,
            "lead_s": limiter.lead_s,
        }
    )
