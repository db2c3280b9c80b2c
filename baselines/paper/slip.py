"""Eq. (21): what the complementary law is worth against slip, in ideal kinematics and on the plant."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from baselines.paper.claims import Below, Claim, Measured, shown
from baselines.paper.errors import Law, settled, straight
from baselines.paper.formations import GAINS, TASKS
from baselines.paper.lanes import Ends, Several, drive, run_of
from baselines.paper.look import BLACK, BLUE, COLOURS, DASHES, GREEN, RED, new_figure
from baselines.paper.parts import Part, Progress, Table
from baselines.policies.reference import ReferencePolicy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import MARKERS, tidy
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.tracking import TrackingGains, gains_row
from tlf_env.task.scenario import Scenario, load_scenario

PERIOD_S = 0.002
SETTLE_S = 60.0  # of the ideal errors; the slowest decays within 4 s
STRAIGHT_MM_S = 300.0
ETAS = (0.0019, 0.19, 1.9, 19.0)  # mm/s, slip of the same size
EPSILONS = tuple(10.0**k for k in np.arange(-7.0, 5.01, 0.5))
STIFFEST = 200.0  # 1/s: η²/ε of the ideal errors, which steps of 10 ms can follow
RATIOS = tuple(10.0**k for k in np.arange(-2.0, 2.01, 0.25))  # slip over η
YAW_ETA, YAW_EPSILON = 0.1, 12.0  # rad/s, and mm²/s
MAP_ETAS = (0.0019, 0.02, 0.2, 2.0, 20.0)
MAP_EPSILONS = tuple(10.0**k for k in range(-3, 6))
FORWARD_MM_S, YAW_RAD_S = 5.0, 0.05
SEEDS = tuple(range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + 3))

SLIPS: dict[str, dict[str, Any]] = {
    "none": {},
    "δ₁ = 5 mm/s": {"slip": {"delta_1_mm_s": FORWARD_MM_S}},
    "sines": {
        "slip": {
            "delta_1_mm_s": {
                "type": "sine",
                "amplitude": FORWARD_MM_S,
                "frequency_hz": 0.3,
                "random_phase": True,
            },
            "delta_2_rad_s": {
                "type": "sine",
                "amplitude": YAW_RAD_S,
                "frequency_hz": 0.41,
                "random_phase": True,
            },
        }
    },
}


class Key(NamedTuple):
    """Which runs."""

    task: str
    gains: str
    slip: str
    estimator: str


class Slip(NamedTuple):
    """Errors with and without the complementary law."""

    inside: dict[float, list[tuple[float, float]]]  # η: (ε, |e₁| in mm) with δ₁ = η
    beyond: list[tuple[float, float, float]]  # δ₁ over η, |e₁| in mm with the law and without it
    yaw: tuple[float, float, float]  # |e₂| in mm under δ₂ = η: with the law, without, formula
    runs: dict[Key, tuple[Ends, Ends]]  # without the law, with it
    map_mm: np.ndarray  # (η, ε): RMS error of the worst robot under δ₁ = 5 mm/s, true pose
    without_mm: float  # the same without the law


def law_of(eta: float, epsilon: Any, preset: str = "printed") -> Law:
    """The gains of a preset with other η and ε (or an array of ε); η = 0 is no complementary law."""
    gains = gains_row(controller(preset).gains)._replace(eta=eta, epsilon=epsilon)
    return Law(gains, eta > 0.0)


def compute(progress: Progress) -> Slip:
    """The ideal errors, the runs and the map."""
    total = len(keys()) + 2
    inside = {eta: inside_errors(eta) for eta in ETAS}
    slips = 1.9 * np.array(RATIOS)
    on, off = (left(law_of(eta, 0.1), slips, 0.0, len(RATIOS))[0] for eta in (1.9, 0.0))
    beyond = list(zip(RATIOS, on.tolist(), off.tolist(), strict=True))
    yaw = yaw_error()
    runs = {}
    for done, key in enumerate(keys(), 1):
        progress(done, total, f"{TASKS[key.task]}, {key.gains}, slip: {key.slip}")
        runs[key] = with_and_without(key)
    progress(total - 1, total, "η and ε on the plant")
    map_mm, without_mm = mapped()
    progress(total, total)
    return Slip(inside, beyond, yaw, runs, map_mm, without_mm)


def inside_errors(eta: float) -> list[tuple[float, float]]:
    """ε and |e₁| (mm) that δ₁ = η leaves, for each ε that steps of 10 ms can follow."""
    epsilons = [epsilon for epsilon in EPSILONS if eta**2 / epsilon <= STIFFEST]
    found = left(law_of(eta, np.array(epsilons)), eta, 0.0, len(epsilons))[0]
    return list(zip(epsilons, found.tolist(), strict=True))


def left(law: Law, forward: Any, yaw: float = 0.0, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """|e₁| and |e₂| (mm) that constant slip leaves on a straight line at 300 mm/s, (case,)."""
    e = np.abs(settled(law, straight, (forward, yaw), SETTLE_S, count))
    return e[0], e[1]


def yaw_error() -> tuple[float, float, float]:
    """|e₂| (mm) under δ₂ = 0.1 rad/s: with η = 0.1 and ε = 12, without (21), and k₃δ₂/u₁*."""
    on, off = law_of(YAW_ETA, YAW_EPSILON, "consistent"), law_of(0.0, 0.1, "consistent")
    with_law, without = (float(left(law, 0.0, YAW_ETA)[1][0]) for law in (on, off))
    return with_law, without, off.gains.k_3 * YAW_ETA / STRAIGHT_MM_S


# Runs on the plant


def keys() -> list[Key]:
    """Every kind of runs: with the true pose under each slip, and with the paper's filter without slip."""
    true = [Key(task, gains, slip, "truth") for task in TASKS for gains in GAINS for slip in SLIPS]
    return true + [Key(task, gains, "none", "ekf") for task in TASKS for gains in GAINS]


def scenario_of(task: str, slip: str, estimator: str) -> Scenario:
    """The scenario of runs."""
    return load_scenario(
        task,
        control_period_s=PERIOD_S,
        plant="batch",
        estimator=estimator,
        broadcast_smoothing_s=0.0,
        disturbance=SLIPS[slip],
    )


def policy(gains: str, **changed: float) -> ReferencePolicy:
    """The paper's law with the gains of a preset, and other η and ε."""
    found = controller(gains).gains.model_copy(update=changed)
    return ReferencePolicy(TrackingGains.model_validate(found.model_dump()), PERIOD_S)


def with_and_without(key: Key) -> tuple[Ends, Ends]:
    """Runs of all seeds without the complementary law and with it."""
    count = len(SEEDS)
    laws = [policy(key.gains, eta=0.0)] * count + [policy(key.gains)] * count
    ends = drive([scenario_of(key.task, key.slip, key.estimator)], Several(laws), SEEDS * 2)
    return run_of(ends, slice(count)), run_of(ends, slice(count, None))


def mapped() -> tuple[np.ndarray, float]:
    """RMS error on ∞ of the worst robot over η and ε under forward slip, true pose; and without the law."""
    laws = [policy("consistent", eta=0.0)]
    laws += [policy("consistent", eta=eta, epsilon=eps) for eta in MAP_ETAS for eps in MAP_EPSILONS]
    scenario = scenario_of("infinity", "δ₁ = 5 mm/s", "truth")
    worst = drive([scenario], Several(laws), [SEEDS[0]] * len(laws)).worst_mm
    return worst[1:].reshape(len(MAP_ETAS), len(MAP_EPSILONS)), float(worst[0])


# Figure


def draw(data: Slip) -> Mapping[str, Figure]:
    """Bound, slip beyond η, and the map on the plant."""
    figure = new_figure(12.5, 3.9)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.25))
    draw_bound(data, panels[0])
    draw_beyond(data, panels[1])
    draw_map(data, panels[2], figure)
    return {"slip": figure}


def draw_bound(data: Slip, axes: Any) -> None:
    """|e₁| against ε, slip of the size η."""
    for (eta, pairs), colour, marker in zip(data.inside.items(), COLOURS, MARKERS, strict=False):
        epsilon, error = np.array(pairs).T
        axes.loglog(
            epsilon, error, marker, ls="-", color=colour, ms=4, lw=1.0, label=f"η = {eta:g} mm/s"
        )
    epsilon = np.array(EPSILONS)
    k_1 = law_of(0.0, 0.1).gains.k_1
    axes.loglog(
        epsilon,
        np.sqrt(epsilon / (4 * k_1)),
        ":",
        color=BLACK,
        lw=1.2,
        label=r"$\sqrt{\epsilon/4k_1}$",
    )
    axes.axvline(0.1, color="0.6", lw=0.8, ls="--")
    axes.set_xlabel("$ε$ (mm²/s)")
    axes.set_ylabel("$|e_1|$ left by $δ_1 = η$ (mm)")
    axes.set_title("ideal kinematics, slip of the size $η$", fontsize=9)
    axes.legend(fontsize=7.5, frameon=False)
    tidy(axes)


def draw_beyond(data: Slip, axes: Any) -> None:
    """|e₁| against slip over η."""
    ratio, on, off = np.array(data.beyond).T
    axes.loglog(ratio, off, DASHES[1], color=RED, label="without (21)")
    axes.loglog(ratio, on, "o-", color=BLUE, ms=4, lw=1.0, label="with (21), η = 1.9 mm/s, ε = 0.1")
    axes.axvline(1.0, color="0.6", lw=0.8, ls="--")
    axes.set_xlabel("$δ_1$ over $η$")
    axes.set_ylabel("$|e_1|$ left (mm)")
    axes.set_title("ideal kinematics, slip inside and beyond $η$", fontsize=9)
    axes.legend(fontsize=7.5, frameon=False)
    tidy(axes)


def draw_map(data: Slip, axes: Any, figure: Figure) -> None:
    """RMS error on the plant over η and ε; grey: lost."""
    image = axes.pcolormesh(
        np.log10(MAP_EPSILONS),
        np.arange(len(MAP_ETAS)),
        np.ma.masked_invalid(data.map_mm),
        norm=LogNorm(5, 50),
        cmap="viridis_r",
        shading="nearest",
    )
    axes.set_facecolor("0.8")
    axes.set_yticks(range(len(MAP_ETAS)), [f"{eta:g}" for eta in MAP_ETAS])
    for (row, column), value in np.ndenumerate(data.map_mm):
        text = f"{value:.0f}" if np.isfinite(value) else "lost"
        look = {"fontsize": 6.5, "color": "white" if 20 < value < np.inf else "0.2"}
        axes.text(np.log10(MAP_EPSILONS[column]), row, text, ha="center", va="center", **look)
    axes.plot(-1, 0, "s", mfc="none", color=GREEN, ms=15, mew=2)
    axes.set_xlabel("$\\log_{10} ε$")
    axes.set_ylabel("$η$ (mm/s and rad/s)")
    axes.set_title(
        f"plant, $δ_1$ = 5 mm/s, true pose; without (21): {shown(data.without_mm, 'mm', 2)}",
        fontsize=9,
    )
    figure.colorbar(image, ax=axes, label="RMS error, worst robot (mm)")


def tables(data: Slip) -> tuple[Table, ...]:
    """The runs."""
    rows = tuple(
        (
            f"{TASKS[key.task]}, {key.gains}",
            key.slip,
            "true pose" if key.estimator == "truth" else "EKF",
            median(off),
            median(on),
        )
        for key, (off, on) in data.runs.items()
    )
    title = (
        f"RMS error of the worst robot after 40 % of the run, mm: median of {len(SEEDS)} seeds, control "
        "period 2 ms"
    )
    return (Table(title, ("simulation, gains", "slip", "pose", "without (21)", "with (21)"), rows),)


def median(ends: Ends) -> str:
    """Median of the worst robots' errors, or how many runs are lost."""
    lost = int(ends.lost.sum())
    return f"{lost} of {len(ends.lost)} lost" if lost else f"{np.median(ends.worst_mm):.3g}"


# Claims


def ratio(off: Ends, on: Ends) -> float:
    """Error with the law over that without it; NaN if any run is lost."""
    if off.lost.any() or on.lost.any():
        return math.nan
    return float(np.median(on.worst_mm) / np.median(off.worst_mm))


def _bound(data: Slip) -> Measured:
    k_1 = law_of(0.0, 0.1).gains.k_1
    found = max(
        (error / math.sqrt(epsilon / (4 * k_1)), eta, epsilon)
        for eta, pairs in data.inside.items()
        for epsilon, error in pairs
    )
    return Measured(found[0], f"at η = {found[1]:g} mm/s, ε = {found[2]:.3g} mm²/s")


def _printed_left(data: Slip) -> Measured:
    error = dict(data.inside[0.0019])[0.1]
    k_1 = law_of(0.0, 0.1).gains.k_1
    return Measured(100 * error * k_1 / 0.0019, "(21) adds η²/ε = 3.6e-5 1/s to k₁ = 0.23 1/s")


def _reduced(data: Slip) -> Measured:
    pairs = dict(data.inside[0.0019])
    smallest = min(pairs)
    return Measured(pairs[smallest] / pairs[0.1], f"ε = {smallest:.0e} and 0.1 mm²/s")


def _yaw(data: Slip) -> Measured:
    on, off, formula = data.yaw
    return Measured(100 * on / off, f"{on:.2f} and {off:.2f} mm; k₃δ₂/u₁* = {formula:.2f} mm")


def _plant(gains: str, slip: str) -> Any:
    """Largest ratio of the simulations in which no run is lost."""

    def measure(data: Slip) -> Measured:
        pairs = {task: data.runs[Key(task, gains, slip, "truth")] for task in TASKS}
        ratios = {task: ratio(*pair) for task, pair in pairs.items()}
        known = [100 * value for value in ratios.values() if not math.isnan(value)]
        details = [
            f"{TASKS[task]} {100 * ratios[task]:.1f} %"
            if not math.isnan(ratios[task])
            else f"{TASKS[task]} {median(pairs[task][1])}, without ϱ {median(pairs[task][0])}"
            for task in TASKS
        ]
        return Measured(max(known) if known else math.nan, "; ".join(details))

    return measure


def _best(data: Slip) -> Measured:
    alone = FORWARD_MM_S / law_of(0.0, 0.1).gains.k_1
    row, column = np.unravel_index(np.argmin(data.map_mm), data.map_mm.shape)
    covers = float(data.map_mm[np.array(MAP_ETAS) >= FORWARD_MM_S].min())
    best = float(data.map_mm[row, column])
    return Measured(
        100 * best / alone,
        f"{best:.0f} mm at η = {MAP_ETAS[int(row)]:g}, ε = {MAP_EPSILONS[int(column)]:g}; with η = 20, which "
        f"covers the slip, {covers:.0f} mm at best; δ₁/k₁ = {alone:.0f} mm",
    )


def _kept(data: Slip) -> Measured:
    without = shown(data.without_mm, "mm", 2)
    printed = shown(float(data.map_mm[0, MAP_EPSILONS.index(0.1)]), "mm", 2)
    return Measured(
        float(data.map_mm.min()), f"without ϱ: {without}; with the printed η and ε: {printed}"
    )


SOURCE = "eqs (21), (25), (27)"
CLAIMS: Sequence[Claim] = (
    Claim(
        "bound-forward",
        "Slip within η leaves an error of at most √(ε/4k), forwards",
        SOURCE,
        "≤ 1",
        "largest |e₁| over √(ε/4k₁), constant δ₁ = η, ideal kinematics; at each η it grows with ε, not √ε, up "
        "to ε = η²/k₁",
        "",
        _bound,
        Below(1.001),
        "slip",
    ),
    Claim(
        "bound-reduced",
        "The bound is as small as ε is made",
        "eq. (27)",
        "small",
        "|e₁| with the smallest ε over that with the printed ε, constant δ₁ = η = 0.0019 mm/s",
        "",
        _reduced,
        Below(0.1, 0.5),
        "slip",
    ),
    Claim(
        "printed-forward",
        "ϱ rejects slip of its design size, with the printed η and ε",
        "section VI",
        "efficient",
        "|e₁| left by δ₁ = η over that without ϱ, ideal kinematics",
        "%",
        _printed_left,
        Below(50, 90),
        "slip",
    ),
    Claim(
        "bound-yaw",
        "ϱ rejects constant yaw slip within η",
        SOURCE,
        "rejected",
        "|e₂| left by δ₂ = η = 0.1 rad/s over that without ϱ, straight line, ε = 12: λ does not contain e₂",
        "%",
        _yaw,
        Below(50, 90),
    ),
    Claim(
        "plant-sines-consistent",
        "ϱ is efficient in rejecting slip on the plant, with k₂/k₃ = 0.83 1/s",
        "section VI",
        "efficient",
        "RMS error with ϱ over that without it, sines of 5 mm/s and 0.05 rad/s, true pose",
        "%",
        _plant("consistent", "sines"),
        Below(50, 90),
    ),
    Claim(
        "plant-sines-printed",
        "ϱ is efficient in rejecting slip on the plant, with the printed gains",
        "section VI",
        "efficient",
        "RMS error with ϱ over that without it, sines of 5 mm/s and 0.05 rad/s, true pose",
        "%",
        _plant("printed", "sines"),
        Below(50, 90),
    ),
    Claim(
        "plant-larger-eta",
        "Knowing the bound of the slip is enough to reject it",
        "section VI",
        "rejected",
        "smallest RMS error over all η and ε of the map over δ₁/k₁, δ₁ = 5 mm/s, k₂/k₃ = 0.83 1/s",
        "%",
        _best,
        Below(10, 50),
        "slip",
    ),
    Claim(
        "plant-eta-holds",
        "ϱ with a suitable η keeps robots that slip on ∞, where they are lost without it",
        "section VI",
        "efficient",
        "RMS error of the worst robot with the best η and ε of the map, δ₁ = 5 mm/s, k₂/k₃ = 0.83 1/s",
        "mm",
        _kept,
        Below(20, 100),
        "slip",
    ),
)

PART = Part(
    name="slip",
    title="Eq. (21): the complementary law against slip",
    text=(
        "Left and middle: eq. (17) with (19) and (21) on a straight line at 300 mm/s, constant forward "
        "slip. At rest, inside the layer, (k₁ + η²/ε) e₁ = δ₁. With δ₁ = η its largest value over η is "
        "exactly √(ε/4k₁), at η = √(k₁ε): the bound of (27) holds for e₁. For a given η the error falls "
        "in proportion to ε, and only below ε = η²/k₁. The printed ε is 6000 times as large.",
        "λ contains e₁ and k₃ sin e₃, with one η for both. The slope of (21) is η²/ε forwards and k₃ = "
        "12 000 times as much for the heading. What the heading can bear at a control period T, about "
        "1/T, leaves at most 1/(k₃T) forwards: 0.04 1/s at 2 ms, a sixth of k₁. A constant yaw slip leaves "
        "e₂ = k₃δ₂/u₁* with sin e₃ = 0, where λ does not see it. So (21) hardly rejects slip.",
        "What it does is to damp the heading: it adds η²k₃/ε = 0.43 1/s near e₃ = 0 to k₂/k₃, which is "
        "0.00007 1/s with the printed k₂. On the plant a hundred times the printed η keeps robots that slip "
        "on ∞, which are lost without it (right), with half of δ₁/k₁ at best.",
    ),
    compute=compute,
    draw=draw,
    captions={
        "slip": "Left: forward error against ε for slip of the size η; dashed line: the printed ε. Middle: "
        "slip inside and beyond η. Right: RMS error on ∞ over η and ε; green: the printed values, grey: "
        "lost."
    },
    tables=tables,
    claims=tuple(CLAIMS),
    drives=True,
)
