"""Write the generated parts of docs/architecture.md from the sources: rooms, files, imports.

    python docs/figures/make_architecture.py

A test compares the page with what this script makes.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "architecture.md"
# From top to bottom; the contract in pyproject.toml has the same order.
ROOMS = (
    "baselines",
    "tlf_env.envs",
    "tlf_env.rendering",
    "tlf_env.engine",
    "tlf_env.task",
    "tlf_env.disturbances",
    "tlf_env.hosting",
    "tlf_env.onboard",
    "tlf_env.physics",
    "tlf_env.numerics",
    "tlf_env.common",
)
WINGS = (
    "cli",
    "commands",
    "policies",
    "runs",
    "pages",
    "paths",
    "data",
    "live",
    "benchmark",
    "training",
    "tuning",
    "speed",
    "paper",
)


def room_of(module: str) -> str | None:
    """The room that a module lies in, or None for the package itself."""
    return next((room for room in ROOMS if module == room or module.startswith(f"{room}.")), None)


def summary(path: Path) -> str:
    """The first line of a module's docstring, without its full stop."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.split("\n")[0].rstrip(".")


def files_of(folder: Path) -> list[Path]:
    """The modules directly in a folder, by name."""
    return sorted(path for path in folder.glob("*.py") if not path.name.startswith("__"))


def file_lists() -> str:
    """For every room a list of its files with what each holds."""
    parts = []
    folders = [ROOT / room.replace(".", "/") for room in ROOMS]
    for folder in folders[:1] + [folders[0] / wing for wing in WINGS] + folders[1:]:
        lines = [f"**`{folder.relative_to(ROOT)}/`** {summary(folder / '__init__.py')}.", ""]
        lines += [f"- `{path.name}`: {summary(path)}" for path in files_of(folder)]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def room_table(graph: grimp.ImportGraph) -> str:
    """Which room imports which, as a table: a row is the importer."""
    imports = {
        (room_of(importer), room_of(imported))
        for importer in graph.modules
        for imported in graph.find_modules_directly_imported_by(importer)
    }
    short = {room: room.removeprefix("tlf_env.") for room in ROOMS}
    lower = ROOMS[1:]
    lines = [
        "| imports | " + " | ".join(f"`{short[room]}`" for room in lower) + " |",
        "|---" * (len(lower) + 1) + "|",
    ]
    for room in ROOMS[:-1]:
        marks = ("●" if (room, other) in imports else "" for other in lower)
        lines.append(f"| **`{short[room]}`** | " + " | ".join(marks) + " |")
    return "\n".join(lines)


def levels(graph: grimp.ImportGraph, room: str) -> list[list[str]]:
    """Files of a room by level: a file imports only from levels before its own."""
    names = {module for module in graph.modules if module.startswith(f"{room}.")}
    below = {name: graph.find_modules_directly_imported_by(name) & names for name in names}
    found: list[list[str]] = []
    done: set[str] = set()
    while done < names:
        level = sorted(name for name in names - done if below[name] <= done)
        if not level:
            raise ValueError(f"{room} has a cycle of imports among {sorted(names - done)}")
        found.append([name.rpartition(".")[2] for name in level])
        done |= {f"{room}.{name}" for name in found[-1]}
    return found


def engine_levels(graph: grimp.ImportGraph) -> str:
    """The engine's files by level."""
    return "\n".join(
        f"{i}. {', '.join(f'`{name}`' for name in level)}"
        for i, level in enumerate(levels(graph, "tlf_env.engine"), start=1)
    )


def page(text: str) -> str:
    """The page with its generated parts made anew."""
    graph = grimp.build_graph("tlf_env", "baselines", exclude_type_checking_imports=True)
    parts = {
        "rooms": room_table(graph),
        "files": file_lists(),
        "levels": engine_levels(graph),
    }
    for name, made in parts.items():
        text = re.sub(
            rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)",
            lambda found, made=made: f"{found[1]}{made}\n{found[2]}",
            text,
            flags=re.DOTALL,
        )
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
