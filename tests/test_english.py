"""The texts are plain: words and turns that make a reader stumble do not come back.

`codespell` in `make check` looks after the spelling. This looks after the style of pages, docstrings, comments
and messages. Each line below is a pattern and what to write instead.
"""

from __future__ import annotations

import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PATTERNS = {
    r"\btold\b": "reported, given, described",
    r"\bnobody\b|\bno one\b": "no robot, no policy",
    r"\beverybody\b|\beveryone\b": "all robots, all policies",
    r"\bsomebody\b|\bsomeone\b": "a user, another program",
    r"\bwhoever\b": "a robot that, a program that",
    r"\bparted by\b": "separated by",
    r"\bwho (stands|is lost|touches|holds|wins|fails|asks|acts|starts)\b": "a robot that ...",
    r"\bwhat is given stands\b": "command-line options take precedence",
    r"\bas it stands\b": "at present, unchanged",
    r"\b(filter|EKF|estimator|law|network|policy) (hears|doubts|believes|trusts|knows|thinks)\b": (
        "covariance, innovation test, receives, estimates"
    ),
    r"\beats\b": "consumes, reduces",
    r"\bhereof\b|\bthereof\b|\bwherein\b|\blest\b|\bhence\b": "a plain word",
    r"\bstudy\b(?! in| of Optuna|\.db)(?=[^\n]{0,40}\b(found|said|measured)\b)": "the command that shows it",
}
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCES = sorted(
    path
    for folder in ("tlf_env", "baselines", "examples", "docs/figures", "docs/generate", "tests")
    for path in (ROOT / folder).rglob("*.py")
    if path != Path(__file__).resolve()  # which quotes what it looks for
)
YAMLS = sorted((ROOT / "configs").rglob("*.yaml"))


def texts(path: Path) -> list[tuple[int, str]]:
    """The lines that a person reads: of a page all, of a source its comments and strings."""
    content = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return list(enumerate(content.splitlines(), start=1))
    kinds = (tokenize.COMMENT, tokenize.STRING)
    tokens = tokenize.generate_tokens(io.StringIO(content).readline)
    return [
        (token.start[0] + i, line)
        for token in tokens
        if token.type in kinds or tokenize.tok_name[token.type] == "FSTRING_MIDDLE"
        for i, line in enumerate(token.string.splitlines())
    ]


@pytest.mark.parametrize(
    "path", [*PAGES, *SOURCES, *YAMLS], ids=lambda path: str(path.relative_to(ROOT))
)
def test_the_text_is_plain(path):
    found = [
        f"{path.relative_to(ROOT)}:{number}: {at[0]!r}; write: {instead}"
        for number, line in texts(path)
        for pattern, instead in PATTERNS.items()
        if (at := re.search(pattern, line, re.IGNORECASE))
    ]
    assert not found, "\n".join(found)


def test_the_patterns_find_what_they_are_for():
    for phrase in (
        "names parted by commas",
        "A robot is told its reference.",
        "nobody fails",
        "a robot who stands still",
        "the filter doubts the fix",
    ):
        assert any(re.search(pattern, phrase, re.IGNORECASE) for pattern in PATTERNS), phrase
