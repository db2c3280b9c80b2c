"""The reference controller as a policy: a pure function of the observation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import reference_actions, stacked

import tlf_env
from baselines import ReferencePolicy
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.tracking import TrackingGains, gains_row, tracking_twist
from tlf_env.task.observation import Tracking, tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S

ENTRIES = len(Tracking._fields)
WHOLE = len(tracking_entries(DEFAULT_PREVIEW_S))
NEEDED = ("e_1", "e_2", "sin_e_3", "cos_e_3", "reference_u_1", "reference_u_2")

presets = pytest.mark.parametrize("preset", ["consistent", "printed"])
every = pytest.mark.parametrize("preset", ["consistent", "printed", "tuned", "linearised", "adrc"])


def batch(rows: int = 64, entries: int = ENTRIES, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (rows, entries)).astype(np.float32)


@presets
def test_action_is_the_law_at_the_formations_estimates(preset):
    env = tlf_env.parallel_env("infinity", end_on=())
    policy, gains = ReferencePolicy(preset), gains_row(controller(preset).gains)
    observations, infos = env.reset(seed=1)
    compared = 0
    for _ in range(800):
        actions, _ = policy.predict(stacked(observations))
        estimates = env.formation.arrays.rows("estimate")[:3, :, 0].T
        for action, (x, y, theta), info, observation in zip(
            actions, estimates, infos.values(), observations.values(), strict=True
        ):
            d_x, d_y = info["reference_x_mm"] - x, info["reference_y_mm"] - y
            e_3 = info["reference_theta_rad"] - theta
            u_1, u_2 = (
                float(observation[Tracking._fields.index(name)]) * scale
                for name, scale in (("reference_u_1", 500.0), ("reference_u_2", 2.0))
            )
            expected = tracking_twist(
                -math.sin(theta) * d_x + math.cos(theta) * d_y,
                math.cos(theta) * d_x + math.sin(theta) * d_y,
                math.sin(e_3),
                math.cos(e_3),
                u_1,
                u_2,
                gains,
            )
            expected = np.clip((expected[0] / 1000, expected[1] / 8), -1, 1)
            # The complementary law jumps by at most 1.9e-3 mm/s and rad/s at the edge of its layer.
            np.testing.assert_allclose(action, expected, atol=1.9e-3 / 8 + 1e-6)
            compared += np.allclose(action, expected, atol=2e-6)
        observations, *_, infos = env.step(reference_actions(env, observations))
    assert compared > 0.99 * 800 * 3


@every
def test_prediction_is_a_pure_function_of_the_observation(preset):
    policy, rows = ReferencePolicy(preset), batch(entries=WHOLE)
    kept = rows.copy()
    first, _ = policy.predict(rows)
    policy.predict(batch(entries=WHOLE, seed=1))
    second, _ = policy.predict(rows, episode_start=np.ones(len(rows), dtype=bool))
    fresh, _ = ReferencePolicy(preset).predict(rows, deterministic=False)
    assert first.tobytes() == second.tobytes() == fresh.tobytes()
    assert rows.tobytes() == kept.tobytes()


@every
def test_a_batch_is_its_rows_one_by_one(preset):
    policy, rows = ReferencePolicy(preset), batch(entries=WHOLE)
    together, _ = policy.predict(rows)
    alone = [policy.predict(row)[0] for row in rows]
    assert together.shape == (64, 2)
    assert alone[0].shape == (2,)
    assert together.tobytes() == np.stack(alone).tobytes()


def test_only_the_errors_and_the_references_twist_matter():
    policy, rows = ReferencePolicy("consistent"), batch(entries=ENTRIES + 12)
    other = batch(entries=ENTRIES + 12, seed=5)
    needed = [Tracking._fields.index(name) for name in NEEDED]
    other[:, needed] = rows[:, needed]
    assert policy.predict(rows)[0].tobytes() == policy.predict(other)[0].tobytes()


def test_action_is_a_float32_twist_within_the_space():
    rows = 10 * batch(500)
    action, _ = ReferencePolicy("consistent").predict(rows)
    assert action.dtype == np.float32
    assert np.abs(action).max() == 1.0


def test_on_the_reference_the_action_is_its_twist():
    observation = np.zeros(ENTRIES, dtype=np.float32)
    observation[Tracking._fields.index("cos_e_3")] = 1.0
    observation[Tracking._fields.index("reference_u_1")] = 0.8
    observation[Tracking._fields.index("reference_u_2")] = -0.5
    action, _ = ReferencePolicy("consistent").predict(observation)
    np.testing.assert_allclose(action, (0.4, -1.0 / 8), rtol=1e-6)


def test_state_passes_through():
    marker = object()
    policy = ReferencePolicy()
    assert policy.predict(batch(entries=WHOLE)[0], state=marker)[1] is marker


@pytest.mark.parametrize("shape", [(), (5,), (ENTRIES - 1,), (3, 5), (2, 3, ENTRIES), (0,)])
def test_what_is_no_tracking_observation_is_refused(shape):
    with pytest.raises(ValueError, match="shape"):
        ReferencePolicy().predict(np.zeros(shape, dtype=np.float32))


def test_unknown_gains_are_refused_naming_the_presets():
    with pytest.raises(ValueError, match=r"bold.*consistent.*printed.*tuned"):
        ReferencePolicy("bold")


def test_gains_may_be_given():
    rows = batch()
    given, _ = ReferencePolicy(TrackingGains(k_2_mm2_s=0.83)).predict(rows)
    printed, _ = ReferencePolicy("printed").predict(rows)
    consistent, _ = ReferencePolicy("consistent").predict(rows)
    assert given.tobytes() == printed.tobytes() != consistent.tobytes()


@pytest.mark.parametrize("change", [{"k_1_per_s": 0.0}, {"k_3_mm2": -1.0}, {"eta": math.nan}])
def test_impossible_gains_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        TrackingGains(**change)


def test_reference_is_not_privileged():
    assert ReferencePolicy.privileged is False
