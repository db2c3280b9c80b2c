"""Digests of Python code that ignore comments, docstrings and layout."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def code_of(source: str) -> str:
    """The syntax tree of a source as text, without comments, docstrings and layout.

    Fields that are empty or None are left out, because versions of Python differ in them.

    Raises
    ------
    SyntaxError
        if the source is not Python.
    """
    return _text(ast.parse(source))


def _text(node: Any) -> str:
    if isinstance(node, ast.Constant):
        return f"Constant({node.value!r})"
    if isinstance(node, ast.AST):
        fields = [(name, value) for name, value in ast.iter_fields(node) if value not in (None, [])]
        return (
            f"{type(node).__name__}({','.join(f'{name}={_text(value)}' for name, value in fields)})"
        )
    if isinstance(node, list):
        return f"[{','.join(_text(item) for item in node if not _is_text_alone(item))}]"
    return repr(node)


def _is_text_alone(node: Any) -> bool:
    """Whether a statement is only a string, as a docstring is."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def code_digest(folders: Iterable[Path], *more: str) -> str:
    """Twelve hexadecimal digits over the code in some folders, and over further texts.

    Parameters
    ----------
    folders
        Their ``.py`` files count, in a fixed order, by the names of folder and file and by
        :func:`code_of` them.
    """
    digest = hashlib.sha256("\0".join(more).encode())
    for folder in folders:
        for path in sorted(folder.glob("*.py")):
            code = code_of(path.read_text(encoding="utf-8"))
            digest.update(f"\0{folder.name}/{path.name}\0{code}".encode())
    return digest.hexdigest()[:12]
