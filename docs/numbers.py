"""Fill the numbers of sentences from the tables of the pages and from the code: `python -m docs.numbers`.

`docs/numbers.toml` lists for each page its phrases with numbers, and where each number comes from:

- a list of cells, one for each `{}` of the phrase, or `{%}` for a share that is written as a percentage. A cell is
  `page: table | row | column`; without a page it is on the same one. A table has the name of its comment
  (`<!-- table NAME -->`) or else of its section, with ` (2)` for the second one there. A row is named by its first
  cells, with ` / ` between them, and a column by its head, with ` (2)` for the second number of the cell. ` minus `
  between two cells is their difference, and `code: name` a number of the code (`CODE`).
- a sentence: why no table has the numbers of the phrase.

A number keeps its count of decimals, and has a sign where one stands there. All percentages and numbers with decimals
in the sentences of `PAGES` must be listed, and those of other pages unless a command that their section names prints
them (`tests/test_numbers.py`).
"""

import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from math import log
from pathlib import Path

import torch

from examples.look_graph import OPSET
from semfov import FovealObservationModel
from semfov.agents.fovea import RATE as FOVEA_RATE
from semfov.agents.head import _CONFIRM
from semfov.agents.window_episode import LIKELY
from semfov.agents.windows import RATE as WINDOW_RATE
from semfov.belief import Verification
from semfov.data.inputs import FRAME
from semfov.decision import MOST_CLOSER
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.detector import FAINT
from semfov.detection.objects import FAINTEST, SCORE_THRESHOLD
from semfov.fit.photographs import LEAST_CERTAINTY
from semfov.head import Speeds
from semfov.io.files import write_text
from semfov.runs.config import BeliefConfig, DataConfig, DetectorConfig
from semfov.sensor.log_polar import _Retina
from semfov.zoom.closer import USUAL_WINDOW

ROOT = Path(__file__).parents[1]

PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("results", "tables", "zoom", "head", "human", "detectors")),
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/decisions/*.md")),
)
"""Pages whose sentences say again what tables have."""

OTHERS = tuple(
    sorted(
        path.relative_to(ROOT).as_posix()
        for names in ("*.md", "measurements/*.md", "guides/*.md")
        for path in ROOT.joinpath("docs").glob(names)
        if path.relative_to(ROOT).as_posix() not in PAGES
    )
)
"""Pages on which a number may also be printed by the command that its section names."""

_DATA = DataConfig()
_DETECTOR = DetectorConfig()
_SPEEDS = Speeds()
_COUNTS = torch.tensor(FovealObservationModel.from_pretrained("yolox-nano-published-narrow").metadata["counts"])
_RINGS, _WEDGES = _Retina(60.0).receptors((640, 480))
_VERIFICATION = Verification.from_pretrained("yolox-nano")

CODE: dict[str, float] = {
    "smallest number of boxes": _DATA.min_instances,
    "largest share of a target": _DATA.max_target_area or 1,
    "prior": BeliefConfig().prior,
    "threshold": _DETECTOR.threshold,
    "iou": _DETECTOR.iou,
    "limit": _DETECTOR.limit,
    "classes of COCO": len(COCO_CLASSES),
    "faint": FAINT,
    "score threshold of objects": SCORE_THRESHOLD,
    "faintest": FAINTEST,
    "likely": LIKELY,
    "window of photographs": USUAL_WINDOW[0],
    "least certainty of a closer look": LEAST_CERTAINTY,
    "opset": OPSET,
    "confirm of a head": _CONFIRM,
    "milliseconds of a saccade": 1000 * _SPEEDS.eye_start,
    "milliseconds a degree": 1000 * _SPEEDS.eye,
    "closer looks": MOST_CLOSER,
    "parameters of a verification": sum(each.numel() for each in _VERIFICATION.parameters()),
    "half-life in windows": log(2) / WINDOW_RATE,
    "rate of a fovea": FOVEA_RATE,
    "rate of a fovea a frame": FOVEA_RATE * FRAME,
    "frames a second": 1 / FRAME,
    "rings": _RINGS,
    "receptors of a ring": _WEDGES,
    "receptors": _RINGS * _WEDGES,
    "objects at the border": float(_COUNTS[1:].sum(0)[-1]),
    "detections at the border": float(_COUNTS.sum(0)[-1]),
    "objects at the fovea": float(_COUNTS[1:].sum(0)[0]),
    "detections at the fovea": float(_COUNTS.sum(0)[0]),
}
"""Numbers of the code that pages name."""

_DIGITS = r"[+−-]?\d(?:[\d,]*\d)?(?:\.\d+)?"
NUMBER = re.compile(rf"(?<![\w.,]){_DIGITS}(?![\w]|[.,]\d)")
_PLACE = re.compile(r"\{%?\}")  # of a number in a phrase
_ORDINAL = re.compile(r" \((\d)\)$")
_HIDDEN = re.compile(
    r"```.*?```|<!--.*?-->|`[^`]*`|\$[^$]*\$|(?<=\])\([^)]*\)|https?://\S+|^(?: {4}|#|\|)[^\n]*",
    re.DOTALL | re.M,
)
"""What is no sentence: code, comments, formulas, addresses, heads and tables."""
_MEASURED = re.compile(r"(?<![\w.,])\d[\d,]*(?:\.\d+(?![\w.])| ?%)")
"""Numbers that must be listed: those with decimals, and percentages."""
_COMMAND = re.compile(r"python -m|`(?:eval|train|benchmarks)\.|`semfov fit|commit [0-9a-f]{7}")


@dataclass(frozen=True)
class Cell:
    """A cell of a table, with what leads to it.

    Attributes:
        table: name of the table: that of its comment, or its section.
        row: the cells of its row; an empty first one is that of the row above.
        column: head of its column.
        text: what stands in it.
    """

    table: str
    row: tuple[str, ...]
    column: str
    text: str


@dataclass(frozen=True)
class Phrase:
    """A phrase with numbers.

    Attributes:
        words: the phrase, with a place for each number that is filled in.
        origin: the cell of each number, or why no table has them.
    """

    words: str
    origin: list[str] | str

    @property
    def pattern(self) -> re.Pattern[str]:
        """Matches the phrase in a page, wherever its lines are broken; numbers are groups."""
        parts = [re.sub(r"(?:\\ )+", r"\\s+", re.escape(part)) for part in _PLACE.split(self.words)]
        return re.compile(rf"(?<![\w.]){f'({_DIGITS})'.join(parts)}(?!\w)")

    @property
    def is_percentage(self) -> list[bool]:
        """Whether each number is the percentage of a share."""
        return ["%" in place for place in _PLACE.findall(self.words)]


@cache
def text_of(page: str) -> str:
    """Read a page."""
    return (ROOT / page).read_text(encoding="utf-8")


@cache
def phrases() -> dict[str, list[Phrase]]:
    """Read the list of phrases, by their pages."""
    pages = tomllib.loads(text_of("docs/numbers.toml"))
    return {page: [Phrase(words, origin) for words, origin in listed.items()] for page, listed in pages.items()}


@cache
def cells_of(page: str) -> tuple[Cell, ...]:
    """List the cells of all tables of a page."""
    return tuple(_cells(text_of(page)))


def _cells(text: str) -> Iterator[Cell]:
    """Walk through the lines of a page, and yield the cells of its tables."""
    section = ""
    comment = ""  # name of the next table
    name = ""  # name of this table
    count = 0  # of the tables of the section
    head: list[str] = []
    above = ""  # first cell of the row above
    for line in re.sub(r"```.*?```", "", text, flags=re.DOTALL).splitlines():
        if line.startswith("#"):
            section = line.strip("# ")
            count = 0
        elif line.startswith("<!-- table "):
            comment = line.removeprefix("<!-- table ").partition(" --")[0]
        if not line.startswith("|"):
            head = []
            continue
        parts = [part.strip() for part in line.strip().strip("|").split("|")]
        if not head:
            head = parts
            count += 1
            name = comment or (section if count == 1 else f"{section} ({count})")
            comment = ""
            continue
        above = parts[0] or above
        for column, part in zip(head, parts, strict=False):
            yield Cell(name, (above, *parts[1:]), column, part)


def value_of(origin: str, page: str) -> float:
    """Look up a number.

    Args:
        origin: where it comes from, as in the list.
        page: the page with the sentence.

    Returns:
        The number.

    Raises:
        LookupError: there is no such cell, or there are several.
    """
    if origin.startswith("code: "):
        return CODE[origin.removeprefix("code: ")]
    first, minus, second = origin.partition(" minus ")
    if minus:
        return value_of(first, page) - value_of(second, page)
    named = re.match(r"([\w./-]+\.md): ", origin)
    table, row, column = origin[named.end() if named else 0 :].split(" | ")
    ordinal = _ORDINAL.search(column)
    found = [
        cell.text
        for cell in cells_of(named[1] if named else page)
        if cell.table == table
        and {*row.split(" / ")} <= {*cell.row}
        and cell.column == (column[: ordinal.start()] if ordinal else column)
    ]
    if len(found) != 1:
        raise LookupError(f"{origin}: expected one cell, got {found or 'none'}")
    numbers = NUMBER.findall(found[0].replace("/", " "))
    return _number(numbers[int(ordinal[1]) - 1 if ordinal else 0])


def _number(text: str) -> float:
    """Read a number as pages write it."""
    return float(text.replace(",", "").replace("−", "-"))


def filled(text: str, page: str, listed: list[Phrase]) -> str:
    """Fill the numbers of a page from their tables.

    Args:
        text: the page.
        page: its path from the root.
        listed: its phrases.

    Returns:
        The page with the numbers of the tables.

    Raises:
        LookupError: a phrase is not there, or there is not one cell for a number.
    """
    for phrase in listed:
        match = phrase.pattern.search(text)
        if match is None:
            raise LookupError(f"{page}: this phrase is not there, docs/numbers.toml has it: {phrase.words}")
        if isinstance(phrase.origin, str):
            continue
        values = [value_of(origin, page) for origin in phrase.origin]
        for number, (value, percent) in reversed([*enumerate(zip(values, phrase.is_percentage, strict=True), 1)]):
            start, end = match.span(number)
            text = text[:start] + _written(100 * value if percent else value, match[number]) + text[end:]
    return text


def _written(value: float, before: str) -> str:
    """Write a number with the digits and the sign of the one that stands there."""
    digits = len(before.partition(".")[2])
    number = f"{abs(value):{',' if ',' in before else ''}.{digits}f}"
    if before[0].isdigit():
        return number
    return ("+" if value >= 0 else before[0].replace("+", "-")) + number


def without_commands(text: str) -> str:
    """Leave out the sections of a page that name the command which prints their numbers."""
    return "\n".join(section for section in re.split(r"\n(?=#+ )", text) if not _COMMAND.search(section))


def not_listed(text: str, listed: list[Phrase]) -> list[str]:
    """List the numbers of sentences that no phrase has, each with the words around it.

    Args:
        text: the page.
        listed: its phrases.

    Returns:
        The words around each number.
    """
    plain = _HIDDEN.sub(lambda match: re.sub(r"\S", " ", match[0]), text)
    spans = [match.span() for phrase in listed for match in phrase.pattern.finditer(text)]
    return [
        " ".join(text[max(match.start() - 60, 0) : match.end() + 30].split())
        for match in _MEASURED.finditer(plain)
        if not any(start <= match.start() and match.end() <= end for start, end in spans)
    ]


def main() -> int:
    """Fill the numbers of all pages, and return the exit code."""
    for page, listed in phrases().items():
        try:
            text = filled(text_of(page), page, listed)
        except LookupError as error:
            print(error, file=sys.stderr)
            return 1
        if text != text_of(page):
            write_text(ROOT / page, text)
            print(f"written: {page}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
