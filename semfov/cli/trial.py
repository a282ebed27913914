"""`semfov detectors NAME --try PHOTO`: what the bare detector shows in a photograph beside what semfov lists."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.cli.outcome import table_lines
from semfov.detection import Candidates, Detector, Objects, score_vectors
from semfov.detection.objects import SCORE_THRESHOLD, box_text
from semfov.detection.onnx import OnnxDetector
from semfov.detection.onnx_heads import HEADS
from semfov.detection.selection import suppress
from semfov.io.compatibility import NETWORKS
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.zoom.eye import WindowEye
from semfov.zoom.looks import Window

_MORE = 1.25  # factor of the sum of scores from which on the other order of the channels suits a detector better
_FEW = 16  # number of different scores up to which an export has lost them
_ENOUGH = 100  # number of scores from which on they must differ


@dataclass(frozen=True)
class Trial:
    """One pass over a whole photograph: boxes `(M, 4)` in its pixels, scores and labels `(M,)`, and all proposals."""

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    proposals: Candidates

    @classmethod
    @torch.inference_mode()
    def of(cls, eye: WindowEye, photo: Path) -> "Trial":
        """Run the bare detector: its best class of each box, and non-maximum suppression.

        Args:
            eye: looks at the photograph with the detector.
            photo: the photograph.

        Returns:
            What the detector shows.
        """
        detector = eye.detector
        view = eye.open(photo)
        overview = torch.tensor([Window.overview(view.lattice).fixation])
        canvas, frames = eye.glimpse(view, overview)
        proposals = detector.propose(canvas).precise()
        confidence = proposals.confidence[0]  # (N,), of all boxes
        labels = proposals.classes[0].argmax(-1)  # (N,), from 0 without background

        confident = (confidence >= SCORE_THRESHOLD).nonzero()[:, 0]
        boxes = proposals.boxes[0, confident]
        survivors = suppress(boxes, confidence[confident], labels[confident], detector.selection)
        index = confident[survivors]

        # From the canvas, where the photograph lies between two corners, to its pixels.
        first_pixel, last_pixel, first, last = frames[0].view(4, 2).repeat(1, 2).unbind()
        placed = (boxes[survivors] - first) * (last_pixel - first_pixel) / (last - first) + first_pixel
        placed = placed.clamp(first_pixel, last_pixel)
        return cls(placed, confidence[index], labels[index] + 1, proposals)


def try_detector(agent: ActivePerception, photo: Path) -> None:
    """Print what a detector shows in a photograph beside what semfov lists after one look, and what may be lost.

    Args:
        agent: the agent of the detector.
        photo: the photograph.
    """
    detector = agent.eye.detector
    eye = agent.zoom.eye
    bare = Trial.of(eye, photo)
    record = agent.find_all(photo, how="windows", passes=1, score_threshold=SCORE_THRESHOLD)
    rows = _rows(bare, record.objects, agent.classes)
    listed = sum("-" not in row[1:3] for row in rows)
    print(f"{detector.name}: {_settings(detector)}")
    print(
        f"{photo.name}: the bare detector shows {len(bare.scores)} from {SCORE_THRESHOLD:g} on, "
        f"and semfov lists {listed} of them"
    )
    if rows:
        print("\n".join(table_lines([["class", "bare", record.words.measure, "box"], *rows])))
    for word in (*_about_scores(bare, detector), *_about_colours(bare, eye, photo)):
        print(f"note: {word}")


def _settings(detector: Detector) -> str:
    """Write the settings of a detector that its scores depend on."""
    width, height = detector.input_size
    parts = [f"{len(detector.classes)} classes", f"{width} × {height} px"]
    if isinstance(detector, OnnxDetector):
        parts = [f"head {detector.head}", f"colours {detector.preprocessing.channels}", *parts]
    return ", ".join([*parts, f"background {detector.background}"])


def _rows(bare: Trial, objects: Objects, classes: tuple[str, ...]) -> list[list[str]]:
    """List class, both scores and box of what the bare detector shows, and then of what semfov lists beyond it.

    Args:
        bare: what the detector shows, most confident first.
        objects: what semfov lists; each stands beside one box of the detector at most.
        classes: names of the classes, background first.

    Returns:
        The cells of each row; `-` where one of them does not have the object.
    """
    partners = _partners(bare, objects)
    rows: list[list[str]] = []
    for box, score, label, partner in zip(bare.boxes, bare.scores, bare.labels, partners, strict=True):
        listed_score = "-" if partner is None else f"{objects.scores[partner]:.2f}"
        rows.append([classes[label], f"{score:.2f}", listed_score, box_text(box.tolist())])
    for number, (box, score, label) in enumerate(zip(objects.boxes, objects.scores, objects.labels, strict=True)):
        if number not in partners:
            rows.append([classes[label], "-", f"{score:.2f}", box_text(box.tolist())])
    return rows


def _partners(bare: Trial, objects: Objects) -> list[int | None]:
    """Find the number of the object that semfov lists at each box of the detector, of the same class; None for none.

    An object is the partner of the most confident box that overlaps it best, and of no other.
    """
    partners: list[int | None] = []
    for box, label in zip(bare.boxes, bare.labels, strict=True):
        partner = None
        if len(objects):
            overlap = box_iou(box[None], objects.boxes.to(box))[0] * (objects.labels == label)  # (objects,)
            best = int(overlap.argmax())
            is_same = best not in partners and float(overlap[best]) >= SAME_OBJECT_IOU
            partner = best if is_same else None
        partners.append(partner)
    return partners


def _about_scores(bare: Trial, detector: Detector) -> list[str]:
    """Say what the scores of the proposals tell of the export, its head and its background."""
    confidence = bare.proposals.confidence[0]
    if not len(bare.scores):
        return [_about_low_scores(confidence)]
    best_box = confidence.argmax()[None]
    share = float(score_vectors(bare.proposals.take(0, best_box), detector.background)[0, 1:].max())
    score = float(confidence.max())
    if share >= 0.5 * score:
        return []
    return [
        f"in the score vectors, which beliefs read, the best class has {share:.2f} of {score:.2f}, since many small "
        "scores share it; lists have the score itself, and semfov fit learns the difference"
    ]


def _about_low_scores(confidence: Tensor) -> str:
    """Say why all scores may be so low that nothing is shown: they were lost, or are read in the wrong way."""
    values = len(confidence.unique())
    if len(confidence) >= _ENOUGH and values <= _FEW:
        return (
            f"its {len(confidence):,} boxes have {values} different score{'s' if values > 1 else ''}: an export to "
            "int8 with one scale for boxes and scores loses the scores; leave its last layers out of the conversion"
        )
    best = float(confidence.amax()) if len(confidence) else 0.0
    return (
        f"the best score is {best:.2f}; if the photograph shows objects of its classes, the head or the colours "
        "may be wrong: give --head, --colour or --logits"
    )


def _about_colours(bare: Trial, eye: WindowEye, photo: Path) -> list[str]:
    """Say whether an ONNX file shows more with the other order of the channels than that of a known network."""
    detector = eye.detector
    if not isinstance(detector, OnnxDetector):
        return []
    usual = detector.preprocessing
    if detector.digest in NETWORKS and usual.channels == HEADS[detector.head].preprocessing.channels:
        return []
    other: Literal["rgb", "bgr"] = "bgr" if usual.channels == "rgb" else "rgb"
    detector.preprocessing = replace(usual, channels=other)
    try:
        swapped = Trial.of(eye, photo)
    finally:
        detector.preprocessing = usual
    shows_more = float(swapped.scores.sum()) >= _MORE * float(bare.scores.sum())
    # Where the detector shows nothing either way, no sum is less than the other.
    if not len(swapped.scores) or not shows_more:
        return []
    return [
        f"with --colour {other} it shows {len(swapped.scores)} from {SCORE_THRESHOLD:g} on; other photographs will tell"
    ]
