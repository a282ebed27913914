"""Comparison of one scanpath with people's scanpaths in the same picture, by the measures of this folder."""

from collections.abc import Callable, Iterable, Sequence, Sized
from functools import partial
from os import PathLike
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations import Fixations
from semfov.data.fixations.record import bare_name, inside_frame
from semfov.errors import check, type_of
from semfov.human.fixations.reading import check_usual_frame, read_fixations
from semfov.human.fixations.suspicions import check_viewed, warn_of_frames
from semfov.human.scanpath.alignment import dynamic_time_warping, multimatch, scanmatch, time_delay_embedding
from semfov.human.scanpath.maps import auc, auc_judd, correlation, kullback_leibler, log_likelihood, nss, similarity
from semfov.human.scanpath.saccades import direction_distance, length_distance, saccades
from semfov.human.scanpath.sequence import cell_labels, edit_distance, sequence_score
from semfov.paths import GazePrediction, Record

_CELLS = 8  # rows and columns of the grid whose cells are the words of a scanpath
_LONGEST = 64  # pixels along the longer side of a map of fixations
_BLUR = 0.03  # standard deviation of the Gaussian around a fixation, in longer sides of the picture

_DIMENSIONS = ("shape", "direction", "length", "position")  # of MultiMatch, those that need no durations

_Points = NDArray[np.float64]
_Measure = Callable[[_Points, Sequence[_Points]], float]
"""Compares the fixations of one scanpath with those of others."""
_ScoreInMap = Callable[[_Points, _Points, _Points], NDArray[np.float64]]
"""Scores fixations, by their x and y, in a map."""

_Words = TypeVar("_Words", bound=Sized)  # what a scanpath is compared as


class BesidePeople(NamedTuple):
    """The value of one measure for a scanpath, and for people.

    Attributes:
        scanpath: of the scanpath against each person, on average.
        people: of each person against each other person, on average; NaN for a single person.

    >>> BesidePeople(0.5, 0.75).people
    0.75
    """

    scanpath: float
    people: float


class ScanpathComparison(dict[str, BesidePeople]):
    """Measures between a scanpath and people, and between people, by name; printed as a table.

    >>> print(ScanpathComparison({"AUC": BesidePeople(0.85, 0.9)}))
    measure  scanpath  people
    AUC          0.85    0.90
    """

    def __str__(self) -> str:
        """Print the measures as a table, and why some are missing."""
        width = max(map(len, ["measure", *self]))
        lines = [f"{'measure':{width}}  scanpath  people"]
        for name, (scanpath, people) in self.items():
            lines.append(f"{name:{width}}  {scanpath:8.2f}  {people:6.2f}")
        if np.isnan([*self.values()]).any():
            lines.append("nan: too few people (two for the last column), or too few fixations inside the picture")
        return "\n".join(lines)


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

    Fixations outside the picture are left out of the sequences and densities. Durations count in none of these
    measures; `multimatch` and `scanmatch` take them.

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
    if isinstance(scanpath, Fixations):
        ours = scanpath
        warn_of_frames("scanpath", [ours])
    else:
        ours = scanpath.as_fixations(viewed[0].picture)
    targets = sorted({fixations.target for fixations in (ours, *viewed) if fixations.target is not None})
    check(len(targets) <= 1, "people", "searches for one target", f"for {', '.join(map(repr, targets))}")
    size = viewed[0].size
    our_points = ours.resized(size).points
    their_points = [fixations.resized(size).points for fixations in viewed]
    comparison = ScanpathComparison()
    for name, measure in _Measures(size).by_name().items():
        of_people = _among_people(measure, their_points)
        comparison[name] = BesidePeople(measure(our_points, their_points), of_people)
    return comparison


def _among_people(measure: _Measure, people: Sequence[_Points]) -> float:
    """Compare each person with all others, on average; NaN for a single one."""
    if len(people) < 2:
        return float("nan")
    values = []
    for number, points in enumerate(people):
        others = [*people[:number], *people[number + 1 :]]
        values.append(measure(points, others))
    return _mean(values)


def _viewers(people: _People, picture: str | None, size: tuple[int, int]) -> list[Fixations]:
    """Take the fixations of people in a picture, and check them.

    Coordinates that do not look like those of their frame give a warning.

    Args:
        people: fixations, records, or a file of fixations, of which those in the picture are taken.
        picture: name of the picture; None for one without a name.
        size: `(width, height)` of the picture.

    Returns:
        The fixations of each person, in one picture.

    Raises:
        InputError: there are none, or some are of other pictures or of a frame with other proportions.
        DataError: the file cannot be read.
    """
    if isinstance(people, str | PathLike):
        viewed: list[Fixations] = _fixations_in_file(people, picture, size)
    else:
        viewed = _as_fixations(people, picture)
    check(len(viewed) > 0, "people", "fixations of at least one person", "none")
    pictures = sorted({fixations.picture for fixations in viewed})
    check(len(pictures) == 1, "people", "fixations in one picture (by_picture)", f"in {len(pictures)}")
    for fixations in viewed:
        check_viewed(fixations, "people", size, picture)
    return warn_of_frames("people", viewed, stacklevel=5)


def _fixations_in_file(path: str | PathLike[str], picture: str | None, size: tuple[int, int]) -> list[Fixations]:
    """Read the fixations of a file that are in a picture, whose name counts without folder and suffix.

    Args:
        path: the file.
        picture: name of the picture; None for one without a name.
        size: `(width, height)` of the picture.
    """
    check_usual_frame(path, "people", [size], "read_fixations(file, size=({width}, {height}))")
    table = read_fixations(path)
    if picture is None:
        return [*table]
    name = bare_name(picture)
    viewed = [fixations for fixations in table if bare_name(fixations.picture) == name]
    check(len(viewed) > 0, "people", f"fixations in {name!r}", f"others, such as those in {table[0].picture!r}")
    return viewed


def _as_fixations(people: Fixations | Record | Sequence[Fixations | Record], picture: str | None) -> list[Fixations]:
    """Take fixations and records as fixations; a record without a source is of the same picture as the others."""
    entries = _entries(people)
    recorded = (entry.picture for entry in entries if isinstance(entry, Fixations))
    name = picture or next(recorded, "")
    viewed = []
    for entry in entries:
        fixations = entry.as_fixations(entry.source or name) if isinstance(entry, Record) else entry
        got = type_of(fixations)
        check(isinstance(fixations, Fixations), "people", "fixations, records of an agent, or a file", got)
        viewed.append(fixations)
    return viewed


def _entries(people: Fixations | Record | Sequence[Fixations | Record]) -> list[Fixations | Record]:
    """List the entries of a sequence; what is none is one entry, of which the caller sees whether it can be one."""
    # Fixations and records have a length, too, and can be gone through.
    if isinstance(people, Fixations | Record) or not isinstance(people, Iterable):
        return [people]
    return [*people]


class _Measures:
    """Measures of the points of a scanpath against those of several others, in a picture of `(width, height)`.

    A new measure is a function of a file beside this one, and a line of `by_name`.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.longer = max(size)

    def by_name(self) -> dict[str, _Measure]:
        """List the measures by name, in the order of the table."""
        of_multimatch = {f"MultiMatch {name}": partial(self._multimatch, name) for name in _DIMENSIONS}
        return of_multimatch | {
            "sequence score": partial(_averaged, sequence_score, self._words),
            "edit distance": partial(_averaged, _share_of_edits, self._words),
            "ScanMatch": partial(_averaged, self._scanmatch, self._inside),
            "time warping": partial(_averaged, self._warping, self._inside),
            "time delay embedding": partial(_averaged, self._embedding, self._inside),
            "saccade lengths": self._lengths,
            "saccade directions": self._directions,
            "NSS": partial(self._in_density, nss),
            "AUC": partial(self._in_density, auc),
        }

    def _inside(self, points: _Points) -> _Points:
        """Select the points inside the picture."""
        return points[inside_frame(points, np.array(self.size))]

    def _words(self, points: _Points) -> list[int]:
        """List the cells of the points inside the picture."""
        return [int(cell) for cell in cell_labels(self._inside(points), _CELLS, _CELLS, self.size)]

    def _multimatch(self, dimension: str, points: _Points, others: Sequence[_Points]) -> float:
        return _mean([getattr(multimatch(points, other, self.size), dimension) for other in others])

    def _scanmatch(self, one: _Points, other: _Points) -> float:
        return scanmatch(one, other, self.size)

    def _warping(self, one: _Points, other: _Points) -> float:
        return dynamic_time_warping(one, other) / self.longer

    def _embedding(self, one: _Points, other: _Points) -> float:
        return time_delay_embedding(one, other) / self.longer

    def _lengths(self, points: _Points, others: Sequence[_Points]) -> float:
        return length_distance(saccades([points])[0], saccades(others)[0]) / self.longer

    def _directions(self, points: _Points, others: Sequence[_Points]) -> float:
        return direction_distance(saccades([points])[1], saccades(others)[1])

    def _in_density(self, score: _ScoreInMap, points: _Points, others: Sequence[_Points]) -> float:
        """Score fixations in the density of the others."""
        columns, rows = (max(1, round(side * _LONGEST / self.longer)) for side in self.size)
        fixated = np.concatenate([self._inside(other) for other in others])
        density = _people_density(fixated, self.size, (rows, columns))
        # A person who is compared is not among the others, whose density would else know where they looked.
        x, y = _map_points(self._inside(points), self.size, (rows, columns)).T
        return _mean(score(density, x, y).tolist())


def _share_of_edits(one: list[int], other: list[int]) -> float:
    """Divide the edit distance by the length of the longer sequence."""
    return edit_distance(one, other) / max(len(one), len(other))


def _averaged(
    score: Callable[[_Words, _Words], float],
    convert: Callable[[_Points], _Words],
    points: _Points,
    others: Sequence[_Points],
) -> float:
    """Average a score of what a scanpath and each of the others are converted to, those of which something is left."""
    ours = convert(points)
    if not len(ours):
        return float("nan")
    return _mean([score(ours, theirs) for theirs in map(convert, others) if len(theirs)])


def _mean(values: Sequence[float]) -> float:
    """Average those of some values that are finite; NaN where there are none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


def _map_points(points: _Points, size: tuple[int, int], shape: tuple[int, ...]) -> _Points:
    """Convert points `(n, 2)` of a picture of `(width, height)` to pixels of a map of `(rows, columns)`."""
    return (points + 0.5) * (np.array(shape[::-1]) / np.array(size)) - 0.5


def _people_density(points: _Points, size: tuple[int, int], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Add up a Gaussian around each point.

    Args:
        points: `(n, 2)` in pixels of the picture.
        size: `(width, height)` of the picture.
        shape: `(rows, columns)` of the map.

    Returns:
        The map, not normalised.
    """
    rows, columns = (np.arange(side) for side in shape)
    x, y = _map_points(points, size, shape).T
    sigma = _BLUR * max(shape)
    twice_variance = 2 * sigma**2
    # A Gaussian is the product of one along the rows and one along the columns.
    of_columns = np.exp(-((columns[:, None] - x) ** 2) / twice_variance)  # (columns, n)
    of_rows = np.exp(-((rows[:, None] - y) ** 2) / twice_variance)  # (rows, n)
    return np.asarray(of_rows @ of_columns.T)


def compare_density(prediction: GazePrediction, people: _People) -> dict[str, float]:
    """Compare a density with people's fixations (without first ones), and with the blurred density of these.

    Args:
        prediction: the density.
        people: fixations of people in the same picture, as for `compare_scanpath`.

    Returns:
        The measures by name.

    Raises:
        InputError: there are no people, or none of their later fixations lies inside the picture.
        DataError: the file cannot be read.
    """
    viewed = _viewers(people, prediction.source, prediction.size)
    later = []
    for fixations in viewed:
        resized = fixations.resized(prediction.size)
        # The first fixation is where the trial begins, and not chosen by the picture.
        later.append(resized.points[1:][resized.inside[1:]])
    points = np.concatenate(later)
    check(len(points) > 0, "people", "fixations inside the picture after the first of each person", "none")
    cells = prediction.cells.double().numpy()  # (rows, columns), with sum 1
    x, y = _map_points(points, prediction.size, cells.shape).T
    people_density = _people_density(points, prediction.size, cells.shape)
    return {
        "NSS": float(nss(cells, x, y).mean()),
        "AUC": float(auc(cells, x, y).mean()),
        "AUC Judd": auc_judd(cells, x, y),
        "log likelihood": float(log_likelihood(np.log(cells), x, y).mean()),
        "CC": float(correlation(cells, people_density)),
        "SIM": float(similarity(cells, people_density)),
        "KL": float(kullback_leibler(people_density, cells)),
    }
