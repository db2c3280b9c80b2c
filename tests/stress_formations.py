"""Runs of the stress campaign on the plants with a pymunk space: ``chipmunk``, and ``pymunk`` in contact."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from stress_cases import Case, draw_actions, draw_case, draw_patch, rng_of, throw
from stress_laws import STILL_MM_S, Inputs, Owed, Payload, Robot, Work, audit_all, robot_row
from stress_runs import ALLOWED, PAYLOAD, TOLERANCES, Finding, Tally

from tlf_env.engine.formation import Formation
from tlf_env.physics.state import Contact, Floor, Motion
from tlf_env.task.scenario import Scenario, load_scenario

SUBSTEPS = 400  # of a case
THROW_EVERY = 40  # control steps
WALL_MM = 160.0  # of a wall beside the start, from the robots' axis
# What contact may add to the energy in a substep. By default robots neither bounce nor rub. Where they do,
# Chipmunk applies Newton's law of restitution to several contacts at once, which can add some: it is counted.
GAINS = {"as by default": 1e-9, "bouncing and rubbing": np.inf}
RESTING_MICROJOULE = 1e-3  # of robots that creep at some 0.03 mm/s
CLOSE_MM = 225.0  # between robots whose outlines have a radius of 110 mm
SPACING_MM = 2000.0  # so far apart that robots seldom meet
# On the plant `chipmunk` the pivot of the fork is a constraint, which 50 iterations leave a little open.
PIVOT = {"energy": np.inf, "momentum": np.inf, "gain": np.inf, "place": np.inf}
IMPULSES = Contact._fields.index("slip_l")
M, C, F = ({name: i for i, name in enumerate(row._fields)} for row in (Motion, Contact, Floor))


class Substep(NamedTuple):
    """One substep of a formation; arrays ``(field, robot)``."""

    before: np.ndarray
    after: np.ndarray
    last: np.ndarray
    given: np.ndarray
    torques: np.ndarray
    floors: np.ndarray
    pushes: np.ndarray
    dt: float
    apart: np.ndarray  # (robot,) bool: has touched nothing so far


def as_inputs(one: Substep) -> np.ndarray:
    """What acted, (Inputs, robot)."""
    f, nothing = one.floors, np.zeros(one.floors.shape[1])
    rows = Inputs(
        one.torques[0], one.torques[1], f[F["conveyor_l"]], f[F["conveyor_r"]], f[F["grip_l"]],
        f[F["grip_r"]], f[F["grip_c"]], f[F["rolling"]], f[F["creep"]], *one.pushes, nothing, nothing,
    )  # fmt: skip
    return np.array(rows)


def robots_of(scenario: Scenario, applied: np.ndarray) -> np.ndarray:
    """Constants with payloads, (Robot, robot); ``applied`` (robot, channel)."""
    rows = [
        robot_row(model, Payload(*payload))
        for model, payload in zip(scenario.robot_models, applied[:, PAYLOAD].tolist(), strict=True)
    ]
    return np.array(rows).T


def with_signs(robots: np.ndarray, one: dict[str, np.ndarray]) -> np.ndarray:
    """Impulses of the plant ``chipmunk``, which come without their signs, with those that momenta show.

    Every sign is that with which the change of a momentum is best explained.
    """
    r, a, b, p = Robot(*robots), Motion(*one["before"]), Motion(*one["after"]), one["given"].copy()
    u, dt = Inputs(*one["inputs"]), one["dt"]
    theta, psi = a.theta + dt * a.w, a.psi + dt * a.s
    cos, sin, c, n = np.cos(theta), np.sin(theta), np.cos(psi), np.sin(psi)

    def fit(*terms: np.ndarray, rest: np.ndarray) -> list[np.ndarray]:
        """Signs of terms (vectors over the first axis) whose sum is nearest to ``rest``."""
        signs = np.array(np.meshgrid(*[[1.0, -1.0]] * len(terms))).reshape(len(terms), -1)
        errors = [
            np.sum((sum(s * t for s, t in zip(way, terms, strict=True)) - rest) ** 2, axis=0)
            for way in signs.T
        ]
        best = np.argmin(errors, axis=0)
        return list(signs[:, best])

    for side, old, new, twist in (
        ("l", a.omega_l, b.omega_l, u.torque_l),
        ("r", a.omega_r, b.omega_r, u.torque_r),
    ):
        rest = r.J * (new - old) - dt * twist
        terms = (p[C[f"q_{side}"]], -r.R * p[C[f"p_{side}f"]])
        for name, sign in zip(
            (f"q_{side}", f"p_{side}f"),
            fit(*(t[None] for t in terms), rest=rest[None]),
            strict=True,
        ):
            p[C[name]] *= sign
    rest = r.J_c * (b.omega_c - a.omega_c)
    terms = (p[C["q_c"]][None], -r.R_c * p[C["p_cy"]][None])
    for name, sign in zip(("q_c", "p_cy"), fit(*terms, rest=rest[None]), strict=True):
        p[C[name]] *= sign
    forward, along = p[C["p_lf"]] + p[C["p_rf"]], p[C["p_cy"]]
    side = p[C["p_le"]] + p[C["p_re"]]
    rest = np.array(
        [
            r.m * (b.v_x - a.v_x) - dt * u.push_x + sin * forward + n * along,
            r.m * (b.v_y - a.v_y) - dt * u.push_y - cos * forward - c * along,
        ]
    )
    lateral, across = np.array([cos, sin]) * side, np.array([c, n]) * p[C["p_cx"]]
    for names, sign in zip(
        (("p_le", "p_re"), ("p_cx",)), fit(lateral, across, rest=rest), strict=True
    ):
        for name in names:
            p[C[name]] *= sign
    rest = r.I_s * (b.s - a.s) - r.T * p[C["p_cx"]]
    (sign,) = fit(p[C["q_s"]][None], rest=rest[None])
    p[C["q_s"]] *= sign
    return p


def audited(
    case: Case, scenario: Scenario, substeps: list[Substep], applied: np.ndarray, *, chipmunk: bool
) -> Tally:
    """Audit the substeps of a formation, all at once."""
    tally = Tally()
    one = {
        name: np.concatenate([getattr(substep, name) for substep in substeps], axis=1)
        for name in ("before", "after", "last", "given")
    }
    one["inputs"] = np.concatenate([as_inputs(substep) for substep in substeps], axis=1)
    count = scenario.robot_count
    one["dt"] = np.repeat([substep.dt for substep in substeps], count)
    apart = np.concatenate([substep.apart for substep in substeps])
    robots = np.ascontiguousarray(np.tile(robots_of(scenario, applied), (1, len(substeps))))
    before = one["before"].copy()
    if chipmunk:  # it solves in the axes at the end of the movement
        with np.errstate(all="ignore"):
            one["given"] = with_signs(robots, one)
        before[M["theta"]] += 0.5 * one["dt"] * before[M["w"]]
        before[M["psi"]] += 0.5 * one["dt"] * before[M["s"]]
    number = len(one["dt"])
    works, owes = np.zeros((len(Work._fields), number)), np.zeros((len(Owed._fields), number))
    audit_all(
        robots,
        before,
        one["after"],
        one["last"],
        one["given"],
        one["inputs"],
        one["dt"],
        works,
        owes,
    )
    owed = Owed(*owes)
    residual = np.maximum(owed.slip, owed.turn)
    open_gain = np.where(residual > STILL_MM_S, owed.gain, 0.0)
    owed.gain[residual > STILL_MM_S] = 0.0
    names = [*TOLERANCES, "gain not converged", "residual mm/s"]
    allowed = dict(zip(names, ALLOWED.tolist(), strict=True)) | (PIVOT if chipmunk else {})
    nothing = np.zeros(number)  # the motors are audited on the plant `batch`
    laws = [nothing if law == "motors" else getattr(owed, law) for law in TOLERANCES]
    sizes = np.array([*laws, open_gain, residual])
    spread = case.spreads[0]
    for name, row in zip(names, sizes, strict=True):
        row = np.where(np.isnan(row), np.inf, row)
        if chipmunk and name in ("energy", "momentum", "gain"):
            row = np.where(apart, row, 0.0)
        tally.most(f"{name}/{spread}", row.max(), case.number)
        for decade in (1e-12, 1e-9, 1e-6, 1e-3) if name in ("energy", "momentum") else ():
            tally.count(f"{name} above {decade:g}/{spread}", (row > decade).sum())
        for i in np.flatnonzero(row > allowed[name]):
            tally.count(f"findings/{name}", 1)
            if len(tally.findings) < 10:
                tally.findings.append(
                    Finding(
                        case.number,
                        name,
                        spread,
                        int(i % count),
                        0,
                        int(i // count),
                        float(row[i]),
                        allowed[name],
                    )
                )
    tally.count("substeps", number)
    tally.count(f"substeps/{spread}", number)
    tally.count("after a touch", (~apart).sum())
    tally.count(f"sliding/{spread}", owed.slides.sum())
    for name, row in zip(Work._fields, works, strict=True):
        tally.count(f"work µJ/{name}", row.sum())
    return tally


def look(case: Case, formation: Formation, tally: Tally, step: int) -> None:
    """Everything that interfaces read must be finite."""
    arrays = formation.arrays
    for read in (
        arrays.observations,
        arrays.rewards,
        arrays.terms,
        arrays.infos,
        formation.state(),
    ):
        if not np.isfinite(read).all():
            tally.count("findings/finite results", 1)
            tally.findings.append(
                Finding(case.number, "finite results", case.spreads[0], -1, 0, step, np.nan, 0.0)
            )
            return


def started(case: Case, rng: np.random.Generator, **overrides: Any) -> Formation:
    """The formation of a case with one scenario, reset."""
    given = case.scenarios[0] | overrides
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        name = given.pop("scenario")
        formation = Formation(load_scenario(name, **given))
    formation.reset(int(rng.integers(2**31)))
    return formation


def drive(case: Case, formation: Formation, rng: np.random.Generator, tally: Tally) -> None:
    """Drive a formation to the case's end."""
    arrays, actions = formation.arrays, np.zeros(formation.arrays.actions.shape)
    for step in range(case.steps):
        if case.thrown and step % THROW_EVERY == 0:
            throw(rng, arrays.rows("motion"), 0.7 if step == 0 else 0.1)
        actions = draw_actions(rng, actions.shape, actions)
        arrays.actions[:] = actions
        formation.step()
        look(case, formation, tally, step)


def chipmunk_case(number: int, substeps: int = SUBSTEPS) -> Tally:
    """Run a case on the plant ``chipmunk``."""
    case = draw_case(number, 1, substeps, creeps=False)
    rng = rng_of(number).spawn(1)[0]
    formation = started(case, rng, plant="chipmunk", start_spacing_mm=SPACING_MM)
    plant, arrays, taken = formation.plant, formation.arrays, []
    original, pushed = plant._advance_once, {}

    def advance(
        motions: np.ndarray,
        contacts: np.ndarray,
        torques: np.ndarray,
        floors: np.ndarray,
        dt: float,
    ) -> None:
        before, last = motions[:, :, 0].copy(), contacts[:, :, 0].copy()
        if plant._dt not in (0.0, dt):
            last[:IMPULSES] *= dt / plant._dt
        original(motions, contacts, torques, floors, dt)
        taken.append(
            Substep(
                before, motions[:, :, 0].copy(), last, contacts[:, :, 0].copy(), torques[:, :, 0].copy(),
                floors[:, :, 0].copy(), pushed["now"], dt, ~arrays.touched[0],
            )
        )  # fmt: skip

    outer = plant.advance

    def whole(
        motions: np.ndarray,
        contacts: np.ndarray,
        torques: np.ndarray,
        floors: np.ndarray,
        dt: float,
        pushes: np.ndarray,
    ) -> None:
        pushed["now"] = pushes[:, :, 0].copy()
        outer(motions, contacts, torques, floors, dt, pushes)

    plant._advance_once, plant.advance = advance, whole
    tally = Tally()
    drive(case, formation, rng, tally)
    tally.add(audited(case, formation.scenario, taken, formation.applied(), chipmunk=True))
    return tally


def draw_world(
    rng: np.random.Generator, x: float, y: float, theta: float, away_mm: float
) -> dict[str, Any]:
    """A wall beside the robots that start at a pose and behind it, and things to push around them."""

    def shape() -> dict[str, Any]:
        if rng.random() < 0.5:
            return {"type": "circle", "radius_mm": float(rng.uniform(20, 100))}
        width, length = rng.uniform(20, 200, 2).tolist()
        return {"type": "box", "width_mm": width, "length_mm": length}

    def place() -> dict[str, float]:
        away = rng.uniform(-800, 800, 2)
        return {"x_mm": float(x + away[0]), "y_mm": float(y + away[1])}

    def surface() -> dict[str, float]:
        return {"restitution": float(rng.random()), "friction": float(rng.uniform(0, 2))}

    side = float(rng.choice([-away_mm, away_mm]))
    right, ahead = (
        np.array([np.cos(theta), np.sin(theta)]),
        np.array([-np.sin(theta), np.cos(theta)]),
    )
    ends = [np.array([x, y]) + side * right + way * ahead for way in (-3000.0, 800.0)]
    return {
        "walls": [
            {"points_mm": [end.tolist() for end in ends], "thickness_mm": float(rng.choice([0.0, 20.0]))}
            | surface()
        ],
        "pushables": [
            {"shape": shape(), **place(), "mass_kg": float(10 ** rng.uniform(-2, 1)),
             "floor_friction": float(rng.uniform(0, 0.5))} | surface()
            for _ in range(rng.integers(0, 4))
        ],
        "patches": [draw_patch(rng)],
    }  # fmt: skip


def draw_surface(rng: np.random.Generator) -> dict[str, float]:
    """Restitution and friction of a robot's outline."""
    return {"outline_restitution": float(rng.random()), "outline_friction": float(rng.random())}


def contact_case(number: int, substeps: int = SUBSTEPS) -> Tally:
    """Run a crowded case on the plant ``pymunk``: robots that meet each other, walls, and things to push."""
    case = draw_case(number, 1, substeps)
    case = case._replace(thrown=True)
    rng = rng_of(number).spawn(1)[0]
    surface = str(rng.choice(list(GAINS)))
    robots = case.scenarios[0]["robots"]
    if surface != "as by default":
        robots = [robot | draw_surface(rng) for robot in robots]
    disturbance = {k: v for k, v in case.scenarios[0]["disturbance"].items() if k != "start"}
    options = {
        "plant": "pymunk",
        "robots": robots,
        "start_spacing_mm": CLOSE_MM,
        "disturbance": disturbance,
        "rays": None,
    }
    start = (
        started(case, rng_of(number), world={}, **options).arrays.rows("start")[:, 0, 0].tolist()
    )
    try:
        formation = started(case, rng, world=draw_world(rng, *start, WALL_MM), **options)
    except ValueError:  # a start beyond a bend of the path is in the wall
        formation = started(
            case, rng, world=draw_world(rng, *start, 5 * WALL_MM) | {"walls": []}, **options
        )
    plant, tally = formation.plant, Tally()
    original = plant.collide

    def energy() -> float:
        """Of the things that can be pushed."""
        return sum(
            0.5 * one.mass * one.velocity.length**2 + 0.5 * one.moment * one.angular_velocity**2
            for one in plant.pushable_bodies
        )

    masses = robots_of(formation.scenario, formation.applied())[:2]

    def of_robots(motion: np.ndarray) -> float:
        v = Motion(*motion[:, :, 0])
        return float(np.sum(0.5 * masses[0] * (v.v_x**2 + v.v_y**2) + 0.5 * masses[1] * v.w**2))

    def collide(before: np.ndarray, motions: np.ndarray, dt: float) -> None:
        start = of_robots(motions) + energy()
        original(before, motions, dt)
        tally.count("substeps", motions.shape[1])
        tally.count(f"substeps/{case.spreads[0]}", motions.shape[1])
        tally.count("robots in contact", len(plant.hits))
        if not np.isfinite(motions).all():
            tally.count("findings/finite state", 1)
        gained = (of_robots(motions) + energy() - start) / (start + RESTING_MICROJOULE)
        tally.most(f"energy gained by contact, relative/{surface}", gained, number)
        for share in (1e-9, 1e-3, 1e-2):
            tally.count(f"contact adds more than {share:g} of the energy/{surface}", gained > share)
        if not gained <= GAINS[surface]:
            tally.count("findings/energy of contact", 1)
            tally.findings.append(
                Finding(number, "energy of contact", surface, -1, 0, 0, gained, GAINS[surface])
            )

    plant.collide = collide
    drive(case, formation, rng, tally)
    return tally
