"""Tables of the documentation, for tests that hold them against the code."""

from __future__ import annotations

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def rows_of(page: str, name: str) -> dict[str, list[str]]:
    """The cells of a table between two markers, without its head: by the first cell, the others."""
    text = (DOCS / page).read_text(encoding="utf-8")
    inside = text.split(f"<!-- {name} -->\n")[1].split(f"<!-- end of {name} -->")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in inside.splitlines()]
    return {first: others for first, *others in rows[2:]}


def numbers_in(text: str) -> list[float]:
    """The decimal numbers of a cell."""
    return [float(one) for one in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", text.replace("−", "-"))]
