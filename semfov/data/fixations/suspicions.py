"""What is suspicious in fixations: their frame, unit, origin and axes, a letterbox, repeats, blinks and durations."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.record import Fixations, Letterbox
from semfov.errors import check

_Array = NDArray[np.float64]

_FAR = 0.5
"""Fixations that lie farther than this outside their frame, in its longer sides, are not what a noisy tracker gives."""

_MANY = 20  # fixations from which on shares tell something
_BAR, _LEVEL = 0.06, 0.03  # shares of a side that is empty where a picture was letterboxed, and where it was not
_MOST_FILLED = 0.6  # shares of a frame that fixations of several pictures fill in its middle, and no more
_ENLARGED, _SEVERAL = 1.15, 5  # how much larger a frame would show a picture, and pictures that tell what one does not
_MOST_OUTSIDE, _MOST_REPEATED, _MOST_ALIKE, _MOST_SHORT = 0.1, 0.02, 0.02, 0.1  # shares of the fixations
_STRETCH = 0.02  # what rounding to whole pixels may do to proportions
_SHORT, _LONG = 50.0, 5000.0  # milliseconds


def suspicions(fixations: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]] | None = None) -> list[str]:
    """What is suspicious in fixations, in plain lines; none where nothing is.

    - Points that do not look like those of their frame: fractions, pixels from the centre, y before x, a smaller frame,
      or many outside it; with `sizes`, frames of other proportions than those of their pictures, and points within the
      pixels of pictures that are smaller than their frames.
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
    looks = _looks_like(records)
    found = [] if looks is None else [f"points look like {looks}"]
    outside = _outside(points, sides).mean()
    if looks is None and outside > _MOST_OUTSIDE:
        found.append(f"{100 * outside:.0f} % of the fixations lie outside their frame (check its size and the origin)")
    if looks is None:
        own = [] if sizes is None else _own_size(records, sizes)
        found += own or _letterbox(points, sides) or _middle(records, points, sides)
    if sizes is not None:
        found += _pictures(records, sizes)
    return [*found, *_repeats(records, points), *_durations(records)]


def _looks_like(fixations: Sequence[Fixations], *, units: bool = True) -> str | None:
    """What fixations look like that do not look like those of their frame; None if they do."""
    points, sides = _joined(fixations)
    if len(points) < 3:
        return None
    inside = 1 - _outside(points, sides).mean()
    swapped = 1 - _outside(points[:, ::-1], sides).mean()
    middle = (np.abs(points) <= sides / 2).all(1).mean()
    negative = (points < -0.5).mean(0)
    fractional = bool(((points >= 0) & (points <= 1)).all()) and bool((points % 1 != 0).any())
    if units and fractional and sides.min() > 8:
        return "fractions of the sides (units='fractions')"
    if negative.min() >= 0.2 and middle > 0.95:
        return "pixels from the centre (origin='centre', or 'centre, y up')"
    if inside < 0.9 and swapped > max(0.98, inside + 0.1):
        return "y before x (swap the two columns)"
    if len(points) >= _MANY and bool((points.max(0) < 0.5 * sides.min(0)).all()):
        corner = " × ".join(f"{side:g}" for side in np.ceil(points.max(0) + 1))
        return f"fixations of a frame of {corner} or little more (give its size)"
    return None


def _joined(fixations: Sequence[Fixations]) -> tuple[_Array, _Array]:
    """The points of all records, and the sizes of their frames, `(n, 2)` both."""
    points = np.concatenate([each.points for each in fixations])
    return points, np.concatenate([np.tile(np.array(each.size, np.float64), (len(each), 1)) for each in fixations])


def _outside(points: _Array, sides: _Array) -> NDArray[np.bool_]:
    return np.asarray(~((points >= -0.5) & (points < sides - 0.5)).all(1))


def _letterbox(points: _Array, sides: _Array) -> list[str]:
    """Bars without fixations at two opposite sides of one frame, while the other sides have none."""
    if len(points) < 5 * _MANY or (sides != sides[0]).any():
        return []
    share = (points + 0.5) / sides
    low, high = np.quantile(share, 0.002, axis=0), 1 - np.quantile(share, 0.998, axis=0)
    for axis, (name, places) in enumerate([("left and right", "x"), ("top and bottom", "y")]):
        bars, others = (low[axis], high[axis]), (low[1 - axis], high[1 - axis])
        if min(bars) > _BAR and max(bars) < 0.4 and abs(bars[0] - bars[1]) < _LEVEL and max(others) < _LEVEL:
            width = f"{100 * min(bars):.0f} % of the frame at the {name}"
            return [f"no {places} lies in {width}: was the picture letterboxed? (Fixations.in_picture)"]
    return []


def _middle(records: Sequence[Fixations], points: _Array, sides: _Array) -> list[str]:
    """Bars without fixations at all sides of one frame, whatever the picture."""
    pictures = len({record.picture for record in records})
    if len(points) < 5 * _MANY or pictures < _SEVERAL or (sides != sides[0]).any():
        return []
    low, high = np.quantile((points + 0.5) / sides, [0.01, 0.99], axis=0)
    filled = high - low
    if (filled > _MOST_FILLED).any() or (np.abs(low + high - 1) > 2 * _LEVEL).any():
        return []
    across, down = (f"{100 * part:.0f} %" for part in filled)
    return [
        f"fixations fill {across} × {down} of their frame, in the middle: were the pictures shown at their own size "
        "(Fixations.in_picture with scale=1), or are the points in degrees?"
    ]


def _own_size(records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Fixations that keep to their pictures' own size in the middle of frames that would hold them much larger."""
    smaller = [
        record
        for record in records
        if record.picture in sizes and Letterbox(record.size, sizes[record.picture]).scale >= _ENLARGED
    ]
    count = sum(map(len, smaller))
    within = sum(int(record.in_picture(sizes[record.picture], scale=1).inside.sum()) for record in smaller)
    if count < 5 * _MANY or count < 0.5 * sum(map(len, records)) or within < 0.99 * count:
        return []
    (across, down), frame = sizes[smaller[0].picture], smaller[0].size
    return [
        f"fixations keep to the middle of their frames, such as {across} × {down} in {frame[0]} × {frame[1]} of "
        f"{smaller[0].picture}: was it shown at its own size? (Fixations.in_picture with scale=1)"
    ]


def _pictures(records: Sequence[Fixations], sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Pictures that are not there, and those whose proportions are not those of the frame."""
    frames = {(each.picture, each.size) for each in records}
    unknown = sorted({picture for picture, _ in frames if picture not in sizes})
    number = len({each.picture for each in records})
    found = [f"{len(unknown)} of {number} pictures are not there, such as {unknown[0]}"] if unknown else []
    known = sorted((picture, size, sizes[picture]) for picture, size in frames if picture in sizes)
    other = [each for each in known if not _alike(*each[1:])]
    if other:
        (name, (width, height), (across, down)), count = other[0], len({each[0] for each in other})
        found.append(
            f"{count} of {number} pictures have other proportions than their frames, such as {name}, {across} × {down} "
            f"in {width} × {height}: was it letterboxed on a screen? (Fixations.in_picture)"
        )
    larger = [(each, sizes[each.picture]) for each in records if each.size > sizes.get(each.picture, each.size)]
    if sum(len(each) for each, _ in larger) >= _MANY and not any((each.points > size).any() for each, size in larger):
        each, (across, down) = larger[0]
        found.append(
            f"no fixation lies beyond the pixels of its picture, although frames are larger, such as {each.size[0]} × "
            f"{each.size[1]} of {each.picture}: give its size, {across} × {down}, if that is what was looked at"
        )
    return found


def _alike(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two `(width, height)` have the same proportions, but for rounding to whole pixels."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= _STRETCH


def _repeats(records: Sequence[Fixations], points: _Array) -> list[str]:
    found = []
    steps = np.concatenate([(each.points[1:] == each.points[:-1]).all(1) for each in records])
    if len(steps) >= _MANY and (same := steps.mean()) > _MOST_REPEATED:
        found.append(f"{100 * same:.0f} % of the fixations repeat the point before (are these samples of the tracker?)")
    twice = Counter((each.picture, each.subject, each.target, each.points.tobytes()) for each in records)
    again = [who for who, count in twice.items() if count > 1 and len(who[3]) > 16]
    if again:
        found.append(f"{len(again)} records occur more than once, such as that of {again[0][1]} in {again[0][0]}")
    places = Counter(map(tuple, points.tolist()))
    place, count = places.most_common(1)[0]
    first = Counter(tuple(each.points[0].tolist()) for each in records)[place]
    if len(points) >= _MANY and count - first > max(5.0, _MOST_ALIKE * len(points)):
        at = ", ".join(f"{value:g}" for value in place)
        found.append(f"{count} of {len(points)} fixations lie at ({at}): does the tracker write it during blinks?")
    alone = sum(len(each) == 1 for each in records)
    if len(records) >= _MANY and alone > 0.5 * len(records):
        found.append(f"{alone} of {len(records)} scanpaths have one fixation (is a column a trial that is none?)")
    return found


def _durations(records: Sequence[Fixations]) -> list[str]:
    times = [each.durations for each in records if each.durations is not None]
    if not times:
        return []
    values = np.concatenate(times)
    found, middle = [], float(np.median(values))
    least, most = (f"{value:g}" for value in (values.min(), values.max()))
    if middle < 2 and values.max() < 20 and (values % 1 != 0).any():
        return [f"durations from {least} to {most} look like seconds (multiply them by 1000)"]
    if middle > 20_000:
        return [f"durations of {middle:g} in the median look like microseconds or nanoseconds (in milliseconds ~250)"]
    if len(values) >= _MANY and (values == values[0]).all():
        found.append(f"all durations are {least} ms (are these samples of the tracker?)")
    elif middle < _SHORT:
        found.append(f"durations of {middle:g} ms in the median are those of samples, not of fixations")
    elif (short := (values < _SHORT).mean()) > _MOST_SHORT:
        found.append(f"{100 * short:.0f} % of the fixations take less than {_SHORT:g} ms")
    if (long := int((values > _LONG).sum())) > 0:
        found.append(f"{long} of {len(values)} fixations take more than {_LONG / 1000:g} s, up to {most} ms")
    return found


def check_viewed(fixations: Fixations, argument: str, size: tuple[int, int], picture: str | None = None) -> None:
    """Refuse fixations in a frame of other proportions than `(width, height)`, or in another picture than the file."""
    got = f"{fixations.size[0]} × {fixations.size[1]} of {fixations.subject!r}"
    expected = (
        f"frames with the proportions of {size[0]} × {size[1]} (Fixations.in_picture((width, height)), with scale=1 if "
        "the picture was shown at its own size)"
    )
    check(_alike(fixations.size, size), argument, expected, got)
    name = Path(picture or fixations.picture).stem
    same = Path(fixations.picture).stem == name
    remedy = "if both are one picture, dataclasses.replace(fixations, picture=…) names it"
    check(same, argument, f"fixations in {name!r}", f"in {fixations.picture!r}; {remedy}")


def warn_of_frames(
    source: str | PathLike[str], fixations: list[Fixations], *, units: bool = True, stacklevel: int = 3
) -> list[Fixations]:
    """Warn of fixations that do not look like those of their frame, with what they look like; returns the records."""
    looks = _looks_like(fixations, units=units) if fixations else None
    if looks is None:
        return warn_outside(source, fixations, stacklevel=stacklevel + 1)
    first, total = fixations[0], sum(map(len, fixations))
    warnings.warn(
        f"{source}: {total} fixations were read as pixels of frames such as {first.size[0]} × {first.size[1]}, of "
        f"{first.subject} in {first.picture}, but look like {looks}",
        stacklevel=stacklevel,
    )
    return fixations


def warn_outside(source: str | PathLike[str], fixations: list[Fixations], *, stacklevel: int = 3) -> list[Fixations]:
    """Warn of fixations that lie farther than `_FAR` outside their frame, with their share; returns the records."""
    beyond = [np.maximum(-each.points, each.points - each.size).max(1) > _FAR * max(each.size) for each in fixations]
    count, total = sum(int(each.sum()) for each in beyond), sum(map(len, beyond))
    if count:
        first = next(record for record, far in zip(fixations, beyond, strict=True) if far.any())
        warnings.warn(
            f"{source}: {count} of {total} fixations ({100 * count / total:.0f} %) lie far outside their frame, such "
            f"as those of {first.subject} in {first.picture}, {first.size[0]} × {first.size[1]}; check size and unit",
            stacklevel=stacklevel,
        )
    return fixations
