"""Code that a name stands for (``module:factory``) is imported only with ``--trust`` or ``trust=True``."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml

import tlf_env
from baselines import cli
from baselines.benchmark.envelope import EnvelopePlan
from baselines.benchmark.envelope_runs import plan_record
from baselines.data.episodes import robots_of
from baselines.live.session import Session
from baselines.policies.reference import ReferencePolicy
from baselines.policies.registry import fit_policy, make_policy
from baselines.runs.run import run_policy, run_seeds
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env import load_scenario
from tlf_env.envs.single import FormationEnv
from tlf_env.onboard.parts import PYTHON_ESTIMATORS, load_part

MODULE = """
from pathlib import Path

Path("imported").touch()


def never(*_):
    raise SystemExit("the code was run")
"""
PARTS = ("estimator", "wheel_loop", "observer", "residual_base")
SAYS = r"'nasty:never' runs code of the module 'nasty'; allow that with --trust, in Python with trust=True"
BATCH = {"plant": "batch", "residual_base": "nasty:never"}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A working directory with a module that notes its import, which must not happen."""
    (tmp_path / "nasty.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("nasty", None)
    yield tmp_path
    assert "nasty" not in sys.modules
    assert not (tmp_path / "imported").exists()


def task_file(folder: Path, **fields: Any) -> str:
    path = folder / "own.yaml"
    path.write_text(yaml.safe_dump({"base": "infinity", "horizon_s": 0.2, **fields}))
    return str(path)


def vector(scenario: Any, **fields: Any) -> Any:
    return gymnasium.make_vec(
        "tlf_env/Infinity-v0", vectorization_mode="vector_entry_point", scenario=scenario, **fields
    )


@pytest.mark.parametrize("role", PARTS)
@pytest.mark.parametrize("form", ["file", "mapping", "scenario", "keyword"])
def test_a_part_by_name_needs_permission(role, form, folder):
    named = {role: "nasty:never"}
    source: Any = {
        "file": lambda: task_file(folder, **named),
        "mapping": lambda: {"base": "infinity", **named},
        "scenario": lambda: load_scenario("infinity", **named),
        "keyword": lambda: "infinity",
    }[form]()
    fields = named if form == "keyword" else {}
    for make in (tlf_env.parallel_env, tlf_env.aec_env, FormationEnv):
        with pytest.raises(ValueError, match=f"^{role} {SAYS}$"):
            make(source, **fields)


@pytest.mark.parametrize("form", ["file", "mapping", "scenario"])
def test_a_base_by_name_needs_permission_in_a_batch(form, folder):
    named = {**BATCH, "action": "residual"}
    source: Any = {
        "file": lambda: task_file(folder, **named),
        "mapping": lambda: {"base": "infinity", **named},
        "scenario": lambda: load_scenario("infinity", **named),
    }[form]()
    doors = [lambda s: tlf_env.BatchPlant(s, 1), vector]
    if importlib.util.find_spec("stable_baselines3") is not None:
        from baselines.sb3 import FormationVecEnv

        doors.append(lambda s: FormationVecEnv(s, 1))
    for make in doors:
        with pytest.raises(ValueError, match=f"^residual_base {SAYS}$"):
            make(source)


def test_the_others_by_name_need_permission():
    with pytest.raises(ValueError, match=f"^others {SAYS}$"):
        gymnasium.make("tlf_env/Infinity-v0", others="nasty:never")


def test_a_policy_by_name_needs_permission():
    for make in (make_policy, fit_policy):
        with pytest.raises(ValueError, match=f"^policy {SAYS}$"):
            make("nasty:never", load_scenario("infinity"))


def test_runs_need_permission(folder):
    scenario, policy = load_scenario(task_file(folder, estimator="nasty:never")), ReferencePolicy()
    batch = load_scenario("infinity", **BATCH)
    for run in (
        lambda: run_policy(scenario, policy),
        lambda: list(run_seeds(batch, policy, [0])),
        lambda: robots_of(scenario, policy, 0),
        lambda: Session(scenario),
        lambda: load_part("estimator", "nasty:never", trust=False),
    ):
        with pytest.raises(ValueError, match=SAYS):
            run()


@pytest.mark.parametrize("wrong", [1, "yes", None])
def test_the_permission_is_true_or_false(wrong):
    with pytest.raises(ValueError, match=r"trust .* must be True, False or 'isolated'"):
        tlf_env.parallel_env("infinity", estimator="nasty:never", trust=wrong)


@pytest.mark.parametrize("where", ["trust", "scenario.trust"])
def test_no_file_can_give_the_permission(where, folder):
    with pytest.raises(ValueError, match="unknown key"):
        tlf_env.parallel_env(task_file(folder, trust=True, estimator="nasty:never"))
    with pytest.raises(TypeError, match="trust"):
        load_scenario("infinity", trust=True)
    config = load_config("quick").model_dump(mode="json")
    place = config if where == "trust" else config["scenario"]
    place["trust"] = True
    with pytest.raises(ValueError, match="trust"):
        load_config(config)


def test_a_training_and_a_search_name_no_code(folder):
    config = load_config("quick").model_dump(mode="json")
    config["scenario"] |= {"residual_base": "nasty:never"}
    with pytest.raises(ValueError, match="residual_base 'nasty:never' is code"):
        load_config(config)
    task = task_file(folder, residual_base="nasty:never")
    (folder / "search.yaml").write_text(yaml.safe_dump({"like": "adrc", "tasks": [task]}))
    with pytest.raises(ValueError, match="residual_base 'nasty:never' is code"):
        load_tune("search.yaml")


def test_an_envelope_needs_permission(folder):
    task = task_file(folder, residual_base="nasty:never")
    plan = EnvelopePlan(("reference:linearised",), (task,), ("friction",), (20000, 20010))
    with pytest.raises(ValueError, match=SAYS):
        plan_record(plan)


COMMANDS = {
    "run a policy": "run infinity --policy nasty:never",
    "run a file": "run own.yaml",
    "run a setting": "run infinity --set estimator=nasty:never",
    "run an estimator": "run infinity --estimator nasty:never",
    "run a wheel loop": "run infinity --wheel-loop nasty:never",
    "run an observer": "run infinity --observer nasty:never",
    "view": "view own.yaml",
    "play": "play own.yaml --out drive.csv",
    "bench a policy": "bench --policies nasty:never --tasks infinity --disturbances nominal",
    "bench a file": "bench --policies reference --tasks own.yaml --disturbances nominal",
    "bench a plan": "bench --plan plan.yaml",
    "envelope": "bench --envelope --policies nasty:never --knobs friction",
    "eval": "eval nasty:never",
    "eval against": "eval residual --against nasty:never",
    "export": "export own.yaml --seeds 0:1",
    "export a policy": "export infinity --policy nasty:never --seeds 0:1",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_imports_nothing_without_the_flag(name, folder, monkeypatch, capsys):
    if name.startswith(("view", "play")):
        pytest.importorskip("pygame")
    if "bench" in COMMANDS[name] or "eval" in COMMANDS[name]:
        pytest.importorskip("arch")
    task_file(folder, estimator="nasty:never")
    plan = {"policies": ["nasty:never"], "tasks": ["infinity"], "disturbances": ["nominal"]}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    live = importlib.import_module("baselines.commands.live")
    monkeypatch.setattr(live, "compile_before_first_run", lambda: None)
    monkeypatch.setattr(sys, "argv", ["tlf", *COMMANDS[name].split()])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 2
    assert "allow that with --trust" in " ".join(capsys.readouterr().err.split())
    assert not (folder / "results").exists()


def test_what_only_reads_a_file_imports_nothing(folder, monkeypatch, capsys):
    task_file(folder, estimator="nasty:never")
    monkeypatch.setattr(sys, "argv", ["tlf", "show", "own.yaml"])
    cli.main()
    assert "nasty:never" in capsys.readouterr().out


def test_the_packages_own_estimators_need_no_permission():
    scenario = load_scenario("infinity", horizon_s=0.2)
    fitted = fit_policy("kanayama+ukf+body", scenario)
    assert fitted.scenario.code == {"estimator": PYTHON_ESTIMATORS["ukf"]}
    assert np.isfinite(run_policy(fitted.scenario, fitted.policy)["x_mm"]).all()


def test_a_file_in_the_working_directory_does_not_replace_a_shipped_estimator(folder, monkeypatch):
    """The names of the shipped estimators need no permission, so that they must stand for those alone."""
    hidden = folder / "baselines"
    hidden.mkdir()
    (hidden / "__init__.py").write_text(MODULE)
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one != str(folder)])
    for name in [one for one in sys.modules if one.partition(".")[0] == "baselines"]:
        monkeypatch.delitem(sys.modules, name)
    found = load_part("estimator", PYTHON_ESTIMATORS["ukf"], trust=False)
    assert folder not in Path(sys.modules[found.__module__].__file__ or "").parents
