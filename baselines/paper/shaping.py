"""Fig. 7(a) and (b): loop shaping of the wheel loop, and conditions (9), (10) and (11)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from baselines.paper.claims import Above, Below, Claim, Measured, Near, shown
from baselines.paper.look import BLACK, BLUE, GREEN, RED, new_figure
from baselines.paper.loop import (
    KAPPA,
    LOOP,
    OMEGA,
    UNITS,
    Conditions,
    conditions,
    controller,
    kappa_of,
    last_crossing,
    open_loop,
    plants,
    sliding_friction,
    weight_error,
    weight_uncertainty,
)
from baselines.paper.parts import Part, Progress, Table
from baselines.runs.style import tidy

FORMS = ("exact", "rounded")
UNIT_NAMES = {"design": "kg·mm²/s²", "running": "N·mm"}
KAPPA_FACTORS = np.geomspace(1 / 3, 3, 41)


class Shaping(NamedTuple):
    """What the figures, tables and claims of this part need."""

    found: dict[tuple[str, str, str], Conditions]  # by plant, unit of K, form of K
    kappas: dict[str, float]  # rad/s² per N·mm
    frequencies: dict[str, float]  # rad/s
    forms_differ: float  # largest relative difference of the two forms of K
    smallest_both: tuple[float, float]  # smallest sup of (11) over κ, and the factor on κ
    between: float  # smallest distance of |L| from the weights: a ratio, 1 where they touch
    curves: dict[str, dict[str, np.ndarray]]  # magnitudes over OMEGA, by unit of K


def compute(progress: Progress) -> Shaping:
    """Conditions for every plant, unit and form, and the curves of the figures."""
    systems = plants()
    cases = [(plant, unit, form) for plant in systems for unit in UNITS for form in FORMS]
    total = len(cases) + len(KAPPA_FACTORS)
    found = {}
    for done, (plant, unit, form) in enumerate(cases, start=1):
        found[plant, unit, form] = conditions(systems[plant], unit, form)
        progress(done, total)
    nominal = systems["eq. (6)"]
    both = []
    for done, factor in enumerate(KAPPA_FACTORS, start=len(cases) + 1):
        both.append(conditions(float(factor) * nominal, "design").both)
        progress(done, total)
    k = int(np.argmin(both))
    s = 1j * OMEGA
    w_delta, w_e = np.abs(weight_uncertainty()(s)), np.abs(weight_error()(s))
    exact, rounded = controller()(s), controller("rounded")(s)
    curves = {}
    for unit in UNITS:
        L = open_loop(nominal, unit)(s)
        curves[unit] = {
            "L": np.abs(L),
            "W_e": w_e,
            "1/W_δ": 1 / w_delta,
            "(9)": w_delta * np.abs(L / (1 + L)),
            "(10)": w_e / np.abs(1 + L),
        }
    frequencies = {
        "W_δ": last_crossing(OMEGA, 1 / w_delta),
        "W_e": last_crossing(OMEGA, w_e),
        "crossover": found["eq. (6)", "design", "exact"].crossover_rad_s,
    }
    L = curves["design"]["L"]
    low, high = frequencies["W_e"] >= OMEGA, frequencies["W_δ"] <= OMEGA
    return Shaping(
        found=found,
        kappas={name: kappa_of(system) for name, system in systems.items()},
        frequencies=frequencies,
        forms_differ=float(np.max(np.abs(rounded / exact - 1))),
        smallest_both=(both[k], float(KAPPA_FACTORS[k])),
        between=float(min((L / w_e)[low].min(), (1 / (w_delta * L))[high].min())),
        curves=curves,
    )


def draw(data: Shaping) -> Mapping[str, Figure]:
    """Fig. 7(a) and (b), each for the design loop and for the loop that runs."""
    return {"fig7a": shapes(data), "fig7b": suprema(data)}


def shapes(data: Shaping) -> Figure:
    """|L| between |W_e| and 1/|W_δ|."""
    figure = new_figure(10.0, 4.0)
    for axes, unit in zip(figure.subplots(1, 2, sharey=True), UNITS, strict=True):
        curves = data.curves[unit]
        for name, label, colour, dashes in (
            ("L", r"$|L|$", BLUE, "-"),
            ("W_e", r"$|W_e|$", GREEN, "-."),
            ("1/W_δ", r"$1/|W_\delta|$", RED, "--"),
        ):
            axes.loglog(OMEGA, curves[name], color=colour, ls=dashes, label=label)
        crossover = data.found["eq. (6)", unit, "exact"].crossover_rad_s
        axes.axhline(1, color="0.45", lw=0.8)
        axes.plot(crossover, 1, "o", color=BLUE, ms=5, label=f"crossover {shown(crossover)} rad/s")
        limit = data.frequencies["W_δ"]
        axes.axvline(
            limit, color="0.45", lw=0.8, ls=":", label=f"$|W_\\delta|=1$ at {limit:.3g} rad/s"
        )
        axes.set_xlim(1e-3, 1e4)
        axes.set_ylim(1e-4, 1e5)
        axes.set_xlabel("frequency (rad/s)")
        axes.set_title(f"{unit} loop, K in {UNIT_NAMES[unit]} per rad/s", fontsize="medium")
        axes.legend(frameon=False, fontsize=9)
        tidy(axes)
    figure.axes[0].set_ylabel("magnitude")
    return figure


def suprema(data: Shaping) -> Figure:
    """The left sides of (9), (10) and (11)."""
    figure = new_figure(10.0, 4.0)
    for axes, unit in zip(figure.subplots(1, 2), UNITS, strict=True):
        curves, found = data.curves[unit], data.found["eq. (6)", unit, "exact"]
        axes.axhline(1, color=BLACK, lw=0.9)
        for values, label, colour, dashes, largest in (
            (curves["(9)"], r"(9)  $|W_\delta T|$", BLUE, "--", found.robust),
            (curves["(10)"], r"(10) $|W_e S|$", GREEN, "-.", found.nominal),
            (curves["(9)"] + curves["(10)"], "(11) their sum", RED, "-", found.both),
        ):
            axes.semilogx(
                OMEGA, values, color=colour, ls=dashes, label=f"{label}, at most {largest:.3g}"
            )
        if unit == "running":
            axes.set_yscale("log")
            axes.set_ylim(1e-3, 200)
        else:
            axes.set_ylim(0, 1.9)
        axes.set_xlim(1e-3, 1e4)
        axes.set_xlabel("frequency (rad/s)")
        axes.set_ylabel("left side of the condition")
        axes.set_title(f"{unit} loop, K in {UNIT_NAMES[unit]} per rad/s", fontsize="medium")
        axes.legend(frameon=False, fontsize=9, loc="upper left")
        tidy(axes)
    return figure


def tables(data: Shaping) -> tuple[Table, ...]:
    """Suprema for each plant and unit; in each cell the exact and the rounded form of K."""
    rows = []
    for plant in data.kappas:
        for unit in UNITS:
            two = [data.found[plant, unit, form] for form in FORMS]
            stable = all(one.stable for one in two)
            rows.append(
                (
                    plant,
                    f"{data.kappas[plant]:.3f}",
                    UNIT_NAMES[unit],
                    "yes" if stable else "no",
                    *(
                        " / ".join(_short(getattr(one, field)) for one in two) if stable else "–"
                        for field in ("crossover_rad_s", "robust", "nominal", "both")
                    ),
                )
            )
    head = (
        "plant",
        "κ, rad/s² per N·mm",
        "unit of K, per rad/s",
        "closed loop stable",
        "crossover, rad/s",
        "(9) sup |W_δT|",
        "(10) sup |W_eS|",
        "(11) sup of the sum",
    )
    return (
        Table(
            "Suprema of conditions (9), (10) and (11): exact K(s) / rounded partial fractions",
            head,
            tuple(rows),
        ),
    )


def _short(value: float) -> str:
    return "none" if math.isnan(value) else shown(value, digits=4)


def _of(field: str, unit: str = "design", plant: str = "eq. (6)") -> Any:
    return lambda data: getattr(data.found[plant, unit, "exact"], field)


def _crossover(data: Shaping) -> Measured:
    rounded = data.found["eq. (6)", "design", "rounded"].crossover_rad_s
    return Measured(
        data.frequencies["crossover"], f"{rounded:.3g} with the rounded partial fractions"
    )


def _both(data: Shaping) -> Measured:
    smallest, factor = data.smallest_both
    return Measured(
        data.found["eq. (6)", "design", "exact"].both,
        f"at least {smallest:.3g} for κ between a third and 3 times as large, at {factor:.2g} times",
    )


def _uncertainty(data: Shaping) -> Measured:
    shares = {name: data.kappas[name] / KAPPA - 1 for name in ("common mode", "differential mode")}
    worst = max(shares.values(), key=abs)
    return Measured(
        100 * abs(worst), ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())
    )


def _error_to_move(_: Shaping) -> Measured:
    error = sliding_friction() / (LOOP.gain_Nmm_s * UNITS["design"])
    return Measured(
        error,
        f"{sliding_friction():.2f} N·mm of sliding friction in a wheel's joint against a gain of "
        f"{LOOP.gain_Nmm_s * UNITS['design']:g} N·mm per rad/s",
    )


def _ramp(data: Shaping) -> float:
    """Poles of L at s = 0: the slope of log |L| at the lowest frequencies, with its sign changed."""
    L = data.curves["design"]["L"]
    return float(-np.log(L[1] / L[0]) / np.log(OMEGA[1] / OMEGA[0]))


def _running_crossover(data: Shaping) -> Measured:
    crossover = data.found["eq. (6)", "running", "exact"].crossover_rad_s
    limit = data.frequencies["W_δ"]
    return Measured(crossover / limit, f"crossover {crossover:.4g} rad/s, limit {limit:.3g} rad/s")


CLAIMS = (
    Claim(
        "crossover",
        "The design loop attenuates ξ and δ_ω up to 0.189 rad/s",
        "section III-A, Fig. 7(a)",
        "0.189 rad/s",
        "frequency at which |L| = 1",
        "rad/s",
        _crossover,
        Near(0.189, 0.02, 0.1),
        "fig7a",
        digits=4,
    ),
    Claim(
        "uncertainty-frequency",
        "W_δ covers the uncertainty up to 2.12 rad/s",
        "eq. (12)",
        "2.12 rad/s",
        "frequency at which |W_δ| = 1",
        "rad/s",
        lambda data: data.frequencies["W_δ"],
        Near(2.12, 0.02, 0.1),
        "fig7a",
        digits=4,
    ),
    Claim(
        "performance-frequency",
        "W_e asks for performance up to 0.09 rad/s",
        "eq. (12)",
        "0.09 rad/s",
        "frequency at which |W_e| = 1",
        "rad/s",
        lambda data: data.frequencies["W_e"],
        Near(0.09, 0.02, 0.1),
        "fig7a",
    ),
    Claim(
        "kappa-uncertainty",
        "An error of 50 % of κ is covered",
        "section III-A",
        "50 %",
        "largest deviation from eq. (6) of κ of our robot, castor and yaw inertia included",
        "%",
        _uncertainty,
        Below(50, 100),
    ),
    Claim(
        "loop-between-weights",
        "L lies between W_e at low and 1/W_δ at high frequencies",
        "section III-A, Fig. 7(a)",
        "between them",
        "smallest of |L|/|W_e| where |W_e| > 1 and 1/|W_δL| where |W_δ| > 1",
        "",
        lambda data: data.between,
        Above(1),
        "fig7a",
    ),
    Claim(
        "partial-fractions",
        "K(s) ≈ 150 + 22/s + 128/(s + 2)",
        "eq. (13)",
        "22 and 128",
        "largest deviation of the rounded form from K(jω); the exact fractions are 22.69 and 127.31",
        "%",
        lambda data: 100 * data.forms_differ,
        Below(5, 10),
    ),
    Claim(
        "ramp",
        "No velocity error in the tracking of a ramp",
        "section III-A",
        "0",
        "poles of L at s = 0 (two leave no error after a ramp)",
        "",
        _ramp,
        Near(2, 0.001, 0.01),
    ),
    Claim(
        "robust-stability",
        "Robust stability holds in the design loop",
        "eq. (9), Fig. 7(b)",
        "< 1",
        "sup |W_δT|",
        "",
        _of("robust"),
        Below(1),
        "fig7b",
        digits=4,
    ),
    Claim(
        "nominal-performance",
        "Nominal performance holds in the design loop",
        "eq. (10), Fig. 7(b)",
        "< 1",
        "sup |W_eS|",
        "",
        _of("nominal"),
        Below(1),
        "fig7b",
        digits=4,
    ),
    Claim(
        "robust-performance",
        "Robust performance holds in the design loop",
        "eq. (11), Fig. 7(b)",
        "< 1",
        "sup (|W_eS| + |W_δT|)",
        "",
        _both,
        Below(1, 1.05),
        "fig7b",
        digits=4,
    ),
    Claim(
        "design-loop-moves",
        "The design loop is the one that drives the robot: friction is a disturbance that it rejects",
        "section III-A",
        "up to 0.189 rad/s",
        "speed error at which its proportional part balances joint friction",
        "rad/s",
        _error_to_move,
        Below(1, 5),
    ),
    Claim(
        "running-robust-stability",
        "The loop that runs (K in N·mm per rad/s) satisfies (9)",
        "eq. (9)",
        "< 1",
        "sup |W_δT|",
        "",
        _of("robust", "running"),
        Below(1),
        "fig7b",
        digits=4,
    ),
    Claim(
        "running-nominal-performance",
        "The loop that runs satisfies (10)",
        "eq. (10)",
        "< 1",
        "sup |W_eS|",
        "",
        _of("nominal", "running"),
        Below(1),
        "fig7b",
        digits=4,
    ),
    Claim(
        "running-bandwidth",
        "The bandwidth lies where the uncertainty is covered",
        "section III-A, footnote 3",
        "0.189 of 2.12 rad/s",
        "crossover of the loop that runs over the frequency at which |W_δ| = 1",
        "",
        _running_crossover,
        Below(1),
        "fig7a",
    ),
)

PART = Part(
    name="fig7ab",
    title="Fig. 7(a) and (b): loop shaping of the wheel loop",
    text=(
        "The paper prints K(s) without a unit. Its frequencies follow with K in kg·mm²/s² per rad/s (the "
        "design loop). That loop gives 0.15 N·mm for an error of 1 rad/s and does not move the robot. "
        "With K in N·mm per rad/s (the running loop) it does, and the loop is 1000 times as fast.",
        "Plants: eq. (6); the common and the differential mode of our robot at 300 mm/s, from its "
        "linearisation, with castor and yaw inertia; each of them with friction linearised about rest, by "
        "the describing function 4 T_f/(πA) at an amplitude of A = 1 rad/s; and eq. (6) at the steepest "
        "fall of joint friction with speed, between the transition speeds of Table I. Sliding friction at "
        "a steady speed is constant: an input disturbance, with no part in the linear plant. The trail, "
        "the yaw inertia and the place of the centre of mass are not published; they decide the "
        "differential mode.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "fig7a": "Fig. 7(a): the loop and its weights. Left: the design loop. Right: the loop that runs.",
        "fig7b": "Fig. 7(b): the conditions, with κ of eq. (6). Left: (11) exceeds 1. Right: so does (9).",
    },
    tables=tables,
    claims=CLAIMS,
)
