"""What the command prints: outcomes, objects and looks."""

from __future__ import annotations

from collections.abc import Sequence

from semfov.decision import Decision
from semfov.detection.objects import box_text
from semfov.paths import Record, Scanpath
from semfov.paths.look import detections_in_words
from semfov.viz.drawing import CONFIDENT
from semfov.viz.semantic import named_regions

_OBJECTS_LISTED = 20
"""Largest number of objects that are listed."""


def outcome_text(record: Record, name: str, seconds: float) -> str:
    """Say what was found where, with what, and in how many passes and seconds."""
    width, height = record.size
    passes = f"{record.passes} pass{'es' if record.passes != 1 else ''} in {seconds:.1f} s"
    decision = record.decision
    headline = record.objects_in_words() if decision is None else _decision_text(record, decision)
    lines = [f"{name}, {width} × {height} px: {headline}"]
    lines.append(f"  {record.why_it_ended()} {passes}.".replace("   ", "  "))
    if record.decision is None:
        lines += _regions_lines(record) if isinstance(record, Scanpath) and record.target is None else []
        lines += _objects_lines(record)
    return "\n".join(lines)


def _decision_text(record: Record, decision: Decision) -> str:
    """Say whether the target was found, and where."""
    what = "probability that the picture holds it:" if record.decided_by == "probability" else record.decided_by
    name, probability = record.target_name, f"{what} {decision.probability:.2f}"
    if decision.outcome != "found":
        where = {"absent": "is not there", "undecided": "undecided"}[decision.outcome]
        return f"{name} {where}, {probability}"
    point, box = record.found_at, decision.box
    edges = f", box {box_text(box.tolist())}" if box is not None else ""
    where = "" if point is None else f" at ({point[0]:.0f}, {point[1]:.0f})"
    return f"found {name}{where}{edges}, {probability}"


def _objects_lines(record: Record) -> list[str]:
    """A line for each of the most confident objects."""
    rows = record.object_rows()
    lines = [
        f"  {row['class']} {row['score']:.2f} at ({row['x']:.0f}, {row['y']:.0f}), "
        f"box {box_text((row['x1'], row['y1'], row['x2'], row['y2']))}{', confirmed' if row['confirmed'] else ''}"
        for row in rows[:_OBJECTS_LISTED]
    ]
    more = len(rows) - _OBJECTS_LISTED
    return [*lines, f"  and {more} more (--out FILE.json writes all)"] if more > 0 else lines


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


def looks_text(record: Record) -> str:
    """The looks as a table: where, which part of the picture, what was detected, and when it ended."""
    rows = [
        [
            str(look.number),
            f"({look.fixation[0]:.0f}, {look.fixation[1]:.0f})",
            "the whole picture" if record.is_whole(look.region) else box_text(look.region),
            detections_in_words(look.detections, record.classes, score=CONFIDENT),
            "" if look.value is None else f"{look.value:.3f}",
            "" if look.seconds is None else f"{look.seconds:.2f}",
        ]
        for look in record
    ]
    head = ["look", "at (x, y)", "shows", "detections", "value", "s"]
    lines = [f"  {line}" for line in table_lines([head, *rows])]
    for number, close_up in enumerate(record.closer, 1):
        chance = f"p {close_up.place:.3f} there, {close_up.presence:.3f} anywhere"
        lines.append(f"  closer look {number} at {box_text(close_up.box.tolist())}: {chance}")
    return "\n".join(lines)


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of equal length as lines with aligned columns.

    >>> table_lines([["name", "size"], ["a", "12"]])
    ['name  size', 'a     12']
    """
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
