"""Write docs/paper.md and docs/paper/ from the folder of ``tlf paper``.

``tlf paper --out results/paper``, which takes about three quarters of an hour, then
``python docs/figures/make_paper.py results/paper``. Both need the extra ``figures``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from make_board import DOCS, write_text

from baselines.paper.report import markdown
from baselines.paper.results import PARTS, read_results, write_results

FOLDER = DOCS / "paper"


def main(source: Path) -> None:
    """Copy the figures and write the page.

    Raises
    ------
    ValueError
        if the folder lacks a part.
    """
    results = read_results(source)
    missing = ", ".join(name for name in PARTS if name not in results)
    if missing:
        raise ValueError(f"{source} lacks {missing}")
    FOLDER.mkdir(exist_ok=True)
    for result in results.values():
        for name in result.figures:
            shutil.copyfile(source / f"{name}.png", FOLDER / f"{name}.png")
    write_results(results, FOLDER)
    write_text(DOCS / "paper.md", markdown(results, "paper/"))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/paper"))
