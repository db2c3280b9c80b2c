"""A part of the paper's results: how its data are computed, drawn and tabulated, and its claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from baselines.paper.claims import Claim

Progress = Callable[..., None]  # update(done, total, what is done now)


class Table(NamedTuple):
    """A table of texts; the first column names the row."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Part:
    """One figure of the paper, or some that belong together.

    Attributes
    ----------
    name
        Name on the command line.
    title, text
        Heading, and paragraphs of plain text.
    compute
        Computes the data; its argument is called with the steps done and their total.
    draw
        The figures of the data, by name.
    captions
        A caption for each figure.
    tables
        The tables of the data.
    claims
        The claims that the data decide.
    drives
        Whether it needs the compiled step drivers.
    """

    name: str
    title: str
    text: tuple[str, ...]
    compute: Callable[[Progress], Any]
    draw: Callable[[Any], Mapping[str, Figure]]
    captions: Mapping[str, str]
    tables: Callable[[Any], tuple[Table, ...]]
    claims: tuple[Claim, ...]
    drives: bool = False
