"""Looks at a picture as data for a page: the picture, and what each look showed, as JPEG."""

from collections import Counter
from itertools import pairwise
from statistics import median

from torch import Tensor

from semfov.data.classes import counted
from semfov.data.inputs import ImageLike
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.decision import CloseUp
from semfov.detection.detections import Detections
from semfov.errors import check, checked_keywords
from semfov.paths import Record, RecordedLook
from semfov.paths.look import CONFIDENT, LookView, read_region
from semfov.report.episode import Data, jpeg_uri, object_data, tagged
from semfov.viz.drawing import photograph_of

_MOST_DETECTIONS = 15  # largest number of detections of a look that are drawn and listed


@checked_keywords
def zoom_data(
    path: Record,
    picture: LargePicture | ImageLike | None,
    *,
    name: str,
    boxes: Tensor | None = None,
    width: int = 1280,
    quality: int = 75,
) -> Data:
    """Collect the data of looks at a picture for a page, as JSON; each look at the resolution of the detector.

    Args:
        path: the record.
        picture: the picture in full size or reduced; None takes the one that the record keeps.
        name: name of the picture.
        boxes: `(M, 4)`, true boxes of the target.
        width: width in pixels to which the picture is reduced.
        quality: of the JPEGs.

    Returns:
        The data, for `semfov.report.write_page`.

    Raises:
        InputError: the picture is not that of the record, or was not kept, or there is no look.
    """
    source = _opened(path, picture)
    check(path.passes > 0, "path", "at least one look", path.passes)
    # Only the pixels that the page shows are read: the picture may be larger than the memory.
    image = read_region(source, (0, 0, *path.size), path.size, min(width, path.size[0]))
    looks = [_look(path, look, view, quality) for look, view in zip(path, path.look_views(source), strict=True)]
    return {
        "name": name,
        "sensor": path.words.sensor,
        "decision": _outcome_in_words(path),
        "summary": path.describe(),
        "size": list(path.size),
        "target": path.target_name,
        "values": f"The value of a look is {path.words.value}.",
        "truth": [] if boxes is None else boxes.tolist(),
        "image": jpeg_uri(image, width, quality),
        "looks": looks,
        **object_data(path),
    }


def _opened(path: Record, picture: LargePicture | ImageLike | None) -> LargePicture:
    """Open the picture of a record, or a reduced one with the same proportions up to a pixel."""
    source = open_large(photograph_of(path, None) if picture is None else picture)
    width, height = path.size
    source_width, source_height = source.size
    same_proportions = abs(source_width * height - source_height * width) <= max(width, height)
    expected = f"the picture of the record, {width} × {height} px, or a reduced one"
    check(source_width <= width and same_proportions, "picture", expected, source.size)
    return source


def _outcome_in_words(path: Record) -> str:
    """Tell the decision or the objects, why the record ended, the best place of doubt, and what is assumed."""
    sentences = [f"{_result_in_words(path)}.", path.why_it_ended(), *path.words.remarks]
    return " ".join(filter(None, sentences))


def _result_in_words(path: Record) -> str:
    """Tell the decision of a search, or the objects, in an exploration by class."""
    words = path.words
    if path.decision is not None:
        by_probability = words.decided_by == "probability"
        measure = "probability that the picture holds it" if by_probability else "best score"
        verdict = words.verdict(f"“{path.target_name}”")
        return f"{verdict[0].upper()}{verdict[1:]}, {measure}: {path.decision.probability:.2f}"
    if len(path.objects) and not path.sought:
        return f"{words.objects}: {words.classes}"
    return words.objects


def _look(path: Record, look: RecordedLook, view: LookView, quality: int) -> Data:
    """Tell of a look its window, the value for which it was chosen, its detections and what it shows most sharply."""
    x1, _, x2, _ = look.region
    # Looks of a head have none of their own: then it is the pixels of the view for one of the picture.
    magnification = look.more.get("magnification", view.size[0] / max(x2 - x1, 1))
    width_seen = max(1, round((x2 - x1) * magnification))
    detections = _detections(path, look, view)
    closer = _closer_look(path, look)
    brought = _brought_in_words(path, look)
    pose = _pose_in_words(look) if path.kind.turns else None
    where = _where_in_words(path, look, magnification, pose)
    return {
        "view": jpeg_uri(view.pixels, width_seen, quality),
        "box": [round(side) for side in look.region],
        "size": list(view.size),
        "whole": path.is_whole(look.region),
        "turned": pose,
        "warm": look.index == 0 and _warmed_up(path),
        "magnification": magnification,
        "value": look.value,
        "seconds": look.seconds,
        "closer": None if closer is None else f"probability {closer.place:.2f} that the target is there",
        "detections": detections[:_MOST_DETECTIONS],
        "count": len(detections),
        "brought": brought,
        "status": _status(f"{_number_in_words(path, look)}{where}.", look, closer, brought),
    }


def _status(place: str, look: RecordedLook, closer: CloseUp | None, brought: str) -> str:
    """Tell of a look where it was, its value, and what came of it."""
    sentences = [place]
    if look.value is not None:
        sentences.append(f"Its value was {look.value:.2g}.")
    if closer is not None:
        sentences.append(_closer_in_words(look, closer))
    if brought:
        sentences.append(f"Best seen in this look: {brought}.")
    return " ".join(sentences)


def _closer_look(path: Record, look: RecordedLook) -> CloseUp | None:
    """Find the closer look that a look is, of several the surest; None for others."""
    closer = [close_up for close_up in path.closer if close_up.index == look.index]
    return max(closer, key=lambda close_up: close_up.place, default=None)


def _number_in_words(path: Record, look: RecordedLook) -> str:
    return f"Look {look.number} of {len(path)}" if len(path) > 1 else "The only look"


def _closer_in_words(look: RecordedLook, closer: CloseUp) -> str:
    """Tell what a closer look brought; a first look that is close enough is one, too."""
    kind = "It is a closer look" if look.index else "It is close enough to tell"
    return f"{kind}: the target is there with a probability of {closer.place:.2f}."


def _brought_in_words(path: Record, look: RecordedLook) -> str:
    """Count the objects by class that no look shows more sharply; empty for none."""
    labels = path.objects.labels[path.objects.passes == look.index].tolist()
    counts = Counter(path.classes[label] for label in labels)
    return ", ".join(counted(count, name) for name, count in counts.most_common())


def _pose_in_words(look: RecordedLook) -> str:
    """Tell the pose of the head in a look."""
    more = look.more
    return f"pan {more['pan']:z.0f}°, tilt {more['tilt']:z.0f}°, field of view {more['field']:.0f}°"


def _where_in_words(path: Record, look: RecordedLook, magnification: float, pose: str | None) -> str:
    """Tell where a look was: at the whole picture, at a point, or in the pose of a head."""
    if path.is_whole(look.region):
        return ", at the whole picture"
    if pose is not None:
        return f": {pose}"
    x, y = look.fixation
    return f" at ({x:z.0f}, {y:z.0f}), magnification {magnification:.2g}"


def _warmed_up(path: Record) -> bool:
    """Tell whether the first look seems to include the warm-up of the detector: over three times the usual time.

    On the clock of a head there is no warm-up, and of fewer than three looks none is usual.
    """
    ends = [look.seconds for look in path if look.seconds is not None]
    if path.kind.turns or len(path) < 3 or len(ends) < len(path):
        return False
    first, *later = [end - start for start, end in pairwise([0.0, *ends])]
    return first > 3 * median(later)


def _label_and_score(detections: Detections, number: int, target: int | None) -> tuple[int, float]:
    """Find the class of a detection of one look, and its score.

    As for objects (`semfov.zoom.merge`), the score of the target counts, even if another class has a higher one.

    Args:
        detections: a batch of one.
        number: number of the detection, from 0.
        target: class 1..K; None for none.

    Returns:
        The class, 0 for background, and the score.
    """
    label = int(detections.labels[0, number])
    if target is not None and label:
        target_score = float(detections.class_scores[0, number, target - 1])
        if target_score >= CONFIDENT:
            return target, target_score
    return label, float(detections.confidence[0, number])


def _detections(path: Record, look: RecordedLook, view: LookView) -> list[Data]:
    """Tell the detections of a look, those of the target first, with boxes and labels in the unit of the view."""
    detections = look.detections
    rows = []
    for number in range(detections.confidence.shape[1]):
        label, score = _label_and_score(detections, number, path.target)
        if score < CONFIDENT:
            continue
        entry = {
            "box": view.boxes[number].tolist(),
            "place": detections.boxes[0, number].tolist(),
            "label": path.classes[label],
            "score": score,
        }
        rows.append((label == path.target, score, entry))
    rows.sort(key=lambda row: row[:2], reverse=True)  # those of the target first, then by score
    entries = [entry for _, _, entry in rows]
    drawn = entries[:_MOST_DETECTIONS]
    # Names would cover small objects. The table has them.
    numbers = [str(number) for number in range(1, len(drawn) + 1)]
    return [*tagged(drawn, numbers, view.size), *entries[_MOST_DETECTIONS:]]
