"""Tables and figures of ``docs/envelopes.md``: envelopes, error against slip frequency and friction, long rows.

``python docs/figures/make_envelopes.py`` needs the extras ``bench`` and ``figures``. It can be interrupted and
called again to continue; what is finished lies in ``--out``. ``--seeds N`` drives other numbers of seeds of
each level, ``--policies`` other systems.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from make_board import DOCS
from make_parts import put
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from baselines.benchmark.bench import run_bench
from baselines.benchmark.envelope import EnvelopePlan, knob_presets
from baselines.benchmark.envelope_board import envelope_board, envelope_tables, explanation
from baselines.benchmark.envelope_figure import draw_envelopes
from baselines.benchmark.envelope_runs import run_envelope
from baselines.benchmark.lines import Line, failures, worst
from baselines.benchmark.plan import Plan, parse_sweep
from baselines.console import progress_bar
from baselines.runs.outcome import failed
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import DPI, MARKERS, hex_colour, tidy
from tlf_env.common.files import atomic

POLICIES = (
    "reference:consistent",
    "reference:tuned",
    "reference:linearised",  # the default
    "adrc:searched+ekf-gyro-smoothed+grip",
)
CURVE_POLICIES = (
    *POLICIES[:3],
    "kanayama:searched+ekf-gyro-smoothed+grip",
    *POLICIES[3:],
)
ROW_SEEDS = 4
FOLDER = DOCS / "envelopes"
HORIZON_S, ROW_HORIZON_S = 60.0, 240.0
SMOOTH = (("start_ramp_s", 6.0),)
FREQUENCIES = "frequency_hz=0.05:2:7:log"
SLIPS = (  # file, path of the frequency, amplitude, title, unit of the gain
    ("sine-forward", "slip.delta_1_mm_s", 20.0, "forward slip δ₁, 20 mm/s", "mm per mm/s"),
    ("sine-yaw", "slip.delta_2_rad_s", 0.1, "yaw slip δ₂, 0.1 rad/s", "mm per rad/s"),
)
TICKS_HZ = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
FRICTIONS = "tyre.friction_scale=1,0.7,0.5,0.45,0.4,0.35,0.3"
ROWS = "robots=3,5,10,20"
ROW_DISTURBANCES = ("nominal", "slip")
LOST_SHARE = 0.05  # of runs; a cell with more has a hollow mark
WORST = "position RMS of the worst robot (mm)"


class Curves:
    """Runs the sweeps of this page, each into a folder of its own, and draws with one style for each system."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.policies: tuple[str, ...] = options.policies or CURVE_POLICIES
        self.seeds: int = options.curve_seeds
        self._out, self._processes = options.out, options.processes

    def lines(
        self,
        name: str,
        sweep: str,
        disturbances: Sequence[str],
        *,
        task: str = "infinity",
        overrides: tuple[tuple[str, Any], ...] = (),
        seeds: int | None = None,
    ) -> list[Line]:
        """The finished runs of a sweep."""
        path, values = parse_sweep(sweep)
        plan = Plan(
            self.policies,
            (task,),
            tuple(disturbances),
            (FIRST_TABLE_SEED, FIRST_TABLE_SEED + (seeds or self.seeds)),
            sweep=path,
            sweep_values=values,
            overrides=(("horizon_s", HORIZON_S), ("plant", "batch"), *overrides),
        )
        with progress_bar(name) as update:
            results = run_bench(plan, self._out / name, processes=self._processes, progress=update)
        return results.ordered()

    def plot(
        self,
        axes: Axes,
        lines: Sequence[Line],
        value: Callable[[Sequence[Line]], float],
        *,
        hollow: bool = True,
    ) -> None:
        """A curve for each system over the swept values; hollow where more than 5 % of the runs failed."""
        for policy in self.policies:
            groups: dict[float, list[Line]] = {}
            for line in lines:
                if line["policy"] == policy:
                    groups.setdefault(line["sweep"], []).append(line)
            lost = [
                hollow and failures(group) > LOST_SHARE * len(group) for group in groups.values()
            ]
            self.curve(
                axes, policy, list(groups), [value(group) for group in groups.values()], lost
            )

    def curve(
        self,
        axes: Axes,
        policy: str,
        x: Sequence[float],
        y: Sequence[float],
        hollow: Sequence[bool],
    ) -> None:
        """A line with a mark at each point, hollow where it says so; later systems are thinner, on top."""
        number = self.policies.index(policy)
        colour = hex_colour(number, len(self.policies))
        marker = MARKERS[number % len(MARKERS)]
        under = 1 - number / len(self.policies)
        lw, ms = 1.0 + 2.0 * under, 4.0 + 3.0 * under
        axes.plot(x, y, color=colour, lw=lw, label=policy, marker=marker, ms=ms, mfc=colour)
        empty = np.array(hollow)
        axes.plot(
            np.array(x)[empty],
            np.array(y)[empty],
            ls="",
            marker=marker,
            ms=5,
            mec=colour,
            mfc="white",
        )


def middle(lines: Sequence[Line]) -> float:
    """Median of the worst robot's position RMS, mm."""
    return float(np.median([worst(line, "position_rmse_mm") or 0.0 for line in lines]))


def held(lines: Sequence[Line]) -> float:
    """Runs that hold, percent."""
    return 100 * (1 - failures(lines) / len(lines))


def save(figure: Figure, name: str, panels: Sequence[Axes]) -> None:
    """Tidy, add a legend below, and write the figure into ``docs/envelopes``."""
    tidy(*panels)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize="small"
    )
    write(figure, name)


def write(figure: Figure, name: str) -> None:
    """Write a figure into ``docs/envelopes``, atomically."""
    with atomic(FOLDER / f"{name}.png", "wb") as file:
        figure.savefig(file, format="png", dpi=DPI)


def two_panels() -> tuple[Figure, list[Axes]]:
    """A figure with two panels side by side."""
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    return figure, list(figure.subplots(1, 2))


def slip_figure(curves: Curves) -> None:
    """Gain from slip to error against the frequency of the slip."""
    figure, panels = two_panels()
    for axes, (name, path, amplitude, title, unit) in zip(panels, SLIPS, strict=True):
        file = FOLDER / f"{name}.yaml"
        lines = curves.lines(name, f"{path}.{FREQUENCIES}", (str(file),), overrides=SMOOTH)
        curves.plot(axes, lines, lambda group, by=amplitude: middle(group) / by)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(TICKS_HZ, [f"{tick:g}" for tick in TICKS_HZ])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_title(title, loc="left", fontsize="medium")
        axes.set_xlabel("frequency of the slip (Hz)")
        axes.set_ylabel(f"position RMS over amplitude ({unit})")
    save(figure, "slip", panels)


def friction_figure(curves: Curves) -> None:
    """Error and survival against the friction of the floor."""
    lines = curves.lines("friction", FRICTIONS, ("nominal",), overrides=SMOOTH)
    figure, panels = two_panels()
    curves.plot(panels[0], lines, middle)
    panels[0].set_yscale("log")
    panels[0].set_ylabel(WORST)
    curves.plot(panels[1], lines, held, hollow=False)
    panels[1].set_ylabel("runs that hold (%)")
    for axes in panels:
        axes.set_xlabel("factor on the friction of the tyres")
        axes.invert_xaxis()
    save(figure, "friction", panels)


def rows_figure(curves: Curves) -> None:
    """The worst error against the number of robots, and the errors along the longest row."""
    lines = curves.lines(
        "rows",
        ROWS,
        ROW_DISTURBANCES,
        task="long_circle",
        overrides=(("horizon_s", ROW_HORIZON_S),),
        seeds=ROW_SEEDS,
    )
    figure = Figure(figsize=(9.6, 7.4), layout="constrained")
    grid = figure.subplots(len(ROW_DISTURBANCES), 2, sharex="col")
    longest = max(line["sweep"] for line in lines)
    for (left, right), disturbance in zip(grid, ROW_DISTURBANCES, strict=True):
        mine = [line for line in lines if line["disturbance"] == disturbance]
        curves.plot(left, mine, middle)
        for policy in curves.policies:
            runs = [x for x in mine if x["policy"] == policy and x["sweep"] == longest]
            errors = np.median(
                [[robot["position_rmse_mm"] for robot in run["robots"]] for run in runs], axis=0
            )
            many = sum(failed(run["robots"]) for run in runs) > LOST_SHARE * len(runs)
            curves.curve(right, policy, range(len(errors)), errors, [many] * len(errors))
        left.set_title(f"long circle, {disturbance}", loc="left", fontsize="medium")
        right.set_title(f"{longest:g} robots, {disturbance}", loc="left", fontsize="medium")
        left.set_ylabel(WORST)
        right.set_ylabel("position RMS (mm)")
        for axes in (left, right):
            axes.set_yscale("log")
    counts = sorted({line["sweep"] for line in lines})
    grid[-1][0].set_xticks(counts, [f"{count:g}" for count in counts])
    grid[-1][1].xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1][0].set_xlabel("robots in the row")
    grid[-1][1].set_xlabel("place in the row, from the leader")
    save(figure, "rows", list(grid.flat))


def envelopes(options: argparse.Namespace) -> None:
    """The tables and the figure of the envelopes."""
    plan = EnvelopePlan(
        options.policies or POLICIES,
        ("infinity",),
        options.knobs,
        (FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds),
        horizon_s=HORIZON_S,
    )
    with progress_bar("envelope") as update:
        results = run_envelope(
            plan, options.out / "envelope", processes=options.processes, progress=update
        )
    board = envelope_board(results)
    score, *levels = "\n".join(envelope_tables(board)).split("\n\n", 1)
    hours = board["processor_hours"]
    missing = [f"`{name}`" for name in knob_presets() if name not in options.knobs]
    put(DOCS / "envelopes.md", score, "score")
    put(DOCS / "envelopes.md", f"{explanation(board)}\n\n{levels[0]}", "levels")
    put(
        DOCS / "envelopes.md",
        f"The {board['levels']} levels of the table, with up to {options.seeds} runs of {HORIZON_S:g} s each, "
        f"took {hours:.2f} hours of one processor core."
        + (f" Knobs not in the table and the score: {', '.join(missing)}." if missing else ""),
        "time",
    )
    write(draw_envelopes(board), "envelope")


PARTS: dict[str, Callable[[Curves], None]] = {
    "slip": slip_figure,
    "friction": friction_figure,
    "rows": rows_figure,
}


def names(text: str) -> tuple[str, ...]:
    """Comma-separated names."""
    return tuple(text.split(","))


def main() -> None:
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100, help="of each level of the envelopes")
    parser.add_argument("--curve-seeds", type=int, default=20, help="of the curves, but for rows")
    parser.add_argument("--policies", type=names, help="in place of those of each part")
    parser.add_argument(
        "--knobs", type=names, default=tuple(knob_presets()), help="comma-separated"
    )
    parser.add_argument("--parts", default=",".join(("envelope", *PARTS)), help="comma-separated")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/envelopes"))
    options = parser.parse_args()
    curves = Curves(options)
    for name in options.parts.split(","):
        if name == "envelope":
            envelopes(options)
        else:
            PARTS[name](curves)


if __name__ == "__main__":
    main()
