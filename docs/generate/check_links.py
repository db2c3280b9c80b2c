"""Check the links of the built site: ``python docs/generate/check_links.py site``.

Every link within the site leads to a file, and to a heading if it names one; no page loads anything from
elsewhere.
Links to other sites are counted and written to ``external-links.txt`` in the site; they are not followed.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

LOADED = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src"), ("source", "src")}
NOT_LOADED = (
    "canonical",
    "next",
    "prev",
    "alternate",
)  # links of a page's head that a browser does not follow


class Links(HTMLParser):
    """Links, what is loaded, and the places that a page has names for."""

    def __init__(self) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.loaded: set[str] = set()
        self.names: set[str] = set()

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        """Collect the attributes of a tag."""
        given = {key: value or "" for key, value in attrs}
        self.names |= {given[key] for key in ("id", "name") if key in given}
        if tag == "a" and given.get("href"):
            self.links.add(given["href"])
        for kind, key in LOADED:
            if tag == kind and given.get(key) and given.get("rel") not in NOT_LOADED:
                self.loaded.add(given[key])


def read(path: Path) -> Links:
    """The links of a page."""
    found = Links()
    found.feed(path.read_text("utf-8"))
    return found


def checked(site: Path) -> tuple[list[str], dict[str, list[str]]]:
    """What is wrong, in a line each, and the links to other sites with the pages that have them."""
    pages = {path: read(path) for path in sorted(site.rglob("*.html"))}
    wrong, abroad = [], defaultdict(list)
    for path, page in pages.items():
        name = path.relative_to(site)
        for link in sorted(page.links | page.loaded):
            parts = urlsplit(link)
            if parts.scheme in ("http", "https") or parts.netloc:
                if link in page.loaded:
                    wrong.append(f"{name} loads {link}")
                abroad[link].append(str(name))
                continue
            if parts.scheme or path.name == "404.html":
                continue
            place = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            if place.is_dir():
                place /= "index.html"
            if not place.is_file():
                wrong.append(f"{name}: {link} leads nowhere")
            elif parts.fragment and place in pages:
                target = unquote(parts.fragment)
                if target not in pages[place].names and not target.startswith("__"):
                    wrong.append(f"{name}: {link} names a place that is not there")
    return wrong, dict(abroad)


def main() -> None:
    """Check a site."""
    site = Path(sys.argv[1]).resolve()
    wrong, abroad = checked(site)
    lines = [f"{link}\t{', '.join(pages)}" for link, pages in sorted(abroad.items())]
    (site / "external-links.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(
        f"{len(list(site.rglob('*.html')))} pages; {len(abroad)} links to other sites, not followed"
    )
    if wrong:
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
