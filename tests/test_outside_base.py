"""A policy in Python as the base of the action ``residual``, through every door."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from helpers import stacked, unstacked

import tlf_env
from baselines import ReferencePolicy
from baselines.policies.card import Card
from baselines.policies.entries import AskedFields
from baselines.policies.systems import make_system, parse_system
from tlf_env import BatchPlant
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.onboard.limiter import twist_limits_row
from tlf_env.onboard.limiters import load_limiter
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.scenario import load_scenario

SHORT = {"horizon_s": 6.0, "end_on": (), "disturbance": "slip"}
ON = {**SHORT, "action": "residual"}
STEPS = 300
SYSTEM = "adrc:searched+ekf-gyro-smoothed+grip"  # a law in Python, with a memory


def law():
    return make_system(parse_system(SYSTEM), load_scenario("infinity"))


class Counting:
    """A policy whose state counts the steps of each robot; it commands a constant twist."""

    def __init__(self, twist=(0.3, 0.02)) -> None:
        self.twist, self.starts = np.array(twist), []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        state = np.zeros(len(observation)) if state is None else state
        self.starts.append(episode_start.copy())
        state = np.where(episode_start, 0, state) + 1
        return np.tile(self.twist, (len(observation), 1)), state


def alone(policy, state=None, **fields) -> list[np.ndarray]:
    """Observations of a formation that the policy drives from outside, by twists."""
    env = tlf_env.parallel_env("infinity", action="twist", **SHORT | fields)
    seen, found, start = stacked(env.reset(seed=3)[0]), [], True
    while env.agents:
        actions, state = policy.predict(seen, state, np.full(len(seen), start))
        start = False
        seen = stacked(env.step(unstacked(env, actions))[0])
        found.append(seen)
    return found


LAST_ACTION = slice(11, 13)  # of the observation: a residual of 0 differs from a twist


def but_last_action(seen: np.ndarray) -> np.ndarray:
    return np.delete(seen, np.r_[LAST_ACTION], axis=-1)


@pytest.mark.parametrize("policy", [ReferencePolicy, law], ids=["compiled", "law"])
def test_a_residual_of_zero_is_the_policy_itself(policy):
    wanted = alone(policy())
    env = tlf_env.parallel_env("infinity", residual_base=policy(), **ON)
    env.reset(seed=3)
    zero = {agent: np.zeros(2, np.float32) for agent in env.agents}
    for theirs in wanted:
        mine = stacked(env.step(zero)[0])
        assert np.array_equal(but_last_action(mine), but_last_action(theirs))
    assert not env.agents


def test_every_door_has_the_same_base():
    """Zero residuals of all robots in each door; the policy has a memory."""
    env = tlf_env.parallel_env("infinity", residual_base=law(), plant="batch", **ON)
    env.reset(seed=4)
    wanted = [
        stacked(env.step({agent: np.zeros(2) for agent in env.agents})[0]) for _ in range(STEPS)
    ]
    single = FormationEnv("infinity", residual_base=law(), plant="batch", **ON)
    single.reset(seed=4)
    vector = FormationVectorEnv("infinity", 3, residual_base=law(), infos=False, **ON)
    vector.reset(seed=3)
    plant = BatchPlant("infinity", 3, residual_base=law(), **ON)
    plant.reset(3)
    for theirs in wanted:
        assert np.array_equal(single.step(np.zeros(2))[0], theirs[1])
        assert np.array_equal(vector.step(np.zeros((3, 2)))[0][1], theirs[1])
        plant.step(np.zeros((3, 3, 2)))
        assert np.array_equal(plant.observations[1], theirs)


def test_what_is_added_is_the_action_times_its_range():
    env = tlf_env.parallel_env(
        "infinity", residual_base=Counting((0.3, 0.02)), action_range=(100.0, 1.0), **ON
    )
    env.reset(seed=0)
    env.step(
        {"robot_0": np.zeros(2), "robot_1": np.array([0.5, -0.25]), "robot_2": np.array([1.0, 1.0])}
    )
    twists = env.formation.arrays.twists[0] * [FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S]
    np.testing.assert_allclose(twists, [[300, 0.16], [350, -0.09], [400, 1.16]], rtol=1e-6)


def test_a_limiter_limits_the_sum():
    fields = {**ON, "limiter": "grip", "disturbance": "nominal"}
    env = tlf_env.parallel_env("infinity", residual_base=Counting((1.0, 0.0)), **fields)
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    limits = twist_limits_row(load_limiter("grip").limits, 0.02)
    speed = env.formation.arrays.twists[0, 0, 0] * FULL_SPEED_MM_S
    assert speed == pytest.approx(limits.step_1, rel=1e-5)
    assert limits.step_1 < 10
    with pytest.raises(ValueError, match="limiter goes with the actions"):
        load_scenario("infinity", action="residual", limiter="grip")


def test_states_and_starts_are_those_of_each_robot():
    policy = Counting()
    plant = BatchPlant("infinity", 2, residual_base=policy, **ON)
    plant.reset(0)
    for _ in range(3):
        plant.step(np.zeros((2, 3, 2)))
    plant.reset(mask=np.array([False, True]))
    plant.step(np.zeros((2, 3, 2)))
    assert [starts.tolist() for starts in policy.starts] == [
        [True] * 6,
        [False] * 6,
        [False] * 6,
        [False] * 3 + [True] * 3,
    ]


def test_others_by_the_reference_are_driven_by_the_base():
    """The learner commands a twist; the policy in Python drives the rest."""
    single = FormationEnv("infinity", residual_base=Counting(), action="twist", **SHORT)
    single.reset(seed=1)
    single.step(np.array([0.1, 0.0]))
    twists = single.formation_env.formation.arrays.twists[0]
    np.testing.assert_allclose(twists[[0, 2]], [[0.3, 0.02]] * 2, rtol=1e-6)


def test_copies_and_pickles_go_on_bit_for_bit():
    env = tlf_env.parallel_env("infinity", residual_base=law(), **ON)
    env.reset(seed=2)
    zero = {agent: np.zeros(2) for agent in env.agents}
    for _ in range(40):
        env.step(zero)
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(40):
        mine = stacked(env.step(zero)[0])
        for twin in twins:
            assert np.array_equal(stacked(twin.step(zero)[0]), mine)


class Broken:
    def __init__(self, answer) -> None:
        self._answer = answer

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self._answer


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (np.zeros((3, 2)), "must return a pair"),
        ((np.zeros((2, 2)), None), r"shape \(3, 2\), got \(2, 2\)"),
        ((np.full((3, 2), np.nan), None), "must be finite"),
        (([["fast", 1.0]] * 3, None), "real numbers"),
    ],
)
def test_a_wrong_answer_is_named_and_nothing_moves(answer, why):
    env = tlf_env.parallel_env("infinity", residual_base=Broken(answer), **ON)
    env.reset(seed=0)
    before = env.formation.arrays.rows("motion").copy()
    with pytest.raises(ValueError, match=r"residual_base .*Broken.*: .*" + why):
        env.step({agent: np.zeros(2) for agent in env.agents})
    assert np.array_equal(env.formation.arrays.rows("motion"), before)


@pytest.mark.parametrize(
    ("base", "why"),
    [
        ("no_such_module:Policy", "cannot import 'no_such_module'"),
        ("math:sqrt", "residual_base 'math:sqrt' cannot be made"),
        (object(), "residual_base 'builtins:object' has no predict"),
        ("no_such", "controller 'no_such' is not one of"),
    ],
)
def test_what_is_no_policy_is_refused(base, why):
    for make in (tlf_env.parallel_env, lambda *a, **f: BatchPlant(*a, 2, **f)):
        with pytest.raises(ValueError, match=why):
            make("infinity", residual_base=base, trust=True, **ON)


def test_a_path_is_a_controllers_file(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("controller: consistent\n")
    assert tlf_env.parallel_env("infinity", residual_base=file, **ON).scenario.residual_base == str(
        file
    )


def test_a_name_is_imported_by_every_door():
    env = tlf_env.parallel_env(
        "infinity", residual_base="baselines:ReferencePolicy", trust=True, **ON
    )
    assert env.scenario.outside_base == "baselines:ReferencePolicy"
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    assert env.formation.arrays.twists.any()


def test_cards_and_programs_must_not_name_code():
    with pytest.raises(ValueError, match="controller's preset or file, got 'os:abort'"):
        AskedFields(residual_base="os:abort")
    fields = dict.fromkeys(Card.model_fields) | {
        "action": "residual",
        "residual_base": "os:abort",
    }
    with pytest.raises(ValueError, match="a policy in Python, which would be run"):
        Card.model_construct(**fields)._check()
