"""The page that lists the runs of a folder."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from baselines.pages.page import page, text
from baselines.runs.folders import INDEX, REPLAY, SUMMARY, verdict
from tlf_env.common.errors import path_text
from tlf_env.common.files import atomic, read_json
from tlf_env.common.models import as_float

HEADINGS = (
    "run",
    "task",
    "policy",
    "disturbance",
    "seed",
    "worst position RMS, mm",
    "verdict",
    "overview",
)
NUMBERS = (3, 4)  # columns after the first that are numbers


def write_index(parent: Path) -> Path | None:
    """Write a page with a row for each run in the folders of ``parent``; None if there is no run."""
    summaries = sorted(parent.glob(f"*/{SUMMARY}"), key=lambda path: -path.stat().st_mtime)
    rows = [row for path in summaries if (row := _row(path)) is not None]
    if not rows:
        return None
    heads = "".join(
        f"<th{_aligned(number - 1)}>{heading}</th>" for number, heading in enumerate(HEADINGS)
    )
    body = (
        "<h1>Runs in this folder</h1>\n<p>Made by <code>tlf run</code>; the latest is first. A name opens the "
        "replay of the run. Errors: the largest root mean square among the robots.</p>\n"
        f'<div class="wide"><table><thead><tr>{heads}</tr></thead><tbody>\n'
        + "\n".join(rows)
        + "\n</tbody></table></div>"
    )
    path = parent / INDEX
    with atomic(path, encoding="utf-8") as file:
        file.write(page("Runs", body))
    return path


def _aligned(column: int) -> str:
    return "" if column in NUMBERS else ' class="text"'


def _row(path: Path) -> str | None:
    """A row of the page; None for a summary that cannot be read."""
    try:
        data = read_json(path)
        robots = list(data["robots"].values())
        errors = [robot["position_rmse_mm"] for robot in robots]
        known = [as_float(error) for error in errors if error is not None]
        scenario = data["scenario"]
        cells = [
            scenario["name"],
            data["policy"],
            scenario["disturbance"]["name"],
            str(data["seed"]),
            "–" if len(known) < len(errors) else f"{max(known):.2f}",
            verdict(data.get("interrupted", False), robots),
        ]
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    # With "./" no name of a folder is taken for a scheme, as javascript: would be.
    place = text(f"./{quote(os.fsencode(path.parent.name))}")
    opened = f"{place}/{REPLAY}" if (path.parent / REPLAY).exists() else f"{place}/"
    picture = path.parent / "overview.png"
    image = (
        f'<a href="{place}/{picture.name}"><img src="{place}/{picture.name}" height="80" alt="overview"></a>'
        if picture.exists()
        else ""
    )
    texts = "".join(f"<td{_aligned(number)}>{text(cell)}</td>" for number, cell in enumerate(cells))
    name = text(path_text(path.parent.name))
    return f'<tr><td><a href="{opened}">{name}</a></td>{texts}<td class="text">{image}</td></tr>'
