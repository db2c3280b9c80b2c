"""After ``reset`` everything that an episode may need is compiled: no step waits for the compiler."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

# In a process of its own, as another test may have loaded a driver before. A driver that is loaded from the
# cache in an episode would have been compiled there on a machine without a cache.
EPISODE = """
import json, sys
import numpy as np
import tlf_env
from tlf_env.numerics.compiled import _Driver

def ready():
    modules = [vars(one) for name, one in sys.modules.items() if name.startswith("tlf_env.")]
    found = {id(one): one for names in modules for one in names.values() if isinstance(one, _Driver)}
    return sorted((one.py_func.__name__, len(one.overloads)) for one in found.values())

scenario, overrides, options, action, steps = json.loads(sys.argv[1])
env = tlf_env.parallel_env(scenario, end_on=(), **overrides)
env.reset(seed=0, options=options)
before = ready()
actions = {agent: np.array(action) for agent in env.agents}
if options is not None:  # into the robot ahead, which stands
    actions["robot_0"] = np.zeros(2)
touched = set()
for _ in range(steps):
    _, _, _, _, infos = env.step(actions)
    touched |= {infos[agent]["touched_by"] for agent in env.agents}
env.reset()
assert ready() == before, (before, ready())
print(json.dumps(sorted(touched)))
"""
NEAR = [[0.0, 0.0, 0.0], [0.0, -260.0, 0.0], [0.0, -1500.0, 3.1416]]


def things_touched(*wanted: object) -> set[int]:
    done = subprocess.run(
        [sys.executable, "-c", EPISODE, json.dumps(wanted)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


def test_robots_that_touch_compile_nothing():
    found = things_touched("infinity", {}, {"poses": NEAR}, [1.0, 0.0], 60)
    assert 1 in found  # a robot


def test_a_world_of_shelves_boxes_and_rays_compiles_nothing():
    found = things_touched("warehouse", {"rays": {"count": 8}}, None, [0.8, 0.0], 400)
    assert 2 in found  # a wall


@pytest.mark.parametrize(
    "overrides",
    [
        {"plant": "chipmunk"},
        {"plant": "kinematic"},
        {"estimator": "baselines.policies.estimators.unscented:UnscentedEstimator"},
        {"disturbance": "combined-hard", "observation": "sensor"},
    ],
)
def test_other_plants_and_parts_compile_nothing(overrides):
    things_touched("infinity", overrides, None, [0.1, 0.2], 30)
