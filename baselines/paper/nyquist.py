"""Fig. 7(c): the Nyquist plot of the wheel loop from an experiment, and its modulus margin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from baselines.paper.claims import Above, Below, Claim, Measured, Near
from baselines.paper.look import COLOURS, DASHES, new_figure
from baselines.paper.loop import KAPPA, conditions, kappa_of, plants
from baselines.paper.parts import Part, Progress, Table
from baselines.paper.prbs import (
    LoopEstimate,
    Trial,
    estimate,
    predicted_loop,
    predicted_margin,
    run_trial,
)
from baselines.runs.style import tidy

REPORTED = 0.81
DEAD_TIMES = {  # name: period of K(z) in s, samples of delay
    "1 ms": (0.001, 0),
    "1 ms, one sample": (0.001, 1),
    "1 ms, two samples": (0.001, 2),
    "2 ms": (0.002, 0),
    "2 ms, one sample": (0.002, 1),
}
USUAL = (0.001, 1)  # dead time of the comparisons
CONDITIONS = {
    "inside ±15 N·mm": Trial(),
    "amplitude 0.1 rad/s": Trial(amplitude_rad_s=0.1),
    "amplitude 1 rad/s": Trial(amplitude_rad_s=1.0),
    "no joint friction": Trial(joint_friction=False),
    "about rest": Trial(mean_rad_s=0.0),
    "about rest, 1 rad/s": Trial(mean_rad_s=0.0, amplitude_rad_s=1.0),
    "about rest, no joint friction": Trial(mean_rad_s=0.0, joint_friction=False),
}
KAPPA_FACTORS = np.linspace(0.5, 1.5, 11)
SHOWN_POINTS = 70


class Experiment(NamedTuple):
    """A trial and what came of it."""

    trial: Trial
    found: LoopEstimate
    saturated: float
    predicted: float  # modulus margin of the linear loop


class Nyquist(NamedTuple):
    """The experiments of this part."""

    dead_times: dict[str, Experiment]
    conditions: dict[str, Experiment]
    kappa: float  # of the common mode, rad/s² per N·mm
    design_margin: float  # of the design loop, continuous
    spread: dict[
        str, float
    ]  # smallest margin of the linear loop over κ of eq. (6) ± 50 %, by dead time


def experiment(trial: Trial, kappa: float) -> Experiment:
    """Run a trial and estimate its loop."""
    data = run_trial(trial)
    return Experiment(
        trial,
        estimate(data, trial.period_s),
        data.saturated,
        predicted_margin(trial.period_s, trial.delay, kappa),
    )


def compute(progress: Progress) -> Nyquist:
    """All experiments, each of 60 s."""
    systems = plants()
    kappa = kappa_of(systems["common mode"])
    wanted = {
        name: Trial(period_s=period_s, delay=delay)
        for name, (period_s, delay) in DEAD_TIMES.items()
    }
    others = {
        name: trial._replace(period_s=USUAL[0], delay=USUAL[1])
        for name, trial in CONDITIONS.items()
    }
    total = len(wanted) + len(others)
    made = []
    for done, trial in enumerate([*wanted.values(), *others.values()], start=1):
        made.append(experiment(trial, kappa))
        progress(done, total)
    return Nyquist(
        dict(zip(wanted, made, strict=False)),
        dict(zip(others, made[len(wanted) :], strict=True)),
        kappa,
        conditions(systems["eq. (6)"], "design").margin,
        {name: spread(*dead_time) for name, dead_time in DEAD_TIMES.items()},
    )


def spread(period_s: float, delay: int) -> float:
    """Smallest modulus margin of the linear loop over κ of eq. (6) times 0.5 to 1.5; NaN if one is unstable."""
    margins = [predicted_margin(period_s, delay, float(one) * KAPPA) for one in KAPPA_FACTORS]
    return float(np.min(margins))  # NaN if one is


def draw(data: Nyquist) -> Mapping[str, Figure]:
    """Fig. 7(c): dead times, and conditions of the experiment."""
    figure = new_figure(10.5, 5.2)
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.plot(-1, 0, "+", color="black", ms=10, mew=1.5)
        axes.add_patch(Circle((-1, 0), REPORTED, fc="none", ec="0.35", lw=1.0, ls=(0, (2, 2))))
        axes.plot([], [], color="0.35", lw=1.0, ls=(0, (2, 2)), label=f"{REPORTED} about −1")
        axes.axhline(0, color="0.6", lw=0.5)
        axes.axvline(0, color="0.6", lw=0.5)
    for i, (name, one) in enumerate(data.dead_times.items()):
        found, trial = one.found, one.trial
        omega = np.geomspace(found.omega[0], np.pi / trial.period_s, 400)
        L = predicted_loop(trial.period_s, trial.delay, data.kappa, omega)
        left.plot(L.real, L.imag, color=COLOURS[i], ls=DASHES[i], lw=1.1)
        points(left, found, COLOURS[i], f"{name}: {margin_text(found)}", "os^Dv"[i])
    left.set_title("dead times; lines: linear loop, κ of the common mode", fontsize="medium")
    shown = (
        "inside ±15 N·mm",
        "no joint friction",
        "amplitude 0.1 rad/s",
        "amplitude 1 rad/s",
        "about rest",
    )
    for i, name in enumerate(shown):
        found = data.conditions[name].found
        points(right, found, COLOURS[i], f"{name}: {margin_text(found)}", "os^Dv"[i])
    right.set_title("conditions of the experiment; 1 ms, one sample of delay", fontsize="medium")
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_xlim(-1.08, 0.22)
        axes.set_ylim(-0.9, 0.3)
        axes.set_xlabel(r"Re $L$")
        axes.set_ylabel(r"Im $L$")
        tidy(axes)
        axes.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(0.0, 0.46))
    return {"fig7c": figure}


def points(axes: Axes, found: LoopEstimate, colour: str, label: str, marker: str) -> None:
    """Points of an estimate at some frequencies, with the circles of its confidence region."""
    bins = np.unique(np.round(np.geomspace(1, len(found.L), SHOWN_POINTS)).astype(int)) - 1
    axes.plot(
        found.L.real[bins], found.L.imag[bins], marker, color=colour, ms=2.6, label=label, zorder=3
    )
    circles = [
        Circle((found.L.real[k], found.L.imag[k]), found.radius[k])
        for k in bins
        if found.radius[k] < 0.5
    ]
    axes.add_collection(PatchCollection(circles, fc=colour, ec="none", alpha=0.18, zorder=2))


def margin_text(found: LoopEstimate) -> str:
    """A modulus margin with the radius of its confidence region."""
    return f"{found.margin:.2f} ± {found.margin_radius:.2f}"


def tables(data: Nyquist) -> tuple[Table, ...]:
    """Every experiment."""
    head = (
        "experiment",
        "K(z)",
        "mean, amplitude, rad/s",
        "joint friction",
        "at the torque limit",
        "coherence at the margin",
        "modulus margin, 95 %",
        "linear loop",
    )
    rows = []
    for name, one in {**data.dead_times, **data.conditions}.items():
        trial, found = one.trial, one.found
        k = int(np.argmin(np.abs(1 + found.L)))
        rows.append(
            (
                name,
                f"{1000 * trial.period_s:g} ms, delay {trial.delay}",
                f"{trial.mean_rad_s:g}, {trial.amplitude_rad_s:g}",
                "on" if trial.joint_friction else "off",
                f"{100 * one.saturated:.0f} %",
                f"{found.coherence[k]:.2f}",
                f"{found.margin:.3f} ± {found.margin_radius:.3f}",
                f"{one.predicted:.3f}",
            )
        )
    return (
        Table("Experiments with a pseudo-random binary reference, 60 s each", head, tuple(rows)),
    )


def _nearest(data: Nyquist) -> Measured:
    margins = {name: one.found.margin for name, one in data.dead_times.items()}
    best = min(margins, key=lambda name: abs(margins[name] - REPORTED))
    return Measured(
        margins[best],
        f"with {best}; " + "; ".join(f"{name}: {value:.2f}" for name, value in margins.items()),
    )


def _smallest(data: Nyquist) -> Measured:
    margins = {name: one.found.margin for name, one in data.dead_times.items()}
    worst = min(margins, key=lambda name: margins[name])
    return Measured(margins[worst], f"with {worst}")


def _spread(data: Nyquist) -> Measured:
    worst = min(data.spread, key=lambda name: data.spread[name])
    return Measured(
        data.spread[worst],
        f"with {worst}; "
        + "; ".join(f"{name}: {value:.2f}" for name, value in data.spread.items()),
    )


def _friction(data: Nyquist) -> Measured:
    rolling, without = (
        data.conditions[name].found for name in ("inside ±15 N·mm", "no joint friction")
    )
    rest = data.conditions["about rest"].found
    k = int(np.argmin(np.abs(1 + rest.L)))
    return Measured(
        abs(rolling.margin - without.margin),
        f"about rest the wheels stick: the estimate is {rest.margin:.2f} with a coherence of "
        f"{rest.coherence[k]:.2f}",
    )


CLAIMS = (
    Claim(
        "modulus-margin",
        "The modulus margin of the loop on the virtual plant is about 0.81",
        "section III-A, Fig. 7(c)",
        "0.81",
        "measured margin nearest to it, of five dead times (period and delay are not published)",
        "",
        _nearest,
        Near(REPORTED, 0.03, 0.1),
        "fig7c",
    ),
    Claim(
        "design-loop-margin",
        "The measured margin is that of the designed loop",
        "section III-A, Fig. 7(c)",
        "0.81",
        "inf |1 + L| of the design loop",
        "",
        lambda data: data.design_margin,
        Near(REPORTED, 0.03, 0.1),
        "fig7b",
    ),
    Claim(
        "margin-robust",
        "The margin is larger than 0.5, which is robust",
        "section III-A, Fig. 7(c)",
        "> 0.5",
        "smallest measured margin of the five dead times",
        "",
        _smallest,
        Above(0.5),
        "fig7c",
    ),
    Claim(
        "margin-kappa",
        "Robust stability is guaranteed with an error of 50 % of κ",
        "section III-A, eq. (12)",
        "50 %",
        "smallest modulus margin of the linear digital loop for κ of eq. (6) ± 50 %",
        "",
        _spread,
        Above(0.5, 0),
    ),
    Claim(
        "friction-in-experiment",
        "Joint friction is a disturbance at the input and no part of L",
        "eqs (6) and (7)",
        "no effect",
        "change of the measured margin without joint friction, while the wheels roll",
        "",
        _friction,
        Below(0.015, 0.05),
        "fig7c",
    ),
)

PART = Part(
    name="fig7c",
    title="Fig. 7(c): the experiment on the wheel loop",
    text=(
        "Both wheels of a robot that goes straight on at 300 mm/s receive a reference with a "
        "pseudo-random binary sequence of one sample per bit; the digital K(z) of the project acts on the "
        "plant of the project, with its friction. L is the ratio of the cross spectra of output and "
        "reference and of error and reference, by averages of segments (Welch). The circles hold the "
        "value of L with 95 %.",
        "Not published, and chosen here: the period of K(z) and its delay, the amplitude and the mean of "
        "the reference, and the noise of the speed (1 mrad/s). Period and delay decide the margin. With "
        "an amplitude of 0.02 rad/s the torque stays inside ±15 N·mm. With 0.1 rad/s and more it is at "
        "its limit for half of the time, and the estimate is of a saturated loop: a smaller L and a "
        "margin that looks larger. About rest the wheels stick, and the data say nothing about L.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "fig7c": "Fig. 7(c): Nyquist plots from the experiments, with the 95 % regions of some points. "
        "Left: dead times. Right: amplitude and friction. Dashed circle: the reported margin."
    },
    tables=tables,
    claims=CLAIMS,
)
