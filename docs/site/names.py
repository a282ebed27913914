"""Links from names in the text to the entries of classes and functions in the reference."""

import importlib
import inspect
import re
from collections.abc import Container
from contextlib import suppress
from functools import cached_property
from typing import Any

from docs.api import MODULES, entries, place

NAME = re.compile(r"(?<![`\[\w])`((?:semfov|[A-Z]\w*)(?:\.\w+)*)((?:\([^`]*\))?)`(?![`\]])")
"""A name in backticks: a full name, or the bare name of a class, with or without a call."""

_BARE = re.compile(r"(?<![`\[\w])`([a-z]\w*)(?:\(\))?`(?![`\]])")


class Names:
    """Find the entry of the reference that a name refers to."""

    @cached_property
    def places(self) -> dict[int, str]:
        """The entry of each public class and function, by the object's `id`."""
        return {id(obj): place(module, name, obj) for module, objects in entries().items() for name, obj in objects}

    @cached_property
    def classes(self) -> dict[str, str]:
        """The entry of each public class, by its bare name. Names that several classes share are left out."""
        found: dict[str, list[str]] = {}
        for objects in entries().values():
            for name, obj in objects:
                if inspect.isclass(obj):
                    found.setdefault(name, []).append(self.places[id(obj)])
        return {name: places[0] for name, places in found.items() if len(places) == 1}

    def place(self, name: str) -> str | None:
        """Find the entry of a name in the reference.

        Args:
            name: a full name, or the bare name of a class.

        Returns:
            The entry, or None if the reference has none.

        Raises:
            LookupError: the name belongs to the package but does not exist.
        """
        if not name.startswith("semfov"):
            first, _, rest = name.partition(".")
            if first not in self.classes:
                return None
            name = self.classes[first] + (f".{rest}" if rest else "")
        if name in MODULES:
            return name
        obj, owner = resolve(name)
        if id(obj) in self.places:
            return self.places[id(obj)]
        if owner is None or id(owner) not in self.places:
            return None
        member = name.rpartition(".")[2]
        return self.places[id(owner)] + (f".{member}" if _shown(owner, member) else "")

    def link_neighbours(self, text: str, module: str, but: Container[str] = ()) -> str:
        """Turn bare names of a module's public functions into links.

        Args:
            text: the text.
            module: the module.
            but: names that are not linked, such as a function's arguments.

        Returns:
            The text with links.
        """
        neighbours = {
            obj.__name__: self.places[id(obj)]
            for objects in entries().values()
            for _, obj in objects
            if inspect.isfunction(obj) and obj.__module__ == module and obj.__name__ not in but
        }
        return _BARE.sub(lambda m: f"[{m[0]}][{neighbours[m[1]]}]" if m[1] in neighbours else m[0], text)

    def link(self, text: str, internals: set[str] | None = None) -> str:
        """Turn full names and names of classes into links.

        Args:
            text: the text.
            internals: names that are not public are added to it and linked to the page of internals (None: they are not
                linked).

        Returns:
            The text with links.

        Raises:
            LookupError: a name belongs to the package but does not exist.
        """

        def linked(match: re.Match[str]) -> str:
            name = match[1]
            found = self.place(name)
            if found is None and internals is not None and name.startswith("semfov."):
                found = _internal(name)
                internals.update([found] if found else [])
            return f"[{match[0]}][{found}]" if found else match[0]

        return NAME.sub(linked, text)


def resolve(name: str) -> tuple[Any, Any]:
    """Find the object with a full name.

    Args:
        name: the full name.

    Returns:
        The object, and the class that it is a member of, or None.

    Raises:
        LookupError: the name does not exist.
    """
    parts = name.split(".")
    for length in range(1, len(parts) + 1):  # a function may hide the module that it is in
        try:
            obj = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            break
        with suppress(AttributeError):
            return _member(obj, parts[length:])
    raise LookupError(f"{name} does not exist")


def _member(obj: Any, names: list[str]) -> tuple[Any, Any]:
    owner = None
    for name in names:
        owner = obj if inspect.isclass(obj) else None
        annotated = name in getattr(obj, "__annotations__", ())
        obj = getattr(obj, name, None) if annotated else getattr(obj, name)
    return obj, owner


def _shown(owner: type, member: str) -> bool:
    """Return whether the reference shows a member: a documented method or property of the class itself."""
    obj = inspect.getattr_static(owner, member, None)
    obj = getattr(obj, "__func__", None) or getattr(obj, "fget", None) or obj
    return member in vars(owner) and inspect.isfunction(obj) and bool(obj.__doc__) and not member.startswith("_")


def _internal(name: str) -> str | None:
    """Return the name under which a class or function that is not public is defined."""
    obj, owner = resolve(name)
    obj = owner or obj
    if not (inspect.isclass(obj) or inspect.isfunction(obj)):
        return None
    return f"{obj.__module__}.{obj.__qualname__}"
