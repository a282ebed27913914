import pytest

from semfov.detection.onnx_heads import HEADS, Signature, recognise
from semfov.errors import InputError

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
