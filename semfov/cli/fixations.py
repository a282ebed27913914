"""Subcommand check: says what is suspicious in files of fixations."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from semfov.cli.content import suspicions_by_content
from semfov.cli.options import CheckOptions
from semfov.data.fixations import Fixations, suspicions
from semfov.data.fixations.exports import PictureError
from semfov.data.fixations.reading import DATA_SETS, frame_of, read_by, reader_of
from semfov.data.fixations.table import FrameError
from semfov.data.large import picture_size
from semfov.data.sources import PHOTOGRAPHS, picture_files
from semfov.errors import DataError, SemfovError, check, printable


class _PictureSizes(Mapping[str, tuple[int, int]]):
    """`(width, height)` of a picture or those in a folder, by names as tables have them: with any path and ending."""

    def __init__(self, folder: Path) -> None:
        self._files: dict[str, Path] = {}
        for path in picture_files(folder, recursive=True):
            for name in (path.stem, path.name, path.relative_to(folder).as_posix()):
                self._files[name.lower()] = path
        self._sizes: dict[Path, tuple[int, int]] = {}

    def path(self, name: str) -> Path:
        """The file of a picture by its name; `KeyError` where there is none."""
        whole = name.lower().replace("\\", "/")
        parts = whole.split("/")
        names = [*("/".join(parts[first:]) for first in range(len(parts))), Path(parts[-1]).stem]
        path = next((self._files[each] for each in names if each in self._files), None)
        if path is None:
            raise KeyError(name)
        return path

    def __getitem__(self, name: str) -> tuple[int, int]:
        path = self.path(name)
        if path not in self._sizes:
            self._sizes[path] = picture_size(path)
        return self._sizes[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def check_fixations(options: CheckOptions) -> int:
    """Print what is in files of fixations, and what is suspicious; returns the exit code, 1 if anything is."""
    check(len(options.files) > 0, "file", "a file of fixations, such as people.csv", "none")
    given: dict[str, Any] = {} if options.size is None else {"size": frame_of(options.size)}
    given |= {name: getattr(options, name) for name in ("picture", "subject") if getattr(options, name) is not None}
    if options.columns is not None:
        given["columns"] = {
            ours.strip(): theirs.strip()
            for ours, _, theirs in (each.partition("=") for each in options.columns.split(","))
        }
        for ours, theirs in given["columns"].items():
            check(bool(theirs), "columns", f"the file's name of {ours}, as in x=FPOGX,y=FPOGY", "none")
    place = None if options.picture is None else Path(options.picture)
    folder = place is not None and place.is_dir()
    if folder:
        del given["picture"]
    pictures = place is not None and (folder or (place.is_file() and place.suffix.lower() in PHOTOGRAPHS))
    sizes = _PictureSizes(place) if place is not None and pictures else None
    wrong = False
    for name in options.files:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of what the lines below say
                reader = reader_of(Path(name), given.get("columns"))
                records = _records(reader, Path(name), given, sizes)
            if sizes is not None and not folder:  # one picture is compared with what was looked at in it
                records = [each for each in records if each.picture in sizes] or records
            lines = suspicions(records, sizes)
            if sizes is not None and not options.rules_alone:
                lines += suspicions_by_content(records, sizes.path, sizes, quiet=options.quiet)
        except SemfovError as error:
            if len(options.files) == 1:
                raise
            print(f"{printable(name)}: cannot be read: {error}")
            wrong = True
            continue
        kind = DATA_SETS.get(reader)
        usual = f" (those of {kind}, or give --size)" if kind in ("OSIE", "COCO-Search18") and not options.size else ""
        print(f"{printable(name)}: {_content(records, usual)}")
        compared = "" if sizes is not None else "; frames were not compared with pictures (--picture FOLDER)"
        found = [f"  suspicious: {line}" for line in lines] or [f"  nothing is suspicious{compared}"]
        print(*found, sep="\n")
        wrong = wrong or bool(lines)
    return 1 if wrong else 0


def _records(
    reader: Callable[..., list[Fixations]], path: Path, given: dict[str, Any], sizes: _PictureSizes | None
) -> list[Fixations]:
    """The records of a file; where it has no frames, they are the pictures."""
    unnamed = {name: value for name, value in given.items() if name != "picture"}
    if "picture" in given and "picture" not in signature(reader).parameters:
        # The file names its pictures.
        check(sizes is not None, "picture", "a picture or folder that exists", given["picture"])
        return _records(reader, path, unnamed, sizes)
    if "picture" in given and sizes is not None:  # a photograph, which may be one of those that the table names
        with suppress(PictureError):
            return _records(reader, path, unnamed, sizes)
    try:
        return read_by(reader, path, given)
    except FrameError as error:
        if sizes is None:
            raise DataError(f"{error}, or give its pictures by --picture FOLDER") from None
        return read_by(reader, path, {**given, "size": sizes})


def _content(records: list[Fixations], usual: str) -> str:
    """What is in the records, in a line; `usual` is said of frames that the file does not tell."""
    if not records:
        return "no fixations"
    people, pictures = ({getattr(each, name) for each in records} for name in ("subject", "picture"))
    sizes = sorted({each.size for each in records})
    frames = ", ".join(f"{width} × {height}" for width, height in sizes[:3]) + (", …" if sizes[3:] else "")
    counts = ((sum(map(len, records)), "fixation"), (len(records), "scanpath"), (len(people), "person"))
    words = ", ".join(f"{n} {name if n == 1 else {'person': 'people'}.get(name, f'{name}s')}" for n, name in counts)
    times = [each.durations for each in records if each.durations is not None]
    lasting = f"; they take {np.median(np.concatenate(times)):g} ms in the median" if times else "; without durations"
    return f"{words}, {len(pictures)} picture{'' if len(pictures) == 1 else 's'}, frames of {frames}{usual}{lasting}"
