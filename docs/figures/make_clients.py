"""Write the tables of ``docs/compatibility.md`` from runs of client libraries.

``make clients`` trains with every library and writes ``results/clients/NAME.json``. ``python
docs/figures/make_clients.py`` keeps what is found there in ``docs/compatibility.json``, by the name of the
environment; what is not found stays as it was. The tables are made from that file alone.
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

Result = dict[str, dict[str, list[dict[str, Any]]]]


def merged(kept: Result, folder: Path) -> Result:
    """The kept runs, those of a folder in place of the earlier ones, in the order of the page."""
    found = {
        path.stem: json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")
    }
    everything = kept | found
    unknown = sorted(set(everything) - set(ORDER))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: not in the order of the page, {', '.join(ORDER)}")
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
