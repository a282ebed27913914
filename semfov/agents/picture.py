"""The picture that a user gave, opened once: its size, the kinds of look that it allows, and its form for each."""

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from os import PathLike
from typing import Self, cast, get_args

from torch import Tensor

from semfov.data.classes import class_index
from semfov.data.images import MAX_PIXELS, SMALLER
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.large import open_large, picture_size
from semfov.data.tone import White
from semfov.data.windowed import ChosenBands, LargePicture, has_windows
from semfov.errors import InputError, SemfovError, check, lookup, type_of
from semfov.eye import MOST_FLOATS
from semfov.gaze.saliency.fixation_density import cells_of
from semfov.head.camera import PanTiltCamera, open_scene
from semfov.head.scenes import Panorama, World
from semfov.io.files import is_pattern
from semfov.kinds import KindName
from semfov.paths import Record
from semfov.settings import How
from semfov.zoom.lattice import Lattice

_MOST_WHOLE = 1 << 24  # pixels from which on a picture with long sides is reduced for a prediction of gaze
_VIEWED = 1024  # pixels that a prediction of gaze needs at least, for six views of a detector

PictureLike = ImageLike | LargePicture | World | PanTiltCamera
"""A picture of any common kind and size (`semfov.as_image`), one that is read window by window, or a scene: a
`semfov.Panorama`, a `semfov.Flat`, or a camera that turns."""


class OpenedPicture:
    """A photograph, a large picture or a scene, read only when a kind of look needs its pixels.

    Args:
        source: the picture.
        color: order of the channels of arrays and tensors.
        white: the values that are black and white; None for those of the type.
        bands: the bands that are shown; None for those that the file names.

    Attributes:
        scene: whether it is a scene: a `Panorama`, a `Flat` or a camera that turns.

    Raises:
        InputError: it names several pictures, or values or bands are given for a picture that is open.
    """

    def __init__(
        self, source: PictureLike, color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
    ) -> None:
        expected = "one picture; semfov.run looks at folders, patterns and lists of names"
        check(not _names_several(source), "picture", expected, source)
        self.source = source
        self.color = color
        self.white = white
        self.bands = bands
        self.scene = hasattr(source, "look_at")
        is_open = isinstance(source, World | LargePicture)
        check(not is_open or white is bands is None, "white", "None for a picture that is open", white)

    @classmethod
    def of(
        cls, source: "PictureLike | Self", color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
    ) -> Self:
        """Open a picture of any kind; an `OpenedPicture` is returned unchanged."""
        return source if isinstance(source, cls) else cls(cast(PictureLike, source), color, white, bands)

    def named(self, record: Record) -> Record:
        """Write the file name of the picture into a record of this picture."""
        # A copy would make what a record makes when it is read.
        object.__setattr__(record, "source", self.path)
        return record

    def kind(self, how: str, canvas: tuple[int, int], *, every: bool = False, photographs: bool = False) -> KindName:
        """Choose the kind of look that suits the picture.

        Where windows suit photographs, too, `auto` takes them for every flat picture; else for those with a side of at
        least four times the detector's input.

        Args:
            how: a kind of look, or `auto`.
            canvas: `(width, height)` of the detector's input.
            every: whether all objects are wanted.
            photographs: whether windows also suit photographs.

        Returns:
            The name of the kind of look.

        Raises:
            InputError: the kind is unknown, or does not suit a scene.
        """
        how = lookup(how, get_args(How), "kind of look")
        if self.scene:
            check(how in ("auto", "head"), "how", "'head' or 'auto' for a scene", how)
            return "head"
        if how != "auto":
            return cast(KindName, how)
        if every:
            return "windows"
        # What cannot be opened is refused where it is read.
        with suppress(SemfovError):
            lattice = Lattice.over(self._size(), canvas)
            # Windows pay where there are two octaves or more to zoom in.
            if photographs or lattice.levels >= 3:
                return "windows"
        return "fovea"

    def _size(self) -> tuple[int, int]:
        """Find the `(width, height)` of a flat picture, without reading its pixels where that is possible."""
        if isinstance(self.source, str | PathLike):
            return self.large.size
        return picture_size(cast(ImageLike | LargePicture, self.source))

    def image(self, like: Tensor) -> Tensor:
        """Read the pixels for a fovea.

        Args:
            like: tensor whose type and device the pixels get.

        Returns:
            `(1, 3, H, W)`, RGB in [0, 1].

        Raises:
            InputError: it is a scene, or too large to be read as a whole.
            DataError: the file cannot be read.
        """
        remedy = "a scene is looked at by search, find_all and explore"
        check(not self.scene, "picture", "a flat picture for a fovea", f"{type_of(self.source)}; {remedy}")
        if not self._is_read_by_windows():
            source = cast(ImageLike, self.source)
            return as_image(source, like=like, argument="picture", color=self.color, white=self.white)[None]
        return as_image(self._all_bytes(), like=like, argument="picture")[None]

    def pixels(self, like: Tensor) -> Tensor:
        """Read the pixels `(1, 3, H, W)` for a fovea, as bytes if floats would take too much memory."""
        if self.scene or math.prod(self._size()) <= MOST_FLOATS:
            return self.image(like)
        return self._all_bytes()[None]

    def _all_bytes(self) -> Tensor:
        """Read all pixels by windows, `(3, H, W)` of bytes; raises `InputError` where they are too many for a fovea."""
        width, height = self.large.size
        self._check_area(width, height)
        return self.large.read((0, 0, width, height))

    @property
    def is_panorama(self) -> bool:
        """Whether the picture is a `Panorama` that was given with its pixels."""
        return isinstance(self.source, Panorama) and self.source.image() is not None

    def whole(self, like: Tensor) -> Tensor:
        """Read the pixels of a flat picture, or of a panorama.

        Args:
            like: as for `image`.

        Returns:
            As for `image`.

        Raises:
            InputError: it is another scene, or too large to be read as a whole.
            DataError: the file cannot be read.
        """
        around = self.source.image() if isinstance(self.source, Panorama) else None
        return around.to(like)[None] if isinstance(around, Tensor) else self.image(like)

    def viewed(self, like: Tensor, *, panorama: bool = False) -> tuple[Tensor, tuple[int, int]]:
        """Read the pixels of a flat picture or a panorama for a prediction of gaze.

        A large picture is reduced as it is read: at its full size it would take gigabytes as floats.

        Args:
            like: as for `image`.
            panorama: whether it is looked at as a panorama, in views as high as the picture.

        Returns:
            `(3, h, w)`, RGB in [0, 1], and `(width, height)` of the picture itself.

        Raises:
            InputError: it is another scene, or too large to be read as a whole.
            DataError: the file cannot be read.
        """
        if not self.scene and math.prod(self._size()) > _MOST_WHOLE:
            width, height = self.large.size
            self._check_area(width, height)
            side_of_view = min(width, height) if panorama else max(width, height)
            reduction = self.large.reduction(side_of_view / _VIEWED)
            shape = (max(1, height // reduction), max(1, width // reduction))
            # Predictions count cells by the size of the picture.
            if reduction > 1 and cells_of(shape) == cells_of((height, width)):
                pixels = self.large.read((0, 0, width, height), reduction)
                return as_image(pixels, like=like, argument="picture"), (width, height)
        image = self.whole(like)[0]
        return image, (int(image.shape[-1]), int(image.shape[-2]))

    def _check_area(self, width: int, height: int) -> None:
        """Raise `InputError` for a picture that is too large for a fovea."""
        expected = f"at most {MAX_PIXELS:,} pixels for a fovea"
        check(width * height <= MAX_PIXELS, "picture", expected, f"{width} × {height}; {SMALLER}")

    def _is_read_by_windows(self) -> bool:
        """Tell whether the pixels are read by windows, as those of a TIFF are."""
        if isinstance(self.source, str | PathLike):
            return has_windows(self.source)
        return isinstance(self.source, LargePicture)

    @property
    def path(self) -> str | None:
        """The file of the picture; None if it does not come from a file."""
        path = self.source.path if isinstance(self.source, LargePicture) else self.source
        return os.fspath(path) if isinstance(path, str | PathLike) else None

    @cached_property
    def large(self) -> LargePicture:
        """The picture in the form in which windows are cut from it."""
        source = cast(ImageLike | LargePicture, self.source)
        return open_large(source, color=self.color, white=self.white, bands=self.bands)

    @cached_property
    def world(self) -> World:
        """The scene in which a head turns."""
        shows_chosen_values = self.white is not None or self.bands is not None
        return open_scene(self.large if shows_chosen_values else self.source, self.color)


def _names_several(source: object) -> bool:
    """Tell whether something names several pictures: a list of names, a folder, or a pattern that is no file."""
    if isinstance(source, list | tuple):
        return any(isinstance(item, str | PathLike) for item in source)
    if not isinstance(source, str | PathLike):
        return False
    return os.path.isdir(source) or is_pattern(os.fspath(source))


def check_order(picture: object, target: object, classes: Sequence[str]) -> None:
    """Raise `InputError` if the arguments picture and class seem to be swapped.

    Args:
        picture: the argument `picture` of a method of the agent.
        target: its argument `target`.
        classes: the detector's classes.
    """
    picture_is_class = isinstance(picture, str) and not os.path.lexists(picture) and _is_class(picture, classes)
    target_is_word = target is not None and not isinstance(target, int | list | Mapping)
    if picture_is_class and target_is_word:
        check(_is_class(target, classes), "picture", "the picture before the class", repr(picture))


def _is_class(name: object, classes: Sequence[str]) -> bool:
    """Tell whether a name is that of a class."""
    try:
        class_index(cast(str, name), classes)
    except InputError:
        return False
    return True
