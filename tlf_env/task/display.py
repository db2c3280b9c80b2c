"""A scenario as YAML text: what differs from the defaults, or all of it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from tlf_env.common.presets import yaml_text

if TYPE_CHECKING:
    from tlf_env.task.scenario import Scenario


def differences_text(scenario: Scenario) -> str:
    """What differs from the defaults of a scenario's fields, as YAML; name and trajectory always."""
    usual = plain(type(scenario)(trajectory=scenario.trajectory))
    data = plain(scenario)
    if isinstance(data["robots"], list):
        data["robots"] = [_differing(one, data["robot"]) for one in data["robots"]]
    always = {name: data.pop(name) for name in ("name", "trajectory")}
    return yaml_text({**always, **_differing(data, usual)})


def whole_text(scenario: Scenario, left_open: Collection[str]) -> str:
    """Every field of a scenario as YAML that :func:`~tlf_env.task.scenario.load_scenario` reads back.

    Parameters
    ----------
    left_open
        Fields that are written as comments where they are at a default that nothing has set, so that a policy
        may still ask for another value.
    """
    lines = []
    for name, value in plain(scenario).items():
        text = yaml_text({name: value})
        if name in left_open and name not in scenario.model_fields_set:
            text = "".join(f"# {line}\n" for line in text.splitlines())
        lines.append(text)
    return "".join(lines)


def plain(scenario: Scenario) -> dict[str, Any]:
    """A scenario as mappings, lists, texts and numbers; a constant signal is its number."""
    return {name: _short(value) for name, value in scenario.model_dump(mode="json").items()}


def _differing(data: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """The values that differ from the usual ones, in mappings as deep as both have the same keys."""
    found = {}
    for key, value in data.items():
        other = usual[key]
        if value == other:
            continue
        same = (
            isinstance(value, Mapping) and isinstance(other, Mapping) and set(value) == set(other)
        )
        found[key] = _differing(value, other) if same else value
    return found


def _short(value: Any) -> Any:
    if isinstance(value, Mapping):
        if set(value) == {"type", "value"} and value["type"] == "constant":
            return value["value"]
        return {key: _short(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_short(one) for one in value]
    return value
