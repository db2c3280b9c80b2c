"""A disturbance's YAML file works wherever a preset's name does: through every door, from every folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import yaml

import tlf_env
from baselines import cli
from baselines.benchmark.plan import Plan, read_plan
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env.common.presets import presets_folder
from tlf_env.disturbances.model import Disturbance
from tlf_env.task.scenario import Scenario, load_scenario

CONTENT = "slip:\n  delta_1_mm_s: {type: sine, amplitude: 12.5, frequency_hz: 0.3}\n"
WANTED = Disturbance.model_validate({"name": "gusts", **yaml.safe_load(CONTENT)})
OTHER = Disturbance.model_validate({"name": "gusts"})
CIRCLE = {"type": "circle", "radius_mm": 900, "speed_mm_s": 200}


def planned(disturbance: Any, **fields: Any) -> Scenario:
    """The scenario of a benchmark's plan."""
    plan = Plan(("pure_pursuit",), ("infinity",), (str(disturbance),), (20_000, 20_001), **fields)
    return plan.scenario(plan.episodes()[0])


def trained(disturbance: Any) -> Scenario:
    """The first scenario of a training."""
    config = training(str(disturbance))
    (scenario,) = load_config(config).evaluation_scenarios().values()
    assert scenario.disturbance == load_config(config).mixture()[0]["flower"][0].disturbance
    return scenario


def training(disturbance: str) -> dict[str, Any]:
    preset = yaml.safe_load((presets_folder("training") / "quick.yaml").read_text("utf-8"))
    own = {"evaluation": preset["evaluation"] | {"disturbances": [disturbance]}}
    return preset | own | {"tasks": {"flower": {}}, "disturbances": {disturbance: 1}}


def search(disturbance: str) -> dict[str, Any]:
    preset = yaml.safe_load((presets_folder("search") / "tuned.yaml").read_text("utf-8"))
    return preset | {"tasks": ["infinity"], "disturbances": [disturbance]}


def mixed(disturbance: Any) -> Scenario:
    tasks = [{"trajectory": CIRCLE}, {"trajectory": CIRCLE, "disturbance": disturbance}]
    return tlf_env.BatchPlant(tasks, 4, mixture=True).scenarios[1]


def vector(disturbance: Any) -> Scenario:
    env = gymnasium.make_vec(
        "tlf_env/Infinity-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        disturbance=disturbance,
    )
    return env.unwrapped.plant.scenario


def with_an_adversary(disturbance: Any) -> Scenario:
    def nothing(env):
        return {}

    return tlf_env.parallel_env("infinity", disturbance=disturbance, adversary=nothing).scenario


def of_stable_baselines3(disturbance: Any) -> Scenario:
    sb3 = pytest.importorskip("baselines.sb3", exc_type=ImportError)
    env = sb3.FormationVecEnv({"infinity": "infinity"}, 2, disturbance=disturbance)
    return env.plants[0].scenario


DOORS = {
    "load_scenario": lambda d: load_scenario("infinity", disturbance=d),
    "with a level": lambda d: load_scenario("infinity", disturbance=d, disturbance_level=1.0),
    "in a mapping": lambda d: load_scenario({"trajectory": CIRCLE, "disturbance": d}),
    "Scenario": lambda d: Scenario(trajectory=CIRCLE, disturbance=d),
    "parallel_env": lambda d: tlf_env.parallel_env("infinity", disturbance=d).scenario,
    "aec_env": lambda d: tlf_env.aec_env("infinity", disturbance=d).unwrapped.scenario,
    "adversary": with_an_adversary,
    "gymnasium.make": lambda d: (
        gymnasium.make("tlf_env/Infinity-v0", disturbance=d).unwrapped.scenario
    ),
    "gymnasium.make_vec": vector,
    "BatchPlant": lambda d: tlf_env.BatchPlant("infinity", 2, disturbance=d).scenario,
    "mixture": mixed,
    "FormationVecEnv": of_stable_baselines3,
    "plan": planned,
    "plan, sweep": lambda d: planned(
        d, sweep="slip.delta_1_mm_s.amplitude", sweep_values=(12.5, 20.0)
    ),
    "plan, levels": lambda d: planned(d, sweep="level", sweep_values=(1.0, 2.0)),
    "training": trained,
}


@pytest.fixture
def gusts(tmp_path, monkeypatch) -> Path:
    """The file, in a folder beside the working directory."""
    folder, here = tmp_path / "mine", tmp_path / "here"
    for place in (folder, here):
        place.mkdir()
    monkeypatch.chdir(here)
    path = folder / "gusts.yaml"
    path.write_text(CONTENT, encoding="utf-8")
    return path


@pytest.mark.parametrize("door", DOORS)
def test_a_relative_and_an_absolute_path(door, gusts):
    relative = Path("..") / "mine" / "gusts.yaml"
    for source in (str(relative), relative, str(gusts), gusts):
        assert DOORS[door](source).disturbance == WANTED


FAULTS = {
    "missing": (None, r"cannot read \S*gusts.yaml: No such file or directory"),
    "no YAML": ("slip: [1", r"gusts.yaml is not YAML: "),
    "a list": ("- slip", r"gusts.yaml must contain a mapping, got list"),
    "an unknown channel": (
        "slip: {delta_3: 1}",
        r"gusts.yaml, disturbance.slip.delta_3: unknown key; allowed: delta_1_mm_s",
    ),
    "out of range": ("tyre: {friction_scale: -1}", r"gusts.yaml, disturbance: tyre.friction_scale"),
    "nested": ("disturbance: {slip: {delta_1_mm_s: 1}}", r"gusts.yaml has the key disturbance"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("door", [door for door in DOORS if door != "Scenario"])
def test_a_faulty_file_is_named_in_one_line(door, fault, gusts):
    content, says = FAULTS[fault]
    gusts.unlink()
    if content is not None:
        gusts.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=says) as caught:
        DOORS[door](gusts)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [3, ["slip"], True])
def test_what_is_no_disturbance_is_refused_with_a_level_too(value):
    for level in (None, 0.5):
        with pytest.raises(ValueError, match="disturbance: Input should be a mapping"):
            load_scenario("infinity", disturbance=value, disturbance_level=level)


# Files that name the disturbance's file


def of_scenario(path: Path, disturbance: str) -> Disturbance:
    path.write_text(yaml.safe_dump({"trajectory": CIRCLE, "disturbance": disturbance}))
    found = load_scenario(path).disturbance
    assert load_scenario(path, disturbance_level=1.0).disturbance == found
    return found


def of_plan(path: Path, disturbance: str) -> Disturbance:
    texts = []
    for names in (["nominal", disturbance], f"nominal, {disturbance}"):
        path.write_text(yaml.safe_dump({"disturbances": names}))
        texts.append(read_plan(str(path), {"disturbances"})["disturbances"])
    assert texts[0] == texts[1]
    nominal, name = texts[0].split(",")
    assert nominal == "nominal"
    return planned(name).disturbance


def of_training(path: Path, disturbance: str) -> Disturbance:
    path.write_text(yaml.safe_dump(training(disturbance)))
    found = [one.disturbance for _, one in load_config(path).named_scenarios()]
    assert found == [found[0], found[0]]
    return found[0]


def of_search(path: Path, disturbance: str) -> Disturbance:
    path.write_text(yaml.safe_dump(search(disturbance)))
    (scenario,) = load_tune(path).scenarios(None).values()
    return scenario.disturbance


@pytest.mark.parametrize("reader", [of_scenario, of_plan, of_training, of_search])
def test_a_file_may_name_one_in_its_folder_or_in_the_working_directory(reader, gusts):
    """Its folder comes first; the working directory is another one."""
    naming = gusts.parent / "naming.yaml"
    assert reader(naming, str(gusts)) == WANTED
    assert reader(naming, "gusts.yaml") == WANTED
    Path("gusts.yaml").write_text("level: 1.0", encoding="utf-8")
    assert reader(naming, "gusts.yaml") == WANTED
    gusts.unlink()
    assert reader(naming, "gusts.yaml") == OTHER
    Path("gusts.yaml").unlink()
    with pytest.raises(ValueError, match=r"cannot read gusts.yaml: No such file"):
        reader(naming, "gusts.yaml")


def test_a_file_that_the_caller_names_lies_in_the_working_directory(gusts):
    """Not in the folder of the scenario's file."""
    scenario = gusts.parent / "task.yaml"
    scenario.write_text(yaml.safe_dump({"trajectory": CIRCLE}), encoding="utf-8")
    Path("gusts.yaml").write_text("level: 1.0", encoding="utf-8")
    assert load_scenario(scenario, disturbance="gusts.yaml").disturbance == OTHER


# The command line


def called(monkeypatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    cli.main()


@pytest.mark.parametrize("absolute", [False, True])
def test_run(absolute, gusts, monkeypatch):
    given = str(gusts) if absolute else "../mine/gusts.yaml"
    words = f"run infinity --disturbance {given} --horizon-s 1 --no-figures --out out"
    called(monkeypatch, *words.split())
    summary = json.loads(Path("out/summary.json").read_text(encoding="utf-8"))
    assert Disturbance.model_validate(summary["scenario"]["disturbance"]) == WANTED


@pytest.mark.parametrize("absolute", [False, True])
def test_bench(absolute, gusts, monkeypatch):
    """Side by side with a preset; every table names the file as it was given."""
    pytest.importorskip("arch")
    given = str(gusts) if absolute else "../mine/gusts.yaml"
    words = "bench --policies pure_pursuit --tasks infinity --seeds 20000:20002 --horizon-s 2"
    words += f" --plant batch --processes 1 --no-figures --out out --disturbances slip,{given}"
    called(monkeypatch, *words.split())
    board = json.loads(Path("out/leaderboard.json").read_text(encoding="utf-8"))
    assert [cell["disturbance"] for cell in board["cells"]] == ["slip", given]
    assert given in Path("out/leaderboard.md").read_text(encoding="utf-8")
    gusts.write_text("level: 1.0", encoding="utf-8")  # other content in the same file
    with pytest.raises(SystemExit):
        called(monkeypatch, *words.split())


@pytest.mark.parametrize(
    "command",
    [
        "run infinity --disturbance",
        "bench --policies pure_pursuit --tasks infinity --seeds 20000:20001 --disturbances",
    ],
)
def test_a_missing_file_ends_in_one_line(command, gusts, monkeypatch, capsys):
    with pytest.raises(SystemExit) as stop:
        called(monkeypatch, *command.split(), "gusts.yaml", "--out", "out")
    assert stop.value.code == 2
    assert "cannot read gusts.yaml: No such file or directory" in capsys.readouterr().err
    assert not Path("out").exists()
