"""Libraries that drive the environment: wrappers, learners, and what the page about them shows.

A test is skipped where its library is missing. ``make clients`` installs the libraries, in an
environment for each file in tests/clients, and sets ``CLIENT`` to the file whose libraries must be there.
"""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import sys
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml

import tlf_env
from tlf_env.common.presets import presets_folder
from tlf_env.task.info import INFO_KEYS

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests" / "clients"), str(ROOT / "docs" / "figures")]
each, rung, wrappers = (importlib.import_module(name) for name in ("each", "rung", "wrappers"))

PAGE = (ROOT / "docs" / "compatibility.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def pins(client: str) -> dict[str, str]:
    """The versions in a file of tests/clients, by the name of the module."""
    text = (ROOT / "tests" / "clients" / f"{client}.txt").read_text(encoding="utf-8")
    lines = re.findall(r"^([\w-]+)(?:\[\w+\])?==(\S+)$", text, re.MULTILINE)
    return {name.replace("-", "_"): version for name, version in lines}


RESULT = json.loads((ROOT / "docs" / "compatibility.json").read_text(encoding="utf-8"))
CLIENTS = {path.stem: pins(path.stem) for path in (ROOT / "tests" / "clients").glob("*.txt")}
REQUIRED = CLIENTS[os.environ["CLIENT"]] if "CLIENT" in os.environ else {}

BRIEF: dict[str, Any] = {
    "disturbance": "none",
    "horizon_s": 0.4,
    "time_gap_s": 0.2,
    "preview_s": (),
}
LOST = {**BRIEF, "horizon_s": 4.0, "lost_beyond_mm": 30.0}  # ends early by a lost robot

both_ends = pytest.mark.parametrize("ending", [BRIEF, LOST], ids=["horizon", "lost"])
pytestmark = pytest.mark.filterwarnings("ignore")  # of the libraries, about each other


def needed(name: str) -> Any:
    """The module ``name``; without it the test is skipped, unless it is one of the required."""
    if name.split(".")[0] in REQUIRED:
        return importlib.import_module(name)
    return pytest.importorskip(name)


# Wrappers of Gymnasium and SuperSuit


@pytest.mark.parametrize(
    ("group", "name"),
    [(group, name) for group, kinds in wrappers.GROUPS.items() for name in kinds],
)
def test_a_wrapper_runs_past_two_ends(
    group: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    if REQUIRED and "gymnasium" not in REQUIRED:
        pytest.skip("the client whose requirements name Gymnasium tries the wrappers")
    needed(group.partition(",")[0].lower())
    if name == "NumpyToTorch":
        needed("torch")
        needed("array_api_compat")
    if name == "ArrayConversion":
        needed("array_api_compat")
    if name == "RecordVideo":
        needed("moviepy")
    if (kind := wrappers.GROUPS[group][name]) and getattr(kind, "made", None):
        needed("pygame")
    if name == "ObstructView":
        needed("cv2")
    if not wrappers.exists(group, name) and not REQUIRED:
        pytest.skip(f"this version of {group} has no {name}")
    assert wrappers.outcome(group, name) == ""


def test_a_skipped_frame_is_a_step_with_the_same_action() -> None:
    supersuit = needed("supersuit")
    plain = tlf_env.parallel_env("infinity", **BRIEF)
    skipping = supersuit.frame_skip_v0(tlf_env.parallel_env("infinity", **BRIEF), 3)
    plain.reset(seed=3)
    skipping.reset(seed=3)
    actions = {agent: np.full(2, 0.3, np.float32) for agent in plain.agents}
    rewards = [plain.step(actions)[1] for _ in range(3)]
    _, total, *_ = skipping.step(actions)
    for agent in actions:
        assert total[agent] == pytest.approx(sum(step[agent] for step in rewards))


# Gymnasium's conversion to tensors


def test_a_single_environment_gives_tensors() -> None:
    torch = needed("torch")
    needed("array_api_compat")
    from gymnasium.wrappers import NumpyToTorch

    env = NumpyToTorch(gymnasium.make("tlf_env/Infinity-v0", **BRIEF))
    env.reset(seed=0)
    over = False
    while not over:
        seen, _, terminated, truncated, info = env.step(torch.zeros(2))
        over = terminated or truncated
    assert isinstance(seen, torch.Tensor)
    assert {key: int(info[key]) for key in ("lost", "touched", "end")} == {
        "lost": 0,
        "touched": 0,
        "end": int(tlf_env.EndReason.HORIZON),
    }


@pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
def test_a_vector_environment_gives_tensors(mode: str) -> None:
    torch = needed("torch")
    needed("array_api_compat")
    from gymnasium.wrappers.vector import NumpyToTorch

    env = NumpyToTorch(
        gymnasium.make_vec("tlf_env/Infinity-v0", num_envs=3, vectorization_mode=mode, **BRIEF)
    )
    env.reset(seed=0)
    ends = []
    for _ in range(30):
        seen, rewards, _, _, info = env.step(torch.zeros(3, 2))
        ends += info["end"].tolist()
    assert isinstance(seen, torch.Tensor)
    assert isinstance(rewards, torch.Tensor)
    assert ends.count(int(tlf_env.EndReason.HORIZON)) == 3


# Minari


def test_minari_records_what_was_driven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = needed("minari")
    pytest.importorskip("jax")  # its collector's requirement, which `minari[create]` brings
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    made = gymnasium.make("tlf_env/Infinity-v0", infos=False, **BRIEF)
    env = minari.DataCollector(made, data_format="arrow")  # the other format needs h5py
    rng = np.random.default_rng(0)
    driven: list[tuple[Any, ...]] = []
    for seed in range(3):
        seen = [env.reset(seed=seed)[0]]
        actions, rewards, over = [], [], False
        while not over:
            actions.append(rng.uniform(-1.0, 1.0, 2).astype(np.float32))
            row, reward, terminated, truncated, _ = env.step(actions[-1])
            seen.append(row)
            rewards.append(reward)
            over = terminated or truncated
        driven.append((seen, actions, rewards))
    env.create_dataset("tlf/brief-v0", algorithm_name="random", eval_env="tlf_env/Infinity-v0")
    env.close()
    loaded = minari.load_dataset("tlf/brief-v0")
    assert loaded.total_episodes == 3
    for episode, (seen, actions, rewards) in zip(loaded, driven, strict=True):
        np.testing.assert_array_equal(episode.observations, seen)
        np.testing.assert_array_equal(episode.actions, actions)
        np.testing.assert_array_equal(episode.rewards, rewards)
        assert episode.truncations.tolist() == [False] * 19 + [True]
    again = loaded.recover_environment()
    np.testing.assert_array_equal(again.reset(seed=0)[0], driven[0][0][0])


# TorchRL

every_choice_of_infos = pytest.mark.parametrize(
    "infos", [True, False, ("position_error_mm", "end")], ids=["all", "none", "two"]
)


@every_choice_of_infos
@both_ends
def test_torchrl_drives_the_parallel_environment(infos: Any, ending: dict[str, Any]) -> None:
    envs = needed("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    env = envs.PettingZooWrapper(
        tlf_env.parallel_env("infinity", infos=infos, **ending), return_state=True
    )
    check_env_specs(env)
    rollout = env.rollout(60, break_when_any_done=False)["next"]
    robots = rollout["robot"]
    over = rollout["done"].flatten()
    assert over.sum() >= 2
    lost = "lost_beyond_mm" in ending
    assert robots["terminated"][over].any(dim=1).all() == lost
    assert (robots["terminated"] ^ robots["truncated"])[over].all()
    assert rollout["state"].isfinite().all()
    keys = set(INFO_KEYS) if infos is True else set(infos or ())
    assert set(robots.get("info", {}).keys()) == keys
    if "end" in keys:
        assert (robots["info", "end"][over] > 0).all()
        assert (robots["info", "end"][~over] == 0).all()


def test_torchrl_drives_the_turn_based_environment() -> None:
    envs = needed("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    env = envs.PettingZooWrapper(tlf_env.aec_env("infinity", **BRIEF), use_mask=True)
    check_env_specs(env)
    assert env.rollout(150, break_when_any_done=False)["next", "done"].sum() == 2


@pytest.mark.parametrize("maker", ["GymEnv", "GymWrapper"])
@both_ends
def test_torchrl_drives_the_single_environment(maker: str, ending: dict[str, Any]) -> None:
    envs = needed("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    if maker == "GymEnv":
        env = envs.GymEnv("tlf_env/Infinity-v0", **ending)
    else:
        env = envs.GymWrapper(gymnasium.make("tlf_env/Infinity-v0", **ending))
    check_env_specs(env)
    over = env.rollout(60, break_when_any_done=False)["next", "done"]
    assert over.sum() >= 2


# TorchRL on the batch plant


def batch_env(formations: int = 4, **fields: Any) -> Any:
    needed("torchrl.envs")
    from baselines.torchrl import FormationBatchEnv

    return FormationBatchEnv("infinity", formations, **fields)


@every_choice_of_infos
@both_ends
def test_torchrl_drives_the_batch(infos: Any, ending: dict[str, Any]) -> None:
    env = batch_env(infos=infos, seed=1, staggered=False, **ending)
    from torchrl.envs.utils import check_env_specs

    check_env_specs(env)
    rollout = env.rollout(60, break_when_any_done=False)["next"]
    robots, over = rollout["robot"], rollout["done"].squeeze(-1)
    assert over.sum() >= 8
    lost = "lost_beyond_mm" in ending
    assert (robots["terminated"][over].any(dim=1) == lost).all()
    assert (rollout["terminated"].squeeze(-1) == robots["terminated"].any(dim=2).squeeze(-1)).all()
    assert (robots["terminated"] ^ robots["truncated"])[over].all()
    assert not robots["done"][~over].any()
    keys = set(INFO_KEYS) if infos is True else set(infos or ())
    assert set(robots.get("info", {}).keys()) == keys


def test_torchrl_gets_what_the_batch_computes() -> None:
    """Observations, rewards and state of each formation, over resets, as of the plant and of one formation."""
    env = batch_env(3, seed=5, staggered=False, action="twist", **BRIEF)
    import torch

    plant = tlf_env.BatchPlant("infinity", 3, action="twist", **BRIEF)
    plant.reset(5)
    alone = tlf_env.parallel_env("infinity", plant="batch", action="twist", **BRIEF)
    seen, own = env.reset(), alone.reset(seed=5)[0]
    rng = np.random.default_rng(0)
    for _ in range(70):
        np.testing.assert_array_equal(seen["robot", "observation"].numpy(), plant.observations)
        np.testing.assert_array_equal(seen["robot", "observation"][0], np.stack(list(own.values())))
        np.testing.assert_array_equal(seen["state"][0], alone.state())
        actions = rng.uniform(-0.2, 0.2, (3, 3, 2)).astype(np.float32)
        seen["robot", "action"] = torch.from_numpy(actions)
        stepped, seen = env.step_and_maybe_reset(seen)
        plant.step(actions)
        np.testing.assert_allclose(stepped["next", "robot", "reward"][..., 0], plant.rewards, 1e-6)
        np.testing.assert_array_equal(stepped["next", "done"][:, 0], plant.ended)
        plant.reset_finished()
        own = alone.step(dict(zip(alone.possible_agents, actions[0], strict=True)))[0]
        if not alone.agents:
            own = alone.reset()[0]


def test_torchrl_repeats_a_seed_and_goes_on_to_other_episodes() -> None:
    first, second, third = (
        batch_env(2, seed=seed, **(BRIEF | {"disturbance": "start"})).reset()["state"]
        for seed in (3, 3, 4)
    )
    assert first.equal(second)
    assert not first.equal(third)
    env = batch_env(2, seed=3, **(BRIEF | {"disturbance": "start"}))
    states = [env.reset()["state"] for _ in range(2)]
    assert not states[0].equal(states[1])


def test_torchrl_is_refused_what_the_batch_refuses() -> None:
    needed("torchrl.envs")
    with pytest.raises(ValueError, match="formations"):
        batch_env(0)
    with pytest.raises(TypeError, match="horizon"):
        batch_env(2, horizon=3)
    env = batch_env(2, seed=0, **BRIEF)
    seen = env.reset()
    seen["robot", "action"] = env.action_spec.rand()["robot", "action"] * float("nan")
    with pytest.raises(ValueError, match="must be finite"):
        env.step(seen)


# BenchMARL


def test_a_file_of_benchmarl_cannot_permit_itself_to_run_code(tmp_path: Path) -> None:
    needed("benchmarl.algorithms")
    from baselines.benchmarl import FormationTask

    path = tmp_path / "own.yaml"
    path.write_text("scenario: infinity\nestimator: nasty:Never\ntrust: true\n")
    with pytest.raises(ValueError, match=r"own\.yaml: trust must be left out"):
        FormationTask.INFINITY.get_from_yaml(str(path))


@pytest.mark.parametrize("algorithm", ["Ippo", "Mappo"])
@pytest.mark.parametrize("task", ["INFINITY", "FLOWER"])
def test_benchmarl_trains_a_task(algorithm: str, task: str, tmp_path: Path) -> None:
    algorithms = needed("benchmarl.algorithms")
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models import MlpConfig

    from baselines.benchmarl import FormationTask

    chosen = FormationTask[task].get_from_yaml()
    chosen.config.update(horizon_s=1.0, time_gap_s=0.5, preview_s=())
    config = ExperimentConfig.get_from_yaml()
    config.save_folder, config.loggers, config.render = str(tmp_path), ["csv"], False
    config.max_n_iters, config.max_n_frames = 2, None
    config.on_policy_collected_frames_per_batch = config.evaluation_interval = 200
    config.on_policy_n_envs_per_worker, config.evaluation_episodes = 2, 1
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = 100, 1
    experiment = Experiment(
        task=chosen,
        algorithm_config=getattr(algorithms, f"{algorithm}Config").get_from_yaml(),
        model_config=MlpConfig.get_from_yaml(),
        critic_model_config=MlpConfig.get_from_yaml(),
        seed=0,
        config=config,
    )
    before = _numbers(experiment)
    experiment.run()
    assert experiment.n_iters_performed == 2
    assert np.isfinite(experiment.mean_return)
    assert (_numbers(experiment) != before).any()
    logged = {path.name for path in tmp_path.rglob("*.csv")}
    assert {f"collection_robot_info_{key}.csv" for key in ("position_error_mm", "lost")} <= logged


def _numbers(experiment: Any) -> np.ndarray:
    parameters = experiment.losses["robot"].parameters()
    return np.concatenate([part.detach().numpy().ravel().copy() for part in parameters])


@pytest.mark.parametrize(
    "path",
    sorted((presets_folder() / "benchmarl").glob("*.yaml")),
    ids=lambda path: path.stem,
)
def test_the_shipped_tasks_are_arguments_of_the_environment(path: Path) -> None:
    arguments = yaml.safe_load(path.read_text(encoding="utf-8"))
    env = tlf_env.parallel_env(**arguments)
    assert env.scenario.name == path.stem
    assert list(env.reset(seed=0)[1]["robot_0"]) == arguments["infos"]


# Tianshou


def test_tianshou_trains_by_ppo(capsys: pytest.CaptureFixture[str]) -> None:
    needed("tianshou")
    shown = next(block for block in BLOCKS if "tianshou" in block)
    result = _run(shown)["result"]
    assert result.update_step > 0
    assert np.isfinite(result.best_reward)


def test_tianshou_drives_the_turn_based_environment() -> None:
    needed("tianshou")
    from tianshou.env.pettingzoo_env import PettingZooEnv

    env = PettingZooEnv(tlf_env.aec_env("infinity", **BRIEF))
    seen, _ = env.reset(seed=0)
    turns, over = 0, False
    while not over:
        seen, rewards, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        turns, over = turns + 1, terminated or truncated
    assert turns == 3 * 20
    assert np.isfinite(rewards).all()
    assert np.isfinite(seen["obs"]).all()


# AgileRL


def _brief_env() -> Any:
    return tlf_env.parallel_env("infinity", **BRIEF)


@pytest.fixture
def crowd() -> Iterator[Any]:
    """Two environments in processes of their own, by AgileRL."""
    vector = needed("agilerl.vector")
    env = vector.AsyncPettingZooVecEnv([_brief_env] * 2)
    yield env
    env.close()


def test_agilerl_steps_environments_in_processes(crowd: Any) -> None:
    alone = _brief_env()
    crowd.reset(seed=0)
    alone.reset(seed=0)
    for _ in range(10):
        seen, rewards, *_ = crowd.step({agent: np.zeros((2, 2)) for agent in crowd.agents})
        expected, paid, *_ = alone.step({agent: np.zeros(2) for agent in alone.agents})
        for agent in alone.agents:
            np.testing.assert_array_equal(seen[agent][0], expected[agent])
            assert rewards[agent][0] == pytest.approx(paid[agent])
    for _ in range(40):  # past an end
        seen, *_ = crowd.step({agent: np.zeros((2, 2)) for agent in crowd.agents})
    assert all(np.isfinite(rows).all() for rows in seen.values())


def test_agilerl_trains_by_ippo(crowd: Any) -> None:
    needed("agilerl")
    from agilerl.algorithms import IPPO
    from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy

    learner = IPPO(
        [crowd.single_observation_space(agent) for agent in crowd.agents],
        [crowd.single_action_space(agent) for agent in crowd.agents],
        agent_ids=list(crowd.agents),
        learn_step=32,
        batch_size=16,
        update_epochs=1,
    )
    _, fitness = train_multi_agent_on_policy(
        crowd,
        "infinity",
        "IPPO",
        [learner],
        max_steps=64,
        evo_steps=64,
        eval_steps=8,
        verbose=False,
    )
    assert np.isfinite(fitness).all()


# RLlib


@both_ends
def test_rllib_samples_whole_episodes(ending: dict[str, Any]) -> None:
    needed("ray.rllib")
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune.registry import register_env

    register_env(
        "brief", lambda _: ParallelPettingZooEnv(tlf_env.parallel_env("infinity", **ending))
    )
    config = (
        PPOConfig()
        .environment("brief", disable_env_checking=True)
        .multi_agent(policies={"all"}, policy_mapping_fn=lambda *_, **__: "all")
        .env_runners(num_env_runners=0)
    )
    runner = MultiAgentEnvRunner(config=config)
    episodes = runner.sample(num_episodes=3, random_actions=True)
    assert len(episodes) == 3
    assert all(episode.is_done for episode in episodes)
    if "lost_beyond_mm" not in ending:
        assert [len(episode) for episode in episodes] == [20] * 3


@pytest.mark.parametrize("runners", [0, 1], ids=["local", "remote"])
def test_rllib_trains_by_ppo(runners: int) -> None:
    ray = needed("ray")
    needed("ray.rllib")
    from ray.rllib.algorithms.ppo import PPOConfig

    config = (
        PPOConfig()
        .environment("tlf_env:tlf_env/Infinity-v0", env_config=BRIEF)
        .env_runners(num_env_runners=runners, rollout_fragment_length=100)
        .training(train_batch_size=100, minibatch_size=50, num_epochs=1)
    )
    algorithm = config.build_algo()
    try:
        sampled = algorithm.train()["env_runners"]
        assert sampled["num_env_steps_sampled"] == 100
        assert np.isfinite(sampled["episode_return_mean"])
    finally:
        algorithm.stop()
        ray.shutdown()


# The page


def _run(block: str) -> dict[str, Any]:
    """The names that a block of the page makes; skipped where one of its libraries is missing."""
    tree = ast.parse(block)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                needed(alias.name)
        elif isinstance(node, ast.ImportFrom) and node.module != "baselines.benchmarl":
            needed(str(node.module))
    made: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(block, "docs/compatibility.md", "exec"), made)
    return made


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_what_the_page_shows_runs(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert _run(BLOCKS[number])


def test_the_page_has_the_versions_that_are_installed_for_the_check() -> None:
    rows = re.findall(r"^\| \[([\w-]+)\]\(\S+\) \| (\d[\w.]*) \|", PAGE, re.MULTILINE)
    shown = {
        name.lower().replace("rllib", "ray").replace("-", "_"): version for name, version in rows
    }
    fixed = {name: version for pins in CLIENTS.values() for name, version in pins.items()}
    for name, version in shown.items():
        assert fixed.get(name, version) == version
    assert {"supersuit", "minari", "ray", "torchrl", "tianshou"} <= set(shown) & set(fixed)


def page_maker() -> Any:
    """The module that writes the tables; like the other makers of pages, it needs two extras of the project."""
    for name in ("arch", "matplotlib"):  # Tianshou brings matplotlib alone
        pytest.importorskip(name)
    return importlib.import_module("make_clients")


def test_the_tables_are_those_of_the_runs() -> None:
    make_clients = page_maker()
    for name, made in (
        ("trainings of clients", make_clients.trainings(RESULT)),
        ("wrappers", make_clients.wrappers(RESULT)),
    ):
        assert f"<!-- {name} -->\n{made}\n<!-- end of {name} -->" in PAGE


def test_every_training_is_of_the_fixed_version_and_acts_the_same_when_loaded() -> None:
    assert set(RESULT) <= set(CLIENTS)
    assert set(page_maker().ORDER) == set(CLIENTS)
    for client, runs in RESULT.items():
        assert runs["trainings"]
        for run in runs["trainings"]:
            fixed = CLIENTS[client].get(run["package"].replace("-", "_"))
            assert run["version"] == fixed or fixed is None
            assert run["loads"]


def test_a_folder_of_new_runs_replaces_the_earlier_ones(tmp_path: Path) -> None:
    make_clients = page_maker()
    first, *others = RESULT["ray"][
        "trainings"
    ]  # of an interrupted run, which did not reach the others
    changed = {"checks": [], "trainings": [first | {"steps": 1}]}
    (tmp_path / "ray.json").write_text(json.dumps(changed), encoding="utf-8")
    merged = make_clients.merged(RESULT, tmp_path)
    assert others
    assert merged["ray"]["trainings"] == changed["trainings"] + others
    assert {**merged, "ray": RESULT["ray"]} == RESULT
    (tmp_path / "new.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ValueError, match="new: not in the order of the page"):
        make_clients.merged(RESULT, tmp_path)


# The turns of the libraries


def parts(**codes: int) -> dict[str, list[list[str]]]:
    """Commands of each part that end with a code."""
    return {
        part: [[sys.executable, "-c", f"raise SystemExit({codes.get(part, 0)})"]]
        for part in each.PARTS
    }


def test_failed_tests_do_not_keep_a_library_from_its_trainings() -> None:
    assert each.failed_part(parts(), "ray") == ""
    assert each.failed_part(parts(tests=1, trainings=2), "ray") == "tests, trainings"
    assert each.failed_part(parts(install=1, tests=1), "ray") == "install"


def test_a_library_that_fails_does_not_keep_the_next_from_its_turn(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(each, "tool", lambda folder: folder / "uv")
    monkeypatch.setattr(
        each, "commands", lambda uv, folder, client, *_: parts(tests=int(client == "ray"))
    )
    monkeypatch.setattr(sys, "argv", ["each.py", "ray", "skrl"])
    assert each.main() == 1
    shown = capsys.readouterr()
    assert [line for line in shown.out.splitlines() if ":" not in line] == ["== ray", "== skrl"]
    assert shown.err == "ray failed: tests\n"


@pytest.mark.parametrize("words", [[], ["--lowest"]])
def test_without_names_each_library_has_its_turn(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []
    monkeypatch.setattr(each, "tool", lambda folder: folder / "uv")
    monkeypatch.setattr(
        each, "commands", lambda uv, folder, client, *_: taken.append(client) or parts()
    )
    monkeypatch.setattr(sys, "argv", ["each.py", *words])
    assert each.main() == 0
    assert taken == (list(each.EXTRAS) if words else sorted(CLIENTS))


def test_a_library_without_a_file_of_versions_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["each.py", "rya"])
    with pytest.raises(SystemExit, match="2"):
        each.main()


@pytest.mark.parametrize("client", each.EXTRAS)
def test_the_lowest_versions_are_those_of_an_extra(client: str, tmp_path: Path) -> None:
    parts = each.commands(Path("uv"), tmp_path, client, "2.13.0", [], lowest=True)
    project = tomllib.loads((each.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra, *others = each.EXTRAS[client]
    assert extra in project["optional-dependencies"]
    install = list(map(str, parts["install"][-1]))
    assert install[install.index("--resolution") + 1] == "lowest-direct"
    assert f"{each.ROOT}[{extra}]" in install
    assert set(others) < set(install)
    assert str(each.HERE / f"{client}.txt") not in install
    assert parts["trainings"][0][-1] == "results/clients-lowest"


def test_a_library_that_the_project_does_not_name_has_no_lowest_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["each.py", "--lowest", "skrl"])
    with pytest.raises(SystemExit, match="2"):
        each.main()


# How a training is judged


def test_a_return_that_stays_within_its_noise_does_not_rise() -> None:
    assert rung.rises([1.0, 2.0, 3.0], [2.0, 3.5, 4.2])
    assert not rung.rises([1.0, 2.0, 3.0], [5.0, 2.0, 1.0])
    assert not rung.rises([1.0, 2.0, 3.0], [0.0, 1.0, 2.0])


def test_the_rung_is_that_of_the_ladder() -> None:
    own = yaml.safe_load((ROOT / "configs/train/ladder-1-point.yaml").read_text(encoding="utf-8"))
    ladder = own["scenario"] | {"plant": own["tasks"]["infinity"]["plant"]}
    assert {name: rung.RUNG[name] for name in ladder} == ladder
    assert list(own["disturbances"]) == [rung.RUNG["disturbance"]]
    scratch = yaml.safe_load((ROOT / "configs/train/scratch.yaml").read_text(encoding="utf-8"))
    assert rung.RUNG["reward"] == scratch["scenario"]["reward"]


def test_what_is_loaded_must_act_the_same() -> None:
    def still(observation: np.ndarray, first: bool) -> np.ndarray:
        return np.zeros(2)

    def other(observation: np.ndarray, first: bool) -> np.ndarray:
        return np.full(2, 1e-6)

    assert rung.same_actions(still, still)
    assert not rung.same_actions(still, other)
    assert np.mean(rung.returns(still)) == pytest.approx(174.7, abs=0.1)
