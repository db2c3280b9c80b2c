"""Gymnasium's vector environment against single environments, and Gymnasium's own wrappers on it."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

import tlf_env  # noqa: F401  registers the environments

SHORT = {"horizon_s": 5.0, "time_gap_s": 1.0, "preview_s": (0.5,), "plant": "batch"}
ROUGH = {**SHORT, "disturbance": "combined-hard", "lost_beyond_mm": 150.0}
MODES = list(AutoresetMode)


def vector(num_envs: int = 5, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **changes):
    return gymnasium.make_vec(
        "tlf_env/Infinity-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode=mode,
        **{**ROUGH, **changes},
    )


def single(num_envs: int = 5, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **changes):
    def make():
        return gymnasium.make("tlf_env/Infinity-v0", **{**ROUGH, **changes})

    return SyncVectorEnv([make] * num_envs, autoreset_mode=mode)


def actions(num_envs: int, steps: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.5, 0.5, (steps, num_envs, 2)).astype(np.float32)


@pytest.mark.parametrize("mode", MODES[:2])
def test_it_is_gymnasiums_vector_of_single_environments(mode):
    """Every number, autoreset included, over several episodes that end in different steps."""
    one, many = vector(mode=mode), single(mode=mode)
    mine, infos = one.reset(seed=7)
    theirs, their_infos = many.reset(seed=7)
    ends = set()
    for k, action in enumerate(actions(5, 600)):
        assert np.array_equal(mine, theirs), k
        for key in ("position_error_mm", "x_mm", "lost"):
            assert np.array_equal(infos[key], their_infos[key]), (k, key)
        mine, *rest, infos = one.step(action)
        theirs, *their_rest, their_infos = many.step(action)
        for a, b in zip(rest, their_rest, strict=True):
            assert np.array_equal(a, b), k
        over = rest[1] | rest[2]
        ends |= {(k, int(i)) for i in np.flatnonzero(over)}
        assert ("final_obs" in infos) == ("final_obs" in their_infos)
        if "final_obs" in infos:
            assert np.array_equal(infos["_final_obs"], their_infos["_final_obs"])
            for i in np.flatnonzero(over):
                assert np.array_equal(infos["final_obs"][i], their_infos["final_obs"][i])
                assert (
                    infos["final_info"]["position_error_mm"][i]
                    == their_infos["final_info"]["position_error_mm"][i]
                )
    assert len(ends) > 10
    assert len({k for k, _ in ends}) > 5


def test_a_disabled_environment_is_reset_by_mask():
    one, many = vector(mode=AutoresetMode.DISABLED), single(mode=AutoresetMode.DISABLED)
    mine, _ = one.reset(seed=3)
    theirs, _ = many.reset(seed=3)
    resets = 0
    for action in actions(5, 400):
        mine, _, terminated, truncated, _ = one.step(action)
        theirs, *_ = many.step(action)
        assert np.array_equal(mine, theirs)
        over = terminated | truncated
        if over.any():
            resets += 1
            with pytest.raises(RuntimeError, match=f"sub-environment {np.flatnonzero(over)[0]}"):
                one.step(action)
            mine, _ = one.reset(options={"reset_mask": over})
            theirs, _ = many.reset(options={"reset_mask": over})
            assert np.array_equal(mine[over], theirs[over])
    assert resets > 3


def test_a_reset_by_hand_begins_the_next_episode_once():
    one, many = vector(), single()
    one.reset(seed=3)
    many.reset(seed=3)
    for action in actions(5, 400):
        _, _, terminated, truncated, _ = one.step(action)
        many.step(action)
        if (terminated | truncated).any():
            assert np.array_equal(one.reset()[0], many.reset()[0])
            return
    pytest.fail("nothing ended")


def test_what_it_declares_is_what_it_does():
    for mode in MODES:
        env = vector(mode=mode)
        assert env.metadata["autoreset_mode"] is mode
        assert env.num_envs == 5
        assert env.observation_space.shape == (5, *env.single_observation_space.shape)
        seen, _ = env.reset(seed=0)
        assert env.observation_space.contains(seen)
    assert vector(mode="SameStep").metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_episode_statistics_are_those_of_single_environments():
    mine, theirs = RecordEpisodeStatistics(vector()), RecordEpisodeStatistics(single())
    mine.reset(seed=1)
    theirs.reset(seed=1)
    found = 0
    for action in actions(5, 400):
        infos, their_infos = mine.step(action)[-1], theirs.step(action)[-1]
        assert ("episode" in infos) == ("episode" in their_infos)
        if "episode" in infos:
            mask = infos["_episode"]
            assert np.array_equal(mask, their_infos["_episode"])
            for key in ("r", "l"):
                assert np.array_equal(
                    infos["episode"][key][mask], their_infos["episode"][key][mask]
                )
            found += mask.sum()
    assert found > 5


def test_normalised_observations_are_those_of_single_environments():
    mine, theirs = NormalizeObservation(vector()), NormalizeObservation(single())
    assert np.array_equal(mine.reset(seed=1)[0], theirs.reset(seed=1)[0])
    for action in actions(5, 100):
        assert np.array_equal(mine.step(action)[0], theirs.step(action)[0])


def test_threads_change_nothing_that_is_returned():
    envs = [
        vector(50, AutoresetMode.SAME_STEP, horizon_s=0.2, threads=threads) for threads in (1, 3)
    ]
    for env in envs:
        env.reset(seed=0)
    for action in actions(50, 25):
        (mine, *rest, infos), (theirs, *their_rest, their_infos) = (
            env.step(action) for env in envs
        )
        assert np.array_equal(mine, theirs)
        for a, b in zip(rest, their_rest, strict=True):
            assert np.array_equal(a, b)
        assert infos.keys() == their_infos.keys()
        for key in ("x_mm", "clipped", "lost", "touched", "end"):
            assert np.array_equal(infos[key], their_infos[key]), key
        for key, values in infos["reward"].items():
            assert np.array_equal(values, their_infos["reward"][key]), key


def test_a_returned_observation_is_not_overwritten():
    env = vector()
    seen, _ = env.reset(seed=0)
    kept = seen.copy()
    env.step(np.zeros((5, 2), np.float32))
    assert np.array_equal(seen, kept)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"learner": "robot_7"}, "learner 'robot_7' is not one of robot_0, robot_1, robot_2"),
        ({"others": "a:b"}, "others 'a:b' must be 'reference'"),
        ({"autoreset_mode": "never"}, "autoreset_mode 'never' is not one of NextStep, SameStep"),
        ({"threads": 0}, "threads 0 must be"),
        ({"render_mode": "human"}, "render_mode 'human' must be None"),
        ({"adversary": True}, "adversary"),
    ],
)
def test_what_does_not_exist_is_one_clear_error(change, says):
    from tlf_env.envs.vector import FormationVectorEnv

    with pytest.raises(ValueError, match=says) as error:
        FormationVectorEnv("infinity", 3, **change)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "action",
    [
        np.zeros((4, 2)),
        np.full((5, 2), np.nan),
        np.full((5, 2), "0.5"),
        np.full((5, 2), 0.5j),
        None,
        [[0.0, 0.0], [0.0]],
    ],
)
def test_a_wrong_action_changes_nothing(action):
    env, other = vector(), vector()
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape|formation 0, robot_1|real numbers"):
        env.step(action)
    good = np.zeros((5, 2), np.float32)
    assert np.array_equal(env.step(good)[0], other.step(good)[0])


def test_an_unknown_option_is_refused():
    with pytest.raises(ValueError, match="reset option 'pose' is unknown"):
        vector().reset(options={"pose": 1})
    with pytest.raises(ValueError, match="'phase_s' does not exist in a vector environment"):
        vector().reset(options={"phase_s": 1.0})


def test_a_constant_reward_is_worth_its_sum_for_ever():
    """V = 1/(1 − γ) where only a true end stops the sum; a formation that is cut goes on in V."""
    gamma = 0.9
    env = vector(8, AutoresetMode.SAME_STEP, horizon_s=1.0, lost_beyond_mm=1e6, end_on=())
    env.reset(seed=0)
    value, cut = 0.0, 0
    for action in actions(8, 300):
        _, _, terminated, truncated, infos = env.step(action)
        cut += truncated.sum()
        assert not (truncated & ~infos.get("_final_obs", ~truncated)).any()
        value += 0.1 * float(np.mean(1.0 + gamma * ~terminated * value - value))
    assert cut == 8 * 6
    assert value == pytest.approx(1 / (1 - gamma), rel=0.06)
