"""Decoders of cells against plain Python code (`test_onnx` has the others), and recognition of heads."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.detection import onnx_heads as heads
from semfov.detection.onnx_heads import HEADS, Signature, recognise
from semfov.errors import InputError

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


def close(actual, expected):
    expected = torch.tensor(expected, dtype=actual.dtype)
    rtol = 1e-5 if actual.dtype == torch.float32 else 1e-12
    torch.testing.assert_close(actual, expected, rtol=rtol, atol=100 * rtol)


@given(canvases, st.sampled_from([(8, 16, 32), (32,), (8, 16, 32, 64)]))
@both
def test_yolox(dtype, canvas, strides):
    cells = cell_list(canvas, strides)
    raw = noise(2, len(cells), 8, dtype=dtype)
    found = heads.decode_yolox(raw, canvas, strides)
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
    found = heads.decode_distances(classes, distances, canvas, strides=strides, offset=offset)
    expected = []
    for (column, row, stride), numbers in zip(cells, distances[0].tolist(), strict=True):
        sides = []
        for side in range(4):
            weights = [math.exp(t) for t in numbers[side * bins : (side + 1) * bins]]
            sides.append(stride * sum(b * w for b, w in enumerate(weights)) / sum(weights))
        x, y = (column + offset) * stride, (row + offset) * stride
        expected.append([x - sides[0], y - sides[1], x + sides[2], y + sides[3]])
    close(found.boxes, [expected])
    assert torch.equal(found.classes, classes)
    assert found.objectness is None


def test_decoders_are_differentiable():
    def numbers(found):
        return tuple(x for x in (found.boxes, found.classes, found.objectness, found.background) if x is not None)

    check = torch.autograd.gradcheck
    raw, boxes = noise(1, 5, 7).requires_grad_(), noise(1, 5, 4, seed=1).sigmoid().requires_grad_()
    assert check(lambda x: numbers(heads.decode_yolox(x, (16, 16), (8, 16))), raw)
    assert check(lambda x: numbers(heads.decode_yolov5(x)), raw)
    assert check(lambda x: numbers(heads.decode_yolov8(x)), raw)
    assert check(lambda x, y: numbers(heads.decode_detr(x, y, (16, 8))), (raw, boxes))
    assert check(lambda x, y: numbers(heads.decode_rtdetr(x, y, (16, 8))), (raw, boxes))
    distances = noise(1, 5, 12).requires_grad_()
    assert check(lambda x, y: numbers(heads.decode_distances(x, y, (16, 16), strides=(8, 16))), (raw, distances))


def test_decoder_compiles():
    raw = noise(1, 84, 8)
    compiled = torch.compile(heads.decode_yolox, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(raw, (64, 64)).boxes, heads.decode_yolox(raw, (64, 64)).boxes)


def test_wrong_shapes_are_refused_by_name():
    with pytest.raises(InputError, match="84 rows, one for each cell of a 64 x 64 canvas"):
        heads.decode_yolox(noise(1, 83, 8), (64, 64))
    with pytest.raises(InputError, match="bins"):
        heads.decode_distances(noise(1, 84, 3), noise(1, 84, 30), (64, 64), strides=(8, 16, 32))
    with pytest.raises(InputError, match="boxes"):
        heads.decode_detr(noise(1, 5, 3), noise(1, 5, 5), (64, 64))


LEVELS = (6400, 1600, 400)


def signature(*outputs, canvas=(640, 640), image="images", producer="pytorch", classes=None):
    named = tuple(o if isinstance(o[0], str) else (f"output{i}", o) for i, o in enumerate(outputs))
    return Signature(image, named, canvas, producer, classes)


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
        ("rtdetr", signature((1, 300, 84), classes=80)),
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


@pytest.mark.parametrize(
    ("fits", "given"),
    [
        ("yolox and yolov5 fit", signature((1, 8400, 85))),  # YOLOv6 also has this shape, with decoded boxes
        ("nanodet-plus and yolov5 fit", signature((1, 2125, 112), canvas=(320, 320))),
        ("picodet and nanodet fit", signature(*maps(1600, 400, 100, names=("a{}", "b{}")), canvas=(320, 320))),
        ("no head fits", signature((1, 300, 84))),
        ("no head fits", signature((1, 1000, 85))),
        ("no head fits", signature((1, 255, 20, 20), (1, 255, 40, 40))),
        ("no head fits", signature(("logits", (1, 100, 91)), ("pred_boxes", (1, 100, 4)))),
        ("with 20 classes: no head fits", signature((1, 84, 8400), classes=20)),
    ],
)
def test_ambiguous_signatures_are_refused_with_a_list_of_heads(fits, given):
    with pytest.raises(InputError, match=fits) as error:
        recognise(given)
    assert all(head in str(error.value) for head in HEADS)


@pytest.mark.parametrize(
    "given",
    [
        signature((1, 300, 6)),
        signature((1, 300, 6), classes=80),
        signature(("labels", (1, 300)), ("boxes", (1, 300, 4)), ("scores", (1, 300))),
    ],
)
def test_outputs_without_score_vectors_are_refused(given):
    with pytest.raises(InputError, match="export"):
        recognise(given)
