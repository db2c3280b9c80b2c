"""``tlf demo``: the paper's loop, the default system and a learned policy on the same draws, in one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.commands.run import Wanted, identity_for, write_run
from baselines.console import progress_bar, screen, warn_of_missing, writable_folder
from baselines.pages.replay import write_comparison
from baselines.policies.registry import fit_policy
from baselines.runs.folders import REPLAY
from baselines.runs.jobs import alone_in
from baselines.runs.run import Record, run_policy
from tlf_env.task.scenario import load_scenario

TASK = "infinity"
HORIZON_S = 60.0
PICTURE = "demo.png"
NEXT = (
    ("tlf run flower", "another task, with a replay and all figures of one run"),
    ("tlf run infinity --disturbance ice --policy residual", "the learned policy on ice"),
    ("tlf list", "every task, disturbance, policy and training"),
    ("tlf show infinity > own.yaml; tlf run own.yaml", "a task of your own"),
    ("tlf train quick", "train a policy in a few minutes (needs the extra train)"),
)


class Entry(NamedTuple):
    """A policy of the demo."""

    policy: str
    title: str  # in the table and above the pictures


ENTRIES = (
    Entry("reference:consistent", "the paper's loop"),
    Entry("reference:linearised", "the default"),
    Entry("residual", "learned"),
)
DISTURBANCES = {"nominal": "no slip", "slip": "slip"}


def demo_command(seed: int, out: Path, *, figures: bool) -> dict[str, list[Record]]:
    """Run every entry under every disturbance, and write and print what came out; the records."""
    writable_folder(out)
    wanted = Wanted(figures=False)
    runs: dict[str, list[Record]] = {}
    total = len(DISTURBANCES) * len(ENTRIES)
    with progress_bar("demo") as update:
        for disturbance in DISTURBANCES:
            runs[disturbance] = []
            for entry in ENTRIES:
                chosen = load_scenario(TASK, disturbance=disturbance, horizon_s=HORIZON_S)
                fitted = fit_policy(entry.policy, chosen)
                record = run_policy(fitted.scenario, fitted.policy, seed, name=entry.policy)
                folder = writable_folder(out / f"{entry.policy.replace(':', '_')}-{disturbance}")
                identity = identity_for(entry.policy, fitted, seed, {})
                with alone_in(folder):
                    write_run(record, folder, identity, wanted)
                runs[disturbance].append(record)
                update(sum(map(len, runs.values())), total)
    replay = write_comparison(runs["slip"], out / REPLAY, [entry.title for entry in ENTRIES])
    screen.print(demo_table(runs, seed))
    if figures:
        draw(runs, seed, out)
    screen.print(f"Replay of the runs with slip, in a browser: {replay}", soft_wrap=True)
    screen.print("Next:")
    for command, words in NEXT:
        screen.print(f"  {command:<55}{words}", soft_wrap=True)
    return runs


def demo_table(runs: dict[str, list[Record]], seed: int) -> Table:
    """The runs: a row for each entry, errors and losses under each disturbance."""
    table = Table(
        title=f"Three robots on the ∞ for {HORIZON_S:g} s, seed {seed}: the same noise and slip for every row",
        caption=f"Error: root mean square of the worst robot's distance to its reference, from "
        f"{0.4 * HORIZON_S:g} s on.",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    table.add_column("controller", no_wrap=True)
    table.add_column("--policy", no_wrap=True)
    for words in DISTURBANCES.values():
        table.add_column(f"{words}:\nerror, mm", justify="right")
        table.add_column("robots\nlost", justify="right")
    for number, entry in enumerate(ENTRIES):
        cells: list[Any] = []
        for records in runs.values():
            robots = records[number].metrics()
            errors = [one.position_rmse_mm for one in robots if one.position_rmse_mm is not None]
            cells += [f"{max(errors):.1f}", str(sum(one.lost or one.touched for one in robots))]
        table.add_row(entry.title, entry.policy, *cells)
    return table


def draw(runs: dict[str, list[Record]], seed: int, out: Path) -> None:
    """The comparison; a note if matplotlib is missing."""
    try:
        from baselines.runs.comparison import draw_comparison
    except ModuleNotFoundError as error:
        warn_of_missing(error)
        return
    draw_comparison(
        list(runs.values()),
        list(DISTURBANCES.values()),
        [entry.title for entry in ENTRIES],
        f"Three controllers, the same noise and slip: three robots on the ∞, {HORIZON_S:g} s, seed {seed}",
        out / PICTURE,
    )
    screen.print(
        f"Picture: {out / PICTURE}; data of each run in the folders beside it.", soft_wrap=True
    )
