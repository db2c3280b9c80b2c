"""Eqs (28) to (41): errors of the filter, whether it expects them, and what slip does to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from baselines.paper.claims import Below, Claim, Measured, Near
from baselines.paper.formations import SETTLED_FROM, TASKS
from baselines.paper.lanes import started
from baselines.paper.look import BLACK, COLOURS, DASHES, new_figure
from baselines.paper.parts import Part, Progress, Table
from baselines.policies.registry import fit_policy
from baselines.runs.consistency import UPPER, normalised_errors
from baselines.runs.run import PolicyDriver
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import tidy
from tlf_env.engine import readout
from tlf_env.task.scenario import Scenario, load_scenario

SEEDS = tuple(range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + 10))
SKID_AT_S, SKID_S = 40.0, 2.0
BACK_RAD = 0.03  # about three times the error without slip
LOST_MM = 1200.0
SHOWN_S, DRAWN_EVERY = (35.0, 100.0), 10


def skid(channel: str, value: float) -> dict[str, Any]:
    """Slip of all robots for 2 s."""
    pulse = {"type": "impulse", "value": value, "at_s": SKID_AT_S, "duration_s": SKID_S}
    return {"slip": {channel: pulse}}


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "∞": ("infinity", {}),
    "flower": ("flower", {}),
    "∞, 5 mm/s for 2 s": ("infinity", skid("delta_1_mm_s", 5.0)),
    "∞, 0.2 rad/s for 2 s": ("infinity", skid("delta_2_rad_s", 0.2)),
    "flower, 0.2 rad/s for 2 s": ("flower", skid("delta_2_rad_s", 0.2)),
    "∞, friction × 0.8": ("infinity", {"tyre": {"friction_scale": 0.8}}),
}
POSES = ("ekf", "truth")


class Course(NamedTuple):
    """What a filter expects and what it does, at each control step; arrays (time, run, robot)."""

    t_s: np.ndarray  # (time,)
    heading_rad: np.ndarray  # estimated less true
    sigma_rad: np.ndarray  # standard deviation that the filter expects
    nees: np.ndarray  # of the pose, three states; NaN without a covariance
    nis: np.ndarray  # of the last fix, two numbers
    position_mm: np.ndarray  # position error of the robot to its reference

    @property
    def settled(self) -> slice:
        """The steps from 40 % of the run on."""
        return slice(int(SETTLED_FROM * len(self.t_s)), None)

    @property
    def lost(self) -> np.ndarray:
        """Whether a robot of a run was beyond 1200 mm, (run,)."""
        return np.asarray((self.position_mm > LOST_MM).any(axis=(0, 2)))


class Filter(NamedTuple):
    """Courses with the filter, and how many runs are lost with it and with the true pose."""

    courses: dict[str, Course]
    lost: dict[str, tuple[int, int]]


def compute(progress: Progress) -> Filter:
    """Drive every case with the filter and with the true pose."""
    courses, lost = {}, {}
    for done, name in enumerate(CASES):
        progress(done, len(CASES), name)
        with_filter, with_truth = (course(scenario_of(name, pose)) for pose in POSES)
        courses[name] = with_filter
        lost[name] = int(with_filter.lost.sum()), int(with_truth.lost.sum())
    progress(len(CASES), len(CASES))
    return Filter(courses, lost)


def scenario_of(name: str, pose: str) -> Scenario:
    """The scenario of a case, at the project's control period of 20 ms."""
    task, disturbance = CASES[name]
    return load_scenario(
        task, plant="batch", estimator=pose, broadcast_smoothing_s=0.0, disturbance=disturbance
    )


def course(scenario: Scenario) -> Course:
    """Runs of all seeds with k₂/k₃ = 0.83 1/s."""
    policy = fit_policy("reference:consistent", scenario).policy
    plant = started([scenario], SEEDS)
    driver = PolicyDriver(policy, plant.scenario, plant.arrays, "reference:consistent")
    rows = []
    for _ in range(plant.scenario.horizon_steps):
        plant.step(driver.act())
        rows.append(observed(plant.arrays))
    t_s = (1 + np.arange(len(rows))) * scenario.control_period_s
    return Course(t_s, *(np.array(column) for column in zip(*rows, strict=True)))


def observed(arrays: Any) -> tuple[np.ndarray, ...]:
    """A row of a course."""
    info, estimate = readout.info(arrays), readout.named(arrays, "estimate")
    turn = np.asarray(estimate.theta - info.theta_rad)
    turn = turn - 2 * np.pi * np.round(turn / (2 * np.pi))
    off = np.stack([estimate.x - info.x_mm, estimate.y - info.y_mm, turn], axis=-1)
    covariance = np.zeros((*turn.shape, 3, 3))
    covariance[..., UPPER[0], UPPER[1]] = np.stack(estimate[3:], axis=-1)
    covariance[..., UPPER[1], UPPER[0]] = np.stack(estimate[3:], axis=-1)
    return (
        turn,
        np.sqrt(estimate.p_tt),
        normalised_errors(off, covariance),
        info.innovation_nis.copy(),
        info.position_error_mm.copy(),
    )


def back_after_s(one: Course) -> float:
    """Time from the end of the skid until the heading errors' RMS stays below 0.03 rad; infinite if never."""
    rms = np.sqrt(np.mean(one.heading_rad**2, axis=(1, 2)))
    far = np.flatnonzero((rms >= BACK_RAD) & (one.t_s > SKID_AT_S))
    if not len(far):
        return 0.0
    last = int(far[-1])
    if last + 1 >= len(rms):
        return float("inf")
    return max(0.0, float(one.t_s[last + 1] - SKID_AT_S - SKID_S))


# Figure


def draw(data: Filter) -> Mapping[str, Figure]:
    """Heading errors and NEES of a run without and with a skid."""
    figure = new_figure(11.0, 5.6)
    names = ["∞", "∞, 5 mm/s for 2 s", "∞, friction × 0.8"]
    top, bottom = figure.subplots(2, 3, sharex=True, sharey="row")
    low, high = chi2.ppf([0.025, 0.975], 3)
    for name, upper, lower in zip(names, top, bottom, strict=True):
        one = data.courses[name]
        shown = np.flatnonzero((one.t_s >= SHOWN_S[0]) & (one.t_s <= SHOWN_S[1]))[::DRAWN_EVERY]
        for robot in range(one.nees.shape[2]):
            look = {"color": COLOURS[robot], "ls": DASHES[robot], "lw": 0.8}
            upper.plot(one.t_s[shown], one.heading_rad[shown, 0, robot], **look)
            lower.semilogy(
                one.t_s[shown], one.nees[shown, 0, robot], label=f"robot {robot + 1}", **look
            )
        for sign in (-3, 3):
            upper.plot(
                one.t_s[shown], sign * one.sigma_rad[shown, 0, 0], color=BLACK, lw=1.0, ls=":"
            )
        lower.axhspan(low, high, color="0.85", lw=0)
        upper.set_title(name, fontsize=9)
        lower.set_xlabel("time (s)")
        for axes in (upper, lower):
            axes.axvspan(
                SKID_AT_S, SKID_AT_S + SKID_S, color="0.93", lw=0
            ) if "for 2 s" in name else None
            tidy(axes)
    top[0].set_ylim(-0.6, 0.6)
    bottom[0].set_ylim(1e-2, 1e6)
    top[0].set_ylabel("heading error (rad)")
    bottom[0].set_ylabel("NEES of the pose")
    handles, labels = bottom[2].get_legend_handles_labels()
    handles += top[0].plot([], [], color=BLACK, lw=1.0, ls=":")
    labels.append("three standard deviations of the filter")
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    return {"ekf": figure}


def tables(data: Filter) -> tuple[Table, ...]:
    """Errors, NEES and NIS of every case."""
    rows = []
    for name, one in data.courses.items():
        held = one.heading_rad[one.settled]
        with_filter, with_truth = data.lost[name]
        rows.append(
            (
                name,
                f"{np.sqrt(np.mean(held**2)):.2g}",
                f"{np.sqrt(np.mean(one.sigma_rad[one.settled] ** 2)):.2g}",
                f"{np.mean(one.nees[one.settled]):.3g}",
                f"{np.mean(one.nis[one.settled]):.3g}",
                f"{with_filter} / {with_truth}",
            )
        )
    head = (
        "simulation",
        "heading error, RMS, rad",
        "expected by the filter, rad",
        "NEES, mean (3)",
        "NIS, mean (2)",
        f"lost of {len(SEEDS)}: filter / true pose",
    )
    return (
        Table("The paper's filter, k₂/k₃ = 0.83 1/s, after 40 % of the run", head, tuple(rows)),
    )


# Claims


def _mean(name: str, expected: float) -> Any:
    def measure(data: Filter) -> Measured:
        means = {
            case: float(np.mean(getattr(data.courses[case], name)[data.courses[case].settled]))
            for case in TASKS.values()
        }
        worst = max(means.values(), key=lambda value: abs(value - expected))
        return Measured(worst, ", ".join(f"{case} {value:.3g}" for case, value in means.items()))

    return measure


def _more_lost(data: Filter) -> Measured:
    more = {name: with_filter - true for name, (with_filter, true) in data.lost.items()}
    return Measured(
        max(more.values()), ", ".join(f"{name}: {value}" for name, value in more.items())
    )


def _back(data: Filter) -> Measured:
    times = {name: back_after_s(data.courses[name]) for name in CASES if "for 2 s" in name}
    rest_s = float(data.courses["∞"].t_s[-1]) - SKID_AT_S - SKID_S  # of the run
    return Measured(
        min(max(times.values()), rest_s),
        ", ".join(f"{name}: {shown_time(value)}" for name, value in times.items()),
    )


def shown_time(value: float) -> str:
    """A time in s, or that it is beyond the run."""
    return "not within the run" if np.isinf(value) else f"{value:.1f} s"


CLAIMS: Sequence[Claim] = (
    Claim(
        "ekf-nees",
        "The filter expects the errors that it has (its covariance is that of its errors)",
        "eqs (28) to (41)",
        "optimal",
        "mean NEES of the pose without slip; it is 3 if so",
        "",
        _mean("nees", 3),
        Near(3, 0.2, 0.5),
        "ekf",
    ),
    Claim(
        "ekf-nis",
        "The innovations of the filter have the variance that it expects",
        "eqs (31), (37)",
        "optimal",
        "mean NIS of the fixes without slip; it is 2 if so",
        "",
        _mean("nis", 2),
        Near(2, 0.1, 0.5),
    ),
    Claim(
        "ekf-bounded",
        "Errors of the estimate converge to a small vicinity of zero, and stay there",
        "proposition 3",
        "small",
        "time after a skid of 2 s until the heading error's RMS stays below 0.03 rad",
        "s",
        _back,
        Below(5, 20),
        "ekf",
    ),
    Claim(
        "ekf-loop",
        "The filter does not compromise the stability of the closed loop",
        "section VI",
        "does not",
        f"runs of {len(SEEDS)} that are lost with the filter and not with the true pose, largest of the cases",
        "",
        _more_lost,
        Below(0.5),
        digits=1,
    ),
)

PART = Part(
    name="ekf",
    title="Eqs (28) to (41): the filter",
    text=(
        "Runs with the paper's filter at 1 ms, k₂/k₃ = 0.83 1/s and a control period of 20 ms, 10 seeds. "
        "NEES (normalised estimation error squared) is the squared error of the pose over the covariance "
        "that the filter computes, NIS the same of the difference between a fix and its prediction. Of a "
        "filter that knows its errors they have a mean of 3 and 2, the number of states and of measured "
        "values. Grey band: 95 % of the values of NEES for such a filter.",
        "The filter has no slip in its model. Slip of 5 mm/s for 2 s, imposed under all wheels of ∞, or a "
        "little less friction, make wheels skid; the heading is then off by far more than the filter "
        "expects, and its gain, small by then, brings it back slowly or never. With the true pose no run "
        "of these is lost.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "ekf": "Heading errors and NEES of one run of each case; grey band in the upper panels: the skid."
    },
    tables=tables,
    claims=tuple(CLAIMS),
    drives=True,
)
