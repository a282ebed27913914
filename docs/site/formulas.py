"""A Markdown extension that converts formulas in `$…$` and `$$…$$` to MathML.

Browsers render MathML by themselves, so the pages need no script and no network.
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
"""Positions before and after a function where TeX inserts a thin space, but the converter does not."""

_BEFORE_ESCAPES = 185  # after code (190), so that `$` in code is left alone


def mathml(formula: str, *, block: bool) -> str:
    """Convert LaTeX to MathML.

    Args:
        formula: the formula in LaTeX.
        block: whether it is displayed in a block of its own.

    Returns:
        The MathML element.

    Raises:
        ValueError: the converter does not know a command of the formula.

    >>> mathml("x_1", block=False)[:5]
    '<math'
    """
    formula = " ".join(formula.split()).replace(r"\arg", r"\operatorname{arg}")
    if "&=" in formula:
        formula = rf"\begin{{aligned}}{formula}\end{{aligned}}"
    formula = _AFTER.sub(r"\1 \\, ", _BEFORE.sub(r" \\, \1", formula))
    result = convert(formula, display="block" if block else "inline")
    if unknown := re.findall(r"\\[A-Za-z]+", result):
        raise ValueError(f"expected commands that can be converted to MathML, got {', '.join(unknown)} in {formula}")
    return result


class Formula(InlineProcessor):
    """Replace one formula by a placeholder, which Markdown exchanges for the MathML at the end."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str | etree.Element, int, int]:
        """Return the placeholder of a formula, and the position of the formula."""
        return self.md.htmlStash.store(mathml(m[2], block=m[1] == "$$")), m.start(0), m.end(0)


class Formulas(Extension):
    """The Markdown extension, which `mkdocs.yml` names."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the pattern of formulas."""
        md.inlinePatterns.register(Formula(PATTERN, md), "formula", _BEFORE_ESCAPES)


def makeExtension(**settings: Any) -> Formulas:
    """Make the extension; Markdown calls this function."""
    return Formulas(**settings)
