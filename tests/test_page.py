"""A page of HTML: one file, nothing from elsewhere, and text stays text."""

from __future__ import annotations

import html.parser
import json

import pytest

from baselines.pages.page import embedded, page, text

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)> & \" ' \u2028"


class Elements(html.parser.HTMLParser):
    """The elements of a page, and the texts inside each kind."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict]] = []
        self.inside: dict[str, list[str]] = {}
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.found:
            self.inside.setdefault(self.found[-1][0], []).append(data)


def test_halves_of_surrogate_pairs_are_replaced():
    """JSON and the names of files may have them; UTF-8 has not."""
    assert text("a\ud800<b") == "a?&lt;b"
    source = page("\ud800", "<p></p>", data={"\udfff": "\ud800"})
    assert source.encode("utf-8").count(b"?") == 3


def test_any_text_stays_text():
    source = page(
        HOSTILE, f'<p title="{text(HOSTILE)}">{text(HOSTILE)}</p>', data={"name": HOSTILE}
    )
    elements = Elements(source)
    names = [name for name, _ in elements.found]
    assert names.count("script") == 1
    assert "img" not in names
    assert "".join(elements.inside["title"]).startswith(HOSTILE)
    assert dict(elements.found)["p"]["title"] == HOSTILE
    assert json.loads(elements.inside["script"][0]) == {"name": HOSTILE}


def test_a_page_loads_nothing():
    elements = Elements(page("a run", "<p>text</p>", data={}))
    for name, attributes in elements.found:
        assert "src" not in attributes, name
        assert attributes.get("href", "data:").startswith("data:"), name


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_data_must_be_json(value):
    with pytest.raises(ValueError, match="JSON"):
        embedded({"value": value})
