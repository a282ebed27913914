"""Conversion to and from the fixation trains of pysaliency."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.record import Fixations
from semfov.errors import check, needing


def to_pysaliency(fixations: Sequence[Fixations], pictures: Sequence[str]) -> Any:
    """Convert fixations to `pysaliency.FixationTrains`.

    pysaliency measures coordinates from the left and the top edge of the picture, so a pixel's centre is at .5. Times
    are the onsets of the fixations in seconds, or 0, 1, … where durations are not known.

    Args:
        fixations: records in pixels of the pictures.
        pictures: names of the stimuli, in pysaliency's order.

    Returns:
        The fixation trains.

    Raises:
        InputError: pysaliency is not installed, or a picture is not among the stimuli.

    Example::

        trains = to_pysaliency(fixations, ["1001.jpg", "1002.jpg"])
    """
    with needing("pysaliency", "to_pysaliency"):
        from pysaliency import FixationTrains
    stimuli = {name: index for index, name in enumerate(pictures)}
    unknown = [record.picture for record in fixations if record.picture not in stimuli]
    check(not unknown, "pictures", "all pictures of the fixations", f"none named {unknown[:1]}")
    subjects = sorted({record.subject for record in fixations})
    people = {name: index for index, name in enumerate(subjects)}
    return FixationTrains.from_fixation_trains(
        xs=[record.points[:, 0] + 0.5 for record in fixations],
        ys=[record.points[:, 1] + 0.5 for record in fixations],
        ts=[_onsets(record) for record in fixations],
        ns=[stimuli[record.picture] for record in fixations],
        subjects=[people[record.subject] for record in fixations],
    )


def _onsets(record: Fixations) -> NDArray[np.float64]:
    """Tell when each fixation begins, in seconds; its number where durations are not known, `(n,)`."""
    if record.durations is None:
        return np.arange(len(record), dtype=np.float64)
    return (np.cumsum(record.durations) - record.durations) / 1000


def from_pysaliency(trains: Any, pictures: Sequence[str], sizes: Mapping[str, tuple[int, int]]) -> list[Fixations]:
    """Convert `pysaliency.FixationTrains`, which have no durations, to fixations.

    Args:
        trains: the fixation trains.
        pictures: names of the stimuli, in pysaliency's order.
        sizes: `(width, height)` of the pictures by name.

    Returns:
        One record for each train, in pixels of the picture.

    Example::

        fixations = from_pysaliency(trains, ["1001.jpg", "1002.jpg"], {"1001.jpg": (800, 600), "1002.jpg": (800, 600)})
    """
    records = []
    columns = (trains.train_xs, trains.train_ys, trains.train_ns, trains.train_subjects)
    for xs, ys, n, subject in zip(*columns, strict=True):
        points = np.stack([np.asarray(xs, dtype=np.float64), np.asarray(ys, dtype=np.float64)], axis=1) - 0.5
        picture = pictures[int(n)]
        # The trains are as long as the longest one, filled with NaN.
        is_fixation = np.isfinite(points).all(1)
        records.append(Fixations(picture, str(subject), points[is_fixation], sizes[picture]))
    return records
