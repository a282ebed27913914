"""Reads pages as a browser does, and checks what holds for every page."""

import json
import re
from html.parser import HTMLParser

VOID = {"meta", "link", "input", "br", "img", "hr"}


class Elements(HTMLParser):
    """Elements and texts of a page; all elements must be closed in their order, and ids occur once."""

    def __init__(self, page):
        super().__init__()
        self.found, self.texts, self.open = [], [], []
        self.feed(page)
        assert self.open == []
        ids = [attributes["id"] for _, attributes in self.found if "id" in attributes]
        assert len(ids) == len(set(ids))

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.texts.append(data)

    def of(self, kind):
        return [attributes for _, attributes in self.found if kind in (attributes.get("class") or "").split()]


def script_text(page):
    """The data of a page as text."""
    return re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)[1]


def data_of(page):
    """The data of a page."""
    return json.loads(script_text(page))


def names_are_text(page, hostile):
    """Check that a name that looks like markup is only text; returns the elements."""
    assert hostile not in page
    elements = Elements(page)
    tags = [tag for tag, _ in elements.found]
    assert tags.count("script") == 2
    assert "img" not in tags
    assert not [name for _, attributes in elements.found for name in attributes if name.startswith("on")]
    assert "<" not in script_text(page)
    return elements


def loads_nothing(page):
    """Check that a page loads nothing from elsewhere; returns its links."""
    links = [a[name] for _, a in Elements(page).found for name in ("src", "href", "action", "data") if name in a]
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "url(" not in page
    assert "default-src 'none'" in page
    return links
