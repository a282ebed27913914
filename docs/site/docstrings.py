"""A Griffe extension that converts formulas, examples and names in docstrings to Markdown for mkdocstrings."""

import inspect
import re
from collections.abc import Container
from pkgutil import resolve_name
from typing import Any

import griffe

from docs.site.names import Names

_MATH = re.compile(r"(?m)^( *)\.\. math::[ \n]*((?:.*)(?:\n+\1 +.*)*)")
_ROLE = re.compile(r":math:`([^`]*)`")
_SESSION = re.compile(r"(?m)^( *)>>> .*(?:\n\1\S.*|\n\1 +\S.*)*")
_EXAMPLE = re.compile(r"(?m)^( *)Example::\n\n((?:\1    .*\n|\n)*\1    .*)")


def markdown(text: str, names: Names, module: str = "", arguments: Container[str] = ()) -> str:
    """Convert a docstring to Markdown. Sections such as `Args:` stay as they are.

    Args:
        text: the docstring.
        names: finds the links of names.
        module: the module that contains the docstring.
        arguments: names of the function's arguments, which are not linked.

    Returns:
        The Markdown.

    Raises:
        LookupError: the docstring names something in the package that does not exist.
    """
    text = _MATH.sub(lambda m: f"{m[1]}$$ {' '.join(m[2].split())} $$", text)
    text = _ROLE.sub(lambda m: f"${' '.join(m[1].split())}$", text)
    text = _EXAMPLE.sub(_fenced_example, text)
    text = _SESSION.sub(lambda m: f"{m[1]}```pycon\n{m[0]}\n{m[1]}```", text)
    parts = re.split(r"(?ms)^( *```.*?^ *```$)", text)
    parts[::2] = [names.link(names.link_neighbours(part, module, arguments)) for part in parts[::2]]
    return "".join(parts)


def _fenced_example(match: re.Match[str]) -> str:
    indent, code = match[1], re.sub(rf"(?m)^{match[1]}    ", match[1], match[2])
    return f"{indent}**Example**\n\n{indent}```python\n{code}\n{indent}```"


def _arguments(obj: griffe.Object) -> set[str]:
    """Return the names of a function's arguments and of a class's attributes, which must not become links."""
    arguments = obj.parameters if isinstance(obj, griffe.Function | griffe.Class) else ()
    return {obj.name, *(argument.name for argument in arguments), *obj.members}


def _whole_docstring(obj: griffe.Object) -> str:
    """Return a docstring of the source, or as Python has it where a decorator adds the help of settings to it."""
    assert obj.docstring is not None
    decorators = obj.decorators if isinstance(obj, griffe.Function) else []
    if any(decorator.callable_path.endswith(".documented_by") for decorator in decorators):
        return inspect.getdoc(resolve_name(obj.path)) or ""
    return obj.docstring.value


class Docstrings(griffe.Extension):
    """Convert every docstring once, when it is read."""

    def __init__(self) -> None:
        super().__init__()
        self.names = Names()

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Convert the docstring of a module, class, function or attribute that was loaded."""
        if obj.docstring and not obj.is_alias:
            try:
                text, module = _whole_docstring(obj), obj.module.path
                obj.docstring.value = markdown(text, self.names, module, _arguments(obj))
            except LookupError as error:
                griffe.logger.warning(f"{obj.path}: {error}")
