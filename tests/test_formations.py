"""Formations of any size, and of different robots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stack_policy import StackPolicy

import tlf_env
from baselines import ReferencePolicy
from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.task.scenario import Scenario

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SIZES = (1, 2, 10, 20)


def drive(env: FormationParallelEnv, policy: Any, steps: int, seed: int = 0) -> np.ndarray:
    """Motions of every step, (step, field, robot)."""
    seen, _ = env.reset(seed=seed)
    state, start = None, np.ones(len(env.agents), dtype=np.bool_)
    motions = []
    for _ in range(steps):
        rows = np.stack([seen[agent] for agent in env.agents])
        actions, state = policy.predict(rows, state, start)
        start = np.zeros_like(start)
        seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        motions.append(env.formation.arrays.rows("motion")[:, :, 0].copy())
    return np.array(motions)


@pytest.mark.parametrize("observation", ["tracking", "sensor"])
def test_what_a_robot_sees_has_the_same_size_in_every_formation(observation: str) -> None:
    shapes = {
        tlf_env.parallel_env(task, robots=n, observation=observation)
        .observation_space("robot_0")
        .shape
        for task in ("infinity", "flower")
        for n in SIZES
    }
    assert len(shapes) == 1


@pytest.mark.parametrize("robots", SIZES)
@pytest.mark.parametrize("plant", ["pymunk", "kinematic"])
def test_the_reference_drives_formations_of_any_size(robots: int, plant: str) -> None:
    env = tlf_env.parallel_env("flower", robots=robots, plant=plant)
    drive(env, ReferencePolicy(), steps=400)
    infos = env.formation.arrays.infos[0]
    assert env.agents == [f"robot_{i}" for i in range(robots)]
    assert infos.shape[0] == robots
    assert infos[:, 0].max() < 50.0  # position error
    assert env.state().shape == (12 * robots,)


def test_robots_behind_do_not_change_those_ahead() -> None:
    three, ten = (tlf_env.parallel_env("infinity", robots=n, end_on=()) for n in (3, 10))
    a, b = (drive(env, ReferencePolicy(), steps=400) for env in (three, ten))
    np.testing.assert_array_equal(a, b[..., :3])


def test_a_policy_made_for_three_robots_drives_ten() -> None:
    def make(n: int) -> FormationParallelEnv:
        return tlf_env.parallel_env(
            "infinity",
            robots=n,
            observation="sensor",
            action="torque",
            control_period_s=0.001,
            estimator="ekf",
            end_on=(),
        )

    three, ten = make(3), make(10)
    policy = StackPolicy(three.scenario)
    a, b = (drive(env, policy, steps=1000) for env in (three, ten))
    np.testing.assert_array_equal(a, b[..., :3])


def lineup(*overrides: dict[str, Any], **options: Any) -> FormationParallelEnv:
    return tlf_env.parallel_env("infinity", robots=list(overrides), end_on=(), **options)


def along_the_way(env: FormationParallelEnv, action: list[float], steps: int = 50) -> np.ndarray:
    """How far every robot gets with the same action, mm."""
    env.reset(seed=0)
    before = env.formation.state()[:, :2]
    for _ in range(steps):
        env.step({agent: np.array(action, np.float32) for agent in env.agents})
    return np.hypot(*(env.formation.state()[:, :2] - before).T)


def test_each_robot_has_the_body_that_it_is_given() -> None:
    heavy = {"mass_kg": 2 * 1.245}
    weak = {"torque_limit_Nmm": 8.0}
    env = lineup({}, heavy, weak, {}, action="torque", start_spacing_mm=1000.0)
    far = along_the_way(env, [0.9, 0.9])
    assert far[0] == pytest.approx(far[3], rel=1e-12)
    assert far[1] < 0.6 * far[0]
    assert far[2] < 0.6 * far[0]


def test_bigger_wheels_get_further_at_the_same_wheel_speed() -> None:
    env = lineup(
        {}, {"wheel_radius_mm": 75.0}, action="wheel_speed", plant="kinematic", disturbance="none"
    )
    near, far = along_the_way(env, [0.2, 0.2])
    assert far / near == pytest.approx(1.5, rel=1e-9)


def test_each_robot_estimates_with_its_own_geometry() -> None:
    env = lineup({}, {"wheel_radius_mm": 60.0, "axle_width_mm": 200.0}, plant="kinematic")
    for _ in along_the_way(env, [0.3, 0.1], steps=200):
        truth = env.formation.state()[:, :2]
    np.testing.assert_allclose(env.formation.arrays.rows("estimate")[:2, :, 0].T, truth, atol=0.2)


def test_overrides_are_merged_into_the_common_robot() -> None:
    env = lineup({}, {"mass_kg": 3.0}, robot={"wheel_radius_mm": 40.0})
    first, second = env.scenario.robot_models
    assert (first.wheel_radius_mm, first.mass_kg) == (40.0, 1.245)
    assert (second.wheel_radius_mm, second.mass_kg) == (40.0, 3.0)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([{}, {"mass": 2.0}], "mass"),
        ([{"mass_kg": -1.0}], "mass_kg.*-1"),
        ([{"com_offset_mm": 35.0}], "com_offset_mm 35.0 does not fit castor_load_share"),
        ([], "robots"),
    ],
)
def test_an_impossible_robot_is_named(overrides: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lineup(*overrides)


@pytest.mark.parametrize("name", ["own_robot", "mixed_formation"])
def test_formations_from_files_drive(name: str) -> None:
    env = tlf_env.parallel_env(EXAMPLES / f"{name}.yaml")
    drive(env, ReferencePolicy(), steps=500)
    assert env.agents
    assert env.formation.arrays.infos[0][:, 0].max() < 50.0  # position error


def test_the_mixed_formation_has_different_robots() -> None:
    scenario: Scenario = tlf_env.load_scenario(EXAMPLES / "mixed_formation.yaml")
    models = scenario.robot_models
    assert len({model.model_dump_json() for model in models}) == len(models) == 4
