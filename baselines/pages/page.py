"""One self-contained page of HTML: style, scripts and data are in the file, and any text in it stays text."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any


def page(
    title: str,
    body: str,
    *,
    scripts: Sequence[str] = (),
    styles: Sequence[str] = (),
    data: Mapping[str, Any] | None = None,
) -> str:
    """A document that loads nothing from elsewhere.

    Parameters
    ----------
    title
        Plain text.
    body
        HTML; text in it must have gone through :func:`text`.
    scripts, styles
        Names of files beside this module; ``style.css`` is always there, and comes first.
    data
        What the scripts read, as JSON, from the element ``data``.

    Raises
    ------
    ValueError
        for data that are not JSON, such as NaN.
    """
    given = (
        ""
        if data is None
        else f'<script type="application/json" id="data">{embedded(data)}</script>\n'
    )
    sheets = "\n".join(asset(name) for name in ("style.css", *styles))
    programs = "".join(f"<script>\n{asset(name)}</script>\n" for name in scripts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'  # otherwise a browser asks for /favicon.ico
        f"<title>{text(title)}</title>\n<style>\n{sheets}</style>\n</head>\n<body>\n{body}\n{given}{programs}"
        "</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Plain text for a page, also inside a quoted attribute."""
    return html.escape(encodable(str(value)), quote=True)


def encodable(value: str) -> str:
    """A text that UTF-8 can encode: halves of surrogate pairs, as in some JSON and file names, are ``?``."""
    return value.encode("utf-8", "replace").decode("utf-8")


def embedded(data: Mapping[str, Any]) -> str:
    """JSON for a script element, which a ``</script>`` in a text does not end.

    Raises
    ------
    ValueError
        for NaN and infinities.
    """
    whole = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return (
        encodable(whole)
        .replace("<", "\\u003c")
        .replace("\u2028", "\\u2028")
        .replace("\u2029", "\\u2029")
    )


@cache
def asset(name: str) -> str:
    """A file beside this module."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
