"""Do the plants agree? ``batch`` and ``pymunk`` bit for bit until robots touch, ``chipmunk`` nearly."""

from __future__ import annotations

import numpy as np
from physics_helpers import NO_MEMORY, random_start, random_torques
from physics_helpers import run as run_kernel
from stress_cases import SPREADS, draw_actions, draw_case, draw_robot, rng_of, throw
from stress_formations import SPACING_MM, started
from stress_runs import Finding, Tally

from tlf_env.physics.chipmunk_plant import ChipmunkPlant
from tlf_env.physics.parameters import RobotParameters
from tlf_env.physics.state import Floor, Motion

SUBSTEPS = 400  # of a case on two plants
SECONDS, TORQUE_NMM, FINE_S, DT_S = 2.0, 20.0, 1e-4, 1e-3  # of a skid, as in docs/chipmunk.md
PER_CONTROL_STEP = 20
SHARES = (1e-3, 3.3e-3, 1e-2, 3e-2)  # of the path; docs/chipmunk.md: 0.33 % at most in 20 skids
AGREES = 3e-2  # of the path, for the default robot


def same_bits(number: int, tally: Tally) -> None:
    """The plants ``batch`` and ``pymunk`` on the same case, until a robot touches another."""
    case = draw_case(number, 1, SUBSTEPS)
    formations = [
        started(case, rng_of(number).spawn(1)[0], plant=plant, start_spacing_mm=SPACING_MM)
        for plant in ("batch", "pymunk")
    ]
    rng = rng_of(number).spawn(2)[1]
    actions = np.zeros(formations[0].arrays.actions.shape)
    for step in range(case.steps):
        actions = draw_actions(rng, actions.shape, actions)
        at = rng.integers(2**31)
        for formation in formations:
            if case.thrown and step % 40 == 0:
                throw(np.random.default_rng(at), formation.arrays.rows("motion"), 0.5)
            formation.arrays.actions[:] = actions
            formation.step()
        if any(formation.arrays.touched.any() for formation in formations):
            return
        rows = ("motion", "contact", "estimate", "trace")
        a, b = ([one.arrays.rows(name).tobytes() for name in rows] for one in formations)
        robots = actions.shape[1]
        tally.count("substeps", robots * formations[0].scenario.substeps)
        tally.count("substeps compared bit for bit", robots * formations[0].scenario.substeps)
        if a != b:
            tally.count("findings/same bits", 1)
            tally.findings.append(
                Finding(number, "same bits", case.spreads[0], 0, 0, step, 1.0, 0.0)
            )
            return


def run_chipmunk(robot: RobotParameters, start: Motion, torques: np.ndarray) -> np.ndarray:
    """Motions (substep, field) of a robot on the plant ``chipmunk``."""
    plant = ChipmunkPlant([robot])
    motions = np.array(start)[:, None, None].copy()
    contacts = np.array(NO_MEMORY)[:, None, None].copy()
    floors = np.array(Floor(0.0, 0.0, 1.0, 1.0, 1.0))[:, None, None].copy()
    rows = []
    for k, torque in enumerate(torques):
        if k % PER_CONTROL_STEP == 0:
            if k:
                plant.release()
            plant.sort(motions)
        plant.advance(motions, contacts, 1000.0 * torque[:, None, None], floors, DT_S)
        rows.append(motions[:, 0, 0].copy())
    return np.array(rows)


def skid(number: int, tally: Tally) -> None:
    """A random skid of the two solvers at 1 ms, each against the kernel at 0.1 ms."""
    rng = rng_of(number).spawn(3)[2]
    spread = ("default", "default", "near")[number % 3]
    robot = RobotParameters(**draw_robot(rng, SPREADS[spread]))
    start, torques = random_start(rng), random_torques(rng, SECONDS, TORQUE_NMM)
    per_step = round(DT_S / FINE_S)
    fine = run_kernel(
        robot, start, seconds=SECONDS, torques_Nmm=np.repeat(torques, per_step, axis=0), dt_s=FINE_S
    ).motion
    wanted = np.array(fine)[:, per_step::per_step].T
    kernel = np.array(run_kernel(robot, start, seconds=SECONDS, torques_Nmm=torques).motion)[
        :, 1:
    ].T
    path = np.hypot(*np.diff(wanted[:, :2], axis=0).T).sum()
    for name, got in (("kernel", kernel), ("chipmunk", run_chipmunk(robot, start, torques))):
        off, turned = (
            np.hypot(*(got - wanted)[:, :2].T).max() / path,
            np.abs(got - wanted)[:, 2].max(),
        )
        tally.most(f"{name}: position over path/{spread}", off, number)
        tally.most(f"{name}: heading, rad/{spread}", turned, number)
        for share in SHARES:
            tally.count(f"{name}: skids above {share:g} of the path/{spread}", off > share)
        if not off <= AGREES and spread == "default":
            tally.count("findings/skids agree", 1)
            tally.findings.append(Finding(number, f"{name} skids", spread, 0, 0, 0, off, AGREES))
    tally.count(f"skids/{spread}", 1)
    tally.count("substeps", len(torques))


def agree_case(number: int) -> Tally:
    """The plants against each other, on one case and one skid."""
    tally = Tally()
    same_bits(number, tally)
    skid(number, tally)
    return tally
