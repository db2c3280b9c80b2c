"""Fig. 11: both simulations, their paths, and the functionals of eq. (54)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from baselines.paper.claims import Above, Below, Claim, Measured, shown
from baselines.paper.formations import (
    GAINS,
    PERIODS_S,
    PLANTS,
    SOON_S,
    TASKS,
    Key,
    Outcome,
    every_key,
    run,
)
from baselines.paper.look import DASHES, new_figure
from baselines.paper.parts import Part, Progress, Table
from baselines.runs.style import hex_colour, tidy

OUTLINES_MM = 220.0  # two robots touch at this distance: twice the outline's radius
LETTERS = {"infinity": ("a", "b", "c"), "flower": ("d", "e", "f")}
SYMBOLS = {"J": ("J_mm_s", "$J$ (mm·s)"), "theta": ("J_theta_rad_s", r"$J_\theta$ (rad·s)")}


class Tracks(NamedTuple):
    """All runs."""

    runs: dict[Key, Outcome]

    def at(self, task: str, plant: str, gains: str, period_s: float = PERIODS_S[0]) -> Outcome:
        """The run of a name."""
        return self.runs[Key(task, plant, gains, period_s)]


def compute(progress: Progress) -> Tracks:
    """Drive every run."""
    wanted, runs = every_key(), {}
    for number, key in enumerate(wanted):
        runs[key] = run(key, partial(_of_run, progress, key, number, len(wanted)))
    return Tracks(runs)


def _of_run(progress: Progress, key: Key, number: int, runs: int, done: int, total: int) -> None:
    """The progress of one of some runs, in hundredths of a run."""
    name = f"{TASKS[key.task]}, {key.plant}, {key.gains}, {1000 * key.period_s:g} ms"
    progress(round(100 * (number + done / total)), 100 * runs, name)


def draw(data: Tracks) -> Mapping[str, Figure]:
    """Fig. 11(a) to (f), at a control period of 1 ms."""
    figures = {}
    for task, (path, J, J_theta) in LETTERS.items():
        figures[f"fig11{path}"] = planes(data, task)
        figures[f"fig11{J}"] = functionals(data, task, "J")
        figures[f"fig11{J_theta}"] = functionals(data, task, "theta")
    return figures


def planes(data: Tracks, task: str) -> Figure:
    """The paths in the plane: columns are plants, rows are gains."""
    figure = new_figure(11.0, 7.2)
    for row, gains in zip(figure.subplots(2, 3, sharex=True, sharey=True), GAINS, strict=True):
        for axes, plant in zip(row, PLANTS, strict=True):
            one = data.at(task, plant, gains)
            axes.plot(*one.leader_mm.T, color="0.75", lw=2.5, zorder=0)
            for robot in range(one.x_mm.shape[1]):
                colour = hex_colour(robot, one.x_mm.shape[1])
                axes.plot(
                    one.x_mm[:, robot],
                    one.y_mm[:, robot],
                    color=colour,
                    ls=DASHES[robot],
                    lw=0.9,
                )
                axes.plot(
                    one.x_mm[0, robot], one.y_mm[0, robot], "o", mfc="white", color=colour, ms=4
                )
                axes.plot(one.x_mm[-1, robot], one.y_mm[-1, robot], "o", color=colour, ms=4)
            axes.set_aspect("equal")
            axes.set_title(f"{plant}, {gains}: {result(one)}", fontsize=9)
            tidy(axes)
    x, y = data.at(task, "complete", "consistent").leader_mm.T
    for axes in figure.axes:
        axes.set_xlim(x.min() - 800, x.max() + 800)
        axes.set_ylim(y.min() - 800, y.max() + 800)
    label(figure, "x (mm)", "y (mm)", one.x_mm.shape[1], path=True)
    return figure


def functionals(data: Tracks, task: str, which: str) -> Figure:
    """A functional of eq. (54) over time: columns are plants, rows are gains."""
    field, text = SYMBOLS[which]
    figure = new_figure(11.0, 5.4)
    for row, gains in zip(figure.subplots(2, 3, sharex=True), GAINS, strict=True):
        for axes, plant in zip(row, PLANTS, strict=True):
            one = data.at(task, plant, gains)
            values = getattr(one, field)
            for robot in range(values.shape[1]):
                axes.plot(
                    one.t_s,
                    values[:, robot],
                    color=hex_colour(robot, values.shape[1]),
                    ls=DASHES[robot],
                    lw=1.0,
                )
            axes.axvline(SOON_S, color="0.45", lw=0.8, ls=":")
            axes.set_title(f"{plant}, {gains}" + (": lost" if one.lost.any() else ""), fontsize=9)
            tidy(axes)
    label(figure, "time (s)", text, one.x_mm.shape[1])
    return figure


def label(figure: Figure, x: str, y: str, robots: int, path: bool = False) -> None:
    """Name the outer axes, and the robots below the panels."""
    panels = list(figure.axes)
    for axes in panels[3:]:
        axes.set_xlabel(x)
    for axes in panels[::3]:
        axes.set_ylabel(y)
    last = panels[-1]
    handles = [
        last.plot([], [], color=hex_colour(i, robots), ls=DASHES[i], label=f"robot {i + 1}")[0]
        for i in range(robots)
    ]
    if path:
        handles += last.plot([], [], color="0.75", lw=2.5, label="path of the leader's reference")
        handles += last.plot([], [], "o", mfc="white", color="0.3", ms=4, label="start")
    else:
        handles += last.plot([], [], color="0.45", lw=0.8, ls=":", label=f"{SOON_S:g} s")
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9
    )


def result(one: Outcome) -> str:
    """RMS error of the worst robot, or how many are lost."""
    lost = int(one.lost.sum())
    return f"{lost} of {len(one.lost)} lost" if lost else f"RMS {one.worst_mm:.2g} mm"


def tables(data: Tracks) -> tuple[Table, ...]:
    """Errors and functionals of every run."""
    rows, others = [], []
    for key, one in data.runs.items():
        name = (TASKS[key.task], key.plant, key.gains, f"{1000 * key.period_s:g} ms")
        rows.append(
            (
                ", ".join(name),
                cells(one.rms_mm, one.lost),
                cells(one.gap_rms_s[1:], one.lost[1:]),
                cells(one.heading_rms_rad, one.lost),
                "–" if one.lost.any() else f"{one.distance_mm[0]:.0f} to {one.distance_mm[1]:.0f}",
            )
        )
        others.append(
            (
                ", ".join(name),
                cells(one.J_mm_s[-1], one.lost),
                cells(one.absolute_J_mm_s[-1], one.lost),
                cells(one.J_theta_rad_s[-1], one.lost),
                cells(one.absolute_J_theta_rad_s[-1], one.lost),
            )
        )
    return (
        Table(
            "Errors of each robot after 40 % of the run, RMS; a lost robot was beyond 1200 mm, or above "
            "100 mm RMS in the last 30 %",
            (
                "simulation, plant, gains, control period",
                "position, mm",
                "time gap, s",
                "estimated heading, rad",
                "distance of neighbours, mm",
            ),
            tuple(rows),
        ),
        Table(
            "Functionals of eq. (54) of each robot at the end: as printed, and with the magnitudes of the "
            "errors",
            (
                "simulation, plant, gains, control period",
                "J, mm·s",
                "∫(|Δx| + |Δy|) dt, mm·s",
                "J_θ, rad·s",
                "∫|Δθ| dt, rad·s",
            ),
            tuple(others),
        ),
    )


def cells(values: np.ndarray, lost: np.ndarray | None = None) -> str:
    """Numbers of the robots with two significant digits; those of a lost robot say nothing."""
    gone = np.zeros(len(values), dtype=bool) if lost is None else lost
    return " / ".join(
        "lost" if is_lost else _two(float(value))
        for value, is_lost in zip(values, gone, strict=True)
    )


def _two(value: float) -> str:
    if value == 0:
        return "0"
    places = max(0, 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}"


def _worst(task: str, plant: str, gains: str) -> Any:
    def measure(data: Tracks) -> Measured:
        one = data.at(task, plant, gains)
        return Measured(one.worst_mm, cells(one.rms_mm, one.lost))

    return measure


def _gap(task: str) -> Any:
    def measure(data: Tracks) -> float:
        one = data.at(task, "complete", "consistent")
        return math.inf if one.lost.any() else float(one.gap_rms_s.max())

    return measure


def _distances(data: Tracks) -> Measured:
    small, large = data.at("infinity", "complete", "consistent").distance_mm
    return Measured(large / small, f"{small:.0f} to {large:.0f} mm")


def _after_20_s(task: str, gains: str) -> Any:
    def measure(data: Tracks) -> Measured:
        one = data.at(task, "complete", gains)
        ratios = one.late_rms_mm / one.early_rms_mm
        return Measured(
            math.inf if one.lost.any() else float(ratios.max()),
            "each robot: " + cells(ratios),
        )

    return measure


def _constant(gains: str) -> Any:
    """Mean rate at which J changes after 20 s, of the robot with the largest, on the kinematic plant."""

    def measure(data: Tracks) -> Measured:
        rates = {
            task: float(one.J_range_mm_s.max() / (one.t_s[-1] - SOON_S))
            for task in TASKS
            for one in [data.at(task, "kinematic", gains)]
        }
        return Measured(
            max(rates.values()),
            ", ".join(f"{TASKS[task]} {value:.2g} mm" for task, value in rates.items()),
        )

    return measure


def _oscillates(data: Tracks) -> Measured:
    ratios = {
        task: float(
            np.min(
                data.at(task, "complete", "consistent").J_range_mm_s
                / data.at(task, "kinematic", "consistent").J_range_mm_s
            )
        )
        for task in TASKS
    }
    return Measured(
        min(ratios.values()),
        ", ".join(f"{TASKS[task]} {value:.1f}" for task, value in ratios.items()),
    )


def _cancels(data: Tracks) -> Measured:
    shares = {
        task: float(np.max(np.abs(one.J_mm_s[-1]) / one.absolute_J_mm_s[-1]))
        for task in TASKS
        for one in [data.at(task, "complete", "consistent")]
    }
    return Measured(
        100 * min(shares.values()),
        ", ".join(f"{TASKS[task]} {100 * value:.0f} %" for task, value in shares.items()),
    )


def _heading(gains: str) -> Any:
    def measure(data: Tracks) -> Measured:
        worst = {}
        for task, name in TASKS.items():
            one = data.at(task, "complete", gains)
            worst[name] = math.inf if one.lost.any() else float(one.heading_rms_rad.max())
        return Measured(
            max(worst.values()),
            ", ".join(f"{name} {shown(value, 'rad', 2)}" for name, value in worst.items()),
        )

    return measure


def _early_distance(data: Tracks) -> float:
    return min(data.at(task, "complete", "consistent").early_distance_mm for task in TASKS)


def _adequate(task: str, plant: str, gains: str, statement: str) -> Claim:
    letter = LETTERS[task][0]
    return Claim(
        f"tracking-{task}-{plant.replace(' ', '-')}-{gains}",
        statement,
        f"section V, Fig. 11({letter})",
        "adequate tracking",
        "RMS position error of the worst robot after 40 % of the run",
        "mm",
        _worst(task, plant, gains),
        Below(20, 100),
        f"fig11{letter}",
    )


CLAIMS = (
    _adequate("infinity", "complete", "printed", "Three robots track ∞, with the printed gains"),
    _adequate("infinity", "complete", "consistent", "Three robots track ∞, with k₂/k₃ = 0.83 1/s"),
    _adequate(
        "infinity",
        "bending off",
        "printed",
        "Three robots track ∞, with the printed gains and no bending friction of the castor",
    ),
    _adequate(
        "flower", "complete", "printed", "Five robots track the flower, with the printed gains"
    ),
    _adequate(
        "flower", "complete", "consistent", "Five robots track the flower, with k₂/k₃ = 0.83 1/s"
    ),
    Claim(
        "gap-infinity",
        "The time gap of 5 s is regulated on ∞",
        "section V",
        "5 s",
        "RMS error of the time gap after 40 % of the run, k₂/k₃ = 0.83 1/s",
        "s",
        _gap("infinity"),
        Below(0.1, 0.5),
        "fig11a",
    ),
    Claim(
        "gap-flower",
        "The time gap of 5 s is regulated on the flower",
        "section V",
        "5 s",
        "RMS error of the time gap after 40 % of the run, k₂/k₃ = 0.83 1/s",
        "s",
        _gap("flower"),
        Below(0.1, 0.5),
        "fig11d",
    ),
    Claim(
        "distances",
        "Robots get closer and farther away to keep the gap",
        "section V",
        "distance varies",
        "largest over smallest distance of neighbours on ∞",
        "",
        _distances,
        Above(1.5),
        "fig11a",
    ),
    Claim(
        "errors-after-20-s-infinity",
        "Errors on ∞ are smallest after 20 s",
        "section V",
        "20 s",
        "RMS error after 20 s over that before, worst robot, k₂/k₃ = 0.83 1/s",
        "",
        _after_20_s("infinity", "consistent"),
        Below(0.5, 1),
        "fig11b",
    ),
    Claim(
        "errors-after-20-s-flower",
        "Errors on the flower are smallest after 20 s",
        "section V",
        "20 s",
        "RMS error after 20 s over that before, worst robot, k₂/k₃ = 0.83 1/s",
        "",
        _after_20_s("flower", "consistent"),
        Below(0.5, 1),
        "fig11e",
    ),
    Claim(
        "ideal-J-printed",
        "In ideal conditions the functionals become constant, with the printed gains",
        "section V",
        "constant",
        "range of J after 20 s over the time, worst robot, kinematic plant with noise of the fixes (0.45 mm)",
        "mm",
        _constant("printed"),
        Below(0.1, 1),
        "fig11b",
    ),
    Claim(
        "ideal-J-consistent",
        "In ideal conditions the functionals become constant, with k₂/k₃ = 0.83 1/s",
        "section V",
        "constant",
        "range of J after 20 s over the time, worst robot, kinematic plant with noise of the fixes (0.45 mm)",
        "mm",
        _constant("consistent"),
        Below(0.1, 1),
        "fig11b",
    ),
    Claim(
        "J-varies",
        "Friction and slip make the functionals vary and oscillate after 20 s",
        "section V, Fig. 11(b, c, e, f)",
        "time-variant",
        "range of J after 20 s: complete plant over kinematic plant, smallest of the robots, k₂/k₃ = 0.83 1/s",
        "",
        _oscillates,
        Above(2, 1),
        "fig11e",
    ),
    Claim(
        "J-measures",
        "J shows how good the tracking is",
        "eq. (54)",
        "a measure of the error",
        "|J| at the end over the integral of the magnitudes, k₂/k₃ = 0.83 1/s: errors of both signs cancel",
        "%",
        _cancels,
        Above(90, 50),
        "fig11b",
    ),
    Claim(
        "heading-estimate-printed",
        "The EKF estimates θ adequately, with the printed gains",
        "section VI",
        "adequate",
        "RMS error of the estimated heading after 40 % of the run, worst robot",
        "rad",
        _heading("printed"),
        Below(0.05, 0.2),
    ),
    Claim(
        "heading-estimate-consistent",
        "The EKF estimates θ adequately, with k₂/k₃ = 0.83 1/s",
        "section VI",
        "adequate",
        "RMS error of the estimated heading after 40 % of the run, worst robot",
        "rad",
        _heading("consistent"),
        Below(0.05, 0.2),
    ),
    Claim(
        "early-collisions",
        "Robots may collide in the first seconds",
        "section VI",
        "a supervisor would prevent it",
        "smallest distance of two robots in the first 20 s, from starts 300 mm apart; outlines touch at 220 mm",
        "mm",
        _early_distance,
        Below(OUTLINES_MM),
    ),
)

PART = Part(
    name="fig11",
    title="Fig. 11: both simulations",
    text=(
        "∞ with three robots for 100 s, and the flower with five for 150 s, gap 5 s, seed 0, with the "
        "paper's EKF at 1 ms and noise of 0.2 mm² of the position fixes. Robot 1 leads, as in the paper. "
        "Plants: kinematic (no masses, no friction, no slip); dynamic without the bending moment of the "
        "castor's steering joint; complete. Robots do not collide with each other in these runs.",
        "Not published, and chosen here: the control period (the figures have 1 ms, the shortest; the "
        "tables have 20 ms, too), the start poses (300 mm apart behind the leader on the tangent, at "
        "rest), the castor's trail, radius and place, the yaw inertia and the centre of mass. “Adequate” "
        "is taken as 20 mm RMS. With the printed gains the castor and the yaw inertia decide whether ∞ is "
        "tracked: see what the paper does not print.",
        "J adds errors of both signs, so that they cancel; the second table has the integrals of the "
        "magnitudes.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "fig11a": "Fig. 11(a): ∞. Upper row: printed gains. Lower row: k₂/k₃ = 0.83 1/s. Columns: plants.",
        "fig11b": "Fig. 11(b): J on ∞. Panels have their own scales.",
        "fig11c": "Fig. 11(c): J_θ on ∞.",
        "fig11d": "Fig. 11(d): the flower.",
        "fig11e": "Fig. 11(e): J on the flower.",
        "fig11f": "Fig. 11(f): J_θ on the flower.",
    },
    tables=tables,
    claims=CLAIMS,
    drives=True,
)
