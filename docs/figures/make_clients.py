"""Write the tables of ``docs/compatibility.md`` from runs of client libraries.

``make clients`` trains with every library and writes ``results/clients/NAME.json``. ``python
docs/figures/make_clients.py`` keeps what is found there in ``docs/compatibility.json``, by the name of the
environment; what is not found stays as it was, also a training that an interrupted run did not reach. The
tables are made from that file alone.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from make_board import DOCS, write_text
from make_parts import put
from make_speed import table

PAGE, KEPT = DOCS / "compatibility.md", DOCS / "compatibility.json"
RUNS = Path("results/clients")
ORDER = (
    "sb3",
    "sbx",
    "zoo",
    "farama",
    "skrl",
    "torchrl",
    "benchmarl",
    "tianshou",
    "agilerl",
    "ray",
)


Runs = dict[str, list[dict[str, Any]]]  # the checks and the trainings of a client
Result = dict[str, Runs]


def newest(kept: Runs, found: Runs) -> Runs:
    """What a client has kept, with what was found in place of the same training, or of all earlier checks."""
    rows = {
        (row["algorithm"], row["door"]): row
        for runs in (kept, found)
        for row in runs.get("trainings", [])
    }
    return {"checks": found["checks"], "trainings": list(rows.values())}


def merged(kept: Result, folder: Path) -> Result:
    """The kept runs, those of a folder in place of the earlier ones, in the order of the page."""
    found = {
        path.stem: json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")
    }
    unknown = sorted((set(kept) | set(found)) - set(ORDER))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: not in the order of the page, {', '.join(ORDER)}")
    everything = kept | {name: newest(kept.get(name, {}), runs) for name, runs in found.items()}
    return {name: everything[name] for name in ORDER if name in everything}


def mean(values: list[float]) -> str:
    """A mean return, as a whole number."""
    return f"{sum(values) / len(values):.0f}"


def trainings(result: Result) -> str:
    """A row for each training, and one for each environment without any."""
    head = ["library", "version", "algorithm", "by", "steps", "before", "after", "rises"]
    head += ["when loaded", "seconds", "Python"]
    rows = []
    for runs in result.values():
        for run in runs["trainings"]:
            python = run["versions"]["python"].rpartition(".")[0]
            rows.append(
                [
                    run["library"],
                    run["version"],
                    run["algorithm"],
                    run["door"] + (f"; {run['remark']}" if run["remark"] else ""),
                    f"{run['steps']:,}".replace(",", " "),
                    mean(run["before"]),
                    mean(run["after"]),
                    "yes" if run["rises"] else "**no**",
                    "the same actions" if run["loads"] else "**other actions**",
                    f"{run['seconds']:.0f}",
                    python,
                ]
            )
    missing = [name for name in ORDER if name not in result]
    rows += [[f"`{name}`", *["not run"] * 3, *[""] * (len(head) - 4)] for name in missing]
    return table(head, rows, names=4)


def wrappers(result: Result) -> str:
    """A row for each group of wrappers: those that run, and those that do not, with their error."""
    checks = [check for runs in result.values() for check in runs["checks"]]
    rows = []
    for group in dict.fromkeys(check["group"] for check in checks):
        here = [check for check in checks if check["group"] == group]
        runs = [f"`{check['wrapper']}`" for check in here if not check["error"]]
        fails = [f"`{check['wrapper']}`: {check['error']}" for check in here if check["error"]]
        rows.append([group, here[0]["version"], ", ".join(runs), "; ".join(fails) or "none"])
    return table(["wrappers", "version", "run past two ends", "fail"], rows, names=4)


def main() -> None:
    """Keep what was found, and write the tables."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    result = merged(kept, folder)
    write_text(KEPT, json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    put(PAGE, trainings(result), "trainings of clients")
    put(PAGE, wrappers(result), "wrappers")


if __name__ == "__main__":
    main()
