"""Word vectors from files in GloVe's or word2vec's text format, and the similarity of names by them."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import IO, Self

import torch
from torch import Tensor

from semfov.data.classes import canonical_name
from semfov.errors import check, check_data, check_number
from semfov.io.files import reading, sha256

_LONGEST = 1 << 20  # characters of a line that are read at once
_COMMON = """
a an the some any this that these those it its you your i my me we us one ones someone something anything thing things
object objects item items kind kinds sort type of to in on at for from with by as into onto and or is are be was can
could would will may might must do does which what where who when how
"""
_IGNORED = frozenset(_COMMON.split())  # words of a description that are ignored because most descriptions have them
_TEMPERATURE = 0.08  # temperature of `spread`, chosen on synonyms of COCO's classes (docs/words.md)


class WordVectors:
    """Word vectors, and the vectors of names.

    The vector of a name with several words is the mean of the vectors of its known words.

    Args:
        vectors: vectors `(D,)` by word, in lower case.
        missing: words that were wanted and have no vector.
        digest: sha256 of the file that the vectors come from.

    >>> words = WordVectors({"wine": torch.tensor([1.0, 0.0]), "glass": torch.tensor([0.0, 1.0])})
    >>> words.vector("wine glass")
    tensor([0.5000, 0.5000])
    """

    def __init__(self, vectors: Mapping[str, Tensor], missing: Sequence[str] = (), digest: str = "") -> None:
        self.vectors = dict(vectors)
        self.missing = tuple(missing)
        self.digest = digest

    @classmethod
    def read(cls, path: str | PathLike[str], names: Iterable[str]) -> Self:
        """Read the vectors of the words in some names from a file.

        Args:
            path: a text file with a word and its vector on each line, with or without word2vec's first line of two
                numbers.
            names: names and descriptions whose words are wanted; other words of the file are skipped.

        Returns:
            The vectors of those words.

        Raises:
            DataError: the file is missing, or the line of a wanted word does not hold a vector of the common length.
            InputError: the file has none of the words.
        """
        wanted: set[str] = set()
        for name in names:
            wanted.update(_words_of(name))
        words = sorted(wanted)
        vectors = _read_vectors(Path(path), frozenset(words))
        expected = f"a file with vectors of some of the words {', '.join(words)}"
        check(bool(vectors), "embeddings", expected, f"{path}, which has none of them")
        missing = [word for word in words if word not in vectors]
        return cls(vectors, missing, sha256(Path(path)))

    def vector(self, name: str) -> Tensor:
        """Compute the mean vector of a name's words.

        Args:
            name: a name or a description.

        Returns:
            The vector, `(D,)`.

        Raises:
            InputError: none of the words has a vector.
        """
        vectors = [self.vectors[word] for word in _words_of(name) if word in self.vectors]
        check(bool(vectors), "name", "a name with at least one word in the file of word vectors", repr(name))
        return torch.stack(vectors).mean(0)

    def knows(self, name: str) -> bool:
        """Tell whether at least one word of a name has a vector.

        Args:
            name: a name or a description.

        Returns:
            Whether the name has a vector.
        """
        return any(word in self.vectors for word in _words_of(name))

    def similarity(self, names: Sequence[str], others: Sequence[str]) -> Tensor:
        r"""Compute the cosine similarity of names, :math:`u \cdot v / (\lVert u \rVert \lVert v \rVert)`.

        Args:
            names: M names.
            others: N names.

        Returns:
            Similarities `(M, N)`, NaN for names without a known word.
        """
        return self._units(names) @ self._units(others).mT

    def _units(self, names: Sequence[str]) -> Tensor:
        """Scale the vectors of names to length 1, `(n, d)`, NaN for names without one."""
        size = len(next(iter(self.vectors.values())))
        rows = torch.full((len(names), size), torch.nan, dtype=torch.float64)
        for row, name in zip(rows, names, strict=True):
            if self.knows(name):
                row.copy_(self.vector(name))
        return rows / rows.norm(dim=-1, keepdim=True)


def _read_vectors(path: Path, wanted: frozenset[str]) -> dict[str, Tensor]:
    """Read the vectors of some words in a file, `(D,)` by word; raises `DataError` for a line without one."""
    vectors: dict[str, Tensor] = {}
    size: int | None = None  # of the vectors, which the first one determines unless word2vec's first line tells it
    with reading(path), path.open(encoding="utf-8", errors="replace", newline="\n") as file:
        for number, line in enumerate(_lines(file), 1):
            word, _, rest = line.strip().partition(" ")
            is_header = number == 1 and word.isdigit() and rest.isdigit()  # number of words and size, by word2vec
            if is_header:
                size = int(rest)
                continue
            key = word.lower()
            # Of two spellings, the one in lower case counts: in upper case, a word may be a proper name.
            is_wanted = key in wanted and (word == key or key not in vectors)
            if not is_wanted:
                continue
            values = _numbers(rest)
            if size is None:
                size = len(values)
            _check_vector(values, size, f"{path}, line {number}", line)
            vectors[key] = torch.tensor(values)
    return vectors


def _check_vector(values: Sequence[float], size: int, where: str, line: str) -> None:
    """Raise `DataError` for a line whose numbers are no vector of the common size."""
    is_vector = len(values) == size > 0 and all(map(math.isfinite, values))
    check_data(is_vector, where, f"a word and {size or 'some'} numbers", f"{line[:60]!r}")


def _lines(file: IO[str]) -> Iterator[str]:
    """Read the lines of a file, longer ones in pieces: a file that is no text may be one line."""
    while line := file.readline(_LONGEST):
        yield line


def _numbers(text: str) -> list[float]:
    """Read numbers with spaces between them; none where there is something else."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _words_of(name: str) -> list[str]:
    """Split a name or a description into words, and leave out common words such as `the` and `something`."""
    words = re.findall(r"[^\W_]+(?:'[^\W_]+)?", canonical_name(name))
    return [word for word in words if word not in _IGNORED] or words


def spread(
    description: str,
    classes: Sequence[str],
    vectors: WordVectors,
    *,
    temperature: float = _TEMPERATURE,
    least: float = 0.1,
) -> dict[str, float]:
    r"""Find the classes that a description may mean, with a weight for each.

    The weight of class k for a description d falls off with their cosine similarity:

    .. math:: w_k = e^{(\cos(d, k) - \max_j \cos(d, j)) / T}

    Args:
        description: words such as `something to drink from`.
        classes: names of the detector's classes.
        vectors: vectors of the words of description and classes.
        temperature: T.
        least: smallest weight; classes with a smaller weight are left out.

    Returns:
        Weights by class, largest first; the largest weight is 1.

    Raises:
        InputError: no word of the description, or of all the classes, has a vector.

    >>> vectors = {"drink": [1.0, 0.1], "cup": [1.0, 0.2], "bottle": [1.0, 0.5], "cow": [-1.0, 1.0]}
    >>> words = WordVectors({word: torch.tensor(vector) for word, vector in vectors.items()})
    >>> {name: round(weight, 2) for name, weight in spread("to drink from", ["cow", "bottle", "cup"], words).items()}
    {'cup': 1.0, 'bottle': 0.47}
    """
    check_number(least, "least", 0, 1)
    check(0 < temperature < math.inf, "temperature", "a number above 0", temperature)
    expected = "a class, or a description with at least one word in the file of word vectors"
    check(vectors.knows(description), "target", expected, repr(description))
    similarity = vectors.similarity([description], classes)[0]
    has_words = ~similarity.isnan()
    check(bool(has_words.any()), "classes", "classes with words in the file of word vectors", ", ".join(classes))
    largest = similarity[has_words].max()
    weights = ((similarity - largest) / temperature).exp().nan_to_num(0)  # classes without words have none
    order = weights.argsort(descending=True, stable=True).tolist()
    return {classes[index]: float(weights[index]) for index in order if weights[index] >= least}
