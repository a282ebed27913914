"""Pictures that a command names: files, those of folders, or examples that come with the package."""

import os
import traceback
from collections.abc import Mapping, Sequence
from glob import glob
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from semfov.agents.picture import How, PictureLike
from semfov.cli.options import GazeOptions, PictureOptions, white_of
from semfov.data.examples import example_scene
from semfov.data.large import open_large, picture_size
from semfov.data.scenes import CLASSES
from semfov.data.sources import VIDEOS, Picture, photographs, picture_files
from semfov.errors import DataError, InputError, SemfovError, check, printable
from semfov.head import Flat, Panorama
from semfov.io.files import disk_is_full

_DEBUG = "SEMFOV_DEBUG"  # variable of the environment that also prints where in the code a picture has failed

_EXAMPLE = "example:"  # before the name of a picture that comes with the package


class PictureSource(NamedTuple):
    """A picture to look at: `place` is its path in the folder that was named, `shown` are arguments of `open_large`."""

    name: str
    file: Path | None = None
    scene: Picture | None = None
    place: Path = Path("example")
    shown: Mapping[str, Any] = MappingProxyType({})

    def opened(self, how: How) -> PictureLike:
        """The picture, with the values and bands that are to be shown, or for a head the scene that it is one of."""
        picture: Any = str(self.file) if self.scene is None else self.scene.image
        if self.shown:
            picture = open_large(picture, **self.shown)
        if how != "head":
            return picture
        width, height = picture_size(picture)
        return Panorama(picture) if width == 2 * height else Flat(picture)

    def version(self) -> list[object]:
        """What changes with the file: its name, size and time of change."""
        if self.file is None:
            return [self.name]
        try:
            status = self.file.stat()
        except OSError:  # a link to nothing is skipped when it is opened
            return [self.name]
        return [printable(str(self.file.resolve())), status.st_size, status.st_mtime_ns]

    def fault(self, error: Exception, *, several: bool) -> SemfovError:
        """Return what is wrong with this picture, which is not the end of `several`; raise what ends a command."""
        if os.environ.get(_DEBUG):
            traceback.print_exception(error)
        if disk_is_full(error):
            raise DataError(f"{error}; make room, and give the same command again") from error
        if isinstance(error, SemfovError):
            return error
        if not several:
            raise error
        reason = " ".join(str(error).split()) or "no message"
        return DataError(f"{self.name}: cannot be looked at ({type(error).__name__}: {reason})")


def example_source(name: str, classes: Sequence[str] = CLASSES, target: str | None = None) -> PictureSource:
    """A picture that comes with the package, with the boxes of a target."""
    scene = example_scene(name, classes)
    boxes = None if target is None else scene.boxes[scene.labels == [*classes].index(target) + 1]
    return PictureSource(f"{_EXAMPLE}{name}", scene=Picture(name, scene.image, boxes), place=Path(name))


def picture_sources(options: PictureOptions | GazeOptions) -> list[PictureSource]:
    """The pictures that are named or match a pattern (`flight/*.jpg`); those of folders in the order of names."""
    sources: dict[str, PictureSource] = {}
    pictures, shown = options.pictures, _shown_by(options)
    # A file may have brackets in its name, as copies do: photo[1].jpg.
    patterns = (name if set(name) & set("*?[") and not os.path.lexists(name) else None for name in pictures)
    matched = ([] if pattern is None else sorted(glob(pattern, recursive=True)) for pattern in patterns)
    names = [each for one, some in zip(pictures, matched, strict=True) for each in some or [one]]
    # What a shell makes of `flight/*` is what is in a folder.
    kept = {*photographs([Path(name) for name in names], "pictures")} if len(names) > 1 else set()
    for name in [name for name in names if Path(name) in kept] or names:
        if name.startswith(_EXAMPLE):
            sources.setdefault(name, example_source(name.removeprefix(_EXAMPLE)))
            continue
        path = Path(name)
        check("://" not in name, "picture", "a file on this machine (`semfov live` takes streams)", repr(name))
        there = path.exists() or bool(path.suffix) or len(path.parts) > 1
        of_class = f" (a class is given by --target {name})" if hasattr(options, "target") else ""
        check(there, "picture", f"a file or folder{of_class}", f"{name}, which does not exist")
        video = path.suffix.lower() in VIDEOS and not path.is_dir()
        check(not video, "picture", "photographs; `semfov live` takes videos", name)
        for each in picture_files(path, recursive=options.recursive):
            place = each.relative_to(path) if path.is_dir() else Path(each.name)
            source = PictureSource(printable(str(each)), each, place=place, shown=shown)
            # A picture that is named twice, such as by its name and by its folder, is looked at once.
            sources.setdefault(os.path.abspath(each), source)
    return [*sources.values()]


def _shown_by(options: PictureOptions | GazeOptions) -> dict[str, Any]:
    """The values and the bands that are shown, as `semfov.data.large.open_large` takes them; those that are given."""
    white = white_of(options.white)
    shown: dict[str, Any] = {} if white is None else {"white": white}
    if options.bands is not None:
        try:
            numbers = tuple(int(each) for each in options.bands.split(","))
        except ValueError:
            raise InputError(f"bands: expected 4,3,2 or the number of one band, got {options.bands!r}") from None
        shown["bands"] = numbers
    return shown
