"""The page of the paper's results: in Markdown with figures beside it, and as one file of HTML."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from baselines.pages.page import page, text
from baselines.paper.claims import Finding, Verdict
from baselines.paper.parts import Part, Table
from baselines.paper.results import PARTS, Result, command_of
from tlf_env.common.files import atomic

TITLE = "The paper, figure by figure"
INTRODUCTION = (
    "Claims of the paper, computed anew. A verdict follows from the computed number by the rule in the "
    "same row; none is written by hand. Equation and figure numbers are the paper's. Units: mm, kg, s, "
    "rad, N·mm.",
    "“Printed gains”: k₂ = 0.83 mm²/s as in the paper. “k₂/k₃ = 0.83 1/s” (consistent): the reading of k₂ "
    "that damps the heading.",
)
OPEN = (
    "Fig. 11 has one seed. The experiment of Fig. 7(c) excites both wheels alike, so that it says nothing "
    "about the differential mode. The screening varies neither the period of the wheel loop and the filter, "
    "which is 1 ms, nor their noise, nor the joints' friction, which Table I gives.",
)
HEAD = ("claim", "paper", "computed", "rule", "verdict", "figure")
CLASSES = {Verdict.REPRODUCED: "good", Verdict.PARTLY: "part", Verdict.NOT: "bad"}


def counted(results: Mapping[str, Result]) -> str:
    """How many claims have which verdict."""
    counts = Counter(one.verdict for result in results.values() for one in result.findings)
    total = sum(counts.values())
    each = ", ".join(f"{counts[str(verdict)]} {verdict}" for verdict in Verdict)
    return f"{total} claims: {each}."


def in_order(results: Mapping[str, Result]) -> list[tuple[Part, Result]]:
    """Parts with a result, as in the paper."""
    return [(part, results[name]) for name, part in PARTS.items() if name in results]


def write_pages(results: Mapping[str, Result], folder: Path) -> list[Path]:
    """Write ``paper.md`` and ``paper.html`` beside the figures."""
    written = []
    for name, content in (
        ("paper.md", markdown(results)),
        ("paper.html", html_page(results, folder)),
    ):
        with atomic(folder / name, encoding="utf-8") as file:
            file.write(content)
        written.append(folder / name)
    return written


# Markdown


def markdown(results: Mapping[str, Result], images: str = "") -> str:
    """The page in Markdown; ``images`` is put before the name of each figure's file."""
    lines = [f"# {TITLE}", ""]
    for paragraph in (*INTRODUCTION, counted(results)):
        lines += [plain(paragraph), ""]
    lines += ["```console", ".venv/bin/tlf paper --out results/paper", "```", ""]
    lines += ["## Claims", ""]
    for part, result in in_order(results):
        if result.findings:
            lines += [f"### {plain(part.title)}", "", f"`{command_of(part.name)}`", ""]
            lines += [f"<!-- {part.name} -->"]
            lines += table_lines(HEAD, [claim_cells(one) for one in result.findings])
            lines += [f"<!-- end of {part.name} -->", ""]
    for part, result in in_order(results):
        lines += [f"## {plain(part.title)}", ""]
        for paragraph in part.text:
            lines += [plain(paragraph), ""]
        for name in result.figures:
            caption = plain(part.captions[name])
            lines += [f"![{caption}]({images}{name}.png)", f"*{caption}*", ""]
        for table in result.tables:
            lines += [f"{plain(table.title)}:", "", *table_lines(table.head, table.rows), ""]
    lines += ["## Not examined", "", *(plain(one) for one in OPEN), ""]
    return "\n".join(lines)


def claim_cells(one: Finding) -> tuple[str, ...]:
    """A row of the table of claims."""
    return (
        f"{one.statement} ({one.source})",
        one.reported,
        f"{one.quantity}: {one.computed}",
        one.rule,
        one.verdict,
        one.figure,
    )


def table_lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table in Markdown."""
    return [
        f"| {' | '.join(plain(cell) for cell in row)} |"
        if row is not None
        else "|" + "---|" * len(head)
        for row in (head, None, *rows)
    ]


def plain(value: str) -> str:
    """A text that Markdown shows as it is, also in a table."""
    for sign, instead in (
        ("&", "&amp;"),
        ("<", "&lt;"),
        (">", "&gt;"),
        ("|", "\\|"),
        ("*", "\\*"),
        ("_", "\\_"),
    ):
        value = value.replace(sign, instead)
    return value


# HTML


def html_page(results: Mapping[str, Result], folder: Path) -> str:
    """The page as one file; the figures are read from the folder."""
    parts = [f"<h1>{text(TITLE)}</h1>"]
    parts += [f"<p>{text(one)}</p>" for one in (*INTRODUCTION, counted(results))]
    parts += ["<p><code>tlf paper --out results/paper</code></p>", "<h2>Claims</h2>"]
    for part, result in in_order(results):
        if result.findings:
            parts += [
                f"<h3>{text(part.title)}</h3>",
                f"<p class='soft'><code>{text(command_of(part.name))}</code></p>",
                claims_html(result.findings),
            ]
    for part, result in in_order(results):
        parts += [f"<h2 id='{part.name}'>{text(part.title)}</h2>"]
        parts += [f"<p>{text(one)}</p>" for one in part.text]
        for name in result.figures:
            caption = text(part.captions[name])
            picture = base64.b64encode((folder / f"{name}.png").read_bytes()).decode()
            parts += [
                f"<figure id='{text(name)}'><img alt='{caption}' src='data:image/png;base64,{picture}'>"
                f"<figcaption class='soft'>{caption}</figcaption></figure>"
            ]
        for table in result.tables:
            parts += [f"<p>{text(table.title)}:</p>", table_html(table)]
    parts += ["<h2>Not examined</h2>", *(f"<p>{text(one)}</p>" for one in OPEN)]
    return page(TITLE, "\n".join(parts), styles=("paper.css",))


def claims_html(findings: Sequence[Finding]) -> str:
    """The table of claims; figures are links, verdicts have a colour beside their word."""
    rows = []
    for one in findings:
        *cells, verdict, figure = claim_cells(one)
        kind = CLASSES[Verdict(verdict)]
        link = f"<a href='#{text(figure)}'>{text(figure)}</a>" if figure else ""
        rows.append(
            "".join(f"<td class='text'>{text(cell)}</td>" for cell in cells)
            + f"<td class='text {kind}'>{text(verdict)}</td><td class='text'>{link}</td>"
        )
    return _table(HEAD, rows, "claims")


def table_html(table: Table) -> str:
    """A table of texts."""
    rows = ["".join(f"<td class='text'>{text(cell)}</td>" for cell in row) for row in table.rows]
    return _table(table.head, rows, "")


def _table(head: Sequence[str], rows: Sequence[str], kind: str) -> str:
    heads = "".join(f"<th class='text'>{text(cell)}</th>" for cell in head)
    body = "\n".join(f"<tr>{row}</tr>" for row in rows)
    return (
        f"<div class='wide'><table class='{kind}'><thead><tr>{heads}</tr></thead><tbody>\n{body}\n"
        "</tbody></table></div>"
    )
