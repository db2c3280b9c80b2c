"""``tlf show``, and the scenario that options of the command line describe."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from tlf_env.common.errors import path_text
from tlf_env.common.presets import parsed_yaml
from tlf_env.task.display import whole_text
from tlf_env.task.scenario import Scenario, scenario_with

STANDARD_INPUT = "-"


def asked_scenario(
    source: str,
    fields: Mapping[str, Any],
    level: float | None = None,
    settings: Iterable[str] = (),
) -> Scenario:
    """The scenario that a command runs.

    Parameters
    ----------
    source
        A preset, a file, or ``-``: YAML from the standard input.
    fields
        Fields that options set; None: not set.
    level
        Level of the disturbance.
    settings
        Texts ``PATH=VALUE``, with VALUE in YAML.

    Raises
    ------
    ValueError
        for whatever is not allowed, naming it.
    """
    start: str | Mapping[str, Any] = source
    if source == STANDARD_INPUT:
        start = parsed_yaml(sys.stdin.read(), "standard input")
        if not isinstance(start, dict):
            raise ValueError(f"standard input must be a mapping in YAML, got {start!r}")
    return scenario_with(start, fields, level, dict(map(parsed_setting, settings)))


def parsed_setting(text: str) -> tuple[str, Any]:
    """The path and the value of ``PATH=VALUE``.

    Raises
    ------
    ValueError
        for a text without ``=``, or a value that is not YAML.
    """
    path, found, value = text.partition("=")
    if not found or not path:
        raise ValueError(
            f"--set {text!r} must be PATH=VALUE, for example time_gap_s=3 or disturbance.level=2"
        )
    return path.strip(), parsed_yaml(value, f"--set {path_text(text)}")


def shown_scenario(scenario: Scenario) -> str:
    """A whole scenario as YAML that ``tlf run -`` runs as it ran before."""
    from baselines.policies.registry import OVERRIDABLE

    text = whole_text(scenario, OVERRIDABLE)
    if "\n# " not in f"\n{text}":
        return text
    return (
        "# Lines with # are defaults that a policy may replace; without # they hold for every policy.\n"
        f"{text}"
    )
