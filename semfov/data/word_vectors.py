"""Vectors of words, from a file in GloVe's or word2vec's text format, and how near names are to each other by them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from semfov.data.classes import canonical_name
from semfov.errors import DataError, InputError, check, check_number
from semfov.io.files import check_regular, sha256

_LONGEST = 1 << 20  # characters of a line
_LITTLE = """
a an the some any this that these those it its you your i my me we us one ones someone something anything thing things
object objects item items kind kinds sort type of to in on at for from with by as into onto and or is are be was can
could would will may might must do does which what where who when how
"""
_EMPTY = frozenset(_LITTLE.split())
"""Words of a description that stand in every other one."""

TEMPERATURE = 0.08
"""Of `spread`: chosen on other names of COCO's classes (docs/words.md)."""


class WordVectors:
    """Vectors of the words that are asked for, of all that a file has.

    A name of several words has the mean of the vectors of those that are known.

    Args:
        vectors: `(D,)` by word, in lower case.
        missing: words that were asked for and are not among them.
        digest: sha256 of the file.

    >>> words = WordVectors({"wine": torch.tensor([1.0, 0.0]), "glass": torch.tensor([0.0, 1.0])})
    >>> words.vector("wine glass")
    tensor([0.5000, 0.5000])
    """

    def __init__(self, vectors: Mapping[str, Tensor], missing: Sequence[str] = (), digest: str = "") -> None:
        self.vectors, self.missing, self.digest = dict(vectors), tuple(missing), digest

    @classmethod
    def read(cls, path: str | PathLike[str], names: Iterable[str]) -> Self:
        """The vectors of all words in some names.

        Args:
            path: text, a word and its vector a line, with or without word2vec's first line of two numbers.
            names: names and descriptions; what else the file has is passed over.

        Raises:
            DataError: the file is missing, or a line of it is no word with a vector as long as the others.
            InputError: it has none of the words.
        """
        wanted = sorted({word for name in names for word in words_of(name)})
        check_regular(path)
        found: dict[str, Tensor] = {}
        try:
            with Path(path).open(encoding="utf-8", errors="replace", newline="\n") as file:
                _read(iter(lambda: file.readline(_LONGEST), ""), set(wanted), found, str(path))
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
        check(bool(found), "embeddings", f"a file with some of the words {', '.join(wanted)}", f"{path} with none")
        return cls(found, [word for word in wanted if word not in found], sha256(Path(path)))

    def vector(self, name: str) -> Tensor:
        """Mean vector of a name's words, `(D,)`.

        Raises:
            InputError: none of them is known.
        """
        known = [self.vectors[word] for word in words_of(name) if word in self.vectors]
        check(bool(known), "name", "a name of which a word is in the file of vectors", repr(name))
        return torch.stack(known).mean(0)

    def knows(self, name: str) -> bool:
        """Whether a word of a name has a vector."""
        return any(word in self.vectors for word in words_of(name))

    def similarity(self, names: Sequence[str], others: Sequence[str]) -> Tensor:
        r"""Cosine of the angle between names, `(M, N)`: :math:`u \cdot v / \lVert u \rVert \lVert v \rVert`.

        Names of which no word is known are NaN.
        """
        first, second = (self._unit(group) for group in (names, others))
        return first @ second.mT

    def _unit(self, names: Sequence[str]) -> Tensor:
        size = len(next(iter(self.vectors.values())))
        unknown = torch.full((size,), torch.nan, dtype=torch.float64)
        rows = [self.vector(name).double() if self.knows(name) else unknown for name in names]
        stacked = torch.stack(rows) if rows else torch.empty(0, size, dtype=torch.float64)
        return stacked / stacked.norm(dim=-1, keepdim=True)


def words_of(name: str) -> list[str]:
    """The words of a name or of a description that mean something by themselves.

    >>> words_of("Wine_Glass"), words_of("something to drink from")
    (['wine', 'glass'], ['drink'])
    """
    words = re.findall(r"[^\W_]+(?:'[^\W_]+)?", canonical_name(name))
    return [word for word in words if word not in _EMPTY] or words


def spread(
    description: str,
    classes: Sequence[str],
    vectors: WordVectors,
    *,
    temperature: float = TEMPERATURE,
    least: float = 0.1,
) -> dict[str, float]:
    r"""Which classes a description may mean, each with a weight, the likeliest first.

    .. math:: w_k = e^{(\cos(d, k) - \max_j \cos(d, j)) / T}

    Args:
        description: words such as `something to drink from`.
        classes: names of the detector's classes.
        vectors: of the words of both.
        temperature: T.
        least: classes of a smaller weight are left out.

    Raises:
        InputError: no word of the description, or none of the classes, is known.

    >>> vectors = {"drink": [1.0, 0.1], "cup": [1.0, 0.2], "bottle": [1.0, 0.5], "cow": [-1.0, 1.0]}
    >>> words = WordVectors({word: torch.tensor(vector) for word, vector in vectors.items()})
    >>> {name: round(weight, 2) for name, weight in spread("to drink from", ["cow", "bottle", "cup"], words).items()}
    {'cup': 1.0, 'bottle': 0.47}
    """
    check_number(least, "least", 0, 1)
    check(0 < temperature < math.inf, "temperature", "a number above 0", temperature)
    if not vectors.knows(description):
        raise InputError(
            f"target: expected a class, or a description of which a word is in the file of vectors, got {description!r}"
        )
    near = vectors.similarity([description], classes)[0]
    known = ~near.isnan()
    check(bool(known.any()), "classes", "some whose words are in the file of vectors", ", ".join(classes))
    weights = ((near - near[known].max()) / temperature).exp().nan_to_num(0)
    order = weights.argsort(descending=True, stable=True).tolist()
    return {classes[k]: float(weights[k]) for k in order if weights[k] >= least}


def _read(lines: Iterable[str], wanted: set[str], found: dict[str, Tensor], path: str) -> None:
    """Vectors of the wanted words among the lines."""
    size: int | None = None
    for number, line in enumerate(lines, 1):
        word, _, rest = line.strip().partition(" ")
        if number == 1 and word.isdigit() and rest.isdigit():
            size = int(rest)
            continue
        key = word.lower()
        # A word in lower case is the word itself; in upper case it may be a name.
        if key not in wanted or (key in found and word != key):
            continue
        try:
            values = [float(value) for value in rest.split()]
        except ValueError:
            values = []
        size = len(values) if size is None else size
        if not values or len(values) != size or not all(map(math.isfinite, values)):
            raise DataError(f"{path}, line {number}: expected a word and {size or 'some'} numbers, got {line[:60]!r}")
        found[key] = torch.tensor(values)
