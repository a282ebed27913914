"""Rows that cannot reach a confidence are left out, and what is selected of the others is the same to the bit."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from semfov.data.examples import example
from semfov.data.inputs import as_image
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_heads import HEADS
from semfov.detection.scores import Candidates
from semfov.detection.selection import Selection, select
from semfov.zoom.eye import _hints_of
from tests.refusals import refused

CANVAS = (64, 64)
CELLS = {8: 64, 16: 16, 32: 4, 64: 1}  # of the canvas, by stride
CLASSES = 3
THREE_LEVELS, FOUR_LEVELS = 84, 85


def noise(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def scores(*shape, seed):
    """Scores from 0 to 1, most of them small."""
    return (2 * noise(*shape, seed=seed) - 3).sigmoid()


def placed(batch, count, columns, seed):
    """Rows of boxes in pixels of the canvas, and of scores."""
    boxes = 64 * noise(batch, count, 4, seed=seed).sigmoid()
    return torch.cat([boxes, scores(batch, count, columns - 4, seed=seed + 1)], -1)


def offsets(batch, count, columns, seed):
    """Rows of any numbers for boxes, and of scores."""
    return torch.cat([noise(batch, count, 4, seed=seed), scores(batch, count, columns - 4, seed=seed + 1)], -1)


def distances_of_cells(batch, seed):
    rows = [scores(batch, FOUR_LEVELS, CLASSES, seed=seed), noise(batch, FOUR_LEVELS, 32, seed=seed + 1)]
    return {"output": torch.cat(rows, -1)}


def distance_maps(batch, seed):
    maps = {}
    for stride in (8, 16, 32):
        maps[f"cls{stride}"] = scores(batch, CELLS[stride], CLASSES, seed=seed + stride)
        maps[f"dis{stride}"] = noise(batch, CELLS[stride], 32, seed=seed - stride)
    return maps


CELL_HEADS = {
    "yolox": lambda batch, seed: {"output": offsets(batch, THREE_LEVELS, 5 + CLASSES, seed)},
    "yolox-decoded": lambda batch, seed: {"output": placed(batch, THREE_LEVELS, 5 + CLASSES, seed)},
    "nanodet-plus": distances_of_cells,
    "yolov5": lambda batch, seed: {"output": placed(batch, 3 * THREE_LEVELS, 5 + CLASSES, seed)},
    "yolov8": lambda batch, seed: {"output": placed(batch, THREE_LEVELS, 4 + CLASSES, seed).mT.contiguous()},
    "picodet": distance_maps,
    "nanodet": distance_maps,
}
OTHERS = {"candidates", "end2end", "end2end-detr", "end2end-nms", "detr", "rtdetr", "rfdetr"}
"""Heads with a few hundred boxes, all of which are decoded."""


def decoded(head, outputs, least):
    return HEADS[head].decode(outputs, CANVAS, CLASSES, least)


def reached(found, least):
    """Boxes and scores of the rows that reach a confidence in some image, in their order."""
    rows = [row for row, best in enumerate(found.confidence.amax(0).tolist()) if best >= least]
    return [numbers[:, rows].tolist() for numbers in (found.boxes, found.classes, found.confidence)]


def test_each_head_is_one_of_cells_or_has_few_boxes():
    assert {*CELL_HEADS, *OTHERS} == {*HEADS}


@pytest.mark.parametrize("head", CELL_HEADS)
@settings(max_examples=25)
@given(st.integers(1, 3), st.integers(100, 999), st.sampled_from([0.002, 0.02, 0.2, 0.5, 0.9]))
def test_rows_that_reach_a_confidence_are_those_of_a_whole_decoding(head, batch, seed, least):
    outputs = CELL_HEADS[head](batch, seed)
    whole, likely = decoded(head, outputs, 0.0), decoded(head, outputs, least)
    assert reached(likely, least) == reached(whole, least)
    assert likely.boxes.shape[1] <= whole.boxes.shape[1]
    selection = Selection(threshold=least, limit=20)
    expected = select(whole, None, selection, HEADS[head].background)
    selected = select(likely, None, selection, HEADS[head].background)
    for name in ("boxes", "scores", "mask", "confidence"):
        assert torch.equal(getattr(selected, name), getattr(expected, name))
    for image in range(batch):
        hints = [_hints_of(found, image, HEADS[head].background, least) for found in (likely, whole)]
        assert torch.equal(hints[0].boxes, hints[1].boxes)
        assert torch.equal(hints[0].scores, hints[1].scores)


@pytest.mark.parametrize("head", CELL_HEADS)
def test_most_rows_are_left_out(head):
    outputs = CELL_HEADS[head](1, 7)
    whole, likely = decoded(head, outputs, 0.0), decoded(head, outputs, 0.5)
    assert 0 < likely.boxes.shape[1] < whole.boxes.shape[1] / 2
    assert decoded(head, outputs, 1.1).boxes.shape[1] == 0


def test_a_detector_shows_the_same_after_its_first_pass():
    """The first pass is decoded and checked as a whole."""
    detector = load_onnx("yolox-nano")
    canvas, placement = detector.fit(as_image(example("sheet"))[None])
    first, later = (detector.detect(canvas, placement) for _ in range(2))
    assert int(first.count) > 3
    for name in ("boxes", "scores", "mask", "confidence"):
        assert torch.equal(getattr(later, name), getattr(first, name))
    likely = detector.propose_likely(canvas, detector.selection.threshold)
    assert likely.boxes.shape[1] < detector.propose(canvas).boxes.shape[1] / 2
    as_bytes = (255 * canvas).round().byte()
    assert torch.equal(detector.propose_likely(as_bytes, 0.0).classes, detector.propose_bytes(as_bytes).classes)
    refused("canvas: expected floating-point", detector.propose_likely, canvas.long(), 0.5)


def test_a_number_that_is_none_is_not_left_out():
    """Selection finds it, as in a whole decoding."""
    outputs = CELL_HEADS["yolox"](1, 7)
    outputs["output"][0, 5, 4] = math.nan
    found = decoded("yolox", outputs, 0.9)
    assert int(found.confidence.isnan().sum()) == 1


def test_few_offsets_from_0_to_1_are_no_fractions():
    """All rows of a pass tell whether boxes are fractions of the canvas, whichever of them are decoded."""
    outputs = CELL_HEADS["yolox"](1, 7)
    outputs["output"][0, :, 4] = 0
    outputs["output"][0, 9, :5] = torch.tensor([0.2, 0.4, 0.6, 0.8, 0.9])
    found = decoded("yolox", outputs, 0.5)
    assert isinstance(found, Candidates)
    assert found.boxes.shape == (1, 1, 4)
