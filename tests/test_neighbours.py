"""Neighbours: what robots of a row see of their predecessors, and the claims of the page about it."""

from __future__ import annotations

import importlib
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from page_tables import DOCS

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")

sys.path.insert(0, str(DOCS / "figures"))
arms = importlib.import_module("neighbours_arms")

# A gap of 5 control steps, episodes of 12.
SHORT = {
    "time_gap_s": 0.1,
    "horizon_s": 0.24,
    "preview_s": [0.02],
    "action": "tracking_twist",
    "disturbance": "slip-noise",
}
GAP, HORIZON, ROBOTS, FORMATIONS = 5, 12, 3, 4


def made(name, **more):
    arm = arms.Arm(name, **more)
    envs = arms.environments(arm, "infinity", FORMATIONS, robots=ROBOTS, infos=False, **SHORT)
    envs.seed(3)
    return envs, envs.reset()


def plain_rows(envs):
    """The observations without what the arm adds."""
    plants = [plant.observations for plant in envs.plants]
    return np.concatenate([one.reshape(-1, one.shape[2]) for one in plants]).copy()


def actions_of(envs, step):
    generator = np.random.default_rng(step)
    return generator.uniform(-1, 1, size=(envs.num_envs, envs.action_space.shape[0]))


def ahead(rows):
    """From the definition: the row of the predecessor, 0 for the leader."""
    found = np.zeros_like(rows)
    for i in range(len(rows)):
        if i % ROBOTS:
            found[i] = rows[i - 1]
    return found


@pytest.mark.parametrize("by_path", [False, True])
def test_a_robot_gets_its_predecessors_observation_of_now_and_of_one_gap_ago(by_path):
    envs, seen = made("shared", by_path=by_path)
    size = plain_rows(envs).shape[1]
    assert envs.observation_space.shape == (3 * size,)
    rows = [plain_rows(envs)]
    for step in range(2 * HORIZON + 3):
        at = step % HORIZON  # of an episode; the next one begins with nothing
        past = ahead(rows[step - GAP]) if at >= GAP else np.zeros_like(rows[step])
        wanted = np.concatenate([rows[step], ahead(rows[step]), past], axis=1)
        np.testing.assert_array_equal(seen, wanted)
        seen, _, dones, infos = envs.step(actions_of(envs, step))
        assert dones.all() == (at == HORIZON - 1)
        if dones.any():  # the last observation of an episode still has its past
            last = np.stack([info["terminal_observation"] for info in infos])
            np.testing.assert_array_equal(last[:, size : 2 * size], ahead(last[:, :size]))
            np.testing.assert_array_equal(last[:, 2 * size :], ahead(rows[step + 1 - GAP]))
        rows.append(plain_rows(envs))
    assert np.abs(seen[:, 2 * size :]).max() == 0  # and the two parts were not equal before:
    assert any((one[1:] != two[1:]).any() for one, two in zip(rows[GAP:], rows, strict=False))


def test_a_formation_that_is_begun_anew_has_no_past_and_the_others_keep_theirs():
    envs, _ = made("shared")
    size = plain_rows(envs).shape[1]
    for step in range(GAP + 1):
        envs.step(actions_of(envs, step))
    before = envs.observations()[:, 2 * size :]
    envs.begin_next(0, np.arange(FORMATIONS) == 1)
    after = envs.observations()[:, 2 * size :]
    begun = np.arange(envs.num_envs) // ROBOTS == 1
    assert not after[begun].any()
    np.testing.assert_array_equal(after[~begun], before[~begun])
    assert before[begun][1:].any()


def test_a_message_arrives_in_the_next_step_and_one_gap_later_and_moves_nothing():
    envs, seen = made("sent")
    other, _ = made("heard")
    size = plain_rows(envs).shape[1]
    assert envs.action_space.shape == (arms.TWIST + arms.MESSAGE,)
    assert not seen[:, size:].any()
    messages = []
    for step in range(HORIZON - 1):
        actions = actions_of(envs, step) * 1.5  # beyond the range they are clipped
        messages.append(ahead(np.clip(actions[:, arms.TWIST :], -1, 1).astype(np.float32)))
        seen = envs.step(actions)[0]
        late = messages[step + 1 - GAP] if step + 1 >= GAP else np.zeros_like(messages[0])
        np.testing.assert_array_equal(seen[:, size:], np.concatenate([messages[-1], late], axis=1))
        np.testing.assert_array_equal(other.step(actions[:, : arms.TWIST])[0], plain_rows(envs))
    assert not envs.step(actions)[0][:, size:].any()  # the next episode


def test_the_own_arm_has_nothing_of_the_predecessor_and_all_the_rest():
    envs, seen = made("own")
    _, rows = made("heard")
    names = arms.entry_names(envs.plants[0].scenario)
    of_predecessor = np.array([name.startswith("predecessor_") for name in names])
    assert of_predecessor.sum() == 6
    assert rows[1][of_predecessor].any()
    assert not seen[:, of_predecessor].any()
    np.testing.assert_array_equal(seen[:, ~of_predecessor], rows[:, ~of_predecessor])


@pytest.mark.parametrize("name", ["own", "heard", "shared", "sent"])
def test_a_policy_sees_in_a_run_what_its_environments_showed(name):
    envs, seen = made(name)
    scenario = envs.plants[0].scenario
    shown = []

    def predict(rows, deterministic):
        shown.append(rows.copy())
        return actions_of(envs, len(shown) - 1).astype(np.float32), None

    policy = arms.RowPolicy(SimpleNamespace(predict=predict), envs._arm, scenario)
    state, start = None, np.ones(envs.num_envs, dtype=np.bool_)
    for step in range(HORIZON + 2):
        acted, state = policy.predict(plain_rows(envs), state, start)
        np.testing.assert_array_equal(shown[-1], seen)
        actions = actions_of(envs, step).astype(np.float32)
        np.testing.assert_array_equal(acted, actions[:, : arms.TWIST])
        seen, _, start, _ = envs.step(actions)


def test_rewards_by_the_path_have_the_distance_to_the_leaders_path():
    envs, _ = made("heard", by_path=True)
    other, _ = made("heard")
    weights = envs.plants[0].scenario.reward
    for step in range(HORIZON):
        actions = actions_of(envs, step)
        rewards, plain = envs.step(actions)[1], other.step(actions)[1]
        if step == HORIZON - 1:  # the last step keeps its reward
            np.testing.assert_array_equal(rewards, plain)
            break
        by_path, own = (
            other.plants[0].info(f"{name}_error_mm").ravel() for name in ("formation", "position")
        )

        def worth(e):
            e = e[:, np.newaxis]
            parts = {
                "far": e / 1000,
                "coarse": np.exp(-e / 100),
                "medium": np.exp(-e / 10),
                "fine": np.exp(-e / 2),
            }
            return np.concatenate([weights[key] * part for key, part in parts.items()], axis=1).sum(
                axis=1
            )

        np.testing.assert_allclose(rewards - plain, worth(by_path) - worth(own), atol=1e-5)
        leaders = np.arange(envs.num_envs) % ROBOTS == 0
        np.testing.assert_array_equal(rewards[leaders], plain[leaders])
        assert (rewards[~leaders] != plain[~leaders]).any()


def test_tasks_with_different_gaps_are_refused():
    with pytest.raises(ValueError, match=r"time_gap_s 0\.2, the first task 5;"):
        arms.environments(
            arms.ARMS["shared"],
            {
                "a": ["infinity"],
                "b": {"name": "b", "base": "infinity", "time_gap_s": 0.2},
            },
            2,
            **{key: value for key, value in SHORT.items() if key != "time_gap_s"},
        )
