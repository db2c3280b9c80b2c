"""The learning libraries' interfaces: what their checkers demand, and what a learner relies on."""

from __future__ import annotations

import hashlib
import itertools
import multiprocessing
import pickle
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics

import tlf_env
from baselines import ReferencePolicy
from tlf_env import EndReason
from tlf_env.envs.single import FormationEnv
from tlf_env.task.observation import tracking_entries
from tlf_env.task.trajectories import sample

pettingzoo_test = pytest.importorskip(
    "pettingzoo.test"
)  # imports deprecated games: not a test of us

ACTIONS = ("twist", "wheel_speed", "torque", "residual", "tracking_twist")
OBSERVATIONS = ("tracking", "sensor")
PLANTS = ("pymunk", "kinematic")
KINDS = [
    kind
    for kind in itertools.product(ACTIONS, OBSERVATIONS, PLANTS)
    if kind[0] != "torque" or kind[2] != "kinematic"
]
AGENTS = ("robot_0", "robot_1", "robot_2")

every_kind = pytest.mark.parametrize(("action", "observation", "plant"), KINDS)
no_warnings = pytest.mark.filterwarnings("error")
pettingzoo_ids = pytest.mark.skipif(
    not hasattr(pettingzoo, "register"),
    reason="pettingzoo.make by id exists from PettingZoo 1.27 on",
)


class Idle:
    """Drives nowhere."""

    def predict(self, observation: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, Any]:
        return np.zeros((len(observation), 2), observation.dtype), None


class Recorder(ReferencePolicy):
    """The reference, remembering how it was asked; its state counts the calls."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[tuple[int, ...], Any, list[bool], bool]] = []

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        assert episode_start is not None
        self.calls.append((observation.shape, state, episode_start.tolist(), deterministic))
        return super().predict(observation)[0], (state or 0) + 1


def random_actions(env: gymnasium.Env, steps: int, seed: int = 0) -> list[np.ndarray]:
    assert env.action_space.shape is not None
    draws = np.random.default_rng(seed).uniform(-1, 1, (steps, *env.action_space.shape))
    return list(draws.astype(env.action_space.dtype))


def steps_of(env: gymnasium.Env, actions: list[np.ndarray]) -> Iterator[tuple[Any, ...]]:
    """What each step returned, comparable with ``==``; stops at the end of the episode."""
    for action in actions:
        seen, reward, terminated, truncated, info = env.step(action)
        yield seen.tobytes(), reward, terminated, truncated, info
        if terminated or truncated:
            return


def put(x_mm: float, y_mm: float, theta: float = 0.0) -> list[float]:
    return [x_mm, y_mm, theta]


# The checkers


@every_kind
@no_warnings
def test_gymnasiums_checker_is_content(action: str, observation: str, plant: str) -> None:
    env = gymnasium.make("tlf_env/Infinity-v0", action=action, observation=observation, plant=plant)
    check_env(env.unwrapped, skip_render_check=True)


@no_warnings
def test_gymnasiums_checker_is_content_with_the_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    check_env(gymnasium.make("tlf_env/Flower-v0", render_mode="rgb_array").unwrapped)


@every_kind
def test_sb3s_checker_is_content(
    action: str, observation: str, plant: str, recwarn: pytest.WarningsRecorder
) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    recwarn.clear()
    checker.check_env(FormationEnv(action=action, observation=observation, plant=plant))
    assert [str(warning.message) for warning in recwarn] == []


@every_kind
@no_warnings
def test_pettingzoos_parallel_checker_is_content(action: str, observation: str, plant: str) -> None:
    env = tlf_env.parallel_env(action=action, observation=observation, plant=plant, horizon_s=6.0)
    pettingzoo_test.parallel_api_test(env, num_cycles=400)


@every_kind
@no_warnings
def test_pettingzoos_turn_based_checker_is_content(
    action: str, observation: str, plant: str
) -> None:
    env = tlf_env.aec_env(action=action, observation=observation, plant=plant, horizon_s=6.0)
    pettingzoo_test.api_test(env, num_cycles=400)


@pytest.mark.parametrize("observation", OBSERVATIONS)
@pytest.mark.parametrize("make", [FormationEnv, tlf_env.parallel_env, tlf_env.aec_env])
def test_the_kinematic_plant_takes_no_torques(make: Any, observation: str) -> None:
    with pytest.raises(ValueError, match="'kinematic' has no torques"):
        make("infinity", action="torque", observation=observation, plant="kinematic")


# Making


@pytest.mark.parametrize(("task", "robots"), [("Infinity", 3), ("Flower", 5)])
@no_warnings
def test_gymnasium_makes_the_tasks_by_id(task: str, robots: int) -> None:
    env = gymnasium.make(f"tlf_env/{task}-v0")
    seen, info = env.reset(seed=1)
    inner = env.unwrapped
    assert isinstance(inner, FormationEnv)
    assert inner.scenario.robot_count == robots
    assert inner.learner == "robot_1"
    assert env.observation_space.contains(seen)
    assert info["position_error_mm"] == 0.0
    env.close()


@pytest.mark.parametrize("task", ["infinity", "flower"])
@pettingzoo_ids
def test_pettingzoo_makes_the_tasks_by_id(task: str) -> None:
    env = pettingzoo.make("parallel", f"tlf_env/{task}-v0", robots=2)
    assert set(env.reset(seed=0)[0]) == {"robot_0", "robot_1"}
    turns = pettingzoo.make("aec", f"tlf_env/{task}-v0", robots=2)
    turns.reset(seed=0)
    assert turns.agent_selection == "robot_0"


def test_without_ids_of_pettingzoo_the_package_still_has_its_doors() -> None:
    code = (
        "import pettingzoo\n"
        "vars(pettingzoo).pop('register', None)\n"
        "import gymnasium, tlf_env\n"
        "assert 'tlf_env/Infinity-v0' in gymnasium.registry\n"
        "assert tlf_env.parallel_env('infinity').possible_agents[0] == 'robot_0'\n"
        "assert tlf_env.aec_env('infinity').possible_agents[0] == 'robot_0'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_spec_survives_json() -> None:
    env = gymnasium.make(
        "tlf_env/Infinity-v0", learner="robot_2", action="torque", reward={"slip": -1.0}, robots=4
    )
    assert env.spec is not None
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    a, b = env.unwrapped, again.unwrapped
    assert isinstance(a, FormationEnv)
    assert isinstance(b, FormationEnv)
    assert (a.scenario, a.learner) == (b.scenario, b.learner)
    actions = random_actions(env, 20)
    assert a.reset(seed=3)[1] == b.reset(seed=3)[1]
    assert list(steps_of(a, actions)) == list(steps_of(b, actions))


def test_a_formation_of_one_has_the_leader_as_learner() -> None:
    env = FormationEnv(robots=1)
    assert env.learner == "robot_0"
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
    assert not terminated
    assert not truncated


@pytest.mark.parametrize("learner", ["robot_3", "robot_-1", "leader", 1])
def test_an_unknown_learner_is_named(learner: Any) -> None:
    with pytest.raises(ValueError, match=rf"learner '?{learner}'? is not one of robot_0, robot_1"):
        FormationEnv(learner=learner)


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ("referenz", "others 'referenz' must be 'reference', 'module:factory' or an object"),
        (3, r"others 3 has no predict\(\)"),
        (None, r"others None has no predict\(\)"),
        ("no_such_module:Policy", "cannot import 'no_such_module'"),
        ("baselines:NoSuchPolicy", "module 'baselines' has no 'NoSuchPolicy'"),
        ("math:pi", "'math:pi' is not callable"),
        ("builtins:dict", r"others 'builtins:dict' has no predict\(\): factory\(\) made dict"),
    ],
)
def test_impossible_others_are_named(others: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FormationEnv(others=others, trust=True)


# Steps


def test_step_needs_a_reset_before_and_after_an_episode() -> None:
    env = FormationEnv(horizon_s=0.04, time_gap_s=0.04, preview_s=())
    still = np.zeros(2, np.float32)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(still)
    env.reset(seed=0)
    assert [env.step(still)[3] for _ in range(2)] == [False, True]
    with pytest.raises(RuntimeError, match="reset"):
        env.step(still)
    env.reset()
    env.step(still)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([np.nan, 0.0], "robot_1: the action must be finite"),
        ([0.0, np.inf], "robot_1: the action must be finite"),
        ([0.0, 0.0, 0.0], r"robot_1: the action must have the shape \(2,\), got \(3,\)"),
        (0.0, r"robot_1: the action must have the shape \(2,\), got \(\)"),
    ],
)
def test_an_impossible_action_is_refused_and_changes_nothing(action: Any, message: str) -> None:
    env, twin = FormationEnv(), FormationEnv()
    actions = random_actions(env, 20)
    for one in (env, twin):
        one.reset(seed=0)
        list(steps_of(one, actions[:10]))
    with pytest.raises(ValueError, match=message):
        env.step(np.array(action))
    assert list(steps_of(env, actions[10:])) == list(steps_of(twin, actions[10:]))


def test_actions_outside_the_box_are_clipped_and_counted() -> None:
    env, twin = FormationEnv(), FormationEnv()
    infos = []
    for one, action in ((env, [3.0, 0.5]), (twin, [1.0, 0.5])):
        one.reset(seed=0)
        for _ in range(3):
            info = one.step(np.array(action, np.float32))[4]
        infos.append(info)
    assert [info.pop("clipped") for info in infos] == [3.0, 0.0]
    assert infos[0] == infos[1]


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_float64_goes_all_the_way_through(observation: str) -> None:
    fine = FormationEnv(dtype="float64", observation=observation)
    coarse = FormationEnv(observation=observation)
    assert fine.observation_space.dtype == fine.action_space.dtype == np.float64
    seen, _ = fine.reset(seed=0)
    assert seen.dtype == np.float64
    np.testing.assert_array_equal(seen.astype(np.float32), coarse.reset(seed=0)[0])
    action = np.array([0.3, 0.1])
    seen, *_ = fine.step(action)
    assert fine.observation_space.contains(seen)
    assert not np.array_equal(seen, seen.astype(np.float32))
    check_env(
        gymnasium.make("tlf_env/Infinity-v0", dtype="float64", observation=observation).unwrapped,
        skip_render_check=True,
    )


@pytest.mark.parametrize(("action", "observation"), [("twist", "tracking"), ("torque", "sensor")])
@pytest.mark.parametrize("others", ["reference", Recorder()])
def test_a_pickled_episode_goes_on_with_the_same_numbers(
    action: str, observation: str, others: Any
) -> None:
    env = FormationEnv(action=action, observation=observation, others=others, horizon_s=6.0)
    env.reset(seed=5)
    actions = random_actions(env, 120)
    list(steps_of(env, actions[:60]))
    copy = pickle.loads(pickle.dumps(env))
    assert list(steps_of(copy, actions[60:])) == list(steps_of(env, actions[60:]))
    assert env.reset()[0].tobytes() == copy.reset()[0].tobytes()
    assert list(steps_of(copy, actions[:20])) == list(steps_of(env, actions[:20]))


def test_wrappers_see_what_they_expect() -> None:
    limited = gymnasium.make("tlf_env/Infinity-v0", max_episode_steps=5)
    env: gymnasium.Env = RecordEpisodeStatistics(limited)
    env.reset(seed=0)
    total = 0.0
    for _ in range(5):
        _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
        total += float(reward)
    assert not terminated
    assert truncated
    assert info["episode"]["l"] == 5
    assert info["episode"]["r"] == pytest.approx(total)


# Who drives the others


@pytest.mark.parametrize("learner", AGENTS)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"plant": "kinematic"},
        {"dtype": "float64"},
        {"observation": "sensor"},
        {"residual_base": "printed"},
        {"residual_base": "adrc"},  # a law with a memory
        {"cooperative": True},
    ],
    ids=str,
)
def test_the_reference_among_others_is_the_reference_policy_bitwise(
    learner: str, options: dict[str, Any]
) -> None:
    policy = ReferencePolicy(options.get("residual_base", "linearised"))
    options = {"action": "twist", **options}
    alone = FormationEnv("infinity", learner=learner, others="reference", **options)
    together = tlf_env.parallel_env("infinity", **options)
    seen, info = alone.reset(seed=2)
    seen_by_all, infos = together.reset(seed=2)
    state = None
    for _ in range(250):
        assert np.array_equal(seen, seen_by_all[learner])
        assert info == infos[learner]
        # What drives is made from `tracking`, whatever the learner sees.
        rows = together.formation.arrays.observations[0]
        chosen, state = policy.predict(rows, state)
        actions = dict(zip(together.agents, chosen, strict=True))
        seen, reward, terminated, truncated, info = alone.step(actions[learner])
        seen_by_all, rewards, ends, cuts, infos = together.step(actions)
        assert (reward, terminated, truncated) == (rewards[learner], ends[learner], cuts[learner])


def test_others_by_name_are_the_same_as_the_object_and_the_built_in_reference() -> None:
    runs = []
    for others in ("reference", "baselines:ReferencePolicy", ReferencePolicy()):
        env = FormationEnv(learner="robot_2", others=others, trust=True)
        env.reset(seed=1)
        runs.append(list(steps_of(env, random_actions(env, 60))))
    assert runs[0] == runs[1] == runs[2]


@pytest.mark.parametrize(("action", "observation"), [("twist", "tracking"), ("torque", "sensor")])
def test_others_are_asked_as_sb3_asks(action: str, observation: str) -> None:
    others = Recorder()
    env = FormationEnv(robots=4, others=others, action=action, observation=observation)
    for _ in range(2):
        env.reset(seed=0)
        list(steps_of(env, random_actions(env, 3)))
    rows = (3, len(tracking_entries(env.scenario.preview_s)))
    first, later = [True] * 3, [False] * 3
    episode = [(rows, None, first, True), (rows, 1, later, True), (rows, 2, later, True)]
    assert others.calls == 2 * episode


def test_idle_others_stand_still() -> None:
    env = FormationEnv(learner="robot_0", others=Idle(), disturbance="none")
    env.reset(seed=0)
    before = env.formation_env.formation.arrays.rows("motion")[:4].copy()
    for _ in range(25):
        env.step(np.array([0.2, 0.0], np.float32))
    after = env.formation_env.formation.arrays.rows("motion")[:4]
    np.testing.assert_allclose(after[:, 1:], before[:, 1:], atol=1e-9)
    assert after[1, 0, 0] > before[1, 0, 0] + 1.0


# Ends


def last_step(env: FormationEnv) -> tuple[bool, bool, dict[str, Any]]:
    over = False
    while not over:
        *_, terminated, truncated, info = env.step(np.zeros(2, np.float32))
        over = terminated or truncated
    return terminated, truncated, info


@pytest.mark.parametrize("learner", AGENTS)
def test_the_horizon_truncates(learner: str) -> None:
    env = FormationEnv(learner=learner, others=Idle(), horizon_s=5.0, lost_beyond_mm=1e5)
    env.reset(seed=0)
    terminated, truncated, info = last_step(env)
    assert (terminated, truncated, info["end"]) == (False, True, EndReason.HORIZON)
    assert env.formation_env.formation.step_count == env.scenario.horizon_steps


@pytest.mark.parametrize(
    ("learner", "end"),
    [("robot_0", (True, False, EndReason.LOST)), ("robot_1", (False, True, EndReason.OTHER_ROBOT))],
)
def test_a_leader_that_stands_gets_lost(learner: str, end: tuple[bool, bool, EndReason]) -> None:
    env = FormationEnv(learner=learner, others=Idle(), lost_beyond_mm=100.0)
    env.reset(seed=0)
    terminated, truncated, info = last_step(env)
    assert (terminated, truncated, info["end"]) == end
    assert info["lost"] == terminated
    assert info["reward_lost"] == float(terminated)


@pytest.mark.parametrize(
    ("learner", "end"),
    [
        ("robot_0", (True, False, EndReason.TOUCHED)),
        ("robot_1", (True, False, EndReason.TOUCHED)),
        ("robot_2", (False, True, EndReason.OTHER_ROBOT)),
    ],
)
def test_outlines_that_meet_end_the_episode(
    learner: str, end: tuple[bool, bool, EndReason]
) -> None:
    env = FormationEnv(learner=learner, others=Idle(), lost_beyond_mm=1e5)
    # The first stands still, facing no other robot; the second is pushed into it by its start.
    env.reset(seed=0, options={"poses": [put(0, 0), put(0, -219.9), put(0, -900)]})
    terminated, truncated, info = last_step(env)
    assert (terminated, truncated, info["end"]) == end
    assert info["touched"] == terminated
    assert info["reward_touched"] == float(terminated)


def test_a_robot_put_beyond_reach_is_lost_at_once() -> None:
    env = FormationEnv(learner="robot_0")
    _, info = env.reset(seed=0, options={"poses": [put(9e3, 0), put(0, 0), put(0, -500)]})
    assert info["position_error_mm"] > env.scenario.lost_beyond_mm
    *_, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated, info["end"]) == (True, False, EndReason.LOST)


def test_without_ends_a_lost_and_touching_formation_goes_on() -> None:
    env = FormationEnv(learner="robot_0", others=Idle(), end_on=(), lost_beyond_mm=100.0)
    env.reset(seed=0, options={"poses": [put(0, 0), put(0, -200), put(0, -900)]})
    *_, terminated, truncated, info = list(steps_of(env, [np.zeros(2, np.float32)] * 60))[-1]
    assert not terminated
    assert not truncated
    assert info["lost"]
    assert info["touched"]
    assert info["end"] == EndReason.RUNNING


# Reset options


def test_reset_puts_the_robots_at_the_given_poses() -> None:
    env = tlf_env.parallel_env("infinity")
    poses = [put(100, 200, 0.3), put(0, -400, -2.0), put(-700, 50, 9.0)]
    _, infos = env.reset(seed=0, options={"poses": poses})
    for pose, info in zip(poses, infos.values(), strict=True):
        assert [info["x_mm"], info["y_mm"], info["theta_rad"]] == pytest.approx(pose, abs=1e-9)
    np.testing.assert_array_equal(env.formation.arrays.rows("estimate")[:3, :, 0].T, poses)
    assert not env.formation.arrays.rows("motion")[4:11].any()
    # A follower's reference starts where it stands.
    assert [infos[agent]["position_error_mm"] for agent in AGENTS[1:]] == pytest.approx([0, 0])


@pytest.mark.parametrize("phase_s", [0, 7.3, -4.0, 1000.0, np.float32(2.5), np.int64(3)])
def test_reset_starts_the_trajectory_at_a_phase(phase_s: Any) -> None:
    env = tlf_env.parallel_env("infinity")
    _, infos = env.reset(seed=0, options={"phase_s": phase_s})
    wanted = sample(env.scenario.trajectory, np.array([float(phase_s)]))[0]
    leader = infos["robot_0"]
    assert leader["reference_x_mm"] == pytest.approx(wanted[0])
    assert leader["reference_y_mm"] == pytest.approx(wanted[1])
    assert leader["position_error_mm"] == pytest.approx(0.0, abs=1e-9)
    _, infos = env.reset(seed=0)
    wanted = sample(env.scenario.trajectory, np.array([0.0]))[0]
    assert infos["robot_0"]["reference_x_mm"] == pytest.approx(wanted[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pose": 1}, "reset option 'pose' is unknown; the options are poses, phase_s"),
        ({"phase_s": np.nan}, "phase_s must be a finite number of seconds, got nan"),
        ({"phase_s": -np.inf}, "phase_s must be a finite number of seconds, got -inf"),
        ({"phase_s": "1"}, "phase_s must be a finite number of seconds, got '1'"),
        ({"phase_s": None}, "phase_s must be a finite number of seconds, got None"),
        (
            {"phase_s": [1.0]},
            r"phase_s must be a finite number of seconds, got the shape \(1,\): \[1.0\]",
        ),
        (
            {"poses": [put(0, 0)]},
            r"poses must be 3 finite rows .* got the shape \(1, 3\): \[\[0, 0",
        ),
        ({"poses": [put(0, 0), put(0, -500), put(0, np.nan)]}, "poses must be 3 finite .* nan"),
        ({"poses": None}, r"poses must be 3 finite rows .* got None"),
        ({"poses": "behind"}, "poses must be 3 finite rows .* got 'behind'"),
        ({"poses": [[0, 0], [1]]}, r"poses must be 3 finite rows .* got \[\[0, 0\], \[1\]\]"),
        ({"poses": np.zeros((4, 3))}, r"poses must be 3 finite rows .* got the shape \(4, 3\)"),
        ({"poses": np.array([["a"], ["b"]])}, "poses must be 3 finite rows .* got array"),
    ],
)
def test_an_impossible_reset_option_is_named(options: dict[str, Any], message: str) -> None:
    for env in (FormationEnv(), tlf_env.parallel_env()):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message) as caught:
            env.reset(options=options)
        assert "\n" not in str(caught.value)


# Many at once


def run_alone(seed: int) -> str:
    """A digest of one environment's run; a function of a module, for other processes."""
    return digest(FormationEnv(observation="sensor"), seed)


def digest(env: FormationEnv, seed: int) -> str:
    first, _ = env.reset(seed=seed)
    numbers = hashlib.sha256(first.tobytes())
    for step in steps_of(env, random_actions(env, 25, seed)):
        numbers.update(repr(step).encode())
    return numbers.hexdigest()


def test_environments_side_by_side_give_the_numbers_of_one_alone() -> None:
    seeds = range(50)
    alone = [run_alone(seed) for seed in seeds]
    assert len(set(alone)) == len(alone)
    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(run_alone, seeds)) == alone
    with ProcessPoolExecutor(3, mp_context=multiprocessing.get_context("spawn")) as processes:
        assert list(processes.map(run_alone, seeds, chunksize=5)) == alone


def test_environments_stepped_in_turn_give_the_numbers_of_one_alone() -> None:
    envs = [FormationEnv(learner=AGENTS[k % 3]) for k in range(50)]
    for k, env in enumerate(envs):
        env.reset(seed=k)
    runs = [steps_of(env, random_actions(env, 20, k)) for k, env in enumerate(envs)]
    in_turn = list(zip(*runs, strict=True))
    for k in (0, 1, 2, 25, 49):
        env = FormationEnv(learner=AGENTS[k % 3])
        env.reset(seed=k)
        assert list(steps_of(env, random_actions(env, 20, k))) == [step[k] for step in in_turn]


def test_an_environment_is_reused_without_a_trace() -> None:
    env = FormationEnv(observation="sensor")
    env.reset(seed=9, options={"phase_s": 3.0})
    list(steps_of(env, random_actions(env, 30)))
    assert digest(env, 4) == run_alone(4)
