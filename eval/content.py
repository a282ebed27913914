r"""Planted faults: `python -m eval.content` measures what `semfov check` knows from the pictures of recordings.

    python -m eval.content --fixations osie/fixations.json --pictures osie/images --detector.name yolox-nano \
        --model other.safetensors --sets 100

Sets of pictures are drawn from a data set of fixations, and each set is read wrongly in thirteen ways, one after the
other, and rightly. The table has the share of the sets in which the fault is named, of `semfov.human.content` alone and
of the rules without pictures (`semfov.data.fixations.suspicions`). A model that was fitted to other pictures makes the
test honest. With `--page PAGE.md` the table `content` of the page is replaced.
"""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from eval.human.viewing import write_tables
from semfov.data.fixations import Fixations, suspicions
from semfov.data.reading import read_image
from semfov.detection.load import load_detector
from semfov.errors import check
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.human import content_suspicions
from semfov.human.fixations.reading import frame_of, read_fixations
from semfov.io.ranges import Seed, Whole
from semfov.paths.gaze import GazePrediction
from semfov.runs.command import command
from semfov.runs.config import DetectorConfig
from semfov.runs.progress import track
from semfov.runs.settings import Settings
from semfov.runs.setup import detector_options
from semfov.runs.tables import table

_Points = NDArray[np.float64]


@dataclass(frozen=True)
class ContentConfig(Settings):
    """Plant faults in recordings of fixations, and count those that are named.

    Args:
        fixations: file of fixations in pixels of the pictures.
        frame: frame of a file that has none, as `640x480` (none: that of its format, such as 800x600 of OSIE's files).
        pictures: folder of the pictures.
        detector: the detector whose feature maps the model reads.
        model: file of a model of where people look (none: the one that is shipped for the detector).
        without: people whose fixations are left out, such as those of a person whose calibration was off.
        sets: number of sets.
        size: number of pictures in a set.
        seed: seed of the generator that draws the sets.
        page: page with a place for the table (`<!-- table content -->` to `<!-- end -->`); none: it is left alone.
        out: folder for the table.
    """

    fixations: Path = Path("fixations.json")
    frame: str | None = None
    pictures: Path = Path("images")
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    model: Path | None = None
    without: tuple[str, ...] = ()
    sets: Whole = 100
    size: Whole = 20
    seed: Seed = 0
    page: Path | None = None
    out: Path = Path("runs/content")


@dataclass(frozen=True)
class _Fault:
    """A way to read recordings wrongly.

    Attributes:
        words: what the line that names it says.
        change: maps points in pixels of a picture, its size, the person's number and the picture's number to those of
            the file.
        frame: size of the frame that the file states; None for that of the picture.
        renamed: maps the names of the pictures to those in the file; None for the same.
        offset: `(x, y)` in pixels that the line should name; None where it names no such offset.
    """

    words: tuple[str, ...]
    change: Callable[[_Points, _Points, int, int], _Points]
    frame: tuple[int, int] | None = None
    renamed: Callable[[list[str], np.random.Generator], list[str]] | None = None
    offset: tuple[int, int] | None = None


def _same(points: _Points, size: _Points, person: int, order: int) -> _Points:
    return points


_SCREEN = (1680, 1050)

_FAULTS = {
    "y upwards": _Fault(("y ran upwards",), lambda p, size, *_: np.stack([p[:, 0], size[1] - 1 - p[:, 1]], 1)),
    "mirrored": _Fault(("x ran from right",), lambda p, size, *_: np.stack([size[0] - 1 - p[:, 0], p[:, 1]], 1)),
    "turned by half a circle": _Fault(("turned",), lambda p, size, *_: size - 1 - p),
    "y before x": _Fault(("y came before x",), lambda p, *_: p[:, ::-1]),
    "half the size, in the middle": _Fault(("filled about 50 %",), lambda p, size, *_: size / 2 + (p - size / 2) / 2),
    "own size on a screen": _Fault(
        ("own size",), lambda p, size, *_: p + (np.array(_SCREEN) - size) / 2, frame=_SCREEN
    ),
    "stretched over a screen": _Fault(("stretched",), lambda p, size, *_: p * np.array(_SCREEN) / size, frame=_SCREEN),
    "pixels of a larger frame": _Fault(("another size",), lambda p, *_: p * 1.6),
    "shifted by (60, 60)": _Fault(("all fixations lie about",), lambda p, *_: p + 60, offset=(60, 60)),
    "one person shifted by (70, -50)": _Fault(
        ("of person",), lambda p, size, person, _: p + np.array([70, -50]) * (person == 3), offset=(70, -50)
    ),
    "drift by (5, -3) from picture to picture": _Fault(
        ("second half", "all fixations lie about", "of person"),
        lambda p, size, person, order: p + np.array([5, -3]) * order,
    ),
    "names of the next pictures": _Fault(
        ("before theirs", "after theirs"), _same, renamed=lambda names, _: names[1:] + names[:1]
    ),
    "names of other pictures": _Fault(
        ("do not fit the pictures",), _same, renamed=lambda names, rng: [names[n] for n in _deranged(len(names), rng)]
    ),
    "none": _Fault(("",), _same),  # any line names it
}

_CLOSE_OFFSET = 10  # pixels, along both axes
_OFFSET = re.compile(r"\((-?\d+), (-?\d+)\) px")


def _deranged(count: int, rng: np.random.Generator) -> list[int]:
    """Draw an order in which nothing keeps its place."""
    while True:
        order = rng.permutation(count)
        if (order != np.arange(count)).all():
            return [int(number) for number in order]


def measure(config: ContentConfig) -> list[str]:
    """Plant all faults in all sets.

    Returns:
        The lines of the table.
    """
    by_picture: dict[str, list[Fixations]] = {}
    frame = {} if config.frame is None else {"size": frame_of(config.frame, "frame")}
    for record in read_fixations(config.fixations, **frame):
        if record.subject not in config.without and len(record):
            by_picture.setdefault(record.picture, []).append(record)
    names = sorted(by_picture)
    check(len(names) >= config.size, "size", f"at most the {len(names)} pictures that somebody looked at", config.size)
    densities, sizes = _densities(config, names)
    rng = np.random.default_rng(config.seed)
    counts = {fault: _Counts() for fault in _FAULTS}
    for _ in track(range(config.sets), "sets", "set"):
        chosen = sorted(rng.choice(names, config.size, replace=False).tolist())
        for name, fault in _FAULTS.items():
            records = _read_wrongly(fault, chosen, by_picture, rng)
            lines = content_suspicions(records, densities, sizes)
            counts[name].add(fault, lines, suspicions(records, sizes))
    rows = [["fault", "named by content", "offset right within 10 px", "anything suspicious by rules"]]
    rows += [[fault, *of_fault.cells(config.sets)] for fault, of_fault in counts.items()]
    return table(rows)


@dataclass
class _Counts:
    """Sets in which a fault is found, of all that were read with it.

    Attributes:
        named: sets in which a line by content names it; of sound recordings those with any line.
        by_rules: sets in which the rules without pictures say anything.
        offset_errors: for each set in which its offset is named, how far that is from the planted one, in pixels.
    """

    named: int = 0
    by_rules: int = 0
    offset_errors: list[float] = field(default_factory=list)

    def add(self, fault: _Fault, lines: list[str], lines_by_rules: list[str]) -> None:
        """Count what is said of a set."""
        naming = [line for line in lines if any(words in line for words in fault.words)]
        self.named += bool(naming)
        self.by_rules += bool(lines_by_rules)
        if fault.offset is not None and naming:
            self.offset_errors.append(_offset_error(naming[0], fault.offset))

    def cells(self, sets: int) -> list[str]:
        """Write the shares of the sets; that of right offsets is of those in which one is named."""
        close = [error <= _CLOSE_OFFSET for error in self.offset_errors]
        right_offset = f"{sum(close) / len(close):.2f}" if close else ""
        return [f"{self.named / sets:.2f}", right_offset, f"{self.by_rules / sets:.2f}"]


def _offset_error(line: str, offset: tuple[int, int]) -> float:
    """Compute how far the offset `(x, y)` that a line names is from the planted one, in pixels, in x or in y."""
    found = _OFFSET.search(line)
    assert found is not None, line
    return max(abs(int(value) - planted) for value, planted in zip(found.groups(), offset, strict=True))


def _densities(config: ContentConfig, names: list[str]) -> tuple[dict[str, Tensor], dict[str, tuple[int, int]]]:
    """Predict where people look in the pictures; returns densities and sizes by the pictures' names."""
    detector = load_detector(config.detector.name, **detector_options(config.detector))
    model = None if config.model is None else FixationDensity.from_pretrained(config.model)
    densities = {}
    sizes = {}
    with torch.inference_mode():
        for name in track(names, "pictures", "picture"):
            prediction = GazePrediction.of(detector, read_image(config.pictures / name), model=model)
            densities[name] = prediction.cells
            sizes[name] = prediction.size
    return densities, sizes


def _read_wrongly(
    fault: _Fault, names: list[str], by_picture: dict[str, list[Fixations]], rng: np.random.Generator
) -> list[Fixations]:
    """Take the records of some pictures as they are read with a fault."""
    renamed = names if fault.renamed is None else fault.renamed(names, rng)
    people = sorted({record.subject for name in names for record in by_picture[name]})
    records = []
    for order, (name, name_read) in enumerate(zip(names, renamed, strict=True)):
        for record in by_picture[name]:
            size = np.array(record.size, np.float64)
            points = fault.change(record.points, size, people.index(record.subject), order)
            records.append(replace(record, picture=name_read, points=points, size=fault.frame or record.size, box=None))
    return records


def run(config: ContentConfig) -> None:
    """Print the table, and write it."""
    lines = measure(config)
    write_tables("\n".join([*lines, ""]), {"content": lines}, config.out, config.page)


main = command(run, ContentConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
