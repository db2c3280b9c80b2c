"""Train on the first rung with the libraries of one environment: ``python tests/clients/run.py sb3``.

The rows of the table of ``docs/compatibility.md`` go to ``results/clients/NAME.json``, after each training.
``make clients`` calls this in an environment for each file ``NAME.txt`` of this folder.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

from rung import measured

from tlf_env.common.files import atomic


def main() -> int:
    """Run the trainings, write what came out, and return 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("client", help="a file of this folder, without .txt")
    parser.add_argument("--out", type=Path, default=Path("results/clients"))
    parser.add_argument("--only", default="", help="an algorithm")
    given = parser.parse_args()
    warnings.simplefilter("ignore")  # of the libraries, about each other
    clients = importlib.import_module(f"with_{given.client}").CLIENTS
    given.out.mkdir(parents=True, exist_ok=True)
    rows, failed = [], 0
    for kind in clients:
        if given.only and given.only != kind.algorithm:
            continue
        try:
            with tempfile.TemporaryDirectory() as folder:
                row = measured(kind, Path(folder))
        except Exception:
            traceback.print_exc()
            failed += 1
            continue
        print(json.dumps(row), flush=True)
        failed += not row["loads"]
        rows.append(row)
        with atomic(given.out / f"{given.client}.json", "wb") as file:
            file.write((json.dumps(rows, indent=1, ensure_ascii=False) + "\n").encode())
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
