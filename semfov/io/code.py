"""Digests of code, which tell whether a stored result was computed by the present code."""

import ast
import hashlib
import json
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from inspect import getmodulename
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

_PACKAGE = "semfov"
_THIS_PROCESS = uuid.uuid4().hex
_LIBRARIES = {"site-packages", "dist-packages"}


@cache
def package_digest() -> str:
    """Compute a sha256 over all modules of the package; comments and docstrings do not count."""
    return _digest(Path(__file__).parents[1].rglob("*.py"))


@cache
def modules_digest(*modules: str) -> str:
    """Compute a sha256 over modules of the package and every module of it that they import, directly or not."""
    return _digest(_closure(modules, lambda name: name.partition(".")[0] == _PACKAGE))


def class_digest(kind: type) -> str:
    """Digest of a user's class: its file, its bases' files, and the user's modules they import; imports none."""
    modules = [str(base.__module__) for base in kind.__mro__ if not _of_others(base.__module__) or base is kind]
    if any(_file(module) is None for module in modules):
        return f"{kind.__qualname__}, process {_THIS_PROCESS}"
    own = {module.partition(".")[0] for module in modules} - {_PACKAGE}
    files = _closure(modules, lambda name: name.partition(".")[0] in own or not _of_others(name))
    return hashlib.sha256(f"{kind.__qualname__} {_digest(files)}".encode()).hexdigest()


def _closure(modules: Iterable[str], belongs: Callable[[str], bool]) -> set[Path]:
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
    return hashlib.sha256("".join(sorted(_parsed(_source(file))[0] for file in files)).encode()).hexdigest()


def _source(file: Path) -> bytes:
    """The content of a file; nothing where it cannot be read."""
    try:
        return file.read_bytes()
    except OSError:
        return b""


@cache
def _parsed(source: bytes) -> tuple[str, list[ast.Import | ast.ImportFrom]]:
    """sha256 of a syntax tree without docstrings, or of the source where Python cannot parse it; and its imports."""
    words: list[str] = []
    imports: list[ast.Import | ast.ImportFrom] = []
    with suppress(SyntaxError, ValueError, RecursionError, MemoryError):
        _spell(ast.parse(source), words, imports)
        source = "\n".join(words).encode()
    return hashlib.sha256(source).hexdigest(), imports


def _spell(part: object, words: list[str], imports: list[ast.Import | ast.ImportFrom]) -> None:
    """Append what a part of a syntax tree consists of, in order and without docstrings, and its imports."""
    if isinstance(part, ast.AST):
        words.append(type(part).__name__)
        for name in part._fields:
            _spell(getattr(part, name, None), words, imports)
        if isinstance(part, ast.Import | ast.ImportFrom):
            imports.append(part)
    elif isinstance(part, list):
        told = (line.value if isinstance(line, ast.Expr) else None for line in part)
        texts = [isinstance(each, ast.Constant) and isinstance(each.value, str) for each in told]
        lines = [line for line, text in zip(part, texts, strict=True) if not text]
        words.append(str(len(lines)))
        for line in lines:
            _spell(line, words, imports)
    else:
        words.append(repr(part))


def _imports(name: str, file: Path) -> Iterator[str]:
    """Dotted names of all imports in a module, at any depth; `from a import b` gives both `a` and `a.b`."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in _parsed(_source(file))[1]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        else:
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _file(name: str) -> Path | None:
    """The source file of a module; None where the module does not exist or has no source."""
    origin = _found(name)[0]
    with suppress(OSError, ValueError):
        path = Path(origin) if isinstance(origin, str) else None
        return path if path is not None and path.suffix == ".py" and path.is_file() else None
    return None


def _found(name: str) -> tuple[str | None, Iterable[str]]:
    """The source of a module and the folders of its submodules; neither it nor its parents are imported."""
    parent, _, last = name.rpartition(".")
    try:
        if name in sys.modules:
            # Not by `getattr`, which makes a module that loads lazily load.
            known = object.__getattribute__(sys.modules[name], "__dict__")
            return known.get("__file__"), known.get("__path__") or ()
        if not parent:
            spec = find_spec(name)
            return (None, ()) if spec is None else (spec.origin, spec.submodule_search_locations or ())
        folders = [Path(folder) / last for folder in _found(parent)[1]]
        sources = [file for each in folders for file in (each / "__init__.py", each.with_name(f"{last}.py"))]
        return next((str(file) for file in sources if file.is_file()), None), [str(folder) for folder in folders]
    except Exception:  # finders and loaded modules are others' code, and may raise anything
        return None, ()


def _of_others(name: str) -> bool:
    """Whether a module belongs to Python, to a library or to this package: not to the user."""
    top = name.partition(".")[0]
    if top == _PACKAGE or top in sys.stdlib_module_names:
        return True
    file = _file(top) or _file(name)
    if file is None:
        return False
    with suppress(Exception):  # paths and damaged metadata may raise anything
        whole = file.resolve()
        if not _LIBRARIES.isdisjoint(file.parts + whole.parts):
            return True
        return any(map(whole.is_relative_to, _distributed(tuple(sys.path)).get(top, ())))
    return False


@cache
def _distributed(path: tuple[str, ...]) -> dict[str, set[Path]]:
    """The folders of distributions' modules, by the topmost module, where they are not in a folder of libraries."""
    found: dict[str, set[Path]] = {}
    for each in metadata.distributions(path=list(path)):
        with suppress(Exception):
            folder = Path(str(each.locate_file("")))
            origin = json.loads(each.read_text("direct_url.json") or "{}")
            if origin.get("dir_info", {}).get("editable"):
                folder = Path(url2pathname(urlsplit(origin["url"]).path))
            elif not _LIBRARIES.isdisjoint(folder.parts):
                continue
            tops = {file.parts[0] for file in each.files or ()}
            names = {*(each.read_text("top_level.txt") or "").split(), each.name.replace("-", "_")}
            for name in names | {getmodulename(top) or top for top in tops}:
                found.setdefault(name, set()).add(folder.resolve())
    return found
