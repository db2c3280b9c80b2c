"""An extension of Griffe: parameters that share a description get an entry each.

Griffe gives all names of a line ``a, b`` in a section of parameters the default of the first.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

SECTION = re.compile(r"(Parameters\n-+\n)(.*?)(?=\n\n\S|\Z)", re.DOTALL)
GROUP = re.compile(r"^(\w+(?:, \w+)+)\n((?:[ \t]+.*(?:\n|\Z)|\n(?=[ \t]))+)", re.MULTILINE)


def separated(text: str) -> str:
    """A docstring with one name in each entry of its parameters."""

    def each(group: re.Match[str]) -> str:
        said = group[2] if group[2].endswith("\n") else group[2] + "\n"
        return "".join(f"{name}\n{said}" for name in group[1].split(", "))

    return SECTION.sub(lambda section: section[1] + GROUP.sub(each, section[2]).rstrip(), text)


class SeparateParameters(griffe.Extension):
    """Rewrites docstrings before they are read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = separated(obj.docstring.value)
