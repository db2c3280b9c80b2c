"""``tlf list``, ``tlf show``, ``--set``, completion, and names that are nearly right."""

from __future__ import annotations

import inspect
import io
import json
import os
import shlex
import subprocess
import sys
from typing import get_args

import gymnasium
import pettingzoo
import pytest
import typer
from helpers import refused

import tlf_env
from baselines import cli
from baselines.cli import options
from baselines.commands import catalogue, scenarios
from baselines.commands.examples import EXAMPLES
from baselines.policies.laws.catalogue import LAWS
from baselines.policies.learned import shipped_policies
from baselines.policies.systems import ESTIMATORS
from tlf_env.common.presets import KINDS, first_sentence, parsed_yaml, preset_names
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER
from tlf_env.task.actions import ACTION_KINDS
from tlf_env.task.scenario import Scenario, load_scenario

CHANGED = {
    "name": "infinity",
    "time_gap_s": 3,
    "robots": [{}, {"mass_kg": 1.6}],
    "disturbance": {"base": "slip", "level": 0.5},
    "limiter": "body",
}


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    cli.app(list(words), standalone_mode=False)
    return capsys.readouterr().out


# --- list


def test_every_preset_is_listed_with_a_line():
    found = catalogue.catalogue()
    listed = {name for names in found.values() for name in names}
    for kind in KINDS:
        law = kind in catalogue.LAW_LINES
        prefix = "reference:" if kind == "controller" else f"{kind}:" if law else ""
        assert {f"{prefix}{name}" for name in preset_names(kind)} <= listed
    for names in found.values():
        for name, line in names.items():
            assert line.endswith("."), name
            assert len(line) > 15, name


def test_what_is_no_preset_is_listed_too():
    docstrings = {name: first_sentence(inspect.getdoc(kind)) for name, (kind, _) in LAWS.items()}
    assert docstrings == catalogue.LAW_LINES
    assert list(catalogue.LEARNED_LINES) == shipped_policies()
    assert set(catalogue.ESTIMATOR_LINES) == set(ESTIMATORS)
    assert set(catalogue.ACTION_LINES) == set(ACTION_KINDS)
    assert set(catalogue.PLANT_LINES) == set(get_args(Scenario.model_fields["plant"].annotation))
    assert set(catalogue.policies()) >= {*LAWS, *shipped_policies(), *catalogue.POLICY_FORMS}


def test_a_list_is_printed_for_a_kind_and_as_json(capsys):
    text = printed(capsys, "list", "tasks")
    assert "infinity_from_rest" in text
    assert "slip-noise" not in text
    assert json.loads(printed(capsys, "list", "plans", "--json")) == catalogue.catalogue("plans")
    assert "slip-noise" in printed(capsys, "list")


def test_names_are_completed(capsys):
    assert cli.completed("tasks")("infinity_") == ["infinity_from_rest", "infinity_hardware"]
    assert "kanayama:searched" in cli.completed("policies")("kanayama:")


def test_the_version_is_printed(capsys):
    assert printed(capsys, "--version") == f"tlf_env {tlf_env.__version__}\n"


# --- what a start imports

# Modules that take long to import; pydantic is none of them, as typer needs it to read options.
HEAVY = ("numba", "llvmlite", "scipy", "pymunk", "matplotlib", "torch", "safetensors")
LIBRARIES = (*HEAVY, "numpy", "gymnasium", "pettingzoo", "yaml", "tlf_env")
COMMANDS = [
    command.name or command.callback.__name__ for command in cli.app.registered_commands
] + [
    command.name or command.callback.__name__
    for group in cli.app.registered_groups
    for command in group.typer_instance.registered_commands
]


def imported_by(code: str, *words: str, **variables: str) -> set[str]:
    """The packages that a fresh Python has imported at the end of some code."""
    ending = "import atexit, sys; atexit.register(lambda: print('imported', *sys.modules)); "
    done = subprocess.run(
        [sys.executable, "-c", ending + code, *words],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **variables},
    )
    return {name.partition(".")[0] for name in done.stdout.rpartition("imported ")[2].split()}


def imported_by_tlf(*words: str, **variables: str) -> set[str]:
    code = "sys.argv[0] = 'tlf'; from baselines.cli import main; main()"
    return imported_by(code, *words, **variables)


def test_the_package_imports_only_what_registers_its_tasks():
    found = imported_by("import tlf_env; assert tlf_env.TASKS and tlf_env.__version__")
    assert not found & {*HEAVY, "pydantic", "yaml", "typer", "rich"}
    assert {"gymnasium", "pettingzoo"} <= found  # their registries hold the tasks


@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS)]
)
def test_help_imports_neither_the_package_nor_a_library(words):
    assert "run" in COMMANDS
    found = imported_by_tlf(*words)
    assert "typer" in found
    assert not found & set(LIBRARIES)


def test_a_list_imports_no_heavy_module():
    assert not imported_by_tlf("list") & set(HEAVY)


def test_completion_imports_no_heavy_module():
    asked = {"_TLF_COMPLETE": "complete_bash", "COMP_CWORD": "3"}
    words = {"COMP_WORDS": "tlf run --policy kana"}
    assert not imported_by_tlf(**asked, **words) & set(HEAVY)
    commands = {**asked, "COMP_WORDS": "tlf ru", "COMP_CWORD": "1"}
    assert not imported_by_tlf(**commands) & set(LIBRARIES)


def test_the_default_of_the_options_is_the_default_controller():
    assert f"reference:{DEFAULT_CONTROLLER}" == options.DEFAULT_SYSTEM
    assert options.named_policy("reference", None) == options.DEFAULT_SYSTEM


# --- show and --set


@pytest.mark.parametrize("task", preset_names())
def test_a_shown_scenario_is_the_scenario(task, capsys):
    text = printed(capsys, "show", task)
    scenario, back = load_scenario(task), load_scenario(parsed_yaml(text, "shown"))
    assert back == scenario
    open_fields = set(type(scenario).model_fields) - back.model_fields_set
    assert {"estimator", "broadcast_smoothing_s"} & open_fields  # a policy may still ask for them
    assert back.model_dump_json() == scenario.model_dump_json()
    differences = parsed_yaml(printed(capsys, "show", task, "--changes"), "shown")
    assert load_scenario(differences) == scenario


@pytest.mark.parametrize("disturbance", preset_names("disturbance"))
def test_a_printed_scenario_is_the_scenario(disturbance):
    scenario = load_scenario({**CHANGED, "base": "infinity"}, disturbance=disturbance)
    assert load_scenario(parsed_yaml(str(scenario), "printed")) == scenario
    assert len(str(load_scenario("infinity")).splitlines()) < 20


def test_a_shown_scenario_runs_from_the_standard_input(capsys, monkeypatch, tmp_path):
    words = ["--horizon-s", "6", "--policy", "reference:consistent", "--no-figures", "--json"]
    shown = printed(capsys, "show", "circle", "--set", "time_gap_s=2")
    monkeypatch.setattr("sys.stdin", io.StringIO(shown))
    piped = printed(capsys, "run", "-", *words, "--out", str(tmp_path / "a"))
    named = printed(
        capsys, "run", "circle", "--set", "time_gap_s=2", *words, "--out", str(tmp_path / "b")
    )
    assert json.loads(piped) == json.loads(named)
    assert json.loads(piped)["scenario"]["estimator"] == "ekf"  # what the policy asks for


def test_any_field_is_set():
    settings = [
        "time_gap_s=3",
        "disturbance.slip.delta_1_mm_s=20",
        "disturbance.slip.delta_2_rad_s={type: uniform, low: -0.1, high: 0.1, every_s: 2}",
        "limiter=body",
        "limiter.limits.yaw_rate_rad_s=1.0",
        "robots=[{}, {mass_kg: 1.5}]",
        "robots.1.tyre.mu_static=0.1",
        "preview_s=[0.4]",
        "reward.alive=1",
    ]
    found = scenarios.asked_scenario("infinity", {"disturbance": "noise"}, 0.5, settings)
    assert found.time_gap_s == 3
    assert found.disturbance.name == "noise"
    assert found.disturbance.level == 0.5
    noise = load_scenario("infinity", disturbance="noise").disturbance
    assert found.disturbance.position == noise.position
    assert found.disturbance.slip.delta_1_mm_s.value == 20
    assert found.disturbance.signal("slip.delta_2_rad_s").high == 0.1
    assert found.limiter.limits.yaw_rate_rad_s == 1.0
    assert found.limiter.limits.lateral_acceleration_mm_s2 == 165.0  # of `body`
    assert [one.mass_kg for one in found.robot_models] == [1.245, 1.5]
    assert found.robot_models[1].tyre.mu_static == 0.1
    assert found.robot_models[0].tyre.mu_static == found.robot.tyre.mu_static
    assert found.preview_s == (0.4,)
    assert (found.reward["alive"], found.reward["fine"]) == (1.0, 0.5)


def test_settings_are_checked_together():
    """Each alone would be refused, as the gap must be a multiple of the period."""
    found = scenarios.asked_scenario(
        "infinity",
        {},
        None,
        ["control_period_s=0.03", "time_gap_s=3", "horizon_s=90", "preview_s=[0.3]"],
    )
    assert found.control_period_s == 0.03


def test_a_set_field_leaves_its_source_alone():
    source = {"base": "infinity", "robot": {"tyre": {"mu_static": 0.08}}}
    scenarios.scenario_with(source, {}, None, {"robot.tyre.mu_static": 0.09})
    assert source["robot"] == {"tyre": {"mu_static": 0.08}}


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("time_gap_s", "must be PATH=VALUE"),
        ("=3", "must be PATH=VALUE"),
        ("a..b=3", "'a..b' must be a field"),
        ("time_gp_s=3", "time_gp_s: unknown key; did you mean 'time_gap_s'?"),
        ("time_gap_s.x=3", "time_gap_s.x: time_gap_s is 5.0, which has no parts"),
        ("robots.7.mass_kg=1", "robots.7.mass_kg: robots is 3, which has no parts"),
        ("time_gap_s=yes", "'yes' is ambiguous in YAML"),
        ("time_gap_s=[1", "is not YAML"),
        ("disturbance.slip.delta_1=3", "did you mean 'delta_1_mm_s'?"),
        ("action=twst", "got 'twst'; did you mean 'twist'?"),
        ("estimator=ekf-gyr", "got 'ekf-gyr'; did you mean 'ekf-gyro'?"),
    ],
)
def test_a_wrong_setting_is_refused_in_one_line(setting, named, capsys, monkeypatch):
    assert named in refused(["show", "infinity", "--set", setting], capsys, monkeypatch)


def test_an_entry_that_a_list_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"robots.2.mass_kg: '2' must be a number from 0 to 1"):
        scenarios.asked_scenario("infinity", {}, None, ["robots=[{}, {}]", "robots.2.mass_kg=1"])


@pytest.mark.parametrize("text", ["3", "[1, 2]", "a: b: c"])
def test_a_standard_input_that_is_no_scenario_is_refused(text, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert "standard input" in refused(["show", "-"], capsys, monkeypatch)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["rnu"], "run"),
        (["list", "task"], "tasks"),
        (["run", "infinity_from_rst"], "infinity_from_rest"),
        (["run", "infinity", "--polcy", "x"], "--policy"),
        (["run", "infinity", "--policy", "residul"], "residual"),
        (["run", "infinity", "--policy", "kanayma"], "kanayama"),
        (["run", "infinity", "--policy", "reference:linearized"], "linearised"),
        (["run", "infinity", "--policy", "kanayama:boundd"], "bounded"),
        (["run", "infinity", "--policy", "kanayama+ekf-gyo"], "ekf-gyro"),
        (["run", "infinity", "--policy", "kanayama+ekf-gyro+gripp"], "grip"),
        (["run", "infinity", "--disturbance", "slipp"], "slip"),
        (["run", "infinity", "--plant", "pymnk"], "pymunk"),
        (["bench", "--plan", "controllrs"], "controllers"),
        (["bench", "--tasks", "infinity_from_rst"], "infinity_from_rest"),
        (["bench", "--envelope", "--knobs", "frction"], "friction"),
        (["tune", "kanayma"], "kanayama"),
        (["train", "scrtch"], "scratch"),
    ],
)
def test_a_name_that_is_nearly_right_is_answered_with_the_nearest(
    words, meant, capsys, monkeypatch
):
    line = refused(words, capsys, monkeypatch)
    assert f"'{meant}'" in line or f"options: {meant}" in line


# --- ids of the tasks


def test_every_task_has_an_id_of_both_libraries():
    assert preset_names() == list(tlf_env.TASKS)
    made = gymnasium.make("tlf_env/InfinityFromRest-v0")
    assert made.unwrapped.scenario.name == "infinity_from_rest"
    camel = {name.title().replace("_", "") for name in tlf_env.TASKS}
    assert {f"tlf_env/{name}-v0" for name in camel} <= set(gymnasium.registry)
    if hasattr(pettingzoo, "register"):
        env = pettingzoo.make("parallel", "tlf_env/long_circle-v0")
        assert env.scenario.name == "long_circle"


EXAMPLE_LINES = [line for lines in EXAMPLES.values() for line in lines]


def test_every_command_has_examples():
    assert set(EXAMPLES) == set(typer.main.get_command(cli.app).commands)


@pytest.mark.parametrize("line", EXAMPLE_LINES)
def test_every_example_can_be_called(line):
    for part in line.split("|"):
        words = shlex.split(part.partition(">")[0])
        assert words[0] == "tlf"
        command = typer.main.get_command(cli.app).commands[words[1]]
        command.make_context(words[1], words[2:])


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_the_help_ends_with_the_examples(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["tlf", name, "--help"])
    cli.main()
    end = capsys.readouterr().out.partition("Examples:\n")[2]
    for line, what in EXAMPLES[name].items():
        assert f"  {line}\n" in end
        assert what in end
