"""Folders of runs: one for each, never half of an old run beside a new one, and a page that lists them."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tlf_env.common.files import read_json
from tlf_env.common.presets import preset_names
from tlf_env.task.neutral import scenario_hash
from tlf_env.task.scenario import Scenario

SUMMARY = "summary.json"
INDEX = "index.html"
REPLAY = "replay.html"
WRITTEN = "files"  # entry of a summary: the files of its run
IDENTITY = "identity"  # entry of a summary: what the run depends on
INTERRUPTED = "interrupted"  # entry of a summary: whether the run ended before its horizon
UNFINISHED = ".unfinished-"  # begin of the name of a folder for files that are not complete
# Files that any run may have: left behind by one that was killed before its summary.
FIGURES = ("overview", "paths", "errors", "functionals", "wheels", "slip", "time_gap")
RUN_FILES = (
    *(f"trajectory.{kind}" for kind in ("npz", "csv", "mat", "parquet")),
    *(f"{name}.png" for name in FIGURES),
    REPLAY,
)
NOT_IN_FOLDERS = re.compile(r"[^\w.+-]+")
LONGEST = 60  # characters of a policy's name in a folder's name
HASH = 6  # hexadecimal digits in a folder's name


class Identity(NamedTuple):
    """What a run depends on, beside the code."""

    scenario: str  # its hash
    policy: str
    policy_hash: str | None  # of its files
    seed: int
    options: str  # of the reset, in JSON

    def digits(self) -> str:
        """Some hexadecimal digits over all of it."""
        return hashlib.sha256(json.dumps(self).encode()).hexdigest()[:HASH]


def identity_of(
    scenario: Scenario,
    policy: str,
    policy_hash: str | None,
    seed: int,
    options: Mapping[str, Any] | None,
) -> Identity:
    """The identity of a run."""
    text = json.dumps(dict(options or {}), sort_keys=True)
    return Identity(scenario_hash(scenario), policy, policy_hash, seed, text)


def folder_name(scenario: Scenario, identity: Identity, usual: Identity | None) -> str:
    """``TASK-POLICY-DISTURBANCE-SEED``, and some digits where anything else differs from the usual.

    Parameters
    ----------
    usual
        The identity of the run with the preset's own values; None: there is no such preset.
    """
    policy = NOT_IN_FOLDERS.sub("_", identity.policy.removeprefix("reference:")).strip("_.")
    parts = [scenario.name, policy[-LONGEST:], scenario.disturbance.name, str(identity.seed)]
    if usual is None or identity != usual:
        parts.append(identity.digits())
    return NOT_IN_FOLDERS.sub("_", "-".join(parts))


def is_preset(scenario: Scenario) -> bool:
    """Whether a preset has the scenario's name, and another its disturbance's."""
    return scenario.name in preset_names() and scenario.disturbance.name in preset_names(
        "disturbance"
    )


def check_room(folder: Path, identity: Identity, overwrite: bool) -> bool:
    """Whether a folder holds a whole run; it may only be the same one, or any with ``overwrite``.

    Raises
    ------
    ValueError
        if the folder holds another run, naming what differs.
    """
    if not (folder / SUMMARY).exists():
        return False
    before = _read_summary(folder)
    held = before.get(IDENTITY)
    if not overwrite and held != list(identity):
        raise ValueError(
            f"{folder} holds another run ({_difference(held, identity)}); --overwrite replaces it, --out "
            "names another folder"
        )
    return not before.get(INTERRUPTED, True)


def _read_summary(folder: Path) -> dict[str, Any]:
    """The summary in a folder; nothing if it is damaged or missing."""
    try:
        return dict(read_json(folder / SUMMARY))
    except (ValueError, TypeError):
        return {}


def _same(one: Path, other: Path) -> bool:
    return one.exists() and other.exists() and one.read_bytes() == other.read_bytes()


@contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """A hidden folder for the files of a run, which take the place of those of an earlier run at the end.

    Until then the earlier run stays as it is, also if this one is killed. Files that belong to no run stay
    in any case. The summary comes last: with it the run's folder is complete.
    """
    for left in folder.glob(f"{UNFINISHED}*"):  # of a killed run
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=UNFINISHED) as made:
        yield Path(made)
        names = sorted(path.name for path in Path(made).iterdir())
        written = _read_summary(folder).get(WRITTEN)
        listed = (
            [one for one in written if isinstance(one, str)] if isinstance(written, list) else []
        )
        earlier = {*RUN_FILES, *listed} - {*names, SUMMARY}
        if not _same(Path(made) / SUMMARY, folder / SUMMARY):
            (folder / SUMMARY).unlink(
                missing_ok=True
            )  # so that it never describes files of another run
        for name in earlier:
            if Path(name).name == name:
                (folder / name).unlink(missing_ok=True)
        for name in sorted(names, key=SUMMARY.__eq__):
            (Path(made) / name).replace(folder / name)


def _difference(held: Any, identity: Identity) -> str:
    """What differs between the identity in a folder and another."""
    if not isinstance(held, list) or len(held) != len(identity):
        return "of an older version"
    names = [
        name.replace("_", " ")
        for name, old, new in zip(Identity._fields, held, identity, strict=True)
        if old != new
    ]
    old = Identity(*held)
    return f"{old.policy}, seed {old.seed}; different: {', '.join(names)}"


def verdict(interrupted: bool, robots: Iterable[Mapping[str, Any]]) -> str:
    """How a run ended, in words."""
    robots = list(robots)
    lost = sum(bool(robot["lost"]) for robot in robots)
    touched = sum(bool(robot["touched"]) for robot in robots)
    parts = [f"{lost} lost"] if lost else []
    parts += [f"{touched} touched"] if touched else []
    parts += ["interrupted"] if interrupted else []
    return ", ".join(parts) or "held"
