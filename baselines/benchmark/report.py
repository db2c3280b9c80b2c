"""The report of a benchmark: one page of HTML to sort, to filter, to look at, and to run single episodes again.

It is made from the leaderboard and from the lines of ``runs.jsonl``; the charts are drawn in the browser from
the same numbers.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from baselines.benchmark.comparisons import LEAST_RUNS, in_words, only_one_failed
from baselines.benchmark.knobs import is_geometric, knob_label
from baselines.benchmark.lines import Line, Strata, grouped
from baselines.benchmark.notable import Commands, key_of, notable
from baselines.benchmark.page import DEFINITIONS, number, policy_label, span, stratum_name
from baselines.benchmark.plan import Episode, Plan
from baselines.benchmark.replays import Replay, by_cell
from baselines.benchmark.results import Results
from baselines.pages.page import page, text
from tlf_env.common.files import atomic

REPORT_FILE = "report.html"
SCRIPTS, STYLES = ("theme.js", "report.js"), ("report.css",)
DIGITS = 5  # significant, of numbers in the charts


class Metric(NamedTuple):
    """A number of a cell that the page shows."""

    key: str
    title: str
    unit: str
    digits: int
    good: str  # "low" or "high"
    log: bool  # colours by ratios


METRICS = (
    Metric("position_rmse_mm", "position RMS", "mm", 1, "low", True),
    Metric("failed", "failed runs", "%", 0, "low", False),
    Metric("score", "score", "", 1, "high", False),
    Metric("settled_formation_rmse_mm", "formation RMS", "mm", 1, "low", True),
    Metric("error_capped_mean_mm", "capped mean", "mm", 1, "low", True),
    Metric("torque_rms_Nmm", "torque RMS", "N·mm", 1, "low", False),
)
COLUMNS = (  # what the headings of the tables mean, beside the definitions of the leaderboard's page
    ("failed", "runs in which a robot was lost or touched something; the interval is Wilson's"),
    (
        "time per step",
        "from observations to actions, all robots together, of entries that are processes of their own; a step "
        "is late if it takes longer than a control period",
    ),
    (
        "median run",
        "the seed whose position RMS of the worst robot is the median (the lower one of two); its command runs "
        "it again, with the same result in every digit on the same machine and versions",
    ),
    (
        "worst run",
        "the seed of a failed run, if any, with the largest position RMS of the worst robot",
    ),
    (
        "verdict",
        "on the same seeds for both: first the exact sign test of the seeds that only one of them fails, then "
        f"whether the interval of the differences of the position RMS excludes 0; none for fewer than "
        f"{LEAST_RUNS} runs. Without any true difference, one row in twenty has a verdict by chance",
    ),
)


def write_report(
    results: Results,
    board: Mapping[str, Any],
    folder: Path,
    replays: Sequence[Replay] = (),
    compared: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Write ``report.html``.

    Parameters
    ----------
    board
        As of :func:`~baselines.benchmark.aggregate.leaderboard`.
    replays
        Written replays in the folder; the page links to them.
    compared
        Comparisons that the page begins with, as of :func:`~baselines.benchmark.comparisons.comparison`, in
        place of those of the board.
    """
    path = folder / REPORT_FILE
    content = report_page(board, results.plan, results.ordered(), replays, compared)
    with atomic(path, encoding="utf-8") as file:
        file.write(content)
    return path


def report_page(
    board: Mapping[str, Any],
    plan: Plan,
    lines: Sequence[Line],
    replays: Sequence[Replay] = (),
    compared: Sequence[Mapping[str, Any]] = (),
) -> str:
    """The page; without lines it names no runs."""
    groups = grouped(lines)
    first, end = plan.seeds
    runs = sum(row["runs"] for row in board["policies"])
    parts = [
        '<header><h1>Benchmark report</h1><span id="theme" class="screen"></span></header>',
        f"<p>{counted(len(board['policies']), 'policy', 'policies')}, "
        f"{counted(len(plan.places), 'pair of task and disturbance', 'pairs of task and disturbance')}, seeds "
        f"{first} to {end - 1}, {runs} runs. All policies meet the same random draws. Intervals are 95 %.</p>",
        f'<div class="command"><code>{text(board["command"])}</code>{COPY}</div>'
        if board["command"]
        else "",
        comparison_part(compared, groups),
        section("policies", "Over all tasks and disturbances", policies_table(board)),
        section("replays", "Replays", replay_list(replays)) if replays else "",
        HEAT,
        CHART,
        SWEEP if plan.sweep is not None else "",
        PROFILES if board["profiles"] else "",
        "" if compared else comparison_part(board["comparisons"], groups),
        section(
            "cells",
            "Every policy, task and disturbance",
            FILTERS + cells_table(board, plan, groups, replays),
        ),
        section("definitions", "Definitions", definitions()),
        section("plan", "Plan and versions", plan_table(board)),
    ]
    return page(
        "Benchmark report",
        "\n".join(filter(None, parts)),
        scripts=SCRIPTS,
        styles=STYLES,
        data=data_of(board, plan),
    )


# --- parts that the scripts fill

COPY = '<button type="button" class="copy screen">copy</button>'


def section(name: str, title: str, content: str) -> str:
    """A part of the page with its heading; ``content`` is HTML."""
    return f'<section id="{name}"><h2>{text(title)}</h2>\n{content}</section>'


def chooser(name: str, label: str) -> str:
    """A list to choose from, which the script fills."""
    return f'<label>{label} <select id="{name}"></select></label>'


HEAT = section(
    "heat",
    "Policies and disturbances",
    f'<div class="choose screen">{chooser("task", "task")}{chooser("metric", "number")}</div>'
    '<p id="heat-title" class="soft"></p><div class="wide" id="heat-map"></div><div id="heat-scale"></div>'
    '<p class="soft screen">A press on a number shows its runs, and its disturbance below.</p>'
    '<div id="chosen" aria-live="polite"></div>',
)
CHART = section(
    "chart",
    "One disturbance",
    f'<div class="choose screen">{chooser("disturbance", "disturbance")}</div>'
    '<p id="chart-title" class="soft"></p><div class="panels" id="chart-panels"></div>',
)
SWEEP = section(
    "sweep",
    "Robustness",
    '<p id="sweep-title" class="soft"></p><div class="panels" id="sweep-panels"></div>'
    '<div class="legend" id="sweep-legend"></div>',
)
PROFILES = section(
    "profiles",
    "Performance profiles",
    '<p class="soft">Share of runs above each score; every task and disturbance has the same weight.</p>'
    '<div class="panels" id="profile-panels"></div><div class="legend" id="profile-legend"></div>',
)
FILTERS = (
    f'<div class="choose screen">{chooser("by-task", "task")}{chooser("by-disturbance", "disturbance")}'
    f'{chooser("by-policy", "policy")}<span id="shown" class="soft" aria-live="polite"></span></div>'
)


# --- tables


class Cell(NamedTuple):
    """A cell of a table: its HTML, and what it is sorted by; None comes last."""

    html: str
    value: float | str | None
    words: bool = False  # text, to the left


def cell(shown: object, value: float | str | None = None) -> Cell:
    """A cell with plain text, sorted by it or by a value."""
    words = value is None or isinstance(value, str)
    return Cell(text(shown), str(shown) if value is None else value, words)


def sortable(name: str, headings: Sequence[str], rows: Sequence[tuple[str, Sequence[Cell]]]) -> str:
    """A table whose headings sort it; each row with its attributes in HTML."""
    words = [all(cells[i].words for _, cells in rows) for i in range(len(headings))]
    head = "".join(
        f'<th scope="col" aria-sort="none"{TEXT if left else ""}><button type="button" class="sort">{text(one)}'
        "</button></th>"
        for one, left in zip(headings, words, strict=True)
    )
    body = "\n".join(
        f"<tr{attributes}>"
        + "".join(
            f'<td{TEXT if left else ""} data-v="{text("" if one.value is None else one.value)}">{one.html}</td>'
            for one, left in zip(cells, words, strict=True)
        )
        + "</tr>"
        for attributes, cells in rows
    )
    return (
        f'<div class="wide"><table class="sortable" id="{name}"><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


TEXT = ' class="text"'


def with_span(value: float | None, ends: Sequence[float] | None, digits: int) -> Cell:
    """A number with its interval."""
    ends_html = f' <span class="soft">{text(span(ends, digits))}</span>' if ends else ""
    return Cell(text(number(value, digits)) + ends_html, value)


def policies_table(board: Mapping[str, Any]) -> str:
    """The policies over all tasks and disturbances, by score."""
    headings = ["policy", "score", "normalised", "better than the reference", "failed", "runs"]
    timed = any("step_ms" in row for row in board["policies"])
    headings += ["time per step, ms", "late steps, %"] if timed else []
    rows = []
    for row in board["policies"]:
        scaled, better = row["normalised_score"], row["probability_of_improvement"]
        cells = [
            cell(policy_label(row)),
            with_span(row["score"]["iqm"], row["score"]["interval"], 1),
            Cell(number(scaled, 2), scaled),
            Cell(number(better, 2), better),
            cell(row["failed"], row["failed"]),
            cell(row["runs"], row["runs"]),
        ]
        if timed:
            times = row.get("step_ms", {"median": None, "late": None})
            late = None if times["late"] is None else 100 * times["late"]
            cells += [
                Cell(number(times["median"], 2), times["median"]),
                Cell(number(late, 2), late),
            ]
        rows.append(("", cells))
    reference = board["reference"]
    note = f'<p class="soft">Reference: {text(reference)}.</p>' if reference else ""
    return sortable("board", headings, rows) + note


def comparison_part(rows: Sequence[Mapping[str, Any]], groups: Mapping[str, Strata]) -> str:
    """The part with the comparisons; nothing without any."""
    return section("compared", "Comparisons", comparison_table(rows, groups)) if rows else ""


def comparison_table(rows: Sequence[Mapping[str, Any]], groups: Mapping[str, Strata]) -> str:
    """Each entry against its rival on the same seeds, with a verdict where the lines are known."""
    headings = (
        *("policy", "against", "task", "disturbance", "failed", "failed, other"),
        *("position RMS, difference mm", "torque RMS, ratio", "verdict"),
    )
    shown = []
    for row in rows:
        error, torque = row["position_rmse_mm"], row["torque_rms_Nmm"]
        mine, theirs = row["failed"]
        cells = [
            *(cell(row[key]) for key in ("policy", "rival", "task")),
            cell(stratum_name(dict(row))),
            cell(f"{mine} of {row['runs']}", mine),
            cell(f"{theirs} of {row['runs']}", theirs),
            with_span(error["difference"], error["interval"], 2),
            with_span(torque["ratio"], torque["interval"], 3),
            cell(verdict_of(row, groups)),
        ]
        shown.append(("", cells))
    note = '<p class="soft">Differences are medians over the same seeds; below 0 the policy is better.</p>'
    return note + sortable("against", headings, shown)


def verdict_of(row: Mapping[str, Any], groups: Mapping[str, Strata]) -> str:
    """The verdict of a comparison in words; a dash without the lines."""
    stratum = key_of(row)[1]
    try:
        mine, theirs = groups[row["policy"]][stratum], groups[row["rival"]][stratum]
    except KeyError:
        return "–"
    return in_words(row, only_one_failed(mine, theirs))


def cells_table(
    board: Mapping[str, Any], plan: Plan, groups: Mapping[str, Strata], replays: Sequence[Replay]
) -> str:
    """A row for each policy, task and disturbance, with its median and its worst run."""
    commands, written = Commands(plan), by_cell(replays)
    headings = [
        "policy",
        "task",
        "disturbance",
        *(metric.title for metric in METRICS),
    ]
    headings += ["median run", "worst run"] if groups else []
    rows = []
    for i, row in enumerate(board["cells"]):
        policy, stratum = key_of(row)
        cells = [cell(policy), cell(row["task"]), cell(stratum_name(dict(row)))]
        for metric in METRICS:
            value, low, high = values_of(row, metric.key)
            cells.append(
                with_span(
                    value, None if low is None or high is None else (low, high), metric.digits
                )
            )
        lines = groups.get(policy, {}).get(stratum)
        if lines:
            for what, line in notable(lines)._asdict().items():
                replay = written.get(((policy, stratum), what))
                cells.append(Cell(run_cell(line, commands, replay), line["seed"]))
        elif groups:
            cells += [cell("–"), cell("–")]
        rows.append((f' id="cell-{i}"', cells))
    return sortable("all", headings, rows)


def run_cell(line: Line, commands: Commands, replay: Replay | None) -> str:
    """A seed, the command that runs it again, and its replay."""
    episode = Episode.of_line(line)
    words = commands.words(episode)
    shown = (
        "No single command asks for exactly this run."
        if words is None
        else f'<span class="command"><code>{text(shlex.join(["tlf", *words]))}</code>{COPY}</span>'
    )
    link = "" if replay is None else f' <a href="{text(quote(replay.file))}">replay</a>'
    return f'<details class="run"><summary>{episode.seed}</summary>{shown}</details>{link}'


def replay_list(replays: Sequence[Replay]) -> str:
    """Links to the replays, each with what it shows, and whether its run is the one in the table."""
    items = []
    for one in replays:
        line = one.line
        place = f"{line['policy']}, {line['task']}, {stratum_name(line)}, seed {line['seed']}"
        alike = "The same metrics as in the table, in every digit."
        if one.differences:
            count = len(one.differences)
            alike = (
                f"Not the same run as in the table: {counted(count, 'value differs', 'values differ')}; "
                f"{one.differences[0]}."
            )
        css = ' class="alarm"' if one.differences else ' class="soft"'
        items.append(
            f'<li><a href="{text(quote(one.file))}">{text(place)}</a>: the {one.what} run of its cell. '
            f"<span{css}>{text(alike)}</span></li>"
        )
    return f"<ul>\n{''.join(items)}\n</ul>"


def definitions() -> str:
    """The meaning of the columns: those of the leaderboard's page, and those of this one."""
    items = [with_code(line.removeprefix("- ").strip()) for line in DEFINITIONS[1:]]
    items += [f"{text(name.capitalize())}: {text(meaning)}." for name, meaning in COLUMNS]
    return "<ul>\n" + "\n".join(f"<li>{item}</li>" for item in items) + "\n</ul>"


def with_code(line: str) -> str:
    """A line of Markdown, of which only code is marked, as HTML."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", text(line))


def plan_table(board: Mapping[str, Any]) -> str:
    """The plan, and what made the results."""
    record = board["plan"]
    plan = record["plan"]
    rows = {
        **{key.replace("_", " "): plain_value(value) for key, value in plan.items()},
        **{f"version of {name}": value for name, value in record.get("versions", {}).items()},
        "digest of the simulation": record.get("simulation"),
        "digest of the physics": record.get("physics"),
        "revision": record.get("git_revision"),
        **{f"digest of {name}": value for name, value in record.get("policies", {}).items()},
    }
    body = "\n".join(
        f'<tr><th scope="row">{text(name)}</th><td class="text">{text(value)}</td></tr>'
        for name, value in rows.items()
        if value not in (None, "")
    )
    return f'<table class="facts"><tbody>\n{body}\n</tbody></table>'


def plain_value(value: Any) -> str | None:
    """A value of the plan as text; None for an empty list."""
    if isinstance(value, list):
        parts = [":".join(map(str, one)) if isinstance(one, list) else str(one) for one in value]
        return ", ".join(parts) or None
    return None if value is None else str(value)


def counted(count: int, one: str, many: str) -> str:
    """A number with its noun."""
    return f"{count} {one if count == 1 else many}"


# --- numbers of the charts


def values_of(row: Mapping[str, Any], key: str) -> tuple[float | None, float | None, float | None]:
    """A cell's value of a metric and its interval; shares of failed runs in percent."""
    if key == "failed":
        low, high = row["success"]["interval"]
        return 100 - 100 * row["success"]["share"], 100 - 100 * high, 100 - 100 * low
    found = row[key]
    low, high = found["interval"] or (None, None)
    return found["iqm" if key == "score" else "median"], low, high


def data_of(board: Mapping[str, Any], plan: Plan) -> dict[str, Any]:
    """What the scripts draw."""
    names = [name for name in plan.policies if name in board["profiles"]]
    sweeps = sorted({row["sweep"] for row in board["cells"] if row["sweep"] is not None})
    return {
        "metrics": [metric._asdict() for metric in METRICS],
        "policies": names,
        "privileged": [row["policy"] for row in board["policies"] if row["privileged"]],
        "cells": [
            {
                "policy": row["policy"],
                "task": row["task"],
                "disturbance": row["disturbance"],
                "sweep": row["sweep"],
                "place": stratum_name(dict(row)),
                "values": [
                    [rounded(one) for one in values_of(row, metric.key)] for metric in METRICS
                ],
            }
            for row in board["cells"]
        ],
        "profiles": [[rounded(one) for one in board["profiles"][name]] for name in names],
        "sweep": None
        if plan.sweep is None
        else {"label": knob_label(plan.sweep), "log": is_geometric(sweeps)},
    }


def rounded(value: float | None) -> float | None:
    """A number with the digits that a chart needs."""
    return None if value is None else float(f"{value:.{DIGITS}g}")
