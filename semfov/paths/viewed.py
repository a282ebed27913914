"""Fixations of one viewer of a picture, in any form in which they are given."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.errors import InputError
from semfov.paths.base import Record

ScanpathLike = Fixations | Record | Tensor | np.ndarray | Sequence[Sequence[float]]
"""Fixations of one viewer: a record of people or of an agent, or points `(n, 2)` in pixels of the picture."""


def fixations_of(given: object, argument: str, size: tuple[int, int], source: str | None) -> Fixations:
    """Convert the fixations of one viewer to pixels of the picture; those far outside give a warning.

    Args:
        given: fixations, a record, or points.
        argument: name of the argument.
        size: `(width, height)` of the picture.
        source: file of the picture; None if it is not known.

    Returns:
        The fixations.

    Raises:
        InputError: they are not those of one viewer of this picture.
    """
    from semfov.human.fixations.suspicions import check_viewed, warn_of_frames

    fixations = _as_fixations(given, argument, size, source)
    check_viewed(fixations, argument, size, source)
    return warn_of_frames(argument, [fixations], stacklevel=4)[0].resized(size)


def _as_fixations(given: object, argument: str, size: tuple[int, int], source: str | None) -> Fixations:
    """Convert what a caller gave for the fixations of one viewer, in pixels of any frame, or refuse it."""
    if isinstance(given, Fixations):
        return given
    if isinstance(given, Record):
        return given.as_fixations(given.source or source or "")
    expected = "Fixations of one viewer, a record of an agent, or points (n, 2) in pixels of the picture"
    got = type(given).__name__
    if not isinstance(given, list | tuple | np.ndarray | Tensor):
        raise InputError(f"{argument}: expected {expected}, got {got}")
    if _holds_viewers(given):
        remedy = f"take one: {argument}=scanpaths[0]"
        raise InputError(f"{argument}: expected {expected}, got a {got} of {len(given)}; {remedy}")
    try:
        return Fixations(source or "", "viewer", given, size)  # type: ignore[arg-type]  # which makes an array
    except InputError as error:
        raise InputError(f"{argument}: expected {expected}, got a {got} ({error})") from None


def _holds_viewers(given: Sequence[object] | np.ndarray | Tensor) -> bool:
    """Tell whether a sequence has the fixations of viewers instead of points."""
    return isinstance(given, list | tuple) and any(isinstance(entry, Fixations | Record) for entry in given)
