"""The differentiable model of ``docs/figures/make_differentiable.py`` against the laws of the environment."""

from __future__ import annotations

import importlib
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tlf_env.engine import readout
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.settings import make_settings
from tlf_env.onboard.observer import Message, dead_reckoned
from tlf_env.onboard.tracking import body_errors
from tlf_env.task.actions import led_reference, residual_share, twist_action
from tlf_env.task.observation import tracking_entries
from tlf_env.task.reward import reward_terms

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

DOCS = Path(__file__).resolve().parents[1] / "docs"


sys.path.insert(0, str(DOCS / "figures"))
try:
    tables, robots, training = (
        importlib.import_module(name)
        for name in ("make_differentiable", "differentiable_model", "differentiable_training")
    )
finally:
    sys.path.pop(0)


LEARNER = training.learner()
MODEL = robots.Model(LEARNER)
RULES = make_settings(LEARNER)


def at(*numbers: float) -> Any:
    """One robot's numbers."""
    return torch.tensor(numbers, dtype=torch.float32)[None, None]


def near(size: float) -> st.SearchStrategy[float]:
    return st.floats(-size, size)


@settings(max_examples=40, deadline=None)
@given(near(500), near(500), near(3), near(600), near(1.5), near(500), near(500), near(3))
def test_errors_move_as_on_exact_arcs(x, y, theta, u_1, u_2, goal_x, goal_y, goal_theta):
    """Eq. (16) of poses that the plant's own dead reckoning moves, and the kinematics behind it."""
    moved = robots.driven(at(x, y, theta), at(u_1, u_2), 0.02)
    wanted = dead_reckoned(Message(x, y, theta, u_1, u_2), 0.02)
    np.testing.assert_allclose(moved[0, 0], wanted[:3], atol=2e-3)
    goal = at(goal_x, goal_y, goal_theta, 0.0, 0.0)[..., None, :]
    relative = MODEL.relative
    seen, later = relative(at(x, y, theta), goal), relative(moved, goal)
    e_1, e_2 = body_errors(goal_x - x, goal_y - y, theta)
    np.testing.assert_allclose(seen[0, 0, 0, :2], (e_1, e_2), atol=1e-3)
    np.testing.assert_allclose(seen[0, 0, 0, 2], math.sin(goal_theta - theta), atol=1e-5)
    # A goal at rest: the derivatives of e₁ and e₂ are −u₁ − u₂ e₂ and u₂ e₁; half the next order is left.
    change = (later - seen)[0, 0, 0, :2].numpy() / 0.02
    room = 0.02 * (abs(u_2) * (abs(u_1) + abs(u_2) * 1500.0)) + 0.2
    np.testing.assert_allclose(change, (-u_1 - u_2 * e_2, u_2 * e_1), atol=room)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(near(600), near(200), near(1)),
    st.tuples(st.floats(0, 560), near(0.8), near(30), near(0.1)),
    st.tuples(st.floats(-20, 660), near(1.5)),
    st.tuples(near(40), near(0.3)),
    st.tuples(near(1), near(1)),
)
def test_an_action_commands_what_the_environment_commands(errors, reference, last, slip, action):
    (e_1, e_2, e_3), (u_1, u_2, more_1, more_2) = errors, reference
    entries = tracking_entries(LEARNER.preview_s)
    values = dict.fromkeys(entries, 0.0) | {"is_leader": 1.0}
    values |= {"e_1": e_1, "e_2": e_2, "sin_e_3": math.sin(e_3), "cos_e_3": math.cos(e_3)}
    values |= {"reference_u_1": u_1, "reference_u_2": u_2}
    values |= {"u_1_in_0.5_s": u_1 + more_1, "u_2_in_0.5_s": u_2 + more_2}
    values |= {"command_u_1": last[0], "command_u_2": last[1]}
    values |= {"slip_1": slip[0], "slip_2": slip[1]}
    scales = np.array([entry.scale for entry in entries.values()])
    row = np.array([values[name] for name in entries]) / scales
    led = led_reference(row, scales, RULES.limits.lead)
    share = residual_share(row, scales, RULES.tracking_fade, math.inf)
    full = (RULES.full_1, RULES.full_2)
    asked = [one + share * a * whole for one, a, whole in zip(led, action, full, strict=True)]
    wanted = twist_action(row, scales, RULES.limits, *asked)
    now = [e_1, e_2, math.sin(e_3), math.cos(e_3), u_1, u_2]
    later = [0.0, 0.0, 0.0, 1.0, u_1 + more_1, u_2 + more_2]
    seen = torch.tensor([now, later, later])[None, None]
    found = MODEL.limited(seen, at(*last), at(*slip), at(*action))[0, 0].numpy() / (1000.0, 8.0)
    np.testing.assert_allclose(found, np.clip(wanted, -1, 1), atol=2e-5)


def test_the_observation_is_that_of_the_environment():
    scenario = training.load_scenario(LEARNER, estimator="truth", disturbance="slip")
    plant = BatchPlant(scenario, 2)
    plant.reset(10_000)
    generator = np.random.default_rng(0)
    for _ in range(330):
        plant.step(generator.uniform(-0.5, 0.5, plant.arrays.actions.shape))
    arrays = plant.arrays
    info = readout.info(arrays)
    pose = torch.tensor(np.stack([info.x_mm, info.y_mm, info.theta_rad], axis=-1))
    step, ring = int(arrays.clock[0, 1]), arrays.references.shape[1]
    slots = [(step + later) % ring for later in (0, *scenario.preview_steps)]
    targets = torch.tensor(arrays.references[:, slots][..., :2].transpose(3, 2, 1, 0))
    entries = list(tracking_entries(LEARNER.preview_s))
    given = plant.observations.astype(np.float64) * MODEL.scales.numpy()
    two = {
        name: torch.tensor(given[..., [entries.index(one) for one in names]])
        for name, names in {
            "command": ("command_u_1", "command_u_2"),
            "action": ("last_action_0", "last_action_1"),
            "odometry": ("odometry_u_1", "odometry_u_2"),
        }.items()
    }
    none = torch.zeros(2, 3, 2)
    state = robots.State(pose=pose, wheels=none, held=none, castor=none[..., 0], **two)
    roles = torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]).expand(2, -1, -1)
    slip = torch.tensor(given[..., [entries.index(one) for one in ("slip_1", "slip_2")]])
    row = MODEL.observation(state, MODEL.relative(pose, targets), slip, roles).numpy()
    lacking = [name for name in entries if MODEL.places[entries.index(name)] == len(MODEL.known)]
    assert lacking == [
        *("innovation_forward", "innovation_right", "torque_l", "torque_r"),
        *(name for name in entries if name.startswith("predecessor_")),
    ]
    for i, name in enumerate(entries):
        wanted = 0.0 if name in lacking else plant.observations[..., i]
        np.testing.assert_allclose(row[..., i], wanted, atol=1e-4, err_msg=name)
    assert np.abs(plant.observations[..., entries.index("e_1")]).max() > 0.1


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 1000), near(1), near(1), near(1), near(1))
def test_the_reward_is_that_of_the_environment(error, a_0, a_1, change_0, change_1):
    action, change = at(a_0, a_1), at(change_0, change_1)
    sizes = [float(one.square().sum()) for one in (change, action)]
    terms = reward_terms(error, *sizes, 0.0, False, False)
    wanted = sum(weight * term for weight, term in zip(training.WEIGHTS, terms, strict=True))
    found = training.reward(torch.tensor([[error]]), change, action)
    assert float(found) == pytest.approx(wanted, abs=1e-4)


def test_gradients_are_finite_and_none_reaches_what_the_model_lacks():
    torch.manual_seed(0)
    task = training.load_scenario("infinity", action="tracking_twist")
    formations = training.Formations(MODEL, [task], 4)
    known = (MODEL.places < len(MODEL.known)).float()
    policy = training.make_network(known, 2, 0.1)
    step = training.step_of(MODEL, policy, formations.roles)
    total = 0.0
    for _ in range(2):  # windows; the first begins at the reference, where the error is 0
        formations.between()
        for _ in range(12):
            total = total + training.driven_on(formations, step).reward.sum()
        total.backward()
        total = 0.0
    first = policy[0].weight
    assert all(torch.isfinite(one.grad).all() for one in policy.parameters())
    assert policy[-1].weight.grad.abs().max() > 0.0
    assert not first[:, known == 0].any()
    assert not first.grad[:, known == 0].any()


def test_the_page_has_the_tables_of_the_measured_runs():
    page = (DOCS / "learning.md").read_text("utf-8")
    kept = json.loads((DOCS / "learning" / "differentiable.json").read_text("utf-8"))
    for name, table in (
        ("differentiable-check", tables.checked_table(kept["check"])),
        ("differentiable", tables.judged_table(kept["judged"])),
    ):
        assert f"<!-- {name} -->\n{table}\n<!-- end of {name} -->" in page
    runs = {len(cell["rms_mm"]) for row in kept["judged"] for cell in row["cells"]}
    count = runs.pop()
    assert not runs
    assert [row["seed"] for row in kept["judged"]] == ["seed_0", "seed_1", "seed_2"]
    for said in (
        f"{count} runs from seed {tables.FIRST_TABLE_SEED} on",
        f"judge --runs {count}",
        f"{training.WINDOWS} windows",
        f"{training.FORMATIONS} formations of three",
        f"{training.WINDOW} steps,\n{training.WINDOW * MODEL.period:g} s",
        f"{robots.AXLES_mNmm:g} and {robots.CASTOR_mNmm:g} mN·mm",
    ):
        assert said in page, said
