"""Do word vectors find the class that a description means? `python -m benchmarks.descriptions --embeddings FILE`.

Other names of COCO's classes (`semfov.data.classes`) serve as descriptions whose class is known. The first table gives
how often the class is among the nearest ones. The second gives the mean log probability of the right class by the
temperature of `semfov.data.spread`. Names that share a word with their class and names with several classes are left
out.
"""

import argparse
from inspect import signature
from pathlib import Path

import torch

from benchmarks.tables import table
from semfov.data.classes import _SYNONYMS, _TABLE, _other_numbers, _plain_key
from semfov.data.word_vectors import WordVectors, _words_of, spread
from semfov.detection.class_names import COCO_CLASSES

NEAREST = (1, 3, 5, 10)
TEMPERATURES = (0.04, 0.06, 0.08, 0.1, 0.15)


def alike(name: str) -> list[int]:
    """Numbers of the classes that a name stands for: in another spelling or, where there is none, as a synonym."""
    key, keys = _plain_key(name), [_plain_key(other) for other in COCO_CLASSES]
    forms = {key, *_other_numbers(key)}
    same = [place for place, other in enumerate(keys) if other in forms or key in _other_numbers(other)]
    return same or [place for place, other in enumerate(keys) if other in map(_plain_key, _SYNONYMS.get(key, ()))]


def cases() -> list[tuple[str, int]]:
    """Other names, each with the index of its class."""
    others = dict(line.split(": ") for line in _TABLE.strip().splitlines())
    pairs = [(each, alike(each)) for name in COCO_CLASSES for each in others.get(name, "").split(", ") if each]
    return [
        (other, places[0])
        for other, places in pairs
        if len(places) == 1 and not set(_words_of(other)) & set(_words_of(COCO_CLASSES[places[0]]))
    ]


def main() -> None:
    """Measure, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--embeddings", type=Path, required=True, help="file of word vectors in the text format of GloVe or word2vec"
    )
    path = parser.parse_args().embeddings
    pairs = cases()
    vectors = WordVectors.read(path, [*COCO_CLASSES, *(other for other, _ in pairs)])
    comparable = [(other, place) for other, place in pairs if vectors.knows(other)]
    near = vectors.similarity([other for other, _ in comparable], COCO_CLASSES).nan_to_num(-1)
    right = torch.tensor([place for _, place in comparable])
    rank = (near >= near.gather(1, right[:, None])).sum(1)
    missing = ", ".join(vectors.missing) or "none"
    print(f"{len(comparable)} other names of COCO's classes, {path.name}; words without a vector: {missing}\n")
    shares = [f"{100 * float((rank <= count).double().mean()):.1f}" for count in NEAREST]
    print(table(["", *(f"among the nearest {count}, %" for count in NEAREST)], [["right class", *shares]]))
    chances = [(near / t).log_softmax(-1).gather(1, right[:, None]).mean() for t in TEMPERATURES]
    used = signature(spread).parameters["temperature"].default
    head = [f"{t:g}{' (used)' if t == used else ''}" for t in TEMPERATURES]
    print("", table(["temperature", *head], [["log probability", *(f"{float(c):.3f}" for c in chances)]]), sep="\n")


if __name__ == "__main__":
    main()
