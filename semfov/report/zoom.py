"""Looks at windows of a picture as data for a page: the picture and the window of each look as JPEG."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import singledispatch
from typing import Any, NamedTuple

from torch import Tensor

from semfov.data.inputs import ImageLike
from semfov.data.large import LargePicture, open_large
from semfov.data.reduction import reduction_for
from semfov.errors import check
from semfov.paths import HeadPath, Record, RecordedLook, ZoomPath
from semfov.paths.stimulus import LONGEST
from semfov.report.episode import Data, jpeg_uri, rounded, tagged
from semfov.viz.drawing import photograph_of
from semfov.viz.head import head_views
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.lattice import Lattice

_Frame = tuple[int, int, int, int]

DRAWN = 500
"""Largest number of objects that are drawn in the picture."""

LISTED = 100
"""Largest number of objects in the table."""

_MOST_DETECTIONS = 15
"""Largest number of detections of a look that are drawn and listed."""


NUMBER = (
    "The value of a look is the number of new objects that it was expected to show, and a share of those that closer "
    "looks would then show."
)
"""What values of windows mean where objects are counted (`semfov.zoom.policy.best_find`)."""

_PROBABILITY = (
    "The value of a look is the probability that it shows the target. For a wide window it is the sum of these "
    "probabilities over the closer windows in it, divided by a constant, if that is larger. The value of a closer look "
    "is the probability, before it, that the target is at the place."
)
"""What values mean in searches (`semfov.zoom.policy.best_hit`)."""


def zoom_data(
    path: Record,
    picture: LargePicture | ImageLike | None,
    *,
    name: str,
    settings: Mapping[str, Any] | None = None,
    width: int = 1280,
    quality: int = 75,
) -> Data:
    """Collect the data of looks at windows of a picture for a page, as JSON values.

    Each window is shown at the resolution at which the detector received it, or that of the picture if it is coarser.
    Detections with a score below 0.1 are left out.

    Args:
        path: the search or exploration.
        picture: the picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`. It
            may be reduced; None takes the one that the record kept.
        name: name of the picture.
        settings: settings of the eye (`WindowEye.settings()`), for the name of the detector; None leaves the name out.
        width: largest width in pixels of the whole picture on the page.
        quality: of the JPEG files.

    Returns:
        The data, for `page_html` and `write_page`.

    Raises:
        InputError: the picture does not have the proportions of the record's, none is there, or there are no looks.

    >>> import torch
    >>> from semfov.detection import Detections, Objects
    >>> from semfov.zoom.glances import Glance, on_lattice
    >>> lattice, nothing = Lattice.over((1600, 1200), (400, 400)), torch.zeros(0)
    >>> look = Glance(on_lattice(lattice, (0, 0, 0)), Detections.empty(1, 1), nothing, nothing, None)
    >>> path = ZoomPath(
    ...     lattice=lattice, classes=("background", "cup"), target=1, glances=(look,), values=(float("inf"),),
    ...     candidates=Objects.none(), ending="passes",
    ... )
    >>> data = zoom_data(path, torch.rand(3, 1200, 1600), name="kitchen.jpg")
    >>> data["sensor"], data["decision"]
    ('windows of 400 × 400 px at magnifications 0.25, 0.5, 1', '0 × cup from score 0.3. The only pass was used.')
    """
    source = open_large(photograph_of(path, None) if picture is None else picture)
    wide, high = path.size
    expected = f"the picture of the record, {wide} × {high} px, or a reduced one"
    reduced = source.size[0] <= wide and abs(source.size[0] * high - source.size[1] * wide) <= max(wide, high)
    check(reduced, "picture", expected, source.size)
    check(path.passes > 0, "path", "at least one look", path.passes)
    objects = _objects(path)
    views = _look_views(path, source)
    return {
        "name": name,
        "pixels": f"{wide} × {high} px",
        "detector": None if settings is None else settings["detector"]["name"],
        "sensor": _sensor_words(path),
        "passes": str(path.passes),
        "decision": _outcome_in_words(path),
        "summary": path.describe(),
        "size": [wide, high],
        "target": path.target_name,
        "values": _values_in_words(path),
        "image": jpeg_uri(_pixels(source, (0, 0, wide, high), path.size, min(width, wide)), width, quality),
        "looks": [_look(path, look, view, objects, quality) for look, view in zip(path, views, strict=True)],
        "objects": objects[:DRAWN],
        "count": len(objects),
        "confirmable": path.confirmable,
    }


class _LookView(NamedTuple):
    """What a look showed; pixels `(3, h, w)`, size `(width, height)`, boxes `(L, 4)`."""

    pixels: Tensor
    size: tuple[int, int]
    boxes: Tensor
    across: int


@singledispatch
def _look_views(path: Record, source: LargePicture) -> Iterator[_LookView]:
    """The views of all looks of a record, from its picture, which may be reduced."""
    for look in path:
        frame = _whole_pixels(look.region, path.size)
        across = frame[2] - frame[0]
        yield _view(look, frame, source, path.size, across)


@_look_views.register
def _(path: ZoomPath, source: LargePicture) -> Iterator[_LookView]:
    for look, glance in zip(path, path.glances, strict=True):
        frame = _whole_pixels(look.region, path.size)
        across = max(1, round((frame[2] - frame[0]) * glance.window.fixation[2]))
        yield _view(look, frame, source, path.size, across)


@_look_views.register
def _(path: HeadPath, source: LargePicture) -> Iterator[_LookView]:
    whole = _pixels(source, (0, 0, *path.size), path.size, 2 * LONGEST)
    size = path.views.world.size
    for number, pixels in enumerate(head_views(path, whole)):
        yield _LookView(pixels, size, path.detections[number].boxes[0], size[0])


def _view(look: RecordedLook, frame: _Frame, source: LargePicture, size: tuple[int, int], across: int) -> _LookView:
    """The view of a window of the picture."""
    x1, y1, x2, y2 = frame
    boxes = look.detections.boxes[0] - look.detections.boxes.new_tensor([x1, y1, x1, y1])
    return _LookView(_pixels(source, frame, size, across), (x2 - x1, y2 - y1), boxes, across)


@singledispatch
def _sensor_words(path: Record) -> str | None:
    """Describe in words through what a record looked."""
    return None


@_sensor_words.register
def _(path: ZoomPath) -> str:
    return _windows_in_words(path.lattice)


@_sensor_words.register
def _(path: HeadPath) -> str:
    wide, high = path.views.world.size
    fields = ", ".join(f"{field:g}" for field in path.views.fields)
    return f"views of {wide} × {high} px with fields of view of {fields} degrees"


@singledispatch
def _values_in_words(path: Record) -> str:
    """Explain the values of the looks, where they have a meaning that the page does not tell elsewhere."""
    return ""


@_values_in_words.register
def _(path: ZoomPath) -> str:
    return f"{NUMBER if path.decision is None else _PROBABILITY} "


def _windows_in_words(lattice: Lattice) -> str:
    """Describe the windows of a lattice in words."""
    wide, high = lattice.canvas
    magnifications = ", ".join(f"{m:.2g}" for m in lattice.magnifications)
    several = "s" if lattice.levels > 1 else ""
    return f"windows of {wide} × {high} px at magnification{several} {magnifications}"


def _outcome_in_words(path: Record) -> str:
    """Tell the result of a search or an exploration, and why it ended if that is known."""
    reason = path.summary().removeprefix(path.describe()).removeprefix(".").strip()
    if path.decision is None:
        text = f"{path.objects_in_words()}."
    else:
        outcome, probability = path.decision.outcome, path.decision.probability
        what = "probability that the picture holds it" if path.decided_by == "probability" else "best score"
        text = f"“{path.target_name}” {outcome}, {what}: {probability:.2f}."
    return f"{text} {reason}".rstrip()


def _objects(path: Record) -> list[Data]:
    """The objects, most confident first."""
    return [
        {
            "box": [round(row[side], 1) for side in ("x1", "y1", "x2", "y2")],
            "label": row["class"],
            "score": rounded(row["score"]),
            "look": row["look"],
            "confirmed": row["confirmed"],
        }
        for row in path.object_rows()
    ]


def _look(path: Record, look: RecordedLook, view: _LookView, objects: list[Data], quality: int) -> Data:
    """A look: its window, the value for which it was chosen, its detections and the number of its objects by class."""
    (x, y), number, (x1, _, x2, _) = look.fixation, look.number, look.region
    whole = path.is_whole(look.region)
    magnification = view.across / max(x2 - x1, 1)
    detections = _detections(path, look, view)
    brought = Counter(each["label"] for each in objects if each["look"] == number)
    closer = next((each for each in path.closer_looks if each.number == number), None)
    kinds = ", ".join(f"{count} × {label}" for label, count in brought.most_common())
    last = sum(1 for _ in path) - 1
    where = ", at the whole picture" if whole else f" at ({x:.0f}, {y:.0f}), magnification {magnification:.2g}"
    sentences = [f"Look {number} of {last}{where}."]
    if look.value is not None:
        sentences.append(f"Its value was {look.value:.2g}.")
    if closer is not None:
        sentences.append(f"It is a closer look: the target is there with a probability of {closer.place:.2f}.")
    sentences.append(f"Objects that it brought: {kinds or 'none'}.")
    return {
        "view": jpeg_uri(view.pixels, view.across, quality),
        "box": [round(side) for side in look.region],
        "size": list(view.size),
        "whole": whole,
        "magnification": rounded(magnification),
        "value": None if look.value is None else rounded(look.value),
        "closer": None if closer is None else f"probability {closer.place:.2f} that the target is there",
        "detections": detections[:_MOST_DETECTIONS],
        "count": len(detections),
        "brought": kinds or "none",
        "status": " ".join(sentences),
    }


def _detections(path: Record, look: RecordedLook, view: _LookView) -> list[Data]:
    """Detections of a look, those of the target first, with boxes and labels in the unit of the view."""
    detections, rows = look.detections, []
    columns = zip(
        view.boxes.tolist(),
        detections.boxes[0].tolist(),
        detections.scores[0],
        detections.labels[0].tolist(),
        detections.confidence[0].tolist(),
        strict=True,
    )
    for box, place, vector, label, score in columns:
        # As for objects (`semfov.zoom.merge`), the score of the target counts, even if another class has a higher one.
        if path.target is not None and label and float(vector[path.target]) >= DETECTION_SCORE:
            label, score = path.target, float(vector[path.target])
        if score >= DETECTION_SCORE:
            first = label == path.target
            corners = {"box": [round(n, 1) for n in box], "place": [round(n, 1) for n in place]}
            rows.append((first, score, {**corners, "label": path.classes[label], "score": rounded(score)}))
    rows.sort(key=lambda row: row[:2], reverse=True)
    entries = [detection for _, _, detection in rows]
    # Names would cover small objects. The table has them.
    numbers = [str(number) for number in range(1, min(len(entries), _MOST_DETECTIONS) + 1)]
    return [*tagged(entries[:_MOST_DETECTIONS], numbers, view.size), *entries[_MOST_DETECTIONS:]]


def _whole_pixels(box: tuple[float, float, float, float], size: tuple[int, int]) -> _Frame:
    """A window in whole pixels, with at least one pixel, inside the picture."""
    x1, y1 = (min(max(round(low), 0), most - 1) for low, most in zip(box[:2], size, strict=True))
    x2, y2 = (min(max(round(high), low + 1), most) for high, low, most in zip(box[2:], (x1, y1), size, strict=True))
    return x1, y1, x2, y2


def _pixels(source: LargePicture, frame: _Frame, size: tuple[int, int], across: int) -> Tensor:
    """Pixels `(3, h, w)` of a window in [0, 1]; one wider than `across` is read at a coarser resolution."""
    scale = [there / here for there, here in zip(source.size, size, strict=True)] * 2
    x1, y1, x2, y2 = (n * by for n, by in zip(frame, scale, strict=True))
    frame = _whole_pixels((x1, y1, x2, y2), source.size)
    return source.read(frame, reduction_for((frame[2] - frame[0]) // across)).float() / 255
