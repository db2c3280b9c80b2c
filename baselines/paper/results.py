"""The parts of the paper's results, and the file that holds what was computed of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from baselines.paper import (
    ekf,
    follower,
    nyquist,
    portrait,
    proofs,
    robustness,
    shaping,
    slip,
    tracks,
    unpublished,
)
from baselines.paper.claims import Finding, judge
from baselines.paper.look import write
from baselines.paper.parts import Part, Progress, Table
from tlf_env.common.errors import suggestion
from tlf_env.common.files import atomic, read_json

PARTS: dict[str, Part] = {
    module.PART.name: module.PART
    for module in (
        shaping,
        nyquist,
        portrait,
        slip,
        ekf,
        follower,
        proofs,
        tracks,
        robustness,
        unpublished,
    )
}
FILE = "paper.json"


class Result(NamedTuple):
    """What was computed of a part."""

    findings: tuple[Finding, ...]
    tables: tuple[Table, ...]
    figures: tuple[str, ...]  # names, each with a file NAME.png in the same folder


def command_of(name: str) -> str:
    """The command that computes a part."""
    return f"tlf paper --figures {name}"


def chosen_parts(names: Sequence[str]) -> list[Part]:
    """Parts by their names, in the order of the paper.

    Raises
    ------
    ValueError
        for an unknown name.
    """
    for name in names:
        if name not in PARTS:
            known = ", ".join(PARTS)
            raise ValueError(
                f"--figures {name!r} is unknown{suggestion(name, PARTS)}; options: {known}"
            )
    return [part for part in PARTS.values() if part.name in names]


def make(part: Part, folder: Path, progress: Progress) -> Result:
    """Compute a part, and write its figures into a folder."""
    data = part.compute(progress)
    return finished(part, data, folder)


def finished(part: Part, data: Any, folder: Path) -> Result:
    """The result of a part's data; its figures are written into the folder."""
    figures = part.draw(data)
    write(figures, folder)
    return Result(
        tuple(judge(claim, data, command_of(part.name)) for claim in part.claims),
        part.tables(data),
        tuple(figures),
    )


def read_results(folder: Path) -> dict[str, Result]:
    """The results that a folder holds, by part; none if it has no file of them.

    Raises
    ------
    ValueError
        in one line, for a file that is not one of results.
    """
    path = folder / FILE
    if not path.exists():
        return {}
    data = read_json(path)
    try:
        return {
            name: Result(
                tuple(Finding(**finding) for finding in one["findings"]),
                tuple(
                    Table(table["title"], tuple(table["head"]), tuple(map(tuple, table["rows"])))
                    for table in one["tables"]
                ),
                tuple(one["figures"]),
            )
            for name, one in data.items()
            if name in PARTS
        }
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a file of the paper's results: {error}") from error


def write_results(results: Mapping[str, Result], folder: Path) -> Path:
    """Write the results into the folder's file."""
    plain = {
        name: {
            "findings": [finding._asdict() for finding in results[name].findings],
            "tables": [table._asdict() for table in results[name].tables],
            "figures": results[name].figures,
        }
        for name in PARTS
        if name in results
    }
    path = folder / FILE
    with atomic(path, encoding="utf-8") as file:
        file.write(json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return path
