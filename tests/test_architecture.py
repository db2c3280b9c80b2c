"""The rooms: what the page on architecture shows, what the sources do, and how far they are apart."""

from __future__ import annotations

import ast
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "figures"))
grimp = pytest.importorskip("grimp")

import make_architecture  # noqa: E402

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
