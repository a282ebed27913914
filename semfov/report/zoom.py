"""Looks at a picture as data for a page: the picture, and what each look showed, as JPEG."""

from collections import Counter
from itertools import pairwise
from statistics import median

from torch import Tensor

from semfov.data.inputs import ImageLike
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.errors import check
from semfov.paths import Record, RecordedLook
from semfov.paths.look import CONFIDENT, LookView, read_region
from semfov.report.episode import Data, jpeg_uri, object_data, tagged
from semfov.viz.drawing import photograph_of

_MOST_DETECTIONS = 15  # largest number of detections of a look that are drawn and listed


def zoom_data(
    path: Record,
    picture: LargePicture | ImageLike | None,
    *,
    name: str,
    boxes: Tensor | None = None,
    width: int = 1280,
    quality: int = 75,
) -> Data:
    """Collect the data of looks at a picture for a page, as JSON; each look at the resolution of the detector."""
    source = open_large(photograph_of(path, None) if picture is None else picture)
    wide, high = path.size
    expected = f"the picture of the record, {wide} × {high} px, or a reduced one"
    reduced = source.size[0] <= wide and abs(source.size[0] * high - source.size[1] * wide) <= max(wide, high)
    check(reduced, "picture", expected, source.size)
    check(path.passes > 0, "path", "at least one look", path.passes)
    place = path.words.best_place.capitalize()
    reason = f"{path.why_it_ended()}{place and f' {place}.'}".strip()
    result = f"{path.words.objects}."
    if path.decision is not None:
        what = "probability that the picture holds it" if path.words.decided_by == "probability" else "best score"
        result = f"“{path.target_name}” {path.decision.outcome}, {what}: {path.decision.probability:.2f}."
    image = read_region(source, (0, 0, wide, high), path.size, min(width, wide))
    return {
        "name": name,
        "sensor": path.words.sensor,
        "decision": f"{result} {reason}".rstrip(),
        "summary": path.describe(),
        "size": [wide, high],
        "target": path.target_name,
        "values": f"The value of a look is {path.words.value}.",
        "truth": [] if boxes is None else boxes.tolist(),
        "image": jpeg_uri(image, width, quality),
        "looks": [_look(path, look, view, quality) for look, view in zip(path, path.look_views(source), strict=True)],
        **object_data(path),
    }


def _look(path: Record, look: RecordedLook, view: LookView, quality: int) -> Data:
    """A look: its window, the value for which it was chosen, its detections and the number of its objects by class."""
    (x, y), number, (x1, _, x2, _) = look.fixation, look.number, look.region
    whole = path.is_whole(look.region)
    magnification = look.more.get("magnification", view.size[0] / max(x2 - x1, 1))
    detections = _detections(path, look, view)
    brought = Counter(path.classes[label] for label in path.objects.labels[path.objects.passes == number].tolist())
    closer = max((each for each in path.closer if each.number == number), key=lambda each: each.place, default=None)
    kinds = ", ".join(f"{count} × {label}" for label, count in brought.most_common())
    turned, warm, ends = None, False, [each.seconds for each in path]
    if number == 0 and not path.kind.turns and len(ends) >= 3 and None not in ends:
        # The first look with the warm-up took over three times as long as the others usually did.
        first, *later = [end - start for start, end in pairwise([0.0, *map(float, ends)])]  # type: ignore[arg-type]
        warm = first > 3 * median(later)
    if path.kind.turns:
        pan, tilt, field = (look.more[name] for name in ("pan", "tilt", "field"))
        turned = f"pan {pan:z.0f}°, tilt {tilt:z.0f}°, field of view {field:.0f}°"
    where = f" at ({x:.0f}, {y:.0f}), magnification {magnification:.2g}" if turned is None else f": {turned}"
    where = ", at the whole picture" if whole else where
    sentences = [f"Look {number} of {len(path) - 1}{where}."]
    if look.value is not None:
        sentences.append(f"Its value was {look.value:.2g}.")
    if closer is not None:
        sentences.append(f"It is a closer look: the target is there with a probability of {closer.place:.2f}.")
    sentences.append(f"Objects that no look shows more sharply: {kinds or 'none'}.")
    return {
        "view": jpeg_uri(view.pixels, max(1, round((x2 - x1) * magnification)), quality),
        "box": [round(side) for side in look.region],
        "size": list(view.size),
        "whole": whole,
        "turned": turned,
        "warm": warm,
        "magnification": magnification,
        "value": look.value,
        "seconds": look.seconds,
        "closer": None if closer is None else f"probability {closer.place:.2f} that the target is there",
        "detections": detections[:_MOST_DETECTIONS],
        "count": len(detections),
        "brought": kinds or "none",
        "status": " ".join(sentences),
    }


def _detections(path: Record, look: RecordedLook, view: LookView) -> list[Data]:
    """Detections of a look, those of the target first, with boxes and labels in the unit of the view."""
    detections, rows = look.detections, []
    columns = zip(
        view.boxes.tolist(),
        detections.boxes[0].tolist(),
        detections.class_scores[0],
        detections.labels[0].tolist(),
        detections.confidence[0].tolist(),
        strict=True,
    )
    for box, place, own, label, score in columns:
        # As for objects (`semfov.zoom.merge`), the score of the target counts, even if another class has a higher one.
        if path.target is not None and label and float(own[path.target - 1]) >= CONFIDENT:
            label, score = path.target, float(own[path.target - 1])
        if score >= CONFIDENT:
            first = label == path.target
            rows.append((first, score, {"box": box, "place": place, "label": path.classes[label], "score": score}))
    rows.sort(key=lambda row: row[:2], reverse=True)
    entries = [detection for _, _, detection in rows]
    # Names would cover small objects. The table has them.
    numbers = [str(number) for number in range(1, min(len(entries), _MOST_DETECTIONS) + 1)]
    return [*tagged(entries[:_MOST_DETECTIONS], numbers, view.size), *entries[_MOST_DETECTIONS:]]
