"""Notebooks as pages of the site, and their execution.

``python docs/generate/notebook_pages.py`` executes all notebooks in ``docs/notebooks`` and writes their outputs
into them; ``--check`` executes copies and keeps the files; names restrict both to some notebooks.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from shared import DOCS, ROOT, Pages

FOLDER = DOCS / "notebooks"
TIMEOUT_S = 900


def text_of(value: str | list[str]) -> str:
    """A text of a notebook, which may be a list of lines."""
    return value if isinstance(value, str) else "".join(value)


def shown(output: dict[str, Any], place: str, number: int, found: Pages) -> str:
    """An output in Markdown; pictures are added to the pages."""
    if output["output_type"] == "error":
        return f"```text\n{output['ename']}: {output['evalue']}\n```\n"
    data = output["data"]
    if "image/png" in data:
        name = f"{place}-{number}.png"
        found[f"notebooks/{name}"] = base64.b64decode(text_of(data["image/png"]))
        return f"![Output of the cell above]({name})\n"
    return f"```text\n{text_of(data['text/plain']).rstrip()}\n```\n"


def notebook_page(path: Path, found: Pages) -> str:
    """A notebook in Markdown."""
    parts, number = [], 0
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        source = text_of(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source + "\n")
            continue
        parts.append(f"```python\n{source}\n```\n")
        said = [text_of(one["text"]) for one in cell["outputs"] if one["output_type"] == "stream"]
        if said:
            parts.append(f"```text\n{''.join(said).rstrip()}\n```\n")
        for output in cell["outputs"]:
            if output["output_type"] != "stream":
                parts.append(shown(output, path.stem, number, found))
                number += 1
    parts.append(
        f'---\n\nThis page is the notebook <a href="{path.name}">{path.name}</a>; '
        "`make check-docs` executes it.\n"
    )
    return "\n".join(parts)


def pages() -> Pages:
    """The pages of all notebooks, with their pictures."""
    found: Pages = {}
    for path in sorted(FOLDER.glob("*.ipynb")):
        found[f"notebooks/{path.stem}.md"] = notebook_page(path, found)
    return found


def merged(outputs: list[Any]) -> list[Any]:
    """The outputs of a cell, with what it printed in one piece and without what it warned of."""
    printed = [one for one in outputs if one.output_type == "stream" and one.name == "stdout"]
    if printed:
        lines = "".join(one.text for one in printed).splitlines(keepends=True)
        printed[0].text = "".join(line for line in lines if "\x1b[" not in line)  # coloured logs
    return printed[:1] + [one for one in outputs if one.output_type != "stream"]


def execute(path: Path, keep: bool) -> None:
    """Execute a notebook from the root of the repository; write it back if asked."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    start = time.monotonic()
    os.environ.setdefault("PYTHONPATH", str(ROOT))
    NotebookClient(
        notebook, timeout=TIMEOUT_S, resources={"metadata": {"path": str(ROOT)}}
    ).execute()
    print(f"{path.name}: {time.monotonic() - start:.0f} s")
    if keep:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # times, which differ every time
            if cell.cell_type == "code":
                cell.outputs = merged(cell.outputs)
        notebook.metadata = {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
        path.write_text(nbformat.writes(notebook, indent=1).rstrip() + "\n", encoding="utf-8")


def main() -> None:
    """Execute the notebooks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="names without .ipynb; default: all")
    parser.add_argument("--check", action="store_true", help="keep the files unchanged")
    given = parser.parse_args()
    paths = sorted(FOLDER.glob("*.ipynb"))
    unknown = set(given.names) - {path.stem for path in paths}
    if unknown:
        sys.exit(f"no notebook {', '.join(sorted(unknown))} in {FOLDER}")
    for path in paths:
        if not given.names or path.stem in given.names:
            execute(path, keep=not given.check)


if __name__ == "__main__":
    main()
