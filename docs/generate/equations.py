"""The code beside the equations of ``docs/equations.md``.

A line ``<!-- code: module:name -->`` is followed by the source of that function or class.
``python docs/generate/equations.py`` renews it; the build of the site and ``tests/test_site.py`` check it.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "equations.md"
PIECE = re.compile(r"(<!-- code: ([\w.]+):([\w.]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def source(module: str, name: str) -> str:
    """The source of a function, class or method, with its decorators.

    Raises
    ------
    ValueError
        if the module has nothing of this name.
    """
    text = (ROOT / (module.replace(".", "/") + ".py")).read_text("utf-8")
    body = ast.parse(text).body
    found: ast.stmt | None = None
    for part in name.split("."):
        found = next((one for one in body if getattr(one, "name", None) == part), None)
        if not isinstance(found, ast.FunctionDef | ast.ClassDef):
            raise ValueError(f"{module} has no {name}")
        body = found.body
    assert isinstance(found, ast.FunctionDef | ast.ClassDef)
    first = min([found.lineno, *(one.lineno for one in found.decorator_list)])
    lines = text.splitlines()[first - 1 : found.end_lineno]
    indent = len(lines[0]) - len(lines[0].lstrip())
    return "\n".join(line[indent:] for line in lines)


def renewed(page: str) -> str:
    """A page with the code after its markers renewed."""

    def piece(match: re.Match[str]) -> str:
        module, name = match[2], match[3]
        path = module.replace(".", "/") + ".py"
        return f"{match[1]}[`{name}`](../{path}), `{path}`:\n\n```py\n{source(module, name)}\n```\n\n{match[5]}"

    return PIECE.sub(piece, page)


def main() -> None:
    """Renew the page."""
    PAGE.write_text(renewed(PAGE.read_text("utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
