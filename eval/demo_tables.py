"""Texts of the demonstration: episodes as tables, detections in words, and names."""

import re
from collections.abc import Sequence

from semfov import Scanpath, viz
from semfov.paths import detections_in_words


def path_table(name: str, scanpath: Scanpath) -> str:
    """The episode, fixation by fixation, as a table."""
    if scanpath.target is None:
        values, what = viz.entropy(scanpath), "entropy (bits)"
    else:
        values, what = viz.class_posterior(scanpath), f"p({scanpath.classes[scanpath.target]})"
    anywhere = None if scanpath.presence is None else scanpath.presence.tolist()
    head = ["#", "at (column, row)", "detections", f"{what} there", "highest", "at"]
    rows = [[*head, *([] if anywhere is None else ["anywhere"]), "ms"]]
    for number, (cell, value) in enumerate(zip(scanpath.cells.tolist(), values, strict=True)):
        best = int(value.argmax())
        milliseconds = 1000 * sum(scanpath.seconds[number].values())
        figures = [f"{float(value[cell]):.3f}", f"{float(value[best]):.3f}", place(scanpath, best)]
        figures += [] if anywhere is None else [f"{anywhere[number]:.3f}"]
        seen = detections_in_words(scanpath.detections[number], scanpath.classes, score=viz.CONFIDENT)
        rows.append([str(number), place(scanpath, cell), seen, *figures, f"{milliseconds:.0f}"])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if scanpath.target is None:
        lines += ["", "what is where:", *regions_table(scanpath)]
    for number, look in enumerate(scanpath.closer, 1):
        assert look.cell is not None
        chance = f"p {look.place:.3f} there, {look.presence:.3f} anywhere"
        lines.append(f"closer look {number}, after fixation {look.fixation}, at {place(scanpath, look.cell)}: {chance}")
    return "\n".join([f"{name}: {scanpath.summary()}", *lines, ""])


def regions_table(scanpath: Scanpath) -> list[str]:
    """A line for each class that the final map names: number of cells, highest probability, and its cell."""
    parts: dict[str, list[int]] = {}
    for label, cells, _ in viz.named_regions(scanpath):
        parts.setdefault(label, []).extend(cells)
    lines = []
    for label, cells in sorted(parts.items(), key=lambda item: -len(item[1])):
        chance = scanpath.probabilities[-1, cells, scanpath.classes.index(label)]
        best = cells[int(chance.argmax())]
        many = f"{len(cells)} cell{'s' if len(cells) != 1 else ''}"
        lines.append(f"  {label}: {many}, p up to {float(chance.max()):.2f} at {place(scanpath, best)}")
    return lines or ["  nothing that is more probable than background"]


def place(scanpath: Scanpath, cell: int) -> str:
    """Column and row of a cell, from 0."""
    row, column = divmod(cell, scanpath.grid.columns)
    return f"({column}, {row})"


def columns(names: Sequence[str], width: int = 100) -> str:
    """Names in columns, in order down each column."""
    wide = max(map(len, names)) + 2
    across = max(1, width // wide)
    down = -(-len(names) // across)
    return "\n".join("".join(name.ljust(wide) for name in names[row::down]).rstrip() for row in range(down))


def plain_name(name: str) -> str:
    """Make a name valid on every file system.

    Args:
        name: any text.

    Returns:
        The name.

    >>> plain_name("my cup, frame 3")
    'my-cup-frame-3'
    """
    return re.sub(r"[^\w.]+", "-", name).strip("-.") or "picture"
