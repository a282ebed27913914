"""The outcome for one picture: texts, rows of results, figures, and its part of a page."""

from __future__ import annotations

import tempfile
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.agents.picture import PictureLike
from semfov.cli.formats import ResultsFormat
from semfov.cli.options import ALL_DRAWINGS, PictureOptions
from semfov.cli.results import STDOUT, kind_of, results_format
from semfov.cli.sources import PictureSource
from semfov.cli.truth import Truth
from semfov.data.classes import amount
from semfov.decision import Decision
from semfov.detection.objects import box_text
from semfov.io.files import plain_name
from semfov.kinds import Drawing
from semfov.paths import Record
from semfov.paths.conversion import Values
from semfov.paths.look import CONFIDENT, RecordedLook, detections_in_words
from semfov.paths.regions import Region

if TYPE_CHECKING:
    from semfov.report.episode import Data

_OBJECTS_LISTED = 20  # largest number of objects that are listed
_CROP_QUALITY = 92  # of the JPEGs of crops


def _outcome_text(record: Record, name: str, seconds: float) -> str:
    """Say what was found where, with what, and in how many passes and seconds."""
    width, height = record.size
    decision = record.decision
    headline = record.words.objects if decision is None else _decision_text(record, decision)
    # That the passes were used up is said with their number.
    reason = record.words.lack() if record.ending == "passes" else record.words.ended
    sentences = [reason, f"{_effort_text(record, seconds)}."]
    lines = [f"{name}, {width} × {height} px: {headline}", f"  {' '.join(filter(None, sentences))}"]
    assumption = record.words.assumption()
    if assumption:
        lines.append(f"  {assumption}")
    if decision is None:
        lines += _regions_lines(record)
        lines += _objects_lines(record)
    return "\n".join(lines)


def _effort_text(record: Record, seconds: float) -> str:
    """Say how many looks were made, and how long they took on this machine and, of a head, on its own clock."""
    limit = " (the limit of --passes)" if record.ending == "passes" else ""
    text = f"{amount(record.passes, 'look')}{limit} in {seconds:.1f} s"
    if not record.kind.turns:
        return text
    return f"{text} on this machine, {record[-1].seconds:.1f} s of eye and head"


def _decision_text(record: Record, decision: Decision) -> str:
    """Say whether the target was found, and where."""
    name = str(record.target_name)
    decided_by = record.words.decided_by
    measure = "probability that the picture holds it:" if decided_by == "probability" else decided_by
    probability = f"{measure} {decision.probability:.2f}"
    if decision.outcome == "found":
        return f"found {name}{_place_text(record, decision)}, {probability}"
    is_absent = decision.outcome == "absent"
    verdict = f"{name} is {record.words.doubt}not there" if is_absent else record.words.verdict(name)
    return "; ".join(filter(None, (f"{verdict}, {probability}", record.words.best_place)))


def _place_text(record: Record, decision: Decision) -> str:
    """Say where the target was found, as far as it is known."""
    text = ""
    if record.found_at is not None:
        x, y = record.found_at
        text = f" at ({x:z.0f}, {y:z.0f})"
    if decision.box is not None:
        text += f", box {box_text(decision.box.tolist())}"
    return text


def _objects_lines(record: Record) -> list[str]:
    """Write a line for each of the most confident objects."""
    rows = record.object_rows()
    lines = [_object_line(row) for row in rows[:_OBJECTS_LISTED]]
    if len(rows) > _OBJECTS_LISTED:
        lines.append(f"  and {len(rows) - _OBJECTS_LISTED} more (--out FILE.json writes all)")
    if not record.sought and len(rows) > 1:
        lines.append(f"  in all: {record.words.classes}")
    return lines


def _object_line(row: Values) -> str:
    """Write the line of an object, a row of `Record.object_rows`."""
    corners = row["x1"], row["y1"], row["x2"], row["y2"]
    line = f"  {row['class']} {row['score']:.2f} at ({row['x']:z.0f}, {row['y']:z.0f}), box {box_text(corners)}"
    return f"{line}, confirmed" if row["confirmed"] else line


def _regions_lines(record: Record) -> list[str]:
    """Write a line for each class that was looked for and that the final map names, with its most probable cell."""
    sought = [record.classes[label] for label in record.targets] or record.classes
    cells = Counter[str]()
    best: dict[str, Region] = {}
    for region in record.regions():
        if region.name not in sought:
            continue
        cells[region.name] += len(region.cells)
        best[region.name] = max(best.get(region.name, region), region, key=lambda other: other.probability)
    lines = []
    for name, count in cells.most_common():
        x, y = best[name].place
        chance = f"p up to {best[name].probability:.2f}"
        lines.append(f"  map: {name} in {amount(count, 'cell')}, {chance} around ({x:z.0f}, {y:z.0f})")
    return lines


def _looks_text(record: Record) -> str:
    """Write the looks as a table: where, which part of the picture, what was detected, and when it ended."""
    headings = ["look", "at (x, y)", "shows", f"detections from score {CONFIDENT:g} on", "value", "s"]
    rows = [_look_row(record, look) for look in record]
    lines = [f"  {line}" for line in table_lines([headings, *rows])]
    if any(look.value is not None for look in record):
        lines.append(f"  value: {record.words.value}")
    if record.closer:
        lines += [_closer_line(record, number) for number in range(len(record.closer))]
        lines.append("  in the picture: by all looks so far, so also where that closer look shows nothing of it")
    return "\n".join(lines)


def _closer_line(record: Record, number: int) -> str:
    """Write a line of a closer look, by its number from 0: where it looked, and what is probable after it."""
    close_up = record.closer[number]
    line = f"  closer look {number + 1} at {box_text(close_up.box.tolist())}: p {close_up.place:.3f} there"
    line += f", {close_up.presence:.3f} in the picture"
    is_decision = record.decision is not None and close_up.presence == record.decision.probability
    return f"{line}, as decided" if is_decision else line


def _look_row(record: Record, look: RecordedLook) -> list[str]:
    """Write the cells of a look in the table of looks."""
    x, y = look.fixation
    return [
        str(look.number),
        f"({x:z.0f}, {y:z.0f})",
        "the whole picture" if record.is_whole(look.region) else box_text(look.region),
        detections_in_words(look.detections, record.classes, target=record.target),
        "" if look.value is None else f"{look.value:.3f}",
        "" if look.seconds is None else f"{look.seconds:.2f}",
    ]


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Write rows of equal length as lines with aligned columns.

    Args:
        rows: the texts of the cells.

    Returns:
        The lines.
    """
    widths = [max(map(terminal_columns, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [padded(text, width) for text, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines


def padded(text: str, width: int) -> str:
    """Fill a text with blanks to a number of columns of a terminal."""
    return text + " " * (width - terminal_columns(text))


def terminal_columns(text: str) -> int:
    """Count the columns of a terminal that a text takes: two for a wide letter, none for a combining one.

    >>> terminal_columns("dog"), terminal_columns("\N{CJK UNIFIED IDEOGRAPH-72AC}"), terminal_columns("e\u0301")
    (3, 2, 1)
    """
    columns = 0
    for letter in text:
        if unicodedata.category(letter) not in ("Mn", "Me", "Cf"):
            columns += 2 if unicodedata.east_asian_width(letter) in "WF" else 1
    return columns


@dataclass(frozen=True)
class PictureOutcome:
    """Outcome of a look at a picture, as JSON values and files: figures in its folder, others where their paths say."""

    ended: str
    text: str
    row: Values
    episode: Data | None = None
    names: tuple[str, ...] = ()
    figures: Mapping[str, bytes] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        record: Record,
        opened: PictureLike,
        source: PictureSource,
        options: PictureOptions,
        seconds: float,
        truth: Truth | None,
    ) -> PictureOutcome:
        """Make the text, the row, the part of a page and the figures of a record.

        Args:
            record: the record of a picture.
            opened: the picture, as it was looked at.
            source: where it is from.
            options: what is wanted of it.
            seconds: how long it took on this machine.
            truth: annotations whose ids results take; None for none.

        Returns:
            The outcome.
        """
        text = _outcome_text(record, source.name, seconds)
        if options.looks:
            text = f"{text}\n{_looks_text(record)}"
        boxes = None if source.scene is None else source.scene.boxes
        episode = None
        if options.report is not None:
            # Records of other kinds of look have no more pixels than they keep.
            pixels = opened if record.kind.fine else None
            episode = record.page_data(pixels, name=Path(source.name).name, boxes=boxes)
        # Without a file of results a row is as in lines of JSON, to which nothing is added.
        form = results_format(options.results or STDOUT, truth=truth)
        figures = _draw_episode(record, boxes, _drawings(options))
        return cls(
            ended=record.verdict or "looked at",
            text=text,
            row=_result_row(record, source, seconds, form),
            episode=episode,
            names=tuple(figures),
            figures=figures,
            files=_figure(record, options) | _labels(record, source, options) | _crops(record, source, options),
        )


def _drawings(options: PictureOptions) -> Sequence[Drawing]:
    """Choose the figures to draw: those that are named, else all for a folder, and none for a file."""
    if options.draw is not None:
        return options.draw
    writes_folder = options.results is not None and kind_of(options.results) is None
    return ALL_DRAWINGS if writes_folder else ()


def _figure(record: Record, options: PictureOptions) -> dict[str, bytes]:
    """Draw the figure of one picture, if it is wanted; returns the file by its path."""
    if options.figure is None:
        return {}
    from semfov.viz import save_figure

    # Returned as bytes, since a worker of a cluster may not have the folder of the results.
    with tempfile.TemporaryDirectory() as folder:
        drawn = save_figure(record.plot(), Path(folder) / options.figure.name)
        return {str(options.figure): drawn.read_bytes()}


def _labels(record: Record, source: PictureSource, options: PictureOptions) -> dict[str, bytes]:
    """Write the labels of a picture in the format of YOLO, if they are wanted; returns the file by its path."""
    if options.labels is None:
        return {}
    return {str(options.labels / source.place.with_suffix(".txt")): record.to_yolo().encode()}


def _crops(record: Record, source: PictureSource, options: PictureOptions) -> dict[str, bytes]:
    """Cut out what the box of each object shows, or of a search the best place; returns the files by their paths."""
    if options.crops is None:
        return {}
    from semfov.report.episode import jpeg

    root = options.crops
    files = {}

    def add(name: str, ending: str, crop: Tensor) -> None:
        folder = root / plain_name(name) / source.place.parent
        files[str(folder / f"{source.place.stem}-{ending}.jpg")] = jpeg(crop, _CROP_QUALITY)

    crops = record.crops(source.picture())
    for number, (label, crop) in enumerate(zip(record.objects.labels.tolist(), crops, strict=True)):
        add(record.classes[label], f"{number:03d}", crop)
    if not crops and record.best_place is not None:
        box, _ = record.best_place
        (crop,) = record.crops(source.picture(), boxes=box[None])
        add(str(record.target_name), "best", crop)
    return files


def _result_row(record: Record, source: PictureSource, seconds: float, form: ResultsFormat) -> Values:
    """Make the entry of a picture in a file of results.

    Args:
        record: the record of the picture.
        source: the picture.
        seconds: time that it took.
        form: format of the file.

    Returns:
        JSON values: the `picture`, and what the format adds.
    """
    values = {**record.to_dict(), "picture": source.name, "seconds": round(seconds, 3), "ended": record.words.ended}
    picture = {name: value for name, value in values.items() if name not in ("looks", "summary")}
    return {"picture": picture, **form.added(record, source.name, source.file)}


def _draw_episode(record: Record, boxes: Tensor | None, drawings: Sequence[Drawing]) -> dict[str, bytes]:
    """Draw those figures and the animation that a record of this kind has; returns the files by name."""
    if not drawings:
        return {}
    from semfov.viz import save_figure

    figures = record.figures(boxes)
    drawn = []
    with tempfile.TemporaryDirectory() as folder:
        for drawing in drawings:
            # The belief of an exploration is the map of what is where.
            name = "map" if drawing == "belief" and "map" in figures else drawing
            if name in figures:
                drawn.append(save_figure(figures[name](), Path(folder) / f"{name}.png"))
        if "animation" in drawings:
            film: Any = record.animate(boxes=boxes)
            drawn += film.save(Path(folder) / "animation.gif")
        return {path.name: path.read_bytes() for path in drawn}
