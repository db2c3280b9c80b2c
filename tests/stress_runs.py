"""Runs of the stress campaign: cases are driven substep by substep, and every substep is audited."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from stress_cases import Case, draw_actions, draw_case, rng_of, throw
from stress_laws import (
    STILL_MM_S,
    Inputs,
    Owed,
    Payload,
    Work,
    audit_all,
    finite,
    inputs_all,
    robot_row,
)

from tlf_env import BatchPlant
from tlf_env.common.presets import preset_names
from tlf_env.disturbances.channels import DEAD_TIME, PATHS
from tlf_env.disturbances.model import patch_rows
from tlf_env.engine import drivers
from tlf_env.numerics.compiled import driver
from tlf_env.numerics.pointers import packed
from tlf_env.numerics.rows import row_reader
from tlf_env.physics.kernel import substep_frame
from tlf_env.physics.parameters import Body
from tlf_env.physics.rolling import rolling
from tlf_env.physics.state import Contact, Floor, Motion, Push
from tlf_env.physics.sweeps import (
    SWEEP_CAP,
    SWEEP_TOLERANCE_MM_S,
    begin_sweeps,
    change_of,
    sweep_on,
)
from tlf_env.task.scenario import Scenario, load_scenario

VARIANTS, LANES, SUBSTEPS = 32, 512, 500  # of a case
THROW_EVERY, THROWN = 40, 0.1  # control steps, and the share of the robots thrown then
COUNT_EVERY = 20  # substeps between two in which all sweeps are counted
PAYLOAD = [PATHS.index(f"payload.{name}") for name in ("mass_kg", "behind_mm", "inertia_kg_mm2")]

# What an audit allows. Each of at most 1000 sweeps takes three tyres' impulses out and puts them back: some
# 12 000 roundings of 1.1e-16, 1.3e-12 if all went one way. An energy has the product of two such numbers, and
# where sweeps do not converge, the impulses in between are larger than those at the ends.
TOLERANCES = {
    "energy": 1e-10,
    "momentum": 1e-10,
    "tyre": 1e-9,
    "joint": 1e-9,
    "gain": 1e-9,
    "place": 1e-12,
    "motors": 1e-9,
    "finite": 0.0,
}

body_of, motion_of, contact_of, floor_of, push_of = (
    row_reader(row, 0) for row in (Body, Motion, Contact, Floor, Push)
)


@driver
def count_sweeps(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    pushes: np.ndarray,
    torques: np.ndarray,
    dt: float,
    counts: np.ndarray,
) -> None:
    """The number of sweeps of each robot's substep, 0 in closed form; arrays ``(field, robot)``."""
    for i in range(counts.shape[0]):
        body, motion, contact = body_of(bodies, i), motion_of(motions, i), contact_of(contacts, i)
        floor, push = floor_of(floors, i), push_of(pushes, i)
        frame = substep_frame(body, motion, contact, floor, push, torques[0, i], torques[1, i], dt)
        rolls, _, _ = rolling(
            body, frame.free, frame.before, frame.cos_p, frame.sin_p, floor, frame.limits
        )
        counts[i] = 0
        if rolls and floor.creep == 0.0:
            continue
        sweep = begin_sweeps(body, frame.free, contact, frame.cos_p, frame.sin_p)
        for k in range(SWEEP_CAP):
            before = sweep
            sweep = sweep_on(
                body, frame.free, frame.cos_p, frame.sin_p, floor, frame.limits, sweep, 1
            )
            counts[i] = k + 1
            if change_of(body, sweep, before) < SWEEP_TOLERANCE_MM_S:
                break


class Moment(NamedTuple):
    """One substep of all robots, flat: (field, robot · lanes + lane)."""

    before: np.ndarray  # Motion
    after: np.ndarray
    last: np.ndarray  # Contact
    given: np.ndarray
    delivered: np.ndarray  # torques, mN·mm
    commanded: np.ndarray
    channels: np.ndarray


TORQUES = [10, 11]  # of Trace


def flat(plant: BatchPlant, name: str) -> np.ndarray:
    """A copy of a row, without unused lanes."""
    rows = plant.arrays.rows(name)[:, :, : plant.formations]
    return rows.reshape(rows.shape[0], -1).copy()


def loaded(case: Case) -> list[Scenario]:
    """The case's scenarios."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [
            load_scenario(one["scenario"], **{k: v for k, v in one.items() if k != "scenario"})
            for one in case.scenarios
        ]


class Substeps:
    """A batch plant that is advanced substep by substep, with the drivers that a plant in Python uses."""

    def __init__(self, plant: BatchPlant) -> None:
        self.plant = plant
        self.nothing = plant._nothing
        self.settings = plant._settings
        self.taking = packed(plant._settings._replace(has_parts=True))
        self.all_lanes = np.arange(plant.formations)

    def moment(self, before: np.ndarray, last: np.ndarray) -> Moment:
        """What the last substep was."""
        applied = self.plant.arrays.applied[:, :, : self.plant.formations]
        return Moment(
            before=before,
            after=flat(self.plant, "motion"),
            last=last,
            given=flat(self.plant, "contact"),
            delivered=flat(self.plant, "trace")[TORQUES],
            commanded=flat(self.plant, "commanded"),
            channels=applied.reshape(applied.shape[0], -1).copy(),
        )

    def step(self, actions: np.ndarray) -> Iterator[Moment]:
        """A control step; yields after each substep."""
        plant, s = self.plant, self.settings
        if s.substeps == 1:
            before, last = flat(plant, "motion"), flat(plant, "contact")
            plant.step(actions)
            yield self.moment(before, last)
            return
        given = plant._given()
        plant.arrays.actions[:] = actions
        for lane in range(plant.formations):
            left = drivers.lanes_to_step(lane, lane + 1)
            result = drivers.control_step(given, left, self.nothing, drivers.WHOLE, 0, self.taking)
            assert result == drivers.MUST_SUBSTEP, result
        for k in range(s.substeps):
            before, last = flat(plant, "motion"), flat(plant, "contact")
            # The sums begin at 0 in each substep, so that what one adds is known without rounding.
            sums = plant.arrays.rows("trace")[TORQUES[0] : TORQUES[-1] + 1]
            already = sums.copy()
            sums[:] = 0.0
            self.do(drivers.ACTUATE, k)
            moment = self.moment(before, last)
            sums += already
            self.do(drivers.SENSE, k)
            yield moment._replace(commanded=flat(plant, "commanded"))
        for part in (drivers.TRANSMIT, drivers.LOOK):
            self.do(part, plant.scenario.robot_count)

    def do(self, part: int, number: int) -> None:
        """A part of a control step, of all lanes."""
        plant = self.plant
        drivers.control_step(
            plant._given(), self.all_lanes, self.nothing, part, number, plant._packed
        )


class Finding(NamedTuple):
    """A law that a substep breaks: where, by how much, and what may be broken at most."""

    case: int
    law: str
    spread: str
    robot: int
    lane: int
    substep: int
    size: float
    allowed: float


MOST_FINDINGS = 20  # of a law in a case
ALLOWED = np.array([*TOLERANCES.values(), np.inf, np.inf])
LARGE_MM_S = 0.01  # more than ordinary runs ever have (docs/physics.md)
LONGEST_DEAD_S = 0.1
DECADES = (1e-9, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)  # of residual slip, mm/s


class Tally:
    """Counts and largest residuals, by class of robots; a plain tree of numbers, so that tallies add up."""

    def __init__(self) -> None:
        self.counts: dict[str, float] = {}
        self.largest: dict[str, list[Any]] = {}
        self.findings: list[Finding] = []

    def count(self, name: str, number: float) -> None:
        """Add to a count."""
        self.counts[name] = self.counts.get(name, 0) + float(number)

    def most(self, name: str, size: float, case: int) -> None:
        """Keep the largest of a residual, and the case in which it was."""
        if not size <= self.largest.get(name, [-1.0])[0]:
            self.largest[name] = [float(size), case]

    def add(self, other: Tally) -> None:
        """Add another tally to this."""
        for name, number in other.counts.items():
            self.count(name, number)
        for name, (size, case) in other.largest.items():
            self.most(name, size, case)
        self.findings += other.findings

    def as_json(self) -> dict[str, Any]:
        """For a file."""
        return {
            "counts": dict(sorted(self.counts.items())),
            "largest": dict(sorted(self.largest.items())),
            "findings": [one._asdict() for one in self.findings],
        }

    @classmethod
    def of_json(cls, tree: dict[str, Any]) -> Tally:
        """From a file."""
        made = cls()
        made.counts, made.largest = dict(tree["counts"]), dict(tree["largest"])
        made.findings = [Finding(**one) for one in tree["findings"]]
        return made


class Audit:
    """The audit of one case on a batch plant."""

    def __init__(self, case: Case, plant: BatchPlant) -> None:
        self.case, self.plant, self.tally = case, plant, Tally()
        scenarios = plant.scenarios
        lanes, robots = plant.formations, plant.scenario.robot_count
        at = plant.scenario_numbers
        channels = plant.arrays.applied[:, :, :lanes].reshape(len(PATHS), -1)
        models = [
            scenarios[at[lane]].robot_models[i] for i in range(robots) for lane in range(lanes)
        ]
        rows = [
            robot_row(model, Payload(*payload))
            for model, payload in zip(models, channels[PAYLOAD].T.tolist(), strict=True)
        ]
        self.robots = np.ascontiguousarray(np.array(rows).T)
        self.classes = sorted(set(case.spreads))
        self.codes = np.tile(
            np.array([self.classes.index(one) for one in case.spreads])[at], robots
        )
        self.order = np.argsort(self.codes, kind="stable")
        self.firsts = np.searchsorted(self.codes[self.order], np.arange(len(self.classes)))
        patches = [patch_rows(one.disturbance, one.world.patches) for one in scenarios]
        most = max(len(one) for one in patches)
        nowhere = np.tile([np.inf, 0.0, 0.0, 1.0], (len(patches), most, 1))
        for place, some in zip(nowhere, patches, strict=True):
            place[: len(some)] = some
        self.patches = np.ascontiguousarray(np.tile(nowhere[at], (robots, 1, 1)))
        number = len(models)
        self.inputs, self.works, self.owed = (
            np.zeros((len(row._fields), number)) for row in (Inputs, Work, Owed)
        )
        self.dt = plant.scenario.physics_period_s
        self.dts, self.motors = np.full(number, self.dt), np.zeros(number)
        self.commands: dict[int, np.ndarray] = {}
        self.substep = 0
        self.work = np.zeros((len(Work._fields), len(self.codes)))
        self.bodies = flat(plant, "body")

    def note(self, names: Sequence[str], sizes: np.ndarray, allowed: np.ndarray) -> None:
        """Keep the largest of residuals (name, robot) by class, and all that are too large; NaN is."""
        sizes = np.where(np.isnan(sizes), np.inf, sizes)
        for name, row in zip(names, self.by_class(np.maximum, sizes), strict=True):
            for spread, size in zip(self.classes, row, strict=True):
                self.tally.most(f"{name}/{spread}", size, self.case.number)
        wrong = np.argwhere(sizes > allowed[:, None])
        for law, i in wrong.tolist():
            self.tally.count(f"findings/{names[law]}", 1)
            if len(self.tally.findings) < MOST_FINDINGS:
                robot, lane = divmod(i, self.plant.formations)
                self.tally.findings.append(
                    Finding(
                        self.case.number, names[law], self.classes[self.codes[i]], robot, lane,
                        self.substep, float(sizes[law, i]), float(allowed[law]),
                    )
                )  # fmt: skip

    def by_class(self, ufunc: np.ufunc, values: np.ndarray) -> np.ndarray:
        """Sum or maximum over the robots of each class; the last axis is that of the robots."""
        return ufunc.reduceat(values[..., self.order], self.firsts, axis=-1)

    def take(self, moment: Moment) -> Owed:
        """Audit a substep."""
        inputs_all(
            self.robots, moment.before, moment.delivered, self.due(moment), moment.channels, self.patches,
            self.inputs, self.motors,
        )  # fmt: skip
        audit_all(
            self.robots, moment.before, moment.after, moment.last, moment.given, self.inputs, self.dts,
            self.works, self.owed,
        )  # fmt: skip
        owed = Owed(*self.owed)
        residual = np.maximum(owed.slip, owed.turn)
        # Where the sweeps have not converged, what friction adds is only counted.
        open_gain = np.where(residual > STILL_MM_S, owed.gain, 0.0)
        self.tally.count("gains not converged", (open_gain > TOLERANCES["gain"]).sum())
        owed.gain[residual > STILL_MM_S] = 0.0
        names = [*TOLERANCES, "gain not converged", "residual mm/s"]
        laws = [self.motors if law == "motors" else getattr(owed, law) for law in TOLERANCES]
        sizes = np.array([*laws, open_gain, residual])
        self.note(names, sizes, ALLOWED)
        self.count_residuals(moment, owed, residual)
        self.work += self.works
        self.tally.count("substeps", len(residual))
        self.substep += 1
        return owed

    def due(self, moment: Moment) -> np.ndarray:
        """The torques that were commanded one dead time ago, 0 before that."""
        self.commands[self.substep] = moment.commanded
        then = self.substep - np.rint(moment.channels[DEAD_TIME] / self.dt).astype(int)
        past = np.zeros_like(moment.commanded)
        for k in np.unique(then[then >= 0]).tolist():
            past[:, then == k] = self.commands[k][:, then == k]
        self.commands.pop(self.substep - round(LONGEST_DEAD_S / self.dt) - 1, None)
        return past

    def count_residuals(self, moment: Moment, owed: Owed, residual: np.ndarray) -> None:
        """Residuals of the sweeps by class; and how many sweeps there were, in some of the substeps."""
        tally = self.tally
        rows = [np.ones_like(residual), owed.slides, *(residual > decade for decade in DECADES)]
        names = ["substeps", "sliding", *(f"residual above {decade:g} mm/s" for decade in DECADES)]
        sums = self.by_class(np.add, np.array(rows, dtype=np.float64))
        for k, spread in enumerate(self.classes):
            for name, row in zip(names, sums, strict=True):
                tally.count(f"{name}/{spread}", row[k])
        who = np.arange(len(residual))
        sampled = self.substep % COUNT_EVERY == 0
        if not sampled:
            who = np.flatnonzero(residual > LARGE_MM_S)[:16]
        if not len(who):
            return
        counts = self.sweeps_of(moment, who)
        capped = counts >= SWEEP_CAP
        large = residual[who] > LARGE_MM_S
        for k, spread in enumerate(self.classes):
            of_class = self.codes[who] == k
            if sampled:
                tally.count(f"sampled/{spread}", of_class.sum())
                tally.count(f"sampled sweeps/{spread}", counts[of_class].sum())
                tally.count(f"sampled swept/{spread}", (counts[of_class] > 0).sum())
                tally.count(f"sampled capped/{spread}", (of_class & capped).sum())
                tally.count(f"sampled ended early/{spread}", (of_class & large & ~capped).sum())
            for name, some in (("capped", of_class & capped), ("ended early", of_class & ~capped)):
                if some.any():
                    most = residual[who][some].max()
                    tally.most(f"{name}: residual mm/s/{spread}", most, self.case.number)
            if (of_class & ~capped).any():
                tally.most(f"sweeps/{spread}", counts[of_class & ~capped].max(), self.case.number)

    def sweeps_of(self, moment: Moment, who: np.ndarray) -> np.ndarray:
        """The number of sweeps of some robots' substep; 0 in closed form."""
        u = Inputs(*self.inputs[:, who])
        floors = np.array([u.belt_l, u.belt_r, u.grip_l, u.grip_r, u.grip_c, u.rolling, u.creep])
        pushes = np.array([u.push_x + u.slope_x, u.push_y + u.slope_y, u.push_w])
        counts = np.zeros(len(who), dtype=np.int64)
        rows = [self.bodies, moment.before, moment.last]
        states = [np.ascontiguousarray(row[:, who]) for row in rows]
        torques = np.ascontiguousarray(moment.delivered[:, who])
        count_sweeps(*states, floors, pushes, torques, self.dt, counts)
        return counts

    def look(self) -> None:
        """Everything that interfaces read must be finite."""
        plant = self.plant
        read = (plant.observations, plant.rewards, plant.terms, plant.infos, plant.state())
        bad = np.zeros((plant.formations, plant.scenario.robot_count), dtype=bool)
        if not finite(read):
            for one in read:
                bad |= ~np.isfinite(one).reshape(*bad.shape, -1).all(axis=-1)
        self.note(["finite results"], bad.T.reshape(1, -1).astype(float), np.zeros(1))

    def close(self) -> None:
        """The sums of the works by source over the whole case."""
        for name, row in zip(Work._fields, self.work, strict=True):
            self.tally.count(f"work µJ/{name}", row.sum())
        options = self.case.scenarios[0]
        number = self.tally.counts.get("substeps", 0)
        for key in ("action", "estimator", "observation", "physics_period_s", "robots"):
            value = options[key] if key != "robots" else len(options["robots"])
            self.tally.count(f"option/{key}/{value}", number)
        per_step = round(options["control_period_s"] / options["physics_period_s"])
        self.tally.count(f"option/substeps a control step/{per_step}", number)
        for spread, one in zip(self.case.spreads, self.case.scenarios, strict=True):
            share = number / len(self.case.spreads)
            for group, signals in one["disturbance"].items():
                for name, signal in signals.items():
                    self.tally.count(f"option/{group}.{name}", share)
                    if isinstance(signal, dict):
                        self.tally.count(f"option/signal/{signal['type']}", share)
            self.tally.count(f"option/robots/{spread}", share)


def run_case(
    number: int,
    *,
    variants: int = VARIANTS,
    lanes: int = LANES,
    substeps: int = SUBSTEPS,
    moments: Any = None,
) -> Tally:
    """Run a case on the plant ``batch`` and audit every substep.

    ``moments`` is called with the audit, each substep, and what it owes.
    """
    case = draw_case(number, variants, substeps)
    rng = rng_of(number).spawn(1)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plant = BatchPlant(loaded(case), lanes, end_on=())
    plant.reset(seed=int(rng.integers(2**31)))
    audited, stepped = Audit(case, plant), Substeps(plant)
    actions = np.zeros(plant.arrays.actions.shape)
    for step in range(case.steps):
        if case.thrown and step % THROW_EVERY == 0:
            throw(rng, plant.arrays.rows("motion")[:, :, :lanes], 0.7 if step == 0 else THROWN)
        actions = draw_actions(rng, actions.shape, actions)
        for moment in stepped.step(actions.astype(plant.arrays.actions.dtype)):
            owed = audited.take(moment)
            if moments is not None:
                moments(audited, moment, owed)
        audited.look()
    audited.close()
    return audited.tally


def preset_case(number: int, lanes: int = 32, steps: int = 60) -> Tally:
    """Run a preset of a disturbance in the closed loop of a task, from its start: ordinary scenarios."""
    names = preset_names("disturbance")
    task, name = ("infinity", "flower")[number // len(names) % 2], names[number % len(names)]
    options = {"disturbance": name, "action": "residual", "end_on": ()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plant = BatchPlant(load_scenario(task, **options), lanes)
    plant.reset(seed=number)
    case = Case(number, [], ["default"], False, steps)
    audited, stepped = Audit(case, plant), Substeps(plant)
    for _ in range(steps):
        for moment in stepped.step(np.zeros(plant.arrays.actions.shape)):
            audited.take(moment)
        audited.look()
    return audited.tally
