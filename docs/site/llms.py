"""The table of contents for language models, `llms.txt`: each page of the navigation with its first sentence.

The form is that of https://llmstxt.org: a title, a summary, and lists of links. The links are relative to the file.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

_LINK = re.compile(r"\[([^\]]*)\](?:\([^)]*\)|\[[^\]]*\])")
_FENCE = re.compile(r"(?ms)^( *```).*?^ *```$")
_ALONE = "Pages"  # section of pages that are in none
_LONGEST = 200  # characters of a first sentence


def contents(configuration: str, pages: Path) -> str:
    """Make the table of contents.

    Args:
        configuration: text of `mkdocs.yml`.
        pages: folder of the pages in Markdown.

    Returns:
        The text of `llms.txt`.
    """
    # Loaded as plain data, with the names of variables in place of what the environment has; other tags are refused.
    settings = yaml.safe_load(configuration.replace("!ENV ", ""))
    lines = [f"# {settings['site_name']}", "", f"> {settings['site_description']}"]
    home = (pages / "index.md").read_text(encoding="utf-8")
    lines += ["", first_sentence(home)]
    chapter = None
    # Pages of their own stand first, so that each section has one heading.
    for section, title, place in sorted(_entries(settings["nav"]), key=lambda entry: entry[0] != _ALONE):
        if section == "Reference" or not (pages / place).is_file():
            continue
        if section != chapter:
            lines += ["", f"## {section}", ""]
            chapter = section
        sentence = first_sentence((pages / place).read_text(encoding="utf-8"))
        address = place.removesuffix(".md") + ".html"
        lines.append(f"- [{title}]({address}): {sentence}" if sentence else f"- [{title}]({address})")
    return "\n".join(lines) + "\n"


def _entries(navigation: list[object]) -> Iterator[tuple[str, str, str]]:
    """Yield section, title and file of each page, in the order of the navigation."""
    for entry in navigation:
        for title, content in _titled(entry, _ALONE):
            if isinstance(content, str):
                yield _ALONE, title, content
            else:
                yield from ((title, name, place) for name, place in _flat(content, title))


def _flat(pages: list[object], title: str) -> Iterator[tuple[str, str]]:
    """Yield title and file of each page of a section, also of the sections in it."""
    for entry in pages:
        for name, content in _titled(entry, title):
            if isinstance(content, str):
                yield name, content
            else:
                yield from _flat(content, name)


def _titled(entry: object, title: str) -> Iterator[tuple[str, Any]]:
    """Yield an entry with its title; a page without one has that of its section."""
    if isinstance(entry, dict):
        yield from entry.items()
    else:
        yield title, entry


def first_sentence(page: str) -> str:
    r"""Return the first sentence of a page as plain text; empty for a page without one.

    Args:
        page: the page in Markdown.

    Returns:
        The sentence, cut after a word if it is long.

    >>> first_sentence("# Title\n\nSee [a page](there.md), or not. Then more.")
    'See a page, or not.'
    """
    for paragraph in re.split(r"\n(?:[ \t]*\n)+", _FENCE.sub("", page)):
        text = " ".join(paragraph.split())
        is_code = paragraph.lstrip("\n").startswith("    ")
        if is_code or not text or text[0] in "#|!<-*=:>{$":
            continue
        plain = _LINK.sub(r"\1", text).replace("`", "").replace("**", "")
        sentence = re.split(r"(?<=[.!?:])\s", plain, maxsplit=1)[0].rstrip(":")
        return sentence if len(sentence) <= _LONGEST else sentence[:_LONGEST].rsplit(" ", 1)[0] + " …"
    return ""
