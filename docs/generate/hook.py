"""The hook of MkDocs that makes the generated pages of the site, and fits the others to it.

The pages in ``docs/`` are read as they are on a forge: links to files elsewhere in the repository become
links to pages of these files. Formulas are set by MathJax from the package ``django-static-mathjax``, which is
copied into the site, so that a page needs no network.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import equations
import notebook_pages
import policy_pages
import preset_pages
import source_pages
import task_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

MATHJAX = "assets/mathjax/tex-svg-full.js"  # with all extensions, which it would load otherwise
SHIM = "https://unpkg.com/iframe-worker/shim"  # what the theme has in its place
# Groups of the navigation that get the generated pages of a folder, by the page that begins them.
GROUPS = ("tasks/index.md", "presets/index.md", "policies/index.md", "notebooks/index.md")
MERMAID = re.compile(r"^```mermaid$", re.MULTILINE)  # its diagrams would need the network: as text

# A name in a docstring: with ~ only its last part is meant.
ROLE = re.compile(r":(?:class|func|mod|meth|data|attr):<code>(?:(~)[\w.]*?(\w+)|([^<]*))</code>")

PICTURE = re.compile(r'(<img [^>]*src="([^"]+)"[^>]*>)(?!</a>)')

generated: dict[str, str | bytes] = {}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Make the pages, and put them into the navigation.

    Raises
    ------
    ValueError
        if the code on the page of the equations is not that of the sources.
    """
    page = equations.PAGE.read_text("utf-8")
    if equations.renewed(page) != page:
        raise ValueError(f"{equations.PAGE} is old; run: python docs/generate/equations.py")
    generated.clear()
    for one in (task_pages, preset_pages, policy_pages, notebook_pages):
        generated.update(one.pages())
    generated.update(
        {
            page: (source_pages.ROOT / name).read_text("utf-8")
            for name, page in source_pages.PAGES.items()
        }
    )
    generated.update(source_pages.pages(source_pages.repository_pages()))
    _fill(config.nav)
    return config


def _fill(nav: Any) -> None:
    """Put generated pages behind the page that begins their group."""
    for entry in nav if isinstance(nav, list) else []:
        if not isinstance(entry, dict):
            continue
        for below in entry.values():
            _fill(below)
            if not isinstance(below, list):
                continue
            for group in set(GROUPS).intersection(one for one in below if isinstance(one, str)):
                folder = group.removesuffix("index.md")
                pages = [
                    page
                    for page in generated
                    if page.startswith(folder) and page.endswith(".md") and page != group
                ]
                at = below.index(group) + 1
                below[at:at] = pages


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and MathJax."""
    for path, content in generated.items():
        files.append(File.generated(config, path, content=content))
    package = importlib.util.find_spec("mathjax")
    if package is None or package.submodule_search_locations is None:
        raise ModuleNotFoundError("the site needs django-static-mathjax: pip install '.[docs]'")
    static = Path(package.submodule_search_locations[0]) / "static" / "mathjax"
    for path, name in ((MATHJAX, "es5/tex-svg-full.js"), ("assets/mathjax/LICENSE.txt", "LICENSE")):
        files.append(File.generated(config, path, abs_src_path=str(static / name)))
    for page in files.documentation_pages():
        if page.src_uri.startswith("files/"):
            page.inclusion = page.inclusion.NOT_IN_NAV
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files of the repository to the site's pages of them."""
    at = page.file.src_uri
    by_page = {page: name for name, page in source_pages.PAGES.items()}
    place = by_page.get(at, f"docs/{at}")
    return MERMAID.sub("```text", source_pages.rewritten(markdown, place, at))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Names in docstrings as code, without the roles of Sphinx; pictures that open by a click."""
    html = ROLE.sub(lambda role: f"<code>{role[2] if role[1] else role[3]}</code>", html)
    return PICTURE.sub(r'<a class="picture" href="\2">\1</a>', html)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Add MathJax to a page with formulas, and take the search's shim from the site."""
    up = "../" * page.file.src_uri.count("/")
    output = output.replace(SHIM, f"{up}assets/iframe-worker.js")
    if 'class="arithmatex"' not in output:
        return output
    scripts = (
        f'<script src="{up}assets/mathjax-settings.js"></script>'
        f'<script src="{up}{MATHJAX}" defer></script>'
    )
    return output.replace("</head>", scripts + "</head>", 1)


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """As :func:`on_post_page`, for the page of a wrong address."""
    return output_content.replace(SHIM, "/assets/iframe-worker.js")


def on_post_build(config: MkDocsConfig) -> None:
    """Leave out what no reader needs: the sources of the theme's scripts."""
    for path in Path(config.site_dir, "assets").rglob("*.map"):
        path.unlink()
