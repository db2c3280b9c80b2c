"""What is recorded with a result: versions, digests of the code, git revision, and command."""

from __future__ import annotations

import functools
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tlf_env.common.digest import code_digest
from tlf_env.numerics.compiled import PACKAGE
from tlf_env.numerics.compiled import simulation_digest as simulation_digest

REPORTED_PACKAGES = ("tlf-env", "numpy", "numba", "gymnasium", "pettingzoo", "pymunk")
PLACE_OPTIONS = ("--out", "--processes", "--workers", "--ray")
SECRET_OPTIONS = ("--test-seed",)


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


@functools.cache
def physics_digest() -> str:
    """Digest of the code of the physics, without comments and docstrings.

    Results with the same scenario hash and the same physics digest are comparable.
    """
    return code_digest(PACKAGE / room for room in ("physics", "numerics"))


def command_line(words: Sequence[str]) -> str:
    """The ``tlf`` command with the given words, without the options that change no result, and without secrets.

    The former, ``--out``, ``--processes``, ``--workers`` and ``--ray``, set where the command runs; the value
    of ``--test-seed`` is replaced by dots.
    """
    kept = ["tlf"]
    skip = False
    for word in words:
        if skip or word.split("=")[0] in PLACE_OPTIONS:
            skip = not skip and "=" not in word
            continue
        if kept[-1] in SECRET_OPTIONS:
            word = "..."
        elif word.split("=")[0] in SECRET_OPTIONS and "=" in word:
            word = f"{word.split('=')[0]}=..."
        kept.append(word)
    return " ".join(kept)
