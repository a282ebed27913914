r"""Whether the coordinates of fixations were read correctly, judged by what the pictures show there.

People look at what is in a picture, so fixations that are read rightly lie where a model of fixations expects them *in
that picture*, and fixations that are read wrongly lie elsewhere. Each way to read a file, such as with y upwards, puts
its points at other places, and the places are compared by the particular density of each picture

.. math:: d_i(u) = \log_2 p_i(u) - \frac{1}{N - 1} \sum_{j \ne i} \log_2 p_j(u)

p is the density of fixations (`semfov.saliency.FixationDensity`) of picture i at the place u, in shares of the
picture's sides. What all pictures have in common, above all the bias to the centre, is not in d. So fixations of
another picture, or a reading that moves all points to the middle, gain nothing. The mean of d over the fixations of a
picture is its *fit* in bits.

     points of the file ──reading──► shares of the sides ──► d of the picture ──mean──► fit of each picture
                          y upwards, mirrored, …, moved by (x, y)         compared over the pictures, paired
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from semfov.data.fixations import Fixations
from semfov.errors import check
from semfov.human.picture_place import PicturePlace, best_place

_Array = NDArray[np.float64]

CONTENT_PICTURES = 40
"""Pictures whose densities are enough to tell; each costs a pass of a detector."""

FEWEST_PICTURES = 5
"""Pictures below which a fit cannot be told from chance."""

_FEWEST_FIXATIONS = 40
_SIDE = 100  # cells along each side of the particular densities: a share of 0.01
_FAINTEST = -8.0  # bits below uniform at which a density is cut off: a model is not sure of less

_STANDARD_ERRORS = 4.0
"""How many standard errors over the pictures a difference must have: many readings are tried."""

_LEAST_GAIN = 0.25  # bits by which another reading must fit better
_LEAST_GAIN_OF_PLACE = 1.0  # the same of a place that is searched for in four numbers
_TIE = 0.05  # bits by which a place that is found by small steps must fit better than a likelier one
_EXCHANGED = 2.0  # bits by which both of two pictures must fit better if their names were exchanged
_LEAST_FIT = 0.5  # bits below which fixations do not fit their picture
_REACH = 20  # cells by which a shift is tried in each direction
_LEAST_SHIFT = 0.05  # share of a side below which a shift of all fixations is what models are off anyway
_LEAST_SHIFT_OF_SOME = 0.06  # the same of one person's or of later fixations, for what trackers are usually off


_Shares = Callable[[_Array, _Array, _Array], _Array]
"""Maps points `(n, 2)` in pixels of a frame, its size and the size of the picture to shares of the picture's sides."""


@dataclass(frozen=True)
class _Reading:
    """A way to read points.

    Attributes:
        shares: where the points lie.
        fault: what is wrong with the file if this reading is right, after *fixations look as if*.
        remedy: how the file is read rightly.
        frame_scale: how much larger than the file says the frame is.
    """

    shares: _Shares
    fault: str = ""
    remedy: str = ""
    frame_scale: float = 1.0


def _shares_as_read(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Place the largest picture that fits, with its proportions, in the middle of the frame."""
    scale = (frame / picture).min()
    corner = (frame - scale * picture) / 2
    return np.asarray((points + 0.5 - corner) / (scale * picture))


def _shares_y_upwards(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Count y from the lower border of the frame."""
    x, y = points.T
    upwards = np.stack([x, frame[1] - 1 - y], 1)
    return _shares_as_read(upwards, frame, picture)


def _shares_mirrored(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Count x from the right border of the frame."""
    x, y = points.T
    mirrored = np.stack([frame[0] - 1 - x, y], 1)
    return _shares_as_read(mirrored, frame, picture)


def _shares_half_turned(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Count both coordinates from the lower right corner of the frame."""
    return _shares_as_read(frame - 1 - points, frame, picture)


def _shares_swapped(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Take the first coordinate for y."""
    return _shares_as_read(points[:, ::-1], frame, picture)


def _shares_at_own_size(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Place the picture in the middle of the frame, pixel for pixel."""
    return np.asarray((points + 0.5 - (frame - picture) / 2) / picture)


def _shares_stretched(points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Stretch the picture over the whole frame."""
    return np.asarray((points + 0.5) / frame)


def _shares_at_part(part: float, points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Let the picture fill a part of what it could, in the middle of the frame."""
    return np.asarray((_shares_as_read(points, frame, picture) - 0.5) / part + 0.5)


def _shares_in_frame(scale: float, points: _Array, frame: _Array, picture: _Array) -> _Array:
    """Take the frame to have been larger or smaller than the file says."""
    return _shares_as_read(points / scale, frame, picture)


_PRESENT_READING = _Reading(_shares_as_read)

_AS_POINTS = _Reading(lambda points, frame, picture: points)  # for those who make shares of them

_PARTS = (0.4, 0.5, 0.6, 2 / 3, 0.75, 0.8, 0.85)
_FINER_SCALES = tuple(1 + step / 100 for step in range(-10, 11))
_FRAME_SCALES = (0.4, 0.5, 0.625, 0.75, 0.8, 1.25, 4 / 3, 1.5, 1.6, 1.875, 2.0, 2.4, 2.7)

_OTHER_AXES = (
    _Reading(_shares_y_upwards, "y ran upwards", "read them with origin='bottom left'"),
    _Reading(_shares_mirrored, "x ran from right to left", "take the width of the frame less x"),
    _Reading(_shares_half_turned, "they were turned by half a circle", "take the size of the frame less x and y"),
    _Reading(_shares_swapped, "y came before x", "swap the two columns"),
)

_NAMED_PLACES = (
    _Reading(_shares_at_own_size, "the pictures were shown at their own size", "use in_picture(size, scale=1)"),
    _Reading(
        _shares_stretched, "the pictures were stretched over the frame", "use in_picture(size, place=(0, 0, *frame))"
    ),
)

_PARTS_OF_FRAME = tuple(
    _Reading(
        partial(_shares_at_part, part),
        f"the pictures filled about {100 * part:.0f} % of the frame, in the middle",
        "give the place of the picture, in_picture(size, place=…)",
    )
    for part in _PARTS
)


def _in_frame(scale: float) -> _Reading:
    """Make the reading for a frame that was larger or smaller than the file says."""
    return _Reading(partial(_shares_in_frame, scale), "their frame had another size", frame_scale=scale)


_OTHER_FRAMES = tuple(_in_frame(scale) for scale in _FRAME_SCALES)

_OTHER_READINGS = (*_OTHER_AXES, *_NAMED_PLACES, *_PARTS_OF_FRAME, *_OTHER_FRAMES)


def content_suspicions(
    fixations: Sequence[Fixations],
    densities: Mapping[str, Tensor],
    sizes: Mapping[str, tuple[int, int]],
) -> list[str]:
    """Judge by the content of the pictures whether fixations were read correctly, and name the likely error.

    Frame, origin and axes, the size at which pictures were shown, their names, and a shift of the calibration are
    tested, for all fixations and for each person. The pictures should differ; ten or more tell much.

    Args:
        fixations: the records.
        densities: density of fixations in each picture, `(rows, columns)`, by the pictures' names.
        sizes: `(width, height)` of the pictures in pixels, by their names.

    Returns:
        The lines; none if nothing is suspicious, or if there are too few data.

    Raises:
        InputError: a density is not a map.

    >>> content_suspicions([], {}, {})
    []
    """
    records = [record for record in fixations if record.picture in densities and len(record)]
    names = sorted({record.picture for record in records})
    if len(names) < FEWEST_PICTURES or sum(map(len, records)) < _FEWEST_FIXATIONS:
        return []
    evidence = _Evidence(records, sizes, _particular_densities(names, densities))
    shift = _shift_of(evidence, records, "all fixations", _LEAST_SHIFT)
    reading = _better_reading(evidence)
    fit_of_shift = 0.0 if shift is None else shift.fit
    # A shift and another size of the frame look alike where few fixations lie at the borders.
    if reading is not None and reading.fit > fit_of_shift:
        return [reading.line]
    # Of pictures at a place that no reading comes close to, some fixations fit by a shift, too.
    elsewhere = _place_on_frame(evidence, fit_of_shift) or shift
    if elsewhere is not None:
        return [elsewhere.line]
    # A drift may be so large that the later fixations do not fit their pictures.
    return _wrong_names(evidence) or _misfit(evidence) or _shifts_of_some(evidence)


@dataclass(frozen=True)
class _Finding:
    """What is suspicious, in a line, and the fit in bits without it."""

    line: str
    fit: float


def _particular_densities(names: Sequence[str], densities: Mapping[str, Tensor]) -> dict[str, _Array]:
    """Compute d of each picture, `(_SIDE, _SIDE)`, row by row from the top left.

    Args:
        names: the pictures.
        densities: density of fixations in each, `(rows, columns)`.

    Returns:
        In bits: how much denser fixations are at a place of this picture than in the others.
    """
    logs = []
    for name in names:
        density = densities[name]
        check(density.ndim == 2, "densities", "a map (rows, columns) for each picture", tuple(density.shape))
        uniform = 1 / density.numel()
        ratio = density.detach().cpu().double() / uniform
        bits = ratio.log2().clamp(min=_FAINTEST)
        on_grid = interpolate(bits[None, None], size=(_SIDE, _SIDE), mode="bilinear")
        logs.append(on_grid[0, 0])
    stacked = torch.stack(logs)  # (N, _SIDE, _SIDE)
    mean_of_other_pictures = (stacked.sum(0) - stacked) / (len(logs) - 1)
    particular = stacked - mean_of_other_pictures
    return {name: density.numpy() for name, density in zip(names, particular, strict=True)}


class _BestShift(NamedTuple):
    """The shift with which records fit best.

    Attributes:
        shift: `(x, y)` in shares of the sides, `(2,)`.
        fits_before: the fits `(n,)` in bits of the pictures of these records without it.
        fits_after: the same with it.
    """

    shift: _Array
    fits_before: _Array
    fits_after: _Array


class _Evidence:
    """Fixations, and the particular densities of the pictures in which they were made.

    Attributes:
        records: the records of these pictures.
        names: the pictures.

    Private attributes: `_sizes` has `(width, height)` of each picture in pixels, and `_particular` its particular
    density, `(_SIDE, _SIDE)`.
    """

    def __init__(
        self, records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]], particular: Mapping[str, _Array]
    ) -> None:
        self.records = records
        self.names = list(particular)
        self._sizes = sizes
        self._particular = particular

    def fits(self, reading: _Reading) -> _Array:
        """Compute the fit of each picture in bits, `(N,)`."""
        places = self._places(self.records, reading)
        return np.array([self._fit(places[name], name) for name in self.names])

    def fit(self, reading: _Reading) -> float:
        """Compute the mean fit over the pictures in bits."""
        return float(self.fits(reading).mean())

    def fits_in_pictures(self) -> _Array:
        """Compute the fit of the fixations of picture i, as they are read, in picture j, `(N, N)`."""
        places = self._places(self.records, _PRESENT_READING)
        return np.array([self._fit_in_all(places[name]) for name in self.names])

    def _fit_in_all(self, places: _Array) -> list[float]:
        """Compute the fit of the fixations of one picture, `(n, 2)`, in each picture."""
        return [self._fit(places, picture) for picture in self.names]

    def best_shift(self, records: Sequence[Fixations]) -> _BestShift:
        """Find the shift with which some records fit best, all of them moved alike."""
        places = self._places(records, _PRESENT_READING)
        # Every picture counts the same, however many fixations it has.
        total = sum(_fit_by_shift(self._particular[name], places[name]) for name in places)
        row, column = np.unravel_index(int(np.argmax(total)), np.shape(total))
        shift = (np.array([column, row]) - _REACH) / _SIDE
        before = [self._fit(places[name], name) for name in places]
        after = [self._fit(places[name] + shift, name) for name in places]
        return _BestShift(shift, np.array(before), np.array(after))

    def place_near(self, reading: _Reading) -> PicturePlace | None:
        """Find where on the frame the pictures lay, near where a reading places them.

        Args:
            reading: one that keeps the directions of the axes.

        Returns:
            The place with the best fit, or one of the pictures' own size or proportions that fits as well; None where
            frames or pictures have several sizes, so that no place is theirs.
        """
        frames = {tuple(record.size) for record in self.records}
        pictures = {tuple(self._sizes[name]) for name in self.names}
        if len(frames) > 1 or len(pictures) > 1:
            return None
        frame = np.array(frames.pop(), np.float64)
        picture = np.array(pictures.pop(), np.float64)
        edges = np.stack([np.zeros(2), frame]) - 0.5  # corners of the frame, as points
        start, end = reading.shares(edges, frame, picture)
        sides = frame / (end - start)
        fit_of = partial(self._fit_at, self._places(self.records, _AS_POINTS))
        best = best_place(PicturePlace(-start * sides, sides), fit_of)
        own_size = best.resized(picture / best.sides)
        scale = np.sqrt(np.prod(best.sides / picture))
        own_proportions = own_size.resized(np.full(2, scale))
        # Pictures are seldom shown at another size than these without a reason.
        for likely in (own_size, own_proportions):
            if fit_of(best) - fit_of(likely) < _TIE:
                return likely
        return best

    def _fit_at(self, points: Mapping[str, _Array], place: PicturePlace) -> float:
        """Compute the mean fit in bits of points on the frame, by their pictures, if these lay at a place on it."""
        return float(np.mean([self._fit(place.shares(points[name]), name) for name in self.names]))

    def _places(self, records: Sequence[Fixations], reading: _Reading) -> dict[str, _Array]:
        """Places of the fixations of records in shares of the sides, `(n, 2)`, by their pictures."""
        by_picture: dict[str, list[_Array]] = defaultdict(list)
        for record in records:
            frame = np.array(record.size, np.float64)
            picture = np.array(self._sizes[record.picture], np.float64)
            by_picture[record.picture].append(reading.shares(record.points, frame, picture))
        return {name: np.concatenate(of_records) for name, of_records in by_picture.items()}

    def _fit(self, places: _Array, picture: str) -> float:
        """Compute the fit of places `(n, 2)` in a picture, in bits."""
        return float(_densities_at(self._particular[picture], places).mean())


def _densities_at(particular: _Array, places: _Array) -> _Array:
    """Take d at places `(n, 2)` in shares of the sides; 0 beyond the picture."""
    cells = np.floor(places * _SIDE).astype(np.int64)  # (n, 2)
    inside = np.all((cells >= 0) & (cells < _SIDE), axis=1)  # (n,)
    columns, rows = np.where(inside[:, None], cells, 0).T
    return np.where(inside, particular[rows, columns], 0.0)


def _fit_by_shift(particular: _Array, places: _Array) -> _Array:
    """Compute the fit of fixations for all shifts up to `_REACH` cells along both axes.

    Args:
        particular: d of the picture, `(_SIDE, _SIDE)`.
        places: the fixations, `(n, 2)` in shares of the sides.

    Returns:
        `(2 · _REACH + 1, 2 · _REACH + 1)`, by the shift down and the shift to the right.
    """
    margin = 2 * _REACH
    padded = np.pad(particular, margin)  # beyond the picture the fit is 0
    cells = np.floor(places * _SIDE).astype(np.int64) + margin
    # Fixations far outside the frame stay outside under every shift.
    cells = cells.clip(_REACH, _SIDE + 3 * _REACH - 1)
    column, row = cells.T
    steps = np.arange(-_REACH, _REACH + 1)
    rows = row[:, None, None] + steps[:, None]  # (n, shifts, 1)
    columns = column[:, None, None] + steps  # (n, 1, shifts)
    return np.asarray(padded[rows, columns].mean(0))


def _is_clear(gains: _Array, least: float) -> bool:
    """Whether a mean gain over pictures is large, and far above its standard error."""
    error = gains.std(ddof=1) / len(gains) ** 0.5
    return bool(gains.mean() > least and gains.mean() > _STANDARD_ERRORS * error)


def _better_reading(evidence: _Evidence) -> _Finding | None:
    """Find the reading that fits better than the present one, if one does."""
    present = evidence.fits(_PRESENT_READING)
    fits_by_reading = {reading: evidence.fits(reading) for reading in _OTHER_READINGS}
    coarse = max(fits_by_reading, key=lambda reading: fits_by_reading[reading].mean())
    coarse_fits = fits_by_reading[coarse]
    if not (_is_clear(coarse_fits - present, _LEAST_GAIN) and _is_clear(coarse_fits, _LEAST_GAIN)):
        return None
    best = coarse if coarse in _OTHER_AXES else _finer(coarse, evidence)
    # A shift is compared with what was found as coarsely.
    return _Finding(_line_of(best, evidence), float(coarse_fits.mean()))


def _line_of(reading: _Reading, evidence: _Evidence) -> str:
    """Say how fixations should be read."""
    width, height = evidence.records[0].size
    frame = f"give a frame of about {width * reading.frame_scale:.0f} × {height * reading.frame_scale:.0f}"
    return (
        f"fixations look as if {reading.fault}: they fit their pictures by {evidence.fit(reading):.2f} bits then, and "
        f"by {evidence.fit(_PRESENT_READING):.2f} as they are read ({reading.remedy or frame})"
    )


def _place_on_frame(evidence: _Evidence, fit_of_shift: float) -> _Finding | None:
    """Find another place of the pictures on the frame, which none of the readings that are tried comes close to.

    Args:
        evidence: the densities of the pictures.
        fit_of_shift: mean fit in bits without a shift that looks like it; 0 where none does.

    Returns:
        The finding; None where no place fits clearly better than the present one and than the shift.
    """
    shift = evidence.best_shift(evidence.records).shift
    moved = _Reading(lambda points, frame, picture: _shares_as_read(points, frame, picture) + shift)
    coarse = max((moved, *_NAMED_PLACES, *_PARTS_OF_FRAME, *_OTHER_FRAMES), key=evidence.fit)
    place = evidence.place_near(coarse)
    if place is None:
        return None
    exact = _at(place)
    fits = evidence.fits(exact)
    is_clear = _is_clear(fits - evidence.fits(_PRESENT_READING), _LEAST_GAIN_OF_PLACE)
    if not (is_clear and _is_clear(fits, fit_of_shift + _LEAST_GAIN_OF_PLACE)):
        return None
    return _Finding(_line_of(exact, evidence), float(fits.mean()))


def _finer(coarse: _Reading, evidence: _Evidence) -> _Reading:
    """Find the reading that is meant by a coarse one of a place: one with a name, or else the place in numbers.

    Args:
        coarse: the best of the readings that are tried, whose place may be a tenth off.
        evidence: the densities of the pictures.

    Returns:
        The first reading that fits as well as the best place near the coarse one.
    """
    place = evidence.place_near(coarse)
    exact = coarse if place is None else _at(place)
    candidates = [*_NAMED_PLACES, coarse]
    if coarse in _OTHER_FRAMES:
        # Between the frames that are tried lie those of other screens.
        frames = [_in_frame(coarse.frame_scale * factor) for factor in _FINER_SCALES]
        candidates.append(max(frames, key=evidence.fit))
    best_fit = evidence.fit(exact)
    named = next((reading for reading in candidates if best_fit - evidence.fit(reading) < _TIE), exact)
    # What fills a part of the frame is read by its place, as nothing else says how.
    has_numbers = place is not None and named in _PARTS_OF_FRAME
    return replace(exact, fault=named.fault) if has_numbers else named


def _at(place: PicturePlace) -> _Reading:
    """Make the reading for pictures that lay at a place on the frame."""
    x, y = place.corner.round().astype(int).tolist()
    width, height = place.sides.round().astype(int).tolist()
    return _Reading(
        lambda points, frame, picture: place.shares(points),
        f"the pictures covered {width} × {height} px of the screen",
        f"use in_picture(size, place=({x}, {y}, {width}, {height})), which may be some pixels off",
    )


def _wrong_names(evidence: _Evidence) -> list[str]:
    """Find fixations that are named for other pictures than those in which they were made."""
    fits = evidence.fits_in_pictures()
    own_fits = fits.diagonal()
    if _is_clear(own_fits, 0.0):
        return _exchanged(evidence.names, fits)
    pictures = np.arange(len(evidence.names))
    # Lists of names and of files that are shifted against each other are the usual fault.
    for steps in (1, -1, 2, -2):
        neighbours = (pictures + steps) % len(pictures)
        if _is_clear(fits[pictures, neighbours] - own_fits, _LEAST_GAIN):
            side = "after" if steps > 0 else "before"
            return [
                f"fixations fit the pictures that come {abs(steps)} {side} theirs in alphabetical order: check names"
            ]
    return []


def _misfit(evidence: _Evidence) -> list[str]:
    """Tell whether fixations do not fit their pictures, by a drift or for another reason."""
    own_fits = evidence.fits(_PRESENT_READING)
    if _is_clear(own_fits, 0.0):
        return []
    return _drift(evidence) or [
        f"fixations do not fit the pictures that they are named for ({own_fits.mean():.2f} bits above those of the "
        "other pictures): are these their pictures, and is the frame right?"
    ]


def _exchanged(names: Sequence[str], fits: _Array) -> list[str]:
    """Find pairs of pictures whose fixations fit each other's picture.

    Args:
        names: the N pictures.
        fits: `(N, N)`, the fit of the fixations of picture i in picture j.

    Returns:
        A line for each pair.
    """
    own_fits = fits.diagonal()
    gains = fits - own_fits[:, None]
    lines = []
    for first, second in combinations(range(len(names)), 2):
        both_gain = min(gains[first, second], gains[second, first]) > _EXCHANGED
        neither_fits = max(own_fits[first], own_fits[second]) < _LEAST_FIT
        if both_gain and neither_fits:
            lines.append(f"the fixations of {names[first]} and {names[second]} fit each other's picture")
    return lines


def _shifts_of_some(evidence: _Evidence) -> list[str]:
    """Find shifts of some people's fixations; where there are none, one of those that were made later."""
    by_person = _by_person(evidence.records)
    lines = []
    if len(by_person) > 1:  # the shift of a single person is that of all fixations
        for person, records in by_person.items():
            shift = _shift_of(evidence, records, f"the fixations of person {person}", _LEAST_SHIFT_OF_SOME)
            if shift is not None:
                lines.append(shift.line)
    return lines or _drift(evidence)


def _by_person(records: Sequence[Fixations]) -> dict[str, list[Fixations]]:
    """Group records by person, those of each in the order in which they were made."""
    by_person: dict[str, list[Fixations]] = defaultdict(list)
    for record in records:
        by_person[record.subject].append(record)
    return by_person


def _drift(evidence: _Evidence) -> list[str]:
    """Find a shift of later fixations: a tracker drifts while a person looks at one picture after the other."""
    second_halves: list[Fixations] = []
    for records in _by_person(evidence.records).values():
        second_halves += records[len(records) // 2 :]
    label = "fixations in the second half of each person's pictures"
    shift = _shift_of(evidence, second_halves, label, _LEAST_SHIFT_OF_SOME)
    return [] if shift is None else [shift.line]


def _shift_of(evidence: _Evidence, records: Sequence[Fixations], label: str, least_shift: float) -> _Finding | None:
    """Find the shift of some records in pixels of their frame, if they fit better without one.

    Args:
        evidence: the densities of the pictures.
        records: the records.
        label: what the fixations are called.
        least_shift: share of a side from which on a shift is told.

    Returns:
        The finding; None without a shift that is clear.
    """
    if len({record.picture for record in records}) < FEWEST_PICTURES:
        return None
    best = evidence.best_shift(records)
    gains = best.fits_after - best.fits_before
    is_clear = _is_clear(gains, _LEAST_GAIN / 2) and _is_clear(best.fits_after, _LEAST_GAIN)
    if np.abs(best.shift).max() < least_shift or not is_clear:
        return None
    # What is added to make the fixations fit is what was taken from them.
    x, y = (-best.shift * np.array(records[0].size)).round().astype(int).tolist()
    line = (
        f"{label} lie about ({x}, {y}) px beside what they were made at, and fit by {gains.mean():.2f} bits more "
        "without this shift (a drift of the calibration, or another origin)"
    )
    return _Finding(line, float(best.fits_after.mean()))
