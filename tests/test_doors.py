"""One scenario through every door: the same observations, rewards, ends and infos, bit for bit.

The doors are the parallel environment, its turn-based form, the Gymnasium environment with one learner,
Gymnasium's vector environment, the batch plant, the vector environment for stable-baselines3 (if it is
installed), and the recorded columns of the command line. The actions of all robots are recorded once, in
the parallel environment: those of the reference, and of the learner ``robot_1`` with noise on them.
"""

from __future__ import annotations

import functools
import json
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest

import tlf_env
from baselines import ReferencePolicy, cli
from baselines.runs.run import RECORDED, run_policy
from tlf_env.task.info import INFO_KEYS

LEARNER = 1
SEED = 5
SHORT = {"horizon_s": 3.0, "time_gap_s": 0.5, "preview_s": (0.2,), "action": "twist"}
POSES = [[0.0, 0.0, 0.1], [0.0, -300.0, 0.0], [50.0, -650.0, -0.2]]


class Case(NamedTuple):
    """A scenario's fields, and the options of the reset."""

    fields: dict[str, Any]
    options: dict[str, Any] | None = None


CASES = {
    "nominal": Case({}),
    "disturbed": Case({"disturbance": "combined-hard", "estimator": "ekf-slip"}),
    "lost": Case({"lost_beyond_mm": 120.0, "disturbance": "slip"}),
    "going on when lost": Case({"lost_beyond_mm": 60.0, "end_on": ()}),
    "sensors": Case({"observation": "sensor", "dtype": "float64"}),
    "about the reference": Case({"action": "tracking_twist", "limiter": "body"}),
    "torques": Case({"action": "torque", "cooperative": True}),
    "kinematic": Case({"plant": "kinematic", "reward": {"fine": 2.0}}),
    "phase": Case({"disturbance": "noise"}, {"phase_s": 7.3}),
    "poses": Case({"disturbance": "start"}, {"poses": POSES}),
    "touching": Case({"lost_beyond_mm": 1e5}, {"poses": [[0, 0, 0], [0, -219.5, 0], [0, -600, 0]]}),
    "walls": Case({"world": {"walls": [{"points_mm": [[0, 2750], [5000, 2750]]}]}}),
    "both options": Case({}, {"phase_s": -2.0, "poses": POSES}),
}


class Step(NamedTuple):
    """What a door returns of all robots: arrays with a row for each robot; None where it returns nothing."""

    observations: np.ndarray
    infos: list[dict[str, Any]]
    rewards: np.ndarray | None = None
    terminated: np.ndarray | None = None
    truncated: np.ndarray | None = None


class Episode(NamedTuple):
    """Steps of an episode, the reset first, and the actions between them."""

    steps: list[Step]
    actions: list[np.ndarray]


class Replay:
    """A policy that returns recorded actions of some robots."""

    def __init__(self, actions, robots) -> None:
        self._left, self._robots = iter(actions), robots

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return next(self._left)[self._robots], state


def rows(values: dict[str, Any]) -> np.ndarray:
    return np.array(list(values.values()))


def recorded(case: Case) -> Episode:
    """The episode in the parallel environment."""
    env = tlf_env.parallel_env("infinity", **SHORT | case.fields)
    observations, infos = env.reset(seed=SEED, options=case.options)
    rng, policy = np.random.default_rng(0), ReferencePolicy(preview_s=env.scenario.preview_s)
    steps, actions = [Step(rows(observations), list(infos.values()))], []
    dtype = env.action_space("robot_0").dtype
    while env.agents:
        seen = rows(observations)
        if env.scenario.observation == "tracking" and env.scenario.action == "twist":
            wanted = policy.predict(seen)[0].astype(dtype)
        else:
            wanted = rng.uniform(-0.2, 0.2, (len(seen), 2)).astype(dtype)
        wanted[LEARNER] += rng.uniform(-0.1, 0.1, 2)
        if case is CASES["touching"]:
            wanted[:] = [[0.0, 0.0], [0.3, 0.0], [0.0, 0.0]]
        actions.append(wanted)
        observations, rewards, ended, cut, infos = env.step(
            dict(zip(env.agents, wanted, strict=True))
        )
        steps.append(
            Step(rows(observations), list(infos.values()), rows(rewards), rows(ended), rows(cut))
        )
    return Episode(steps, actions)


@functools.cache
def episode_of(name: str) -> Episode:
    return recorded(CASES[name])


@pytest.fixture(params=CASES)
def case(request) -> tuple[Case, Episode]:
    return CASES[request.param], episode_of(request.param)


def without_contact(episode: Episode) -> Episode:
    """The episode up to the step before the first touch, for doors whose robots pass through each other."""
    touched = [any(info["touched"] for info in step.infos) for step in episode.steps]
    last = touched.index(True) if True in touched else len(touched)
    return Episode(episode.steps[:last], episode.actions[: max(last - 1, 0)])


def same_infos(mine: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert list(mine) == list(theirs) == list(INFO_KEYS)
    for key, value in theirs.items():
        assert mine[key] == value, key
        assert type(mine[key]) is type(value), key


def same_step(mine: Step, theirs: Step, robots=slice(None)) -> None:
    """Whether a door's step is the recorded one's rows of some robots."""
    assert mine.observations.dtype == theirs.observations.dtype
    assert np.array_equal(mine.observations, theirs.observations[robots])
    for field in ("rewards", "terminated", "truncated"):
        value, wanted = getattr(mine, field), getattr(theirs, field)
        assert (value is None) == (wanted is None)
        if value is not None:
            assert np.array_equal(value, wanted[robots]), field
    for one, other in zip(mine.infos, theirs.infos[robots], strict=True):
        same_infos(one, other)


def test_the_cases_end_in_every_way():
    ends = {name: episode_of(name).steps[-1].infos for name in CASES}
    seen = {info["end"] for infos in ends.values() for info in infos}
    assert seen == set(tlf_env.EndReason) - {tlf_env.EndReason.RUNNING}
    for infos in ends.values():
        for info in infos:
            assert set(info) == set(INFO_KEYS)
            assert all(type(value) in (float, int, bool) for value in info.values())


def test_the_turn_based_form(case):
    case, episode = case
    env = tlf_env.aec_env("infinity", **SHORT | case.fields)
    env.reset(seed=SEED, options=case.options)
    agents = list(env.agents)
    for step, actions in zip(episode.steps[1:], episode.actions, strict=True):
        for i, agent in enumerate(agents):
            assert env.agent_selection == agent
            env.step(actions[i])
        seen = [env.observe(agent) for agent in agents]
        mine = Step(
            np.array(seen),
            [env.infos[agent] for agent in agents],
            np.array([env.rewards[agent] for agent in agents]),
            np.array([env.terminations[agent] for agent in agents]),
            np.array([env.truncations[agent] for agent in agents]),
        )
        same_step(mine, step)


def test_the_gymnasium_environment(case):
    case, episode = case
    if case.fields.get("action", "twist") != "twist" or case.fields.get("observation") == "sensor":
        pytest.skip("a policy drives the other robots by twists, from `tracking`")
    others = Replay(episode.actions, [0, 2])
    env = gymnasium.make(
        "tlf_env/Infinity-v0", learner=f"robot_{LEARNER}", others=others, **SHORT | case.fields
    )
    learner = slice(LEARNER, LEARNER + 1)
    seen, info = env.reset(seed=SEED, options=case.options)
    same_step(Step(seen[None], [info]), episode.steps[0], learner)
    for step, actions in zip(episode.steps[1:], episode.actions, strict=True):
        seen, reward, *over, info = env.step(actions[LEARNER])
        mine = Step(seen[None], [info], np.array([reward]), *(np.array([one]) for one in over))
        same_step(mine, step, learner)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_the_vector_environment(case, mode):
    """Sub-environment 2 of 4 has the seed of the episode; the reference drives the other robots."""
    case, episode = case
    fields = SHORT | case.fields
    if fields["action"] != "twist" or fields.get("observation") or case is CASES["touching"]:
        pytest.skip("the reference drives the others by twists, from `tracking`")
    episode = without_contact(episode)
    env = gymnasium.make_vec(
        "tlf_env/Infinity-v0",
        num_envs=4,
        vectorization_mode="vector_entry_point",
        learner=f"robot_{LEARNER}",
        autoreset_mode=mode,
        **fields,
    )
    options = dict(case.options or {})
    learner = slice(LEARNER, LEARNER + 1)

    def of_third(infos):
        assert all(infos[f"_{key}"][2] for key in INFO_KEYS)
        return {key: infos[key][2].item() for key in INFO_KEYS}

    seen, infos = env.reset(seed=SEED - 2, options=options)
    same_step(Step(seen[2:3], [of_third(infos)]), episode.steps[0], learner)
    for step, actions in zip(episode.steps[1:], episode.actions, strict=True):
        given = np.zeros((4, 2), actions.dtype)
        given[2] = actions[LEARNER]
        if mode == "Disabled" and (infos["end"] != 0).any():
            env.reset(options={"reset_mask": infos["end"] != 0})
        seen, rewards, terminated, truncated, infos = env.step(given)
        if mode == "SameStep" and (terminated | truncated)[2]:
            assert infos["_final_obs"][2]
            seen = np.array([infos["final_obs"][2]] * 3)
            infos = infos["final_info"]
        mine = Step(seen[2:3], [of_third(infos)], rewards[2:3], terminated[2:3], truncated[2:3])
        same_step(mine, step, learner)


def test_the_batch_plant(case):
    """Formation 1 of 3 has the seed of the episode."""
    case, episode = case
    episode = without_contact(episode)
    plant = tlf_env.BatchPlant("infinity", 3, **SHORT | case.fields)
    plant.reset([1, SEED, 2], options=case.options)

    def infos():
        columns = {key: plant.info(key)[1].tolist() for key in INFO_KEYS}
        return [{key: column[i] for key, column in columns.items()} for i in range(3)]

    same_step(Step(plant.observations[1], infos()), episode.steps[0])
    for step, actions in zip(episode.steps[1:], episode.actions, strict=True):
        plant.step(np.broadcast_to(actions, (3, *actions.shape)))
        mine = Step(
            plant.observations[1],
            infos(),
            plant.rewards[1],
            plant.terminated[1],
            plant.truncated[1],
        )
        same_step(mine, step)


def test_the_vector_environment_of_stable_baselines3(case):
    """Formation 1 of 2 has the seed of the episode."""
    sb3 = pytest.importorskip("baselines.sb3", exc_type=ImportError)
    case, episode = case
    episode = without_contact(episode)
    env = sb3.FormationVecEnv("infinity", 2, seed=SEED - 1, infos=True, **SHORT | case.fields)
    if case.options is not None:
        env.set_options(case.options)
    mine = slice(3, 6)
    seen = env.reset()
    same_step(Step(seen[mine], env.reset_infos[mine]), episode.steps[0])
    returns = np.zeros(3)
    for number, (step, actions) in enumerate(
        zip(episode.steps[1:], episode.actions, strict=True), start=1
    ):
        seen, rewards, dones, infos = env.step(np.concatenate([actions, actions]))
        returns += step.rewards
        last, cut = seen[mine].copy(), np.zeros(3, dtype=np.bool_)
        for i, info in enumerate(infos[mine]):
            if dones[3 + i]:
                last[i], cut[i] = info.pop("terminal_observation"), info.pop("TimeLimit.truncated")
                statistics = info.pop("episode")
                assert (statistics["r"], statistics["l"]) == (pytest.approx(returns[i]), number)
        assert rewards.dtype == np.float32
        wanted = step._replace(rewards=step.rewards.astype(np.float32))
        same_step(Step(last, infos[mine], rewards[mine], dones[mine] & ~cut, cut), wanted)


def test_the_recorded_columns(case):
    """A recorded run has no end before the horizon; up to there it is the same episode."""
    case, episode = case
    scenario = tlf_env.load_scenario("infinity", **SHORT | case.fields)
    idle = [np.zeros_like(episode.actions[0])] * scenario.horizon_steps
    policy = Replay([*episode.actions, *idle], slice(None))
    record = run_policy(scenario, policy, SEED, options=case.options)
    known = [name for name in RECORDED if name in INFO_KEYS]
    assert len(known) > 15
    for k, step in enumerate(episode.steps):
        for name in known:
            wanted = [info[name] for info in step.infos]
            assert np.array_equal(record[name][k], wanted), (k, name)


@pytest.mark.parametrize(
    "given", [[], ["--phase-s", "7.3", "--poses", "0,0,0.1; 0,-300,0; 50,-650,-0.2"]]
)
def test_the_command_line(given, tmp_path, monkeypatch):
    """The reference, recorded by ``tlf run`` and driven by hand in the parallel environment."""
    command = ["run", "infinity", "--disturbance", "combined-hard", "--seed", str(SEED)]
    command += ["--horizon-s", "10", "--no-figures", "--out", str(tmp_path), *given]
    monkeypatch.setattr("sys.argv", ["tlf", *command])
    cli.main()
    options = {"phase_s": 7.3, "poses": POSES} if given else None
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["reset_options"] == options
    env = tlf_env.parallel_env("infinity", disturbance="combined-hard", horizon_s=10.0, end_on=())
    policy = ReferencePolicy()
    observations, infos = env.reset(seed=SEED, options=options)
    steps = [infos]
    while env.agents:
        actions, _ = policy.predict(rows(observations))
        observations, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        steps.append(infos)
    with np.load(tmp_path / "trajectory.npz") as columns:
        known = [name for name in columns.files if name in INFO_KEYS and columns[name].ndim > 1]
        assert len(known) > 15
        for name in known:
            wanted = [[info[name] for info in infos.values()] for infos in steps]
            assert np.array_equal(columns[name], wanted), name


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["--poses", "0,0"], "poses must be 3 finite rows"),
        (["--poses", "a,b,c"], "--poses 'a,b,c' must be x_mm,y_mm,theta_rad of each robot"),
        (["--phase-s", "nan"], "phase_s must be a finite number of seconds, got nan"),
    ],
)
def test_an_impossible_option_of_the_command_line_is_named(
    given, says, tmp_path, monkeypatch, capsys
):
    command = ["run", "infinity", "--out", str(tmp_path / "out"), *given]
    monkeypatch.setattr("sys.argv", ["tlf", *command])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
