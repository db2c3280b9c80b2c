"""Snapshots: an environment goes on from any moment with the same bits; what does not fit is refused."""

from __future__ import annotations

import copy
import errno
import hashlib
import json
import os
import pickle
import subprocess
import sys
import warnings
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pymunk
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

import tlf_env
from tlf_env.engine import snapshot as module
from tlf_env.engine.arrays import FROM_SCENARIO
from tlf_env.engine.formation import Formation
from tlf_env.engine.layout import in_array
from tlf_env.engine.snapshot import FORMAT, Snapshot, difference
from tlf_env.onboard.memory import DEEPEST, NotPlainError, packed, unpacked

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")

# --- environments and their courses -----------------------------------------------------------------


def thing(x: float, y: float, square: bool, mass_kg: float = 0.5) -> dict[str, Any]:
    shape = (
        {"type": "box", "width_mm": 120.0, "length_mm": 90.0}
        if square
        else {"type": "circle", "radius_mm": 55.0}
    )
    return {
        "shape": shape,
        "x_mm": x,
        "y_mm": y,
        "mass_kg": mass_kg,
        "floor_friction": 0.1,
        "friction": 0.4,
    }


PILE = {
    "pushables": [
        thing(x, y, (i + j) % 2 == 1)
        for i, x in enumerate((-130.0, 0.0, 130.0))
        for j, y in enumerate((260.0, 365.0, 470.0))
    ],
    "walls": [{"points_mm": [[-600.0, 620.0], [600.0, 620.0]]}],
}
PUSHER = {
    "shape": {"type": "circle", "radius_mm": 60.0},
    "points_mm": [[-700.0, 420.0], [700.0, 420.0]],
    "speed_mm_s": 300.0,
    "random_start": True,
}
CLOSE = {"time_gap_s": 0.1, "preview_s": (), "end_on": (), "horizon_s": 8.0}
PLACES: dict[str, dict[str, Any]] = {
    # robots that push a pile against a wall, with noise
    "pile": {
        **CLOSE,
        "robots": 3,
        "world": PILE,
        "disturbance": "noise",
        "robot": {"outline_friction": 0.4},
    },
    "pile-chipmunk": {
        **CLOSE,
        "robots": 3,
        "world": PILE,
        "plant": "chipmunk",
        "disturbance": "noise",
        "robot": {"outline_friction": 0.4},
    },
    # an obstacle that moves through the things, with a phase of its own in every episode
    "mover": {
        **CLOSE,
        "robots": 2,
        "world": {"pushables": PILE["pushables"][:4], "moving": [PUSHER]},
        "rays": {"count": 8, "range_mm": 800.0, "noise_std_mm": 3.0},
    },
    # robots that push each other, one of which is a rectangle with a payload
    "queue": {
        **CLOSE,
        "robots": 4,
        "disturbance": {"payload": {"mass_kg": 0.3, "behind_mm": 5.0}},
        "robots_pushed": True,
    },
    "queue-chipmunk": {**CLOSE, "robots": 3, "plant": "chipmunk", "robots_pushed": True},
    "polygons": {
        **CLOSE,
        "robots": 2,
        "robots_pushed": True,
        "robot": {
            "outline_polygon_mm": [(-90.0, -120.0), (90.0, -120.0), (90.0, 90.0), (-90.0, 90.0)]
        },
    },
    # everything that has a memory on board: delays, losses, smoothing, rare and late fixes
    "hardware": {"scenario": "infinity_hardware", "disturbance": "combined-hard", "horizon_s": 6.0},
    "batch": {"plant": "batch", "disturbance": "slip-noise", "horizon_s": 6.0},
    "kinematic": {"plant": "kinematic", "disturbance": "slip", "horizon_s": 6.0},
    "residual": {"action": "residual", "disturbance": "combined-medium", "horizon_s": 6.0},
    "sensors": {
        "action": "torque",
        "observation": "sensor",
        "control_period_s": 0.004,
        "disturbance": "noise",
        "horizon_s": 1.0,
    },
}
MOMENTS = (0, 1, 7, 20, 33, 47, 61)
STEPS, FOLLOW = 80, 16


def make(name: str, **more: Any) -> tlf_env.envs.parallel.FormationParallelEnv:
    fields = {key: value for key, value in PLACES[name].items() if key != "robots_pushed"}
    return tlf_env.parallel_env(fields.pop("scenario", "infinity"), **fields, **more)


def start(env: Any, name: str, seed: int = 3) -> None:
    robots = len(env.possible_agents)
    options: dict[str, Any] = {"phase_s": 1.5}
    if PLACES[name].get("robots_pushed"):
        options = {"poses": [[0.0, -212.0 * i, 0.0] for i in range(robots)]}
    elif "world" in PLACES[name]:
        options = {"poses": [[240.0 * (-1) ** i * ((i + 1) // 2), 0.0, 0.0] for i in range(robots)]}
    env.reset(seed=seed, options=options)


def step(env: Any, name: str, number: int) -> bytes:
    """One control step, and a digest of all that it gives."""
    rng = np.random.default_rng(number // 15)
    agents = env.possible_agents
    pushing = name in ("pile", "pile-chipmunk", "mover", "queue", "queue-chipmunk", "polygons")
    low, high = ((0.1, -0.15), (0.5, 0.15)) if pushing else ((-1.0, -1.0), (1.0, 1.0))
    actions = {agent: rng.uniform(low, high) for agent in agents}
    if PLACES[name].get("robots_pushed"):
        actions["robot_0"] = np.array([-0.3, 0.05])
    outcome = env.step(actions) if env.agents else ({}, {}, {}, {}, {})
    digest = hashlib.sha256(repr([*outcome[1:4], env.agents]).encode())
    digest.update(b"".join(row.tobytes() for row in outcome[0].values()))
    numbers = [[float(value) for value in info.values()] for info in outcome[4].values()]
    digest.update(np.array(numbers).tobytes())
    digest.update(env.state().tobytes())
    digest.update(env.formation.plant.object_poses(env.formation.step_count).tobytes())
    return digest.digest()


def course(
    env: Any, name: str, moments: tuple[int, ...] = MOMENTS
) -> tuple[list[bytes], dict[int, Any]]:
    """What every step gives, and snapshots from before some of them."""
    found, snapshots = [], {}
    for number in range(STEPS):
        if number in moments:
            snapshots[number] = env.get_state()
        found.append(step(env, name, number))
    return found, snapshots


@pytest.fixture(scope="module")
def courses() -> Callable[[str], tuple[Any, list[bytes], dict[int, Any]]]:
    """Environment, course and snapshots of each place; made once."""
    made: dict[str, Any] = {}

    def of(name: str) -> Any:
        if name not in made:
            env = make(name)
            start(env, name)
            made[name] = (env, *course(env, name))
        return made[name]

    return of


@pytest.mark.parametrize("name", PLACES)
def test_an_environment_goes_on_from_its_snapshots_bit_for_bit(name, courses):
    env, wanted, snapshots = courses(name)
    for moment, taken in reversed(snapshots.items()):
        env.set_state(taken)
        assert env.get_state() == taken, moment
        last = STEPS if moment == MOMENTS[1] else min(moment + FOLLOW, STEPS)
        for number in range(moment, last):
            assert step(env, name, number) == wanted[number], (moment, number)


@pytest.mark.parametrize("name", PLACES)
def test_snapshots_change_nothing(name, courses):
    """As an environment of which none was taken, on its second episode."""
    quiet = make(name)
    start(quiet, name, seed=8)
    step(quiet, name, 0)
    start(quiet, name)
    assert [step(quiet, name, number) for number in range(STEPS)] == courses(name)[1]


@pytest.mark.parametrize("name", PLACES)
def test_another_environment_goes_on_from_a_file(name, courses, tmp_path):
    """One that was never reset, and one in the midst of another episode."""
    _, wanted, snapshots = courses(name)
    busy = make(name)
    start(busy, name, seed=11)
    for number in range(12):
        step(busy, name, number + 100)
    for i, (moment, taken) in enumerate(snapshots.items()):
        taken.save(tmp_path / "moment")
        loaded = Snapshot.load(tmp_path / "moment")
        assert loaded == taken
        other = busy if i % 2 else make(name)
        other.set_state(loaded)
        for number in range(moment, min(moment + FOLLOW, STEPS)):
            assert step(other, name, number) == wanted[number], (moment, number)


def test_the_piles_are_piles(courses):
    """What the tests above rely on: at the moments of their snapshots things touch."""
    for name in ("pile", "pile-chipmunk", "mover", "queue", "queue-chipmunk", "polygons"):
        pairs = [len(one.numbers["space/pairs"]) for one in courses(name)[2].values()]
        assert pairs[-1] >= 1, name
    assert len(courses("pile")[2][61].numbers["space/pairs"]) > 4
    assert max(one.numbers["space/corrections"].max() for one in courses("pile")[2].values()) > 0


CHILD = ("pile", "pile-chipmunk", "queue", "batch", "kinematic")


def in_another_process(folder: str) -> None:
    """Go on from all files of a folder; what each gives is printed, the last line."""
    warnings.simplefilter("ignore")
    found = {}
    for name in CHILD:
        env = make(name)
        env.set_state(Snapshot.load(Path(folder) / name))
        found[name] = [step(env, name, number).hex() for number in range(47, 47 + FOLLOW)]
    print(json.dumps(found))


def test_another_process_goes_on_from_a_file(courses, tmp_path):
    for name in CHILD:
        courses(name)[2][47].save(tmp_path / name)
    code = "import sys, test_snapshots; test_snapshots.in_another_process(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        cwd=ROOT / "tests",
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        },
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    for name in CHILD:
        assert found[name] == [one.hex() for one in courses(name)[1][47 : 47 + FOLLOW]], name


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    moment=st.integers(0, STEPS - 1),
    steps=st.integers(0, 8),
    name=st.sampled_from(["pile", "hardware", "queue-chipmunk"]),
)
def test_any_moment_will_do(moment, steps, name, courses):
    """Back and forth: from a moment, then some steps, then its own moment, and on."""
    env, wanted, snapshots = courses(name)
    first = max(one for one in MOMENTS if one <= moment)
    env.set_state(snapshots[first])
    for number in range(first, moment):
        assert step(env, name, number) == wanted[number]
    taken = env.get_state()
    last = min(moment + steps, STEPS)
    assert [step(env, name, number) for number in range(moment, last)] == wanted[moment:last]
    env.set_state(taken)
    assert [step(env, name, number) for number in range(moment, last)] == wanted[moment:last]


def test_the_moment_is_seen_again(courses):
    env = make("hardware")
    start(env, "hardware")
    for number in range(20):
        step(env, "hardware", number)
    *_, infos = env.step({agent: np.zeros(2) for agent in env.agents})
    seen, taken = env._observations(), env.get_state()
    env.reset(seed=5)
    observations, again = env.set_state(taken)
    for agent in env.possible_agents:
        assert observations[agent].tobytes() == seen[agent].tobytes()
        assert [*again[agent].items()] == [*infos[agent].items()]


def test_what_is_known_to_be_out_of_reach_stays_so_in_snapshots_and_copies():
    far = {"pushables": [thing(9000.0, 9000.0, True)]}
    env, other = (tlf_env.parallel_env("infinity", world=far) for _ in range(2))
    env.reset(seed=0)
    for _ in range(3):
        env.step({agent: np.zeros(2) for agent in env.agents})
    plant = env.formation.plant
    assert plant._is_calm()
    other.set_state(env.get_state())
    for twin in (other, copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert twin.formation.plant._is_calm()
        assert twin.formation.plant._calm_until == plant._calm_until
        twin.pushable_bodies[0].position = (500.0, 0.0)
        assert not twin.formation.plant._is_calm()


def test_branches_of_one_moment(courses):
    """The same moment under several actions: each branch is that of an environment that only went there."""
    env, _, snapshots = courses("pile")

    def ends(env: Any, forward: float) -> bytes:
        for _ in range(5):
            env.step({agent: np.array([forward, 0.0]) for agent in env.agents})
        return env.state().tobytes()

    found = []
    for forward in (0.5, -0.5, 0.0):
        env.set_state(snapshots[47])
        found.append(ends(env, forward))
    assert len(set(found)) == 3
    for forward, wanted in zip((0.5, -0.5, 0.0), found, strict=True):
        alone = make("pile")
        alone.set_state(snapshots[47])
        assert ends(alone, forward) == wanted


def test_many_returns_to_a_moment_in_contact_take_no_more_memory(courses):
    """Chipmunk's memory of contacts is used again. (What stays is the contacts themselves, 0.2 KB each.)"""
    resource = pytest.importorskip("resource")
    env, _, snapshots = courses("pile")
    for count in (30, 400):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(count):
            env.formation.restore(snapshots[61])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # KB


# --- after the end, the next episode, generators ------------------------------------------------------


def test_a_snapshot_of_the_end_and_the_episode_after():
    env = tlf_env.parallel_env("infinity", horizon_s=0.4, disturbance="noise")
    env.reset(seed=4)
    while env.agents:
        env.step({agent: np.zeros(2) for agent in env.agents})
    taken, infos = env.get_state(), env._infos()
    draws = env.np_random.random(3)
    after = [row.tobytes() for row in env.reset()[0].values()]
    other = tlf_env.parallel_env("infinity", horizon_s=0.4, disturbance="noise")
    assert other.set_state(taken)[1] == infos
    assert not other.agents
    assert other.step({}) == ({}, {}, {}, {}, {})
    assert other.np_random.random(3).tolist() == draws.tolist()
    assert [row.tobytes() for row in other.reset()[0].values()] == after


def test_the_generator_goes_back_with_the_environment():
    env = tlf_env.parallel_env("infinity")
    env.reset(seed=1)
    env.np_random.random(5)
    taken = env.get_state()
    wanted = env.np_random.random(5).tolist()
    env.reset(seed=9)
    env.set_state(taken)
    assert env.np_random.random(5).tolist() == wanted


@pytest.mark.parametrize(
    "made",
    [
        lambda: tlf_env.parallel_env("infinity"),
        lambda: gymnasium.make("tlf_env/Infinity-v0").unwrapped,
        lambda: gymnasium.make_vec("tlf_env/Infinity-v0", num_envs=2),
        lambda: tlf_env.BatchPlant("infinity", 2),
        lambda: Formation(tlf_env.load_scenario("infinity")),
    ],
)
def test_there_is_no_state_before_the_first_reset(made):
    with pytest.raises(RuntimeError, match=r"^call reset\(\) before get_state\(\)$"):
        made().get_state()


def test_a_window_and_images_go_on():
    env = tlf_env.parallel_env("infinity", render_mode="rgb_array")
    env.reset(seed=0)
    taken, image = env.get_state(), env.render()
    for _ in range(3):
        env.step({agent: np.array([0.5, 0.0]) for agent in env.agents})
    env.render()
    env.set_state(taken)
    np.testing.assert_array_equal(env.render(), image)
    env.close()


# --- one learner, and vector environments -------------------------------------------------------------


class Wavering:
    """Drives the others with a memory of its own beside the state that predict returns."""

    def __init__(self) -> None:
        self.calls = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if state is None or episode_start.any():
            state = (np.zeros(len(observation)), {"turns": 0})
        filtered, counts = state
        filtered = 0.9 * filtered + observation[:, 0]
        self.calls += 1
        forward = np.tanh(filtered + 0.01 * self.calls + 0.02 * counts["turns"])
        return np.stack([0.3 + 0.1 * forward, 0.0 * forward], axis=1), (
            filtered,
            {"turns": counts["turns"] + 1},
        )

    def get_state(self):
        return {"calls": self.calls}

    def set_state(self, state):
        self.calls = state["calls"]


class Forgetful(Wavering):
    """The same without the hook for what it counts."""

    get_state = set_state = None  # type: ignore[assignment]

    def predict(self, *given, **named):
        self.calls = 0
        return super().predict(*given, **named)


@pytest.mark.parametrize("others", ["reference", Wavering, Forgetful])
def test_one_learner_goes_on_with_the_policy_of_the_others(others, tmp_path):
    def made() -> Any:
        policy = others if isinstance(others, str) else others()
        return gymnasium.make(
            "tlf_env/Infinity-v0", others=policy, disturbance="noise", end_on=()
        ).unwrapped

    def run(env: Any, count: int) -> list[Any]:
        rows = []
        for number in range(count):
            seen, *rest, info = env.step(np.array([0.1, 0.02 * (number % 3)]))
            rows.append((seen.tobytes(), rest, [*info.items()]))
        return rows

    env = made()
    env.reset(seed=6)
    run(env, 30)
    env.np_random.random()
    env.get_state().save(tmp_path / "moment")
    draw, wanted = env.np_random.random(), run(env, 30)
    other = made()
    seen, info = other.set_state(Snapshot.load(tmp_path / "moment"))
    assert seen.shape == other.observation_space.shape
    assert "position_error_mm" in info
    assert other.np_random.random() == draw
    assert run(other, 30) == wanted


def as_text(value: Any) -> str:
    """Every bit of infos, nested ones too."""
    if isinstance(value, dict):
        return repr([(key, as_text(one)) for key, one in value.items()])
    if isinstance(value, np.ndarray) and value.dtype == object:
        return repr([as_text(one) for one in value])
    return repr(value.tobytes()) if isinstance(value, np.ndarray) else repr(value)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_vector_environments_go_on_at_every_step(mode):
    """Also right after an end, with other threads, staggered, and with a mixture of scenarios."""
    scenarios = [
        {"base": "infinity", "disturbance": "noise", "horizon_s": 0.3},
        {"base": "infinity", "disturbance": "slip", "horizon_s": 0.3},
    ]

    def made(threads: int) -> Any:
        return tlf_env.envs.vector.FormationVectorEnv(
            scenarios, 20, mixture=[0.3, 0.7], staggered=True, autoreset_mode=mode, threads=threads
        )

    def run(env: Any, first: int, last: int) -> list[Any]:
        rows = []
        for number in range(first, last):
            rng = np.random.default_rng(number)
            if mode == "Disabled" and env._over.any():
                env.reset(options={"reset_mask": env._over.copy(), "phase_s": 0.5 * (number % 3)})
            seen, rewards, ended, cut, infos = env.step(rng.uniform(-1, 1, (20, 2)))
            numbers = as_text(infos)
            rows.append(
                (seen.tobytes(), rewards.tobytes(), ended.tobytes(), cut.tobytes(), numbers)
            )
        return rows

    env, other = made(1), made(2)
    env.reset(seed=2, options={"phase_s": np.linspace(0.0, 2.0, 20)})
    env.plant.set_shares([0.8, 0.2])
    taken = []
    for number in range(22):
        if number % 2 or number > 13:
            taken.append((number, env.get_state(), env._now().observations.tobytes()))
        run(env, number, number + 1)
    for number, snapshot, seen in taken:
        one, two = (env, other) if number % 3 else (other, env)
        assert one.set_state(snapshot)[0].tobytes() == seen
        course = run(one, number, number + 4)
        two.set_state(pickle.loads(pickle.dumps(snapshot)))
        assert run(two, number, number + 4) == course
        assert two.plant.seeds.tolist() == one.plant.seeds.tolist()


def test_a_batch_goes_on_from_a_file_with_start_poses(tmp_path):
    poses = np.random.default_rng(0).normal(size=(6, 3, 3)) * [50.0, 50.0, 0.1]
    poses[:, :, 0] += np.array([0.0, 600.0, 1200.0])

    def run(plant: Any, count: int) -> bytes:
        digest = hashlib.sha256()
        for number in range(count):
            plant.step(np.random.default_rng(number).uniform(-1, 1, (6, 3, 2)))
            plant.reset_finished()
            for array in (
                plant.observations,
                plant.rewards,
                plant.infos,
                plant.state(),
                plant.seeds,
            ):
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.digest()

    plant = tlf_env.BatchPlant("infinity", 6, horizon_s=0.6, disturbance="combined-medium")
    plant.reset(seed=1)
    plant.reset(mask=np.array([True, False] * 3), options={"poses": poses, "phase_s": 2.0})
    run(plant, 17)
    plant.get_state().save(tmp_path / "moment")
    wanted = run(plant, 40)
    other = tlf_env.BatchPlant(
        "infinity", 6, horizon_s=0.6, disturbance="combined-medium", threads=2
    )
    other.set_state(Snapshot.load(tmp_path / "moment"))
    assert run(other, 40) == wanted


def test_a_partly_started_batch_stays_so():
    plant = tlf_env.BatchPlant("infinity", 3)
    plant.reset(seed=1, mask=np.array([True, False, True]))
    other = tlf_env.BatchPlant("infinity", 3)
    other.set_state(plant.get_state())
    with pytest.raises(RuntimeError, match="formation 1: call reset"):
        other.step(np.zeros((3, 3, 2)))


def test_a_formation_goes_on_and_a_restart_of_a_batch_is_that_of_its_start():
    formation = Formation(tlf_env.load_scenario("infinity", disturbance="slip"))
    formation.reset(3)
    formation.arrays.actions[0] = 0.2
    for _ in range(10):
        formation.step()
    taken = formation.get_state()
    rows = []
    for _ in range(2):
        for _ in range(10):
            formation.step()
        rows.append(formation.state().tobytes())
        formation.set_state(taken)
    assert rows[0] == rows[1]


# --- parts, policies and adversaries in Python --------------------------------------------------------


class Odometry:
    """Plain attributes only, and a constant of the robot's."""

    def __init__(self, robot, period_s):
        self.robot, self.norm = robot, np.hypot
        self.rng = np.random.default_rng(3)

    def reset(self, pose):
        self.pose, self.ways = pose.copy(), deque([0.0], maxlen=4)
        self.notes = {"last": (0, None), "seen": [self.pose]}

    def update(self, readings):
        left, right = self.robot.wheel_radius_mm * readings.steps_rad
        theta = self.pose[2]
        forward, turn = (left + right) / 2, (right - left) / self.robot.axle_width_mm
        self.ways.append(float(forward))
        drift = 1e-3 * self.rng.normal() + 1e-6 * sum(self.ways) + 1e-9 * self.notes["last"][0]
        self.notes["last"] = (self.notes["last"][0] + 1, None)
        # The same array in two places: both change.
        self.pose += [-forward * np.sin(theta) + drift, forward * np.cos(theta), turn]
        assert self.notes["seen"][0] is self.pose
        return self.pose.copy()


class Loop:
    """A hook of its own, beside something that cannot be read."""

    def __init__(self, robot, period_s):
        self.lock, self.sums = object(), np.zeros(2)

    def reset(self):
        self.sums[:] = 0.0

    def torque(self, wanted_rad_s, measured_rad_s):
        self.sums += 0.001 * (wanted_rad_s - measured_rad_s)
        return np.clip(4.0 * (wanted_rad_s - measured_rad_s) + 20.0 * self.sums, -15.0, 15.0)

    def get_state(self):
        return [self.sums, None, True, "text", 2.5]

    def set_state(self, state):
        assert state[1:] == [None, True, "text", 2.5]
        self.sums[:] = state[0]


class Follow:
    def __init__(self, robot, period_s):
        self.count = 0

    def reset(self, pose):
        self.start = pose

    def update(self, message, t_s):
        self.count += 1
        x, y, theta, u_1, u_2 = message
        return x + 1e-3 * self.count, y, theta, u_1, u_2


PARTS = {"estimator": Odometry, "wheel_loop": Loop, "observer": Follow, "end_on": ()}


def with_parts(**more: Any) -> Any:
    return tlf_env.parallel_env(
        "infinity", **{**PARTS, **more}, preview_s=(0.5,), disturbance="noise"
    )


def run_parts(env: Any, count: int) -> list[bytes]:
    rows = []
    for _ in range(count):
        env.step({agent: np.array([0.3, 0.02]) for agent in env.possible_agents})
        rows.append(env.state().tobytes() + env._seen().tobytes())
    return rows


def test_parts_go_on_with_their_states(tmp_path):
    env = with_parts()
    env.reset(seed=2)
    run_parts(env, 12)
    env.get_state().save(tmp_path / "moment")
    wanted = run_parts(env, 12)
    other = with_parts()
    for env_of in (other, env, other):
        env_of.set_state(Snapshot.load(tmp_path / "moment"))
        assert run_parts(env_of, 12) == wanted


@pytest.mark.parametrize(
    ("role", "part"),
    [
        ("estimator", "examples.custom_estimator:ComplementaryFilter"),
        ("wheel_loop", "examples.custom_wheel_loop:PiLoop"),
        ("observer", "examples.custom_observer:DelayLine"),
        ("estimator", "examples.ukf_estimator:SlipUkf"),
        ("estimator", "baselines.policies.estimators.unscented:UnscentedEstimator"),
        ("estimator", "baselines.policies.estimators.moving_horizon:MovingHorizonEstimator"),
    ],
)
def test_the_examples_and_the_shipped_estimators_go_on(role, part, monkeypatch):
    monkeypatch.chdir(ROOT)
    trust = not part.startswith("baselines")  # the package's own parts need no permission
    fields = {role: part, "disturbance": "combined-medium", "end_on": (), "trust": trust}
    env, other = (tlf_env.parallel_env("infinity", **fields) for _ in range(2))
    env.reset(seed=2)
    run_parts(env, 8)
    taken = env.get_state()
    wanted = run_parts(env, 8)
    for env_of in (other, env):
        env_of.set_state(taken)
        assert run_parts(env_of, 8) == wanted


def part_with(**attributes: Any) -> type:
    class Part(Odometry):
        def reset(self, pose):
            super().reset(pose)
            vars(self).update({name: value() for name, value in attributes.items()})

    Part.__qualname__ = "Part"
    return Part


class Slotted:
    __slots__ = ("pose",)

    def __init__(self, robot, period_s):
        pass

    def reset(self, pose):
        self.pose = pose

    def update(self, readings):
        return self.pose


class HalfHook(Odometry):
    def get_state(self):
        return 0


class BadHook(Odometry):
    def get_state(self):
        return {"filter": self}

    def set_state(self, state):
        pass


def views() -> list[np.ndarray]:
    whole = np.zeros(6)
    return [whole, whole[2:]]


def ring() -> list[Any]:
    made: list[Any] = []
    made.append(made)
    return made


HINT = r"; give it the methods get_state\(\) and set_state\(state\), with plain values$"
NAMED = r"^the state of the estimator 'test_snapshots:\w+' of robot_0 cannot be read: "


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (part_with(helper=object), r"attribute\['helper'\] is <object object at .*" + HINT),
        (
            part_with(parts=lambda: {"a": [1, {2}]}),
            r"attribute\['parts'\]\['a'\]\[1\] is \{2\}" + HINT,
        ),
        (
            part_with(lines=lambda: (i for i in range(3))),
            r"attribute\['lines'\] is <generator.*" + HINT,
        ),
        (
            part_with(words=lambda: np.array(["a"])),
            r"attribute\['words'\] is an array of <U1" + HINT,
        ),
        (
            part_with(both=views),
            r"attribute\['both'\]\[1\] is an array in the memory of another" + HINT,
        ),
        (part_with(ring=ring), r"attribute\['ring'\]\[0\] contains itself" + HINT),
        (
            part_with(keys=lambda: {(1, 2): 3}),
            r"attribute\['keys'\] has keys that are neither" + ".*" + HINT,
        ),
        (Slotted, "its attributes are in slots" + HINT),
        (HalfHook, r"it has get_state\(\) but no set_state\(\)$"),
        (BadHook, r"the value of get_state\(\)\['filter'\] is <test_snapshots.BadHook.*" + HINT),
    ],
)
def test_a_part_whose_state_cannot_be_read_is_named(part, message):
    env = tlf_env.parallel_env("infinity", estimator=part)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=NAMED + message):
        env.get_state()
    env.step({agent: np.zeros(2) for agent in env.agents})


def test_a_part_that_does_not_take_its_state_is_named_and_nothing_changes():
    class Refusing(Loop):
        def set_state(self, state):
            raise RuntimeError("no\nroom")

    Refusing.__qualname__ = "Refusing"
    env = tlf_env.parallel_env("infinity", wheel_loop=Refusing)
    env.reset(seed=0)
    taken = env.get_state()
    env.step({agent: np.zeros(2) for agent in env.agents})
    before = env.get_state()
    with pytest.raises(
        ValueError,
        match=r"^the wheel loop 'test_snapshots:Refusing' of robot_0 does not take its state: "
        r"RuntimeError: no room$",
    ):
        env.set_state(taken)
    assert env.get_state() == before


@pytest.mark.parametrize("tree", [None, {}, {"wheel_loop": []}, {"wheel_loop": [{}, {}, {}]}])
def test_parts_without_their_states_are_refused(tree):
    env = tlf_env.parallel_env("infinity", wheel_loop=Loop)
    env.reset(seed=0)
    taken = env.get_state()
    damaged = Snapshot(taken.kind, taken._fits, {**taken._memory, "parts": tree}, taken.numbers)
    with pytest.raises(ValueError, match=r"no states for each wheel_loop|does not take its state"):
        env.set_state(damaged)
    assert env.get_state() == taken


class Base(Wavering):
    """A policy beneath the action residual."""


def test_a_policy_as_base_goes_on():
    def made() -> Any:
        return tlf_env.parallel_env(
            "infinity", action="residual", residual_base=Base(), disturbance="noise", end_on=()
        )

    env, other = made(), made()
    env.reset(seed=0)
    run_parts(env, 10)
    taken = env.get_state()
    wanted = run_parts(env, 10)
    for env_of in (other, env):
        env_of.set_state(taken)
        assert run_parts(env_of, 10) == wanted


class Pushing:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, env):
        self.calls += 1
        return {"slip.delta_1_mm_s": 5.0 * (self.calls % 7)}

    def get_state(self):
        return self.calls

    def set_state(self, state):
        self.calls = state


def test_an_adversary_with_a_hook_goes_on_and_one_without_keeps_its_own():
    envs = [tlf_env.parallel_env("infinity", adversary=Pushing(), end_on=()) for _ in range(2)]
    envs[0].reset(seed=0)
    run_parts(envs[0], 10)
    taken = envs[0].get_state()
    wanted = run_parts(envs[0], 10)
    for env in envs[::-1]:
        env.set_state(taken)
        assert run_parts(env, 10) == wanted
    quiet = tlf_env.parallel_env("infinity", adversary=lambda env: {"slip.delta_1_mm_s": 2.0})
    quiet.reset(seed=0)
    quiet.set_state(quiet.get_state())


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        2**100,
        -0.5,
        float("inf"),
        "text",
        [1, (2, [3.5, None])],
        {"a": {1: "b"}},
        deque([1, 2], maxlen=3),
        np.float32(0.1),
        np.arange(6, dtype=np.int16).reshape(2, 3),
        np.zeros((0, 3)),
        np.array(2.0),
    ],
)
def test_plain_values_come_back_through_json(value):
    numbers: dict[str, np.ndarray] = {}
    tree = json.loads(json.dumps(packed(value, "name", numbers, "value")))
    back = unpacked(tree, numbers)
    assert type(back) is type(value)
    if isinstance(value, np.ndarray | np.generic):
        assert back.dtype == value.dtype
        np.testing.assert_array_equal(back, value)
    else:
        assert back == value
    if isinstance(value, deque):
        assert back.maxlen == value.maxlen


@pytest.mark.parametrize("kind", ["MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64"])
def test_generators_come_back(kind):
    generator = np.random.Generator(getattr(np.random, kind)(5))
    generator.normal(size=3)
    numbers: dict[str, np.ndarray] = {}
    tree = json.loads(json.dumps(packed([generator, generator], "name", numbers, "value")))
    one, two = unpacked(tree, numbers)
    assert one is two
    assert one.normal(size=5).tolist() == generator.normal(size=5).tolist()


@pytest.mark.parametrize(
    "tree",
    [
        [1],
        {"list": 3},
        {"again": 4},
        {"array": "none"},
        {"what": 1},
        {},
        {"dict": [[1]]},
        {"generator": {"dict": [["bit_generator", "__class__"]]}},
        {"deque": [1]},
    ],
)
def test_what_is_no_packed_value_is_refused(tree):
    with pytest.raises(ValueError, match="no packed value"):
        unpacked(tree, {})


@pytest.mark.parametrize(
    "around",
    [lambda one: [one], lambda one: (one,), lambda one: {"key": one}, lambda one: deque([one])],
)
def test_what_is_nested_too_deeply_is_refused(around):
    value: Any = []
    for _ in range(DEEPEST):
        value = around(value)
    assert unpacked(packed(value, "name", {}, "value"), {}) == value
    with pytest.raises(NotPlainError, match="nested too deeply"):
        packed(around(value), "name", {}, "value")


# --- a user's objects in the space --------------------------------------------------------------------


def with_objects(
    *, mass: float = 1.0, rope: bool = True, late: bool = False, reset: bool = True
) -> Any:
    env = make("pile")
    if reset:
        start(env, "pile")
    space = env.space
    box = pymunk.Body(mass, 2000.0)
    box.position = (-60.0, 180.0)
    box.center_of_gravity = (3.0, 1.5)
    shape = pymunk.Poly.create_box(box, (40.0, 40.0))
    shape.friction = 0.3
    cart = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
    cart.position, cart.velocity = (-400.0, 150.0), (120.0, 0.0)
    space.add(box, shape, cart, pymunk.Circle(cart, 40.0))
    wall = pymunk.Segment(space.static_body, (-500.0, 700.0), (500.0, 700.0), 4.0)
    space.add(wall)
    if rope:
        bodies = (
            env.robot_bodies
            if reset
            else dict(zip(env.possible_agents, env.formation.plant.bodies, strict=True))
        )
        space.add(pymunk.SlideJoint(bodies["robot_0"], box, (0.0, 0.0), (5.0, 0.0), 0.0, 170.0))
        space.add(pymunk.DampedSpring(cart, box, (0.0, 0.0), (0.0, 5.0), 100.0, 5.0, 2.0))
    if late:
        space.remove(wall)
        space.add(wall)
    return env


def step_objects(env: Any, number: int) -> bytes:
    if number % 4 == 0:
        env.robot_bodies["robot_1"].apply_force_at_world_point((200.0, 50.0), (0.0, 0.0))
    given = step(env, "pile", number)
    rows = [(*body.position, body.angle, *body.velocity) for body in env.space.bodies]
    return given + np.array(rows).tobytes()


PULLED = (0, 4, 19, 40)


def pull(env: Any, number: int) -> None:
    if number in PULLED:
        env.robot_bodies["robot_2"].apply_force_at_world_point((0.0, 90.0), (0.0, 0.0))


def test_objects_that_a_user_has_added_go_on_too(tmp_path):
    env = with_objects()
    taken, wanted = {}, []
    for number in range(60):
        pull(env, number)
        if number in PULLED:
            taken[number] = env.get_state()  # with a force that acts in the coming step
        wanted.append(step_objects(env, number))
    other = with_objects(reset=False, late=True)
    for number, snapshot in taken.items():
        snapshot.save(tmp_path / "moment")
        for env_of in (other, env):
            env_of.set_state(Snapshot.load(tmp_path / "moment"))
            for now in range(number, min(number + 15, 60)):
                if now > number:
                    pull(env_of, now)
                assert step_objects(env_of, now) == wanted[now], (number, now)
    # And the next episode puts them back to where this one found them.
    rows = []
    for env_of in (env, other):
        env_of.set_state(taken[40])
        start(env_of, "pile", seed=5)
        rows.append([step_objects(env_of, number) for number in range(10)])
    assert rows[0] == rows[1]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"mass": 2.0}, r"space.bodies\[\d+\].mass is 2.0 here, and 1.0 in it"),
        ({"rope": False}, r"the number of space.constraints is \d+ here, and \d+ in it"),
    ],
)
def test_other_objects_are_refused(fields, message):
    env, other = with_objects(), with_objects(**fields)
    with pytest.raises(ValueError, match=f"^the snapshot does not fit: {message}$"):
        other.set_state(env.get_state())


def test_an_object_too_many_is_refused_and_nothing_changes(courses):
    taken = courses("pile")[2][20]
    env = with_objects()
    before = env.get_state()
    with pytest.raises(ValueError, match=r"the number of space.bodies is 14 here, and 12 in it"):
        env.set_state(taken)
    assert env.get_state() == before


# --- what does not fit --------------------------------------------------------------------------------


def moment(**fields: Any) -> Snapshot:
    env = tlf_env.parallel_env("infinity", **fields)
    env.reset(seed=0)
    return env.get_state()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"time_gap_s": 2.0}, r"scenario.time_gap_s is 3.0 here, and 2.0 in it"),
        ({"robots": 4}, r"scenario.robots is 3 here, and 4 in it"),
        ({"plant": "chipmunk"}, r"scenario.plant is 'pymunk' here, and 'chipmunk' in it"),
        ({"plant": "kinematic"}, r"scenario.plant is 'pymunk' here, and 'kinematic' in it"),
        ({"disturbance": "slip"}, r"scenario.disturbance\..* here, and .* in it"),
        ({"robot": {"mass_kg": 1.7}}, r"scenario.robot\S* is .* here, and .* in it"),
        (
            {"world": {"pushables": [thing(0.0, 900.0, True)]}},
            "the number of scenario.world.pushables is 0 here, and 1 in it",
        ),
    ],
)
def test_another_scenario_is_refused_and_nothing_changes(fields, message):
    env = (
        tlf_env.parallel_env("infinity", time_gap_s=3.0)
        if "time_gap_s" in fields
        else tlf_env.parallel_env("infinity")
    )
    env.reset(seed=1)
    before = env.get_state()
    with pytest.raises(ValueError, match=f"^the snapshot does not fit: {message}$"):
        env.set_state(moment(**fields))
    assert env.get_state() == before


def test_the_name_of_a_scenario_does_not_matter():
    scenario = tlf_env.load_scenario("infinity")
    env = tlf_env.parallel_env(scenario.model_copy(update={"name": "mine"}))
    env.set_state(moment())


def test_snapshots_of_other_classes_are_refused():
    taken = moment()
    plant = tlf_env.BatchPlant("infinity", 2)
    with pytest.raises(
        ValueError, match=r"^the snapshot is of a FormationParallelEnv, not of a BatchPlant$"
    ):
        plant.set_state(taken)
    plant.reset(seed=0)
    with pytest.raises(ValueError, match="of a BatchPlant, not of a FormationParallelEnv"):
        tlf_env.parallel_env("infinity").set_state(plant.get_state())
    with pytest.raises(ValueError, match=r"formations is 3 here, and 2 in it"):
        tlf_env.BatchPlant("infinity", 3).set_state(plant.get_state())
    with pytest.raises(ValueError, match=r"staggered is True here, and False in it"):
        tlf_env.BatchPlant("infinity", 2, staggered=True).set_state(plant.get_state())
    with pytest.raises(ValueError, match=r"mixture is True here, and False in it"):
        tlf_env.BatchPlant("infinity", 2, mixture=True).set_state(plant.get_state())
    with pytest.raises(ValueError, match=r"the number of scenarios is 2 here, and 1 in it"):
        tlf_env.BatchPlant(["infinity"] * 2, 2).set_state(plant.get_state())


def test_other_learners_policies_and_modes_are_refused():
    env = gymnasium.make("tlf_env/Infinity-v0", learner="robot_1").unwrapped
    env.reset(seed=0)
    other = gymnasium.make("tlf_env/Infinity-v0", learner="robot_2").unwrapped
    with pytest.raises(ValueError, match="learner is 'robot_2' here, and 'robot_1' in it"):
        other.set_state(env.get_state())
    other = gymnasium.make("tlf_env/Infinity-v0", learner="robot_1", others=Wavering()).unwrapped
    with pytest.raises(
        ValueError, match="others is 'test_snapshots:Wavering' here, and 'reference' in it"
    ):
        other.set_state(env.get_state())
    vector = [
        gymnasium.make_vec(
            "tlf_env/Infinity-v0", num_envs=2, vectorization_mode="vector_entry_point", **fields
        )
        for fields in ({}, {"autoreset_mode": "SameStep"})
    ]
    vector[0].reset(seed=0)
    with pytest.raises(ValueError, match="autoreset_mode is 'SameStep' here, and 'NextStep' in it"):
        vector[1].set_state(vector[0].get_state())


@pytest.mark.parametrize("value", [None, {}, b"bytes", "moment", np.zeros(3)])
def test_what_is_no_snapshot_is_refused(value):
    env = tlf_env.parallel_env("infinity")
    with pytest.raises(
        TypeError, match=r"^the state must be a tlf_env.Snapshot, as of get_state\(\), got "
    ):
        env.set_state(value)


def with_number(taken: Snapshot, name: str, change: Callable[[np.ndarray], Any]) -> Snapshot:
    """A snapshot with one array changed."""
    numbers = {key: array.copy() for key, array in taken.numbers.items()}
    changed = change(numbers[name])
    if changed is None:
        del numbers[name]
    else:
        numbers[name] = changed
    return Snapshot(taken.kind, taken._fits, taken._memory, numbers)


def put(value: Any, *place: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[place] = value
        return array

    return change


RANGE = "^the snapshot is damaged: its episode has a step, seed or number out of range$"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("arrays/states", put(np.nan, 0, 0, 0), "arrays/states has a number that is not finite$"),
        (
            "arrays/states",
            lambda a: a.astype(np.float32),
            "states has the type float32, not float64$",
        ),
        (
            "arrays/states",
            lambda a: a[:-1],
            r"states has the shape \(\d+, 4, 1\), not \(\d+, 4, 1\)$",
        ),
        ("arrays/states", lambda a: a[0], r"states has the shape \(4, 1\), not \(\d+, 4, 1\)$"),
        ("arrays/states", lambda a: None, "the snapshot does not fit: arrays/states is missing$"),
        ("arrays/clock", put(10**6, 0, 1), RANGE),
        ("arrays/clock", put(-1, 0, 1), RANGE),
        ("arrays/clock", put(10**6, 0, 3), RANGE),
        ("arrays/clock", put(1, 0, 0), RANGE),
        ("arrays/clock", put(-1, 0, 2), RANGE),
        ("arrays/seeds", put(-1, 0), RANGE),
        ("arrays/variants", put(1, 0), RANGE),
        ("arrays/routes", put(1, 0), RANGE),
        ("arrays/routes", put(-1, 0), RANGE),
        ("arrays/ends", put(99, 0, 0), RANGE),
        ("arrays/touched_by", put(-3, 0, 0), RANGE),
        ("arrays/kinds", put(3, 0, 0), "its robots have other kinds of actions$"),
        ("arrays/states", put(1e16, 0, 0, 0), "arrays/states has a number beyond ±1e"),
        ("arrays/imposed", put(np.inf, 0, 0, 0), "imposed has a number that is not finite$"),
        ("arrays/constants", put(0.0, 0, 0, 0), "robots have constants of another scenario$"),
        ("arrays/constants", put(-1.0, 20, 1, 0), "robots have constants of another scenario$"),
        *(
            (
                "arrays/constants",
                put(value, in_array(*place), 1, 0),
                "constants of another scenario$",
            )
            for value, place in (
                (1.9e11, ("gyro_ekf", "slip_weight")),
                (2.0, ("gyro_ekf", "variance_weight")),
                (1e3, ("slip_ekf", "mean_weight")),
                (1e12, ("slip_ekf", "forward")),
            )
        ),
        ("space/bodies", put(np.inf, 0, 0), "space/bodies has a number that is not finite$"),
        ("space/bodies", lambda a: a[:-1], r"space/bodies has the shape"),
        ("space/pair_counts", put(99, 0, 0), "damaged: pairs of shapes that are out of range$"),
        ("space/pair_counts", put(-1, 0, 1), "damaged: pairs of shapes that are out of range$"),
        ("space/pair_counts", put(7, 0, 5), "damaged: pairs of shapes that are out of range$"),
        ("space/pair_counts", put(0, 0, slice(0, 2)), "damaged: a shape that touches itself$"),
        ("space/pair_counts", put(0, 0, 2), "damaged: pairs of shapes without their contacts$"),
        ("space/contacts", lambda a: a[:-1], "damaged: pairs of shapes without their contacts$"),
        (
            "space/contact_keys",
            lambda a: a[:-1],
            "damaged: pairs of shapes without their contacts$",
        ),
        ("space/shape_numbers", put(1, 0), "damaged: shapes that have no number of their own$"),
        ("space/shape_numbers", put(-1, 0), "damaged: shapes that have no number of their own$"),
    ],
)
def test_numbers_that_no_episode_has_are_refused_and_nothing_changes(
    name, change, message, courses
):
    env, _, snapshots = courses("queue")
    env.set_state(snapshots[61])
    with pytest.raises(ValueError, match=message):
        env.set_state(with_number(snapshots[47], name, change))
    assert env.get_state() == snapshots[61]


@pytest.mark.parametrize(
    ("memory", "message"),
    [
        ({"seed": -1}, "^seed -1 must be a whole number"),
        ({"seed": "x"}, "^seed 'x' must be a whole number"),
        ({"episode": -1}, "^the snapshot is damaged: its episode is none$"),
        ({"over": 3}, "^the snapshot is damaged: its episode is none$"),
        ({"random": 3}, "^the snapshot is damaged: its random generator is none$"),
        ({"phase_s": "x"}, "^the snapshot is damaged: its phase is 'x'$"),
        ({"adversary": []}, "^the adversary does not take its state: there is none$"),
        ({"seed": {"array": "none"}}, "^the snapshot is damaged: it has no 'seed'$"),
    ],
)
def test_a_memory_that_no_environment_has_is_refused(memory, message):
    taken = moment()
    env = tlf_env.parallel_env("infinity")
    with pytest.raises(ValueError, match=message):
        env.set_state(Snapshot(taken.kind, taken._fits, {**taken._memory, **memory}, taken.numbers))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("batch/phases_s", put(1.0, 0), "its phases are not those of tables$"),
        ("batch/phases_s", lambda a: a[:0], "its phases are not those of tables$"),
        ("batch/mixture", put(0.5, -1), "its shares of the scenarios do not sum to 1$"),
        ("batch/mixture", put(-0.5, 0), "its shares of the scenarios do not sum to 1$"),
        ("batch/seeded", lambda a: a[:1], "batch/seeded has the shape"),
        ("arrays/variants", put(2, 0), RANGE),
    ],
)
def test_numbers_that_no_batch_has_are_refused(name, change, message):
    plant = tlf_env.BatchPlant(["infinity", "infinity"], 4, mixture=True)
    plant.reset(seed=0)
    taken = plant.get_state()
    with pytest.raises(ValueError, match=message):
        plant.set_state(with_number(taken, name, change))
    assert plant.get_state() == taken


# --- files --------------------------------------------------------------------------------------------


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "moment"
    moment().save(path)
    return path


def test_a_file_appears_complete_or_not_at_all(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ValueError, match=r"^cannot write \S+/moment: No space"):
        moment().save(tmp_path / "moment")
    assert not list(tmp_path.iterdir())


def test_a_path_that_cannot_be_written_or_read_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"^cannot write \S+/file/moment: "):
        moment().save(tmp_path / "file" / "moment")
    with pytest.raises(ValueError, match=r"^cannot read \S+/none: No such file or directory$"):
        Snapshot.load(tmp_path / "none")
    with pytest.raises(ValueError, match=r"^cannot read .*: Is a directory$"):
        Snapshot.load(tmp_path)


def test_a_truncated_file_is_refused_at_every_length(file):
    data = file.read_bytes()
    for length in {0, 1, 7, 8, 9, 100, 1000, *range(0, len(data), 1501), len(data) - 1}:
        file.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"moment is damaged|moment has the format"):
            Snapshot.load(file)


def test_a_changed_byte_is_noticed_wherever_it_is(file):
    data = bytearray(file.read_bytes())
    for place in np.random.default_rng(0).integers(8, len(data), 60).tolist():
        data[place] ^= 0x10
        file.write_bytes(data)
        with pytest.raises(
            ValueError, match=r"moment is damaged|moment has the format|written with"
        ):
            Snapshot.load(file)
        data[place] ^= 0x10
    file.write_bytes(data)
    Snapshot.load(file)


@pytest.mark.parametrize(
    "data", [b"PK\x03\x04 a zip", b"\x80\x04\x95 a pickle" * 9, b"{}", b"\xff" * 64]
)
def test_other_files_are_refused(data, tmp_path):
    (tmp_path / "moment").write_bytes(data)
    with pytest.raises(ValueError, match=r"^\S+/moment is damaged, or no snapshot: "):
        Snapshot.load(tmp_path / "moment")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, r"has the format None, not 'tlf_env snapshot 1'$"),
        (
            {"format": "tlf_env snapshot 2"},
            r"has the format 'tlf_env snapshot 2', not 'tlf_env snapshot 1'$",
        ),
        ({"format": FORMAT}, "is damaged$"),
        ({"format": FORMAT, "about": "{", "sha256": ""}, "is damaged$"),
        ({"format": FORMAT, "about": "[" * 100_000, "sha256": ""}, "is damaged$"),
        ({"format": FORMAT, "about": "[]", "sha256": ""}, "is damaged$"),
    ],
)
def test_safetensors_of_others_are_refused(metadata, message, tmp_path):
    save_file({"weights": np.zeros(3)}, tmp_path / "moment", metadata)
    with pytest.raises(ValueError, match=f"^\\S+/moment {message}"):
        Snapshot.load(tmp_path / "moment")


def test_a_file_of_other_code_or_libraries_is_refused(file, monkeypatch):
    own = module.simulation_digest()
    with monkeypatch.context() as changed:
        changed.setattr(module, "simulation_digest", lambda: "0" * 12)
        with pytest.raises(
            ValueError,
            match=rf"^\S+ was written with another code of the simulation: '{own}'; here it is '{'0' * 12}'$",
        ):
            Snapshot.load(file)
    with monkeypatch.context() as changed:
        changed.setattr(module, "version", lambda name: "0.0")
        with pytest.raises(ValueError, match=r"another version of numba: '\S+'; here it is '0.0'$"):
            Snapshot.load(file)
    with monkeypatch.context() as changed:
        changed.setattr(tlf_env, "__version__", "9.9")
        with pytest.raises(
            ValueError, match=r"another version of tlf_env: '\S+'; here it is '9.9'$"
        ):
            Snapshot.load(file)
    Snapshot.load(file)


def test_a_file_runs_no_code(file):
    assert b"pickle" not in file.read_bytes()
    assert not file.read_bytes().startswith((b"PK", b"\x80"))


# --- the snapshot itself ------------------------------------------------------------------------------


def test_every_array_is_kept_or_follows_from_the_scenario():
    """A new array of the engine is in a snapshot, or is the same in all episodes of a scenario."""
    formations = [
        Formation(tlf_env.load_scenario("infinity", disturbance="combined-hard")) for _ in range(2)
    ]
    for seed, formation in enumerate(formations):
        formation.reset(seed)
        for _ in range(5 + seed):
            formation.step()
    one, two = (formation.arrays._asdict() for formation in formations)
    kept = {
        name.removeprefix("arrays/")
        for name in formations[0].get_state().numbers
        if "arrays/" in name
    }
    assert kept == set(one) - set(FROM_SCENARIO)
    for name in FROM_SCENARIO:
        assert one[name].tobytes() == two[name].tobytes(), name


def test_a_snapshot_does_not_change_and_cannot_be_changed():
    env = tlf_env.parallel_env("infinity", disturbance="noise")
    env.reset(seed=0)
    taken = env.get_state()
    twin = pickle.loads(pickle.dumps(taken))
    env.step({agent: np.ones(2) for agent in env.agents})
    assert taken == twin
    assert taken != env.get_state()
    assert taken.kind == "FormationParallelEnv"
    assert taken.nbytes == sum(array.nbytes for array in taken.numbers.values()) > 1000
    assert repr(taken) == f"<Snapshot of a FormationParallelEnv, {taken.nbytes} bytes>"
    assert taken != 3
    for array in [*taken.numbers.values(), *twin.numbers.values()]:
        assert not array.flags.writeable


def test_differences_are_named():
    assert difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 2}]}) is None
    assert difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}) == ("a[1].b", 2, 3)
    assert difference({"a": [1]}, {"a": [1, 2]}) == ("the number of a", 1, 2)
    assert difference({"a": 1}, {"a": True}) == ("a", 1, True)
    place, _, here = difference({}, {"a": 1})
    assert (place, here) == ("a", 1)
