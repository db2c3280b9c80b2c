"""Tracking with an error of κ, and with more robots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from baselines.paper.claims import Above, Below, Claim, Measured
from baselines.paper.formations import GAINS, TASKS
from baselines.paper.lanes import Ends, drive, run_of
from baselines.paper.look import COLOURS, DASHES, new_figure
from baselines.paper.parts import Part, Progress, Table
from baselines.paper.tracks import cells
from baselines.policies.registry import fit_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import MARKERS, tidy
from tlf_env.onboard.wheel_loop import WheelLoopParameters
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.scenario import Scenario, load_scenario

PERIOD_S = 0.002
SEEDS = tuple(range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + 5))
FACTORS = (0.5, 1.0, 1.5)
MOST_ROBOTS = {"infinity": 9, "flower": 20}  # as many as fit on the path, a gap of 5 s apart
POSES = {"ekf": "EKF", "truth": "true pose"}
Place = tuple[str, str]  # task, gains


class Row(NamedTuple):
    """Which long row of robots."""

    task: str
    gains: str
    estimator: str


class Robustness(NamedTuple):
    """All runs."""

    kappa: dict[Place, dict[str, Ends]]  # variant: one run
    rows: dict[Row, Ends]


def heavy(factor: float) -> RobotParameters:
    """A robot with ``factor`` times κ of eq. (6), by its mass and, in proportion, its yaw inertia."""
    robot = RobotParameters()
    wheel = 0.4 * robot.wheel_radius_mm**2
    total = (wheel * robot.mass_kg + robot.wheel_inertia_kg_mm2) / factor
    mass_kg = (total - robot.wheel_inertia_kg_mm2) / wheel
    return robot.model_copy(
        update={
            "mass_kg": mass_kg,
            "body_inertia_kg_mm2": robot.body_inertia_kg_mm2 * mass_kg / robot.mass_kg,
        }
    )


def variants() -> dict[str, dict[str, Any]]:
    """Fields of the scenario by which κ, or the loop's gain in its place, is off."""
    found: dict[str, dict[str, Any]] = {}
    for factor in FACTORS:
        gain = WheelLoopParameters().gain_Nmm_s * factor
        found[f"K × {factor:g}"] = {"wheel_loop": WheelLoopParameters(gain_Nmm_s=gain)}
    for factor in FACTORS[::2]:
        found[f"mass for κ × {factor:g}"] = {"robot": heavy(factor)}
    return found


def fitted(task: str, gains: str, **fields: Any) -> Any:
    """Policy and scenario of a simulation."""
    scenario = load_scenario(task, control_period_s=PERIOD_S, plant="batch", **fields)
    return fit_policy(f"reference:{gains}", scenario)


def compute(progress: Progress) -> Robustness:
    """All runs."""
    places = [(task, gains) for task in TASKS for gains in GAINS]
    rows = [Row(*place, estimator) for place in places for estimator in POSES]
    total, kappa, long = len(places) + len(rows), {}, {}
    for done, place in enumerate(places):
        progress(done, total, f"κ: {TASKS[place[0]]}, {place[1]}")
        kappa[place] = with_kappa(*place)
    for done, row in enumerate(rows, len(places)):
        progress(done, total, f"{MOST_ROBOTS[row.task]} robots: {TASKS[row.task]}, {row.gains}")
        long[row] = with_many(row)
    progress(total, total)
    return Robustness(kappa, long)


def with_kappa(task: str, gains: str) -> dict[str, Ends]:
    """A run of each variant of κ."""
    found = fitted(task, gains)
    scenarios: list[Scenario] = [
        found.scenario.model_copy(update=fields) for fields in variants().values()
    ]
    ends = drive(scenarios, found.policy, [SEEDS[0]] * len(scenarios))
    return {name: run_of(ends, [number]) for number, name in enumerate(variants())}


def with_many(row: Row) -> Ends:
    """Runs of a row as long as the path; as no robot depends on those behind, also of all shorter rows."""
    found = fitted(row.task, row.gains, robots=MOST_ROBOTS[row.task])
    scenario = found.scenario.model_copy(update={"estimator": row.estimator})
    return drive([scenario], found.policy, SEEDS)


def share_lost(ends: Ends) -> np.ndarray:
    """Share of runs in which one of the first n robots is lost, for each n from 1 on."""
    return np.asarray(np.logical_or.accumulate(ends.gone, axis=1).mean(axis=0))


# Figure


def draw(data: Robustness) -> Mapping[str, Figure]:
    """Share lost against n, and errors along the row."""
    figure = new_figure(11.0, 3.9)
    share, errors = figure.subplots(1, 2)
    for number, (row, ends) in enumerate(data.rows.items()):
        name = f"{TASKS[row.task]}, {row.gains}, {POSES[row.estimator]}"
        look = {
            "color": COLOURS[number // 2],
            "ls": DASHES[number % 2],
            "marker": MARKERS[number // 2],
            "ms": 4 if number % 2 == 0 else 6,
            "mfc": COLOURS[number // 2] if number % 2 == 0 else "none",
            "lw": 1.0,
        }
        places = np.arange(1, ends.rms_mm.shape[1] + 1)
        share.plot(places, 100 * share_lost(ends), **look)
        held = ~np.logical_or.accumulate(ends.gone, axis=1).any(axis=0)
        errors.semilogy(places[held], np.median(ends.rms_mm, axis=0)[held], label=name, **look)
    share.set_xlabel("number of robots $n$")
    share.set_ylabel("runs with a lost robot (%)")
    errors.set_xlabel("place in the row, up to the first that is lost")
    errors.set_ylabel("RMS position error (mm)")
    for axes in (share, errors):
        axes.set_xticks(range(1, 21, 2))
        tidy(axes)
    figure.legend(loc="outside right center", frameon=False, fontsize=8)
    return {"robustness": figure}


def tables(data: Robustness) -> tuple[Table, ...]:
    """κ, and the rows."""
    names = list(variants())
    kappa = tuple(
        (f"{TASKS[task]}, {gains}", *(cells(one.rms_mm[0], one.gone[0]) for one in each.values()))
        for (task, gains), each in data.kappa.items()
    )
    rows = tuple(
        (
            f"{TASKS[row.task]}, {row.gains}, {POSES[row.estimator]}",
            str(longest(ends)),
            ", ".join(f"{n}: {100 * value:.0f} %" for n, value in steps(share_lost(ends))),
        )
        for row, ends in data.rows.items()
    )
    return (
        Table(
            "RMS position error of each robot after 40 % of the run, mm",
            ("simulation, gains", *names),
            kappa,
        ),
        Table(
            f"Longest row without a lost run ({len(SEEDS)} seeds), and the share of runs lost with n robots "
            "where it changes",
            ("simulation, gains, pose", "longest row", "n: lost"),
            rows,
        ),
    )


def longest(ends: Ends) -> int:
    """The number of robots of the longest row that no run loses."""
    return int((share_lost(ends) == 0.0).sum())


def steps(shares: np.ndarray) -> list[tuple[int, float]]:
    """Number of robots and share, where the share changes, and the last."""
    changed = [n for n in range(1, len(shares)) if shares[n] != shares[n - 1]]
    places = sorted({0, *changed, len(shares) - 1})
    return [(n + 1, float(shares[n])) for n in places]


# Claims


def _kappa(task: str, gains: str, kind: str) -> Any:
    def measure(data: Robustness) -> Measured:
        worst = {
            name: float(one.worst_mm[0])
            for name, one in data.kappa[task, gains].items()
            if name.startswith(kind)
        }
        return Measured(
            max(worst.values()),
            ", ".join(
                f"{name}: " + ("lost" if math.isinf(value) else f"{value:.2g}")
                for name, value in worst.items()
            ),
        )

    return measure


def _longest(task: str, gains: str) -> Any:
    def measure(data: Robustness) -> Measured:
        ends = data.rows[Row(task, gains, "ekf")]
        true = longest(data.rows[Row(task, gains, "truth")])
        return Measured(
            longest(ends), f"of {MOST_ROBOTS[task]} that fit on the path; true pose: {true}"
        )

    return measure


def _kappa_claim(task: str, gains: str, kind: str, statement: str) -> Claim:
    return Claim(
        f"kappa-{task}-{gains}-{kind.split()[0]}",
        statement,
        "section III-A, eq. (12)",
        "robust",
        "RMS position error of the worst robot after 40 % of the run",
        "mm",
        _kappa(task, gains, kind),
        Below(20, 100),
        digits=2,
    )


def _longest_claim(task: str, gains: str, few: int, reading: str) -> Claim:
    return Claim(
        f"row-{task}-{gains}",
        f"The strategy is decentralised: each robot depends on its predecessor only, for any n, on "
        f"{TASKS[task]}{reading}",
        "sections IV and VI",
        f"n robots; {few} shown",
        "robots of the longest row without a lost run",
        "",
        _longest(task, gains),
        Above(MOST_ROBOTS[task] - 0.5, few + 0.5),
        "robustness",
        digits=1,
    )


CONSISTENT = ", with k₂/k₃ = 0.83 1/s"
CLAIMS: Sequence[Claim] = (
    _kappa_claim(
        "infinity", "consistent", "K", "∞ is tracked with ± 50 % of the loop's gain" + CONSISTENT
    ),
    _kappa_claim(
        "flower",
        "consistent",
        "K",
        "The flower is tracked with ± 50 % of the loop's gain" + CONSISTENT,
    ),
    _kappa_claim(
        "flower",
        "printed",
        "K",
        "The flower is tracked with ± 50 % of the loop's gain, with the printed gains",
    ),
    _kappa_claim(
        "infinity",
        "consistent",
        "mass",
        "∞ is tracked by robots whose mass makes κ ± 50 %" + CONSISTENT,
    ),
    _kappa_claim(
        "flower",
        "consistent",
        "mass",
        "The flower is tracked by robots whose mass makes κ ± 50 %" + CONSISTENT,
    ),
    _longest_claim("infinity", "consistent", 3, CONSISTENT),
    _longest_claim("flower", "consistent", 5, CONSISTENT),
    _longest_claim("flower", "printed", 5, ", with the printed gains"),
)

PART = Part(
    name="robustness",
    title="κ ± 50 %, and more robots",
    text=(
        "Runs as in Fig. 11 at a control period of 2 ms, with the paper's filter. K × 0.5 and × 1.5 "
        "change L of the wheel loop as such an error of κ does, and nothing else. The other two columns "
        "change κ itself, by the mass (0.81 and 2.5 kg in place of 1.245 kg); the yaw inertia, the loads "
        "and all friction change with it.",
        "A robot does not depend on those behind it, so that a row of n robots contains all shorter rows. "
        "A lost robot is as in Fig. 11.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "robustness": "Left: runs with a lost robot among the first n. Right: errors along the row, median "
        "of the seeds. Open markers and dashes: true pose in place of the filter's."
    },
    tables=tables,
    claims=tuple(CLAIMS),
    drives=True,
)
