"""A short part of the stress campaign (``tests/campaign/stress.py``), and what its audit sees and misses."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from physics_helpers import FLOOR, ROBOT, run
from stress_agree import same_bits, skid
from stress_cases import draw_case, rng_of
from stress_formations import GAINS, chipmunk_case, contact_case
from stress_laws import Owed, Work, audit_all, inputs_all
from stress_runs import TOLERANCES, Audit, Moment, Substeps, Tally, loaded, run_case

from tlf_env import BatchPlant
from tlf_env.physics.state import Contact, Motion

SMALL = {"variants": 8, "lanes": 16, "substeps": 60}
BATCH, CHIPMUNK, CONTACT, AGREE = range(12), range(4), range(10), range(4)
C, M = ({name: i for i, name in enumerate(row._fields)} for row in (Contact, Motion))


def checked(tally: Tally) -> Tally:
    """A tally in which no law is broken."""
    assert not tally.findings, tally.findings[:3]
    assert tally.counts["substeps"] > 0
    return tally


@pytest.fixture(scope="module")
def batch() -> Tally:
    """All cases of the plant ``batch``."""
    tally = Tally()
    for number in BATCH:
        tally.add(checked(run_case(number, **SMALL)))
    return tally


def of_all(tally: Tally, name: str) -> float:
    """A count over all classes of robots."""
    return sum(count for key, count in tally.counts.items() if key.startswith(f"{name}/"))


def test_every_substep_owes_nothing_to_mechanics_and_friction(batch):
    """Balances of momentum and work, circles, eq. (5), motors, finite numbers: see stress_runs.TOLERANCES."""
    assert of_all(batch, "substeps") == batch.counts["substeps"] > 10_000
    assert {key.split("/")[1] for key in batch.counts if key.startswith("substeps/")} == {
        "default", "near", "wide", "extreme",
    }  # fmt: skip
    for law in TOLERANCES:
        assert any(key.startswith(f"{law}/") for key in batch.largest), law
    assert 0.1 < of_all(batch, "sliding") / batch.counts["substeps"] < 0.95


def test_the_works_of_all_substeps_close(batch):
    work = {name: batch.counts[f"work µJ/{name}"] for name in Work._fields}
    change = work.pop("change")
    assert change == pytest.approx(sum(work.values()), abs=1e-9 * sum(map(abs, work.values())))
    assert work["joints"] < 0
    assert work["tyres"] < 0


def test_few_substeps_reach_the_cap_of_the_sweeps(batch):
    sampled = {name: of_all(batch, name) for name in ("sampled", "sampled capped")}
    assert sampled["sampled capped"] <= 0.02 * sampled["sampled"]
    usual = [f"residual above 1 mm/s/{spread}" for spread in ("default", "near")]
    assert not any(batch.counts[name] for name in usual)


@pytest.mark.parametrize("number", CHIPMUNK)
def test_the_plant_chipmunk_stays_within_its_limits(number):
    tally = checked(chipmunk_case(number, substeps=60))
    for law in ("energy", "momentum"):  # what 50 iterations leave open at the fork's pivot
        assert all(size < 1e-3 for key, (size, _) in tally.largest.items() if key.startswith(law))


def test_contact_adds_no_energy_unless_robots_bounce():
    tally = Tally()
    for number in CONTACT:
        tally.add(contact_case(number, substeps=100))
    checked(tally)
    assert tally.counts["robots in contact"] > 100
    assert set(GAINS) == {key.split("/")[1] for key in tally.largest}


@pytest.mark.parametrize("number", AGREE)
def test_batch_and_pymunk_give_the_same_bits(number):
    tally = Tally()
    same_bits(number, tally)
    checked(tally)


@pytest.mark.parametrize("number", [0, 1])
def test_kernel_and_chipmunk_agree_in_skids(number):
    tally = Tally()
    skid(number, tally)
    assert tally.largest["kernel: position over path/default"][0] < 0.02
    assert tally.largest["chipmunk: position over path/default"][0] < 0.01


# --- the harness itself ---------------------------------------------------------------------------------


def one_moment() -> tuple[Audit, Moment]:
    """A substep in which tyres slide and stick, of a case on the plant ``batch``."""
    found = []

    def look(audit: Audit, moment: Moment, owed: Owed) -> None:
        if audit.substep == 5 and not found:
            found.append((audit, moment))

    run_case(2, **(SMALL | {"substeps": 8}), moments=look)
    return found[0]


def audit_of(audit: Audit, moment: Moment) -> Owed:
    """What a substep owes, but for the motors."""
    inputs_all(
        audit.robots, moment.before, moment.delivered, moment.delivered, moment.channels, audit.patches,
        audit.inputs, audit.motors,
    )  # fmt: skip
    audit_all(
        audit.robots, moment.before, moment.after, moment.last, moment.given, audit.inputs, audit.dts,
        audit.works, audit.owed,
    )  # fmt: skip
    return Owed(*audit.owed.copy())


@pytest.mark.parametrize(
    ("law", "row", "field", "change"),
    [
        ("momentum", "after", M["v_x"], lambda v: v + 1e-6 * (1 + abs(v))),
        ("momentum", "after", M["omega_c"], lambda v: v + 1e-6 * (1 + abs(v))),
        ("energy", "after", M["w"], lambda v: v + 1e-4 * (1 + abs(v))),
        ("momentum", "given", C["p_le"], lambda p: p + 1e-3),
        ("tyre", "given", C["p_rf"], lambda p: p + 1e4),
        ("joint", "given", C["q_s"], lambda q: q + 1e6),
        ("place", "after", M["x"], lambda x: x + 1e-6),
        ("momentum", "delivered", 0, lambda t: t + 1.0),
        ("finite", "after", M["psi"], lambda x: x * np.nan),
    ],
)
def test_the_audit_sees_what_is_wrong(law, row, field, change):
    audit, moment = one_moment()
    right = getattr(audit_of(audit, moment), law)
    assert (right <= TOLERANCES[law]).all()
    wrong = getattr(moment, row).copy()
    wrong[field] = change(wrong[field])
    broken = getattr(audit_of(audit, moment._replace(**{row: wrong})), law)
    assert (~(broken <= TOLERANCES[law])).mean() > 0.5


def test_substep_by_substep_gives_the_bits_of_whole_control_steps():
    number = next(
        n
        for n in range(100)
        if draw_case(n, 8, 60).scenarios[0]["control_period_s"]
        > 1.5 * draw_case(n, 8, 60).scenarios[0]["physics_period_s"]
    )
    case = draw_case(number, 8, 60)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plants = [BatchPlant(loaded(case), 16, end_on=()) for _ in range(2)]
    actions = rng_of(0).uniform(-1, 1, (4, *plants[0].arrays.actions.shape))
    for plant in plants:
        plant.reset(seed=0)
    stepped = Substeps(plants[0])
    for action in actions[: case.steps]:
        assert len(list(stepped.step(action))) == plants[0].scenario.substeps > 1
        plants[1].step(action)
        for name in ("motion", "contact", "estimate", "trace", "sensors"):
            a, b = (plant.arrays.rows(name) for plant in plants)
            assert a.tobytes() == b.tobytes(), name
        assert plants[0].observations.tobytes() == plants[1].observations.tobytes()


# --- what is known to remain ----------------------------------------------------------------------------


@pytest.mark.parametrize("belt", [1e-4, 1e-3, 1e-2, 0.05, 0.2, 1.0])
@pytest.mark.parametrize("turning", [False, True])
def test_a_robot_at_rest_follows_a_slow_floor_with_little_delay(belt, turning):
    """Where not all that sticks can stick, sweeps end with impulses that still grow: docs/physics.md."""
    floor = FLOOR._replace(conveyor_l=belt, conveyor_r=-belt if turning else belt)
    made = run(seconds=1.0, floor=floor)
    slid = np.cumsum(np.maximum(made.contact.slip_l, made.contact.slip_r)[1:]) * 1e-3
    most = (
        ROBOT.tyre.mu_static * ROBOT.drive_load_share * ROBOT.mass_kg * ROBOT.gravity_mm_s2 * 1e-3
    )
    inside = np.hypot(made.contact.p_le, made.contact.p_lf)[1:] < most * (1 - 1e-9)
    assert made.contact.slip_l[1:][inside].max() < 0.02
    assert slid[-1] < 3e-3
    assert made.contact.slip_l[-1] < 1e-4
