"""Eqs (43) to (51): how fast the observer of a follower converges, and the peak that ℘ removes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from baselines.paper.claims import Below, Claim, Measured, shown
from baselines.paper.look import COLOURS, DASHES, new_figure
from baselines.paper.parts import Part, Progress, Table
from baselines.runs.style import tidy
from tlf_env.onboard.observer import (
    Message,
    ObserverParameters,
    observed_reference,
    observer_rates,
    smoothing,
)

STEP_S, SHOWN_S = 0.001, 8.0
GAINS_PER_S = (1.0, 3.0, 10.0)
PAPERS = ObserverParameters()
BEHIND_MM = 300.0  # spacing of the starts
TWIST = (300.0, 0.4)  # of the predecessor on a circle, mm/s and rad/s
START = (200.0, -200.0, 1.0)  # error of the observer at first, mm and rad
LEFT_S = 3.0


class Follower(NamedTuple):
    """Signals of this part, over ``t_s``."""

    t_s: np.ndarray
    errors_mm: dict[float, np.ndarray]  # distance of observer and predecessor, by gain in 1/s
    left: dict[float, float]  # distance after 3 s over that at the start, by gain
    speeds: dict[str, np.ndarray]  # u₁* of a follower at rest, mm/s, with ℘ and without


def compute(progress: Progress) -> Follower:
    """Observers on exact messages, by explicit steps of 1 ms."""
    t_s = np.arange(round(SHOWN_S / STEP_S) + 1) * STEP_S
    errors, left = {}, {}
    for done, gain in enumerate(GAINS_PER_S, start=1):
        errors[gain] = distance(t_s, gain)
        left[gain] = float(errors[gain][round(LEFT_S / STEP_S)] / errors[gain][0])
        progress(done, len(GAINS_PER_S) + 1)
    speeds = {
        "with ℘": reference_speed(t_s, PAPERS.smoothing_s),
        "without": reference_speed(t_s, 0),
    }
    return Follower(t_s, errors, left, speeds)


def distance(t_s: np.ndarray, gain: float) -> np.ndarray:
    """Distance (mm) of the observer's pose from a predecessor on a circle, with ℘ = 1."""
    u_1, u_2 = TWIST
    x, y, theta = (-one for one in START)
    found = np.empty(len(t_s))
    for k, t in enumerate(t_s):
        # On a circle about the origin of the radius u₁/u₂.
        turn = u_2 * t
        there = Message(u_1 / u_2 * math.cos(turn), u_1 / u_2 * math.sin(turn), turn, u_1, u_2)
        if k == 0:
            x, y = there.x + x, there.y + y
        found[k] = math.hypot(there.x - x, there.y - y)
        rate_x, rate_y, rate = observer_rates(x, y, theta, there, gain, 1.0)
        x, y, theta = x + STEP_S * rate_x, y + STEP_S * rate_y, theta + STEP_S * rate
    return found


def reference_speed(t_s: np.ndarray, smoothing_s: float) -> np.ndarray:
    """u₁* (mm/s) of a follower that starts behind a predecessor at rest, by eq. (50)."""
    there = Message(0.0, BEHIND_MM, 0.0, 0.0, 0.0)
    x = y = theta = 0.0
    found = np.empty(len(t_s))
    for k, t in enumerate(t_s):
        factor = smoothing(float(t), smoothing_s)
        rates = observer_rates(x, y, theta, there, PAPERS.gain_per_s, factor)
        found[k] = observed_reference(x, y, theta, *rates).u_1
        x, y, theta = (one + STEP_S * rate for one, rate in zip((x, y, theta), rates, strict=True))
    return found


def draw(data: Follower) -> Mapping[str, Figure]:
    """Decay of the error, and u₁* at the start."""
    figure = new_figure(10.0, 3.6)
    left, right = figure.subplots(1, 2)
    for i, (gain, error) in enumerate(data.errors_mm.items()):
        left.semilogy(
            data.t_s,
            np.maximum(error, 1e-6),
            color=COLOURS[i],
            ls=DASHES[i],
            label=f"b = {gain:g} 1/s",
        )
    left.set_ylim(1e-3, 1e3)
    left.set_ylabel("error of the observer (mm)")
    for i, (name, speed) in enumerate(data.speeds.items()):
        right.plot(
            data.t_s, speed, color=COLOURS[i], ls=DASHES[i], label=f"{name}: {speed.max():.0f} mm/s"
        )
    right.set_ylabel("$u_1^*$ of the follower (mm/s)")
    for axes in (left, right):
        axes.set_xlabel("time (s)")
        axes.legend(frameon=False, fontsize=9)
        tidy(axes)
    return {"observer": figure}


def tables(_: Follower) -> tuple[Table, ...]:
    """No table."""
    return ()


def _decay(data: Follower) -> Measured:
    return Measured(
        data.left[PAPERS.gain_per_s],
        "; ".join(
            f"b = {gain:g} 1/s: {shown(value, digits=2)}" for gain, value in data.left.items()
        ),
    )


def _peak(data: Follower) -> Measured:
    with_it, without = (data.speeds[name].max() for name in ("with ℘", "without"))
    return Measured(with_it / without, f"{with_it:.0f} mm/s and {without:.0f} mm/s")


CLAIMS = (
    Claim(
        "observer-decay",
        "Errors of the observer converge, the faster the larger b is",
        "proposition 4, eqs (45) to (49)",
        "converge",
        "error after 3 s over that at the start, predecessor on a circle, b = 3 1/s",
        "",
        _decay,
        Below(0.01, 0.1),
        "observer",
    ),
    Claim(
        "observer-peak",
        "℘ overcomes the peak of the reference at the start",
        "eq. (51)",
        "smoothed",
        "largest u₁* with ℘ over that without, follower at rest 300 mm behind",
        "",
        _peak,
        Below(0.5, 0.9),
        "observer",
    ),
)

PART = Part(
    name="observer",
    title="Eqs (43) to (51): the observer of a follower",
    text=(
        "The observer on exact messages, by explicit steps of 1 ms, which leave 0.01 mm. Left: the "
        "predecessor drives a circle at 300 mm/s and 0.4 rad/s, and the observer starts with an error of "
        "200 mm in x and y and 1 rad, with ℘ = 1. Right: before the first gap is over, the predecessor's "
        "message is its start pose at rest, 300 mm ahead; b = 3 1/s.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "observer": "Left: decay of the observer's error. Right: the reference's speed at the start."
    },
    tables=tables,
    claims=CLAIMS,
)
