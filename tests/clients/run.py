"""Train on the first rung with the libraries of one environment: ``python tests/clients/run.py sb3``.

The rows of the table of ``docs/compatibility.md`` go to ``results/clients/NAME.json``, after each training.
``--resume`` leaves out a training that is there already, with the same version. ``make clients`` calls this
in an environment for each file ``NAME.txt`` of this folder.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
import traceback
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rung import measured

from tlf_env.common.files import atomic


def key(row: dict[str, Any]) -> tuple[str, str, str]:
    """What distinguishes the trainings of a client."""
    return row["algorithm"], row["door"], row["version"]


def main() -> int:
    """Run the trainings and other checks, write what came out, and return 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("client", help="a file of this folder, without .txt")
    parser.add_argument("--out", type=Path, default=Path("results/clients"))
    parser.add_argument("--resume", action="store_true", help="keep what is finished")
    given = parser.parse_args()
    warnings.simplefilter("ignore")  # of the libraries, about each other
    module = importlib.import_module(f"with_{given.client}")
    path = given.out / f"{given.client}.json"
    resumed = given.resume and path.exists()
    earlier = json.loads(path.read_text(encoding="utf-8"))["trainings"] if resumed else []
    kept = {key(row): row for row in earlier}
    made: dict[str, Any] = {"checks": getattr(module, "checks", list)(), "trainings": []}
    failed = sum(bool(row["error"]) for row in made["checks"])
    for kind in module.CLIENTS:
        row = kept.get((kind.algorithm, kind.door, version(kind.package)))
        if row is None or row["steps"] != kind.steps:
            try:
                with tempfile.TemporaryDirectory() as folder:
                    row = measured(kind, Path(folder))
            except Exception:
                traceback.print_exc()
                failed += 1
                continue
        print(json.dumps(row, ensure_ascii=False), flush=True)
        failed += not row["loads"]
        made["trainings"].append(row)
        with atomic(path, "wb") as file:
            file.write((json.dumps(made, indent=1, ensure_ascii=False) + "\n").encode())
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
