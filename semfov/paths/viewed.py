"""Fixations of one viewer of a picture, in any form in which they are given."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.errors import InputError, check
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

    expected = "Fixations of one viewer, a record of an agent, or points (n, 2) in pixels of the picture"
    if isinstance(given, Record):
        given = given.as_fixations(given.source or source or "")
    elif isinstance(given, list | tuple) and any(isinstance(entry, Fixations | Record) for entry in given):
        check(False, argument, expected, f"a {type(given).__name__} of {len(given)}; take one: {argument}=scanpaths[0]")
    elif isinstance(given, list | tuple | np.ndarray | Tensor):
        try:
            given = Fixations(source or "", "viewer", given, size)  # type: ignore[arg-type]  # which makes an array
        except InputError as error:
            raise InputError(f"{argument}: expected {expected}, got a {type(given).__name__} ({error})") from None
    if not isinstance(given, Fixations):
        raise InputError(f"{argument}: expected {expected}, got {type(given).__name__}")
    check_viewed(given, argument, size, source)
    return warn_of_frames(argument, [given], stacklevel=4)[0].resized(size)
