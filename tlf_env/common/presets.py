"""Presets (YAML files shipped in ``configs/``): where they are, and how YAML is read and written.

Values are those of YAML 1.2: numbers are decimal (``12``, ``-0.5``, ``5e-1``), and only ``true`` and
``false`` are switches. What YAML 1.1 reads otherwise (``no``, ``010``, ``1_000``, ``1:30``, a date) is refused
unless it is quoted, as it means a number or a switch to one reader and a name to another.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from tlf_env.common.errors import RepeatedKeyError, shown

PACKAGE = Path(__file__).resolve().parent.parent
KINDS = {
    "scenario": "",
    "disturbance": "disturbances",
    "controller": "controllers",
    "plan": "plans",
    "training": "train",
    "search": "tune",
}  # kinds of preset, and the subfolder of each
SUFFIXES = (".yaml", ".yml")
MOST_LEVELS = 50  # of mappings and lists in each other

AMBIGUOUS = "!ambiguous"  # tag of the values that YAML 1.1 and 1.2 read differently
SCALARS = {
    "tag:yaml.org,2002:null": r"~|null|Null|NULL|",
    "tag:yaml.org,2002:bool": r"true|True|TRUE|false|False|FALSE",
    "tag:yaml.org,2002:int": r"[-+]?(?:0|[1-9][0-9]*)",
    AMBIGUOUS: r"(?:yes|no|on|off)|(?:Yes|No|On|Off)|(?:YES|NO|ON|OFF)"
    r"|[-+]?0[0-9]+|[-+]?0[box][0-9a-fA-F_]+"  # octal, binary and hexadecimal
    r"|[-+]?[0-9.]+_[0-9_.]*(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?[1-9][0-9_]*(?::[0-5]?[0-9])+"  # to the base of 60
    r"|[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+\.[0-9_]*"
    r"|[0-9]{4}-[0-9][0-9]?-[0-9][0-9]?(?:[Tt \t].*)?",  # a date
    "tag:yaml.org,2002:float": r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
    "tag:yaml.org,2002:merge": r"<<",
}  # what plain values mean, the first that fits; all others are texts


class AmbiguousValueError(ValueError):
    """A plain value of a YAML file that YAML 1.1 and 1.2 read differently."""


class _Loader(yaml.SafeLoader):
    """YAML's safe loader with the values of :data:`SCALARS`, and an error for a repeated key."""

    yaml_implicit_resolvers = {}
    level = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node; mappings and lists may be nested :data:`MOST_LEVELS` deep."""
        self.level += 1
        if self.level > MOST_LEVELS:
            raise RecursionError
        try:
            return super().compose_node(parent, index)
        finally:
            self.level -= 1

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """The mapping as written; keys that it merges with ``<<`` may be overridden."""
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    line = key.start_mark.line + 1
                    raise RepeatedKeyError(f"line {line}: the key {key.value!r} is repeated")
                seen.add(key.value)
        return node

    def refuse(self, node: yaml.ScalarNode) -> None:
        """Refuse an ambiguous value."""
        raise AmbiguousValueError(
            f"line {node.start_mark.line + 1}: {shown(node.value)} is ambiguous in YAML: write true, "
            "false or a decimal number, or quote it if it is a text"
        )


class _Dumper(yaml.SafeDumper):
    """YAML's safe writer, which also quotes texts that would be a number here or are ambiguous."""


for _tag, _pattern in SCALARS.items():
    _fits = re.compile(rf"(?:{_pattern})\Z")
    _Loader.add_implicit_resolver(_tag, _fits, None)
    _Dumper.add_implicit_resolver(_tag, _fits, None)
_Loader.add_constructor(AMBIGUOUS, _Loader.refuse)


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file as a mapping.

    Raises
    ------
    ValueError
        in one line, if the file is missing, is not YAML, is not a mapping, is nested too deeply, repeats a
        key, or has an ambiguous value.
    """
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from error
    except (RepeatedKeyError, AmbiguousValueError) as error:
        raise ValueError(f"{path}, {error}") from error
    except RecursionError as error:
        raise ValueError(f"{path} is nested more than {MOST_LEVELS} levels deep") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path} must contain a mapping, got {type(data).__name__}")
    return data


def yaml_text(data: Any) -> str:
    """Plain data as YAML that :func:`read_yaml` reads back unchanged; mappings keep their order."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)


def presets_folder(kind: str = "scenario") -> Path:
    """The folder of the presets of a kind, in the installed package or in a source checkout."""
    installed = PACKAGE / "configs"
    root = installed if installed.is_dir() else PACKAGE.parent / "configs"
    return root / KINDS[kind]


def preset_names(kind: str = "scenario") -> list[str]:
    """Sorted names of the presets of a kind."""
    return sorted(path.stem for path in presets_folder(kind).glob("*.yaml"))


def is_file_name(source: str | Path) -> bool:
    """Whether a source names a YAML file rather than a preset."""
    return Path(source).suffix.lower() in SUFFIXES


def read_preset_or_file(kind: str, source: str | Path, others: str = "") -> dict[str, Any]:
    """The mapping of a preset, by its name, or of a YAML file, by its path.

    Parameters
    ----------
    kind
        One of :data:`KINDS`.
    source
        A preset's name, or a path that ends in ``.yaml`` or ``.yml``.
    others
        What else is allowed, appended to the error message.

    Raises
    ------
    ValueError
        in one line, if the source is neither, or as :func:`read_yaml`.
    """
    names = preset_names(kind)
    if str(source) in names:
        return read_yaml(presets_folder(kind) / f"{source}.yaml")
    if isinstance(source, str | Path) and is_file_name(source):
        return read_yaml(Path(source))
    raise ValueError(
        f"{kind} {str(source)!r:.60} is not one of {', '.join(names)}, nor a .yaml file{others}"
    )
