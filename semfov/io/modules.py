"""Modules by name: where their sources are, and whether they are the user's own. None of them is imported."""

import json
import sys
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from inspect import getmodulename
from os.path import isdir, isfile, join
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

PACKAGE = "semfov"

_LIBRARIES = {"site-packages", "dist-packages"}  # folders in which environments keep libraries


def source_file(name: str) -> Path | None:
    """Find the source file of a module.

    Args:
        name: dotted name of the module.

    Returns:
        The file; None where the module does not exist or has no source.
    """
    origin, _ = _origin(name)
    if isinstance(origin, str) and origin.endswith(".py") and isfile(origin):
        return Path(origin)
    return None


def _origin(name: str) -> tuple[object, Iterable[str]]:
    """Find the source of a module and the folders of its submodules; neither it nor its parents are imported."""
    parent, _, last = name.rpartition(".")
    try:
        if name in sys.modules:
            # Not by `getattr`, which makes a module that loads lazily load.
            attributes = object.__getattribute__(sys.modules[name], "__dict__")
            return attributes.get("__file__"), attributes.get("__path__") or ()
        if parent:
            _, parent_folders = _origin(parent)
            return _origin_in(parent_folders, last)
        spec = find_spec(name)
        if spec is None:
            return None, ()
        return spec.origin, spec.submodule_search_locations or ()
    except Exception:  # finders and loaded modules are others' code, and may raise anything
        return None, ()


def _origin_in(parent_folders: Iterable[str], name: str) -> tuple[str | None, Iterable[str]]:
    """Find the source of a submodule in the folders of its package, and the folders of its own submodules.

    A folder without a source is a part of a namespace package, which may have several (PEP 420).
    """
    # With the functions of `os.path`: a closure asks for a thousand names, and paths as objects take most of the time.
    folders = [join(folder, name) for folder in parent_folders]
    for folder in folders:
        package = join(folder, "__init__.py")
        if isfile(package):
            return package, folders
        module = f"{folder}.py"
        if isfile(module):
            return module, ()
    return None, [folder for folder in folders if isdir(folder)]


def belongs_to_others(name: str) -> bool:
    """Tell whether a module belongs to Python, to a library or to this package: not to the user.

    Args:
        name: dotted name of the module.

    Returns:
        Whether it does; a module without a source counts as the user's.
    """
    top = name.partition(".")[0]
    if top == PACKAGE or top in sys.stdlib_module_names:
        return True
    file = source_file(top) or source_file(name)
    if file is None:
        return False
    with suppress(Exception):  # paths and damaged metadata may raise anything
        resolved = file.resolve()
        if not _LIBRARIES.isdisjoint(file.parts + resolved.parts):
            return True
        return any(map(resolved.is_relative_to, _distributed(tuple(sys.path)).get(top, ())))
    return False


@cache
def _distributed(path: tuple[str, ...]) -> dict[str, set[Path]]:
    """List the folders of distributions' modules, by the topmost module, where no folder of libraries holds them."""
    folders: dict[str, set[Path]] = {}
    for distribution in metadata.distributions(path=list(path)):
        with suppress(Exception):
            folder = Path(str(distribution.locate_file("")))
            origin = json.loads(distribution.read_text("direct_url.json") or "{}")
            if origin.get("dir_info", {}).get("editable"):
                folder = Path(url2pathname(urlsplit(origin["url"]).path))
            elif not _LIBRARIES.isdisjoint(folder.parts):
                continue
            for module in _topmost_modules(distribution):
                folders.setdefault(module, set()).add(folder.resolve())
    return folders


def _topmost_modules(distribution: metadata.Distribution) -> set[str]:
    """List the topmost modules of a distribution, by its files, its list of them, and its own name."""
    listed = (distribution.read_text("top_level.txt") or "").split()
    name_as_module = distribution.name.replace("-", "_")
    entries = {file.parts[0] for file in distribution.files or ()}
    return {*listed, name_as_module} | {getmodulename(entry) or entry for entry in entries}
