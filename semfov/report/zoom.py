"""A path through a large picture as data for a page: the picture and the window of each look as JPEG."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from semfov.data.inputs import ImageLike
from semfov.data.large import LargePicture, open_large
from semfov.data.reduction import reduction_for
from semfov.detection.objects import Objects
from semfov.errors import check
from semfov.paths import ZoomPath
from semfov.report.episode import Data, Pool, rounded, tagged
from semfov.zoom.gist import FOUND
from semfov.zoom.glances import Glance
from semfov.zoom.lattice import Lattice

_Frame = tuple[int, int, int, int]

DRAWN = 500
"""Largest number of objects that are drawn in the picture."""

LISTED = 100
"""Largest number of objects in the table."""

SHOWN = 15
"""Largest number of detections of a look that are drawn and listed."""


def zoom_data(
    path: ZoomPath,
    picture: LargePicture | ImageLike,
    pool: Pool,
    *,
    name: str,
    settings: Mapping[str, Any] | None = None,
    width: int = 1280,
    quality: int = 75,
) -> Data:
    """Collect the data of a search or an exploration of a large picture for a page, as JSON values.

    Each window is shown at the resolution at which the detector received it. Detections and objects with a score below
    0.1 are left out.

    Args:
        path: the search or exploration.
        picture: the picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
        pool: collects the pictures.
        name: name of the picture.
        settings: settings of the eye (`WindowEye.settings()`), for the name of the detector; None leaves the name out.
        width: largest width in pixels of the whole picture on the page.
        quality: of the JPEG files.

    Returns:
        The data, for `page_html` and `write_page`.

    Raises:
        InputError: the picture does not have the size of the path, or the path has no looks.

    >>> import torch
    >>> from semfov.detection import Detections
    >>> from semfov.zoom.glances import Glance, on_lattice
    >>> lattice, nothing = Lattice.over((1600, 1200), (400, 400)), torch.zeros(0)
    >>> look = Glance(on_lattice(lattice, (0, 0, 0)), Detections.empty(1, 1), nothing, nothing, None)
    >>> objects = Objects(nothing.view(0, 4), nothing, nothing.long(), nothing.long())
    >>> path = ZoomPath(
    ...     lattice=lattice, classes=("background", "cup"), target=1, glances=(look,), values=(float("inf"),),
    ...     candidates=objects, ending="passes",
    ... )
    >>> data = zoom_data(path, torch.rand(3, 1200, 1600), Pool(), name="kitchen.jpg")
    >>> data["sensor"], data["decision"]
    ('windows of 400 × 400 px at magnifications 0.25, 0.5, 1', '0 × cup from score 0.3. The only pass was used.')
    """
    source = open_large(picture)
    wide, high = path.lattice.size
    check(tuple(source.size) == (wide, high), "picture", f"the picture of the path, {wide} × {high} px", source.size)
    check(path.passes > 0, "path", "at least one look", path.passes)
    sure = path.objects
    objects = _objects(sure, path.classes)
    found = None if path.decision is None else path.decision.box
    return {
        "name": name,
        "pixels": f"{wide} × {high} px",
        "detector": None if settings is None else settings["detector"]["name"],
        "sensor": windows_in_words(path.lattice),
        "passes": str(path.passes),
        "decision": outcome_in_words(path),
        "summary": path.describe(),
        "size": [wide, high],
        "target": path.target_name,
        "decided": path.decision is not None,
        "image": pool.add(_pixels(source, (0, 0, wide, high), min(width, wide)), width, quality),
        "found": None if found is None else [round(x, 1) for x in found.tolist()],
        "looks": [_look(path, number, objects, source, pool, quality) for number in range(path.passes)],
        "objects": objects[:DRAWN],
        "count": len(objects),
    }


def windows_in_words(lattice: Lattice) -> str:
    """Describe the windows of a lattice in words."""
    wide, high = lattice.canvas
    magnifications = ", ".join(f"{m:.2g}" for m in lattice.magnifications)
    several = "s" if lattice.levels > 1 else ""
    return f"windows of {wide} × {high} px at magnification{several} {magnifications}"


def outcome_in_words(path: ZoomPath) -> str:
    """Tell the result of a search or an exploration, and why it ended if that is known."""
    target = path.target_name
    if path.decision is None:
        told = f"{path.objects_in_words()}."
    else:
        outcome, probability = path.decision.outcome, path.decision.probability
        told = f"“{target}” {outcome}, probability that the picture holds it: {probability:.2f}."
    return f"{told} {path.why_it_ended()}".rstrip()


def _objects(objects: Objects, classes: tuple[str, ...]) -> list[Data]:
    """The objects, most confident first."""
    parts = (objects.boxes.tolist(), objects.labels.tolist(), objects.scores.tolist(), objects.passes.tolist())
    return [
        {"box": [round(x, 1) for x in box], "label": classes[label], "score": rounded(score), "look": look}
        for box, label, score, look in zip(*parts, strict=True)
    ]


def _look(path: ZoomPath, number: int, objects: list[Data], source: LargePicture, pool: Pool, quality: int) -> Data:
    """A look: its window, the value for which it was chosen, its detections and the number of its objects by class."""
    x, y, magnification = path.glances[number].window.fixation
    frame = _whole_pixels(path.region(number), path.lattice.size)
    across = max(1, round((frame[2] - frame[0]) * magnification))
    detections = _detections(path, path.glances[number], frame)
    brought = Counter(each["label"] for each in objects if each["look"] == number)
    closer = next((look for look in path.closer if look.number == number), None)
    value, kinds = path.values[number], ", ".join(f"{count} × {label}" for label, count in brought.most_common())
    told = [f"Look {number} of {path.passes - 1}"]
    told[0] += f" at ({x:.0f}, {y:.0f}), magnification {magnification:.2g}." if number else ", at the whole picture."
    if number:
        told.append(f"Its value was {value:.2g}.")
    if closer is not None:
        told.append(f"It is a closer look: the target is there with a probability of {closer.place:.2f}.")
    told.append(f"Objects that it brought: {kinds or 'none'}.")
    return {
        "view": pool.add(_pixels(source, frame, across), across, quality),
        "box": list(frame),
        "magnification": rounded(magnification),
        "value": rounded(value),
        "closer": None if closer is None else f"probability {closer.place:.2f} that the target is there",
        "detections": detections[:SHOWN],
        "count": len(detections),
        "brought": kinds or "none",
        "status": " ".join(told),
    }


def _detections(path: ZoomPath, glance: Glance, frame: _Frame) -> list[Data]:
    """Detections of a look, those of the target first, with boxes and labels in pixels of the window."""
    x1, y1, x2, y2 = frame
    rows = []
    best = (glance.detections.labels[0].tolist(), glance.detections.confidence[0].tolist())
    for box, vector, label, score in zip(glance.detections.boxes[0], glance.detections.scores[0], *best, strict=True):
        # As for objects (`semfov.zoom.merge`), the score of the target counts, even if another class has a higher one.
        if path.target is not None and label and float(vector[path.target]) >= FOUND:
            label, score = path.target, float(vector[path.target])
        if score >= FOUND:
            place = [round(n - low, 1) for n, low in zip(box.tolist(), (x1, y1, x1, y1), strict=True)]
            first = label == path.target
            rows.append((first, score, {"box": place, "label": path.classes[label], "score": rounded(score)}))
    rows.sort(key=lambda row: row[:2], reverse=True)
    kept = [detection for _, _, detection in rows]
    # Names would cover small objects. The table has them.
    numbers = [str(number) for number in range(1, min(len(kept), SHOWN) + 1)]
    return [*tagged(kept[:SHOWN], numbers, (x2 - x1, y2 - y1)), *kept[SHOWN:]]


def _whole_pixels(box: tuple[float, float, float, float], size: tuple[int, int]) -> _Frame:
    """A window in whole pixels, with at least one pixel, inside the picture."""
    x1, y1 = (min(max(round(low), 0), most - 1) for low, most in zip(box[:2], size, strict=True))
    x2, y2 = (min(max(round(high), low + 1), most) for high, low, most in zip(box[2:], (x1, y1), size, strict=True))
    return x1, y1, x2, y2


def _pixels(source: LargePicture, frame: _Frame, across: int) -> Any:
    """Pixels `(3, h, w)` of a window in [0, 1]; very large windows are read at a coarser resolution."""
    return source.read(frame, reduction_for((frame[2] - frame[0]) // across)).float() / 255
