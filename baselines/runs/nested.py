"""Values of nested mappings by dotted paths: ``slip.delta_1_mm_s``."""

from __future__ import annotations

from typing import Any


def value_at(tree: Any, path: str) -> Any:
    """The value at a dotted path.

    Raises
    ------
    KeyError
        if the path does not exist.
    """
    for name in path.split("."):
        tree = tree[name]
    return tree


def with_value(tree: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy of a nested mapping with one value replaced.

    Raises
    ------
    ValueError
        if the path does not exist.
    """
    head, _, tail = path.partition(".")
    if head not in tree:
        raise ValueError(f"there is no {head!r}; there are {', '.join(sorted(tree))}")
    if tail and not isinstance(tree[head], dict):
        raise ValueError(f"{head!r} is a value, not a group, got {path!r}")
    return {**tree, head: with_value(tree[head], tail, value) if tail else value}
