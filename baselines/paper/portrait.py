"""Fig. 8: tracking errors about two equilibria, and the domain from which they converge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from baselines.paper.claims import Above, Below, Claim, Measured
from baselines.paper.errors import (
    REFERENCES,
    Converged,
    Law,
    Paths,
    convergence,
    growth_rates,
    laws,
    paths,
    straight,
)
from baselines.paper.look import BLUE, RED, new_figure
from baselines.paper.parts import Part, Progress, Table
from baselines.runs.style import tidy

SHOWN_S, MAPPED_S, SOON_S, SCALE_S = 60.0, 100.0, 20.0, 25.0
EVERY = 1  # steps between the points of a shown path
SMALL = np.array([[0.0], [5.0], [0.0]])  # e₁, e₂ in mm, e₃ in rad
# Starts about an equilibrium: e₁ and e₂ in mm, e₃ in rad.
OFFSETS = np.array(
    [
        (300.0, 300.0, 1.5),
        (-300.0, 300.0, -1.5),
        (300.0, -300.0, -2.5),
        (-300.0, -300.0, 2.5),
        (0.0, 150.0, 0.5),
        (0.0, 40.0, 0.2),
    ]
).T
E_1_MM = (-300.0, 0.0, 300.0)
E_2_MM = np.linspace(-600, 600, 17)
E_3_RAD = np.linspace(-np.pi, np.pi, 19)[1:-1]  # the ends are equilibria


class Portrait(NamedTuple):
    """Paths and maps of this part."""

    paths: dict[tuple[str, int], Paths]  # by law and turn of the equilibrium
    maps: dict[tuple[str, str], Converged]  # by law and reference; starts as of `grid()`
    left_mm: dict[str, float]  # by law: from SMALL, in the last 10 s on the straight line
    rates: dict[str, tuple[float, float, float]]  # largest real parts about e₃ = 0, π, 2π, 1/s


def grid() -> np.ndarray:
    """Starts (3, start) of the maps: e₁ slowest, then e₂, then e₃."""
    return np.stack([one.ravel() for one in np.meshgrid(E_1_MM, E_2_MM, E_3_RAD, indexing="ij")])


def rates_of(law: Law) -> tuple[float, float, float]:
    """Largest real parts of the eigenvalues about e₃ = 0, π and 2π, 1/s."""
    about_0, about_pi, about_2_pi = (
        float(growth_rates(e_3, law).real.max()) for e_3 in (0.0, np.pi, 2 * np.pi)
    )
    return about_0, about_pi, about_2_pi


def compute(progress: Progress) -> Portrait:
    """Paths for 60 s and maps for 100 s."""
    every_law = laws()
    total, done = len(every_law) * (2 + len(REFERENCES)), 0
    shown, maps = {}, {}
    for name, law in every_law.items():
        for turn in (0, 1):
            starts = OFFSETS + np.array([0.0, 0.0, 2 * np.pi * turn])[:, None]
            shown[name, turn] = paths(starts, law, straight, SHOWN_S, EVERY)
            done += 1
            progress(done, total)
        for reference, twist in REFERENCES.items():
            maps[name, reference] = convergence(grid(), law, twist, MAPPED_S)
            done += 1
            progress(done, total)
    rates = {name: rates_of(law) for name, law in every_law.items()}
    left_mm = {
        name: float(convergence(SMALL, law, straight, MAPPED_S).left_mm[0])
        for name, law in every_law.items()
    }
    return Portrait(shown, maps, left_mm, rates)


PLANES = ((0, 1), (1, 2), (0, 2))
LABELS = ("$e_1$ (mm)", "$e_2$ (mm)", "$e_3$ (rad)")


def draw(data: Portrait) -> Mapping[str, Figure]:
    """Fig. 8 for each reading of k₂, and the maps."""
    figures = {f"fig8_{preset}": trajectories(data, preset) for preset in ("printed", "consistent")}
    return {**figures, "fig8_domain": domain(data)}


def trajectories(data: Portrait, preset: str) -> Figure:
    """Errors in space and in three planes; upper row without the complementary law, lower row with it."""
    figure = new_figure(12.5, 6.4)
    places = figure.add_gridspec(2, 4, width_ratios=(1.4, 1, 1, 1))
    for row, on in enumerate(("off", "on")):
        space: Any = figure.add_subplot(places[row, 0], projection="3d")
        planes = [figure.add_subplot(places[row, 1 + i]) for i in range(3)]
        for turn, colour, dashes in ((0, BLUE, "-"), (1, RED, "--")):
            e = data.paths[f"{preset}, ϱ {on}", turn].e
            goal = (0.0, 0.0, 2 * np.pi * turn)
            for start in range(e.shape[2]):
                space.plot(*e[:, :, start].T, color=colour, lw=0.7)
                for axes, (i, j) in zip(planes, PLANES, strict=True):
                    axes.plot(e[:, i, start], e[:, j, start], dashes, color=colour, lw=0.7)
                    axes.plot(e[0, i, start], e[0, j, start], "o", mfc="white", color=colour, ms=3)
            space.plot(*goal, "k+", ms=8, mew=1.5)
            for axes, (i, j) in zip(planes, PLANES, strict=True):
                axes.plot(goal[i], goal[j], "k+", ms=8, mew=1.5)
        space.set_xlabel(LABELS[0], fontsize=8)
        space.set_ylabel(LABELS[1], fontsize=8)
        space.set_zlabel(LABELS[2], fontsize=8)
        space.set_box_aspect(None, zoom=0.78)
        space.tick_params(labelsize=7)
        space.set_title(f"complementary law {on}", fontsize="medium")
        for axes, (i, j) in zip(planes, PLANES, strict=True):
            axes.set_xlabel(LABELS[i])
            axes.set_ylabel(LABELS[j])
            tidy(axes)
    last = figure.axes[-1]
    last.plot([], [], color=BLUE, label="starts about [0 0 0]")
    last.plot([], [], "--", color=RED, label="starts about [0 0 2π]")
    handles, names = last.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def domain(data: Portrait) -> Figure:
    """Time to converge over e₂ and e₃ at e₁ = 0, by law and reference."""
    names, references = list(laws()), list(REFERENCES)
    figure = new_figure(12.0, 7.2)
    grid_axes = figure.subplots(len(references), len(names), sharex=True, sharey=True)
    shape = (len(E_1_MM), len(E_2_MM), len(E_3_RAD))
    image: Any = None
    for row, reference in zip(grid_axes, references, strict=True):
        for axes, name in zip(row, names, strict=True):
            found = data.maps[name, reference]
            at_s = found.at_s.reshape(shape)[E_1_MM.index(0.0)]
            turn = found.turn.reshape(shape)[E_1_MM.index(0.0)]
            image = axes.pcolormesh(
                E_3_RAD,
                E_2_MM,
                np.ma.masked_invalid(at_s),
                cmap="viridis_r",
                vmin=0,
                vmax=SCALE_S,
                shading="nearest",
            )
            axes.set_facecolor("0.8")
            e_2, e_3 = np.meshgrid(E_2_MM, E_3_RAD, indexing="ij")
            other = turn != 0
            axes.plot(e_3[other], e_2[other], "x", color="white", ms=3.5, mew=0.9)
            axes.set_title(f"{reference}; {name}", fontsize=8.5)
    for axes in grid_axes[-1]:
        axes.set_xlabel("$e_3$ at the start (rad)")
    for axes in grid_axes[:, 0]:
        axes.set_ylabel("$e_2$ at the start (mm)")
    figure.colorbar(image, ax=grid_axes, label="time to converge (s)", shrink=0.7)
    return figure


def tables(data: Portrait) -> tuple[Table, ...]:
    """Shares of the grid that converge."""
    rows = []
    for (law, reference), found in data.maps.items():
        times = found.at_s[np.isfinite(found.at_s)]
        rows.append(
            (
                law,
                reference,
                f"{100 * share(found, SOON_S):.0f} %",
                f"{100 * share(found):.0f} %",
                f"{100 * np.mean(found.turn == 0):.0f} %",
                f"{np.median(times):.1f} s" if len(times) else "–",
            )
        )
    head = (
        "gains",
        "reference",
        "converged in 20 s",
        "converged in 100 s",
        "at the end about their own equilibrium",
        "median time of those that converge",
    )
    eigen = tuple(
        (name, *(f"{rate:.2g}" for rate in values), f"{data.left_mm[name]:.2f} mm")
        for name, values in data.rates.items()
    )
    return (
        Table(f"Domain of convergence: {grid().shape[1]} starts", head, tuple(rows)),
        Table(
            "Small errors: largest real part of the eigenvalues on the circle, 1/s; and the swing that an "
            "error of 5 mm in e₂ leaves after 90 s on the straight line",
            ("gains", "about e₃ = 0", "about π", "about 2π", "swing left"),
            eigen,
        ),
    )


def share(found: Converged, within_s: float = np.inf) -> float:
    """Share of the starts that converge within a time."""
    return float(np.mean(np.isfinite(found.at_s) & (found.at_s <= within_s)))


def _shares(preset: str, within_s: float) -> Any:
    def measure(data: Portrait) -> Measured:
        shares = {
            reference: 100 * share(data.maps[f"{preset}, ϱ on", reference], within_s)
            for reference in REFERENCES
        }
        return Measured(
            min(shares.values()),
            ", ".join(f"{name} {value:.1f} %" for name, value in shares.items()),
        )

    return measure


def _own(data: Portrait) -> Measured:
    shares = {
        law: min(
            100 * float(np.mean(data.maps[law, reference].turn == 0)) for reference in REFERENCES
        )
        for law in laws()
    }
    worst = min(shares, key=lambda law: shares[law])
    return Measured(shares[worst], f"with {worst}")


def _unstable(data: Portrait) -> Measured:
    rates = {law: values[1] for law, values in data.rates.items()}
    return Measured(min(rates.values()), "smallest of the four laws")


def _stable(data: Portrait) -> Measured:
    worst = max(data.rates, key=lambda law: max(data.rates[law][0], data.rates[law][2]))
    rate = max(data.rates[worst][0], data.rates[worst][2])
    return Measured(rate, f"with {worst}; time constant {-1 / rate:.3g} s" if rate < 0 else "")


def _shift(data: Portrait) -> float:
    """Largest difference of the paths about both equilibria, 2π apart: mm and rad alike."""
    difference = 0.0
    for law in laws():
        near, far = data.paths[law, 0].e, data.paths[law, 1].e
        off = far - near - np.array([0.0, 0.0, 2 * np.pi])[None, :, None]
        difference = max(difference, float(np.abs(off).max()))
    return difference


CLAIMS = (
    Claim(
        "odd-equilibria-unstable",
        "Equilibria [0 0 jπ] with odd j are unstable",
        "Remark 3",
        "unstable",
        "largest real part of an eigenvalue about e₃ = π, on the circle",
        "1/s",
        _unstable,
        Above(0),
    ),
    Claim(
        "even-equilibria-stable",
        "Equilibria with even j are asymptotically stable",
        "Proposition 1",
        "stable",
        "largest real part of an eigenvalue about e₃ = 0 and 2π, on the circle",
        "1/s",
        _stable,
        Below(0),
    ),
    Claim(
        "period",
        "The closed loop repeats every 2π of e₃",
        "Remark 3, Fig. 8",
        "same behaviour about both points",
        "largest difference of the paths about [0 0 0] and [0 0 2π], in mm or rad",
        "",
        _shift,
        Below(1e-3, 1.0),
        "fig8_consistent",
    ),
    Claim(
        "convergence-printed",
        "Errors from everywhere in −π < e₃ < π converge, with the printed gains",
        "Proposition 1, Fig. 8",
        "all",
        "smallest share of starts that converge within 100 s",
        "%",
        _shares("printed", MAPPED_S),
        Above(99, 50),
        "fig8_domain",
    ),
    Claim(
        "convergence-consistent",
        "Errors from everywhere in −π < e₃ < π converge, with k₂/k₃ = 0.83 1/s",
        "Proposition 1, Fig. 8",
        "all",
        "smallest share of starts that converge within 100 s",
        "%",
        _shares("consistent", MAPPED_S),
        Above(99, 50),
        "fig8_domain",
    ),
    Claim(
        "soon-printed",
        "Errors are smallest after 20 s, with the printed gains in ideal kinematics",
        "section V",
        "20 s",
        "smallest share of starts that converge within 20 s",
        "%",
        _shares("printed", SOON_S),
        Above(95, 50),
        "fig8_domain",
    ),
    Claim(
        "soon-consistent",
        "Errors are smallest after 20 s, with k₂/k₃ = 0.83 1/s in ideal kinematics",
        "section V",
        "20 s",
        "smallest share of starts that converge within 20 s",
        "%",
        _shares("consistent", SOON_S),
        Above(95, 50),
        "fig8_domain",
    ),
    Claim(
        "own-equilibrium",
        "Errors within (j − 2)π < e₃ < jπ end at (j − 1)π",
        "Remark 3",
        "all",
        "smallest share of starts that are within π of their own equilibrium after 100 s",
        "%",
        _own,
        Above(99.9, 50),
        "fig8_domain",
    ),
)

PART = Part(
    name="fig8",
    title="Fig. 8: tracking errors about two equilibria",
    text=(
        "Eq. (20) in ideal kinematics, for the printed k₂ = 0.83 mm²/s and for k₂/k₃ = 0.83 1/s, without "
        "the complementary law and with it: then (17) with (19) and (21). The twist of the reference and "
        "the starts of Fig. 8 are not published. Its trajectories are drawn here for a straight line at "
        "300 mm/s; the maps are for that line, for a circle at 300 mm/s and 0.4 rad/s, and for the path "
        "of eq. (52).",
        "A start has converged when its error stays below 10 mm and 0.05 rad. Large errors converge with "
        "either k₂, because the turn −e₂u₁*/k₃ carries e₂ over to e₁, which k₁ damps, and a positive e₁ "
        "damps e₂. Small errors do not have this damping: on the straight line the printed k₂ alone "
        "leaves a swing of millimetres, which only the boundary layer of (21) damps.",
        "White crosses: e₃ ends about another turn than the one it started at, so the strips of Remark 3 "
        "are not invariant. The level set of V₁ that holds no other equilibrium reaches 219 mm.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "fig8_printed": "Fig. 8 with the printed gains: 60 s from twelve starts (open markers).",
        "fig8_consistent": "Fig. 8 with k₂/k₃ = 0.83 1/s: 60 s from the same starts.",
        "fig8_domain": "Time to converge from starts with e₁ = 0. Grey: not within 100 s. "
        "White crosses: ends about another turn.",
    },
    tables=tables,
    claims=CLAIMS,
)
