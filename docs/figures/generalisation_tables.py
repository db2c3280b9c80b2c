"""The tables of ``docs/generalisation.md``, from the kept lines alone."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from generalisation_causes import CAUSES, key_of
from generalisation_cells import BASE, CELLS, CLASSICAL, ENTRIES, LEARNED, MIXTURE, Cell
from generalisation_kick import KICK, ROBOTS, SLIPPING
from generalisation_runs import Line

from baselines.benchmark.comparisons import in_words
from baselines.benchmark.envelope_board import sign_interval
from baselines.policies.learned import load_policy
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.scenario import load_scenario

Lines = Mapping[tuple[str, str], Line]

SHOWN_TABLES = ("tasks", "counts", "gaps", "robots", "disturbances")
# Rows of another table that are shown first: what the learned entries were trained with.
SHOWN_FIRST = {
    "gaps": ("∞, 3 robots, nominal", "∞, 3 robots, combined-medium"),
    "robots": ("∞, 3 robots, nominal", "∞, 3 robots, combined-medium"),
    "disturbances": ("∞, 3 robots, nominal",),
}
TITLES = {
    "tasks": "tasks",
    "counts": "robots in a row",
    "gaps": "time gaps",
    "robots": "other robots",
    "disturbances": "disturbances",
    "rows": "long rows",
}
MARKS = {"better": " +", "worse": " −"}
MOST_PLACES = 5  # that are named
BEST = "the best classical one"


class Compared(NamedTuple):
    """A learned entry and a rival in a cell."""

    cell: str
    entry: str
    rival: str
    verdict: str


def digits(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{float(f'{value:.3g}'):g}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A table in Markdown; the first columns are aligned to the left."""
    marks = ["---"] * left + ["---:"] * (len(head) - left)
    lines = [f"| {' | '.join(head)} |", f"|{'|'.join(marks)}|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


# --- what was in a training ----------------------------------------------------------------------


@functools.cache
def training_of(entry: str) -> dict[str, Any]:
    """The configuration of a learned entry's training, from its card."""
    config: Any = load_policy(entry).card.training["config"]
    return dict(config)


def trained_disturbances(entry: str) -> list[str]:
    """The presets of a training, without the levels that some have."""
    return list(dict.fromkeys(one.split("@")[0] for one in training_of(entry)["disturbances"]))


def was_trained(entry: str, cell: Cell) -> bool:
    """Whether task and disturbance of a cell were in the training; the level does not count."""
    own = set(cell.fields) - {"plant", "horizon_s"}
    return (
        not own
        and cell.source in training_of(entry)["tasks"]
        and cell.disturbance in trained_disturbances(entry)
    )


def joined(values: Iterable[Any]) -> str:
    """Different values, each once."""
    return ", ".join(dict.fromkeys(str(one) for one in values))


def training_texts(entry: str) -> dict[str, str]:
    """What a learned entry was trained with, by the name of the row."""
    training = training_of(entry)
    scenarios = [load_scenario(task) for task in training["tasks"]]
    own = {one.robot == RobotParameters() for one in scenarios}
    return {
        "tasks": joined(f"`{task}`" for task in training["tasks"]),
        "robots in a row": joined(one.robot_count for one in scenarios),
        "time gap, s": joined(f"{one.time_gap_s:g}" for one in scenarios),
        "robot": "the paper's" if own == {True} else "others, too",
        "disturbances": joined(f"`{name}`" for name in trained_disturbances(entry)),
        "robot steps": f"{training['robot_steps'] / 1e6:.1f} M",
    }


def seen() -> str:
    """What each learned entry was trained with."""
    texts = [training_texts(entry) for entry in LEARNED]
    rows = [[name, *(each[name] for each in texts)] for name in texts[0]]
    return table(["", *(f"`{entry}`" for entry in LEARNED)], rows, left=3)


# --- cells ---------------------------------------------------------------------------------------


def standing(line: Line) -> tuple[int, float]:
    """Rank of an entry in a cell, less is better: failed runs, then the median error."""
    return len(line["failed"]), float(np.median(line["rms_mm"]))


def best_classical(lines: Lines, cell: str) -> str:
    """The classical entry with the fewest failed runs; of equals the one with the smallest median."""
    return min(CLASSICAL, key=lambda entry: standing(lines[cell, entry]))


def verdict(mine: Line, theirs: Line) -> str:
    """Two entries on the same seeds, in the words of ``tlf eval``, with the interval of the sign test."""
    lost, their_lost = set(mine["failed"]), set(theirs["failed"])
    pairs = zip(mine["rms_mm"], theirs["rms_mm"], strict=True)
    differences_mm = sorted(a - b for a, b in pairs)
    row = {
        "failed": (len(lost), len(their_lost)),
        "runs": len(differences_mm),
        "position_rmse_mm": {"interval": sign_interval(differences_mm)},
    }
    return in_words(row, (len(lost - their_lost), len(their_lost - lost)))


def compared(lines: Lines, cell: str, entry: str, rival: str = BEST) -> Compared:
    """A learned entry in a cell against a classical one."""
    name = best_classical(lines, cell) if rival == BEST else rival
    return Compared(cell, entry, name, verdict(lines[cell, entry], lines[cell, name]))


def mark(words: str) -> str:
    """The sign of a verdict."""
    return MARKS.get(words.split(":")[0], "")


def error_text(line: Line) -> str:
    """The median error and, in brackets, how many runs failed."""
    lost, median_mm = standing(line)
    return digits(median_mm) + (f" ({lost})" if lost else "")


def cell_row(lines: Lines, cell: str) -> list[str]:
    """A row: the best classical entry is bold, the learned ones have the sign of their verdict."""
    best, texts = best_classical(lines, cell), [cell]
    for entry in ENTRIES:
        text = error_text(lines[cell, entry])
        if entry in LEARNED:
            text += mark(compared(lines, cell, entry).verdict)
        texts.append(f"**{text}**" if entry == best else text)
    return texts


def cells_table(lines: Lines, name: str) -> str:
    """The table of one kind of conditions."""
    shown = [*SHOWN_FIRST.get(name, ()), *(cell.name for cell in CELLS if cell.table == name)]
    head = ["", *(f"`{entry}`" for entry in ENTRIES)]
    return table(head, [cell_row(lines, cell) for cell in shown])


# --- verdicts ------------------------------------------------------------------------------------

RIVALS = (("residual", BASE), ("residual", BEST), ("from-nothing", BEST))


def verdicts(lines: Lines, entry: str, rival: str) -> list[tuple[Cell, Compared]]:
    """The verdicts on an entry in all cells that were not in its training."""
    return [
        (cell, compared(lines, cell.name, entry, rival))
        for cell in CELLS
        if not was_trained(entry, cell)
    ]


def counted(found: Iterable[Compared]) -> str:
    """How many verdicts are better, worse, and neither."""
    words = [one.verdict.split(":")[0] for one in found]
    better, worse = words.count("better"), words.count("worse")
    return f"{better} / {worse} / {len(words) - better - worse}"


def summary(lines: Lines) -> str:
    """For each kind of conditions: in how many cells an entry is better, worse, or neither."""
    found = {pair: verdicts(lines, *pair) for pair in RIVALS}
    rows = [
        [
            title,
            *(counted(one for cell, one in each if cell.table == name) for each in found.values()),
        ]
        for name, title in TITLES.items()
    ]
    mixed = {True: f"all under `{MIXTURE}`", False: "all others"}
    rows += [
        [
            title,
            *(
                counted(one for cell, one in each if (cell.disturbance == MIXTURE) == wanted)
                for each in found.values()
            ),
        ]
        for wanted, title in mixed.items()
    ]
    rows.append(["all", *(counted(one for _, one in each) for each in found.values())])
    head = [
        f"`{entry}` and {rival if rival == BEST else f'its base, `{rival}`'}"
        for entry, rival in RIVALS
    ]
    return table(["conditions", *head], rows)


def holdable(lines: Lines) -> list[str]:
    """The cells in which not every run of every entry fails."""
    return [
        cell.name
        for cell in CELLS
        if any(
            len(lines[cell.name, e]["failed"]) < len(lines[cell.name, e]["rms_mm"]) for e in ENTRIES
        )
    ]


def failures(lines: Lines) -> str:
    """Failed runs of each entry over the cells that some entry holds, and where they are."""
    names, rows = holdable(lines), []
    for entry in ENTRIES:
        lost = {name: len(lines[name, entry]["failed"]) for name in names}
        runs = sum(len(lines[name, entry]["rms_mm"]) for name in names)
        places = [f"{name}: {count}" for name, count in lost.items() if count]
        few = "; ".join(places) if len(places) <= MOST_PLACES else f"{len(places)} cells"
        rows.append([f"`{entry}`", f"{sum(lost.values())} of {runs}", few or "none"])
    return table(["entry", "failed", "where"], rows, left=3)


def losses(lines: Lines) -> str:
    """Every cell in which a learned entry is worse."""
    rows = []
    for entry, rival in RIVALS:
        for cell, one in verdicts(lines, entry, rival):
            if one.verdict.startswith("worse"):
                mine, theirs = lines[cell.name, entry], lines[cell.name, one.rival]
                rows.append(
                    [
                        f"{TITLES[cell.table]}: {cell.name}",
                        f"`{entry}`",
                        error_text(mine),
                        f"`{one.rival}`" + (", its base" if rival == BASE else ""),
                        error_text(theirs),
                        one.verdict.removeprefix("worse: "),
                    ]
                )
    return table(["cell", "entry", "error, mm", "rival", "error, mm", "verdict"], rows, left=2)


# --- along the row -------------------------------------------------------------------------------


def row_cells(line: Line) -> list[str]:
    """Errors of the leader, of robot 1 and of the last one, and how they grow from robot 1 to the last."""
    own, path = line["row_mm"], line["path_mm"]
    return [
        str(len(line["failed"])),
        *(digits(own[place]) for place in (0, 1, -1)),
        f"{own[-1] / own[1]:.2f}",
        *(digits(path[place]) for place in (1, -1)),
        f"{path[-1] / path[1]:.1f}",
        f"{line['gain']:.2f}",
    ]


def row_table(lines: Lines) -> str:
    """Growth of the errors along the long rows."""
    rows = [
        [cell.name, f"`{entry}`", *row_cells(lines[cell.name, entry])]
        for cell in CELLS
        if cell.table == "rows"
        for entry in ENTRIES
    ]
    head = ["row", "entry", "failed", "position: leader", "robot 1", "last", "last / robot 1"]
    head += ["path: robot 1", "last", "last / robot 1", "`time_gain`"]
    return table(head, rows, left=2)


def kick_table(lines: Lines) -> str:
    """How far the robots of a row are moved when one of them slips once."""
    places = (SLIPPING, SLIPPING + 1, SLIPPING + 2, 5, ROBOTS - 1)
    rows = []
    for entry in ENTRIES:
        moved = np.array(lines[KICK, entry]["row_mm"])
        behind = moved[SLIPPING + 1 :]
        rows.append(
            [
                f"`{entry}`",
                *(digits(moved[place]) for place in places),
                f"{behind[-1] / behind[0]:.2f}",
                f"{np.max(moved[SLIPPING + 1 :] / moved[SLIPPING:-1]):.2f}",
            ]
        )
    head = ["entry", *(f"robot {place}" for place in places)]
    head += [f"robot {ROBOTS - 1} / robot {SLIPPING + 1}", "largest step"]
    return table(head, rows)


def cause_table(lines: Lines) -> str:
    """What a change does to an entry, and the best entry without learning."""
    rows = []
    for cause in CAUSES:
        for entry in cause.entries:
            best = lines[cause.cell, best_classical(lines, cause.cell)]
            same, other = lines[cause.cell, entry], lines[key_of(cause), entry]
            texts = [error_text(line) for line in (same, other, best)]
            rows.append([cause.cell, f"`{entry}`", cause.name, *texts])
    head = ["cell", "entry", "change", "unchanged", "changed", "best classical"]
    return table(head, rows, left=3)


def tables(lines: Lines) -> dict[str, str]:
    """All tables by their names."""
    return {
        "seen": seen(),
        **{name: cells_table(lines, name) for name in SHOWN_TABLES},
        "summary": summary(lines),
        "failures": failures(lines),
        "losses": losses(lines),
        "causes": cause_table(lines),
        "row": row_table(lines),
        "kick": kick_table(lines),
    }
