"""What environments have for learners: a default action, staggered episodes, rewards for driving on."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import yaml

import tlf_env
from tlf_env import BatchPlant, EndReason
from tlf_env.common.presets import preset_names, read_preset_or_file
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.reward import DEFAULT_WEIGHTS, least_reward, reward_terms
from tlf_env.task.scenario import load_scenario, scenario_warnings

SHORT = {"horizon_s": 2.0, "time_gap_s": 1.0, "preview_s": (0.5,)}
STEPS = 100


def single(scenario="infinity", **fields):
    return FormationEnv(scenario, **fields)


def vector(scenario="infinity", **fields):
    return FormationVectorEnv(scenario, 2, **fields)


def sb3(scenario="infinity", **fields):
    vec_env = pytest.importorskip("baselines.sb3").FormationVecEnv(scenario, 2, **fields)
    vec_env.scenario = vec_env.plants[0].scenario
    return vec_env


DOORS = pytest.mark.parametrize("door", [single, vector, sb3])


@DOORS
def test_learners_act_about_the_reference_by_default(door, tmp_path):
    assert door().scenario.action == "tracking_twist"
    assert door(action_range=(50.0, 0.5)).scenario.action_range == (50.0, 0.5)
    tree = {
        "trajectory": {"type": "circle", "radius_mm": 1500.0, "speed_mm_s": 300.0},
        "horizon_s": 5.0,
    }
    assert door(tree).scenario.action == "tracking_twist"
    file = tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump(tree))
    assert door(str(file)).scenario.action == "tracking_twist"


@DOORS
def test_what_is_given_is_the_action(door, tmp_path):
    assert door(action="twist").scenario.action == "twist"
    tree = {
        "trajectory": {"type": "circle", "radius_mm": 1500.0, "speed_mm_s": 300.0},
        "horizon_s": 5.0,
        "action": "wheel_speed",
    }
    assert door(tree).scenario.action == "wheel_speed"
    assert door(tree, action="residual").scenario.action == "residual"
    file = tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump(tree))
    assert door(str(file)).scenario.action == "wheel_speed"
    assert door(load_scenario("infinity")).scenario.action == "twist"


@DOORS
def test_an_unknown_scenario_is_named(door):
    with pytest.raises(ValueError, match="scenario 'infinitx'"):
        door("infinitx")


def test_of_several_scenarios_one_that_says_its_action_is_enough():
    """Then the others must agree: nothing that is given is replaced."""
    plain = {"trajectory": load_scenario("infinity").trajectory.model_dump(), "name": "infinity"}
    assert vector([plain, "infinity"]).scenario.action == "tracking_twist"
    assert vector([plain, load_scenario(plain)]).scenario.action == "twist"
    for several in (
        [plain, {**plain, "action": "residual"}],
        [{**plain, "action": "residual"}, plain],
    ):
        with pytest.raises(ValueError, match=r"scenario 1: action is '(residual|twist)'"):
            vector(several)
    with pytest.raises(ValueError, match="empty"):
        vector([])


def test_tasks_of_one_environment_have_the_action_that_one_of_them_says():
    plain = load_scenario("infinity").model_dump(exclude={"action"})
    assert sb3({"a": "infinity", "b": [plain, "infinity"]}).scenario.action == "tracking_twist"
    assert sb3({"a": "infinity", "b": [load_scenario("infinity")]}).scenario.action == "twist"
    with pytest.raises(ValueError, match="'flower' has action 'twist', the first task 'residual'"):
        sb3({"a": {**plain, "action": "residual"}, "b": "flower"})


def test_all_agents_of_a_formation_command_twists_by_default():
    """The reference policies answer with twists."""
    assert tlf_env.parallel_env("infinity").scenario.action == "twist"


def test_zero_keeps_a_follower_longer_than_standing_still():
    """An action of zero follows the reference; before, it stood still, and the robot was lost."""
    steps = {}
    for action in ("twist", "tracking_twist"):
        env = gymnasium.make("tlf_env/Infinity-v0", action=action, horizon_s=20.0, infos=False)
        env.reset(seed=0)
        for steps[action] in range(1, 1001):
            if any(env.step(np.zeros(2))[2:4]):
                break
    assert steps["tracking_twist"] == 1000 > 2 * steps["twist"]


# Staggered episodes


def lengths(ended: np.ndarray) -> list[list[int]]:
    """Lengths of the episodes of each formation, from ``(step, formation)`` bool."""
    return [np.diff(np.flatnonzero(np.append(True, column))).tolist() for column in ended.T]


def plant_ends(staggered: bool) -> np.ndarray:
    plant = BatchPlant("infinity", 4, staggered=staggered, end_on=(), **SHORT)
    plant.reset(0)
    ends = []
    for _ in range(3 * STEPS):
        plant.step(np.zeros((4, 3, 2)))
        ends.append(plant.ended.copy())
        plant.reset_finished()
    return np.array(ends)


def vector_ends(staggered: bool) -> np.ndarray:
    env = FormationVectorEnv(
        "infinity",
        4,
        staggered=staggered,
        end_on=(),
        autoreset_mode="SameStep",
        infos=False,
        **SHORT,
    )
    env.reset(seed=0)
    return np.array([env.step(np.zeros((4, 2)))[3] for _ in range(3 * STEPS)])


def sb3_ends(staggered: bool) -> np.ndarray:
    env = pytest.importorskip("baselines.sb3").FormationVecEnv(
        "infinity", 4, staggered=staggered, end_on=(), infos=False, **SHORT
    )
    env.reset()
    ends = []
    for _ in range(3 * STEPS):
        _, _, dones, infos = env.step(np.zeros((12, 2)))
        assert all(
            info["TimeLimit.truncated"] for info, done in zip(infos, dones, strict=True) if done
        )
        ends.append(dones[::3])
        assert (dones.reshape(4, 3) == dones[::3, None]).all()
    return np.array(ends)


@pytest.mark.parametrize("ends", [plant_ends, vector_ends, sb3_ends])
def test_staggered_episodes_end_at_different_times(ends):
    assert lengths(ends(False)) == [[STEPS] * 3] * 4
    found = lengths(ends(True))
    assert [one[0] for one in found] == [25, 50, 75, 100]
    assert all(set(one[1:]) == {STEPS} for one in found)


def test_staggering_changes_no_bit_of_an_episode():
    """But its end; and a reset of some formations alone is not staggered."""
    plain, cut = (BatchPlant("infinity", 3, staggered=one, **SHORT) for one in (False, True))
    for plant in (plain, cut):
        plant.reset(5)
    for step in range(1, 34):
        for plant in (plain, cut):
            plant.step(np.full((3, 3, 2), 0.1))
        assert np.array_equal(plain.observations, cut.observations)
        assert np.array_equal(plain.rewards, cut.rewards)
        assert cut.ended.tolist() == [step == 33, False, False]
        assert not plain.ended.any()
    assert cut.ends[0].tolist() == [EndReason.HORIZON] * 3
    with pytest.raises(RuntimeError, match="formation 0"):
        cut.step(np.zeros((3, 3, 2)))
    cut.reset(mask=np.array([True, False, False]))
    for _ in range(33):
        cut.step(np.zeros((3, 3, 2)))
    assert cut.ended.tolist() == [False, True, False]


def test_more_formations_than_steps_end_after_one_step_at_least():
    plant = BatchPlant("infinity", 300, staggered=True, **SHORT)
    plant.reset(0)
    plant.step(np.zeros((300, 3, 2)))
    assert np.flatnonzero(plant.ended).tolist() == [
        0,
        1,
        2,
        3,
        4,
    ]  # (k + 1)/300 of 100 steps, rounded down


@pytest.mark.parametrize("value", [1, "yes", None])
def test_staggered_is_a_switch(value):
    with pytest.raises(ValueError, match=r"staggered .* must be True or False"):
        BatchPlant("infinity", 2, staggered=value)


# Rewards


def still(weights: dict[str, float], error_mm: float) -> float:
    """The reward of a robot with that error whose action is zero and whose wheels do not slip."""
    terms = reward_terms.py_func(error_mm, 0.0, 0.0, 0.0, False, False)
    return sum(weights[name] * value for name, value in terms._asdict().items())


def rewards_of_trainings() -> dict[str, tuple[dict[str, float], float]]:
    """Weights of the rewards, and the longest episode in steps, of all shipped trainings and the default."""
    found = {"default": (DEFAULT_WEIGHTS._asdict(), 5000.0)}
    for name in preset_names("training"):
        scenario = load_scenario(
            "infinity", reward=read_preset_or_file("training", name)["scenario"].get("reward")
        )
        found[name] = (dict(scenario.reward), 5000.0)
    return found


@pytest.mark.parametrize(
    ("weights", "steps"), rewards_of_trainings().values(), ids=rewards_of_trainings()
)
def test_being_lost_is_never_the_best_choice(weights, steps):
    """By arithmetic: whatever the error, driving on to the horizon is worth more than being lost at once."""
    lost = reward_terms.py_func(1201.0, 0.0, 0.0, 0.0, True, False)
    at_once = sum(weights[name] * value for name, value in lost._asdict().items())
    touching = reward_terms.py_func(0.0, 0.0, 0.0, 0.0, False, True)
    best_touch = sum(weights[name] * value for name, value in touching._asdict().items())
    worst = min(still(weights, error_mm) for error_mm in np.linspace(0.0, 1200.0, 2401))
    assert worst >= -1e-12
    assert steps * worst >= 0.0 > max(at_once, best_touch)


def test_the_least_reward_is_that_of_the_worst_error():
    weights = {**DEFAULT_WEIGHTS._asdict(), "far": -1.0, "coarse": 2.0, "fine": -0.5}
    least, error_mm = least_reward(weights, 1200.0)
    brute = {error: still(weights, error) for error in np.linspace(0.0, 1200.0, 12001)}
    assert least == pytest.approx(min(brute.values()), abs=1e-3)
    assert brute[min(brute, key=lambda one: abs(one - error_mm))] == pytest.approx(least, abs=5e-3)


def lines_of(**fields) -> list[str]:
    return [
        line for line in scenario_warnings(load_scenario("infinity", **fields)) if "reward" in line
    ]


def test_a_reward_under_which_being_lost_pays_warns():
    assert not lines_of()
    (line,) = lines_of(reward={"far": -1.0}, end_on=("lost",))
    for part in ("1200 mm", "-1.2", "being lost, -20 once", "alive 1.2"):
        assert part in line
    assert not lines_of(reward={"far": -1.0, "alive": 1.2})
    assert not lines_of(reward={"far": -1.0, "lost": -1e4, "touched": -1e4})
    assert not lines_of(reward={"far": -1.0}, end_on=())
    assert lines_of(reward={"lost": 5.0})


def test_alive_is_one_until_the_robot_is_lost():
    env = tlf_env.parallel_env("infinity", lost_beyond_mm=150.0, reward={"alive": 0.5}, end_on=())
    env.reset(seed=0)
    lost_before = False
    for _ in range(200):
        _, rewards, _, _, infos = env.step({agent: np.zeros(2) for agent in env.agents})
        info = infos["robot_0"]
        now = info["lost"] and not lost_before
        lost_before = info["lost"]
        assert info["reward_alive"] == (0.0 if now else 1.0)
        weights = env.scenario.reward
        total = math.fsum(weights[name] * info[f"reward_{name}"] for name in weights)
        assert rewards["robot_0"] == pytest.approx(total, rel=1e-12, abs=1e-12)
    assert lost_before
