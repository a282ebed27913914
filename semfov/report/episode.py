"""An episode as data for a page: pictures as JPEG, and probabilities quantised to 255 steps of their maximum."""

import base64
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from semfov.detection.placement import resize
from semfov.io.files import MADE_HERE
from semfov.paths import Record, Scanpath
from semfov.paths.look import confident_detections
from semfov.viz.belief import class_posterior
from semfov.viz.labels import LabelBox, place_labels
from semfov.viz.semantic import cell_entropy

Data = dict[str, Any]

_DRAWN = 500  # largest number of objects that are drawn in the picture and listed
_MOST, _SCORES = 10, 5  # detections of a look, and classes of each, that are told


def pillow(image: Tensor) -> Any:
    """A picture `(3, H, W)`, of bytes or in [0, 1], for Pillow."""
    from PIL import Image

    pixels = image if image.dtype == torch.uint8 else (image.detach().clamp(0, 1) * 255).round().byte()
    return Image.fromarray(pixels.cpu().permute(1, 2, 0).numpy())


def jpeg(image: Tensor, quality: int) -> bytes:
    """A picture `(3, H, W)`, of bytes or in [0, 1], as JPEG."""
    file = io.BytesIO()
    pillow(image).save(file, "JPEG", quality=quality, optimize=True, comment=MADE_HERE)
    return file.getvalue()


def jpeg_uri(image: Tensor, width: int, quality: int) -> str:
    """A picture `(3, H, W)` as a data URI, reduced to at most `width` pixels."""
    if image.shape[-1] > width:
        image = resize(image[None], (width, max(1, round(width * image.shape[-2] / image.shape[-1]))))[0]
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(image, quality)).decode()


def episode_data(
    scanpath: Scanpath,
    image: Tensor | None,
    views: Sequence[Tensor] | None,
    *,
    name: str,
    settings: Mapping[str, Any] | None = None,
    boxes: Tensor | None = None,
    classes: int | None = None,
    width: int = 416,
    quality: int = 75,
) -> Data:
    """Collect the data of an episode for a page, as JSON values."""
    grid, decision = scanpath.grid, scanpath.decision
    size = grid.extent.tolist()
    found = decision if decision is not None and decision.outcome == "found" else None
    best = found.box if found is not None else scanpath.best_place and scanpath.best_place[0]
    timed = len(scanpath.seconds) > 0
    after = [*scanpath.cells.tolist()[1:], None]
    every_view: Sequence[Tensor | None] = [None] * len(scanpath) if views is None else views
    fixations = [
        {
            "cell": cell,
            "view": None if view is None else jpeg_uri(view, width, quality),
            "detections": _detection_data(scanpath, number),
            "values": [rounded(value) for value in scanpath.values[number].tolist()],
            "next": after[number],
            "seconds": dict(scanpath.seconds[number]) if timed else None,
        }
        for number, (cell, view) in enumerate(zip(scanpath.cells.tolist(), every_view, strict=True))
    ]
    return {
        "name": name,
        **object_data(scanpath),
        **_about_data(scanpath, settings),
        "summary": scanpath.describe(),
        "outcome": {
            "why": scanpath.why_it_ended(),
            "cell": None if found is None else found.cell,
            "box": None if best is None else [round(x, 1) for x in best.tolist()],
        },
        "presence": None if scanpath.presence is None else [rounded(p, 9) for p in scanpath.presence.tolist()],
        "size": size,
        "grid": [grid.columns, grid.rows],
        "image": None if image is None else jpeg_uri(image, width * 3 // 2, quality),
        "target": None if scanpath.target is None else scanpath.classes[scanpath.target],
        "found": scanpath.found,
        "truth": [] if boxes is None else boxes.tolist(),
        "fixations": fixations,
        "maps": _map_data(scanpath, classes),
        "entropy": _quantised(cell_entropy(scanpath)),
    }


def object_data(record: Record) -> Data:
    """Picture, detector, passes and objects of a record; the page rounds their scores."""
    (width, height), rows = record.size, record.object_rows()
    told = "look", "confirmed", "pan", "tilt"
    return {
        "pixels": f"{width} × {height} px",
        "detector": record.detector,
        "passes": str(record.passes),
        "objects": [
            {
                "box": [row[side] for side in ("x1", "y1", "x2", "y2")],
                "label": row["class"],
                "score": score,
                **{name: row[name] for name in told if name in row},
            }
            for row, score in zip(rows[:_DRAWN], record.objects.scores.tolist(), strict=False)
        ],
        "count": len(rows),
        "confirmable": record.confirmable,
        "turns": record.kind.turns,
        "best": None if record.best_place is None else record.best_place[0].tolist(),
    }


def _about_data(scanpath: Scanpath, settings: Mapping[str, Any] | None) -> Data:
    """Detector, sensor and decision in words; None for parts that were not kept."""
    if settings is None and scanpath.stimulus is not None:
        settings = scanpath.stimulus.settings
    decision = scanpath.summary()
    if scanpath.decision is not None and scanpath.decision.cell is not None:
        row, column = divmod(scanpath.decision.cell, scanpath.grid.columns)
        decision += f" It is at column {column}, row {row}."
    for look in scanpath.closer:
        assert look.cell is not None
        row, column = divmod(look.cell, scanpath.grid.columns)
        decision += f" Closer look at column {column}, row {row}: probability {look.place:.2f}."
    if settings is None:
        return {"detector": scanpath.detector, "sensor": None, "decision": decision}
    sensor = settings["sensor"]
    if "sigma" in sensor and "growth" in sensor:
        words = f"fovea of {sensor['sigma']:.0f} px in {sensor['reference']:.0f}, growth {sensor['growth']:g}"
    else:
        numbers = (f"{name} {value:g}" for name, value in sensor.items() if isinstance(value, int | float))
        words = ", ".join([str(sensor.get("kind", "sensor")), *numbers])
    return {"detector": settings["detector"]["name"], "sensor": words, "decision": decision}


def _detection_data(scanpath: Scanpath, fixation: int) -> list[Data]:
    """The most confident detections of a look, each with its highest class scores and the position of its label."""
    looked, classes = confident_detections(scanpath.detections[fixation], _MOST)[0], scanpath.classes
    detections = []
    for box, scores in zip(looked.boxes, looked.class_scores, strict=True):
        best = scores.topk(min(_SCORES, len(scores)))
        pairs = zip(best.values.tolist(), best.indices.tolist(), strict=True)
        top = [[classes[index + 1], rounded(score, 9)] for score, index in pairs]
        detections.append({"box": [round(x, 1) for x in box.tolist()], "label": top[0][0], "scores": top})
    width, height = scanpath.grid.extent.tolist()
    unit = width / 640
    x, y = (scanpath.fixations[fixation] + 0.5).tolist()
    texts = [f"{number} {detection['label']}" for number, detection in enumerate(detections, 1)]
    return tagged(detections, texts, (width, height), [(x - 14 * unit, y - 14 * unit, x + 14 * unit, y + 14 * unit)])


def tagged(
    detections: list[Data], texts: Sequence[str], frame: tuple[float, float], obstacles: Sequence[LabelBox] = ()
) -> list[Data]:
    """Detections with `tag`, the rectangle of their text; frame `(width, height)`."""
    unit = frame[0] / 640
    sizes = [(unit * (11.5 * len(text) + 8), unit * 25) for text in texts]
    places = place_labels([tuple(detection["box"]) for detection in detections], sizes, frame, obstacles)
    return [
        {**detection, "tag": [round(x, 1) for x in place]} for detection, place in zip(detections, places, strict=True)
    ]


def _map_data(scanpath: Scanpath, classes: int | None) -> list[Data]:
    """Probability maps `(n, X·Y)`: of the target, then of the classes most probable anywhere, then of background."""
    probabilities = scanpath.probabilities.detach().cpu()
    order = (1 + probabilities[..., 1:].amax((0, 1)).argsort(descending=True, stable=True)).tolist()
    target, maps = scanpath.target, []
    if target is not None:
        order = [index for index in order if index != target]
        maps.append({"label": scanpath.classes[target], **_quantised(class_posterior(scanpath)[0])})
    labels = [*order[: None if classes is None else max(0, classes - len(maps))], 0]
    maps += [{"label": scanpath.classes[index], **_quantised(probabilities[..., index])} for index in labels]
    # Some detectors give several classes the same name. A number tells their entries apart.
    times: Counter[str] = Counter()
    for each in maps:
        times[each["label"]] += 1
        if times[each["label"]] > 1:
            each["label"] = f"{each['label']} ({times[each['label']]})"
    return maps


def _quantised(values: Tensor) -> Data:
    """Numbers of 0 or more in 255 steps of their maximum, in row-major order, in base 64."""
    greatest = max(float(values.max()), 1e-12)
    steps = (values.detach().cpu().double() / greatest * 255).round().to(torch.uint8)
    return {"max": rounded(greatest), "data": base64.b64encode(np.ascontiguousarray(steps.numpy()).tobytes()).decode()}


def rounded(value: float, digits: int = 4) -> float | None:
    """A number rounded to some digits, of which 9 keep a float32; None if it is not finite."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
