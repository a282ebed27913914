"""Digests of code, which tell whether a stored result was computed by the present code."""

from __future__ import annotations

import ast
import hashlib
import subprocess
import sys
import sysconfig
import uuid
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_PACKAGE = "semfov"
_THIS_PROCESS = uuid.uuid4().hex
_LIBRARIES = tuple(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "purelib", "platlib"))


@cache
def package_digest() -> str:
    """Compute a sha256 over all modules of the package; comments and docstrings do not count.

    >>> len(package_digest())
    64
    """
    return _digest(Path(__file__).parents[1].rglob("*.py"))


@cache
def modules_digest(*modules: str) -> str:
    """Compute a sha256 over modules of the package and every module of it that they import, directly or not.

    >>> modules_digest("semfov.errors") == modules_digest("semfov.io.files")
    False
    """
    return _digest(closure(modules, lambda name: name.partition(".")[0] == _PACKAGE))


def class_digest(kind: type) -> str:
    """Compute a digest of the code of a user's class: its file, its bases' files, and the user's modules they import.

    Installed libraries do not count, and this package does not either: it has `package_digest`. A class that was typed
    into an interpreter has no file, so its digest is valid in this process only.
    """
    modules = [base.__module__ for base in kind.__mro__ if not _of_others(base.__module__) or base is kind]
    if any(_file(module) is None for module in modules):
        return f"{kind.__qualname__}, process {_THIS_PROCESS}"
    own = {module.partition(".")[0] for module in modules} - {_PACKAGE}
    files = closure(modules, lambda name: name.partition(".")[0] in own or not _of_others(name))
    return hashlib.sha256(f"{kind.__qualname__} {_digest(files)}".encode()).hexdigest()


def closure(modules: Iterable[str], belongs: Callable[[str], bool]) -> set[Path]:
    """Find the files of modules and of every module that they import, directly or not."""
    files: dict[Path, None] = {}
    todo = list(modules)
    while todo:
        name = todo.pop()
        file = _file(name)
        if file is None or file in files:
            continue
        files[file] = None
        todo += [imported for imported in _imports(name, file) if belongs(imported)]
    return set(files)


def _digest(files: Iterable[Path]) -> str:
    """sha256 over files, sorted by content: it does not depend on their folders and names."""
    return hashlib.sha256("".join(sorted(map(_code, files))).encode()).hexdigest()


def _code(file: Path) -> str:
    """sha256 of a file's syntax tree without docstrings."""
    source = file.read_bytes()
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return hashlib.sha256(source).hexdigest()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_text(line: ast.AST) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)


def _imports(name: str, file: Path) -> Iterator[str]:
    """Dotted names of all imports in a module, at any depth; `from a import b` gives both `a` and `a.b`."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _file(name: str) -> Path | None:
    """The source file of a module; None where the module does not exist or has no source."""
    module = sys.modules.get(name)
    origin = getattr(module, "__file__", None)
    if module is None:
        try:
            spec = find_spec(name)
        except (ImportError, ValueError):
            return None
        origin = None if spec is None else spec.origin
    path = None if origin is None else Path(origin)
    return path if path is not None and path.suffix == ".py" and path.is_file() else None


def _of_others(name: str) -> bool:
    """Whether a module belongs to Python, to an installed library or to this package."""
    top = name.partition(".")[0]
    if top == _PACKAGE or top in sys.stdlib_module_names:
        return True
    file = _file(top) or _file(name)
    return file is not None and any(file.resolve().is_relative_to(folder) for folder in _LIBRARIES)


def commit() -> str | None:
    """Commit of the git checkout, followed by `+` if it has uncommitted changes; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
