"""Digests of code, which tell whether a stored result was computed by the present code.

    stored                               digest of                             after a change of that code
    -----------------------------------  ------------------------------------  -------------------------------------
    looks of fits and studies            what looking imports                  they are made anew
    (`semfov.runs.store`)                (`semfov.runs.looks.LOOK_SOURCES`)
    results of studies, parts of a fit   the package, and classes of a user    they are computed anew
    (`semfov.runs.scene_run`)            that run in it
    feature maps of viewed pictures      what looking, `semfov.human.viewing`  they are computed anew
    (`semfov.human.viewing`)             and `semfov.gaze.saliency` import
    models of gaze of folds, and scores  what `semfov.gaze.saliency` and       they are fitted and computed anew
    (`semfov.fit.gaze_folds`)            `semfov.fit.gaze_folds` import
    pictures that a stopped command has  the package                           the command refuses to go on, and says
    finished (`semfov.cli.results`)                                            which folder to remove

The first three also depend on the versions of libraries, and on the machine (`semfov.runs.store.versions`); adapted
models of gaze also on what `semfov.fit.gaze_adapted` imports. Comments and docstrings change no digest.
"""

import hashlib
import sys
import uuid
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

from semfov.io.modules import PACKAGE, belongs_to_others, source_file
from semfov.io.sources import keep_sources, read_source

_THIS_PROCESS = uuid.uuid4().hex


@cache
def package_digest() -> str:
    """Compute the digest of all modules of the package; comments and docstrings do not count.

    Returns:
        sha256 in hexadecimal digits.
    """
    return _digest(Path(__file__).parents[1].rglob("*.py"))


@cache
def modules_digest(*modules: str) -> str:
    """Compute the digest of modules of the package and every module of it that they import, directly or not.

    Args:
        modules: dotted names.

    Returns:
        sha256 in hexadecimal digits.
    """
    return _digest(_closure(modules, lambda name: _topmost(name) == PACKAGE))


def class_digest(kind: type) -> str:
    """Compute the digest of a user's class: its file, its bases' files, and the user's modules they import.

    Args:
        kind: the class; nothing is imported.

    Returns:
        sha256 in hexadecimal digits; for a class without a file a text that no other process has.
    """
    bases = [base for base in kind.__mro__ if base is kind or not belongs_to_others(base.__module__)]
    modules = [base.__module__ for base in bases]
    has_files = all(source_file(module) is not None for module in modules)
    if not has_files:
        return f"{kind.__qualname__}, process {_THIS_PROCESS}"
    packages = {_topmost(module) for module in modules} - {PACKAGE}

    def is_users(module: str) -> bool:
        """Tell whether a module is of the packages of the class, or at least of no installed one."""
        return _topmost(module) in packages or not belongs_to_others(module)

    files = _closure(modules, is_users)
    return hashlib.sha256(f"{kind.__qualname__} {_digest(files)}".encode()).hexdigest()


def _topmost(name: str) -> str:
    """Name the package that a module lies in, or the module itself."""
    return name.partition(".")[0]


def _closure(modules: Iterable[str], belongs: Callable[[str], bool]) -> set[Path]:
    """Find the files of modules and of every module that they import, directly or not, and that belongs to them."""
    files: set[Path] = set()
    visited: set[str] = set()
    single_files: set[str] = set()  # modules that are no packages
    todo = list(modules)
    while todo:
        name = todo.pop()
        parent = name.rpartition(".")[0]
        # What is imported from a single file is a class or function. To look for its file would find none, and take
        # most of the time. (A few single files make modules all the same, as `os` makes `os.path`.)
        is_no_module = parent in single_files and name not in sys.modules
        if name in visited or is_no_module:
            continue
        visited.add(name)
        file = source_file(name)
        if file is None or file in files:
            continue
        files.add(file)
        is_package = file.name == "__init__.py"
        if not is_package:
            single_files.add(name)
        start_of_relative = name if is_package else parent
        for statement in read_source(file).imports:
            todo += filter(belongs, statement.modules(start_of_relative))
    return files


def _digest(files: Iterable[Path]) -> str:
    """Compute a sha256 over files, sorted by content: it does not depend on their folders and names."""
    digests = sorted(read_source(file).digest for file in files)
    keep_sources()
    return hashlib.sha256("".join(digests).encode()).hexdigest()
