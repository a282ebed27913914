"""What is kept of a look at a picture: texts, rows of results, figures, and its part of a page."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from semfov.agents.picture import PictureLike
from semfov.cli.formats import ResultsFormat
from semfov.cli.options import ALL_DRAWINGS, Drawing, PictureOptions
from semfov.cli.results import kind_of, results_format
from semfov.cli.sources import PictureSource
from semfov.cli.truth import Truth
from semfov.decision import Decision
from semfov.detection.objects import box_text
from semfov.io.files import plain_name
from semfov.paths import Record, Scanpath
from semfov.paths.look import CONFIDENT, detections_in_words
from semfov.report.episode import jpeg
from semfov.viz import plot_belief, plot_belief_bars, plot_foveated_strip, save_figure
from semfov.viz.semantic import named_regions, plot_semantic_map

_OBJECTS_LISTED = 20  # largest number of objects that are listed


def _outcome_text(record: Record, name: str, seconds: float) -> str:
    """Say what was found where, with what, and in how many passes and seconds."""
    width, height = record.size
    limit = " (the limit)" if record.ending == "passes" else ""
    looks = f"{record.passes} look{'s' if record.passes != 1 else ''}{limit} in {seconds:.1f} s"
    if record.kind.turns:  # whose seconds are those of its movements and looks
        looks += f" on this machine, {record[-1].seconds:.1f} s of eye and head"
    decision = record.decision
    headline = record.words.objects if decision is None else _decision_text(record, decision)
    why = "" if limit else record.why_it_ended()
    lines = [f"{name}, {width} × {height} px: {headline}", f"  {why} {looks}.".replace("   ", "  ")]
    if record.decision is None:
        lines += _regions_lines(record) if isinstance(record, Scanpath) and record.target is None else []
        lines += _objects_lines(record)
    return "\n".join(lines)


def _decision_text(record: Record, decision: Decision) -> str:
    """Say whether the target was found, and where."""
    name = record.target_name
    measure = record.words.decided_by
    number = "probability that the picture holds it:" if measure == "probability" else measure
    probability = f"{number} {decision.probability:.2f}"
    if decision.outcome == "absent":
        return f"{name} is not there, {probability}"
    if decision.outcome == "undecided":
        return "; ".join(filter(None, (f"{name} undecided, {probability}", record.words.best_place)))
    point, box = record.found_at, decision.box
    edges = f", box {box_text(box.tolist())}" if box is not None else ""
    where = "" if point is None else f" at ({point[0]:.0f}, {point[1]:.0f})"
    return f"found {name}{where}{edges}, {probability}"


def _objects_lines(record: Record) -> list[str]:
    """A line for each of the most confident objects."""
    rows = record.object_rows()
    lines = [
        f"  {row['class']} {row['score']:.2f} at ({row['x']:.0f}, {row['y']:.0f}), "
        f"box {box_text((row['x1'], row['y1'], row['x2'], row['y2']))}{', confirmed' * row['confirmed']}"
        for row in rows[:_OBJECTS_LISTED]
    ]
    more = len(rows) - _OBJECTS_LISTED
    lines += [f"  and {more} more (--out FILE.json writes all)"] if more > 0 else []
    several = record.target is None and not record.targets and len(rows) > 1
    return [*lines, f"  in all: {record.words.classes}"] if several else lines


def _regions_lines(scanpath: Scanpath) -> list[str]:
    """A line for each class that was looked for and that the final map names, with its most probable cell."""
    by_class: dict[str, list[int]] = {}
    for label, cells, _ in named_regions(scanpath):
        if not scanpath.targets or scanpath.classes.index(label) in scanpath.targets:
            by_class.setdefault(label, []).extend(cells)
    lines = []
    for label, cells in sorted(by_class.items(), key=lambda item: -len(item[1])):
        chance = scanpath.probabilities[-1, cells, scanpath.classes.index(label)]
        x, y = scanpath.grid.centres[cells[int(chance.argmax())]].tolist()
        many = f"{len(cells)} cell{'s' if len(cells) != 1 else ''}"
        lines.append(f"  map: {label} in {many}, p up to {float(chance.max()):.2f} around ({x:.0f}, {y:.0f})")
    return lines


def _looks_text(record: Record) -> str:
    """The looks as a table: where, which part of the picture, what was detected, and when it ended."""
    rows = [
        [
            str(look.number),
            f"({look.fixation[0]:.0f}, {look.fixation[1]:.0f})",
            "the whole picture" if record.is_whole(look.region) else box_text(look.region),
            detections_in_words(look.detections, record.classes, target=record.target),
            "" if look.value is None else f"{look.value:.3f}",
            "" if look.seconds is None else f"{look.seconds:.2f}",
        ]
        for look in record
    ]
    head = ["look", "at (x, y)", "shows", f"detections from score {CONFIDENT:g} on", "value", "s"]
    lines = [f"  {line}" for line in table_lines([head, *rows])]
    if any(look.value is not None for look in record):
        lines.append(f"  value: {record.words.value}")
    for number, close_up in enumerate(record.closer, 1):
        taken = record.decision is not None and close_up.presence == record.decision.probability
        chance = f"p {close_up.place:.3f} there, {close_up.presence:.3f} in the picture{', as decided' * taken}"
        lines.append(f"  closer look {number} at {box_text(close_up.box.tolist())}: {chance}")
    if record.closer:
        lines.append("  in the picture: by all looks so far, so also where that closer look shows nothing of it")
    return "\n".join(lines)


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of equal length as lines with aligned columns."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


@dataclass(frozen=True)
class PictureOutcome:
    """Outcome of a look at a picture, as JSON values and files: figures in its folder, others where their paths say."""

    ended: str
    text: str
    row: dict[str, Any]
    episode: dict[str, Any] | None = None
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
        """Make the text, the row, the part of a page and the figures of a record, as the options say."""
        usual = ALL_DRAWINGS if options.out is not None and kind_of(options.out) is None else ()
        drawings = usual if options.draw is None else options.draw
        text = _outcome_text(record, source.name, seconds)
        boxes = None if source.scene is None else source.scene.boxes
        episode = None
        form = None if options.out is None else results_format(options.out, truth=truth)
        row = _result_row(record, source, seconds, form)
        if options.report is not None:
            name = Path(source.name).name
            # Others have no more pixels than the record keeps.
            shown = opened if record.kind.fine else None
            episode = record.page_data(shown, name=name, boxes=boxes)
        figures = _draw_episode(record, boxes, drawings)
        files = {}
        if options.labels is not None:
            files[str(options.labels / source.place.with_suffix(".txt"))] = record.to_yolo().encode()
        if options.crops is not None:
            picture: Any = source.opened("auto")
            crops = record.crops(picture)
            for number, (crop, label) in enumerate(zip(crops, record.objects.labels.tolist(), strict=True)):
                folder = options.crops / plain_name(record.classes[label]) / source.place.parent
                files[str(folder / f"{source.place.stem}-{number:03d}.jpg")] = jpeg(crop, 92)
        return cls(
            ended="looked at" if record.decision is None else record.decision.outcome,
            text=f"{text}\n{_looks_text(record)}" if options.looks else text,
            row=row,
            episode=episode,
            names=tuple(figures),
            figures=figures,
            files=files,
        )


def _result_row(record: Record, source: PictureSource, seconds: float, form: ResultsFormat | None) -> dict[str, Any]:
    """Make the entry of a picture in a file of results.

    Args:
        record: the record of the picture.
        source: the picture.
        seconds: time that it took.
        form: format of the file; None without a file.

    Returns:
        JSON values: the `picture`, and what the format adds.
    """
    values = {**record.to_dict(), "picture": source.name, "seconds": round(seconds, 3), "ended": record.why_it_ended()}
    picture = {name: value for name, value in values.items() if name not in ("looks", "summary")}
    return {"picture": picture, **({} if form is None else form.added(record, source.name, source.file))}


def _draw_episode(record: Record, boxes: Tensor | None, drawings: Sequence[Drawing]) -> dict[str, bytes]:
    """Draw those figures and the animation that a record of this kind has; returns the files by name."""
    if not drawings:
        return {}
    figures: dict[str, Callable[[], Any]] = {"scanpath": lambda: record.plot(boxes=boxes)}
    if isinstance(record, Scanpath):
        figures["views"] = lambda: plot_foveated_strip(record)
        if record.target is not None:
            figures["belief"] = lambda: plot_belief(record, None)
            figures["belief_bars"] = lambda: plot_belief_bars(record)
        else:
            figures["map"] = lambda: plot_semantic_map(record)
    names = ["map" if name == "belief" and "map" in figures else name for name in drawings]
    with tempfile.TemporaryDirectory() as folder:
        drawn = [save_figure(figures[name](), Path(folder) / f"{name}.png") for name in names if name in figures]
        if "animation" in drawings:
            film: Any = record.animate(boxes=boxes)
            drawn += film.save(Path(folder) / "animation.gif")
        return {path.name: path.read_bytes() for path in drawn}
