"""The public names and the modules that document them. The site's reference and the tests use this list."""

import importlib
import inspect
from functools import cache
from importlib.util import find_spec
from types import ModuleType
from typing import Any

MODULES = (
    "semfov",
    "semfov.sensor",
    "semfov.detection",
    "semfov.observation",
    "semfov.observation.dirichlet",
    "semfov.belief",
    "semfov.belief.observers",
    "semfov.belief.fusion",
    "semfov.gaze",
    "semfov.gaze.policies",
    "semfov.gaze.acquisition",
    "semfov.gaze.saliency",
    "semfov.episode",
    "semfov.live",
    "semfov.settings",
    "semfov.paths",
    "semfov.viz",
    "semfov.report",
    "semfov.zoom",
    "semfov.motion",
    "semfov.tracking",
    "semfov.head",
    "semfov.agents",
    "semfov.envs",
    "semfov.data",
    "semfov.data.fixations",
    "semfov.human",
    "semfov.metrics.scanpath",
    "semfov.metrics.merging",
    "semfov.errors",
)


@cache
def entries() -> dict[str, list[tuple[str, Any]]]:
    """List the public classes and functions of each module. Each of them is listed in one module only.

    Returns:
        Names and objects, by the name of the module.
    """
    listed: set[int] = set()
    by_module: dict[str, list[tuple[str, Any]]] = {}
    # The top-level package comes last, because it re-exports names of the others.
    for name in (*MODULES[1:], MODULES[0]):
        module = importlib.import_module(name)
        objects = [(public, getattr(module, public)) for public in sorted(_public_names(module))]
        by_module[name] = [(public, obj) for public, obj in objects if _is_documented(obj) and id(obj) not in listed]
        listed |= {id(obj) for _, obj in by_module[name]}
    return {name: by_module[name] for name in MODULES if by_module[name]}


def _public_names(module: ModuleType) -> list[str]:
    """List the names in `__all__`, or without it those of the classes and functions that the module defines."""
    names: list[str] = getattr(module, "__all__", [])
    return names or [
        name
        for name, obj in vars(module).items()
        if _is_documented(obj) and obj.__module__ == module.__name__ and not obj.__name__.startswith("_")
    ]


def _is_documented(obj: object) -> bool:
    """Tell whether the reference documents an object: a class or a function."""
    return inspect.isclass(obj) or inspect.isfunction(obj)


def place(module: str, name: str, obj: Any) -> str:
    """Return the name under which the reference documents a class or function.

    This is the name in its public module, or the name where it is defined if a module has the public name, too.

    Args:
        module: the public module.
        name: the public name in it.
        obj: the class or function.

    Returns:
        The full name.

    >>> from semfov.sensor import foveate, glimpse
    >>> place("semfov.sensor", "foveate", foveate), place("semfov.sensor", "glimpse", glimpse)
    ('semfov.sensor.foveate', 'semfov.sensor.glimpse.glimpse')
    """
    public = f"{module}.{name}"
    return f"{obj.__module__}.{obj.__qualname__}" if _is_module(public) else public


def _is_module(name: str) -> bool:
    """Tell whether there is a module of this name."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def pages() -> dict[str, str]:
    """Write the pages of the reference in Markdown, one for each module. mkdocstrings fills in the docstrings.

    Returns:
        The pages, by the name of the module.
    """
    texts = {}
    for module, objects in entries().items():
        about = (inspect.getdoc(importlib.import_module(module)) or "").split("\n\n")[0]
        names = [f"::: {place(module, name, obj)}" for name, obj in objects]
        texts[module] = "\n\n".join([f"# {module} {{#{module}}}", about, *names, ""])
    return texts
