"""No source reads a file in a way that can run code, but for the kept machine code of the step drivers."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

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
