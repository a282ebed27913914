"""The picture that a user gave, opened once: its size, the kinds of look that it allows, and its form for each."""

from contextlib import suppress
from functools import cached_property
from typing import Literal, cast, get_args

from torch import Tensor

from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.large import LargePicture, open_large, picture_size
from semfov.errors import SemfovError, check, lookup
from semfov.head.camera import PanTiltCamera, is_scene, open_scene
from semfov.head.world import World
from semfov.zoom.lattice import Lattice

KindOfLook = Literal["fovea", "windows", "head"]
"""Kind of look: foveal fixations of a photograph, windows of a large picture, or views of a scene."""

How = Literal["auto", "fovea", "windows", "head"]
"""Kind of look, or `auto` for the one that suits the picture."""

PictureLike = ImageLike | LargePicture | World | PanTiltCamera
"""A picture of any common kind and size (`semfov.as_image`), one that is read window by window, or a scene: a
`semfov.Panorama`, a `semfov.Flat`, or a camera that turns."""


class OpenedPicture:
    """A photograph, a large picture or a scene; what a kind of look needs of it is read when it is asked for."""

    def __init__(self, source: PictureLike, color: Color = "rgb") -> None:
        self.source, self.color = source, color
        self.scene = is_scene(source)

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
            size = picture_size(cast(ImageLike | LargePicture, self.source))
            return "windows" if photographs or pays(size, canvas) else "fovea"
        return "fovea"

    def image(self, like: Tensor) -> Tensor:
        """The pixels for a fovea, `(1, 3, H, W)`."""
        if isinstance(self.source, LargePicture):
            return as_image(self.source.read((0, 0, *self.source.size)), like=like, argument="picture")[None]
        return as_image(cast(ImageLike, self.source), like=like, argument="picture", color=self.color)[None]

    @cached_property
    def large(self) -> LargePicture:
        """The picture for windows."""
        return open_large(cast(ImageLike | LargePicture, self.source), color=self.color)

    @cached_property
    def world(self) -> World:
        """The scene for a head."""
        return open_scene(self.source, self.color)


def open_picture(source: "PictureLike | OpenedPicture", color: Color = "rgb") -> OpenedPicture:
    """Open a picture of any kind; one that is open stays as it is."""
    return source if isinstance(source, OpenedPicture) else OpenedPicture(source, color)


def pays(size: tuple[int, int], canvas: tuple[int, int]) -> bool:
    """Tell whether a picture is large enough for windows to pay: whether there are two octaves or more to zoom in.

    Shapes: size `(width, height)`, canvas `(width, height)`.
    """
    return Lattice.over(size, canvas).levels >= 3
