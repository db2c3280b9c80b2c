"""``tlf compare``: recorded runs of one task side by side, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.console import progress_bar, screen
from baselines.pages.differences import differences
from baselines.pages.replay import write_comparison
from baselines.runs.files import read_record
from baselines.runs.recorded_film import film_of
from baselines.runs.run import Record
from baselines.runs.video import FPS, Film, check_video, write_video
from tlf_env.common.errors import path_text


class Filmed(NamedTuple):
    """A video that is asked for."""

    path: Path
    fps: float = FPS
    speed: float = 1.0


def compare_command(folders: Sequence[Path], out: Path, film: Filmed | None = None) -> list[Record]:
    """Read the runs of some folders, write the page and the video, and print what differs; the records.

    Raises
    ------
    ValueError
        for fewer than two folders, more than a page replays, a folder without a finished run, or runs of
        different tasks or seeds; for a video that cannot be written.
    """
    if film is not None:
        check_video(film.path)
        Film(film.fps, film.speed)  # refuses wrong numbers before anything is read
    if len(folders) < 2:
        raise ValueError("tlf compare needs two runs or more: folders that tlf run has written")
    records = [read_record(folder) for folder in folders]
    for what, values in {
        "tasks": [record.scenario.name for record in records],
        "seeds": [str(record.seed) for record in records],
    }.items():
        if len(set(values)) > 1:
            each = ", ".join(
                f"{value} in {path_text(folder)}"
                for folder, value in zip(folders, values, strict=True)
            )
            raise ValueError(f"runs of different {what} cannot be compared: {each}")
    names = names_of(records)
    write_comparison(records, out, names)
    screen.print(difference_table(records, names))
    screen.print(f"Replay of the runs, in a browser: {out}", soft_wrap=True)
    if film is not None:
        films = [film_of(record, film.fps, film.speed) for record in records]
        with progress_bar("video") as update:
            write_video(films, film.path, captions=names, progress=update)
        screen.print(f"Video: {film.path}", soft_wrap=True)
    return records


def names_of(records: Sequence[Record]) -> list[str]:
    """A name for each run: its policy, its disturbance, or both, whichever differs."""
    policies = [record.policy for record in records]
    disturbances = [
        record.scenario.disturbance.name
        + (f" × {level:g}" if (level := record.scenario.disturbance.level) != 1 else "")
        for record in records
    ]
    if len(set(disturbances)) == 1:
        return policies
    if len(set(policies)) == 1:
        return disturbances
    return [f"{one}, {other}" for one, other in zip(policies, disturbances, strict=True)]


def difference_table(records: Sequence[Record], names: Sequence[str]) -> Table:
    """What differs, as on the page."""
    table = Table(box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column("field")
    for number, name in enumerate(names):
        table.add_column(f"{chr(ord('A') + number)}: {name}", justify="right")
    for field, cells in differences(records):
        table.add_row(field, *cells)
    return table
