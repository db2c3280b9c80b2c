"""What the command line prints: on every terminal, with brackets as they are, without stray warnings."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from baselines import cli, console
from baselines.runs.jobs import first_difference
from tlf_env.common.errors import install_command

ROOT = Path(__file__).parent.parent
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
    "optional-dependencies"
]
ENCODINGS = ("latin-1", "ascii", "cp437", "cp1252", "koi8-r", "utf-8")


def tlf(words: list[str], encoding: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "baselines", *words],
        env={**os.environ, "PYTHONIOENCODING": encoding, "COLUMNS": "160"},
        capture_output=True,
        check=False,
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_run_prints_its_table_in_every_encoding(encoding, tmp_path):
    words = ["run", "circle", "--horizon-s", "6", "--no-figures", "--out", str(tmp_path / "Größe")]
    done = tlf(words, encoding)
    assert done.returncode == 0, done.stderr
    table = done.stdout.decode(encoding)
    assert re.search(r"robot\W+mm\W+mm", table)
    assert len(re.findall(r"^\W*[01]\W.*held\W*$", table, re.MULTILINE)) == 2
    assert len(re.findall(r"^\W*2\W.*waits\W*$", table, re.MULTILINE)) == 1  # until 10 s
    assert "trajectory.csv" in table
    assert ("–" if encoding in ("utf-8", "cp1252") else "-") in table
    assert "Traceback" not in done.stderr.decode(encoding)


@pytest.mark.parametrize("encoding", ["ascii", "cp437"])
@pytest.mark.parametrize(
    "words",
    [["run", "größe"], ["run", "infinity", "--disturbance", "路径"], ["bench", "--tasks", "∞"]],
)
def test_an_error_is_one_line_and_status_2_in_every_encoding(encoding, words):
    done = tlf(words, encoding)
    assert done.returncode == cli.BAD_INPUT
    lines = done.stderr.decode(encoding).splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("tlf: ")


@pytest.mark.parametrize(
    "command", ["run", "openloop", "speed", "bench", "train", "tune", "compile"]
)
def test_every_help_is_printed_in_ascii(command):
    done = tlf([command, "--help"], "ascii")
    assert done.returncode == 0, done.stderr
    assert b"Usage" in done.stdout


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("text", [*console.PLAIN, "é", "ü", "₁", "²", "½", "路", "🤖", "Ω", "σ"])
def test_every_character_can_be_printed(text, encoding):
    printed = f"a{text}z".encode(encoding, "tlf.plain").decode(encoding)
    assert re.fullmatch(r"a\S.*z", printed)
    assert f"a{text}z".encode("utf-8", "tlf.plain").decode() == f"a{text}z"


def test_streams_that_are_no_files_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    console.print_on_any_terminal()


# Markup


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_extra_of_every_hint_is_printed(extra, capsys):
    hint = f"pip install 'tlf-env[{extra}]'"
    console.notes.print(hint, soft_wrap=True)
    console.screen.print(hint, soft_wrap=True)
    printed = capsys.readouterr()
    assert hint in printed.err
    assert hint in printed.out
    with pytest.raises(SystemExit):
        cli.fail(hint, 2)
    assert hint in capsys.readouterr().err


def test_the_command_of_a_hint_is_of_this_installation(monkeypatch, tmp_path):
    """Of its Python, as another pip would install into another place."""
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    assert install_command("data") == "python -m pip install 'tlf-env[data]'"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert install_command("data") == f"{sys.executable} -m pip install 'tlf-env[data]'"


def test_a_missing_matplotlib_names_its_extra(capsys):
    console.warn_of_missing(ModuleNotFoundError(name="matplotlib"))
    assert "pip install 'tlf-env[figures]'" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[red]a[/red]", "[/]", ":smile:", "[link=x]a", "a[0]"])
def test_names_are_printed_as_they_are(text, capsys):
    from rich.table import Table

    table = Table()
    table.add_column(text)
    table.add_row(text)
    console.screen.print(table)
    assert capsys.readouterr().out.count(text) == 2
    with console.progress_bar(text) as update:
        update(1, 2)


@pytest.mark.parametrize("file", sorted((ROOT / "baselines").rglob("*.py")), ids=lambda f: f.name)
def test_every_hint_names_an_extra_that_there_is(file):
    for extra in re.findall(r"tlf-env\[(\w+)\]", file.read_text("utf-8")):
        assert extra in EXTRAS


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["bench", "--plan", "my plan.yaml"],
            "the same command goes on: tlf bench --plan 'my plan.yaml'",
        ),
        (["train", "quick"], "the same command goes on: tlf train quick"),
        (["compile"], "interrupted"),
        ([], "interrupted"),
    ],
)
def test_an_interruption_names_the_command_that_goes_on(words, said, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "app", interrupt)
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == cli.INTERRUPTED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(said)


@pytest.mark.parametrize(
    ("there", "now", "wanted"),
    [
        ({"a": 1}, {"a": 2}, ("plan.a", 1, 2)),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, ("plan.a.b.1", 2, 3)),
        ({"a": [1]}, {"a": [1, 2]}, ("plan.a", [1], [1, 2])),
        ({"a": 1, "b": 2}, {"a": 1}, ("plan.b", 2, None)),
        (None, {"a": 1}, ("plan", None, {"a": 1})),
    ],
)
def test_the_first_difference_is_named_with_both_values(there, now, wanted):
    assert first_difference(there, now, "plan") == wanted
