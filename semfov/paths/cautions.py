"""Why a prediction of where people look may be wrong for a picture, in words."""

from collections.abc import Iterator
from typing import NamedTuple

_WIDE = 2  # width over height from which a picture is wider than those of the shipped models
_SMALL = 64  # longer side in pixels below which a picture shows a detector next to nothing
_PANORAMA = 2  # width over height of a panorama of 360° by 180°


class Cautions(NamedTuple):
    """Facts about a picture for which the gaze model may be wrong.

    Attributes:
        size: `(width, height)` of the picture in pixels.
        unlike: whether the picture is unlike those of the fit.
        blank: whether all of it has one colour.
        panorama: whether it was looked at as a panorama.
        is_shipped: whether the model is the one that is shipped for the detector.
    """

    size: tuple[int, int]
    unlike: bool
    blank: bool
    panorama: bool
    is_shipped: bool

    def words(self) -> str | None:
        """Describe all reasons to doubt the prediction; None if there is none."""
        return "; ".join(self._all()) or None

    def _all(self) -> Iterator[str]:
        """Say what is known against it, one after the other."""
        width, height = self.size
        if self.blank:
            said = "how high people look" if self.panorama else "that people look at the middle"
            yield f"this picture has one colour, so the map only says {said}"
        elif self.unlike:
            yield "this picture is unlike the photographs that the model learned from, so the map may be wrong"
        # The pictures of a model that a user has fitted are not known.
        if not self.is_shipped:
            return
        if max(width, height) < _SMALL:
            yield f"{width} × {height} px show little, and the model learned from pictures of 640 px and more"
        # A panorama is looked at in views, and not as a whole.
        if not self.panorama:
            yield from self._proportions()

    def _proportions(self) -> Iterator[str]:
        """Say how the shape of the picture differs from those of the shipped fits."""
        width, height = self.size
        if width <= height:
            yield "the model learned only from pictures that are wider than high, and this one is not"
        if width >= _WIDE * height:
            yield f"the model learned from pictures of 4 : 3, and this one is {width / height:.1f} : 1"
        if width == _PANORAMA * height:
            yield "if it is a panorama of 360°, say so (--panorama; semfov.Panorama in Python)"
