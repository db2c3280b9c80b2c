"""Presets (YAML files shipped in ``configs/``): where they are, and how YAML is read and written.

Values are those of YAML 1.2: numbers are decimal (``12``, ``-0.5``, ``5e-1``), and only ``true`` and
``false`` are switches. What YAML 1.1 reads otherwise (``no``, ``010``, ``1_000``, ``1:30``, a date) is refused
unless it is quoted, as it means a number or a switch to one reader and a name to another.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from tlf_env.common.errors import RepeatedKeyError, path_text, shown, suggestion

PACKAGE = Path(__file__).resolve().parent.parent
KINDS = {
    "scenario": "",
    "disturbance": "disturbances",
    "controller": "controllers",
    "world": "worlds",
    "plan": "plans",
    "training": "train",
    "search": "tune",
    "limiter": "limiters",
    "knob": "knobs",
    "pure_pursuit": "laws/pure_pursuit",
    "feedback_linearisation": "laws/feedback_linearisation",
    "kanayama": "laws/kanayama",
    "lqr": "laws/lqr",
    "sliding_mode": "laws/sliding_mode",
    "adrc": "laws/adrc",
    "nmpc": "laws/nmpc",
}  # kinds of preset, and the subfolder of each
SUFFIXES = (".yaml", ".yml")
MOST_LEVELS = 50  # of mappings and lists in each other
MOST_VALUES = (
    1_000_000  # in a file, each as often as aliases repeat it; 100 000 waypoints are 400 000
)
DECIMAL = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"

# Ends of the files that a file may name, and what separates their names in one text.
NAMED_SUFFIXES = (*SUFFIXES, ".csv", ".json", ".parquet", ".safetensors", ".zip", ".npz")
NAMES_A_FILE = ("file", "data")  # keys of waypoints, and of the data of a training
MOST_NAMED = 300  # characters of a name in an error
BETWEEN_NAMES = re.compile(r"[,;:+@]")

SENTENCE_END = re.compile(r"(?<=\.) (?=[A-Z`]|docs/)")
BREAKS = re.compile("[\x85\u2028\u2029]")
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
    "tag:yaml.org,2002:float": rf"{DECIMAL}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
    "tag:yaml.org,2002:merge": r"<<",
}  # what plain values mean, the first that fits; all others are texts


class AmbiguousValueError(ValueError):
    """A plain value of a YAML file that YAML 1.1 and 1.2 read differently."""


class RepetitionError(ValueError):
    """Aliases of a YAML file that repeat too much."""


class _Loader(yaml.SafeLoader):
    """YAML's safe loader with the values of :data:`SCALARS`, and an error for a repeated key.

    A few aliases of aliases can stand for any number of values, so that these are counted.
    """

    yaml_implicit_resolvers = {}
    level = 0

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self.sizes: dict[yaml.Node, int] = {}  # values in a node, itself included

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node; mappings and lists may be nested :data:`MOST_LEVELS` deep."""
        alias = self.check_event(yaml.AliasEvent)
        self.level += 1
        if self.level > MOST_LEVELS:
            raise RecursionError
        try:
            node = super().compose_node(parent, index)
        finally:
            self.level -= 1
        if node is None:
            return None
        if not alias:
            self.sizes[node] = self.size(node)
        elif node not in self.sizes:
            line = node.start_mark.line + 1
            raise RepetitionError(f"line {line}: the value contains itself by an alias")
        return node

    def size(self, node: yaml.Node) -> int:
        """The number of values in a node whose parts are composed, itself included."""
        parts = [] if isinstance(node, yaml.ScalarNode) else node.value
        if isinstance(node, yaml.MappingNode):
            parts = [one for pair in parts for one in pair]
        values = 1 + sum(self.sizes[one] for one in parts)
        if values > MOST_VALUES:
            line = node.start_mark.line + 1
            raise RepetitionError(
                f"line {line}: more than {MOST_VALUES} values, counted with aliases"
            )
        return values

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


def _text(dumper: _Dumper, value: str) -> yaml.ScalarNode:
    """A text; line breaks of Unicode are escaped, which PyYAML would read back as spaces."""
    style = '"' if BREAKS.search(value) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Dumper.add_representer(str, _text)
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
        in one line, if the file is missing, is not YAML, is not a mapping, is nested too deeply, has too
        many values, repeats a key, or has an ambiguous value.
    """
    name = path_text(path)
    try:
        data = parsed_yaml(path.read_text(encoding="utf-8"), name)
    except OSError as error:
        raise ValueError(f"cannot read {name}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{name} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{name} must contain a mapping, got {type(data).__name__}")
    return data


def parsed_yaml(text: str, name: str) -> Any:
    """The value that a YAML text stands for; ``name`` is its source in errors.

    Raises
    ------
    ValueError
        in one line, as :func:`read_yaml`, but for a value of any kind.
    """
    try:
        return yaml.load(text, _Loader)
    except (RepeatedKeyError, AmbiguousValueError, RepetitionError) as error:
        raise ValueError(f"{name}, {error}") from error
    except RecursionError as error:
        raise ValueError(f"{name} is nested more than {MOST_LEVELS} levels deep") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{name} is not YAML: {' '.join(str(error).split())}") from error


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


def preset_summary(kind: str, name: str) -> str:
    """The first sentence of the comment at the top of a preset's file."""
    lines = (presets_folder(kind) / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    comment = itertools.takewhile(lambda line: line.startswith("#"), lines)
    return first_sentence(" ".join(line.lstrip("# ") for line in comment))


def first_sentence(text: str) -> str:
    """The first sentence of a text, or its first paragraph if that ends before."""
    paragraph = " ".join(text.partition("\n\n")[0].split())
    return SENTENCE_END.split(paragraph, maxsplit=1)[0]


def is_file_name(source: str | Path) -> bool:
    """Whether a source names a YAML file rather than a preset."""
    return Path(source).suffix.lower() in SUFFIXES


def is_path_file(source: str | Path) -> bool:
    """Whether a source names a CSV file, a path of waypoints."""
    return Path(source).suffix.lower() == ".csv"


def preset_or_file(kind: str, source: str) -> Path | None:
    """Where a preset or the YAML file that a source names lies; None if it is neither's name."""
    if source in preset_names(kind):
        return presets_folder(kind) / f"{source}.yaml"
    return Path(source) if is_file_name(source) else None


def beside(folder: Path, named: Any) -> Any:
    """What a file in a folder names, with the paths of the YAML and CSV files that lie in the folder.

    A relative path starts at the folder, or at the working directory if there is no such file in the folder.
    ``named`` is a name, a list of names or a mapping by names; all else is returned as it is.
    """
    if isinstance(named, list):
        return [beside(folder, one) for one in named]
    if isinstance(named, dict):
        return {beside(folder, one): value for one, value in named.items()}
    if not isinstance(named, str) or not (is_file_name(named) or is_path_file(named)):
        return named
    path = folder / named
    return str(path) if path.is_file() else named


def check_named_files(path: Path, data: Any) -> None:
    """Check that the files that a file's values name lie in its folder, or in the working directory.

    Links are followed. So a file of others reads nothing that did not come with it, or that lies where the
    user works.

    Parameters
    ----------
    path
        The file.
    data
        Plain data. A text, or what is between commas, colons, ``+`` and ``@`` in it, names a file if it ends as
        one, and always as the value of a key in :data:`NAMES_A_FILE`.

    Raises
    ------
    ValueError
        in one line that names the file, and what it names.
    """
    folders = [path.resolve().parent, Path.cwd()]
    for text, is_file in _texts(data):
        for named in {text, *BETWEEN_NAMES.split(text)}:
            name = named.strip()
            if not (is_file or name.lower().endswith(NAMED_SUFFIXES)):
                continue
            for start in folders:
                try:
                    found = (start / name).resolve()
                except (
                    OSError,
                    RuntimeError,
                    ValueError,
                ):  # a loop of links, a character that none has
                    continue
                if not any(folder in found.parents for folder in folders):
                    raise ValueError(
                        f"{path_text(path)} names {path_text(name[-MOST_NAMED:])}, which lies neither in its "
                        "folder nor in the working directory"
                    )


def _texts(data: Any, is_file: bool = False) -> Iterator[tuple[str, bool]]:
    """All texts in plain data, keys included, and whether each is the value of a key of a file."""
    if isinstance(data, str):
        yield data, is_file
    elif isinstance(data, dict):
        for key, value in data.items():
            yield from _texts(key)
            yield from _texts(value, key in NAMES_A_FILE)
    elif isinstance(data, list | tuple):
        for one in data:
            yield from _texts(one, is_file)


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
        in one line, if the source is neither, or as :func:`read_yaml` and, for a file,
        :func:`check_named_files`.
    """
    path = preset_or_file(kind, str(source))
    if path is not None:
        found = read_yaml(path)
        if is_file_name(source):
            check_named_files(path, found)
        return found
    names = preset_names(kind)
    raise ValueError(
        f"{kind} {shown(str(source))} is not one of {', '.join(names)}, nor a .yaml file{others}"
        f"{suggestion(source, names)}"
    )
