"""What the long harnesses share: a result file that is always whole, and where the results go."""

from __future__ import annotations

import json
import platform
import time
from pathlib import Path
from typing import Any

from baselines.runs.provenance import git_revision, simulation_digest, versions
from tlf_env.common.files import atomic

RESULTS = Path("results/campaign")


class Outcome:
    """Cases counted by kind, and the defects found; written after every case."""

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path, self._began = path, time.monotonic()
        self.cases: dict[str, int] = {}
        self.defects: list[str] = []
        self.figures: dict[str, Any] = {}
        self._settings = settings

    def case(self, kind: str, wrong: list[str], count: int = 1) -> None:
        """Count a case, and keep what was wrong in it."""
        self.cases[kind] = self.cases.get(kind, 0) + count
        self.defects += [f"{kind}: {one}" for one in wrong]
        self.write()

    def write(self) -> None:
        """Write the JSON file."""
        with atomic(self.path, encoding="utf-8") as file:
            json.dump(
                {
                    "cases": self.cases,
                    "defects": self.defects,
                    "figures": self.figures,
                    "settings": self._settings,
                    "wall_s": round(time.monotonic() - self._began, 1),
                    "versions": versions(),
                    "python": platform.python_version(),
                    "simulation": simulation_digest(),
                    "git_revision": git_revision(),
                },
                file,
                indent=1,
            )
            file.write("\n")

    def report(self) -> int:
        """Print the counts and the defects; the exit status."""
        self.write()
        for kind, count in self.cases.items():
            print(f"{kind}: {count} cases")
        for name, value in self.figures.items():
            print(f"{name}: {value}")
        print(f"{len(self.defects)} defects")
        for one in self.defects:
            print(f"  {one}")
        print(f"In {self.path}")
        return int(bool(self.defects))
