"""Pages for files of the repository that the documentation links to: sources, presets, results."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from shared import DOCS, ROOT, Pages

LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
FENCE = re.compile(r"(^```.*?^```|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
ABROAD = re.compile(r"[a-z]+:")
LANGUAGES = {".py": "python", ".yaml": "yaml", ".csv": "text", ".json": "json", ".toml": "toml"}
PAGES = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
# Folders of the repository, and the pages that are generated from what is in them.
FOLDERS = {
    "configs": "tasks/index.md",
    "configs/disturbances": "presets/index.md",
    "configs/controllers": "policies/index.md",
    "baselines/policies": "policies/index.md",
}


def target(link: str, place: str) -> PurePosixPath | None:
    """The path in the repository of a link on the page at a place in the repository; None if abroad."""
    if ABROAD.match(link) or link.startswith("/"):
        return None
    parts: list[str] = []
    for part in (PurePosixPath(place).parent / link).parts:
        if part == "..":
            if not parts:
                return None
            parts.pop()
        else:
            parts.append(part)
    return PurePosixPath(*parts)


def made_page(path: PurePosixPath) -> str | None:
    """The generated page about a preset, or about the presets of a folder; None if there is none."""
    if str(path) in FOLDERS:
        return FOLDERS[str(path)]
    folder, name = str(path.parent), path.stem
    if path.suffix != ".yaml" or not folder.startswith("configs"):
        return None
    if folder.startswith("configs/laws/"):
        return f"policies/{path.parent.name}.md"
    pages = {
        "configs": f"tasks/{name}.md",
        "configs/disturbances": f"presets/{name}.md",
        "configs/controllers": f"policies/reference-{name}.md",
    }
    return pages.get(folder)


def shown(path: PurePosixPath) -> bool:
    """Whether the site has no other page or picture of a file of the repository."""
    if str(path) in PAGES or made_page(path):
        return False
    own = path.parts[:1] == ("docs",)
    return not own or path.suffix not in (".md", ".png", ".svg", ".gif", ".ipynb")


def page_of(path: PurePosixPath) -> str:
    """Where the site shows a file of the repository, relative to docs/."""
    if str(path) in PAGES:
        return PAGES[str(path)]
    made = made_page(path)
    if made is not None:
        return made
    if not shown(path):
        inside = path.relative_to("docs")
        return str(inside.with_suffix(".md") if inside.suffix == ".ipynb" else inside)
    return f"files/{path}.md"


def relative(page: str, place: str) -> str:
    """The link from one page of the site to another."""
    up = len(PurePosixPath(place).parent.parts)
    return "../" * up + page


def rewritten(text: str, place: str, at: str) -> str:
    """A page with its links to files of the repository turned to the site's pages of them.

    Parameters
    ----------
    text
        In Markdown.
    place, at
        Where the page is in the repository, and on the site.
    """

    def turned(match: re.Match[str]) -> str:
        path = target(match[2], place)
        if path is None or not (ROOT / path).exists():
            return match[0]
        return f"{match[1]}{relative(page_of(path), at)}{match[3] or ''}{match[4]}"

    parts = FENCE.split(text)
    return "".join(part if i % 2 else LINK.sub(turned, part) for i, part in enumerate(parts))


def linked(text: str, place: str) -> set[PurePosixPath]:
    """Files of the repository that a page links to and that have no page of their own yet."""
    plain = FENCE.sub("", text)
    paths = (target(match[2], place) for match in LINK.finditer(plain))
    return {path for path in paths if path is not None and (ROOT / path).exists() and shown(path)}


def file_page(path: PurePosixPath) -> str:
    """A file, or the names in a folder, as a page."""
    place = ROOT / path
    hidden = "---\nsearch:\n  exclude: true\n---\n\n"
    if place.is_dir():
        names = sorted(
            one.name + "/" * one.is_dir() for one in place.iterdir() if one.name[0] not in "._"
        )
        listed = "\n".join(f"- `{name}`" for name in names)
        return f"{hidden}# {path}\n\nA folder of the repository.\n\n{listed}\n"
    language = LANGUAGES.get(path.suffix, "text")
    return f"{hidden}# {path}\n\n````{language}\n{place.read_text('utf-8').rstrip()}\n````\n"


def pages(sources: dict[str, str]) -> Pages:
    """The pages for everything that other pages link to.

    Parameters
    ----------
    sources
        Markdown by place in the repository.
    """
    wanted = set().union(*(linked(text, place) for place, text in sources.items()))
    return {f"files/{path}.md": file_page(path) for path in sorted(wanted)}


def repository_pages() -> dict[str, str]:
    """Markdown of the repository: docs/, and the pages at its top."""
    places = [*DOCS.rglob("*.md"), *(ROOT / name for name in PAGES)]
    return {
        path.relative_to(ROOT).as_posix(): path.read_text("utf-8")
        for path in map(Path, places)
        if path.is_file()
    }
