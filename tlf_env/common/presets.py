"""Presets (YAML files shipped in ``configs/``): where they are, and how YAML is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tlf_env.common.errors import RepeatedKeyError

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


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, with an error for a repeated key instead of keeping the last one."""

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


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file as a mapping.

    Raises
    ------
    ValueError
        in one line, if the file is missing, is not YAML, is not a mapping, or repeats a key.
    """
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from error
    except RepeatedKeyError as error:
        raise ValueError(f"{path}, {error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path} must contain a mapping, got {type(data).__name__}")
    return data


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
    return Path(source).suffix in SUFFIXES


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
