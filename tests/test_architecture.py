"""The rooms: what the page on architecture shows, what the sources do, and how far they are apart."""

from __future__ import annotations

import ast
import importlib
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "figures"))
grimp = pytest.importorskip("grimp")

make_architecture = importlib.import_module("make_architecture")  # a script, in no package

CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
    "importlinter"
]
LONGEST_CHAIN = 9  # levels of imports inside the engine; it had 14


@pytest.fixture(scope="module")
def graph():
    return grimp.build_graph("tlf_env", "baselines", exclude_type_checking_imports=True)


def test_the_page_is_made_from_the_sources():
    text = make_architecture.PAGE.read_text(encoding="utf-8")
    assert make_architecture.page(text) == text


def test_the_page_and_the_contract_have_the_same_rooms():
    rooms = next(one for one in CONTRACTS["contracts"] if one["name"].startswith("Rooms"))
    assert tuple(rooms["layers"]) == make_architecture.ROOMS


def test_every_folder_with_sources_is_a_room(graph):
    for module in graph.modules:
        if module not in ("tlf_env", "baselines"):
            assert make_architecture.room_of(module), module
    wings = {path.parent.name for path in (ROOT / "baselines").glob("*/__init__.py")}
    assert wings == set(make_architecture.WINGS)


def test_no_room_imports_from_a_higher_one(graph):
    """The contract again, without the tool: a chain counts only where an import is written."""
    order = {room: i for i, room in enumerate(make_architecture.ROOMS)}
    for importer in graph.modules:
        for imported in graph.find_modules_directly_imported_by(importer):
            upper, lower = map(make_architecture.room_of, (importer, imported))
            if upper and lower:
                assert order[upper] <= order[lower], (importer, imported)


def test_the_engine_has_few_levels_and_no_cycle(graph):
    assert len(make_architecture.levels(graph, "tlf_env.engine")) <= LONGEST_CHAIN


def test_an_import_inside_a_function_counts_too():
    """Late imports keep heavy packages out; they must not hide an upward import."""
    for path in (ROOT / "tlf_env").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith("baselines"), path
            if isinstance(node, ast.Import):
                assert not any(name.name.startswith("baselines") for name in node.names), path


MOST_BY_PLACE = 6  # fields of a named tuple that may be given by place


def long_tuples() -> dict[str, int]:
    """Named tuples of the sources with more fields than may be given by place."""
    found = {}
    for folder in ("tlf_env", "baselines"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                bases = getattr(node, "bases", [])
                if any(isinstance(base, ast.Name) and base.id == "NamedTuple" for base in bases):
                    fields = sum(isinstance(item, ast.AnnAssign) for item in node.body)
                    if fields > MOST_BY_PLACE:
                        found[node.name] = fields
    return found


def test_long_named_tuples_are_made_by_keyword():
    tuples = long_tuples()
    assert {"Body", "Motion", "Contact", "Estimate", "SlipEstimate", "Tracking", "Info"} <= set(
        tuples
    )
    for folder in ("tlf_env", "baselines"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                    plain = [one for one in node.args if not isinstance(one, ast.Starred)]
                    if node.func.id in tuples:
                        assert not plain, f"{path}:{node.lineno}: {node.func.id} by place"
