"""Test and train with client libraries, each in an environment of its own: ``make clients``.

An environment is made for each file ``NAME.txt`` of this folder, and deleted when its tests
(``tests/test_clients.py``) and its trainings (``run.py``) are over. A failure does not keep the next libraries
from their turn; what failed is listed at the end. Environments are installed by uv, which links files to one
cache: pip would unpack torch anew for each.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
NAMES = sorted(path.stem for path in HERE.glob("*.txt"))
PARTS = ("install", "tests", "trainings")
# The extra of pyproject.toml that has a client's library, and so its lowest version; and what else it needs.
EXTRAS = {"benchmarl": ["benchmarl"], "ray": ["ray", "ray[rllib]"], "sb3": ["train"]}


def tool(folder: Path) -> Path:
    """An installed uv. pip cannot link files, and uv does not read pip's setting of folders of wheels."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    subprocess.run(
        [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", "uv"], check=True
    )
    return folder / "bin" / "uv"


def commands(
    uv: Path, folder: Path, client: str, torch: str, more: list[str], lowest: bool = False
) -> dict[str, list[list[str | Path]]]:
    """The commands of each part, for an environment in a folder.

    ``lowest``: with the lowest versions that pyproject.toml allows, of what it names.
    """
    python = folder / "bin" / "python"
    install: list[str | Path] = [uv, "pip", "install", "-q", "--python", python]
    wanted: list[str | Path] = ["-e", ROOT, "-r", HERE / f"{client}.txt"]
    if lowest:
        extra, *others = EXTRAS[client]
        wanted = ["--resolution", "lowest-direct", "-e", f"{ROOT}[{extra}]", *others]
        more = [*more, "--out", "results/clients-lowest"]
    return {
        "install": [
            [uv, "venv", "-q", "--python", sys.executable, folder],
            # First, so that a build of this version in a folder of wheels is taken.
            [*install, f"torch=={torch}"],
            [*install, *wanted, f"torch=={torch}", "pytest>=9.0"],
        ],
        "tests": [[python, "-m", "pytest", "-q", "-rs", ROOT / "tests" / "test_clients.py"]],
        "trainings": [[python, HERE / "run.py", client, *more]],
    }


def failed_part(parts: dict[str, list[list[str | Path]]], client: str) -> str:
    """The parts that failed, with commas; without an installation nothing else is tried."""
    environment = os.environ | {
        "CLIENT": client,
        "OMP_NUM_THREADS": "1",
        "RAY_ADDRESS": "local",  # not a cluster that other processes have started
        "SDL_VIDEODRIVER": "dummy",
        "UV_FIND_LINKS": os.environ.get("PIP_FIND_LINKS", ""),
    }
    failed = []
    for part in PARTS:
        runs = (
            subprocess.run(command, env=environment, check=False, cwd=ROOT).returncode
            for command in parts[part]
        )
        if any(runs):
            failed.append(part)
            if part == "install":
                break
    return ", ".join(failed)


def turns(clients: Iterable[str], torch: str, more: list[str], lowest: bool) -> dict[str, str]:
    """The parts that failed, of each client: empty where all is well."""
    outcomes = {}
    with tempfile.TemporaryDirectory(prefix="tlf-clients-") as kept:
        uv = tool(Path(kept) / "tools")
        for client in clients:
            print(f"== {client}", flush=True)
            begun_s = time.monotonic()
            with tempfile.TemporaryDirectory(dir=kept) as folder:
                parts = commands(uv, Path(folder) / "venv", client, torch, more, lowest)
                outcomes[client] = failed_part(parts, client)
            spent_s = time.monotonic() - begun_s
            print(f"== {client}: {outcomes[client] or 'passed'}, {spent_s:.0f} s", flush=True)
    return outcomes


def main() -> int:
    """Take all clients in turn, and return 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clients", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--torch", default="2.13.0", help="version of torch")
    parser.add_argument("--resume", action="store_true", help="keep trainings that are finished")
    parser.add_argument(
        "--lowest",
        action="store_true",
        help="with the lowest versions that pyproject.toml allows, of the clients that it names: "
        f"{', '.join(EXTRAS)}",
    )
    given = parser.parse_args()
    known = list(EXTRAS) if given.lowest else NAMES
    unknown = sorted(set(given.clients) - set(known))
    if unknown:
        parser.error(f"{', '.join(unknown)}: not one of {', '.join(known)}")
    # A stop deletes the environment, as Ctrl-C does.
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        more = ["--resume"] if given.resume else []
        outcomes = turns(given.clients or known, given.torch, more, given.lowest)
    finally:
        signal.signal(signal.SIGTERM, before)
    failed = {client: parts for client, parts in outcomes.items() if parts}
    for client, parts in failed.items():
        print(f"{client} failed: {parts}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
