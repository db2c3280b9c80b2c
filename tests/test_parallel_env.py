"""The PettingZoo environment: its contract, its random numbers, its ends, and the kinematic plant."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pettingzoo
import pytest
from helpers import alike, digest, play, random_actions, reference_actions, whole_episode_digest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from scipy import stats

import tlf_env
from tlf_env import EndReason
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.task.info import INFO_KEYS as ALL_KEYS
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking
from tlf_env.task.reward import RewardTerms
from tlf_env.task.trajectories import sample

HERE = Path(__file__).resolve().parent

INFO_KEYS = {
    "position_error_mm",
    "formation_error_mm",
    "heading_error_rad",
    "time_gap_error_s",
    "slip_mm_s",
    "torque_l_Nmm",
    "torque_r_Nmm",
    "saturation_fraction",
    "innovation_nis",
    "x_mm",
    "y_mm",
    "theta_rad",
    "reference_x_mm",
    "reference_y_mm",
    "reference_theta_rad",
    "clipped",
    "reward_coarse",
    "reward_touched",
    "slip_delta_1_mm_s",
    "start_heading_std_rad",
    "lost",
    "touched",
    "end",
}

scenarios = pytest.mark.parametrize("scenario", ["infinity", "flower"])


def make(scenario: str = "infinity", **overrides):
    """An environment after its reset with seed 0."""
    env = tlf_env.parallel_env(scenario, **overrides)
    env.reset(seed=0)
    return env


def constant(**by_agent):
    """A policy: the actions given, and standing still for the others."""
    return lambda env, _: {
        **alike(env),
        **{agent: np.array(action, dtype=np.float32) for agent, action in by_agent.items()},
    }


def sluggish_actions(rng: np.random.Generator, steps: int = 100):
    """Random actions that are held for 2 s: robots go far, meet and get lost."""
    held = {"left": 0, "actions": None}
    draw = random_actions(rng)

    def policy(env, observations):
        if held["left"] == 0:
            held.update(left=steps, actions=draw(env, observations))
        held["left"] -= 1
        return held["actions"]

    return policy


def without_disturbance_info(steps):
    """Returned values without the channels in the infos, which tell the settings apart."""
    channels = {channel.key for channel in CHANNELS}
    return [
        (
            *step[:4],
            {a: {k: v for k, v in i.items() if k not in channels} for a, i in step[4].items()},
        )
        for step in steps
    ]


# PettingZoo's own tests


@scenarios
@pytest.mark.filterwarnings("error")
def test_parallel_api(scenario, capsys):
    parallel_api_test(tlf_env.parallel_env(scenario), num_cycles=500)
    assert "Passed" in capsys.readouterr().out


@scenarios
@pytest.mark.filterwarnings("error")
def test_aec_api(scenario):
    api_test(tlf_env.aec_env(scenario), num_cycles=300)


@scenarios
def test_parallel_seeds(scenario):
    parallel_seed_test(lambda: tlf_env.parallel_env(scenario), num_cycles=300)


@pytest.mark.skipif(
    not hasattr(pettingzoo, "register"),
    reason="pettingzoo.make by id exists from PettingZoo 1.27 on",
)
def test_registered_names():
    env = pettingzoo.make("parallel", "tlf_env/flower-v0", robots=2)
    assert env.scenario.name == "flower"
    assert env.possible_agents == ["robot_0", "robot_1"]


# Random numbers for wrappers


def test_np_random_follows_the_seed_of_the_reset():
    def draws(env: tlf_env.envs.parallel.FormationParallelEnv) -> list[float]:
        return env.np_random.random(3).tolist()

    env = make()
    assert draws(env) != draws(env)
    env.reset(seed=5)
    first = draws(env)
    env.reset()
    assert draws(env) != first
    env.reset(seed=5)
    assert draws(env) == first


def test_drawing_from_np_random_changes_no_episode():
    plain, drawn = make(), make()
    for env in (plain, drawn):
        env.reset(seed=5)
    drawn.np_random.random(100)
    action = dict.fromkeys(plain.agents, np.zeros(2))
    for _ in range(5):
        seen, others = plain.step(action)[0], drawn.step(action)[0]
        assert all(np.array_equal(seen[agent], others[agent]) for agent in seen)


# Spaces


def test_spaces_are_the_documented_boxes():
    env = make()
    for agent in env.possible_agents:
        action, observation = env.action_space(agent), env.observation_space(agent)
        assert (action.shape, action.dtype) == ((2,), np.float32)
        assert (action.low == -1).all()
        assert (action.high == 1).all()
        assert observation.dtype == np.float32
        assert (observation.low == -10).all()
        assert (observation.high == 10).all()
        assert env.action_space(agent) is action
        assert env.observation_space(agent) is observation


@pytest.mark.parametrize("robots", [1, 2, 10])
def test_size_of_an_observation_does_not_depend_on_the_number_of_robots(robots):
    env = tlf_env.parallel_env("infinity", robots=robots)
    observations, _ = env.reset(seed=0)
    assert env.possible_agents == [f"robot_{i}" for i in range(robots)]
    assert list(observations) == env.agents == env.possible_agents
    size = len(TRACKING_ENTRIES) + 2 * 6
    assert {o.shape for o in observations.values()} == {(size,)}


@pytest.mark.parametrize("robots", [1, 10])
def test_a_single_robot_and_ten_run(robots):
    env = tlf_env.parallel_env("flower", robots=robots)
    observations, _ = env.reset(seed=0)
    leader, last = (Tracking._fields.index(name) for name in ("is_leader", "is_last"))
    roles = [(o[leader], o[last]) for o in observations.values()]
    assert [role[0] for role in roles] == [1] + [0] * (robots - 1)
    assert [role[1] for role in roles] == [0] * (robots - 1) + [1]
    steps = play(env, observations, 500)
    assert len(steps) == 500
    assert all(info["position_error_mm"] < 100 for info in steps[-1][4].values())


@scenarios
@pytest.mark.parametrize("kind", ["reference", "random", "sluggish"])
def test_observations_stay_in_their_spaces_over_whole_episodes(scenario, kind):
    env = tlf_env.parallel_env(scenario, end_on=())
    rng = np.random.default_rng(3)
    policy = {
        "reference": reference_actions,
        "random": random_actions(rng),
        "sluggish": sluggish_actions(rng),
    }[kind]
    observations, infos = env.reset(seed=5)
    space = env.observation_space("robot_0")
    count = 0
    while env.agents:
        observations, rewards, _, _, infos = env.step(policy(env, observations))
        rows = np.stack(list(observations.values()))
        assert rows.dtype == np.float32
        assert np.isfinite(rows).all()
        assert np.abs(rows).max() <= 10
        assert all(math.isfinite(reward) for reward in rewards.values())
        count += 1
    assert all(space.contains(observation) for observation in observations.values())
    assert count == env.scenario.horizon_steps
    if kind == "sluggish":
        assert any(info["lost"] for info in infos.values())
        assert all(math.isfinite(info["position_error_mm"]) for info in infos.values())


def test_a_returned_observation_is_not_overwritten():
    env = tlf_env.parallel_env("infinity")
    observations, infos = env.reset(seed=0)
    kept = digest([observations, infos])
    play(env, observations, 5)
    assert digest([observations, infos]) == kept


def test_callers_actions_are_left_alone():
    env = make()
    actions = {agent: np.array([3.0, -3.0], dtype=np.float32) for agent in env.agents}
    env.step(actions)
    assert all(action.tolist() == [3.0, -3.0] for action in actions.values())


def test_state_has_its_shape_and_tells_the_truth():
    for robots in (1, 3, 10):
        env = tlf_env.parallel_env("infinity", robots=robots, end_on=())
        _, infos = env.reset(seed=0)
        assert env.state_space.shape == env.state().shape == (12 * robots,)
        assert env.state() in env.state_space
        *_, infos = env.step(alike(env, (0.2, 0.1)))
        rows = env.state().reshape(robots, 12)
        for row, info in zip(rows, infos.values(), strict=True):
            assert 1000 * row[:2] == pytest.approx((info["x_mm"], info["y_mm"]), rel=1e-6)
            assert math.atan2(row[2], row[3]) == pytest.approx(info["theta_rad"], abs=1e-6)


# Random numbers and repetition


@scenarios
def test_a_whole_episode_repeats_bit_for_bit(scenario):
    assert whole_episode_digest(scenario, seed=7) == whole_episode_digest(scenario, seed=7)


def test_another_seed_gives_another_episode():
    short = {"horizon_s": 1.0}
    digests = {whole_episode_digest("infinity", seed, **short) for seed in range(5)}
    assert len(digests) == 5


def test_a_whole_episode_repeats_in_another_process():
    code = "from helpers import whole_episode_digest as d; print(d('infinity', 11))"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=HERE, capture_output=True, text=True, check=True
    )
    assert run.stdout.split()[-1] == whole_episode_digest("infinity", 11)


def test_an_environment_repeats_after_other_episodes_with_contact():
    env = tlf_env.parallel_env("infinity", end_on=(), horizon_s=4.0)
    ram = constant(robot_1=(1.0, 0.0))
    first = digest(play(env, env.reset(seed=2)[0], policy=ram))
    play(env, env.reset(seed=3)[0], 50, ram)
    assert digest(play(env, env.reset(seed=2)[0], policy=ram)) == first


def test_two_environments_do_not_disturb_each_other():
    def episodes():
        envs = [tlf_env.parallel_env("infinity"), tlf_env.parallel_env("flower")]
        return envs, [env.reset(seed=seed)[0] for seed, env in enumerate(envs)]

    envs, starts = episodes()
    apart = [digest(play(env, start, 200)) for env, start in zip(envs, starts, strict=True)]
    envs, observations = episodes()
    mixed = [[], []]
    for _ in range(200):
        for i, env in enumerate(envs):
            mixed[i] += play(env, observations[i], 1)
            observations[i] = mixed[i][-1][0]
    assert [digest(steps) for steps in mixed] == apart


def test_reset_without_a_seed_goes_on_to_the_next_episode_of_it():
    def three(seed):
        env = tlf_env.parallel_env("infinity")
        return [digest(play(env, env.reset(seed=s)[0], 20)) for s in (seed, None, None)]

    first, second = three(4), three(4)
    assert first == second
    assert len({*first, *three(5)}) == 6


def test_reset_without_any_seed_draws_one():
    def fresh():
        env = tlf_env.parallel_env("infinity")
        return digest(play(env, env.reset()[0], 20))

    assert fresh() != fresh()


@pytest.mark.parametrize("seed", [-1, 1.5, 2**63, "7", True])
def test_an_impossible_seed_is_refused_and_named(seed):
    with pytest.raises(ValueError, match="seed") as caught:
        tlf_env.parallel_env("infinity").reset(seed=seed)
    assert repr(seed) in str(caught.value)


@pytest.mark.parametrize("seed", [0, 2**63 - 1, np.int64(3), np.uint8(3)])
def test_possible_seeds_are_taken(seed):
    tlf_env.parallel_env("infinity").reset(seed=seed)


def test_an_unknown_reset_option_is_refused_and_named():
    with pytest.raises(ValueError, match="phaze"):
        tlf_env.parallel_env("infinity").reset(seed=0, options={"phaze": 1})


@pytest.mark.parametrize("steps", [0, 1, 137])
def test_a_pickled_environment_goes_on_with_the_same_numbers(steps):
    env = tlf_env.parallel_env("infinity")
    observations, _ = env.reset(seed=6)
    before = play(env, observations, steps)
    observations = before[-1][0] if before else observations
    copy = pickle.loads(pickle.dumps(env))
    after = digest([play(env, observations, 300), env.reset()])
    assert digest([play(copy, observations, 300), copy.reset()]) == after


def test_position_fixes_carry_white_noise_of_the_stated_variance():
    """A robot at rest knows its place, so its innovations are the noise."""
    env = make(control_period_s=0.001, horizon_s=10.0, estimator="ekf")
    nis = np.array(
        [
            [info["innovation_nis"] for info in step[4].values()]
            for step in play(env, {}, 2000, constant())
        ]
    )
    low, high = stats.chi2.interval(0.999, 2 * nis.size)
    assert low < nis.sum() < high
    bound = 4 / math.sqrt(len(nis))
    assert np.abs(np.corrcoef(nis.T) - np.eye(3)).max() < bound
    assert abs(np.corrcoef(nis[1:, 0], nis[:-1, 0])[0, 1]) < bound


# Disturbances


def steps_under(disturbance, count: int = 400, **overrides):
    env = tlf_env.parallel_env("infinity", disturbance=disturbance, end_on=(), **overrides)
    return without_disturbance_info(play(env, env.reset(seed=1)[0], count))


def test_zero_position_noise_is_no_disturbance_bit_for_bit():
    silent = digest(steps_under({"position": {"noise_std_mm": 0.0}}))
    assert silent == digest(steps_under("none"))
    assert digest(steps_under({})) == digest(steps_under("nominal")) != silent


SINGLE_CHANNELS = (
    {"slip": {"delta_1_mm_s": 8.0}},
    {"slip": {"delta_2_rad_s": 0.05}},
    {"tyre": {"friction_scale": 0.5}},
    {"position": {"noise_std_mm": 1.0}},
)


@pytest.mark.parametrize(
    "channel", SINGLE_CHANNELS, ids=lambda c: next(iter(next(iter(c.values()))))
)
def test_each_disturbance_acts_and_at_level_0_is_gone_bit_for_bit(channel):
    nothing = digest(steps_under("nominal"))
    assert digest(steps_under(channel)) != nothing
    assert digest(steps_under(channel, disturbance_level=0.0)) == nothing
    assert digest(steps_under({**channel, "level": 0})) == nothing


def test_level_scales_the_deviation_from_nominal():
    whole = {"slip": {"delta_1_mm_s": 4.0}, "tyre": {"friction_scale": 0.75}}
    twice = {"slip": {"delta_1_mm_s": 8.0}, "tyre": {"friction_scale": 0.5}}
    assert digest(steps_under(twice, disturbance_level=0.5)) == digest(steps_under(whole))


def test_one_disturbance_does_not_move_the_draws_of_another():
    """The fixes' noise under slip is that without slip: seen at rest, where nothing slips."""
    noise = {"position": {"noise_std_mm": 1.0}}
    rubber = {**noise, "tyre": {"friction_scale": 1.5}}

    def at_rest(disturbance):
        env = tlf_env.parallel_env("infinity", disturbance=disturbance)
        env.reset(seed=1)
        return digest(without_disturbance_info(play(env, {}, 50, constant())))

    assert at_rest(noise) == at_rest(rubber)


def test_info_tells_the_disturbance():
    env = make(disturbance={"slip": {"delta_1_mm_s": 8.0}}, disturbance_level=0.5)
    *_, infos = env.step(alike(env))
    assert 4.0 in infos["robot_1"].values()


# Actions

BAD = {
    "nan": np.array([math.nan, 0.0]),
    "inf": np.array([0.0, math.inf]),
    "minus inf": np.array([-math.inf, 0.0]),
    "too long": np.zeros(3),
    "a column": np.zeros((2, 1)),
    "a number": 0.5,
    "none": None,
    "words": ["fast", "left"],
    "two nones": [None, None],
    "ragged": [[1.0], [1.0, 2.0]],
    "numbers in words": ["0.5", "0.5"],
    "an array of words": np.array(["0.5", "0.5"]),
    "complex": np.array([0.5, 0.5 + 1j]),
}


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD.keys())
@pytest.mark.parametrize("agent", ["robot_0", "robot_2"])
def test_a_bad_action_names_its_robot_and_leaves_the_episode_as_it_was(bad, agent):
    env, undisturbed = make(), make()
    for one in (env, undisturbed):
        play(one, one.reset(seed=0)[0], 30)
    state = env.state().tobytes()
    with pytest.raises(ValueError, match=agent) as caught:
        env.step({**alike(env, (0.3, 0.1)), agent: bad})
    assert "\n" not in str(caught.value)
    assert env.state().tobytes() == state
    assert env.agents == undisturbed.agents
    go_on = constant(robot_0=(0.2, 0.1))
    assert digest(play(env, {}, 30, go_on)) == digest(play(undisturbed, {}, 30, go_on))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda actions: actions.pop("robot_1"), "robot_1"),
        (lambda actions: actions.update(robot_9=np.zeros(2)), "robot_9"),
        (lambda actions: actions.update(robot_9=actions.pop("robot_1")), "robot_9"),
        (lambda actions: actions.clear(), "robot_0"),
    ],
    ids=["missing", "unknown", "renamed", "none at all"],
)
def test_actions_for_the_wrong_agents_are_refused_and_named(change, named):
    env, undisturbed = make(), make()
    actions = alike(env)
    change(actions)
    with pytest.raises(ValueError, match=named):
        env.step(actions)
    go_on = constant(robot_0=(0.2, 0.1))
    assert digest(play(env, {}, 30, go_on)) == digest(play(undisturbed, {}, 30, go_on))


def test_order_of_the_actions_does_not_matter():
    forward, backward = make(), make()
    actions = {f"robot_{i}": np.array([0.1 * i, 0.05], dtype=np.float32) for i in range(3)}
    turned = dict(reversed(actions.items()))
    assert digest(forward.step(actions)) == digest(backward.step(turned))


def test_actions_outside_are_clipped_and_counted():
    env, within = make(), make()
    wild, tame = constant(robot_1=(0.5, -7.0)), constant(robot_1=(0.5, -1.0))
    for count in (1, 2, 3):
        outside, inside = env.step(wild(env, {})), within.step(tame(within, {}))
        assert outside[4]["robot_1"]["clipped"] == count
        assert outside[4]["robot_0"]["clipped"] == inside[4]["robot_1"]["clipped"] == 0
        assert digest(outside[:4]) == digest(inside[:4])
    env.reset(seed=0)
    assert env.step(alike(env))[4]["robot_1"]["clipped"] == 0


def test_step_before_reset_is_an_error():
    with pytest.raises(RuntimeError, match="reset"):
        tlf_env.parallel_env("infinity").step({})


def test_wheel_speed_and_twist_actions_agree():
    """1000 mm/s forward is 20 rad/s of both wheels, 0.8 of the wheels' unit."""
    twist, wheels = make(action="twist"), make(action="wheel_speed")
    by_twist = play(twist, {}, 100, constant(robot_0=(0.25, 0.0)))
    by_wheels = play(wheels, {}, 100, constant(robot_0=(0.2, 0.2)))
    for name in ("x_mm", "y_mm", "theta_rad"):
        assert by_twist[-1][4]["robot_0"][name] == pytest.approx(
            by_wheels[-1][4]["robot_0"][name], rel=1e-5
        )


# Ends


def check_end(step, ended: dict[str, EndReason]) -> None:
    """The robots in ``ended`` have ended for the reason given; the others are cut off by them."""
    _, _, terminated, truncated, infos = step
    for agent, info in infos.items():
        assert terminated[agent] is (agent in ended)
        assert truncated[agent] is (agent not in ended)
        assert info["end"] == ended.get(agent, EndReason.OTHER_ROBOT)


def check_goes_on(steps) -> None:
    for step in steps:
        assert not any(step[2].values())
        assert not any(step[3].values())
        assert not any(info["end"] for info in step[4].values())


def test_a_lost_leader_ends_the_episode():
    """It stands still and its reference leaves."""
    env = make()
    steps = play(env, {}, policy=constant())
    check_goes_on(steps[:-1])
    check_end(steps[-1], {"robot_0": EndReason.LOST})
    assert env.agents == []
    assert steps[-2][4]["robot_0"]["position_error_mm"] <= 1200
    assert steps[-1][4]["robot_0"]["position_error_mm"] > 1200
    assert steps[-1][4]["robot_0"]["lost"]
    assert not steps[-1][4]["robot_1"]["lost"]
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_a_lost_follower_ends_the_episode():
    env = make(start_spacing_mm=2000.0, lost_beyond_mm=700.0)

    def policy(env, observations):
        retreat = np.array([-0.4, 0.0], dtype=np.float32)
        return {**reference_actions(env, observations), "robot_1": retreat}

    steps = play(env, env.reset(seed=0)[0], policy=policy)
    check_goes_on(steps[:-1])
    check_end(steps[-1], {"robot_1": EndReason.LOST})
    assert env.agents == []


def test_robots_that_touch_end_the_episode():
    env = make()
    steps = play(env, {}, policy=constant(robot_1=(0.4, 0.0)))
    check_goes_on(steps[:-1])
    check_end(steps[-1], dict.fromkeys(("robot_0", "robot_1"), EndReason.TOUCHED))
    assert env.agents == []
    infos = steps[-1][4]
    assert [infos[agent]["touched"] for agent in infos] == [True, True, False]
    gap = math.dist(*([infos[a]["x_mm"], infos[a]["y_mm"]] for a in ("robot_0", "robot_1")))
    outline = 2 * env.scenario.robot.outline_radius_mm
    assert outline - 2 < gap <= outline + 0.01


def test_the_horizon_cuts_all_off():
    env = make(horizon_s=0.5)
    steps = play(env, {}, policy=constant())
    assert len(steps) == 25
    check_goes_on(steps[:-1])
    _, _, terminated, truncated, infos = steps[-1]
    assert not any(terminated.values())
    assert all(truncated.values())
    assert {info["end"] for info in infos.values()} == {EndReason.HORIZON}
    assert env.agents == []


def test_without_end_on_the_episode_goes_on_to_the_horizon():
    env = make(end_on=(), horizon_s=10.0)
    steps = play(env, {}, policy=constant(robot_1=(0.4, 0.0)))
    assert len(steps) == env.scenario.horizon_steps
    check_goes_on(steps[:-1])
    infos = steps[-1][4]
    assert infos["robot_0"]["touched"]
    assert infos["robot_1"]["touched"]
    assert infos["robot_0"]["lost"]
    assert {info["end"] for info in infos.values()} == {EndReason.HORIZON}


def test_end_on_chooses_the_reason():
    ram = constant(robot_1=(0.4, 0.0))
    only_lost = play(make(end_on=("lost",)), {}, policy=ram)
    assert only_lost[-1][4]["robot_1"]["touched"]
    assert EndReason.LOST in {info["end"] for info in only_lost[-1][4].values()}
    only_touched = play(make(end_on=("touched",), horizon_s=5.0), {}, policy=constant())
    assert only_touched[-1][4]["robot_0"]["lost"]
    assert only_touched[-1][4]["robot_0"]["end"] == EndReason.HORIZON


def test_an_episode_can_be_left_and_started_anew():
    env = make()
    play(env, {}, policy=constant())
    observations, _ = env.reset(seed=0)
    assert env.agents == env.possible_agents
    again = make()
    assert digest(play(env, observations, 50)) == digest(play(again, again.reset(seed=0)[0], 50))


# Reward and info


@pytest.mark.parametrize(
    "infos",
    [
        False,
        ("end", "reward_fine", "slip_delta_1_mm_s", "time_gap_error_s"),
        ("slip_delta_2_rad_s", "slip_delta_1_mm_s"),
        ALL_KEYS[::-1],
    ],
)
def test_infos_may_be_chosen(infos):
    """Their keys come in the order of the choice, with the same values, and a changed info changes no other."""
    envs = [
        tlf_env.parallel_env("infinity", infos=one, disturbance="slip-noise")
        for one in (infos, True)
    ]
    results = [[env.reset(seed=3)[-1] for env in envs]]
    for _ in range(30):
        actions = {agent: np.array([0.5, -0.5]) for agent in envs[0].agents}
        results.append([env.step(actions)[-1] for env in envs])
        for info in results[-1][0].values():
            for key, value in list(info.items()):
                info[key] = None
                info[f"_{key}"] = value
    assert (
        len({one["robot_1"].get("_slip_delta_1_mm_s") for one, _ in results[1:]}) > 1 or not infos
    )
    for mine, theirs in results:
        for agent, info in mine.items():
            values = [info.get(f"_{key}", info.get(key)) for key in infos or ()]
            assert list(info)[: len(values)] == list(infos or ())
            np.testing.assert_array_equal(values, [theirs[agent][key] for key in infos or ()])


def test_info_has_its_keys():
    env = tlf_env.parallel_env("infinity")
    observations, infos = env.reset(seed=0)
    keys = set(infos["robot_0"])
    assert keys >= INFO_KEYS
    assert all(set(info) == keys for info in infos.values())
    for step in play(env, observations, 3):
        assert all(set(info) == keys for info in step[4].values())
        assert len({id(info) for info in step[4].values()}) == 3


def test_reward_is_the_weighted_sum_of_its_terms():
    for weights in ({}, {"fine": 3.0, "action_size": -1.0, "slip": 0.0, "touched": -5.0}):
        env = make(reward=weights)
        ram = constant(robot_1=(0.4, 0.1))
        steps = play(env, {}, policy=ram)
        assert steps[-1][4]["robot_1"]["touched"]
        for _, rewards, _, _, infos in steps:
            for agent, reward in rewards.items():
                total = sum(
                    weight * infos[agent][f"reward_{name}"]
                    for name, weight in env.scenario.reward.items()
                )
                assert reward == pytest.approx(total, rel=1e-12, abs=1e-12)


def test_reward_terms_are_what_they_say():
    env = make(lost_beyond_mm=100.0)
    last = np.zeros(2)
    rng = np.random.default_rng(0)
    draw = random_actions(rng)
    steps = []
    while env.agents:
        actions = draw(env, {})
        steps.append(env.step(actions))
        info, action = steps[-1][4]["robot_0"], actions["robot_0"].astype(float)
        error = info["position_error_mm"]
        terms = {name: info[f"reward_{name}"] for name in RewardTerms._fields}
        assert terms["coarse"] == pytest.approx(math.exp(-error / 100))
        assert terms["medium"] == pytest.approx(math.exp(-error / 10))
        assert terms["fine"] == pytest.approx(math.exp(-error / 2))
        assert terms["action_size"] == pytest.approx(action @ action)
        assert terms["action_change"] == pytest.approx((action - last) @ (action - last))
        assert terms["slip"] == pytest.approx(info["slip_mm_s"] / 100)
        assert terms["lost"] == (1.0 if error > 100 else 0.0)
        last = action
    assert steps[-1][4]["robot_0"]["end"] == EndReason.LOST


def test_errors_are_those_of_the_true_pose():
    env = tlf_env.parallel_env("infinity", end_on=())
    steps = play(env, env.reset(seed=0)[0], 800)
    times = 0.02 * np.arange(1, 801)
    path = sample(env.scenario.trajectory, np.arange(0, 17, 0.02))
    for t_s, step in zip(times, steps, strict=True):
        for i, info in enumerate(step[4].values()):
            here = np.array([info["x_mm"], info["y_mm"]])
            own = np.array([info["reference_x_mm"], info["reference_y_mm"]])
            assert info["position_error_mm"] == pytest.approx(math.dist(here, own))
            wanted = path[max(round((t_s - 5.0 * i) / 0.02), 0), :2]
            assert info["formation_error_mm"] == pytest.approx(math.dist(here, wanted))
            turn = math.remainder(info["reference_theta_rad"] - info["theta_rad"], 2 * math.pi)
            assert info["heading_error_rad"] == pytest.approx(turn, abs=1e-12)


def test_time_gap_error_is_how_late_a_follower_is():
    """At 100 mm/s and 300 mm apart a robot passes 3 s after its predecessor: 1 s more than the gap."""
    env = make(
        plant="kinematic", disturbance="none", time_gap_s=2.0, end_on=(), start_spacing_mm=300.0
    )
    steps = play(env, {}, 400, lambda env, _: alike(env, (0.1, 0.0)))
    for step in steps[200:]:
        infos = step[4]
        assert infos["robot_0"]["time_gap_error_s"] == 0
        assert infos["robot_1"]["time_gap_error_s"] == pytest.approx(1.0, abs=1e-6)
        assert infos["robot_2"]["time_gap_error_s"] == pytest.approx(1.0, abs=1e-6)
    assert all(info["time_gap_error_s"] == 0 for step in steps[:99] for info in step[4].values())


def test_torques_stay_within_their_limit_and_saturation_is_reported():
    env = make(end_on=())
    steps = play(env, env.reset(seed=0)[0], 300)
    infos = [info for step in steps for info in step[4].values()]
    torques = np.array([[info["torque_l_Nmm"], info["torque_r_Nmm"]] for info in infos])
    saturation = np.array([info["saturation_fraction"] for info in infos])
    assert np.abs(torques).max() <= 15 * (1 + 1e-12)
    assert 0 <= saturation.min() < saturation.max() == 1.0
    at_limit = np.abs(torques).max(axis=1) > 15 * (1 - 1e-12)
    assert (saturation[at_limit] == 1).all()


# The kinematic plant


@pytest.mark.parametrize(("delta_1", "delta_2"), [(0.0, 0.0), (40.0, -0.2)])
def test_the_kinematic_plant_moves_by_eq_14(delta_1, delta_2):
    """A constant twist and slip: an arc. Wheels and encoders know nothing of the slip."""
    slip = {"slip": {"delta_1_mm_s": delta_1, "delta_2_rad_s": delta_2}}
    env = tlf_env.parallel_env(
        "infinity", robots=2, plant="kinematic", disturbance=slip, end_on=(), horizon_s=10.0
    )
    _, infos = env.reset(seed=0)
    start = infos["robot_0"]
    action = np.array([0.25, 0.125], dtype=np.float32)  # exact in binary
    for k, step in enumerate(play(env, {}, 500, constant(robot_0=action)), start=1):
        t_s, (v, w) = 0.02 * k, (250 + delta_1, 1.0 + delta_2)
        theta = start["theta_rad"] + w * t_s
        x = start["x_mm"] + v / w * (math.cos(theta) - math.cos(start["theta_rad"]))
        y = start["y_mm"] + v / w * (math.sin(theta) - math.sin(start["theta_rad"]))
        info = step[4]["robot_0"]
        assert info["theta_rad"] == pytest.approx(theta, abs=1e-9)
        assert (info["x_mm"], info["y_mm"]) == pytest.approx((x, y), abs=1e-3)
        odometry = [
            step[0]["robot_0"][Tracking._fields.index(f"odometry_u_{i}")] * scale
            for i, scale in ((1, 500.0), (2, 2.0))
        ]
        assert odometry == pytest.approx((250.0, 1.0), rel=1e-6)


def test_on_the_kinematic_plant_robots_touch_too():
    env = make(plant="kinematic")
    steps = play(env, {}, policy=constant(robot_1=(0.4, 0.0)))
    check_end(steps[-1], dict.fromkeys(("robot_0", "robot_1"), EndReason.TOUCHED))
