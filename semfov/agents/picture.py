"""The picture that a user gave, opened once: its size, the kinds of look that it allows, and its form for each."""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self, cast, get_args

from torch import Tensor

from semfov.data.classes import class_index
from semfov.data.images import MAX_PIXELS
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.large import open_large, picture_size
from semfov.data.tone import White
from semfov.data.windowed import BY_WINDOWS, ChosenBands, LargePicture
from semfov.errors import InputError, SemfovError, check, check_number, lookup
from semfov.head.camera import PanTiltCamera, open_scene
from semfov.head.scenes import World
from semfov.paths import Record
from semfov.zoom.lattice import Lattice

KindOfLook = Literal["fovea", "windows", "head"]
"""Kind of look: foveal fixations of a photograph, windows of a large picture, or views of a scene."""

How = Literal["auto", "fovea", "windows", "head"]  # kind of look, or `auto` for the one that suits the picture

PictureLike = ImageLike | LargePicture | World | PanTiltCamera
"""A picture of any common kind and size (`semfov.as_image`), one that is read window by window, or a scene: a
`semfov.Panorama`, a `semfov.Flat`, or a camera that turns."""


class OpenedPicture:
    """A photograph, a large picture or a scene; what a kind of look needs of it is read when it is asked for."""

    def __init__(
        self, source: PictureLike, color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
    ) -> None:
        several = "one picture; semfov.run looks at folders, patterns and lists of names"
        check(not _names_several(source), "picture", several, source)
        self.source, self.color, self.white, self.bands = source, color, white, bands
        self.scene = hasattr(source, "look_at")  # a `Panorama`, a `Flat` or a camera that turns
        made = isinstance(source, World | LargePicture)
        check(not made or white is bands is None, "white", "None for a picture that is open", white)

    @classmethod
    def of(
        cls, source: "PictureLike | Self", color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
    ) -> Self:
        """Open a picture of any kind; one that is open stays as it is."""
        return source if isinstance(source, cls) else cls(cast(PictureLike, source), color, white, bands)

    def named(self, record: Record) -> Record:
        """Name the file of the picture in a record that was just made of it."""
        # A copy would make what a record makes when it is read.
        object.__setattr__(record, "source", self.path)
        return record

    def kind(self, how: str, canvas: tuple[int, int], *, every: bool = False, photographs: bool = False) -> KindOfLook:
        """The kind of look that suits it, of photographs, too, windows; canvas `(width, height)` of the input."""
        how = lookup(how, get_args(How), "kind of look")
        if self.scene:
            check(how in ("auto", "head"), "how", "'head' or 'auto' for a scene", how)
            return "head"
        if how != "auto":
            return cast(KindOfLook, how)
        if every:
            return "windows"
        # What cannot be opened is refused where it is read.
        with suppress(SemfovError):
            file = isinstance(self.source, str | PathLike)
            size = self.large.size if file else picture_size(cast(ImageLike | LargePicture, self.source))
            # Windows pay where there are two octaves or more to zoom in.
            return "windows" if photographs or Lattice.over(size, canvas).levels >= 3 else "fovea"
        return "fovea"

    def image(self, like: Tensor) -> Tensor:
        """The pixels for a fovea, `(1, 3, H, W)`."""
        remedy = "a scene is looked at by search, find_all and explore"
        check(not self.scene, "picture", "a flat picture for a fovea", f"a {type(self.source).__name__}; {remedy}")
        source, path = self.source, isinstance(self.source, str | PathLike)
        if isinstance(source, LargePicture) or (path and Path(cast(str, source)).suffix.lower() in BY_WINDOWS):
            width, height = self.large.size
            most = f"at most {MAX_PIXELS:,} pixels for a fovea"
            check(width * height <= MAX_PIXELS, "picture", most, f"{width} × {height}; use how='windows'")
            return as_image(self.large.read((0, 0, width, height)), like=like, argument="picture")[None]
        settings: dict[str, Any] = {"color": self.color, "white": self.white}
        return as_image(cast(ImageLike, source), like=like, argument="picture", **settings)[None]

    @property
    def path(self) -> str | None:
        """The file of the picture; None if it does not come from a file."""
        path = self.source.path if isinstance(self.source, LargePicture) else self.source
        return os.fspath(path) if isinstance(path, str | PathLike) else None

    @cached_property
    def large(self) -> LargePicture:
        """The picture for windows."""
        source = cast(ImageLike | LargePicture, self.source)
        return open_large(source, color=self.color, white=self.white, bands=self.bands)

    @cached_property
    def world(self) -> World:
        """The scene for a head."""
        given = self.white is not None or self.bands is not None
        return open_scene(self.large if given else self.source, self.color)


def _names_several(source: object) -> bool:
    """Tell whether something names several pictures: a list of names, a folder, or a pattern that is no file."""
    if isinstance(source, list | tuple):
        return any(isinstance(each, str | PathLike) for each in source)
    if not isinstance(source, str | PathLike):
        return False
    return os.path.isdir(source) or (bool({*os.fspath(source)} & {*"*?["}) and not os.path.lexists(source))


def check_order(picture: object, target: object, classes: Sequence[str]) -> None:
    """Raise `InputError` where a class stands in the place of the picture, and what is none in that of the class."""
    named = isinstance(picture, str) and not os.path.lexists(picture) and _is_class(picture, classes)
    swapped = named and target is not None and not isinstance(target, int | list | Mapping)
    check(not swapped or _is_class(target, classes), "picture", "the picture before the class", repr(picture))


def _is_class(name: object, classes: Sequence[str]) -> bool:
    """Tell whether a name is that of a class."""
    try:
        class_index(cast(str, name), classes)
    except InputError:
        return False
    return True


def counted_from(record: Record, least: float | None) -> Record:
    """Count the objects of a record from a probability or score on; None leaves the record as it is."""
    check_number(0.0 if least is None else least, "least", 0, 1)
    return record if least is None else replace(record, least=least)
