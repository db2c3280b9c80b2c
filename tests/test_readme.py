"""What the README shows: its Python runs and prints what stands below it, and its commands exist."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest
import typer

from baselines import cli

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", README, re.DOTALL)
COMMANDS = sorted(
    {
        line.partition("#")[0].strip()
        for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
        for line in block.splitlines()
        if line.startswith("tlf ")
    }
    | set(re.findall(r"`(tlf [^`]+)`", README))
)


@pytest.mark.parametrize(("code", "wanted"), SNIPPETS, ids=range(len(SNIPPETS)))
def test_every_snippet_prints_what_the_page_shows(code, wanted):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code, "README.md", "exec"), {})
    assert out.getvalue() == wanted


def test_the_page_has_its_snippets_and_commands():
    assert len(SNIPPETS) == 3
    assert len(COMMANDS) > 10


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_and_option_exists(line):
    for command in line.split(";"):
        words = [word for word in shlex.split(command.partition(">")[0]) if word != "..."]
        if len(words) < 2 or words[1].startswith("-"):
            continue
        known = typer.main.get_command(cli.app).commands
        assert words[1] in known, command
        options = {name for one in known[words[1]].params for name in one.opts}
        assert {word for word in words[2:] if word.startswith("--")} <= options | {"--help"}
