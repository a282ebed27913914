"""Word vectors against numpy: both file formats, names of several words, and weights of classes for a description."""

import hashlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.data import WordVectors, spread
from semfov.data.word_vectors import _words_of
from tests.refusals import refused, unusable

VECTORS = np.random.default_rng(0).normal(size=(6, 5))
WORDS = ("cup", "wine", "glass", "drink", "cow", "Dog")


@pytest.fixture(params=["glove", "word2vec"])
def path(request, tmp_path):
    lines = [f"{word} {' '.join(map(repr, map(float, row)))}" for word, row in zip(WORDS, VECTORS, strict=True)]
    if request.param == "word2vec":
        lines.insert(0, f"{len(WORDS)} 5")
    file = tmp_path / "vectors.txt"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def test_only_requested_words_are_read_and_missing_ones_are_listed(path):
    words = WordVectors.read(path, ["Wine_Glass", "dog", "toaster oven"])
    assert set(words.vectors) == {"wine", "glass", "dog"}
    assert words.missing == ("oven", "toaster")
    assert words.digest == hashlib.sha256(path.read_bytes()).hexdigest()
    expected = (VECTORS[1] + VECTORS[2]) / 2
    np.testing.assert_allclose(words.vector("wine glass"), expected, rtol=1e-5)
    # If only some words of a name are known, their mean is used.
    half = WordVectors.read(path, ["cow shed"])
    np.testing.assert_allclose(half.vector("cow shed"), VECTORS[4], rtol=1e-5)
    assert not words.knows("toaster")


def test_similarity_is_the_cosine(path):
    names, others = ["cup", "wine glass"], ["cow", "toaster", "drink"]
    got = WordVectors.read(path, [*names, *others]).similarity(names, others)
    rows = {"cup": VECTORS[0], "wine glass": VECTORS[1:3].mean(0), "cow": VECTORS[4], "drink": VECTORS[3]}
    for row, name in enumerate(names):
        for column, other in enumerate(others):
            if other not in rows:
                assert got[row, column].isnan()
                continue
            a, b = rows[name], rows[other]
            assert float(got[row, column]) == pytest.approx(a @ b / np.sqrt((a @ a) * (b @ b)), abs=1e-6)


def test_a_word_in_lower_case_has_priority(tmp_path):
    file = tmp_path / "vectors.txt"
    file.write_text("Turkey 1 0\nturkey 0 1\nTURKEY 1 1\n")
    assert WordVectors.read(file, ["turkey"]).vectors["turkey"].tolist() == [0, 1]


@given(st.floats(0.02, 1), st.integers(0, 2**31))
def test_weights_are_a_softmax_whose_largest_is_one(temperature, seed):
    generator = torch.Generator().manual_seed(seed)
    names = ("cup", "cow", "car", "cat")
    words = WordVectors({word: torch.randn(6, generator=generator) for word in (*names, "drink")})
    got = spread("something to drink", names, words, temperature=temperature, least=0.0)
    cosines = words.similarity(["drink"], names)[0]
    expected = (cosines / temperature).softmax(0)
    for name, weight in got.items():
        assert weight == pytest.approx(float(expected[names.index(name)] / expected.max()), rel=1e-4, abs=1e-12)
    assert list(got.values()) == sorted(got.values(), reverse=True)
    assert next(iter(got.values())) == 1
    few = spread("something to drink", names, words, temperature=temperature, least=0.5)
    assert few == {name: weight for name, weight in got.items() if weight >= 0.5}


@pytest.mark.parametrize(
    ("description", "words"),
    [("something to drink from", ["drink"]), ("Fire-Hydrant", ["fire", "hydrant"]), ("one of it", ["one", "of", "it"])],
)
def test_function_words_are_ignored_unless_there_are_no_others(description, words):
    assert _words_of(description) == words


def test_errors_name_the_file_line_or_argument(path, tmp_path):
    unusable(r"nothing\.txt", WordVectors.read, tmp_path / "nothing.txt", ["cup"])
    refused("zebra", WordVectors.read, path, ["zebra"])
    lines = path.read_text().splitlines()
    where = next(number for number, line in enumerate(lines) if line.startswith("cow"))
    for damaged in ("cow 1 2 3", "cow 1 2 3 4 x", "cow", "cow 1 2 3 4 nan"):
        path.write_text("\n".join([*lines[:where], damaged, *lines[where + 1 :]]))
        unusable(f"line {where + 1}: expected a word and 5 numbers", WordVectors.read, path, ["cup", "cow"])
    words = WordVectors({"cup": torch.ones(2)})
    refused("'zebra'", words.vector, "zebra")
    refused("target", spread, "a zebra", ["cup"], words)
    refused("classes", spread, "a cup", ["zebra"], words)
    for options, name in (({"temperature": 0.0}, "temperature"), ({"least": 2}, "least")):
        refused(name, spread, "cup", ["cup"], words, **options)
