"""Files of others: no source reads one in a way that can run code, and none names a file that lies elsewhere.

The kept machine code of the step drivers is the exception to the first.
"""

from __future__ import annotations

import ast
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from baselines.benchmark.envelope import load_knob
from baselines.benchmark.plan import read_plan
from baselines.policies.card import read_policy
from baselines.policies.entries import load_entry
from baselines.policies.laws.catalogue import read_law
from baselines.policies.learned import SHIPPED
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env import load_scenario
from tlf_env.onboard.limiters import load_limiter
from tlf_env.task.sources import disturbance_data

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(path for room in ("tlf_env", "baselines") for path in (ROOT / room).rglob("*.py"))
PICKLERS = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
CACHE = "tlf_env/numerics/compiled.py"  # its folder belongs to the user alone
ROWS = "tlf_env/numerics/rows.py"  # makes functions of the names of fields


def calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    """All calls by the dotted name of what is called."""
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


def unsafe(text: str) -> list[str]:
    """What in a source can run code that is read from a file."""
    tree = ast.parse(text)
    found = []
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        found += [name for name in names if name.split(".")[0] in PICKLERS]
    for name, call in calls(tree):
        given = {one.arg: ast.unparse(one.value) for one in call.keywords}
        if name in ("eval", "exec", "torch.load") or name.endswith("yaml.unsafe_load"):
            found.append(name)
        if name.endswith("np.load") and given.get("allow_pickle") != "False":
            found.append("np.load")
        if name == "yaml.load" and "_Loader" not in ast.unparse(call):
            found.append("yaml.load")
        if given.get("shell") == "True":
            found.append("shell")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_source_runs_no_code_of_files(path):
    allowed = {CACHE: {"pickle"}, ROWS: {"exec"}}.get(path.relative_to(ROOT).as_posix(), set())
    assert set(unsafe(path.read_text("utf-8"))) == allowed


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from joblib import load",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "yaml.load(text, yaml.Loader)",
        "torch.load(path)",
        "subprocess.run(command, shell=True)",
        "eval(text)",
    ],
)
def test_what_could_run_code_is_found(text):
    assert unsafe(text)


# A file may name other files of its own folder and of the working directory, and no others.

CIRCLE = {"type": "circle", "radius_mm": 1000.0, "speed_mm_s": 100.0}
ENTRY = {"name": "a", "authors": ["b"], "kind": "code", "command": ["python", "a.py"]}
FIELDS = {
    "base": "base",
    "disturbance": "disturbance",
    "trajectory": "trajectory",
    "world": "world",
    "limiter": "limiter",
    "residual_base": "residual_base",
}
# What reads a file of each kind, and its content, where FILE stands for a file that it names.
READERS: dict[str, tuple[Any, Any]] = {
    **{f"scenario, {key}": (load_scenario, {"trajectory": CIRCLE, key: "FILE"}) for key in FIELDS},
    "disturbance, base": (disturbance_data, {"base": "FILE"}),
    "limiter, base": (load_limiter, {"base": "FILE"}),
    "plan, tasks": (lambda path: read_plan(str(path), {"tasks"}), {"tasks": ["infinity", "FILE"]}),
    "plan, disturbances": (
        lambda path: read_plan(str(path), {"disturbances"}),
        {"disturbances": "nominal, FILE"},
    ),
    "plan, policies": (
        lambda path: read_plan(str(path), {"policies"}),
        {"policies": ["adrc:FILE+ekf-gyro-smoothed+grip"]},
    ),
    "training, disturbances": (load_config, {"disturbances": {"FILE@1.5": 1.0}}),
    "training, data": (load_config, {"offline": {"data": ["FILE"]}}),
    "training, base": (load_config, {"tasks": {"own": {"base": "FILE"}}}),
    "search, like": (load_tune, {"like": "FILE"}),
    "search, start": (load_tune, {"start": "FILE"}),
    "knob, disturbance": (load_knob, {"disturbance": "FILE"}),
    "law": (lambda path: read_law("adrc", str(path)), {"found": {"like": "FILE"}}),
    "entry": (
        lambda path: load_entry(path.parent),
        {**ENTRY, "scenario": {"residual_base": "FILE"}},
    ),
}


def with_file(content: Any, name: str) -> Any:
    return yaml.safe_load(yaml.safe_dump(content).replace("FILE", name))


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """The folder of a file, in which we are not, and a file beside both folders."""
    for name in ("files", "work"):
        (tmp_path / name).mkdir()
    (tmp_path / "secret.yaml").write_text(yaml.safe_dump({"trajectory": CIRCLE}))
    (tmp_path / "files" / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "files"


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("name", ["../secret.yaml", "absolute", "a/../../secret.yaml", "link.yaml"])
def test_a_file_does_not_read_a_file_elsewhere(kind, name, folders):
    read, content = READERS[kind]
    named = str(folders.parent / "secret.yaml") if name == "absolute" else name
    path = folders / ("entry.yaml" if kind == "entry" else "own.yaml")
    path.write_text(yaml.safe_dump(with_file(content, named)))
    with pytest.raises(
        ValueError, match="lies neither in its folder nor in the working directory"
    ) as said:
        read(path)
    assert "secret.yaml" in str(said.value) or "link.yaml" in str(said.value)
    assert str(said.value).startswith(str(path))


@pytest.mark.parametrize("name", ["../secret.yaml", "/etc/secret.yaml"])
def test_a_card_does_not_name_a_base_elsewhere(name, folders):
    for end in (".safetensors", ".json"):
        shutil.copy(SHIPPED / f"residual{end}", folders / f"own{end}")
    card = json.loads((folders / "own.json").read_text())
    (folders / "own.json").write_text(json.dumps({**card, "residual_base": name}))
    with pytest.raises(ValueError, match="lies neither in its folder nor in the working directory"):
        read_policy(folders / "own.safetensors")


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd"])
def test_the_suffix_of_a_path_does_not_matter_where_a_file_must_be(name, folders):
    for content, read in (
        ({"trajectory": {"type": "waypoints", "file": name}}, load_scenario),
        ({"imitation": {"data": name}}, load_config),
    ):
        (folders / "own.yaml").write_text(yaml.safe_dump(content))
        with pytest.raises(ValueError, match=f"names {name}, which lies neither"):
            read(folders / "own.yaml")


def test_what_lies_beside_a_file_or_where_we_work_is_read(folders):
    (folders / "path.yaml").write_text(yaml.safe_dump({"trajectory": CIRCLE}))
    (folders.parent / "work" / "other.yaml").write_text("level: 1.0")
    for trajectory in ("path.yaml", "./path.yaml", str(folders / "path.yaml")):
        (folders / "own.yaml").write_text(
            yaml.safe_dump({"trajectory": trajectory, "disturbance": "other.yaml"})
        )
        assert load_scenario(folders / "own.yaml").trajectory.type == "circle"


def test_a_caller_may_name_any_file(folders):
    """Only files are bound to their folder: a mapping, a keyword and the command line are the user's."""
    mapping = {"base": "../secret.yaml"}
    assert load_scenario(mapping).trajectory.type == "circle"
    assert load_scenario("infinity", trajectory="../secret.yaml").trajectory.type == "circle"
