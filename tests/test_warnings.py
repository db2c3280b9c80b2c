"""Warnings for scenarios: through every door, each line once, at the user's line of code."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import tlf_env
from baselines import cli
from baselines.benchmark.plan import Plan
from baselines.policies.reference import ReferencePolicy
from baselines.runs.run import run_policy, run_seeds
from tlf_env.envs.parallel import ReferenceWarning
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task import warn
from tlf_env.task.scenario import load_scenario, scenario_warnings

FAST = {
    "name": "fast",
    "trajectory": {"type": "circle", "radius_mm": 1000.0, "speed_mm_s": 1100.0},
    "robots": 2,
    "horizon_s": 10.0,
}
UNFIT = {"residual_base": "tuned"}  # a filter that estimates no slip
GYM = "tlf_env/Infinity-v0"


def single_doors() -> dict[str, Callable[..., Any]]:
    doors: dict[str, Callable[..., Any]] = {
        "parallel_env": tlf_env.parallel_env,
        "aec_env": tlf_env.aec_env,
        "FormationEnv": FormationEnv,
        "gymnasium.make": lambda fields: gymnasium.make(GYM, **fields),
        "make_vec": lambda fields: gymnasium.make_vec(GYM, 2, **fields),
        "FormationVectorEnv": lambda fields: FormationVectorEnv(fields, 2),
        "BatchPlant": lambda fields: tlf_env.BatchPlant(fields, 2),
    }
    try:
        from baselines.sb3 import FormationVecEnv
    except ModuleNotFoundError:
        return doors
    return doors | {"FormationVecEnv": lambda fields: FormationVecEnv(fields, 2)}


DOORS = single_doors()


def caught_from(make: Callable[[], Any]) -> list[warnings.WarningMessage]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    return [one for one in caught if one.category is ReferenceWarning]


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("extra", [{}, UNFIT, {"observation": "sensor", "horizon_s": 1100.0}])
def test_every_door_warns_of_the_same_lines_at_the_users_code(door, extra):
    fields = FAST | extra
    expected = scenario_warnings(load_scenario(fields))
    assert len(expected) > 1
    found = caught_from(lambda: DOORS[door](fields))
    assert [str(one.message) for one in found] == expected
    assert {one.filename for one in found} == {__file__}


@pytest.mark.parametrize("door", DOORS)
def test_no_door_warns_of_a_scenario_within_the_limits(door):
    calm = {**FAST, "trajectory": {**FAST["trajectory"], "speed_mm_s": 100.0}}
    assert caught_from(lambda: DOORS[door](calm)) == []


def test_the_warning_is_the_one_of_the_parallel_environment():
    assert ReferenceWarning is warn.ReferenceWarning


def test_several_scenarios_are_named_and_each_line_comes_once():
    fast = load_scenario(FAST)
    weak = load_scenario(fast, disturbance={"actuator": {"torque_gain_l": 0.5}})
    found = caught_from(lambda: tlf_env.BatchPlant([fast, fast, weak], 3))
    lines = [str(one.message) for one in found]
    assert len(set(lines)) == len(lines)
    mine, others = scenario_warnings(fast), scenario_warnings(weak)
    for line in {*mine, *others}:
        (found,) = [one for one in lines if one.endswith(line)]
        if line in mine and line in others:
            assert found == line
        else:
            assert found.startswith(
                "scenario 2: " if line in others else "scenario 0; scenario 1: "
            )


def test_many_names_are_counted():
    fast, calm = load_scenario(FAST), load_scenario("circle")
    named = [*((f"task {i}", fast) for i in range(9)), ("calm", calm)]
    for line in warn.warning_lines(named):
        assert line.startswith("task 0; task 1; task 2; task 3 and 5 more: ")


def test_recorded_runs_warn_in_neither_form():
    scenario = load_scenario(FAST, horizon_s=0.2, plant="batch", time_gap_s=0.1, preview_s=(0.1,))
    policy = ReferencePolicy(preview_s=scenario.preview_s)
    assert caught_from(lambda: run_policy(scenario, policy, 0)) == []
    assert caught_from(lambda: list(run_seeds(scenario, policy, [0, 1]))) == []


# The command line


@pytest.fixture
def fast_file(tmp_path):
    path = tmp_path / "fast.yaml"
    path.write_text(
        "trajectory: {type: circle, radius_mm: 1000, speed_mm_s: 1100}\n"
        "robots: 2\nhorizon_s: 1\ntime_gap_s: 0.5\npreview_s: [0.5]\n",
        encoding="utf-8",
    )
    return path


def warned(words: list[str], monkeypatch, capfd) -> list[str]:
    """The warnings that a command prints."""
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        cli.main()
    lines = capfd.readouterr().err.splitlines()
    assert not any("ReferenceWarning" in line for line in lines)
    return [line.split("warning: ")[1] for line in lines if "warning: " in line]


def test_a_run_prints_each_line_once(fast_file, tmp_path, monkeypatch, capfd):
    words = ["run", str(fast_file), "--no-figures", "--out", str(tmp_path / "out")]
    assert warned(words, monkeypatch, capfd) == scenario_warnings(load_scenario(fast_file))


@pytest.mark.parametrize("processes", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_a_benchmark_prints_each_line_once(processes, fast_file, tmp_path, monkeypatch, capfd):
    pytest.importorskip("arch")
    words = ["bench", "--tasks", str(fast_file), "--disturbances", "nominal,slip", "--seeds", "0:2"]
    words += ["--policies", "reference,pure_pursuit", "--plant", "batch", "--no-figures"]
    words += ["--processes", processes, "--out", str(tmp_path / "out")]
    expected = scenario_warnings(load_scenario(fast_file))
    assert expected
    assert warned(words, monkeypatch, capfd) == expected


def test_a_benchmark_names_the_disturbance_and_heeds_what_a_policy_asks_for(tmp_path):
    from baselines.benchmark.bench import named_scenarios

    plan = Plan(("reference:tuned", "residual"), ("infinity",), ("nominal", "ice"), (0, 1))
    named = named_scenarios(plan)
    assert [name for name, _ in named] == ["infinity, nominal"] * 2 + ["infinity, ice"] * 2
    assert [one.action for _, one in named] == ["twist", "residual"] * 2
    assert [one.estimator for _, one in named] == ["ekf-slip", "ekf-gyro"] * 2


def test_a_search_prints_each_line_once(fast_file, tmp_path, monkeypatch, capfd):
    pytest.importorskip("optuna")
    path = tmp_path / "search.yaml"
    path.write_text(
        f"start: consistent\nestimator: ekf\nsearch: {{gains.k_1_per_s: {{low: 0.1, high: 9}}}}\n"
        f"tasks: ['{fast_file}']\ndisturbances: [nominal, slip]\nseeds: {{first: 0, count: 1}}\n"
        "choose: {first: 10000, count: 1, finalists: 1}\nhorizon_s: 1\ntrials: 1\n"
        "objective: {settled_formation_rmse_mm: 0}\n",
        encoding="utf-8",
    )
    words = ["tune", str(path), "--out", str(tmp_path / "out")]
    lines = warned(words, monkeypatch, capfd)
    assert lines == scenario_warnings(load_scenario(fast_file))


def test_a_training_prints_each_line_once(fast_file, tmp_path, monkeypatch, capfd):
    pytest.importorskip("stable_baselines3")
    path = tmp_path / "training.yaml"
    path.write_text(
        "algorithm: PPO\nsettings: {n_steps: 16, batch_size: 32, n_epochs: 1}\nrobot_steps: 64\n"
        f"formations: 2\ntasks: {{'{fast_file}': {{}}}}\ndisturbances: {{nominal: 1}}\n"
        "evaluation: {every: 64, seeds: [10000, 10001], disturbances: [nominal], horizon_s: 1}\n",
        encoding="utf-8",
    )
    words = ["train", str(path), "--out", str(tmp_path / "out")]
    lines = warned(words, monkeypatch, capfd)
    assert lines == scenario_warnings(load_scenario(fast_file))


# Actions


def drive_doors() -> dict[str, Callable[[Any], Any]]:
    """Each door, reset, as a function of what is given for the actions of all robots."""

    def parallel() -> Callable[[Any], Any]:
        env = tlf_env.parallel_env("infinity")
        env.reset(seed=0)
        return lambda value: env.step(dict.fromkeys(env.agents, value))

    def aec() -> Callable[[Any], Any]:
        env = tlf_env.aec_env("infinity")
        env.reset(seed=0)

        def step(value: Any) -> None:
            for _ in range(3):
                env.step(value)

        return step

    def single() -> Callable[[Any], Any]:
        env = FormationEnv("infinity")
        env.reset(seed=0)
        return env.step

    def vector() -> Callable[[Any], Any]:
        env = FormationVectorEnv("infinity", 1)
        env.reset(seed=0)
        return env.step

    def batch() -> Callable[[Any], Any]:
        plant = tlf_env.BatchPlant("infinity", 1)
        plant.reset(0)
        return plant.step

    doors = {
        "parallel": parallel, "aec": aec, "single": single, "vector": vector, "batch": batch,
    }  # fmt: skip
    try:
        from baselines.sb3 import FormationVecEnv
    except ModuleNotFoundError:
        return doors

    def sb3() -> Callable[[Any], Any]:
        env = FormationVecEnv("infinity", 1, seed=0)
        env.reset()
        return env.step

    return doors | {"sb3": sb3}


DRIVES = drive_doors()
SHAPES = {
    "parallel": (2,),
    "aec": (2,),
    "single": (2,),
    "vector": (1, 2),
    "batch": (1, 3, 2),
    "sb3": (3, 2),
}


class Refusing:
    """An object that raises whatever is asked of it, as a tensor with a gradient does."""

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray:
        raise RuntimeError("call detach() first")

    def __len__(self) -> int:
        raise RuntimeError("no length")


def wrong_actions(shape: tuple[int, ...]) -> dict[str, Any]:
    zeros = np.zeros(shape)
    ragged = [[0.0], [0.0, 0.0]]
    return {
        "refusing": Refusing(),
        "text": np.full(shape, "0"),
        "complex": zeros + 0j,
        "objects": zeros.astype(object),
        "nothing": None,
        "generator": (one for one in zeros),
        "ragged": ragged,
        "mapping": {"robot_0": zeros},
        "set": {0.0, 1.0},
        "shape": np.zeros((*shape, 1)),
        "number": 0.5,
        "nan": np.full(shape, np.nan),
        "infinite": np.full(shape, np.inf),
        "function": len,
        "date": np.zeros(shape, dtype="datetime64[s]"),
    }


@pytest.mark.parametrize("door", DRIVES)
@pytest.mark.parametrize("wrong", wrong_actions((2,)))
def test_wrong_actions_are_one_value_error_at_every_door(door, wrong):
    step = DRIVES[door]()
    value = wrong_actions(SHAPES[door])[wrong]
    with pytest.raises(ValueError, match=r"\S") as caught:
        step(value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    if door != "aec":  # PettingZoo's conversion keeps the actions of the others
        step(np.zeros(SHAPES[door]))


@pytest.mark.parametrize("door", DRIVES)
@pytest.mark.parametrize("kind", ["plain", "gradient", "bfloat16", "meta"])
def test_tensors_act_or_are_a_value_error_at_every_door(door, kind):
    torch = pytest.importorskip("torch")
    step, shape = DRIVES[door](), SHAPES[door]
    if kind == "plain":
        step(torch.zeros(shape))
        return
    value = {
        "gradient": lambda: torch.zeros(shape, requires_grad=True),
        "bfloat16": lambda: torch.zeros(shape, dtype=torch.bfloat16),
        "meta": lambda: torch.zeros(shape, device="meta"),
    }[kind]()
    with pytest.raises(ValueError, match=r"numbers"):
        step(value)


@pytest.mark.parametrize(
    "value", [None, [[0, 0]] * 3, np.zeros((3, 2)), 0.0, "robot_0", {("robot_0", 0)}, Refusing()]
)
def test_actions_that_are_no_mapping_say_what_is_wanted(value):
    env = tlf_env.parallel_env("infinity")
    env.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"mapping \{agent: 2 numbers\}.*robot_0, robot_1, robot_2"
    ):
        env.step(value)


@pytest.mark.parametrize("value", [Refusing(), "high", None, [1.0], {"a": 1}])
def test_an_adversarys_value_that_is_no_number_is_refused(value):
    env = tlf_env.parallel_env("infinity", adversary=lambda env: {"slip.delta_1_mm_s": value})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"slip\.delta_1_mm_s must be a number or one per robot"):
        env.step({agent: np.zeros(2) for agent in env.agents})
