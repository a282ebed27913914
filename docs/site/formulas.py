"""Formulas as MathML, which browsers draw by themselves: a Markdown extension for `$…$` and `$$…$$`.

A page needs no script for it, and nothing from a network.
"""

import re
import xml.etree.ElementTree as etree
from typing import Any

from latex2mathml.converter import convert
from markdown import Extension, Markdown
from markdown.inlinepatterns import InlineProcessor

PATTERN = r"(?<![\\$\w])(\$\$?)(?!\s*\$)(.+?)\1(?![\w$])"
_BEFORE = re.compile(r"(?<=[\w)}\]])\s+(\\(?:ln|log|exp)(?![A-Za-z]))")
_AFTER = re.compile(r"(\\(?:ln|log(?:_\w|_\{\w+\})?|exp))(?![A-Za-z])(?!\s*(?:[({_^]|\\left|\\[bB]igl))\s*")
"""Where TeX sets a thin space, before a function and after it, and the converter sets none."""

_BEFORE_ESCAPES = 185  # after code (190), so that `$` in code stays what it is


def mathml(formula: str, *, block: bool) -> str:
    """LaTeX to MathML.

    Raises:
        ValueError: the converter does not know a command, which it would otherwise print as it stands.

    >>> mathml("x_1", block=False)[:5]
    '<math'
    """
    formula = " ".join(formula.split()).replace(r"\arg", r"\operatorname{arg}")
    if "&=" in formula:
        formula = rf"\begin{{aligned}}{formula}\end{{aligned}}"
    formula = _AFTER.sub(r"\1 \\, ", _BEFORE.sub(r" \\, \1", formula))
    result = convert(formula, display="block" if block else "inline")
    if unknown := re.findall(r"\\[A-Za-z]+", result):
        raise ValueError(f"no MathML for {', '.join(unknown)} in {formula}")
    return result


class Formula(InlineProcessor):
    """Turns one formula into what Markdown puts into the page untouched."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str | etree.Element, int, int]:
        """The placeholder of the formula, and where it stood."""
        return self.md.htmlStash.store(mathml(m[2], block=m[1] == "$$")), m.start(0), m.end(0)


class Formulas(Extension):
    """The extension, named in `mkdocs.yml`."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the pattern."""
        md.inlinePatterns.register(Formula(PATTERN, md), "formula", _BEFORE_ESCAPES)


def makeExtension(**settings: Any) -> Formulas:
    """What Markdown calls."""
    return Formulas(**settings)
