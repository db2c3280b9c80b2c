"""Sweeps side by side: every robot gets the bits that it gets alone, whatever the others need."""

from __future__ import annotations

import numpy as np
import pytest
from physics_helpers import DT_S, random_start

from tlf_env.numerics.compiled import driver
from tlf_env.numerics.memory import table
from tlf_env.numerics.rows import row_reader, row_writer
from tlf_env.physics.friction import Circle, disc
from tlf_env.physics.parameters import Body, RobotParameters, body
from tlf_env.physics.sliding import begin_wheel, solution_of, solve_wheels
from tlf_env.physics.state import Contact, Floor, Motion, Push
from tlf_env.physics.sweeps import Wheel
from tlf_env.physics.vehicle import (
    SLIDE_COLUMNS,
    SLIDE_ROWS,
    begin_slide,
    end_slide,
    slide,
    sweep_together,
)

body_of, motion_of, contact_of, floor_of = (
    row_reader(row, 0) for row in (Body, Motion, Contact, Floor)
)
set_motion, set_contact = row_writer(Motion, 0), row_writer(Contact, 0)
circle_at = row_reader(Circle, 0)
STEPS = 40


@driver
def alone(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    torques: np.ndarray,
    slides: np.ndarray,
) -> None:
    """One substep of the robots that slide, ``(field, robot)``."""
    for i in range(motions.shape[1]):
        if slides[i]:
            motion, contact = slide(
                body_of(bodies, i),
                motion_of(motions, i),
                contact_of(contacts, i),
                floor_of(floors, i),
                Push(0.0, 0.0, 0.0),
                torques[0, i],
                torques[1, i],
                DT_S,
            )
            set_motion(motions, i, motion)
            set_contact(contacts, i, contact)


@driver
def together(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    torques: np.ndarray,
    slides: np.ndarray,
) -> None:
    """The same for as many robots as a table has columns."""
    t = table(SLIDE_ROWS, SLIDE_COLUMNS)
    for i in range(SLIDE_COLUMNS):
        begin_slide(
            t,
            i,
            slides[i],
            body_of(bodies, i),
            motion_of(motions, i),
            contact_of(contacts, i),
            floor_of(floors, i),
            Push(0.0, 0.0, 0.0),
            torques[0, i],
            torques[1, i],
            DT_S,
        )
    sweep_together(t)
    for i in range(SLIDE_COLUMNS):
        if slides[i]:
            motion, contact = end_slide(t, i, motion_of(motions, i), DT_S)
            set_motion(motions, i, motion)
            set_contact(contacts, i, contact)


def robots(rng: np.random.Generator) -> np.ndarray:
    """Some with joint friction, some without, ``(field, robot)``."""
    kinds = [body(RobotParameters(joint_friction=bool(rng.random() < 0.7))) for _ in range(8)]
    return np.array(kinds).T.copy()


@pytest.mark.parametrize("seed", range(30))
def test_side_by_side_gives_the_bits_of_one_by_one(seed):
    rng = np.random.default_rng(seed)
    bodies = robots(rng)
    scales = rng.choice([0.0, 1e-3, 0.05, 0.3, 1.0], SLIDE_COLUMNS)
    motions = np.array([random_start(rng, scale) for scale in scales]).T.copy()
    stuck = rng.random(SLIDE_COLUMNS) < 0.3
    motions[Motion._fields.index("s"), stuck] = motions[Motion._fields.index("w"), stuck]
    contacts = np.zeros((len(Contact._fields), SLIDE_COLUMNS))
    floors = np.zeros((len(Floor._fields), SLIDE_COLUMNS))
    floors[:2] = rng.choice([0.0, 40.0, -25.0], (2, SLIDE_COLUMNS))
    floors[2:5] = rng.choice([1.0, 0.7, 0.1, 0.0], (3, SLIDE_COLUMNS))
    floors[6] = rng.choice([0.0, 0.0, 0.05], SLIDE_COLUMNS)
    slides = rng.random(SLIDE_COLUMNS) < rng.choice([0.3, 0.8, 1.0])
    one, many = (motions.copy(), contacts.copy()), (motions.copy(), contacts.copy())
    for _ in range(STEPS):
        torques = rng.uniform(-6e4, 6e4, (2, SLIDE_COLUMNS))
        alone(bodies, *one, floors, torques, slides)
        together(bodies, *many, floors, torques, slides)
        assert np.isfinite(one[0]).all()
        for got, wanted in zip(many, one, strict=True):
            assert got.tobytes() == wanted.tobytes()
    assert (one[0] == motions)[:, ~slides].all()
    assert (one[0] != motions)[4:11, slides].any(axis=0).all() or not scales[slides].all()


@driver
def tyres_alone(circles: np.ndarray, found: np.ndarray) -> None:
    """The impulse and λ of each circle, (number, circle)."""
    for i in range(SLIDE_COLUMNS):
        found[0, i], found[1, i], found[2, i] = disc(
            circles[0, i], circles[1, i], circles[2, i], circles[3, i], circles[4, i], circles[5, i]
        )


@driver
def tyres_together(circles: np.ndarray, found: np.ndarray) -> None:
    """The same for all at once: wheels that turn without friction, and are too thin to turn their tyres."""
    t = table(SLIDE_ROWS, SLIDE_COLUMNS)
    may_stick = False
    for i in range(SLIDE_COLUMNS):
        circle = circle_at(circles, i)
        wheel = Wheel(
            radius=0.0,
            inertia=1.0,
            inverse_inertia=1.0,
            w_ee=circle.w_ee,
            w_ff=circle.w_ff,
            w_ef=circle.w_ef,
            w_ff_turning=circle.w_ff,
            b_e=circle.b_e,
            b_f=circle.b_f,
            omega_0=1.0,
            friction=0.0,
            grip=circle.radius,
        )
        may_stick |= begin_wheel(t, i, wheel, True)
    solve_wheels(t, may_stick)
    for i in range(SLIDE_COLUMNS):
        each = solution_of(t, i)
        found[0, i], found[1, i], found[2, i] = each.p_e, each.p_f, each.lam


@pytest.mark.parametrize("seed", range(20))
def test_tyres_side_by_side_are_solved_as_one_by_one_also_beside_one_without_an_answer(seed):
    rng = np.random.default_rng(seed)
    a, c = 10.0 ** rng.uniform(-3, 0, (2, SLIDE_COLUMNS))
    between = rng.uniform(-0.99, 0.99, SLIDE_COLUMNS) * np.sqrt(a * c)
    speeds = rng.normal(size=(2, SLIDE_COLUMNS)) * 10.0 ** rng.uniform(-3, 3, SLIDE_COLUMNS)
    radius = 10.0 ** rng.uniform(-3, 2, SLIDE_COLUMNS) * (rng.random(SLIDE_COLUMNS) < 0.9)
    circles = np.array([a, c, between, *speeds, radius])
    if seed % 4 == 0:
        circles[3, rng.integers(SLIDE_COLUMNS)] = np.nan
    alone, together = np.zeros((2, 3, SLIDE_COLUMNS))
    tyres_alone(circles, alone)
    tyres_together(circles, together)
    assert np.array_equal(together, alone, equal_nan=True)
    assert np.isnan(alone).any() == (seed % 4 == 0)


def test_robots_whose_castors_all_turn_get_the_bits_of_one_by_one():
    rng = np.random.default_rng(0)
    starts = [random_start(rng)._replace(w=-2.0, s=6.0 + i) for i in range(SLIDE_COLUMNS)]
    motions = np.array(starts).T.copy()
    bodies = np.repeat(np.array(body(RobotParameters()))[:, None], SLIDE_COLUMNS, axis=1)
    contacts = np.zeros((len(Contact._fields), SLIDE_COLUMNS))
    floors = np.zeros((len(Floor._fields), SLIDE_COLUMNS))
    floors[2:5] = 1.0
    torques, slides = np.zeros((2, SLIDE_COLUMNS)), np.ones(SLIDE_COLUMNS, dtype=np.bool_)
    one, many = (motions.copy(), contacts.copy()), (motions.copy(), contacts.copy())
    for _ in range(3):
        alone(bodies, *one, floors, torques, slides)
        together(bodies, *many, floors, torques, slides)
        for got, wanted in zip(many, one, strict=True):
            assert got.tobytes() == wanted.tobytes()
    turning = one[0][Motion._fields.index("s")] - one[0][Motion._fields.index("w")]
    assert np.abs(turning).min() > 1.0
