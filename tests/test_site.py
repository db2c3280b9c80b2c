"""The documentation site: what is generated fits the sources, and nothing is left out."""

from __future__ import annotations

import ast
import importlib
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
from test_english import PATTERNS

from tlf_env.common.presets import preset_names
from tlf_env.disturbances.channels import CHANNELS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
NAV = re.compile(r"^ +- (?:[^:#\n]+: )?(\S+\.md)$", re.MULTILINE)
COMMAND = re.compile(r"^[!%](?:.*\\\n)*.*", re.MULTILINE)  # of a notebook
# Pages that the build makes.
MADE = {"readme.md", "contributing.md", "changelog.md", "tasks/index.md", "presets/index.md"}
MADE |= {"policies/index.md"}


@pytest.fixture
def generator(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> ModuleType:
    """A module of ``docs/generate``."""
    monkeypatch.syspath_prepend(DOCS / "generate")
    module = importlib.import_module(request.param)
    yield module
    for name in ("shared", request.param):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("generator", ["equations"], indirect=True)
def test_the_code_beside_the_equations_is_that_of_the_sources(generator):
    page = generator.PAGE.read_text("utf-8")
    assert len(generator.PIECE.findall(page)) > 15
    assert generator.renewed(page) == page
    with pytest.raises(ValueError, match="has no missing"):
        generator.source("tlf_env.onboard.tracking", "missing")


@pytest.mark.parametrize("generator", ["equations"], indirect=True)
def test_every_equation_of_the_paper_has_its_place(generator):
    page = generator.PIECE.sub("", generator.PAGE.read_text("utf-8"))
    named: set[int] = set()
    for text in re.findall(r"\*\*(\([^*]*)\*\*", page):
        numbers = [int(number) for number in re.findall(r"\((\d+)\)", text)]
        named |= set(range(min(numbers), max(numbers) + 1)) if " to " in text else set(numbers)
    assert named == set(range(1, 55))


@pytest.mark.parametrize("generator", ["preset_pages"], indirect=True)
def test_every_group_of_channels_has_a_family(generator):
    assert {channel.path.split(".")[0] for channel in CHANNELS} == set(generator.FAMILIES)
    assert all(
        (DOCS / "disturbances" / f"{page}.md").exists() for page in generator.FAMILIES.values()
    )


@pytest.mark.parametrize("generator", ["task_pages"], indirect=True)
def test_a_page_of_a_task_has_its_numbers(generator):
    text, picture = generator.page("infinity")
    assert "37.4 m in the horizon" in text
    assert "| speed, mm/s | 559 |" in text
    assert "`tlf_env/Infinity-v0`" in text
    assert picture.startswith(b"\x89PNG")


@pytest.mark.parametrize("generator", ["policy_pages"], indirect=True)
def test_every_policy_has_a_page_and_every_entry_of_the_board_is_on_one(generator):
    pages = generator.pages()
    entries = {one["policy"] for one in generator.policies_of()}
    for entry in entries:
        assert f"`{entry}`" in pages[f"policies/{generator.policy_page(entry)}"]
    controllers = {f"policies/reference-{name}.md" for name in preset_names("controller")}
    assert controllers < set(pages)


@pytest.mark.parametrize("generator", ["source_pages"], indirect=True)
def test_links_out_of_docs_become_links_to_pages_of_the_site(generator):
    wanted = {
        "[a](../Makefile#x)": "[a](files/Makefile.md#x)",
        "[a](../README.md#start)": "[a](readme.md#start)",
        "[a](../configs/flower.yaml)": "[a](tasks/flower.md)",
        "[a](../configs/disturbances)": "[a](presets/index.md)",
        "[a](../configs/laws/lqr/bounded.yaml)": "[a](policies/lqr.md)",
        "[a](notebooks/train.ipynb)": "[a](notebooks/train.md)",
        "`[a](../README.md)`": "`[a](../README.md)`",
        "[a](https://example.org)": "[a](https://example.org)",
        "[a](nowhere.md)": "[a](nowhere.md)",
    }
    for text, one in wanted.items():
        assert generator.rewritten(text, "docs/faq.md", "faq.md") == one
    linked = generator.linked(" ".join(wanted), "docs/faq.md")
    assert [str(path) for path in linked] == ["Makefile"]


@pytest.mark.parametrize("generator", ["check_links"], indirect=True)
def test_links_that_lead_nowhere_are_found(generator, tmp_path):
    (tmp_path / "a.html").write_text(
        '<p id="here"><a href="b.html#there">b</a><a href="#here">a</a><a href="c.html">c</a>'
        '<a href="https://e.org">e</a><script src="https://e.org/x.js"></script>'
    )
    (tmp_path / "b.html").write_text('<p id="their">')
    wrong, abroad = generator.checked(tmp_path)
    assert wrong == [
        "a.html: b.html#there names a place that is not there",
        "a.html: c.html leads nowhere",
        "a.html loads https://e.org/x.js",
    ]
    assert set(abroad) == {"https://e.org", "https://e.org/x.js"}


def test_every_page_is_in_the_navigation_once():
    listed = NAV.findall((ROOT / "mkdocs.yml").read_text("utf-8"))
    assert len(listed) == len(set(listed))
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert set(listed) == pages | MADE


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_plain_and_was_executed(path):
    cells = json.loads(path.read_text("utf-8"))["cells"]
    assert path.stat().st_size < 250_000
    assert cells[0]["cell_type"] == "markdown"
    assert cells[0]["source"][0].startswith("# ")
    for cell in cells:
        text = "".join(cell["source"])
        assert not [pattern for pattern in PATTERNS if re.search(pattern, text, re.IGNORECASE)]
        if cell["cell_type"] == "code":
            ast.parse(COMMAND.sub("pass", text))
            assert cell["execution_count"]
            assert all(one["output_type"] != "error" for one in cell["outputs"])


def test_there_are_three_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["drive_and_look", "train", "write_a_controller"]


def test_parameters_that_share_a_description_get_an_entry_each(monkeypatch):
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(DOCS / "generate")
    separated = importlib.import_module("docstrings").separated
    text = "A law.\n\nParameters\n----------\na, b\n    Gains.\nc\n    More.\n\nRaises\n------\nd, e\n    f."
    wanted = text.replace("a, b\n    Gains.", "a\n    Gains.\nb\n    Gains.")
    assert separated(text) == wanted
    assert separated(wanted) == wanted
