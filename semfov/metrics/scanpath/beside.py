"""One scanpath beside those of people in the same picture, by the measures of this folder."""

from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations import Fixations, read_fixations
from semfov.data.fixations.suspicions import check_viewed, warn_of_frames
from semfov.errors import check
from semfov.metrics.scanpath.alignment import dynamic_time_warping, multimatch, scanmatch, time_delay_embedding
from semfov.metrics.scanpath.maps import auc, auc_judd, correlation, kullback_leibler, log_likelihood, nss, similarity
from semfov.metrics.scanpath.saccades import direction_distance, length_distance, saccades
from semfov.metrics.scanpath.sequence import cell_labels, edit_distance, sequence_score
from semfov.paths import GazePrediction, Record

_CELLS = 8
_LONGEST = 64

_Points = NDArray[np.float64]
_Measure = Callable[[_Points, Sequence[_Points]], float]


class BesidePeople(NamedTuple):
    """A measure of a scanpath, and of people.

    Attributes:
        scanpath: of the scanpath against each person, on average.
        people: of each person against each other person, on average; NaN for a single person.

    >>> BesidePeople(0.5, 0.75).people
    0.75
    """

    scanpath: float
    people: float


class ScanpathComparison(dict[str, BesidePeople]):
    """Measures of a scanpath beside those of people, by name; printed as a table.

    >>> print(ScanpathComparison({"AUC": BesidePeople(0.85, 0.9)}))
    measure  scanpath  people
    AUC          0.85    0.90
    """

    def __str__(self) -> str:
        """The measures as a table, and why some are missing."""
        wide = max(map(len, ["measure", *self]))
        lines = [f"{name:{wide}}  {each.scanpath:8.2f}  {each.people:6.2f}" for name, each in self.items()]
        if np.isnan([*self.values()]).any():
            lines.append("nan: too few people (two for the last column), or too few fixations inside the picture")
        return "\n".join([f"{'measure':{wide}}  scanpath  people", *lines])


_People = Fixations | Record | Sequence[Fixations | Record] | str | PathLike[str]
"""Fixations of one person or several, records of agents, or a file (`semfov.data.fixations.read_fixations`)."""


def compare_scanpath(scanpath: Record | Fixations, people: _People) -> ScanpathComparison:
    """Compare a scanpath with those of people in the same picture, and the people with each other.

    - `MultiMatch shape`, `direction`, `length`, `position` (`multimatch`): 1 for equal scanpaths; NaN below three
      fixations.
    - `sequence score` (`sequence_score`): of the cells of an 8 × 8 grid in the order of the fixations, 0 to 1.
    - `edit distance` (`edit_distance`): of the same sequences, divided by the longer one; 0 for equal scanpaths.
    - `ScanMatch` (`scanmatch`): 1 for equal scanpaths.
    - `time warping` (`dynamic_time_warping`) and `time delay embedding` (`time_delay_embedding`), in longer sides of
      the picture; 0 for equal scanpaths.
    - `saccade lengths` (`length_distance`), in longer sides, and `saccade directions` (`direction_distance`), in
      radians: how far the distributions are apart.
    - `NSS` (`nss`) and `AUC` (`auc`): of the fixations in the density of all fixations of the others, blurred by a
      Gaussian of 3 % of the longer side. A person is compared with the density of the other people.

    Fixations outside the picture are left out of the sequences and densities.

    Args:
        scanpath: a record of an agent, or fixations.
        people: fixations of people (`semfov.data.fixations`) in the same picture, in any size of it, or the path of a
            file of them, of which those in the picture are taken.

    Returns:
        The measures by name.

    Raises:
        InputError: there are no people, their records are of several pictures, of another picture or target, or of a
            frame with other proportions, or rapidfuzz is not installed.
        DataError: the file cannot be read.

    >>> path = Fixations("a.jpg", "1", np.array([[10.0, 10], [60, 10], [60, 40]]), (80, 60))
    >>> compare_scanpath(path, [path])["sequence score"].scanpath
    1.0
    """
    picture = scanpath.picture if isinstance(scanpath, Fixations) else scanpath.source
    viewed = _viewers(people, picture, scanpath.size)
    ours = scanpath if isinstance(scanpath, Fixations) else scanpath.as_fixations(viewed[0].picture)
    if ours is scanpath:
        warn_of_frames("scanpath", [ours])
    targets = sorted({each.target for each in (ours, *viewed) if each.target is not None})
    check(len(targets) <= 1, "people", "searches for one target", f"for {', '.join(map(repr, targets))}")
    size = viewed[0].size
    mine, *theirs = [each.resized(size).points for each in (ours, *viewed)]
    comparison = ScanpathComparison()
    for name, measure in _measures(size).items():
        among = [measure(each, theirs[:n] + theirs[n + 1 :]) for n, each in enumerate(theirs)] if theirs[1:] else []
        comparison[name] = BesidePeople(measure(mine, theirs), _mean(among))
    return comparison


def _viewers(people: _People, picture: str | None, size: tuple[int, int]) -> list[Fixations]:
    """The fixations of people in a picture of `(width, height)`, checked; None is a picture without a name.

    Of a file those in the picture are taken. Coordinates that do not look like those of their frame give a warning.
    """
    if isinstance(people, str | PathLike):
        table = read_fixations(people)
        name = None if picture is None else Path(picture).stem
        people = [each for each in table if name is None or Path(each.picture).stem == name]
        check(len(people) > 0, "people", f"fixations in {name!r}", f"others, such as those in {table[0].picture!r}")
    people = [people] if isinstance(people, Fixations | Record) or not isinstance(people, Iterable) else [*people]
    named = picture or next((each.picture for each in people if isinstance(each, Fixations)), "")
    viewed = [each.as_fixations(each.source or named) if isinstance(each, Record) else each for each in people]
    others = [type(each).__name__ for each in viewed if not isinstance(each, Fixations)]
    check(not others, "people", "fixations, records of an agent, or a file", f"a {others[0]}" if others else "")
    check(len(viewed) > 0, "people", "fixations of at least one person", "none")
    pictures = sorted({each.picture for each in viewed})
    check(len(pictures) == 1, "people", "fixations in one picture (by_picture)", f"in {len(pictures)}")
    for each in viewed:
        check_viewed(each, "people", size, picture)
    return warn_of_frames("people", viewed, stacklevel=5)


def _measures(size: tuple[int, int]) -> dict[str, _Measure]:
    """Measures of points against those of several others, by name."""

    def inside(points: _Points) -> _Points:
        return points[Fixations("", "", points, size).inside]

    def words(points: _Points) -> list[int]:
        return [int(cell) for cell in cell_labels(inside(points), _CELLS, _CELLS, size)]

    def paired(score: Callable[[_Points, _Points], float]) -> _Measure:
        return lambda points, others: _mean([score(points, other) for other in others])

    def matched(dimension: str) -> _Measure:
        return paired(lambda one, other: float(getattr(multimatch(one, other, size), dimension)))

    def placed(score: Callable[[Any, Any], float], of: Callable[[_Points], Any] = inside) -> _Measure:
        def pair(one: _Points, other: _Points) -> float:
            a, b = of(one), of(other)
            return score(a, b) if len(a) and len(b) else float("nan")

        return paired(pair)

    def moved(score: Callable[[_Points, _Points], float], number: int, unit: float) -> _Measure:
        return lambda points, others: score(saccades([points])[number], saccades(others)[number]) / unit

    def mapped(score: Callable[..., NDArray[np.float64]]) -> _Measure:
        def whole(points: _Points, others: Sequence[_Points]) -> float:
            columns, rows = (max(1, round(side * _LONGEST / max(size))) for side in size)
            density = _people_density(np.concatenate([inside(other) for other in others]), size, (rows, columns))
            x, y = ((inside(points) + 0.5) * (np.array([columns, rows]) / np.array(size)) - 0.5).T
            return _mean(score(density, x, y).tolist())

        return whole

    return {
        **{f"MultiMatch {name}": matched(name) for name in ("shape", "direction", "length", "position")},
        "sequence score": placed(sequence_score, words),
        "edit distance": placed(lambda a, b: edit_distance(a, b) / max(len(a), len(b)), words),
        "ScanMatch": placed(lambda a, b: scanmatch(a, b, size)),
        "time warping": placed(lambda a, b: dynamic_time_warping(a, b) / max(size)),
        "time delay embedding": placed(lambda a, b: time_delay_embedding(a, b) / max(size)),
        "saccade lengths": moved(length_distance, 0, max(size)),
        "saccade directions": moved(direction_distance, 1, 1),
        "NSS": mapped(nss),
        "AUC": mapped(auc),
    }


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


_BLUR = 0.03


def _people_density(points: _Points, size: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float64]:
    """A map of `(rows, columns)`, a Gaussian of 3 % of its longer side around each point; points `(n, 2)`."""
    rows, columns = (np.arange(side) for side in shape)
    x, y = ((points + 0.5) * (np.array(shape[::-1]) / np.array(size)) - 0.5).T
    width = 2 * (_BLUR * max(shape)) ** 2
    across = np.exp(-((columns[:, None] - x) ** 2) / width)
    down = np.exp(-((rows[:, None] - y) ** 2) / width)
    return np.asarray(down @ across.T)


def compare_density(prediction: GazePrediction, people: _People) -> dict[str, float]:
    """Measures of a density against all fixations of people but their first ones, and against their blurred density."""
    viewed = _viewers(people, prediction.source, prediction.size)
    records = [each.resized(prediction.size) for each in viewed]
    points = np.concatenate([each.points[1:][each.inside[1:]] for each in records])
    check(len(points) > 0, "people", "fixations inside the picture after the first of each person", "none")
    cells = prediction.cells.double().numpy()
    ratio = np.array(cells.shape[::-1]) / np.array(prediction.size)
    x, y = ((points + 0.5) * ratio - 0.5).T
    theirs = _people_density(points, prediction.size, cells.shape)
    return {
        "NSS": float(nss(cells, x, y).mean()),
        "AUC": float(auc(cells, x, y).mean()),
        "AUC Judd": auc_judd(cells, x, y),
        "log likelihood": float(log_likelihood(np.log(cells), x, y).mean()),
        "CC": float(correlation(cells, theirs)),
        "SIM": float(similarity(cells, theirs)),
        "KL": float(kullback_leibler(theirs, cells)),
    }
