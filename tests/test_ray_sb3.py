"""The vector environment on a Ray cluster: the same numbers as one process, whatever the workers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("ray")

from baselines.ray_sb3 import RayFormationVecEnv
from baselines.sb3 import FormationVecEnv

SHORT = {"horizon_s": 1.0, "disturbance": "combined-hard"}


@pytest.fixture(scope="module")
def cluster():
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 3, "include_dashboard": False})
    yield made.address
    made.shutdown()


@pytest.fixture
def make(cluster):
    made = []

    def build(*given, **named):
        made.append(RayFormationVecEnv(*given, address=cluster, **named))
        return made[-1]

    yield build
    for one in made:
        one.close()


def without_times(infos):
    return [
        {k: v for k, v in info.items() if k != "episode"}
        | (
            {"episode": {k: v for k, v in info["episode"].items() if k != "t"}}
            if "episode" in info
            else {}
        )
        for info in infos
    ]


@pytest.mark.parametrize("workers", [1, 3])
def test_the_workers_change_no_bit(make, workers):
    far, near = (
        make("infinity", 5, workers=workers, **SHORT),
        FormationVecEnv("infinity", 5, **SHORT),
    )
    generator = np.random.default_rng(0)
    assert far.num_envs == near.num_envs
    assert far.seed(7) == near.seed(7)
    np.testing.assert_array_equal(far.reset(), near.reset())
    assert far.reset_infos == near.reset_infos
    ended = 0
    for _ in range(60):  # beyond the horizon, so that formations restart
        actions = 0.3 * generator.standard_normal((far.num_envs, 2)).clip(-1, 1)
        mine, theirs = far.step(actions), near.step(actions)
        for one, other in zip(mine[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(one, other)
        for one, other in zip(without_times(mine[3]), without_times(theirs[3]), strict=True):
            np.testing.assert_equal(one, other)
        ended += int(mine[2].sum())
    assert ended >= far.num_envs


def test_a_training_goes_through_it(make):
    from stable_baselines3 import PPO

    envs = make("infinity", 4, workers=2, horizon_s=2.0)
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=96, n_epochs=1, device="cpu")
    before = [one.detach().clone() for one in model.policy.parameters()]
    model.learn(32 * envs.num_envs)
    changed = [
        not np.array_equal(a, b.detach())
        for a, b in zip(before, model.policy.parameters(), strict=True)
    ]
    assert any(changed)


def test_the_example_of_the_page_runs(cluster):
    """With a smaller cluster, fewer formations and steps."""
    page = (Path(__file__).parents[1] / "docs" / "scale.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for text, small in (
        ('"auto"', repr(cluster)),
        ("1024, workers=8", "4, workers=2"),
        ("batch_size=8192", "batch_size=128"),
        ("10_000_000", "384"),
    ):
        assert text in code
        code = code.replace(text, small)
    scope = {}
    try:
        exec(compile(code, "scale.md", "exec"), scope)
        assert scope["model"].num_timesteps == 384
    finally:
        scope["envs"].close()


def test_attributes_and_methods_are_those_of_the_sub_environments(make):
    far, near = make("infinity", 3, workers=2), FormationVecEnv("infinity", 3)
    far.seed(1), near.seed(1)
    far.reset(), near.reset()
    np.testing.assert_array_equal(
        far.env_method("state", indices=[8, 0]), near.env_method("state", indices=[8, 0])
    )
    far.set_attr("mark", 5, indices=[7])
    assert far.get_attr("mark", [7]) == [5]
    assert far.get_attr("render_mode") == [None] * 9
    with pytest.raises(AttributeError, match="a robot has no attribute 'colour'"):
        far.get_attr("colour")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"workers": 0}, "workers 0 must be"),
        (
            {"formations": 1, "workers": 2},
            "formations 1 must be at least one for each of 2 workers",
        ),
        ({"workers": 2, "threads": 2}, "need 4 processors, the cluster has 3"),
        ({"seed": -1}, "seed -1"),
        ({"tyres": 4}, "tyres"),
        (
            {"scenario": {"a": "infinity", "b": "flower"}, "formations": 4},
            "at least one for each|2 tasks; workers take one task",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, given, message):
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        make(**given)
    assert "\n" not in str(caught.value)


def test_actions_that_are_not_finite_change_nothing(make):
    far = make("infinity", 2, workers=2)
    far.seed(1)
    far.reset()
    before = far.env_method("state")
    with pytest.raises(ValueError, match=r"actions must be \(6, 2\) finite numbers"):
        far.step(np.full((6, 2), np.nan))
    np.testing.assert_array_equal(before, far.env_method("state"))


def test_a_worker_that_ended_is_named(make):
    far = make("infinity", 2, workers=2)
    far.reset()
    far._ray.kill(far._workers[1])
    with pytest.raises(ConnectionError, match="worker 1 of 2 has ended"):
        far.step(np.zeros((6, 2)))


def test_an_address_without_a_cluster_is_an_error():
    with pytest.raises(ValueError, match=r"no Ray cluster at '127\.0\.0\.1:1'"):
        RayFormationVecEnv("infinity", 2, address="127.0.0.1:1")
