"""Gymnasium's vector environment against single environments, and Gymnasium's own wrappers on it."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

import tlf_env
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.info import INFO_KEYS

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
        for key in INFO_KEYS:
            assert np.array_equal(infos[key], their_infos[key]), key


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


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_infos_and_masks_are_gymnasiums_own(mode):
    """Every key, value, type and mask, over autoresets."""
    one, many = vector(4, AutoresetMode(mode)), single(4, AutoresetMode(mode))
    pairs = [(one.reset(seed=7)[1], many.reset(seed=7)[1])]
    pairs += [(one.step(action)[-1], many.step(action)[-1]) for action in actions(4, 300)]
    finals = 0
    for mine, theirs in pairs:
        assert set(mine) == set(theirs)
        finals += "final_info" in theirs
        for names in (mine, theirs):
            names.update({f"final_{k}": v for k, v in names.pop("final_info", {}).items()})
            names.pop("final_obs", None)  # objects; compared elsewhere
        assert set(mine) == set(theirs)
        for key, wanted in theirs.items():
            assert np.array_equal(mine[key], wanted), key
            assert mine[key].dtype == wanted.dtype, key
    assert finals > 3 or mode == "NextStep"


def test_masks_mark_what_was_reset_and_share_no_memory():
    env = vector(5)
    env.reset(seed=0)
    env.step(np.full((5, 2), 0.3, np.float32))
    mask = np.array([False, True, False, False, True])
    _, infos = env.reset(options={"reset_mask": mask})
    for key in INFO_KEYS:
        assert np.array_equal(infos[f"_{key}"], mask)
        assert not infos[key][~mask].any()
    masks = [infos[f"_{key}"] for key in INFO_KEYS]
    masks[0][:] = True
    assert all(np.array_equal(one, mask) for one in masks[1:])
    infos["x_mm"][:] = 1.0
    assert not (infos["y_mm"] == 1.0).any()


@pytest.mark.parametrize("infos", [False, ("end", "reward_fine", "slip_delta_1_mm_s")])
def test_infos_may_be_left_out(infos):
    env, full = vector(5, infos=infos), vector(5)
    wanted = set(infos or ())
    results = [(env.reset(seed=0), full.reset(seed=0))]
    results += [(env.step(a), full.step(a)) for a in actions(5, 50)]
    for mine, theirs in results:
        assert set(mine[-1]) == wanted | {f"_{key}" for key in wanted}
        for key, value in mine[-1].items():
            assert np.array_equal(value, theirs[-1][key])
        for a, b in zip(mine[:-1], theirs[:-1], strict=True):
            assert np.array_equal(a, b)


def test_each_sub_environment_may_start_in_its_own_way():
    """As single environments do, with options of their own; the next episodes start as usual."""
    count = 3
    env = vector(count, horizon_s=1.0, time_gap_s=0.5)
    alone = [single(1, horizon_s=1.0, time_gap_s=0.5) for _ in range(count)]
    phases = [0.0, 11.5, -3.0]
    poses = np.zeros((count, 3, 3))
    poses[:, :, 1] = [0.0, -400.0, -800.0]
    poses[:, :, 2] = np.linspace(-0.3, 0.3, 9).reshape(3, 3)
    seen, infos = env.reset(seed=4, options={"phase_s": phases, "poses": poses})
    theirs = [
        one.reset(seed=4 + k, options={"phase_s": phases[k], "poses": poses[k]})
        for k, one in enumerate(alone)
    ]
    for action in actions(count, 130):  # two and a half episodes
        assert np.array_equal(seen, np.concatenate([one[0] for one in theirs]))
        for key in INFO_KEYS:
            assert np.array_equal(infos[key], np.concatenate([one[-1][key] for one in theirs]))
        seen, *_, infos = env.step(action)
        theirs = [one.step(action[k : k + 1]) for k, one in enumerate(alone)]


@pytest.mark.parametrize("mode", MODES)
def test_a_reset_after_the_end_takes_its_options(mode):
    """Also where the next episode of an ended formation has started already."""
    short = {"horizon_s": 0.4, "time_gap_s": 0.4, "preview_s": (), "end_on": ()}
    env, alone = vector(2, mode, **short), [single(1, mode, **short) for _ in range(2)]
    env.reset(seed=9)
    for k, one in enumerate(alone):
        one.reset(seed=9 + k)
    for action in actions(2, 20):
        *_, truncated, _ = env.step(action)
        for k, one in enumerate(alone):
            one.step(action[k : k + 1])
    assert truncated.all()
    options = {"phase_s": 5.0}
    seen, _ = env.reset(options=dict(options))
    theirs = [one.reset(options=dict(options))[0] for one in alone]
    assert np.array_equal(seen, np.concatenate(theirs))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"phase_s": [0.0, 1.0]}, r"phase_s must be a finite number of seconds, or that for each"),
        ({"phase_s": np.nan}, "phase_s must be a finite number"),
        ({"poses": np.zeros((2, 3))}, r"poses must be 3 finite rows .* got the shape \(2, 3\)"),
        (
            {"poses": np.zeros((4, 3, 3))},
            r"poses must be 3 finite rows .* got the shape \(4, 3, 3\)",
        ),
        ({"poses": np.full((5, 3, 3), np.nan)}, "poses must be 3 finite rows"),
        ("phase_s", "reset options must be a mapping, got 'phase_s'"),
        ({"reset_mask": np.ones(4, dtype=bool)}, r"mask must be \(5,\) bool"),
        ({"speed": 1}, "reset option 'speed' is unknown; the options are poses, phase_s"),
    ],
)
def test_an_impossible_option_changes_nothing(options, says):
    env, other = vector(), vector()
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match=says) as error:
        env.reset(options=options)
    assert "\n" not in str(error.value)
    good = np.zeros((5, 2), np.float32)
    assert np.array_equal(env.step(good)[0], other.step(good)[0])


def test_a_seed_may_be_given_to_some_only():
    env, alone = vector(3), [single(1) for _ in range(3)]
    env.reset(seed=[4, 5, 6])
    for one, seed in zip(alone, (4, 5, 6), strict=True):
        one.reset(seed=seed)
    seen, _ = env.reset(seed=[1, None, 3])
    theirs = [one.reset(seed=seed)[0] for one, seed in zip(alone, (1, None, 3), strict=True)]
    assert np.array_equal(seen, np.concatenate(theirs))
    fresh = vector(3)
    fresh.reset(seed=[1, None, 3])
    assert fresh.plant.seeds[0] == 1
    assert fresh.plant.seeds[2] == 3


def test_a_seed_seeds_np_random():
    def draw(seed):
        env = vector(2)
        env.reset(seed=seed)
        return env.np_random.random(), env.np_random_seed

    assert draw(5) == draw(5) == draw(np.int64(5)) == draw([5, None])
    assert draw(5) != draw(6)


@pytest.mark.parametrize("steps", [1, 7, 10**6])
def test_max_episode_steps_is_gymnasiums_time_limit(steps):
    """As gymnasium.make shortens a single environment; a larger number changes nothing."""
    env = vector(3, max_episode_steps=steps)
    limited = gymnasium.make("tlf_env/Infinity-v0", max_episode_steps=steps, **ROUGH)
    horizon = min(steps, limited.unwrapped.scenario.horizon_steps)
    assert env.spec.max_episode_steps == env.scenario.horizon_steps == horizon
    seen, _ = env.reset(seed=3)
    assert np.array_equal(seen[0], limited.reset(seed=3)[0])
    for k, action in enumerate(actions(3, 12)):
        seen, _, terminated, truncated, infos = env.step(action)
        one = limited.step(action[0])
        assert np.array_equal(seen[0], one[0])
        assert (terminated[0], truncated[0]) == one[2:4]
        assert truncated[0] == (k + 1 == horizon)
        assert infos["end"][0] == (tlf_env.EndReason.HORIZON if k + 1 == horizon else 0)
        if k + 1 == horizon:
            break


@pytest.mark.filterwarnings("error")
def test_a_shortened_horizon_warns_of_nothing_that_lies_beyond_it():
    sensor = {"observation": "sensor", "horizon_s": 2000.0}
    with pytest.warns(UserWarning, match="max_episode_steps 20") as caught:
        gymnasium.make_vec("tlf_env/Infinity-v0", 2, max_episode_steps=20, **sensor)
    assert [str(one.message) for one in caught] == [
        "max_episode_steps 20 ends episodes before horizon_s 2000, which is 100000 steps"
    ]
    gymnasium.make_vec("tlf_env/Infinity-v0", 2, max_episode_steps=20)


def test_the_length_in_a_copied_specification_does_not_hide_a_longer_horizon():
    says = "max_episode_steps 250 ends episodes before horizon_s 60, which is 3000 steps"
    with pytest.warns(UserWarning, match=says):
        gymnasium.make_vec(vector(2).spec, horizon_s=60.0)


def test_a_partial_reset_leaves_the_other_rows():
    """Also of a formation that has ended, and starts again in the next step."""
    ends = {"horizon_s": 0.4, "time_gap_s": 0.4, "preview_s": (), "end_on": ()}
    env, many = vector(3, **ends), single(3, **ends)
    env.reset(seed=2)
    many.reset(seed=2)
    for action in actions(3, 20):
        last, _, _, truncated, _ = env.step(action)
        many.step(action)
    assert truncated.all()
    mask = np.array([True, False, True])
    seen, _ = env.reset(options={"reset_mask": mask.copy()})
    theirs, _ = many.reset(options={"reset_mask": mask.copy()})
    assert np.array_equal(seen, theirs)
    assert np.array_equal(seen[1], last[1])
    for action in actions(3, 10):
        assert np.array_equal(env.step(action)[0], many.step(action)[0])


@pytest.mark.parametrize("seed", [np.array(3), np.int64(3)])
def test_a_seed_of_numpy_is_a_seed(seed):
    env, other = vector(2), vector(2)
    assert np.array_equal(env.reset(seed=seed)[0], other.reset(seed=3)[0])


@pytest.mark.parametrize("seed", ["3", b"abc", 2.0, [1.5, 2], True])
def test_an_impossible_seed_is_named(seed):
    with pytest.raises(ValueError, match="must be a whole number from 0"):
        vector(2).reset(seed=seed)


def test_the_number_of_formations_has_one_name():
    with pytest.raises(TypeError, match="unexpected keyword argument 'formations'; use num_envs"):
        vector(2, formations=3)
    with pytest.raises(TypeError, match="unexpected keyword argument 'num_envs'; use formations"):
        tlf_env.BatchPlant("infinity", 2, num_envs=3)


@pytest.mark.parametrize("steps", [0, -1, 2.5, True, "7"])
def test_an_impossible_number_of_steps_is_named(steps):
    with pytest.raises(ValueError, match=f"max_episode_steps {steps!r} must be a whole number"):
        vector(2, max_episode_steps=steps)


def test_without_gymnasiums_maker_there_is_no_specification():
    env = FormationVectorEnv("infinity", 2)
    assert env.spec is None
    assert repr(env) == "FormationVectorEnv(num_envs=2)"


def test_the_specification_knows_the_episode():
    env = gymnasium.make("tlf_env/Infinity-v0", **SHORT)
    assert env.spec.max_episode_steps == 250
    assert gymnasium.spec("tlf_env/Infinity-v0").max_episode_steps is None
    again = gymnasium.make(env.spec)
    assert again.spec.max_episode_steps == 250
    assert vector(2).spec.max_episode_steps == 250
    aware = gymnasium.wrappers.TimeAwareObservation(env)
    assert aware.reset(seed=0)[0].shape == (env.observation_space.shape[0] + 1,)


def test_a_scenario_cannot_be_assigned():
    other = tlf_env.load_scenario("flower")
    single_env = gymnasium.make("tlf_env/Infinity-v0", **SHORT).unwrapped
    for env in (vector(2), single_env, tlf_env.parallel_env("infinity")):
        before = env.scenario
        with pytest.raises(AttributeError, match="scenario"):
            env.scenario = other
        assert env.scenario is before


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
