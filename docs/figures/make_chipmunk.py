"""Write the tables and the figure of ``docs/chipmunk.md``: pymunk's constraints beside the exact kernel.

``python docs/figures/make_chipmunk.py`` takes about fifteen minutes and needs the extra ``figures``.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pymunk
from make_board import DOCS, ROOT, with_part, write_text
from matplotlib.figure import Figure

from baselines import ReferencePolicy
from baselines.runs.run import Record, run_policy
from baselines.runs.style import GREY, METADATA, hex_colour, tidy
from tlf_env.common.files import atomic
from tlf_env.engine.formation import Formation
from tlf_env.physics import chipmunk_plant
from tlf_env.physics.chipmunk_plant import ChipmunkPlant, RobotBodies, pin, slips_of
from tlf_env.physics.friction_limits import friction_limits
from tlf_env.physics.openloop import (
    advance_chipmunk,
    advance_open_loop,
    load_scenarios,
    run_open_loop,
)
from tlf_env.physics.parameters import Body, RobotParameters, body_array
from tlf_env.physics.state import Contact, Floor, Motion
from tlf_env.physics.sweeps import Slips
from tlf_env.task.scenario import load_scenario

GOLDEN = ROOT / "tests" / "golden"
SCENARIOS = load_scenarios(GOLDEN / "scenarios.json")
NAMES = ("straight", "straight_nojf", "coast", "skid", "spin")
STEPS_S = (0.002, 0.001, 0.0005, 0.00025, 0.0001)
ITERATIONS = (5, 10, 20, 50, 100, 200)
ROBOT = RobotParameters()
SKIDS, SKID_S, JUMP_S, LARGEST_NMM = 20, 2.0, 0.05, 20.0
EXACT_STEP_S = 0.0001
RUN_S, SLIP_SEEDS = 30.0, range(20_000, 20_005)
TASKS = {"infinity": "∞", "flower": "flower"}
GENTLE: dict[str, Any] = {
    "`none`": "none",
    "`nominal`": "nominal",
    "$\\delta_1$ = 5 mm/s": {"slip": {"delta_1_mm_s": 5.0}},
}
TIMED_STEPS, TIMINGS = 100, 7
NEAR_REST_MM_S = 0.001
FIGURE = DOCS / "figures" / "chipmunk.svg"


class Error(NamedTuple):
    """Largest difference between two runs."""

    share: float  # of the position, of the path's length
    heading_rad: float


def difference(wanted: np.ndarray, got: np.ndarray) -> Error:
    """Of rows as :func:`run_open_loop` gives them."""
    path = np.hypot(*np.diff(wanted[:, 1:3], axis=0).T).sum()
    off = got - wanted
    return Error(float(np.hypot(*off[:, 1:3].T).max() / path), float(np.abs(off[:, 3]).max()))


def golden(name: str) -> np.ndarray:
    """A golden run."""
    return np.loadtxt(GOLDEN / f"{name}.csv", delimiter=",", skiprows=1)


# --- other ways to make the robot ----------------------------------------------------------------------


class OneJointPerTyre(RobotBodies):
    """A tyre is one pivot joint with a limit: Chipmunk then shortens the impulse, whatever the slip."""

    tyre_count = 3
    rim_mm = 0.0

    def tyres(self) -> list[pymunk.Constraint]:
        """Left, right, castor."""
        r, (left, right, castor) = self.robot, self.spins
        joints = [
            pymunk.PivotJoint(self.chassis, left, (-r.h, r.d), (r.R, 0.0)),
            pymunk.PivotJoint(self.chassis, right, (r.h, r.d), (r.R, 0.0)),
            pymunk.PivotJoint(self.fork, castor, (0.0, -r.T), (r.R_c, 0.0)),
        ]
        for joint in joints:
            joint.max_bias = 0.0
        return joints


class OneJointPlant(ChipmunkPlant):
    """The robot of :class:`OneJointPerTyre`."""

    kind = OneJointPerTyre

    def _limit(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        jumps: np.ndarray,
        dt: float,
    ) -> None:
        most, _ = limits_now(self, motions, contacts, floors, dt)
        self._limits[:, 0] = np.array(most) / dt

    def _record(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        spins: np.ndarray,
        dt: float,
    ) -> None:
        r, motion = Body(*self._constants[:, 0]), Motion(*motions[:, 0, 0])
        left, right, castor, q_l, q_r, q_c, q_s = self._impulses[:, 0].tolist()
        along = [
            (np.copysign(q, -omega) - r.J * (omega - free)) / r.R if omega else 0.0
            for q, omega, free in zip(
                (q_l, q_r), (motion.omega_l, motion.omega_r), spins[:, 0], strict=True
            )
        ]
        p_lf, p_rf = (
            float(np.clip(one, -most, most)) for one, most in zip(along, (left, right), strict=True)
        )
        slips, _, _ = slips_of(r, motion, Floor(*floors[:, 0, 0]))
        contacts[:, 0, 0] = Contact(
            p_le=float(np.sqrt(left**2 - p_lf**2)),
            p_lf=p_lf,
            p_re=float(np.sqrt(right**2 - p_rf**2)),
            p_rf=p_rf,
            p_cx=castor,
            p_cy=0.0,
            q_l=q_l,
            q_r=q_r,
            q_c=q_c,
            q_s=q_s,
            slip_l=float(np.hypot(slips.e, slips.lf)),
            slip_r=float(np.hypot(slips.e, slips.rf)),
            slip_c=float(np.hypot(slips.cx, slips.cy)),
        )


class LastSlipPlant(ChipmunkPlant):
    """A sliding tyre's limits follow the direction of the last slip alone; a sticking one's are equal."""

    def _limit(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        jumps: np.ndarray,
        dt: float,
    ) -> None:
        most, s = limits_now(self, motions, contacts, floors, dt)
        pairs = [
            parts(circle, *slip)
            for circle, slip in zip(most[:3], ((s.e, s.lf), (s.e, s.rf), (s.cx, s.cy)), strict=True)
        ]
        (e_l, f_l), (e_r, f_r), (x, y) = pairs
        self._limits[:, 0] = np.array([e_l + e_r, f_l, f_r, x, y, *most[3:]]) / dt


class NoJumpPlant(ChipmunkPlant):
    """The motors' next torques are not used."""

    def _limit(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        jumps: np.ndarray,
        dt: float,
    ) -> None:
        super()._limit(motions, contacts, floors, np.zeros_like(jumps), dt)


class TwoAlongTheAxle(RobotBodies):
    """Each drive wheel has a lateral constraint of its own."""

    tyre_count = 6

    def tyres(self) -> list[pymunk.Constraint]:
        """As usual, and the right wheel's lateral one at the end."""
        arm, r = chipmunk_plant.ARM_MM, self.robot
        return [*super().tyres(), pin(self.frame, self.chassis, (-arm, r.d), (0.0, r.d))]


class UnsharedPlant(ChipmunkPlant):
    """Which of the two lateral constraints has the force is left to the order in which they are solved."""

    kind = TwoAlongTheAxle

    def _limit(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        jumps: np.ndarray,
        dt: float,
    ) -> None:
        all_limits, self._limits = self._limits, np.zeros((9, 1))
        super()._limit(motions, contacts, floors, jumps, dt)
        both, self._limits = self._limits, all_limits
        self._limits[:, 0] = [both[0, 0] / 2, *both[1:5, 0], both[0, 0] / 2, *both[5:, 0]]

    def _record(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        spins: np.ndarray,
        dt: float,
    ) -> None:
        impulses = self._impulses
        left, right = float(impulses[0, 0]), float(impulses[5, 0])
        self._impulses = np.delete(impulses, 5, axis=0)
        super()._record(motions, contacts, floors, spins, dt)
        self._impulses = impulses
        contacts[Contact._fields.index("p_le"), 0, 0] = left
        contacts[Contact._fields.index("p_re"), 0, 0] = right


class KeptPlant(ChipmunkPlant):
    """All constraints are made once, and remember their impulses during the whole run."""

    def sort(self, motions: np.ndarray, step: int = 0) -> None:
        """Only once."""
        if not self._robots[0].constraints:
            super().sort(motions, step)

    def release(self) -> None:
        """Never."""


def parts(circle: float, s_1: float, s_2: float) -> tuple[float, float]:
    """Components of a friction limit along a slip, or the same for both if there is none."""
    size = float(np.hypot(s_1, s_2))
    if size < NEAR_REST_MM_S:
        return circle * np.sqrt(0.5), circle * np.sqrt(0.5)
    return circle * abs(s_1) / size, circle * abs(s_2) / size


def limits_now(
    plant: ChipmunkPlant,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    dt: float,
) -> tuple[tuple[float, ...], Slips]:
    """The kernel's limits of friction of a lone robot (tyres, axles, steering), and its tyres' slips."""
    r, motion = Body(*plant._constants[:, 0]), Motion(*motions[:, 0, 0])
    floor = Floor(*floors[:, 0, 0])
    most = friction_limits(r, motion, Contact(*contacts[:, 0, 0]), floor, dt)
    return most[:LIMITS], slips_of(r, motion, floor)[0]


LIMITS = 7  # of FrictionLimits: three tyres, three axles, the steering; its compliances follow
Make = Callable[[RobotParameters], ChipmunkPlant]
VARIANTS: dict[str, Make] = {
    "the plant `chipmunk`": lambda robot: ChipmunkPlant([robot]),
    "one joint with a limit for each tyre": lambda robot: OneJointPlant([robot]),
    "limits by the direction of the last slip alone": lambda robot: LastSlipPlant([robot]),
    "the next torques not used in the estimate": lambda robot: NoJumpPlant([robot]),
    "a lateral constraint for each drive wheel": lambda robot: UnsharedPlant([robot]),
    "constraints that keep their memory": lambda robot: KeptPlant([robot]),
    "10 iterations": lambda robot: ChipmunkPlant([robot], iterations=10),
    "500 iterations": lambda robot: ChipmunkPlant([robot], iterations=500),
}


# --- runs ----------------------------------------------------------------------------------------------


def open_loop(name: str, make: Make, dt_s: float = 0.001) -> np.ndarray:
    """A golden run by some plant."""
    return run_open_loop(SCENARIOS[name], dt_s=dt_s, plant=make)


class Skid(NamedTuple):
    """A start at which all wheels slide, and torques that jump."""

    start: Motion
    levels_Nmm: np.ndarray  # (jump, wheel)


def skids() -> list[Skid]:
    """Random ones."""
    rng = np.random.default_rng(0)
    made = []
    for _ in range(SKIDS):
        theta, psi = rng.uniform(-4, 4, 2)
        speeds = rng.normal(size=7) * [300, 300, 2, 5, 10, 10, 20]
        levels = rng.uniform(-LARGEST_NMM, LARGEST_NMM, (round(SKID_S / JUMP_S), 2))
        made.append(Skid(Motion(0.0, 0.0, theta, psi, *speeds, 0.0, 0.0), levels))
    return made


def course(skid: Skid, dt_s: float, make: Make | None) -> np.ndarray:
    """Rows (time, x, y, θ) every 50 ms; by the exact kernel if there is no plant to make."""
    motions = np.array(skid.start).reshape(-1, 1, 1).copy()
    contacts, bodies = np.zeros((len(Contact._fields), 1, 1)), body_array([ROBOT])
    plant, rows = make(ROBOT) if make else None, [(0.0, *motions[:3, 0, 0])]
    for k, level in enumerate(skid.levels_Nmm):
        torques = np.repeat(1000.0 * level[None], round(JUMP_S / dt_s), axis=0)
        if plant is None:
            advance_open_loop(bodies, motions, contacts, torques, np.zeros(3), dt_s)
        else:
            advance_chipmunk(plant, motions, contacts, torques, dt_s)
        rows.append(((k + 1) * JUMP_S, *motions[:3, 0, 0]))
    return np.array(rows)


def closed_loop(trajectory: str, disturbance: Any, plant: str, seed: int) -> Record:
    """A run of the paper's controller."""
    scenario = load_scenario(
        trajectory,
        disturbance=disturbance,
        plant=plant,
        estimator="ekf",
        broadcast_smoothing_s=0.0,
        horizon_s=RUN_S,
    )
    return run_policy(scenario, ReferencePolicy("consistent"), seed)


def time_of_a_step(plant: str) -> float:
    """Median processor time of a control step of three robots on ∞, µs."""
    formation = Formation(
        load_scenario("infinity", plant=plant, disturbance="none", end_on=(), horizon_s=60.0)
    )
    formation.reset(0)
    formation.arrays.actions[:] = 0.3, 0.1
    formation.step()
    found = []
    for _ in range(TIMINGS):
        begin = time.process_time()
        for _ in range(TIMED_STEPS):
            formation.step()
        found.append((time.process_time() - begin) / TIMED_STEPS * 1e6)
    return statistics.median(found)


# --- tables ----------------------------------------------------------------------------------------------


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table; the first column is text."""
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join(lines + [f"| {' | '.join(row)} |" for row in rows])


def percent(share: float) -> str:
    """Two significant digits."""
    return f"{100 * share:.2g} %"


def golden_table() -> str:
    """Every golden run at 1 ms, by both."""
    rows = []
    for name in NAMES:
        wanted = golden(name)
        kernel = difference(wanted, run_open_loop(SCENARIOS[name]))
        made = difference(wanted, run_open_loop(SCENARIOS[name], plant="chipmunk"))
        cells = [percent(kernel.share), percent(made.share)]
        cells += [f"{kernel.heading_rad:.4f}", f"{made.heading_rad:.4f}"]
        rows.append([f"`{name}`", *cells])
    head = ["run", "position: kernel", "`chipmunk`", "heading, rad: kernel", "`chipmunk`"]
    return table(head, rows)


def step_table() -> str:
    """Position error of every golden run against the substep; the kernel's in brackets."""
    rows = []
    for name in NAMES:
        wanted, cells = golden(name), []
        for dt_s in STEPS_S:
            made = difference(wanted, run_open_loop(SCENARIOS[name], dt_s=dt_s, plant="chipmunk"))
            kernel = difference(wanted, run_open_loop(SCENARIOS[name], dt_s=dt_s))
            cells.append(f"{percent(made.share)} ({percent(kernel.share)})")
        rows.append([f"`{name}`", *cells])
    return table(["run", *(f"{1000 * dt_s:g} ms" for dt_s in STEPS_S)], rows)


def iteration_table() -> str:
    """Errors at 1 ms against the iterations, and what moves below the torque at which the robot starts."""
    rows = []
    for iterations in ITERATIONS:

        def make(robot: RobotParameters, iterations: int = iterations) -> ChipmunkPlant:
            return ChipmunkPlant([robot], iterations=iterations)

        cells = [percent(difference(golden(n), open_loop(n, make)).share) for n in NAMES[2:]]
        plant, motions = make(ROBOT), np.zeros((len(Motion._fields), 1, 1))
        contacts, torques = np.zeros((len(Contact._fields), 1, 1)), np.full((20, 2), 7200.0)
        for _ in range(50):
            advance_chipmunk(plant, motions, contacts, torques, 0.001)
        rows.append([str(iterations), *cells, f"{abs(motions[1, 0, 0]):.4f} mm"])
    return table(["iterations", *(f"`{name}`" for name in NAMES[2:]), "creep"], rows)


def variant_table() -> str:
    """Ways to make the robot: errors in golden runs, and in random skids."""
    made = skids()
    exact = [course(skid, EXACT_STEP_S, None) for skid in made]
    rows = []
    for name, make in {"exact kernel": None, **VARIANTS}.items():
        cells = []
        for run in ("coast", "skid", "spin"):
            got = run_open_loop(SCENARIOS[run]) if make is None else open_loop(run, make)
            error = difference(golden(run), got)
            cells.append(f"{percent(error.share)}, {error.heading_rad:.3f}")
        errors = [
            difference(wanted, course(skid, 0.001, make))
            for skid, wanted in zip(made, exact, strict=True)
        ]
        shares, headings = np.transpose(errors)
        cells.append(f"{percent(np.median(shares))}, {np.median(headings):.3f}")
        cells.append(f"{percent(shares.max())}, {headings.max():.3f}")
        rows.append([name, *cells])
        print(rows[-1], flush=True)
    head = ["robot made of", "`coast`", "`skid`", "`spin`", "skids: median", "skids: largest"]
    return table(head, rows)


def closed_loop_table() -> str:
    """Runs of the paper's controller: how far apart, and the RMS errors of the robots."""
    rows = []
    for trajectory, shown in TASKS.items():
        for name, disturbance in GENTLE.items():
            kernel = closed_loop(trajectory, disturbance, "pymunk", SLIP_SEEDS[0])
            made = closed_loop(trajectory, disturbance, "chipmunk", SLIP_SEEDS[0])
            apart = np.hypot(kernel["x_mm"] - made["x_mm"], kernel["y_mm"] - made["y_mm"])
            cells = [f"{apart.max():.2f}"]
            for record in (kernel, made):
                rms = [one.position_rmse_mm for one in record.metrics()]
                cells.append(", ".join(f"{one:.2f}" for one in rms))
            rows.append([f"{shown}, {name}", *cells])
            print(rows[-1], flush=True)
    head = ["task", "apart at most, mm", "RMS of each robot, mm: kernel", "`chipmunk`"]
    return table(head, rows)


def slip_table() -> str:
    """Runs with injected slip: the leader's error for each seed, and how many robots are lost."""
    rows = []
    for trajectory, shown in TASKS.items():
        for plant in ("pymunk", "chipmunk"):
            runs = [closed_loop(trajectory, "slip", plant, seed) for seed in SLIP_SEEDS]
            leaders = [run.metrics()[0].position_rmse_mm for run in runs]
            lost = sum(int(np.isfinite(run.lost_at_s).sum()) for run in runs)
            robots = sum(run.robots for run in runs)
            name = "exact kernel" if plant == "pymunk" else f"`{plant}`"
            rows.append(
                [
                    f"{shown}, {name}",
                    ", ".join(f"{one:.0f}" for one in leaders),
                    f"{lost} of {robots}",
                ]
            )
            print(rows[-1], flush=True)
    head = ["task and plant", "leader's RMS, mm, by seed", "robots lost"]
    return table(head, rows)


def speed_table() -> str:
    """Time of a control step of three robots on each plant."""
    plants = ("pymunk", "batch", "kinematic", "chipmunk")
    rows = [[f"`{plant}`", f"{time_of_a_step(plant):.0f} µs"] for plant in plants]
    return table(["plant", "processor time of a control step of 20 ms, three robots"], rows)


# --- figure ----------------------------------------------------------------------------------------------


def draw() -> None:
    """Paths of `skid` and `spin`."""
    mpl.rcParams["svg.hashsalt"] = "tlf_env"
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    radial = VARIANTS["one joint with a limit for each tyre"]
    for axes, name in zip(figure.subplots(1, 2), ("skid", "spin"), strict=True):
        wanted = golden(name)
        kernel = run_open_loop(SCENARIOS[name])
        made = run_open_loop(SCENARIOS[name], plant="chipmunk")
        other = open_loop(name, radial)
        axes.plot(*other[:, 1:3].T, color=GREY, lw=1.2, ls=":", label="one joint for each tyre")
        axes.plot(*kernel[:, 1:3].T, color=hex_colour(0, 3), lw=3.0, alpha=0.5, label="kernel")
        axes.plot(*made[:, 1:3].T, color=hex_colour(1, 3), lw=1.2, label="chipmunk")
        axes.plot(*wanted[::4, 1:3].T, "o", ms=3.5, mfc="none", color="black", label="golden run")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x, mm")
        axes.set_ylabel("y, mm")
        axes.set_title(name)
        tidy(axes)
    figure.axes[0].legend(frameon=False, fontsize=9)
    with atomic(FIGURE, "wb") as file:
        figure.savefig(file, format="svg", metadata=METADATA["svg"], facecolor="white")


TABLES: dict[str, Callable[[], str]] = {
    "golden": golden_table,
    "substep": step_table,
    "iterations": iteration_table,
    "variants": variant_table,
    "loop": closed_loop_table,
    "slip": slip_table,
    "speed": speed_table,
}


def main() -> None:
    """Write everything."""
    draw()
    page = DOCS / "chipmunk.md"
    for name, make in TABLES.items():
        made = make()
        print(f"{name}\n{made}", flush=True)
        text = page.read_text("utf-8")
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        write_text(page, with_part(text, made, begin, end, page.name))


if __name__ == "__main__":
    main()
