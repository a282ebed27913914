"""Decoders of cells against plain Python code (`test_onnx` has the others), and recognition of heads."""

import math
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.detection import onnx_decoding as decoding
from semfov.detection.onnx_cells import cell_grid
from semfov.detection.onnx_heads import HEADS, Head
from semfov.detection.onnx_recognition import explain_misplacement, recognise
from semfov.detection.onnx_signature import Signature
from semfov.detection.scores import Candidates
from semfov.errors import InputError
from tests.refusals import refused

both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
canvases = st.tuples(st.integers(8, 130), st.integers(8, 130))


def noise(*shape, dtype=torch.float64, seed=0):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def cell_list(canvas, strides):
    """Column, row and stride of every cell."""
    found = []
    for stride in strides:
        for row in range(math.ceil(canvas[1] / stride)):
            found += [(column, row, stride) for column in range(math.ceil(canvas[0] / stride))]
    return found


def corners(x, y, w, h):
    return [x - w / 2, y - h / 2, x + w / 2, y + h / 2]


def distance_boxes(numbers, cells, offset):
    """Boxes of distributions of the distances of their four sides, `(N, 4 · bins)`, from points of cells."""
    rows, bins = [], numbers.shape[1] // 4
    for (column, row, stride), each in zip(cells, numbers.tolist(), strict=True):
        sides = []
        for side in range(4):
            weights = [math.exp(t) for t in each[side * bins : (side + 1) * bins]]
            sides.append(stride * sum(b * w for b, w in enumerate(weights)) / sum(weights))
        x, y = (column + offset) * stride, (row + offset) * stride
        rows.append([x - sides[0], y - sides[1], x + sides[2], y + sides[3]])
    return rows


def close(actual, expected):
    expected = torch.tensor(expected, dtype=actual.dtype)
    rtol = 1e-5 if actual.dtype == torch.float32 else 1e-12
    torch.testing.assert_close(actual, expected, rtol=rtol, atol=100 * rtol)


def decode(head, canvas, *tensors, names=("logits", "pred_boxes")):
    return HEADS[head].decode(dict(zip(names, tensors, strict=False)), canvas, None)


@given(canvases)
@both
def test_yolox(dtype, canvas):
    cells = cell_list(canvas, (8, 16, 32))
    raw = noise(2, len(cells), 8, dtype=dtype)
    found = decode("yolox", canvas, raw)
    expected = [
        [
            corners((x + c) * s, (y + r) * s, math.exp(w) * s, math.exp(h) * s)
            for (c, r, s), (x, y, w, h) in zip(cells, image[:, :4].tolist(), strict=True)
        ]
        for image in raw
    ]
    close(found.boxes, expected)
    assert torch.equal(found.objectness, raw[..., 4])
    assert torch.equal(found.classes, raw[..., 5:])


@given(canvases, st.integers(2, 9), st.sampled_from([0.0, 0.5]))
@both
def test_distance_distributions(dtype, canvas, bins, offset):
    strides = (8, 16, 32, 64)
    cells = cell_list(canvas, strides)
    classes, distances = noise(1, len(cells), 3, dtype=dtype), 2 * noise(1, len(cells), 4 * bins, dtype=dtype)
    grid = cell_grid(len(cells), canvas, strides, offset, dtype, torch.device("cpu"))
    found = decoding.decode_distances(classes, distances, grid)
    close(found.boxes, [distance_boxes(distances[0], cells, offset)])
    assert torch.equal(found.classes, classes)
    assert found.objectness is None


def test_decoders_are_differentiable_and_compile():
    def numbers(found):
        return tuple(x for x in (found.boxes, found.classes, found.objectness, found.background) if x is not None)

    check = torch.autograd.gradcheck
    raw, boxes = noise(1, 5, 7).requires_grad_(), noise(1, 5, 4, seed=1).sigmoid().requires_grad_()
    assert check(lambda x: numbers(decode("yolox", (32, 16), x)), noise(1, 11, 7).requires_grad_())
    assert check(lambda x: numbers(decoding.decode_yolov5(x)), raw)
    assert check(lambda x: numbers(decoding.decode_yolov8(x)), raw)
    assert check(lambda x, y: numbers(decoding.decode_detr(x, y, (16, 8))), (raw, boxes))
    assert check(lambda x, y: numbers(decode("rtdetr", (16, 8), x, y)), (raw, boxes))
    distances = noise(1, 5, 12).requires_grad_()
    grid = noise(5, 3)
    assert check(lambda x, y: numbers(decoding.decode_distances(x, y, grid)), (raw, distances))
    raw = noise(1, 84, 8)
    compiled = torch.compile(lambda x: decode("yolox", (64, 64), x).boxes, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(raw), decode("yolox", (64, 64), raw).boxes)


def signature(*outputs, canvas=(640, 640), image="images", producer="pytorch", classes=None, **metadata):
    named = tuple(o if isinstance(o[0], str) else (f"output{i}", o) for i, o in enumerate(outputs))
    return Signature(image, named, canvas, producer, classes, metadata)


def maps(*levels, bins=32, names=("cls_pred_stride_{}", "dis_pred_stride_{}")):
    pairs = [
        (name.format(i), (1, n, c)) for name, c in zip(names, (80, bins), strict=True) for i, n in enumerate(levels)
    ]
    return pairs


@pytest.mark.parametrize(
    ("expected", "given"),
    [
        ("yolox", signature(("output", (1, 8400, 85)))),
        ("yolox", signature(("output", (1, 3549, 85)), canvas=(416, 416))),
        ("yolov5", signature((1, 25200, 85))),
        ("yolov5", signature((1, 25200, 7), classes=2)),
        ("yolov5", signature((1, 3 * (25600 + 6400 + 1600 + 400), 85), canvas=(1280, 1280))),
        ("yolov8", signature((1, 84, 8400))),
        ("yolov8", signature((1, 5, 8400))),
        ("yolov8", signature((1, 84, 6300), canvas=(640, 480))),
        ("yolov8", signature((1, 8400, 84))),
        ("yolov8", signature((1, 8400, 6), classes=2)),
        ("yolov5", signature((1, 85, 25200))),
        ("rtdetr", signature((1, 300, 84), classes=80)),
        ("rtdetr", signature((1, 300, 6), classes=2, end2end="False")),
        ("end2end", signature((1, 300, 6), classes=2, end2end="True", task="detect")),
        ("end2end", signature((1, 300, 6), classes=2, end2end="False", args="{'batch': 1, 'nms': True}")),
        ("end2end", signature((1, 300, 6), classes=80)),
        ("end2end-detr", signature(("labels", (1, 300)), ("boxes", (1, 300, 4)), ("scores", (1, 300)))),
        ("end2end-nms", signature(("dets", (1, 100, 5)), ("labels", (1, 100)))),
        (
            "end2end-nms",
            signature(
                ("num_dets", (1, 1)), ("det_boxes", (1, 100, 4)), ("det_scores", (1, 100)), ("det_classes", (1, 100))
            ),
        ),
        (
            "end2end-nms",
            signature(
                ("num_detections", (1,)),
                ("nmsed_boxes", (1, 100, 4)),
                ("nmsed_scores", (1, 100)),
                ("nmsed_classes", (1, 100)),
            ),
        ),
        ("rfdetr", signature(("dets", (1, 300, 4)), ("labels", (1, 300, 91)))),
        ("rtdetr", signature(("logits", (1, 300, 80)), ("pred_boxes", (1, 300, 4)))),
        ("detr", signature(("logits", (1, 100, 92)), ("pred_boxes", (1, 100, 4)), ("hidden", (1, 100, 256)))),
        ("detr", signature(("pred_logits", (1, 100, 6)), ("pred_boxes", (1, 100, 4)), classes=5)),
        ("rtdetr", signature(("pred_logits", (1, 100, 6)), ("pred_boxes", (1, 100, 4)), classes=6)),
        ("candidates", signature(("boxes", (1, 10, 4)), ("objectness", (1, 10)), ("classes", (1, 10, 3)))),
        ("candidates", signature(("boxes", (1, 10, 4)), ("scores", (1, 10, 3)))),
        ("picodet", signature(*maps(2704, 676, 169, 49), canvas=(416, 416), producer="PaddlePaddle")),
        ("nanodet", signature(*maps(1600, 400, 100), canvas=(320, 320))),
        ("nanodet-plus", signature((1, 2125, 112), canvas=(320, 320), classes=80)),
    ],
)
def test_unambiguous_signatures_are_recognised(expected, given):
    assert recognise(given) == expected


def test_a_head_is_registered_by_being_defined():
    class Points(Head):
        name = "points"

        def recognises(self, signature):
            return "points" in signature.shapes

        def decode(self, outputs, canvas, classes):
            points = outputs["points"]
            return Candidates(torch.cat([points[..., :2] - 1, points[..., :2] + 1], -1), points[..., 2:])

    try:
        assert recognise(signature(("points", (1, 5, 9)))) == "points"
        assert decode("points", (64, 64), torch.ones(1, 5, 9), names=["points"]).classes.shape == (1, 5, 7)
    finally:
        HEADS.pop("points")
    refused("no head fits", recognise, signature(("points", (1, 5, 9))))


@pytest.mark.parametrize(
    ("fits", "given"),
    [
        # YOLOv6 also has this shape, with decoded boxes.
        ("yolox and yolox-decoded and yolov5 fit", signature((1, 8400, 85))),
        ("end2end and rtdetr fit", signature((1, 300, 6), classes=2)),
        ("nanodet-plus and yolov5 fit", signature((1, 2125, 112), canvas=(320, 320))),
        ("picodet and nanodet fit", signature(*maps(1600, 400, 100, names=("a{}", "b{}")), canvas=(320, 320))),
        ("no head fits", signature((1, 300, 84))),
        ("no head fits", signature((1, 1000, 85))),
        ("no head fits", signature((1, 255, 20, 20), (1, 255, 40, 40))),
        ("no head fits", signature(("logits", (1, 100, 91)), ("pred_boxes", (1, 100, 4)))),
        ("with 20 classes: no head fits", signature((1, 84, 8400), classes=20)),
    ],
)
def test_ambiguous_signatures_are_refused_with_the_heads_that_fit(fits, given):
    with pytest.raises(InputError, match=fits) as error:
        recognise(given)
    remedy = str(error.value).rpartition("; ")[2]
    assert all(head in remedy for head in HEADS if head in fits)


def test_models_without_score_vectors_or_of_other_tasks_are_refused():
    refused("export", recognise, signature((1, 300, 7)))
    for task in ["segment", "pose", "obb", "classify"]:
        with pytest.raises(InputError, match=f"task: expected a model that detects .*'{task}'"):
            recognise(signature((1, 116, 8400), classes=80, task=task))
    refused("84 rows, one for each cell of a 64 x 64 canvas", decode, "yolox", (64, 64), noise(1, 83, 8))
    refused("bins", decoding.decode_distances, noise(1, 84, 3), noise(1, 84, 30), noise(84, 3))
    refused("boxes", decoding.decode_detr, noise(1, 5, 3), noise(1, 5, 5), (64, 64))


@pytest.mark.parametrize(
    ("given", "run", "said"),
    [
        pytest.param(signature((1, 17, 8400), classes=3), None, r"classes= with the 13 names", id="names"),
        pytest.param(
            signature((1, 100, 84)),
            {"output0": noise(1, 100, 84).sigmoid()},
            "head=, one of rfdetr, rtdetr$",
            id="a head",
        ),
        pytest.param(signature((1, 255, 20, 20), (1, 255, 40, 40)), None, "export the model with", id="none"),
    ],
)
def test_the_remedy_for_outputs_that_no_head_fits_is_one_that_works(given, run, said):
    with pytest.raises(InputError, match=said):
        recognise(given, run and (lambda: run))


def test_places_of_a_pass_tell_heads_of_one_shape_apart():
    """Boxes that the other head would put outside the canvas, or into one pixel of it."""
    raw, pixels = noise(1, 84, 8), torch.cat([64 * noise(1, 84, 4).sigmoid(), noise(1, 84, 4).sigmoid()], -1)
    both = signature(("output", (1, 84, 8)), canvas=(64, 64), classes=3)
    assert recognise(both, lambda: {"output": raw}) == "yolox"
    assert recognise(both, lambda: {"output": pixels}) == "yolox-decoded"
    rows = torch.tensor([[[4.0, 8.0, 40.0, 30.0, 0.9, 1.0], [3.0, 2.0, 9.0, 9.0, 0.2, 0.0], [0.0] * 6]])
    two = signature((1, 3, 6), canvas=(64, 64), classes=2)
    assert recognise(two, lambda: {"output0": rows}) == "end2end"
    assert recognise(two, lambda: {"output0": noise(1, 3, 6).sigmoid()}) == "rtdetr"


def test_end_to_end_rows_are_one_hot_vectors():
    rows = torch.tensor([[[4.0, 8.0, 40.0, 30.0, 0.9, 2.0], [1.0, 1.0, 9.0, 9.0, 0.2, 0.0], [0.0] * 6]])
    found = decoding.decode_end_to_end(rows, 3)
    assert torch.equal(found.boxes, rows[..., :4])
    assert torch.equal(found.classes, torch.tensor([[[0, 0, 0.9], [0.2, 0, 0], [0, 0, 0]]]))
    with pytest.raises(InputError, match="classes: expected a name for each class of the rows, got 2, and class 2"):
        decoding.decode_end_to_end(rows, 2)
    refused("rows: expected a whole number", decoding.decode_end_to_end, rows + 0.5, 9)


def test_selected_outputs_are_one_hot_vectors():
    """Those of RT-DETR, of mmdeploy with the scores beside the boxes, and of a network that counts its boxes."""
    boxes = torch.tensor([[[4.0, 8.0, 40.0, 30.0], [1.0, 1.0, 9.0, 9.0], [5.0, 5.0, 7.0, 7.0]]])
    scores, labels = torch.tensor([[0.9, 0.2, 0.4]]), torch.tensor([[2.0, 0.0, 1.0]])
    every = torch.tensor([[[0, 0, 0.9], [0.2, 0, 0], [0, 0.4, 0]]])
    detr = HEADS["end2end-detr"].decode({"labels": labels, "boxes": boxes, "scores": scores}, (64, 64), 3)
    assert torch.equal(detr.boxes, boxes)
    assert torch.equal(detr.classes, every)
    dets = {"dets": torch.cat([boxes, scores[..., None]], -1), "labels": labels}
    assert torch.equal(HEADS["end2end-nms"].decode(dets, (64, 64), 3).classes, every)
    counted = {"num_dets": torch.tensor([[2.0]]), "det_boxes": boxes, "det_scores": scores, "det_classes": labels}
    found = HEADS["end2end-nms"].decode(counted, (64, 64), 3)
    assert torch.equal(found.classes, torch.cat([every[:, :2], torch.zeros(1, 1, 3)], 1))


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ([0.1, 0.2, 0.4, 0.9], "fractions"),
        ([30.0, 40.0, 10.0, 50.0], "comes first"),
        ([3000.0, 40.0, 3010.0, 50.0], "around .3005, 45., outside"),
        ([30.0, math.nan, 40.0, 50.0], "finite"),
        ([30.0, 40.0, 50.0, 60.0], None),
        ([0.0, 0.0, 0.0, 0.0], None),
    ],
)
def test_boxes_of_another_head_are_told_by_their_places(box, message):
    found = explain_misplacement(torch.tensor([[box]]), (64, 64))
    assert found is None if message is None else re.search(message, found)


def test_corners_that_were_read_as_centres_and_sizes_are_told():
    low, size = 64 * noise(1, 84, 2).sigmoid(), 20 * noise(1, 84, 2, seed=1).sigmoid()
    rows = torch.cat([low, low + size, noise(1, 84, 3).sigmoid()], -1)
    assert explain_misplacement(torch.cat([low, low + size], -1), (64, 64)) is None
    assert "corners" in explain_misplacement(decoding.decode_yolov8(rows.mT).boxes, (64, 64))
    assert "comes first" in explain_misplacement(torch.tensor([[[20.0, 20, 20, 20], [40, 40, 20, 20]]]), (64, 64))
    assert (
        explain_misplacement(torch.tensor([[[20.0, 20, 20, 20], [30, 30, 40, 40], [9, 9, 20, 20]]]), (64, 64)) is None
    )


def test_boxes_with_y_before_x_are_told():
    """By the order of cells, and on a canvas that is not square by their places."""
    for canvas in [(64, 64), (96, 64)]:
        cells = torch.tensor(cell_list(canvas, (8, 16, 32)), dtype=torch.float32)
        middle = (cells[:, :2] + 0.5) * cells[:, 2:] + noise(len(cells), 2, dtype=torch.float32)
        boxes = torch.cat([middle - 9, middle + 9], -1)[None]
        assert explain_misplacement(boxes, canvas) is None
        assert "y comes before x; export" in explain_misplacement(boxes[..., [1, 0, 3, 2]], canvas)
    wide = torch.tensor([[[200.0, 8.0, 220.0, 30.0], [150.0, 1.0, 170.0, 9.0]]])
    assert explain_misplacement(wide, (240, 32)) is None
    assert "y comes before x" in explain_misplacement(wide[..., [1, 0, 3, 2]], (240, 32))
