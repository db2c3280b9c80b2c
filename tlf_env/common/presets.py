"""Presets and files: where they lie, and how YAML is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

PACKAGE = Path(__file__).resolve().parent.parent


def presets_folder() -> Path:
    """Where the presets lie: inside the installed package, or at the top of a source checkout."""
    installed = PACKAGE / "configs"
    return installed if installed.is_dir() else PACKAGE.parent / "configs"


def preset_names(folder: Path | None = None) -> list[str]:
    """Names of the presets in a folder of configs, by default the scenarios."""
    return sorted(path.stem for path in (folder or presets_folder()).glob("*.yaml"))


class _RepeatedKeyError(ValueError):
    """A YAML mapping has a key twice."""


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, which would keep the last of two equal keys in silence, but for that."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """The mapping as written: what it merges with ``<<`` it may override."""
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    line = key.start_mark.line + 1
                    raise _RepeatedKeyError(
                        f"line {line}: the key {key.value!r} stands there twice"
                    )
                seen.add(key.value)
        return node


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file as a mapping.

    Raises
    ------
    ValueError
        in one line, if the file is missing, is not YAML, is not a mapping, or has a key twice.
    """
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from error
    except _RepeatedKeyError as error:
        raise ValueError(f"{path}, {error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path} must hold a mapping, got {type(data).__name__}")
    return data
