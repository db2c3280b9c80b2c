"""What a result is recorded with: versions, the git revision, and the command that made it."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tlf_env.task.scenario import Scenario

REPORTED_PACKAGES = ("tlf-env", "numpy", "numba", "gymnasium", "pettingzoo", "pymunk")
PLACE_OPTIONS = ("--out", "--processes", "--workers", "--ray")


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of those of the packages that are installed."""
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    unknown = dict.fromkeys(REPORTED_PACKAGES, "unknown")
    return {
        "python": platform.python_version(),
        **unknown,
        **installed_versions(REPORTED_PACKAGES),
    }


def _git(*words: str) -> str:
    """Output of a git command in the checkout that holds this file."""
    here = Path(__file__).resolve().parent
    done = subprocess.run(
        ["git", *words], cwd=here, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()


def git_revision() -> str | None:
    """Revision of the source checkout, with ``+`` if tracked files have changes; None without git."""
    try:
        revision = _git("rev-parse", "HEAD")
        changes = _git("status", "--porcelain", "-uno")
    except (OSError, subprocess.SubprocessError):
        return None
    return revision + ("+" if changes else "")


def scenario_hash(scenario: Scenario) -> str:
    """Twelve digits that stand for everything an episode depends on but its seed."""
    return hashlib.sha256(scenario.model_dump_json().encode()).hexdigest()[:12]


def command_line(words: Sequence[str]) -> str:
    """The ``tlf`` command with the given words, without the options that change no result.

    Those are ``--out``, ``--processes``, ``--workers`` and ``--ray``: they say where the command runs.
    """
    kept = ["tlf"]
    skip = False
    for word in words:
        if skip or word.split("=")[0] in PLACE_OPTIONS:
            skip = not skip and "=" not in word
            continue
        kept.append(word)
    return " ".join(kept)
