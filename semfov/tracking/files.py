"""Tracked objects as the tensors of a file."""

from collections.abc import Mapping

import torch
from torch import Tensor

from semfov.errors import check
from semfov.io.schema import Field
from semfov.tracking.kalman import Kinematics
from semfov.tracking.tracks import TRAIL, Tracks

_PREFIX = "track_"
_KINEMATICS = {"place": (2,), "velocity": (2,), "covariance": (2, 2)}
_COLUMNS = {
    "rest_place": (2,),
    "speed": (),
    "log_size": (2,),
    "size_variance": (),
    "shown_odds": (),
    "missed_odds": (),
    "unseen": (),
    "magnification": (),
    "trail": (TRAIL, 2),
}
_NUMBERS = {"track_ids": 1, "labels": 1, "passes": 0}  # whole numbers, and the lowest of each

TRACK_FIELDS: dict[str, Field] = {
    **{
        # A trail is NaN where its object was not known yet.
        _PREFIX + name: Field(("T", *shape), dtype=torch.float64, finite=name != "trail", optional=True)
        for name, shape in {**_KINEMATICS, **_COLUMNS}.items()
    },
    **{_PREFIX + name: Field(("T",), dtype=torch.int64, low=low, optional=True) for name, low in _NUMBERS.items()},
}
"""The tensors by their names; a file has all or none."""


def track_tensors(tracks: Tracks) -> dict[str, Tensor]:
    """Convert tracks to tensors.

    Args:
        tracks: the objects.

    Returns:
        The tensors by the names of `TRACK_FIELDS`.
    """
    arrays = {name: getattr(tracks.kinematics, name) for name in _KINEMATICS}
    arrays.update({name: getattr(tracks, name) for name in (*_COLUMNS, *_NUMBERS)})
    # A clone keeps the order of memory otherwise, and a file has rows one after another.
    plain = torch.contiguous_format
    return {_PREFIX + name: torch.from_numpy(array).clone(memory_format=plain) for name, array in arrays.items()}


def tracks_of(tensors: Mapping[str, Tensor]) -> Tracks:
    """Make tracks of the tensors of a file.

    Args:
        tensors: the tensors of the file.

    Returns:
        The objects; none where the file has none of the tensors.

    Raises:
        InputError: some of the tensors are missing.

    >>> len(tracks_of(track_tensors(Tracks.none())))
    0
    """
    missing = [name for name in TRACK_FIELDS if name not in tensors]
    if len(missing) == len(TRACK_FIELDS):
        return Tracks.none()
    check(not missing, "tracks", "all tensors of tracked objects, or none", f"none named {', '.join(missing)}")
    arrays = {name: tensors[_PREFIX + name].numpy() for name in (*_KINEMATICS, *_COLUMNS, *_NUMBERS)}
    kinematics = Kinematics(**{name: arrays.pop(name) for name in _KINEMATICS})
    return Tracks(kinematics=kinematics, **arrays)
