"""Sources of modules: a digest of what they compute, and the modules that they import.

A digest does not depend on comments and docstrings, so the syntax tree of each source is read, which takes a second for
the whole package. What was read is therefore kept between processes, by the sha256 of the source: a source with other
bytes has another key, and is read anew.
"""

import ast
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import NamedTuple

from semfov.errors import DataError
from semfov.io.files import cache_folder, write_text

_MOST_SOURCES = 4000  # sources that are kept, the latest ones: about ten versions of the package


class ImportStatement(NamedTuple):
    """An import statement: `import a, b` has names alone, and `from ..a import b` a module, a level of 2, and names.

    Attributes:
        names: what is imported.
        module: the module that it is imported from; empty where only dots name it, or nothing.
        level: number of dots of a relative import.
        is_from: whether it begins with `from`.
    """

    names: Sequence[str]
    module: str = ""
    level: int = 0
    is_from: bool = False

    def modules(self, package: str) -> Iterator[str]:
        """List the dotted names of what may be modules, a parent last; `from a import b` gives both `a.b` and `a`.

        Args:
            package: dotted name of the package of the module that has the statement.

        Returns:
            The names.
        """
        if not self.is_from:
            yield from self.names
            return
        with suppress(ImportError):  # of more dots than there are packages
            base = resolve_name("." * self.level + self.module, package)
            for name in self.names:
                yield f"{base}.{name}"
            yield base


class Source(NamedTuple):
    """Digest and imports of a source.

    Attributes:
        digest: sha256 of its syntax tree without docstrings; of its bytes where Python cannot parse it.
        imports: its import statements, at any depth.
    """

    digest: str
    imports: list[ImportStatement]


class _Spelling:
    """Spells a syntax tree: what it consists of, in order and without docstrings, and its imports."""

    def __init__(self) -> None:
        self.words: list[str] = []
        self.imports: list[ImportStatement] = []

    def spell(self, part: object) -> None:
        """Append a part of a syntax tree: a node, a list of nodes, or a name or a constant."""
        if isinstance(part, ast.AST):
            self._spell_node(part)
        elif isinstance(part, list):
            self._spell_list(part)
        else:
            self.words.append(repr(part))

    def _spell_node(self, node: ast.AST) -> None:
        """Append a node with all its fields, and its imports."""
        self.words.append(type(node).__name__)
        for name in node._fields:
            self.spell(getattr(node, name, None))
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
            self.imports.append(ImportStatement(names))
        elif isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
            self.imports.append(ImportStatement(names, node.module or "", node.level, is_from=True))

    def _spell_list(self, nodes: list[object]) -> None:
        """Append a list without its docstrings, after its length: else `[[a], b]` and `[[a, b]]` would read alike."""
        lines = [node for node in nodes if not _is_text(node)]
        self.words.append(str(len(lines)))
        for line in lines:
            self.spell(line)


def _is_text(line: object) -> bool:
    """Tell whether a line of code is a text alone, such as a docstring."""
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)


def _parse(source: bytes) -> Source:
    """Read a source from its syntax tree."""
    spelling = _Spelling()
    spelled = source
    with suppress(SyntaxError, ValueError, RecursionError, MemoryError):
        spelling.spell(ast.parse(source))
        spelled = "\n".join(spelling.words).encode()
    return Source(hashlib.sha256(spelled).hexdigest(), spelling.imports)


class _Kept:
    """The sources that were read, kept in a file of the user's cache.

    Invariant: each entry of `_sources` is what `_parse` reads from the source with that sha256. Another version of
    Python or of this module may read otherwise, and has a file of another name. Where the cache cannot be written,
    every process reads the sources itself.
    """

    def __init__(self) -> None:
        self._sources: dict[str, Source] = {}
        self._is_written = True  # whether the file has all entries
        reader = hashlib.sha256(sys.version.encode() + Path(__file__).read_bytes()).hexdigest()
        self._file: Path | None = None
        with suppress(DataError):
            self._file = cache_folder() / "code" / f"{reader[:16]}.json"
            self._load(self._file)

    def _load(self, file: Path) -> None:
        """Take the entries of the file; none where it is missing or damaged."""
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            entries = json.loads(file.read_bytes())
            for key, (digest, imports) in entries.items():
                self._sources[key] = Source(digest, [ImportStatement(*line) for line in imports])

    def read(self, source: bytes) -> Source:
        """Take a source from the entries, or parse it."""
        key = hashlib.sha256(source).hexdigest()
        if key not in self._sources:
            self._sources[key] = _parse(source)
            self._is_written = False
        return self._sources[key]

    def write(self) -> None:
        """Write the entries, if there are new ones."""
        if self._is_written or self._file is None:
            return
        self._is_written = True
        latest = list(self._sources.items())[-_MOST_SOURCES:]
        with suppress(DataError):  # a full disk, or no permission
            write_text(self._file, json.dumps(dict(latest)))


@cache
def _kept() -> _Kept:
    return _Kept()


def read_source(file: Path) -> Source:
    """Read what the source in a file computes and imports.

    Args:
        file: the file; one that cannot be read counts as empty.

    Returns:
        What it computes and imports.
    """
    try:
        content = file.read_bytes()
    except OSError:
        content = b""
    return _kept().read(content)


def keep_sources() -> None:
    """Store the digests and imports of sources, for later processes."""
    _kept().write()
