"""Every decoder against plain Python code that decodes one box at a time."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.detection import onnx_heads as heads
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


@both
def test_yolov5_and_yolov8_rows(dtype):
    rows = noise(2, 7, 9, dtype=dtype)
    expected = [[corners(*row[:4]) for row in image] for image in rows.tolist()]
    five, eight = heads.decode_yolov5(rows), heads.decode_yolov8(rows.transpose(1, 2))
    close(five.boxes, expected)
    close(eight.boxes, expected)
    assert torch.equal(five.objectness, rows[..., 4])
    assert torch.equal(five.classes, rows[..., 5:])
    assert eight.objectness is None
    assert torch.equal(eight.classes, rows[..., 4:])


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


@both
def test_detr_softmax_and_sigmoid(dtype):
    canvas = (60, 40)
    logits, boxes = noise(2, 5, 4, dtype=dtype), noise(2, 5, 4, dtype=dtype, seed=1).sigmoid()
    expected = [[corners(x * 60, y * 40, w * 60, h * 40) for x, y, w, h in image] for image in boxes.tolist()]
    soft, hard = heads.decode_detr(logits, boxes, canvas), heads.decode_rtdetr(logits, boxes, canvas)
    close(soft.boxes, expected)
    close(hard.boxes, expected)
    powers = [[[math.exp(t) for t in row] for row in image] for image in logits.tolist()]
    close(soft.classes, [[[p / sum(row) for p in row[:-1]] for row in image] for image in powers])
    close(soft.background, [[row[-1] / sum(row) for row in image] for image in powers])
    close(hard.classes, [[[p / (1 + p) for p in row] for row in image] for image in powers])
    assert hard.background is None
    rows = heads.decode_rtdetr_rows(torch.cat([boxes, logits], -1), canvas)
    close(rows.boxes, expected)
    assert torch.equal(rows.classes, logits)


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
