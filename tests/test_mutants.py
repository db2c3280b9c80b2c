"""The mutants of tests/campaign: small changes of a source, one at a time, which a test should notice."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from campaign import mutation

ROOT = Path(__file__).parent.parent
LAWS = frozenset({"law"})
SOURCE = '''
"""A module."""
from x import law

FIRST: int = 3
__all__ = ["f"]


@law
def f(a: float, n: int = 2) -> float:
    """Of 1 and 2."""
    if a < 0.0 and n != 4:
        raise ValueError(f"a is {a - 1}")
    return max(a * 2.0, -a)


class C:
    def g(self, x: int | None) -> float | None:
        self.x = x
        return None if isinstance(x, int | float) else abs(f(x))
'''


@pytest.fixture
def module(tmp_path):
    (tmp_path / "module.py").write_text(SOURCE, encoding="utf-8")
    return tmp_path


def test_every_kind_of_change_is_made_where_it_belongs(module):
    found = mutation.mutants_of(module, "module.py", LAWS)
    changes = {(one.function, one.before, one.after) for one in found}
    assert len(changes) == len(found)
    assert changes == {
        ("", "3", "4"),
        ("f", "2", "3"),
        ("f", "if a < 0.0 and n != 4:", "if not (a < 0.0 and n != 4):"),
        ("f", "a < 0.0 and n != 4", "a < 0.0 or n != 4"),
        ("f", "a < 0.0", "a <= 0.0"),
        ("f", "a < 0.0", "a >= 0.0"),
        ("f", "0.0", "1.0"),
        ("f", "n != 4", "n == 4"),
        ("f", "4", "5"),
        ("f", "raise ValueError(f'a is {a - 1}')", "pass"),
        ("f", "max(a * 2.0, -a)", "min(a * 2.0, -a)"),
        ("f", "a * 2.0", "a / 2.0"),
        ("f", "2.0", "2.2"),
        ("f", "-a", "a"),
        ("C.g", "self.x = x", "pass"),
        (
            "C.g",
            "None if isinstance(x, int | float) else abs(f(x))",
            "abs(f(x)) if isinstance(x, int | float) else None",
        ),
        ("C.g", "abs(f(x))", "f(x)"),
    }
    assert {one.function for one in found if one.compiled} == {"", "f"}


def test_a_changed_source_differs_in_its_one_place_only(module):
    lines = ast.unparse(ast.parse(SOURCE)).splitlines()
    found = mutation.mutants_of(module, "module.py", LAWS)
    for one in found:
        changed = mutation.source_of(module, one, LAWS).splitlines()
        assert len(changed) == len(lines)
        assert sum(a != b for a, b in zip(lines, changed, strict=True)) == 1
    assert len({mutation.source_of(module, one, LAWS) for one in found}) == len(found)


def test_a_sample_is_drawn_in_proportion_to_the_lines_and_by_its_seed(module):
    pool = mutation.mutants_of(module, "module.py", LAWS)
    pools = {name: [one._replace(file=name) for one in pool] for name in "abc"}
    lines = {"a": 100, "b": 50, "c": 10}
    drawn = mutation.sample(pools, lines, 16, 1)
    assert Counter(one.file for one in drawn) == {"a": 10, "b": 5, "c": 1}
    assert len(set(drawn)) == 16
    assert mutation.sample(pools, lines, 16, 1) == drawn
    assert mutation.sample(pools, lines, 16, 2) != drawn


def test_the_tests_of_friction_notice_changes_of_its_law(tmp_path):
    command = [
        sys.executable,
        "tests/campaign/mutants.py",
        "--only",
        "physics/friction.py",
        "--sample",
        "5",
    ]
    out = tmp_path / "results.json"
    paths = ["--out", str(out), "--copy", str(tmp_path / "copy")]
    before = {one: one.read_bytes() for one in (ROOT / "tlf_env" / "physics").glob("*.py")}
    done = subprocess.run(
        # The second file imports the policies, so all of the package has to do without Numba.
        [*command, *paths, "--tests", "friction", "wheel_loop"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(out.read_text(encoding="utf-8"))["mutants"]
    assert len(results) == 5
    killed = [one for one in results if one["outcome"] == "killed"]
    assert len(killed) >= 4
    assert all(one["test"].startswith("tests/test_friction.py::") for one in killed)
    assert "physics: 5 mutants" in done.stdout
    assert before == {one: one.read_bytes() for one in before}
