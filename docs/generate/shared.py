"""What the generated pages of the site share: tables, numbers, pictures, the figures of the board."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
DPI = 130
# Okabe and Ito's colours, which differ in lightness; each line has its own dashes too.
STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "ls": "-"},
    {"color": "#D55E00", "ls": "--"},
    {"color": "#009E73", "ls": "-."},
    {"color": "black", "ls": ":"},
)

Pages = dict[str, str | bytes]  # content by path, relative to docs/


def table(head: Sequence[str], rows: Iterable[Sequence[object]], right: int = 0) -> str:
    """A table in Markdown; the last ``right`` columns are aligned to the right."""
    left = len(head) - right
    lines = [head, ["---"] * left + ["---:"] * right, *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def png(figure: Figure) -> bytes:
    """A figure as a file."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


@functools.cache
def board(name: str = "leaderboard") -> dict[str, Any]:
    """The numbers of a leaderboard."""
    found: dict[str, Any] = json.loads((DOCS / name / "leaderboard.json").read_text("utf-8"))
    return found


def policies_of(name: str = "leaderboard") -> list[dict[str, Any]]:
    """The board's policies, the fewest failed runs first."""
    return sorted(board(name)["policies"], key=lambda one: one["failed"])


def cells(name: str = "leaderboard", **wanted: str) -> list[dict[str, Any]]:
    """The board's cells with these values of ``policy``, ``task`` and ``disturbance``."""
    return [
        cell
        for cell in board(name)["cells"]
        if all(cell[key] == value for key, value in wanted.items())
    ]


def error(cell: dict[str, Any]) -> str:
    """A cell as on the board: the median error in mm and the failed runs in brackets."""
    failed = cell["runs"] - cell["success"]["count"]
    if 2 * failed >= cell["runs"]:
        return f"({failed})"
    median = cell["position_rmse_mm"]["median"]
    return f"{median:.2f}" + (f" ({failed})" if failed else "")


READ = (
    "Position RMS of the worst robot in mm, median of the runs; in brackets the number of failed runs (a robot "
    "is lost or touches another), alone if at least half failed."
)


def policy_page(name: str) -> str:
    """The page's file name of a policy: the part before the estimator, without characters of its own."""
    head = name.split("+", maxsplit=1)[0]
    kind, _, rest = head.partition(":")
    return f"{kind}-{rest}.md" if kind == "reference" and rest else f"{kind}.md"
