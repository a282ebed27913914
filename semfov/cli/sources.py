"""The pictures of a command: files, all pictures of folders, or examples that come with the package."""

import os
import sys
import traceback
import warnings
from collections.abc import Iterable, Sequence
from glob import glob
from itertools import chain
from pathlib import Path
from typing import NamedTuple, TypedDict, cast

from torch import Tensor
from tqdm import tqdm

from semfov.agents.picture import PictureLike
from semfov.cli.options import CompareOptions, GazeOptions, PictureOptions, white_of
from semfov.data.examples import example_scene
from semfov.data.inputs import ImageLike
from semfov.data.large import open_large, picture_size
from semfov.data.picture_files import VIDEOS, photographs, picture_files
from semfov.data.scenes import CLASSES
from semfov.data.sources import Picture
from semfov.data.tone import White
from semfov.data.windowed import LargePicture
from semfov.errors import DataError, InputError, SemfovError, check, printable, reason_of
from semfov.head import Flat, Panorama
from semfov.io.files import disk_is_full, is_pattern
from semfov.settings import How

_DEBUG = "SEMFOV_DEBUG"  # variable of the environment that also prints where in the code a picture has failed

FlatPicture = str | Tensor | LargePicture  # a picture that is no scene: a file, pixels, or one that is open

EXAMPLE = "example:"
"""What is before the name of a picture that comes with the package."""


class _Shown(TypedDict, total=False):
    """Values and bands of a picture that are shown, as arguments of `semfov.data.large.open_large`."""

    white: White
    bands: tuple[int, ...]


class PictureSource(NamedTuple):
    """A picture to look at, which is opened when it is looked at.

    Attributes:
        name: name of the picture, as results have it.
        file: its file; None for a picture that comes with the package.
        scene: the picture that comes with the package; None for a file.
        place: path in the folder that was named.
        shown: the values and the bands that are shown, as arguments of `open_large`.
    """

    name: str
    file: Path | None = None
    scene: Picture | None = None
    place: Path = Path("example")
    shown: _Shown = _Shown()  # never changed

    @property
    def is_escaped(self) -> bool:
        """Whether the name of the file has characters that results do not have."""
        return self.file is not None and self.name != str(self.file)

    def picture(self) -> FlatPicture:
        """Open the picture, with the values and bands that are to be shown."""
        picture = str(self.file) if self.scene is None else self.scene.image
        return open_large(picture, **self.shown) if self.shown else picture

    def opened(self, how: How) -> PictureLike:
        """Open the picture for a kind of look: for a head it is the scene in front of the viewer, or a panorama.

        Args:
            how: kind of look, or `auto`.

        Returns:
            The picture, or the scene that it shows.
        """
        picture = self.picture()
        if how != "head":
            return picture
        width, height = picture_size(picture)
        pixels = cast(ImageLike, picture)  # scenes take pictures that are open, too
        return Panorama(pixels) if width == 2 * height else Flat(pixels)

    def version(self) -> list[object]:
        """Return the file's name, size and time of change, which show whether it has changed."""
        if self.file is None:
            return [self.name]
        try:
            status = self.file.stat()
        except OSError:  # a link to nothing is skipped when it is opened
            return [self.name]
        return [printable(str(self.file.resolve())), status.st_size, status.st_mtime_ns]

    def tell_example(self) -> None:
        """Print that this example is used because no picture was given."""
        print(f"no picture was given: looking at {self.name}, which comes with semfov")

    def tell_skipped(self, fault: Exception) -> None:
        """Say why this picture is left out, beside the progress bar of the others."""
        tqdm.write(f"skipped {self.name}: {fault}", file=sys.stderr)

    def skip(self, error: Exception, *, several: bool) -> None:
        """Leave this picture out of several after an error, and say why; the error of a single one is raised."""
        fault = self.fault(error, several=several)
        if not several:
            raise fault
        self.tell_skipped(fault)

    def fault(self, error: Exception, *, several: bool) -> SemfovError:
        """Say what is wrong with this picture.

        Args:
            error: what was raised when it was looked at.
            several: whether other pictures can still be looked at.

        Returns:
            The error of this picture.

        Raises:
            DataError: the disk is full, which ends the command.
            Exception: a fault of the code, at a single picture.
        """
        if os.environ.get(_DEBUG):
            traceback.print_exception(error)
        if disk_is_full(error):
            raise DataError(f"{error}; make room, and give the same command again") from error
        if isinstance(error, SemfovError):
            return error
        if not several:
            raise error
        reason = reason_of(error) or "no message"
        return DataError(f"{self.name}: cannot be looked at ({type(error).__name__}: {reason})")


def example_source(name: str, classes: Sequence[str] = CLASSES, target: str | None = None) -> PictureSource:
    """Take a picture that comes with the package, with the boxes of a target.

    Args:
        name: name of the picture.
        classes: names of the classes, of which the boxes have their labels.
        target: class whose boxes it has; None for no boxes.

    Returns:
        The picture.
    """
    scene = example_scene(name, classes)
    boxes = None if target is None else scene.boxes[scene.labels == [*classes].index(target) + 1]
    return PictureSource(f"{EXAMPLE}{name}", scene=Picture(name, scene.image, boxes), place=Path(name))


def picture_sources(options: PictureOptions | GazeOptions | CompareOptions) -> list[PictureSource]:
    """Find the pictures that are named or match a pattern (`flight/*.jpg`); those of folders in the order of names.

    Args:
        options: the options of a command.

    Returns:
        The pictures, each once.

    Raises:
        InputError: there is no such file or folder, or it is no picture.
    """
    sources: dict[str, PictureSource] = {}
    shown = _shown_by(options)
    for name in _names_of_pictures(options.pictures):
        if name.startswith(EXAMPLE):
            sources.setdefault(name, example_source(name.removeprefix(EXAMPLE)))
            continue
        _check_may_be_picture(name, has_target=hasattr(options, "target"))
        path = Path(name)
        for file in picture_files(path, recursive=options.recursive):
            place = file.relative_to(path) if path.is_dir() else Path(file.name)
            source = PictureSource(printable(str(file)), file, place=place, shown=shown)
            # A picture that is named twice, such as by its name and by its folder, is looked at once.
            sources.setdefault(os.path.abspath(file), source)
    _warn_of_escapes([source.name for source in sources.values() if source.is_escaped])
    return [*sources.values()]


def _warn_of_escapes(names: Sequence[str]) -> None:
    """Warn of names of files that no table can hold as they are."""
    if names:
        text = f"{len(names)} with control characters or bytes that are not UTF-8 in the name, such as {names[0]}"
        warnings.warn(f"pictures: {text}; results have these escapes: rename them to find them again", stacklevel=3)


def _names_of_pictures(words: Iterable[str]) -> list[str]:
    """List the files and folders that words name or match; of several, those that may be photographs."""
    names = [*chain.from_iterable(map(_matching, words))]
    if len(names) <= 1:
        return names
    # What a shell makes of `flight/*` is what is in a folder, where other files than photographs are left out.
    photos = {*photographs([Path(name) for name in names], "pictures")}
    return [name for name in names if Path(name) in photos] or names


def _matching(word: str) -> list[str]:
    """Find the files that match a pattern; what is none, or matches nothing, stands for itself."""
    if not is_pattern(word):
        return [word]
    return sorted(glob(word, recursive=True)) or [word]


def _check_may_be_picture(name: str, *, has_target: bool) -> None:
    """Raise `InputError` for what is no picture: an address, standard input, a word that is no file, or a video."""
    remedy = "standard input is not read: write the picture to a file"
    check(name != "-", "picture", "a file or folder", f"-; {remedy}")
    if "://" in name:
        is_stream = name.lower().startswith(("rtsp", "rtmp", "udp", "tcp", "srt"))
        remedy = "`semfov live` takes streams" if is_stream else "download it first"
        raise InputError(f"picture: expected a file on this machine, got {name!r}; {remedy}")
    path = Path(name)
    looks_like_file = path.exists() or bool(path.suffix) or len(path.parts) > 1
    of_class = f" (a class is given by --target {name})" if has_target else ""
    check(looks_like_file, "picture", f"a file or folder{of_class}", f"{name}, which does not exist")
    is_video = path.suffix.lower() in VIDEOS and not path.is_dir()
    check(not is_video, "picture", "photographs; `semfov live` takes videos", name)


def _shown_by(options: PictureOptions | GazeOptions | CompareOptions) -> _Shown:
    """Take the values and the bands that are to be shown, as arguments of `semfov.data.large.open_large`."""
    shown: _Shown = {}
    white = white_of(options.white)
    if white is not None:
        shown["white"] = white
    if options.bands is not None:
        try:
            shown["bands"] = tuple(int(number) for number in options.bands.split(","))
        except ValueError:
            raise InputError(f"bands: expected 4,3,2 or the number of one band, got {options.bands!r}") from None
    return shown
