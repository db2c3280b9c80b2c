"""The tables of envelopes: levels with intervals, the score, differences between systems, and the page.

The score of a system is the geometric mean of its envelopes, in levels, over all knobs and tasks. Level 1 is
the disturbance as the knob's file has it, so a score of 2 is twice these disturbances. An envelope below the
first level of a knob counts as the first level, one beyond the last as the last.

What a system spends is beside the score: energy, torque and time gap at the usual level of each knob, the
largest one up to 1 that every system runs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

from baselines.benchmark.envelope import CONFIDENCE, HELD_SHARE, Envelope, Probe, envelope
from baselines.benchmark.envelope_runs import PLAN_FILE, EnvelopeResults, middle
from baselines.benchmark.knobs import unit_of
from baselines.benchmark.lines import BESIDE
from baselines.benchmark.page import figure_title, number, policy_label
from tlf_env.common.files import atomic

BOARD_FILE, PAGE_FILE = "envelope.json", "envelope.md"
SECONDS_PER_HOUR = 3600.0


def envelope_board(results: EnvelopeResults, command: str = "") -> dict[str, Any]:
    """Everything that the tables and the figure show, from finished levels.

    Parameters
    ----------
    command
        The command that made the results, for the page.
    """
    plan = results.plan
    cells = []
    for search in plan.searches():
        knob, found = plan.loaded[search.knob], plan.grids[search.knob]
        made = envelope(found, results.failed(search), plan.counts)
        lines = [line for probe, line in results.lines.items() if probe.search == search]
        usual = results.lines.get(Probe(*search, found.usual), {})
        cells.append(
            {
                **search._asdict(),
                **made._asdict(),
                "holds_again": list(made.holds_again),
                "first": found.levels[0],
                "last": found.levels[-1],
                "counted": counted(made, found.levels),
                "shown": knob.shown,
                "value": None if made.level is None else knob.value(made.level),
                "value_low": None if made.low is None else knob.value(made.low),
                "value_high": None if made.high is None else knob.value(made.high),
                "value_first": knob.value(found.levels[0]),
                "value_last": knob.value(found.levels[-1]),
                "privileged": any(line["privileged"] for line in lines),
                "overrides": lines[0]["overrides"] if lines else {},
                "tested": len(lines),
                "usual": found.usual,
                **{name: usual.get(name) for name in BESIDE},
            }
        )
    policies = [policy_row(name, cells) for name in plan.policies]
    policies.sort(key=lambda row: -row["score"])
    return {
        "command": command,
        "plan": json.loads((results.folder / PLAN_FILE).read_text(encoding="utf-8")),
        "counts": plan.counts._asdict(),
        "policies": policies,
        "cells": cells,
        "comparisons": comparisons(policies, cells),
        "levels": len(results.lines),
        "processor_hours": round(
            sum(line["seconds"] for line in results.lines.values()) / SECONDS_PER_HOUR, 3
        ),
    }


def counted(made: Envelope, levels: Sequence[float]) -> float:
    """The level with which an envelope counts in the score."""
    return levels[0] if made.level is None else made.level


def policy_row(policy: str, cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A system over all knobs and tasks."""
    mine = [cell for cell in cells if cell["policy"] == policy]
    return {
        "policy": policy,
        "privileged": any(cell["privileged"] for cell in mine),
        "overrides": {key: value for cell in mine for key, value in cell["overrides"].items()},
        "score": math.exp(math.fsum(math.log(cell["counted"]) for cell in mine) / len(mine)),
        "below_first": sum(cell["level"] is None for cell in mine),
        "beyond_last": sum(cell["beyond"] for cell in mine),
        "knobs": len(mine),
        **{name: middle([cell[name] for cell in mine]) for name in BESIDE},
    }


def comparisons(
    policies: Sequence[Mapping[str, Any]], cells: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Each system against the one with the best score: the median of the paired ratios of their envelopes.

    A pair is a knob and task. The interval is the one of the sign test: the order statistics between which the
    median lies with a probability of at least 95 %, whatever the distribution of the ratios.
    """
    best = policies[0]["policy"]
    theirs = {
        (cell["task"], cell["knob"]): cell["counted"] for cell in cells if cell["policy"] == best
    }
    rows = []
    for row in policies[1:]:
        ratios = sorted(
            cell["counted"] / theirs[cell["task"], cell["knob"]]
            for cell in cells
            if cell["policy"] == row["policy"]
        )
        rows.append(
            {
                "policy": row["policy"],
                "rival": best,
                "ratio": float(np.median(ratios)),
                "interval": sign_interval(ratios),
                "larger": sum(ratio > 1 for ratio in ratios),
                "smaller": sum(ratio < 1 for ratio in ratios),
            }
        )
    return rows


def sign_interval(ordered: Sequence[float]) -> list[float] | None:
    """Interval of the median of ordered values, from the sign test; None for fewer than six."""
    count = len(ordered)
    places = [k for k in range(count // 2) if binom.cdf(k, count, 0.5) <= (1 - CONFIDENCE) / 2]
    if not places:
        return None
    return [float(ordered[places[-1]]), float(ordered[count - 1 - places[-1]])]


def text_of(cell: Mapping[str, Any]) -> str:
    """The envelope as the shown number with its interval."""
    mark = " ↕" if cell["holds_again"] else ""
    if cell["level"] is None:
        return f"none ({short(cell['value_first'])} fails){mark}"
    if cell["beyond"]:
        return f"all (to {short(cell['value_last'])})"
    low = "–" if cell["value_low"] is None else short(cell["value_low"])
    high = "–" if cell["value_high"] is None else short(cell["value_high"])
    return f"{short(cell['value'])} [{low}, {high}]{mark}"


def short(value: float) -> str:
    """A number with three digits."""
    return f"{float(f'{value:.3g}'):g}"


def envelope_tables(board: Mapping[str, Any]) -> list[str]:
    """The score, the differences and the envelopes as lines of Markdown."""
    names = [row["policy"] for row in board["policies"]]
    parts = [
        "| system | score | knobs below the first level | beyond the last | median ratio to the best | "
        "larger, smaller | energy J | torque RMS N·mm | time gap RMS s |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    compared = {row["policy"]: row for row in board["comparisons"]}
    for row in board["policies"]:
        other = compared.get(row["policy"])
        signs = "–" if other is None else f"{other['larger']}, {other['smaller']}"
        parts.append(
            f"| {policy_label(dict(row))} | {row['score']:.2f} | {row['below_first']} of {row['knobs']} | "
            f"{row['beyond_last']} | {ratio_text(other)} | {signs} | {number(row['energy_J'], 2)} | "
            f"{number(row['torque_rms_Nmm'], 2)} | {number(row['time_gap_rmse_s'], 4)} |"
        )
    for task in dict.fromkeys(cell["task"] for cell in board["cells"]):
        parts += ["", f"Envelopes on `{task}`:", ""]
        parts += [
            "| knob | number | level 1 | " + " | ".join(f"`{name}`" for name in names) + " |",
            "|---|---|---:|" + "---:|" * len(names),
        ]
        cells = {
            (cell["knob"], cell["policy"]): cell for cell in board["cells"] if cell["task"] == task
        }
        for knob in dict.fromkeys(knob for knob, _ in cells):
            mine = [cells[knob, name] for name in names]
            largest = max(cell["counted"] for cell in mine)
            texts = [
                f"**{text_of(cell)}**" if cell["counted"] == largest else text_of(cell)
                for cell in mine
            ]
            parts.append(
                f"| `{knob}` | {number_name(mine[0]['shown'])} | {short(level_one(mine[0]))} | "
                + " | ".join(texts)
                + " |"
            )
    return parts


def ratio_text(row: Mapping[str, Any] | None) -> str:
    """A median ratio with its interval, bold if the interval excludes 1."""
    if row is None:
        return "1"
    text = f"{row['ratio']:.2f}"
    if row["interval"] is None:
        return text
    low, high = row["interval"]
    if high < 1 or low > 1:
        text = f"**{text}**"
    return f"{text} [{low:.2f}, {high:.2f}]"


def level_one(cell: Mapping[str, Any]) -> float:
    """The shown number at level 1; it is linear in the level."""
    slope = (cell["value_last"] - cell["value_first"]) / (cell["last"] - cell["first"])
    return float(cell["value_first"] + slope * (1 - cell["first"]))


def number_name(path: str) -> str:
    """The shown number with its unit: ``slip.delta_1_mm_s.std`` → ``slip.delta_1_mm_s.std (mm/s)``."""
    unit = next((unit_of(part) for part in reversed(path.split(".")) if unit_of(part)), "")
    return f"`{path}`" + (f" ({unit})" if unit else "")


def envelope_page(board: Mapping[str, Any], figures: Sequence[str] = ()) -> str:
    """The tables as a page of Markdown, with links to the figures."""
    plan = board["plan"]["plan"]
    first, end = plan["seeds"]
    return "\n".join(
        [
            "# Envelopes\n",
            f"Made by `{board['command']}`.\n",
            f"{explanation(board)}\n",
            *envelope_tables(board),
            "",
            f"{board['levels']} levels of up to {end - first} runs took "
            f"{board['processor_hours']:.2f} hours of one processor core.",
            *(f"\n![{figure_title(name)}]({name})" for name in figures),
            "",
        ]
    )


def explanation(board: Mapping[str, Any]) -> str:
    """What the numbers of the tables are, in sentences."""
    first, end = board["plan"]["plan"]["seeds"]
    counts = board["counts"]
    low, high = counts["low"], counts["high"]
    ends = [
        "no low end, since there are too few seeds"
        if low is None
        else f"the largest level at which at most {low} fail",
        "no high end, since there are too few seeds"
        if high is None
        else f"the first level at which more than {high} fail",
    ]
    return (
        f"The largest level that at least {end - first - counts['held']} of {end - first} runs hold (seeds "
        f"{first} to {end - 1}, the same for every system and level), with all tested levels below it. A run "
        "fails if a robot is lost or touches another. In brackets, the "
        f"{100 * CONFIDENCE:.0f} % interval of the level that {100 * HELD_SHARE:.0f} % of all seeds hold: "
        f"{ends[0]}; {ends[1]}. **Bold**: the largest of a row. ↕: a tested level above holds again. Score: "
        "geometric mean of the envelopes in levels. Energy of all robots, torque and time gap of the worst: "
        "medians over the knobs of the medians over the runs, at the largest level up to 1 that every system "
        "runs."
    )


def write_envelope(
    results: EnvelopeResults,
    folder: Path,
    command: str,
    draw: Callable[[dict[str, Any], Path], Sequence[Path]] | None = None,
) -> dict[str, Any]:
    """Write ``envelope.json`` and ``envelope.md``; returns the content of the first.

    Parameters
    ----------
    draw
        Writes figures into the folder and returns their paths; the page shows them.
    """
    board = envelope_board(results, command)
    with atomic(folder / BOARD_FILE, encoding="utf-8") as file:
        json.dump(board, file, indent=1, allow_nan=False)
        file.write("\n")
    figures = [path.name for path in draw(board, folder)] if draw else []
    with atomic(folder / PAGE_FILE, encoding="utf-8") as file:
        file.write(envelope_page(board, figures))
    return board
