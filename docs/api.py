"""The public names and the modules that document them. The site's reference and the tests use this list."""

import importlib
import inspect
from functools import cache
from importlib.util import find_spec
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
    """List the public classes and functions of each module. Each of them is listed in one module only."""
    seen: set[int] = set()
    found: dict[str, list[tuple[str, Any]]] = {}
    # The top-level package comes last, because it re-exports names of the others.
    for name in (*MODULES[1:], MODULES[0]):
        module = importlib.import_module(name)
        public = getattr(module, "__all__", None) or [n for n, t in vars(module).items() if _own(t, name)]
        objects = [(n, getattr(module, n)) for n in sorted(public)]
        objects = [(n, t) for n, t in objects if (inspect.isclass(t) or inspect.isfunction(t)) and id(t) not in seen]
        seen |= {id(t) for _, t in objects}
        found[name] = objects
    return {name: found[name] for name in MODULES if found[name]}


def _own(obj: Any, module: str) -> bool:
    public = inspect.isclass(obj) or inspect.isfunction(obj)
    return public and obj.__module__ == module and not obj.__name__.startswith("_")


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
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def pages() -> dict[str, str]:
    """Write the pages of the reference in Markdown, one for each module. mkdocstrings fills in the docstrings."""
    found = {}
    for module, objects in entries().items():
        about = (inspect.getdoc(importlib.import_module(module)) or "").split("\n\n")[0]
        names = [f"::: {place(module, name, obj)}" for name, obj in objects]
        found[module] = "\n\n".join([f"# {module} {{#{module}}}", about, *names, ""])
    return found
