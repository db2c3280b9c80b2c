"""What ``pyproject.toml`` asks for and what ``constraints.txt`` fixes."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
EVERYTHING = [Requirement(line) for line in sum(EXTRAS.values(), PROJECT["dependencies"])]
OURS = [one for one in EVERYTHING if one.name == PROJECT["name"]]  # extras made of other extras
REQUIREMENTS = [one for one in EVERYTHING if one not in OURS]
PINS = {
    canonicalize_name(name): version
    for name, version in re.findall(
        r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE
    )
}


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_every_requirement_is_fixed_at_a_version_within_its_bound(requirement: Requirement) -> None:
    assert PINS[canonicalize_name(requirement.name)] in requirement.specifier


def test_the_workflow_runs_every_check() -> None:
    """The jobs of a public forge: each target for tests in the Makefile, and each file of clients."""
    jobs = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))[
        "jobs"
    ]
    run = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    targets = {command.split()[1] for command in run if command.startswith("make ")}
    campaign = jobs["reliability"]["strategy"]["matrix"]["check"]
    targets = {*targets, *campaign} - {"${{"}
    assert targets == {
        "test",
        "test-learning",
        "check-docs",
        "check-install",
        "check-lowest",
        "clients",
        "check-pages",
        "check-live",
        "check-paper",
        "check-audit",
        "check-fuzz",
        "check-stress",
        "check-faults",
        "check-endurance",
        "check-mutants",
    }
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    clients = sorted(path.stem for path in (ROOT / "tests" / "clients").glob("*.txt"))
    assert jobs["clients"]["strategy"]["matrix"]["client"] == clients


def test_the_extra_all_has_everything_but_torch() -> None:
    (everything,) = (one for one in OURS if "train" not in one.extras)
    with_torch = {"train", "benchmarl", "peers"}  # these install it
    others = {"dev", "docs", "browser", "peers-jax", "ray", "all", "all-train"}
    assert everything.extras == set(EXTRAS) - with_torch - others
    (with_training,) = (one for one in OURS if "train" in one.extras)
    assert with_training.extras == {"all", "train"}


def test_the_extra_view_makes_videos_too() -> None:
    names = {Requirement(line).name for line in EXTRAS["view"]}
    assert {"moviepy", "pygame-ce"} <= names


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("target", ["clients", "check-clients"])
@pytest.mark.parametrize("named", ["", "ray", "skrl ray"])
def test_the_check_of_clients_runs_those_that_are_named_or_each_of_them(target, named):
    done = subprocess.run(
        ["make", "-n", target, f"CLIENTS={named}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    clients = sorted(path.stem for path in (ROOT / "tests" / "clients").glob("*.txt"))
    assert len(clients) > 3
    (command,) = [line for line in done.stdout.splitlines() if "each.py" in line]
    script, *words = command.split()[1:]
    assert script == "tests/clients/each.py"
    assert words[2:] == named.split()  # after --torch and its version
    scripts = sorted(path.stem for path in (ROOT / "tests" / "clients").glob("with_*.py"))
    assert scripts == [f"with_{client}" for client in clients]
