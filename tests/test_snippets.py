"""The Python of the documentation's pages runs: each page in a namespace of its own, block after block."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest

import tlf_env

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)
# Pages whose blocks run elsewhere, and where.
ELSEWHERE = {
    "docs/compatibility.md": "tests/test_clients.py",  # with each library in an environment of its own
    "docs/extending.md": "tests/test_extending.py",
    "docs/scale.md": "tests/test_ray_sb3.py",
}
# Blocks that need what no test has, by page and number: they are only compiled.
COMPILED = {
    ("docs/benchmark.md", 3): "a model that was trained",
    ("docs/benchmark.md", 4): "the file of that model",
    ("docs/learning.md", 0): "a training of 14 minutes",
    ("docs/test-set.md", 0): "results of the test set",
}
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in [*ROOT.glob("docs/**/*.md"), ROOT / "CONTRIBUTING.md"]
    if BLOCK.search(path.read_text(encoding="utf-8"))
)


def blocks(page: str) -> list[tuple[str, str]]:
    return BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))


@pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")
@pytest.mark.parametrize("page", [page for page in PAGES if page not in ELSEWHERE])
def test_every_block_of_a_page_runs(page, tmp_path, monkeypatch):
    """What is printed must be what a block of text below shows, if there is one."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    usual = {"np": np, "gymnasium": gymnasium, "tlf_env": tlf_env}
    module = ModuleType("page")
    vars(module).update(usual)
    monkeypatch.setitem(sys.modules, "page", module)
    monkeypatch.setitem(sys.modules, "my_policies", module)  # as a page names its own classes
    for number, (code, wanted) in enumerate(blocks(page)):
        compiled = compile(code, f"{page}, block {number}", "exec")
        if (page, number) in COMPILED:
            continue
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compiled, vars(module))
        assert not wanted or out.getvalue() == wanted


def test_what_is_not_run_here_exists():
    for page, other in ELSEWHERE.items():
        assert page in PAGES
        assert (ROOT / other).exists()
    for page, number in COMPILED:
        assert number < len(blocks(page))
