"""An episode as data for a page: pictures as JPEG, and probabilities quantised to 255 steps of their maximum."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from semfov.detection.placement import resize
from semfov.errors import checked_keywords
from semfov.io.compatibility import Settings
from semfov.io.files import MADE_HERE
from semfov.paths import Record, Scanpath
from semfov.paths.look import confident_detections
from semfov.report.markup import data_uri
from semfov.viz.belief import class_posterior
from semfov.viz.labels import LabelBox, place_labels
from semfov.viz.semantic import cell_entropy

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

Data = dict[str, Any]
"""JSON values of a record, or of a part of it, by name."""

_DRAWN = 500  # largest number of objects that are drawn in the picture and listed
_DETECTIONS = 10  # largest number of detections of a look that are listed
_SCORES = 5  # largest number of classes of a detection that are listed


def pillow(image: Tensor) -> PillowImage:
    """Convert a picture `(3, H, W)`, of bytes or in [0, 1], for Pillow."""
    from PIL import Image

    # Pillow has the channels last.
    pixels = image if image.dtype == torch.uint8 else (image.detach().clamp(0, 1) * 255).round().byte()
    return Image.fromarray(pixels.cpu().permute(1, 2, 0).numpy())


def jpeg(image: Tensor, quality: int) -> bytes:
    """Encode a picture `(3, H, W)`, of bytes or in [0, 1], as JPEG."""
    file = io.BytesIO()
    pillow(image).save(file, "JPEG", quality=quality, optimize=True, comment=MADE_HERE)
    return file.getvalue()


def jpeg_uri(image: Tensor, width: int, quality: int) -> str:
    """Encode a picture as a data URI.

    Args:
        image: `(3, H, W)`, of bytes or in [0, 1].
        width: width in pixels to which a wider picture is reduced.
        quality: of the JPEG, up to 100.

    Returns:
        The URI.
    """
    rows, columns = image.shape[-2:]
    if columns > width:
        height = max(1, round(width * rows / columns))
        image = resize(image[None], (width, height))[0]
    return data_uri("jpeg", jpeg(image, quality))


@checked_keywords
def episode_data(
    scanpath: Scanpath,
    image: Tensor | None,
    views: Sequence[Tensor] | None,
    *,
    name: str,
    settings: Settings | None = None,
    boxes: Tensor | None = None,
    classes: int | None = None,
    width: int = 416,
    quality: int = 75,
) -> Data:
    """Collect the data of an episode for a page, as JSON values.

    Args:
        scanpath: the episode.
        image: `(3, H, W)`, the photograph; None leaves it out.
        views: for each fixation the foveated photograph `(3, h, w)`; None leaves them out.
        name: name of the photograph.
        settings: those of the eye; None takes those that the scanpath keeps.
        boxes: `(M, 4)`, true boxes of the target.
        classes: largest number of classes with a map; None for all.
        width: width in pixels to which views are reduced.
        quality: of the JPEGs.

    Returns:
        The data, for `semfov.report.write_page`.
    """
    grid = scanpath.grid
    photograph = None if image is None else jpeg_uri(image, width * 3 // 2, quality)
    presence = None
    if scanpath.presence is not None:
        presence = [rounded(chance, 9) for chance in scanpath.presence.tolist()]
    data = object_data(scanpath)
    for found in data["objects"]:
        # The page steps through fixations, and closer looks are none.
        found["look"] = scanpath.fixation_after(found["look"] - 1) + 1
    return {
        "name": name,
        **data,
        **_about_data(scanpath, settings),
        "summary": scanpath.describe(),
        "outcome": _outcome_data(scanpath),
        "presence": presence,
        "size": grid.extent.tolist(),
        "grid": [grid.columns, grid.rows],
        "image": photograph,
        "target": scanpath.target_name,
        "found": scanpath.found,
        "truth": [] if boxes is None else boxes.tolist(),
        "fixations": _fixation_data(scanpath, views, width, quality),
        "maps": _map_data(scanpath, classes),
        "entropy": _quantised(cell_entropy(scanpath)),
    }


def _outcome_data(scanpath: Scanpath) -> Data:
    """Tell why the episode ended, and where the target was found, or is most likely."""
    cell = None
    box = None
    decision = scanpath.decision
    if decision is not None and decision.outcome == "found":
        cell = decision.cell
        box = decision.box
    elif scanpath.best_place is not None:
        box, _ = scanpath.best_place
    edges = None if box is None else [round(edge, 1) for edge in box.tolist()]
    return {"why": scanpath.why_it_ended(), "cell": cell, "box": edges}


def _fixation_data(scanpath: Scanpath, views: Sequence[Tensor] | None, width: int, quality: int) -> list[Data]:
    """Tell of each fixation what was seen, the values of the next ones, and its time."""
    following = [*scanpath.cells.tolist()[1:], None]
    fixations = []
    for number, look in enumerate(scanpath.fixated):
        fixations.append(
            {
                "cell": look.cell,
                "view": None if views is None else jpeg_uri(views[number], width, quality),
                "detections": _detection_data(scanpath, number),
                "values": [rounded(value) for value in scanpath.values[number].tolist()],
                "next": following[number],
                "seconds": dict(look.stages) if look.stages else None,
            }
        )
    return fixations


def object_data(record: Record) -> Data:
    """Collect picture, detector, passes and objects of a record; the page rounds their scores.

    Args:
        record: the record, of any kind.

    Returns:
        JSON values by name.
    """
    width, height = record.size
    rows = record.object_rows()
    objects = []
    for row, score in zip(rows[:_DRAWN], record.objects.scores.tolist(), strict=False):
        box = [row[edge] for edge in ("x1", "y1", "x2", "y2")]
        more: Data = {name: row[name] for name in ("look", "confirmed", "pan", "tilt") if name in row}
        objects.append({"box": box, "label": row["class"], "score": score, **more})
    return {
        "pixels": f"{width} × {height} px",
        "detector": record.detector,
        "passes": str(record.passes),
        "objects": objects,
        "count": len(rows),
        "verdict": _verdict(record),
        "confirmable": record.confirmable,
        "turns": record.kind.turns,
        "best": None if record.best_place is None else record.best_place[0].tolist(),
    }


def _verdict(record: Record) -> str:
    """Tell how a search ended; without a decision something was found, or nothing, which is absent."""
    has_find = record.found or len(record.objects) > 0
    return record.verdict or ("found" if has_find else "absent")


def _about_data(scanpath: Scanpath, settings: Settings | None) -> Data:
    """Tell detector, sensor and decision in words; None for parts that were not kept."""
    if settings is None and scanpath.stimulus is not None:
        settings = scanpath.stimulus.settings
    return {
        "detector": scanpath.detector if settings is None else settings["detector"]["name"],
        "sensor": None if settings is None else _sensor_in_words(settings["sensor"]),
        "decision": _decision_in_words(scanpath),
    }


def _decision_in_words(scanpath: Scanpath) -> str:
    """Summarise the episode, with the cells of the decision and of the closer looks."""
    sentences = [scanpath.summary()]
    if scanpath.decision is not None and scanpath.decision.cell is not None:
        sentences.append(f"It is at {_cell_in_words(scanpath, scanpath.decision.cell)}.")
    for look in scanpath.closer:
        assert look.cell is not None
        sentences.append(f"Closer look at {_cell_in_words(scanpath, look.cell)}: probability {look.place:.2f}.")
    return " ".join(sentences)


def _cell_in_words(scanpath: Scanpath, cell: int) -> str:
    row, column = divmod(cell, scanpath.grid.columns)
    return f"column {column}, row {row}"


def _sensor_in_words(sensor: Settings) -> str:
    """Describe a fovea, or a sensor of another kind by its numbers."""
    if "sigma" in sensor and "growth" in sensor:
        return f"fovea of {sensor['sigma']:.0f} px in {sensor['reference']:.0f}, growth {sensor['growth']:g}"
    numbers = [f"{name} {value:g}" for name, value in sensor.items() if isinstance(value, int | float)]
    return ", ".join([str(sensor.get("kind", "sensor")), *numbers])


def _detection_data(scanpath: Scanpath, fixation: int) -> list[Data]:
    """Collect the most confident detections of a look.

    Args:
        scanpath: the record.
        fixation: number of the look, from 0.

    Returns:
        Data of each: its box, its best classes with their scores, and the place of its label.
    """
    found = confident_detections(scanpath.fixated[fixation].detections, _DETECTIONS)[0]  # a batch of one
    detections = []
    for box, scores in zip(found.boxes, found.class_scores, strict=True):
        best = scores.topk(min(_SCORES, len(scores)))  # of (K,), without background
        names = [scanpath.classes[index + 1] for index in best.indices.tolist()]
        classes = [[name, rounded(score, 9)] for name, score in zip(names, best.values.tolist(), strict=True)]
        detections.append({"box": [round(x, 1) for x in box.tolist()], "label": names[0], "scores": classes})
    width, height = scanpath.grid.extent.tolist()
    texts = [f"{number} {detection['label']}" for number, detection in enumerate(detections, 1)]
    # No label covers the mark of the gaze. Pixel centres are at integers, and in the page edges of pixels are.
    x, y = (scanpath.fixations[fixation] + 0.5).tolist()
    reach = 14 * width / 640
    mark = (x - reach, y - reach, x + reach, y + reach)
    return tagged(detections, texts, (width, height), [mark])


def tagged(
    detections: list[Data], texts: Sequence[str], frame: tuple[float, float], obstacles: Sequence[LabelBox] = ()
) -> list[Data]:
    """Find the places of the labels of detections.

    Args:
        detections: data of the detections.
        texts: text of each label.
        frame: `(width, height)` of the view.
        obstacles: rectangles that no label covers.

    Returns:
        The data of each, with `tag`, the rectangle of its text.
    """
    unit = frame[0] / 640  # the view is drawn about 640 pixels of the screen wide
    sizes = [(unit * (11.5 * len(text) + 8), unit * 25) for text in texts]
    places = place_labels([tuple(detection["box"]) for detection in detections], sizes, frame, obstacles)
    with_tags = []
    for detection, place in zip(detections, places, strict=True):
        tag = [round(side, 1) for side in place]
        with_tags.append({**detection, "tag": tag})
    return with_tags


def _map_data(scanpath: Scanpath, classes: int | None) -> list[Data]:
    """Quantise the maps `(n, X·Y)` of the target, of the classes most probable anywhere, and of background."""
    probabilities = scanpath.probabilities.detach().cpu()  # (n, X·Y, K+1)
    highest = probabilities[..., 1:].amax((0, 1))  # (K,), anywhere after any look; background comes last
    labels = (1 + highest.argsort(descending=True, stable=True)).tolist()
    target = scanpath.target
    maps = []
    if target is not None:
        labels.remove(target)
        maps.append({"label": scanpath.classes[target], **_quantised(class_posterior(scanpath)[0])})
    if classes is not None:
        labels = labels[: max(0, classes - len(maps))]
    maps += [{"label": scanpath.classes[label], **_quantised(probabilities[..., label])} for label in (*labels, 0)]
    # Some detectors give several classes the same name. A number tells their entries apart.
    times: Counter[str] = Counter()
    for entry in maps:
        name = entry["label"]
        times[name] += 1
        if times[name] > 1:
            entry["label"] = f"{name} ({times[name]})"
    return maps


def _quantised(values: Tensor) -> Data:
    """Encode numbers of 0 or more in 255 steps of their maximum, in row-major order, in base 64."""
    greatest = max(float(values.max()), 1e-12)  # a map of zeros is not divided by 0
    shares = values.detach().cpu().double() / greatest
    steps = (shares * 255).round().to(torch.uint8)
    data = np.ascontiguousarray(steps.numpy()).tobytes()
    return {"max": rounded(greatest), "data": base64.b64encode(data).decode()}


def rounded(value: float, digits: int = 4) -> float | None:
    """Round a number to some digits, of which 9 keep a float32; None if it is not finite."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
