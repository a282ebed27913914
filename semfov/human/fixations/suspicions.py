"""Checks for wrong frames, units, origins, axes, letterboxes, repeats, blinks and durations of fixations."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.record import Fixations, Letterbox, bare_name, inside_frame
from semfov.errors import check

_Array = NDArray[np.float64]

_DEGREES = 0.05  # of a side of the frame: numbers up to here from its centre are no pixels

_FAR = 0.5
"""Fixations that lie farther than this outside their frame, in its longer sides, are not what a noisy tracker gives."""

_MANY = 20  # fixations from which on shares tell something
_ENOUGH = 5 * _MANY  # fixations from which on their borders tell something
_ENOUGH_PICTURES = 5  # that tell what one does not
_ENLARGED = 1.15  # how much larger a frame would show a picture
_STRETCH = 0.02  # what rounding to whole pixels may do to proportions

# Shares of a side of the frame without fixations: where the picture was letterboxed, where it was not, and at most.
_BAR = 0.06
_LEVEL = 0.03
_MOST_BAR = 0.4
_MOST_FILLED = 0.6  # share of a side that fixations of several pictures fill in its middle, and no more

# Shares of the fixations from which on they are suspicious.
_MOST_OUTSIDE = 0.1
_MOST_REPEATED = 0.02
_MOST_ALIKE = 0.02
_MOST_SHORT = 0.1

_SHORT = 50.0  # milliseconds
_LONG = 5000.0


def suspicions(fixations: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]] | None = None) -> list[str]:
    """List what is suspicious in fixations, as lines of text.

    - Points that do not look like those of their frame: fractions, pixels or degrees from the centre, y before x, a
      smaller frame, or many outside it; with `sizes`, frames of other proportions than those of their pictures, and
      points within the pixels of pictures that are smaller than their frames.
    - A letterbox: bars at two opposite sides without fixations, while the others reach the border; and a picture at its
      own size in the middle: bars at all sides.
    - Points that repeat the one before, records that occur twice, and many fixations at one same point, such as what
      a tracker writes during a blink.
    - Durations in seconds or microseconds, all alike, or of samples; and fixations of less than 50 ms or of more than
      5 s.

    Args:
        fixations: the records.
        sizes: `(width, height)` of the pictures by their names.

    Returns:
        The lines.

    >>> path = Fixations("a.jpg", "1", np.array([[10.0, 10], [60, 10], [60, 40]]), (80, 60), np.array([0.2, 0.3, 0.2]))
    >>> suspicions([path])
    ['durations from 0.2 to 0.3 look like seconds (multiply them by 1000)']
    """
    records = list(fixations)
    if not records:
        return ["there are no fixations"]
    points, sides = _joined(records)
    lines = _of_frames(records, points, sides, sizes)
    if sizes is not None:
        lines += _of_pictures(records, sizes)
    return [*lines, *_of_repeats(records, points), *_of_durations(records)]


def _of_frames(
    records: Sequence[Fixations], points: _Array, sides: _Array, sizes: Mapping[str, tuple[int, int]] | None
) -> list[str]:
    """Say what is suspicious in the frames of points `(n, 2)`, with `sides` `(n, 2)`."""
    other_frame = other_frame_of(records)
    if other_frame is not None:
        return [f"points look like {other_frame}"]
    lines = []
    outside = _outside(points, sides).mean()
    if outside > _MOST_OUTSIDE:
        lines.append(f"{100 * outside:.0f} % of the fixations lie outside their frame (check its size and the origin)")
    own_size = [] if sizes is None else _own_size(records, sizes)
    return lines + (own_size or _letterbox(points, sides) or _middle(records, points, sides))


def other_frame_of(fixations: Sequence[Fixations], *, units: bool = True) -> str | None:
    """Describe another unit, origin, axis or frame that fits the fixations better than their own, if any.

    Args:
        fixations: the records, at least one.
        units: whether they may be fractions that were read as pixels.

    Returns:
        The unit, origin, order of axes or frame that they look like, in words; None if they look like their own.
    """
    points, sides = _joined(fixations)
    if len(points) < 3:
        return None
    rules = [_other_origin, _other_order, _smaller_frame]
    if units:
        rules.insert(0, _other_unit)
    # The first rule that applies explains what the later ones would find.
    frames = (rule(points, sides) for rule in rules)
    return next((frame for frame in frames if frame is not None), None)


def _other_unit(points: _Array, sides: _Array) -> str | None:
    """Recognise fractions: all points `(n, 2)` in [0, 1], not all at its ends, in frames of more than some pixels."""
    in_unit_square = ((points >= 0) & (points <= 1)).all()
    are_whole = (points % 1 == 0).all()
    are_fractions = in_unit_square and not are_whole
    # In a frame of some pixels they may be pixels.
    return "fractions of the sides (units='fractions')" if are_fractions and sides.min() > 8 else None


def _other_origin(points: _Array, sides: _Array) -> str | None:
    """Recognise points on all sides of the origin, no farther from it than a frame around it reaches."""
    negative = (points < -0.5).mean(0)  # (2,), shares of x and of y
    in_middle = (np.abs(points) <= sides / 2).all(1).mean()
    if negative.min() < 0.2 or in_middle <= 0.95:
        return None
    if (np.abs(points) < _DEGREES * sides.min()).all():
        return "degrees from the centre (multiply them by the pixels of a degree)"
    return "pixels from the centre (origin='centre', or 'centre, y up')"


def _other_order(points: _Array, sides: _Array) -> str | None:
    """Recognise y before x: points that lie inside their frames only with x and y exchanged."""
    inside = 1 - _outside(points, sides).mean()
    inside_if_swapped = 1 - _outside(points[:, ::-1], sides).mean()
    if inside < 0.9 and inside_if_swapped > max(0.98, inside + 0.1):
        return "y before x (swap the two columns)"
    return None


def _smaller_frame(points: _Array, sides: _Array) -> str | None:
    """Recognise many points that all lie in the first quarter of their frames."""
    farthest = points.max(0)  # (2,)
    in_first_quarter = bool((farthest < 0.5 * sides.min(0)).all())
    if len(points) < _MANY or not in_first_quarter:
        return None
    corner = " × ".join(f"{side:g}" for side in np.ceil(farthest + 1))
    return f"fixations of a frame of {corner} or little more (give its size)"


def _joined(fixations: Sequence[Fixations]) -> tuple[_Array, _Array]:
    """Join the points of all records, and the sizes of their frames, `(n, 2)` both."""
    points = np.concatenate([record.points for record in fixations])
    sides = np.concatenate([np.tile(np.array(record.size, np.float64), (len(record), 1)) for record in fixations])
    return points, sides


def _outside(points: _Array, sides: _Array) -> NDArray[np.bool_]:
    """Tell whether points lie outside their frame, `(n,)`."""
    return ~inside_frame(points, sides)


def _show_borders(points: _Array, sides: _Array) -> bool:
    """Tell whether points are many enough, and in one frame, so that their borders tell where the pictures were."""
    return len(points) >= _ENOUGH and bool((sides == sides[0]).all())


def _letterbox(points: _Array, sides: _Array) -> list[str]:
    """Find bars without fixations at two opposite sides of one frame, while the other sides have none."""
    if not _show_borders(points, sides):
        return []
    share = (points + 0.5) / sides
    # Empty shares at the left and the top, and at the right and the bottom; single points may lie in a bar.
    before = np.quantile(share, 0.002, axis=0)
    after = 1 - np.quantile(share, 0.998, axis=0)
    wider = np.maximum(before, after)
    narrower = np.minimum(before, after)
    are_bars = (narrower > _BAR) & (wider < _MOST_BAR) & (wider - narrower < _LEVEL)
    reaches_borders = wider < _LEVEL
    for axis, (borders, coordinate) in enumerate([("left and right", "x"), ("top and bottom", "y")]):
        if are_bars[axis] and reaches_borders[1 - axis]:
            width = f"{100 * narrower[axis]:.0f} % of the frame at the {borders}"
            return [f"no {coordinate} lies in {width}: was the picture letterboxed? (Fixations.in_picture)"]
    return []


def _middle(records: Sequence[Fixations], points: _Array, sides: _Array) -> list[str]:
    """Find bars without fixations at all sides of one frame, whatever the picture."""
    pictures = {record.picture for record in records}
    if len(pictures) < _ENOUGH_PICTURES or not _show_borders(points, sides):
        return []
    start, end = np.quantile((points + 0.5) / sides, [0.01, 0.99], axis=0)  # (2,) both, shares of the sides
    filled = end - start
    is_centred = np.abs(start + end - 1) <= 2 * _LEVEL
    is_part = filled <= _MOST_FILLED
    if not (is_part & is_centred).all():
        return []
    width, height = (f"{100 * part:.0f} %" for part in filled)
    return [
        f"fixations fill {width} × {height} of their frame, in the middle: were the pictures shown at their own size "
        "(Fixations.in_picture with scale=1), or are the points in degrees?"
    ]


def _own_size(records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Find fixations that keep to their pictures' own size in frames that would hold them much larger."""
    enlarging = [record for record in records if _would_enlarge(record, sizes)]
    count = sum(map(len, enlarging))
    if count < max(_ENOUGH, 0.5 * sum(map(len, records))):
        return []
    at_own_size = [record.in_picture(sizes[record.picture], scale=1) for record in enlarging]
    within = sum(int(record.inside.sum()) for record in at_own_size)
    if within < 0.99 * count:
        return []
    first = enlarging[0]
    width, height = sizes[first.picture]
    return [
        f"fixations keep to the middle of their frames, such as {width} × {height} in {first.size[0]} × "
        f"{first.size[1]} of {first.picture}: was it shown at its own size? (Fixations.in_picture with scale=1)"
    ]


def _would_enlarge(record: Fixations, sizes: Mapping[str, tuple[int, int]]) -> bool:
    """Tell whether a record's frame, filled by its picture, would show it much larger than it is."""
    if record.picture not in sizes:
        return False
    return Letterbox(record.size, sizes[record.picture]).scale >= _ENLARGED


def _of_pictures(records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Say what is suspicious beside the sizes of the pictures."""
    pictures = {record.picture for record in records}
    unknown = sorted(pictures - sizes.keys())
    lines = []
    if unknown:
        lines.append(f"{len(unknown)} of {len(pictures)} pictures are missing or damaged, such as {unknown[0]}")
    if other_frame_of(records) is not None:
        return lines  # of which the frame tells nothing
    smaller = _smaller_pictures(records, sizes)
    # What tells where the pictures were comes before what asks.
    if smaller or _own_size(records, sizes):
        return lines + smaller
    return lines + _other_proportions(records, sizes)


def _other_proportions(records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Find pictures with other proportions than their frames."""
    pictures = {record.picture for record in records}
    frames = sorted({(record.picture, record.size) for record in records if record.picture in sizes})
    stretched = [(picture, frame) for picture, frame in frames if not _alike(frame, sizes[picture])]
    if not stretched:
        return []
    first, frame = stretched[0]
    width, height = sizes[first]
    count = len(dict(stretched))  # a picture may have several frames
    return [
        f"{count} of {len(pictures)} pictures have other proportions than their frames, such as {first}, "
        f"{width} × {height} in {frame[0]} × {frame[1]}: was it letterboxed on a screen? "
        "(Fixations.in_picture; with scale=1 at its own size, with place= elsewhere)"
    ]


def _smaller_pictures(records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Find fixations in larger frames that lie within the pixels of their pictures."""
    in_larger = [record for record in records if record.size > sizes.get(record.picture, record.size)]
    beyond = any((record.points > sizes[record.picture]).any() for record in in_larger)
    if beyond or sum(map(len, in_larger)) < _MANY:
        return []
    first = in_larger[0]
    width, height = sizes[first.picture]
    return [
        f"no fixation lies beyond the pixels of its picture, although frames are larger, such as {first.size[0]} × "
        f"{first.size[1]} of {first.picture}: give its size, {width} × {height}, if that is what was looked at"
    ]


def _alike(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Tell whether two `(width, height)` have the same proportions, but for rounding to whole pixels."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= _STRETCH


def _of_repeats(records: Sequence[Fixations], points: _Array) -> list[str]:
    """Say what repeats: points, records, one place, and scanpaths of a single fixation."""
    return [
        *_repeated_points(records),
        *_repeated_records(records),
        *_at_one_place(records, points),
        *_single_fixations(records),
    ]


def _repeated_points(records: Sequence[Fixations]) -> list[str]:
    """Find many fixations at the point of the one before."""
    repeats = np.concatenate([_repeats_point(record.points) for record in records])
    if len(repeats) < _MANY or repeats.mean() <= _MOST_REPEATED:
        return []
    percent = f"{100 * repeats.mean():.0f} %"
    return [f"{percent} of the fixations repeat the point before (are these samples of the tracker?)"]


def _repeats_point(points: _Array) -> NDArray[np.bool_]:
    """Tell which points `(n, 2)` after the first are equal to the one before, `(n - 1,)`."""
    return np.asarray((points[1:] == points[:-1]).all(1))


def _single_fixations(records: Sequence[Fixations]) -> list[str]:
    """Find many scanpaths of a single fixation."""
    single = sum(len(record) == 1 for record in records)
    if len(records) < _MANY or single <= 0.5 * len(records):
        return []
    return [f"{single} of {len(records)} scanpaths have one fixation (is a column a trial that is none?)"]


def _repeated_records(records: Sequence[Fixations]) -> list[str]:
    """Find records of more than one fixation that occur more than once."""
    counts = Counter((record.picture, record.subject, record.target, record.points.tobytes()) for record in records)
    one_point = np.zeros((1, 2)).nbytes
    repeated = [key for key, count in counts.items() if count > 1 and len(key[3]) > one_point]
    if not repeated:
        return []
    picture, subject, _, _ = repeated[0]
    return [f"{len(repeated)} records occur more than once, such as that of {subject} in {picture}"]


def _at_one_place(records: Sequence[Fixations], points: _Array) -> list[str]:
    """Find many fixations at one same point, but for those at which scanpaths begin."""
    places = Counter(map(tuple, points.tolist()))
    place, count = places.most_common(1)[0]
    beginnings = sum(tuple(record.points[0].tolist()) == place for record in records)
    usual = max(5.0, _MOST_ALIKE * len(points))
    if len(points) < _MANY or count - beginnings <= usual:
        return []
    numbers = ", ".join(f"{value:g}" for value in place)
    return [f"{count} of {len(points)} fixations lie at ({numbers}): does the tracker write it during blinks?"]


def _of_durations(records: Sequence[Fixations]) -> list[str]:
    """Say what is suspicious in durations: their unit, their being alike, and their length."""
    durations = [record.durations for record in records if record.durations is not None]
    if not durations:
        return []
    values = np.concatenate(durations)
    # In another unit, all of them would also be too short, or too long.
    return _other_time_unit(values) or [*_short_durations(values), *_long_durations(values)]


def _other_time_unit(durations: _Array) -> list[str]:
    """Recognise durations `(n,)` that are no milliseconds."""
    median = float(np.median(durations))
    least = durations.min()
    most = durations.max()
    are_whole = (durations % 1 == 0).all()
    are_short = median < 2 and most < 20
    if are_short and not are_whole:
        return [f"durations from {least:g} to {most:g} look like seconds (multiply them by 1000)"]
    if median > 20_000:
        return [f"durations of {median:g} in the median look like microseconds or nanoseconds (in milliseconds ~250)"]
    return []


def _short_durations(durations: _Array) -> list[str]:
    """Say of durations `(n,)` in ms that they are those of samples, or that many are short."""
    least = durations.min()
    median = float(np.median(durations))
    share_short = (durations < _SHORT).mean()
    if len(durations) >= _MANY and least == durations.max():
        return [f"all durations are {least:g} ms (are these samples of the tracker?)"]
    if median < _SHORT:
        return [f"durations of {median:g} ms in the median are those of samples, not of fixations"]
    if share_short > _MOST_SHORT:
        return [f"{100 * share_short:.0f} % of the fixations take less than {_SHORT:g} ms"]
    return []


def _long_durations(durations: _Array) -> list[str]:
    """Say how many durations `(n,)` in ms are longer than fixations last."""
    count = int((durations > _LONG).sum())
    if count == 0:
        return []
    longest = durations.max()
    return [f"{count} of {len(durations)} fixations take more than {_LONG / 1000:g} s, up to {longest:g} ms"]


def check_viewed(fixations: Fixations, argument: str, size: tuple[int, int], picture: str | None = None) -> None:
    """Raise an error if the frame of fixations differs in proportions from a picture, or if the picture differs.

    Args:
        fixations: the record.
        argument: name of the argument, for the message.
        size: `(width, height)` of the picture.
        picture: name of its file; None where it has none.

    Raises:
        InputError: with how to convert the fixations.
    """
    got = f"{fixations.size[0]} × {fixations.size[1]} of {fixations.subject!r}"
    expected = (
        f"frames with the proportions of {size[0]} × {size[1]} (Fixations.in_picture((width, height)), with scale=1 if "
        "the picture was shown at its own size)"
    )
    check(_alike(fixations.size, size), argument, expected, got)
    name = bare_name(picture or fixations.picture)
    remedy = "if both are one picture, dataclasses.replace(fixations, picture=…) names it"
    is_same = bare_name(fixations.picture) == name
    check(is_same, argument, f"fixations in {name!r}", f"in {fixations.picture!r}; {remedy}")


def warn_of_frames(
    source: str | PathLike[str], fixations: list[Fixations], *, units: bool = True, stacklevel: int = 3
) -> list[Fixations]:
    """Warn of fixations that seem to be in another frame, unit or axis, and name it.

    Args:
        source: the file, for the message.
        fixations: the records.
        units: whether they may be fractions that were read as pixels.
        stacklevel: as for `warnings.warn`.

    Returns:
        The records.
    """
    other_frame = other_frame_of(fixations, units=units) if fixations else None
    if other_frame is None:
        return warn_outside(source, fixations, stacklevel=stacklevel + 1)
    first = fixations[0]
    warnings.warn(
        f"{source}: {sum(map(len, fixations))} fixations were read as pixels of frames such as {first.size[0]} × "
        f"{first.size[1]}, of {first.subject} in {first.picture}, but look like {other_frame}",
        stacklevel=stacklevel,
    )
    return fixations


def warn_outside(source: str | PathLike[str], fixations: list[Fixations], *, stacklevel: int = 3) -> list[Fixations]:
    """Warn of the share of fixations that lie farther than `_FAR` outside their frame.

    Args:
        source: the file, for the message.
        fixations: the records.
        stacklevel: as for `warnings.warn`.

    Returns:
        The records.
    """
    counts = [int(_is_far_outside(record).sum()) for record in fixations]
    count = sum(counts)
    if count:
        total = sum(map(len, fixations))
        first = next(record for record, outside in zip(fixations, counts, strict=True) if outside)
        warnings.warn(
            f"{source}: {count} of {total} fixations ({100 * count / total:.0f} %) lie far outside their frame, such "
            f"as those of {first.subject} in {first.picture}, {first.size[0]} × {first.size[1]}; check size and unit",
            stacklevel=stacklevel,
        )
    return fixations


def _is_far_outside(fixations: Fixations) -> NDArray[np.bool_]:
    """Tell whether each fixation lies farther than `_FAR` outside its frame, `(n,)`."""
    distance = np.maximum(-fixations.points, fixations.points - fixations.size).max(1)
    return np.asarray(distance > _FAR * max(fixations.size))
