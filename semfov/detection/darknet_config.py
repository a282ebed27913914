"""Darknet configuration files: the sections that describe a network, layer by layer."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

from semfov.errors import DataError
from semfov.io.files import check_regular
from semfov.io.schema import excerpt

_MOST_BYTES = 2**20


@dataclass(frozen=True)
class Section:
    """One `[kind]` section of a cfg: a layer, or `[net]`, which comes first.

    Attributes:
        kind: the name in brackets.
        options: keys and values as written.
        where: file and line, for error messages.

    >>> Section("yolo", {"mask": "1,2,3"}).integers("mask")
    (1, 2, 3)
    """

    kind: str
    options: Mapping[str, str] = field(default_factory=dict)
    where: str = "cfg"

    def text(self, key: str, default: str | None = None) -> str:
        """The value of `key` as text; a key without a default is required."""
        value = self.options.get(key, default)
        if value is None:
            raise DataError(f"{self.where}: [{self.kind}] expected the key {key!r}, which is missing")
        return value

    def integers(self, key: str, default: str | None = None) -> tuple[int, ...]:
        """The value of `key` as a list of whole numbers."""
        try:
            return tuple(int(part) for part in self._entries(key, default))
        except ValueError as error:
            raise self._refuse(key, "whole numbers") from error

    def numbers(self, key: str, default: str | None = None) -> tuple[float, ...]:
        """The value of `key` as a list of numbers."""
        try:
            numbers = tuple(float(part) for part in self._entries(key, default))
        except ValueError as error:
            raise self._refuse(key, "numbers") from error
        if not all(map(math.isfinite, numbers)):
            raise self._refuse(key, "finite numbers")
        return numbers

    def integer(self, key: str, default: int | None = None, *, minimum: int = 1) -> int:
        """The value of `key` as one whole number, at least `minimum`."""
        values = self.integers(key, None if default is None else str(default))
        if len(values) != 1 or values[0] < minimum:
            raise self._refuse(key, f"one whole number of at least {minimum}")
        return values[0]

    def _entries(self, key: str, default: str | None) -> list[str]:
        return [part for part in self.text(key, default).split(",") if part.strip()]

    def _refuse(self, key: str, expected: str) -> DataError:
        return DataError(
            f"{self.where}: [{self.kind}] {key}: expected {expected}, got {excerpt(self.options.get(key))}"
        )


def parse_cfg(text: str, source: str = "cfg") -> list[Section]:
    r"""Parse the text of a cfg.

    Lines are `[kind]`, `key=value`, comments (`#` or `;`) or blank. Where a key is repeated in a section, the first
    value counts, as in Darknet.

    Args:
        text: the text.
        source: name of the file, for messages.

    Returns:
        The sections in the order of the text.

    Raises:
        DataError: a line is none of these.

    >>> [s.kind for s in parse_cfg("[net]\nwidth=416\n\n[maxpool]\nsize=2")]
    ['net', 'maxpool']
    """
    sections: list[Section] = []
    options: dict[str, str] = {}
    for number, raw in enumerate(text.splitlines(), start=1):
        line = "".join(raw.split())
        where = f"{source}:{number}"
        if not line or line[0] in "#;":
            continue
        if line[0] == "[" and line[-1] == "]":
            options = {}
            sections.append(Section(line[1:-1], options, where))
        elif "=" in line and sections:
            key, _, value = line.partition("=")
            options.setdefault(key, value)
        else:
            raise DataError(f"{where}: expected [section] or key=value, got {raw.strip()[:60]!r}")
    return sections


def read_cfg(path: str | PathLike[str]) -> list[Section]:
    """Read the sections of a cfg file."""
    check_regular(path)
    try:
        if Path(path).stat().st_size > _MOST_BYTES:
            size = Path(path).stat().st_size
            raise DataError(f"{str(path)!r}: expected a cfg of at most {_MOST_BYTES:,} bytes, got {size:,}")
        return parse_cfg(Path(path).read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise DataError(f"cannot read the cfg {str(path)!r}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{str(path)!r}: expected a Darknet cfg, got a file that is not text") from error
