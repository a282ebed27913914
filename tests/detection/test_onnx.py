import json
import math

import numpy as np
import pytest
import torch

from semfov import DataError, load_detector
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_heads import HEADS
from semfov.detection.preprocessing import Preprocessing
from semfov.io.files import sha256
from tests.colours import write_network
from tests.detection.test_onnx_heads import cell_list, corners, distance_boxes
from tests.refusals import refused, unusable

SIDE = 64
NAMES = ("cat", "dog", "cup")
CELLS = {s: (SIDE // s) ** 2 for s in (8, 16, 32, 64)}


def random(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def cells_of(*strides):
    return cell_list((SIDE, SIDE), strides)


def pixels(rows):
    """The first four columns as boxes in pixels, the others as scores."""
    return np.concatenate([rows[..., :2] * SIDE, rows[..., 2:4] * 20, rows[..., 4:]], -1)


# Each function returns the outputs of a model, and a function that decodes the outputs of one image to boxes and
# scores. Background is the first score, computed as by the default policy of the head.


def residual(classes, objectness=None):
    present = max(classes) if objectness is None else objectness
    return [1 - present] + [present * c / sum(classes) for c in classes]


def normalised(classes):
    parts = [1 - max(classes), *classes]
    return [part / sum(parts) for part in parts]


def yolox():
    def read(out):
        return [
            (corners((row[0] + c) * s, (row[1] + r) * s, s * math.exp(row[2]), s * math.exp(row[3])),
             residual(row[5:], row[4]))
            for row, (c, r, s) in zip(out["output"].tolist(), cells_of(8, 16, 32), strict=True)
        ]  # fmt: skip

    rows = random(1, 84, 8)
    rows[..., :4] -= 0.3
    return {"output": rows}, read


def yolov5():
    def read(out):
        return [(corners(*row[:4]), residual(row[5:], row[4])) for row in out["output0"].tolist()]

    return {"output0": pixels(random(1, 252, 8))}, read


def yolov8():
    def read(out):
        return [(corners(*row[:4]), residual(row[4:])) for row in out["output0"].T.tolist()]

    return {"output0": pixels(random(1, 84, 7)).transpose(0, 2, 1)}, read


def nanodet():
    """Maps in pairs, level by level."""
    outputs = {}
    for s in (8, 16, 32):
        outputs[f"cls_pred_stride_{s}"] = random(1, CELLS[s], 3, seed=s)
        outputs[f"dis_pred_stride_{s}"] = random(1, CELLS[s], 32, seed=s + 1)

    def read(out):
        classes = np.concatenate([out[f"cls_pred_stride_{s}"] for s in (8, 16, 32)])
        distances = np.concatenate([out[f"dis_pred_stride_{s}"] for s in (8, 16, 32)])
        return list(
            zip(distance_boxes(distances, cells_of(8, 16, 32), 0.5), map(residual, classes.tolist()), strict=True)
        )

    return outputs, read


def picodet():
    """All class maps, then all distance maps."""
    strides = (8, 16, 32, 64)
    outputs = {f"a{s}": random(1, CELLS[s], 3, seed=s) for s in strides}
    outputs |= {f"b{s}": random(1, CELLS[s], 32, seed=s + 1) for s in strides}

    def read(out):
        classes, distances = (np.concatenate([out[f"{kind}{s}"] for s in strides]) for kind in "ab")
        return list(
            zip(distance_boxes(distances, cells_of(*strides), 0.5), map(residual, classes.tolist()), strict=True)
        )

    return outputs, read


def nanodet_plus():
    def read(out):
        boxes = distance_boxes(out["output"][:, 3:], cells_of(8, 16, 32, 64), 0.0)
        return list(zip(boxes, map(normalised, out["output"][:, :3].tolist()), strict=True))

    return {"output": random(1, 85, 35)}, read


def detr():
    def read(out):
        found = []
        for logits, box in zip(out["logits"].tolist(), out["pred_boxes"].tolist(), strict=True):
            powers = [math.exp(t) for t in logits]
            scores = [p / sum(powers) for p in powers]
            found.append((corners(*(SIDE * x for x in box)), [scores[-1], *scores[:-1]]))
        return found

    return {"logits": 4 * random(1, 9, 4), "pred_boxes": random(1, 9, 4, seed=1)}, read


def rtdetr():
    def read(out):
        return [
            (corners(*(SIDE * x for x in box)), residual([1 / (1 + math.exp(-t)) for t in logits]))
            for logits, box in zip(out["logits"].tolist(), out["pred_boxes"].tolist(), strict=True)
        ]

    return {"logits": 4 * random(1, 9, 3) - 2, "pred_boxes": random(1, 9, 4, seed=1)}, read


def rtdetr_rows():
    def read(out):
        return [(corners(*(SIDE * x for x in row[:4])), residual(row[4:])) for row in out["output0"].tolist()]

    return {"output0": random(1, 9, 7)}, read


def candidates():
    def read(out):
        rows = zip(out["boxes"].tolist(), out["objectness"].tolist(), out["classes"].tolist(), strict=True)
        return [(box, residual(classes, objectness)) for box, objectness, classes in rows]

    corner = random(1, 9, 2) * 30
    boxes = np.concatenate([corner, corner + 10 + random(1, 9, 2)], -1)
    return {"boxes": boxes, "objectness": random(1, 9), "classes": random(1, 9, 3)}, read


MAKERS = {
    "yolox": yolox,
    "yolov5": yolov5,
    "yolov8": yolov8,
    "nanodet": nanodet,
    "picodet": picodet,
    "nanodet-plus": nanodet_plus,
    "detr": detr,
    "rtdetr": rtdetr,
    "rtdetr rows": rtdetr_rows,
    "candidates": candidates,
}


@pytest.mark.parametrize("kind", MAKERS)
def test_score_vectors_of_every_head_equal_a_plain_implementation(make_onnx, kind, dtype):
    outputs, read = MAKERS[kind]()
    path = make_onnx(outputs, producer="PaddlePaddle" if kind == "picodet" else "pytorch")
    detector = load_detector(path, classes=NAMES, threshold=0.0, iou=1.0, limit=1000)
    assert detector.head == kind.split()[0]
    image = torch.rand(2, 3, SIDE, SIDE, dtype=dtype, generator=torch.Generator().manual_seed(0))
    image[1] *= 0.3
    found = detector.detect(image)
    for index in range(2):
        gain = detector.preprocessing(image.double())[index].mean().sigmoid().numpy()
        expected = [(b, s) for b, s in read({name: v[0] * gain for name, v in outputs.items()}) if max(s[1:]) > 0]
        expected = sorted(expected, key=lambda row: -max(row[1][1:]))
        assert int(found.count[index]) == len(expected)
        own = found[index]
        boxes, scores = (np.array(column) for column in zip(*expected, strict=True))
        np.testing.assert_allclose(own.scores[own.mask].double().numpy(), scores, atol=2e-6)
        np.testing.assert_allclose(own.boxes[own.mask].double().numpy(), boxes, rtol=1e-4, atol=1e-4)
    assert found.boxes.dtype == found.scores.dtype == dtype


def test_settings_and_preprocessing_follow_head_file_and_arguments(make_onnx):
    path = make_onnx(yolox()[0])
    detector = load_detector(path, classes=NAMES, threshold=0.1)
    assert detector.name == "model"
    assert detector.digest == sha256(path)
    assert detector.input_size == (SIDE, SIDE)
    settings = json.loads(json.dumps(detector.settings()))
    assert settings["head"] == "yolox"
    assert settings["preprocessing"]["channels"] == "bgr"
    assert load_onnx(path, classes=NAMES, preprocessing={"channels": "rgb"}).settings() != detector.settings()
    path = make_onnx(yolox()[0])
    assert load_onnx(path, classes=NAMES).preprocessing == Preprocessing("bgr", 255.0, corner=True)
    path.with_suffix(".json").write_text(json.dumps({"classes": NAMES, "preprocessing": {"std": [2, 2, 2]}}))
    detector = load_onnx(path, preprocessing={"fill": 0.0})
    assert detector.classes == NAMES
    assert detector.preprocessing == Preprocessing("bgr", 255.0, std=(2.0, 2.0, 2.0), corner=True, fill=0.0)
    assert load_onnx(path, preprocessing=Preprocessing("rgb")).preprocessing == Preprocessing("rgb")


@pytest.mark.parametrize(
    ("settings", "offset"), [({}, (0, 16)), ({"corner": True}, (0, 0)), ({"stretch": True}, (0, 0))]
)
def test_settings_determine_the_placement_of_the_image(make_onnx, settings, offset):
    detector = load_onnx(make_onnx(yolov8()[0]), classes=NAMES, preprocessing={"fill": 1.0, **settings})
    canvas, placement = detector.fit(torch.zeros(1, 3, 20, 40))
    padding = 0 if "stretch" in settings else SIDE * SIDE / 2
    assert canvas.shape == (1, 3, SIDE, SIDE)
    assert placement.offset == offset
    assert float(canvas.sum()) == 3 * padding


def test_a_model_with_dynamic_size_needs_an_input_size(make_onnx):
    path = make_onnx(yolox()[0], dynamic=True, batch="batch")
    refused("input_size", load_onnx, path, classes=NAMES)
    detector = load_onnx(path, classes=NAMES, input_size=SIDE, stride=32)
    assert detector.head == "yolox"
    assert detector.fit(torch.zeros(1, 3, 20, 64))[0].shape == (1, 3, 32, 64)
    refused("stride", load_onnx, path, classes=NAMES, input_size=SIDE, stride=0)
    for side in [SIDE, [SIDE, SIDE]]:
        path = make_onnx(yolox()[0], dynamic=True, batch="batch")
        path.with_suffix(".json").write_text(json.dumps({"classes": NAMES, "input_size": side}))
        assert load_onnx(path).input_size == (SIDE, SIDE)


def test_options_that_contradict_the_model_are_refused(make_onnx):
    path = make_onnx(yolox()[0])
    for options, message in (
        ({"input_size": 32}, "input_size: expected the model's fixed size, 64 x 64"),
        ({"stride": 32, "classes": NAMES}, "stride: expected None"),
        ({"input_size": (64.0, 64.0), "classes": NAMES}, "input_size: expected"),
        ({"classes": ["cat", "dog"]}, "with 2 classes"),
        ({"classes": ["cat", "dog"], "head": "yolox"}, "classes: expected 3 names, one for each score, got 2"),
        ({"classes": ["cat", "cat", "dog"]}, "at least one name, all different"),
        ({"head": "yolo"}, "unknown head"),
        ({}, "classes: expected the names of the 3 classes of model"),
        ({"classes": NAMES, "preprocessing": {"colour": "bgr"}}, "unknown preprocessing setting"),
        ({"weights": path}, "unknown ONNX model"),
    ):
        refused(message, load_onnx, path, **options)
    detector = load_onnx(path, classes=NAMES)
    refused("canvas", detector.propose, torch.zeros(1, 3, 32, 64))


def test_outputs_of_a_wrong_head_are_refused(make_onnx):
    decoded = make_onnx({"output": pixels(random(1, 84, 8))})  # YOLOX with its boxes decoded in the graph
    canvas = torch.ones(1, 3, SIDE, SIDE)
    detector = load_onnx(decoded, classes=NAMES)
    assert (detector.head, detector.preprocessing) == ("yolox-decoded", HEADS["yolox"].preprocessing)
    wanted = load_onnx(decoded, classes=NAMES, head="yolov5", preprocessing=detector.preprocessing)
    assert torch.equal(detector.propose(canvas).boxes, wanted.propose(canvas).boxes)
    with pytest.raises(DataError, match="expected boxes on a canvas of 64 x 64 px with head 'yolox', got"):
        load_onnx(decoded, classes=NAMES, head="yolox")(canvas)
    fractions = make_onnx({"output0": random(1, 84, 7).transpose(0, 2, 1)}, file="other.onnx")
    unusable("got fractions of the canvas instead of pixels; export", load_onnx(fractions, classes=NAMES), canvas)
    for head in ("picodet", "nanodet", "detr", "candidates", "end2end-nms"):
        refused("does not fit the outputs", load_onnx, fractions, classes=NAMES, head=head)


def test_rows_may_be_boxes_or_channels(make_onnx):
    outputs = yolov8()[0]
    canvas = torch.ones(1, 3, SIDE, SIDE)
    usual = load_onnx(make_onnx(outputs), classes=NAMES).propose(canvas)
    other = make_onnx({"output0": outputs["output0"].transpose(0, 2, 1)}, file="other.onnx")
    turned = load_onnx(other, classes=NAMES).propose(canvas)
    assert torch.equal(usual.boxes, turned.boxes)
    assert torch.equal(usual.classes, turned.classes)


def test_rows_of_an_end_to_end_model_are_read_with_a_note(make_onnx):
    """`make_onnx` halves all numbers of a black picture, which for classes gives whole numbers of even ones."""
    rows = np.array([[[8, 16, 80, 60, 1.8, 2], [2, 2, 18, 18, 0.4, 0], [0, 0, 0, 0, 0, 0]]], np.float32)
    path = make_onnx({"output0": rows}, metadata={"names": "{0: 'cat', 1: 'dog'}", "end2end": "True"})
    with pytest.warns(UserWarning, match=r"model\.onnx selects boxes itself .* end2end=False"):
        detector = load_onnx(path)
    assert detector.head == "end2end"
    found = detector.detect(torch.zeros(1, 3, SIDE, SIDE))
    assert found.boxes[0].tolist() == [[4, 8, 40, 30], [1, 1, 9, 9]]
    torch.testing.assert_close(found.scores[0], torch.tensor([[0.1, 0.0, 0.9], [0.8, 0.2, 0.0]]))


@pytest.mark.parametrize("logits", [None, True])
def test_scores_after_their_sigmoid_are_refused_where_logits_are_expected(make_onnx, logits):
    outputs = {"logits": random(1, 9, 4), "pred_boxes": random(1, 9, 4, seed=1)} if logits is None else yolov8()[0]
    detector = load_onnx(make_onnx(outputs), classes=NAMES, logits=logits)
    unusable("expected scores before the", detector, torch.ones(1, 3, SIDE, SIDE))


def test_scores_without_sigmoid_need_the_option_logits(make_onnx):
    outputs = {"output0": pixels(random(1, 252, 8))}
    outputs["output0"][..., 4:] = 8 * outputs["output0"][..., 4:] - 4
    path = make_onnx(outputs)
    unusable("logits=True", load_onnx(path, classes=NAMES), torch.ones(1, 3, SIDE, SIDE))
    found = load_onnx(path, classes=NAMES, logits=True).propose(torch.ones(1, 3, SIDE, SIDE))
    raw = torch.tensor(outputs["output0"][0]) * torch.ones(()).sigmoid()
    torch.testing.assert_close(found.classes[0], raw[:, 5:].sigmoid())
    torch.testing.assert_close(found.objectness[0], raw[:, 4].sigmoid())


def test_classes_are_those_of_coco_by_default_and_unused_ids_are_dropped(make_onnx):
    outputs, _ = yolox()
    path = make_onnx(outputs)
    whole = load_onnx(path, classes=NAMES)
    part = load_onnx(path, classes=["cat", "N/A", "cup"])
    assert part.classes == ("cat", "cup")
    canvas = torch.ones(1, 3, SIDE, SIDE)
    assert torch.equal(part.propose(canvas).classes, whole.propose(canvas).classes[..., [0, 2]])
    assert load_onnx(make_onnx({"output": random(1, 84, 85) - 0.5})).classes == COCO_CLASSES
    outputs = {"logits": 9 * random(1, 9, 92), "pred_boxes": random(1, 9, 4)}
    detector = load_onnx(make_onnx(outputs))
    assert detector.classes == COCO_CLASSES  # from 91 ids, without the unused ones
    assert detector.propose(torch.ones(1, 3, SIDE, SIDE)).classes.shape[-1] == 80


def test_published_models_are_loaded_by_name(make_onnx):
    path = make_onnx({"output": random(1, 84, 85)})
    detector = load_detector("yolox-nano", weights=path)
    assert detector.name == "yolox-nano"
    assert detector.digest == sha256(path)
    refused("did you mean 'yolox-tiny'", load_onnx, "yolox-tinny")


@pytest.mark.shared
@pytest.mark.parametrize("name", ["yolox_nano_416", "picodet_s_416_coco", "nanodet_plus_m_1.5x_416"])
def test_real_models_against_opencv_and_numpy(shared, name):
    import cv2
    import onnxruntime as ort

    path = shared / "weights" / f"{name}.onnx"
    photo = sorted((shared / "coco" / "eval300").glob("*.jpg"))[0]
    bgr = cv2.imread(str(photo))
    height, width = bgr.shape[:2]
    options = ort.SessionOptions()
    options.log_severity_level = 3
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    if name.startswith("yolox"):
        ratio = 416 / max(height, width)
        inner = cv2.resize(bgr.astype(np.float32), (round(width * ratio), round(height * ratio)))
        canvas = np.full((416, 416, 3), 114, np.float32)
        canvas[: inner.shape[0], : inner.shape[1]] = inner
        out = session.run(None, {"images": canvas.transpose(2, 0, 1)[None]})[0][0]
        grid = cell_list((416, 416), (8, 16, 32))
        boxes = np.array([corners((o[0] + c) * s, (o[1] + r) * s, np.exp(o[2]) * s, np.exp(o[3]) * s)
                          for o, (c, r, s) in zip(out, grid, strict=True)])  # fmt: skip
        boxes /= [inner.shape[1] / width, inner.shape[0] / height] * 2
        classes, objectness = out[:, 5:], out[:, 4]
    else:
        small, objectness = cv2.resize(bgr.astype(np.float32), (416, 416)), None
        if name.startswith("picodet"):
            canvas = (small[..., ::-1] / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
            out = session.run(None, {"image": canvas.transpose(2, 0, 1)[None].astype(np.float32)})
            classes, distances, offset = np.concatenate(out[:4], 1)[0], np.concatenate(out[4:], 1)[0], 0.5
        else:
            canvas = (small - [103.53, 116.28, 123.675]) / [57.375, 57.12, 58.395]
            out = session.run(None, {"data": canvas.transpose(2, 0, 1)[None].astype(np.float32)})[0][0]
            classes, distances, offset = out[:, :80], out[:, 80:], 0.0
        boxes = np.array(distance_boxes(distances, cell_list((416, 416), (8, 16, 32, 64)), offset))
        boxes /= [416 / width, 416 / height] * 2
    detector = load_detector(path)
    fitted, placement = detector.fit(torch.tensor(bgr[..., ::-1].copy()).permute(2, 0, 1)[None] / 255)
    found = detector.propose(fitted)
    confident = found.confidence[0] > 0.3
    assert int(confident.sum()) > 5
    np.testing.assert_allclose(found.classes[0].numpy(), classes, atol=2e-3)
    if objectness is not None:
        np.testing.assert_allclose(found.objectness[0].numpy(), objectness, atol=2e-3)
    limits = np.array([width, height] * 2)
    ours = placement.boxes_to_image(found.boxes[0][confident]).numpy()
    np.testing.assert_allclose(ours, np.clip(boxes[confident.numpy()], 0, limits), atol=0.5)


def test_a_digest_is_of_all_files_of_a_model(tmp_path):
    """Weights in another file count, wherever both files lie."""
    import onnx

    digests = []
    for folder, factor in (("a", 1), ("b", 1), ("c", 2)):
        path = write_network(tmp_path / "whole.onnx")
        assert load_detector(path).settings()["digest"] == sha256(path)
        model, split = onnx.load(path), tmp_path / folder / "split.onnx"
        weight = next(each for each in model.graph.initializer if each.name == "weight")
        weight.raw_data = (np.frombuffer(weight.raw_data, np.float32) * factor).tobytes()
        split.parent.mkdir()
        external = {"save_as_external_data": True, "location": "split.bin", "size_threshold": 64}
        onnx.save(model, str(split), **external)
        digests.append((load_detector(split).settings()["digest"], sha256(split)))
    assert digests[0] == digests[1]
    assert (digests[0][0] == digests[2][0], digests[0][1] == digests[2][1]) == (False, True)


def test_scores_that_rounding_puts_beyond_one_are_clamped_with_a_warning(make_onnx):
    """Those of networks of 8 bits reach 1.004; logits go much farther and are refused."""
    gain = 1 / (1 + np.exp(-1.0))  # of `make_onnx`, for a white picture
    outputs = {"output0": pixels(random(1, 252, 8))}
    outputs["output0"][..., 4:] = outputs["output0"][..., 4:].clip(0, 0.5)
    outputs["output0"][0, 3, 4:6] = [1.004 / gain, -0.003 / gain]
    detector = load_onnx(make_onnx(outputs), classes=NAMES)
    with pytest.warns(UserWarning, match=r"scores from -0\.003\d* to 1\.004\d*, which rounding explains"):
        found = detector.propose(torch.ones(1, 3, SIDE, SIDE))
    assert float(found.objectness[0, 3]) == 1
    assert float(found.classes[0, 3, 0]) == 0
    detector.propose(torch.ones(1, 3, SIDE, SIDE))  # warned of once


def test_what_wraps_a_model_is_named(make_small):
    class Trained(torch.nn.Module):
        def __init__(self, model):
            super().__init__()
            self.model = model

    small = make_small()
    for wrapper, inner in [
        (torch.nn.DataParallel(small), "module"),
        (torch.compile(small, backend="eager"), "_orig_mod"),
        (Trained(small), "model"),
    ]:
        refused(rf"detector: expected .*give the YoloV3 in it, which is its \.{inner};", load_detector, wrapper)


def test_a_printed_detector_has_its_name_its_input_and_its_head():
    assert repr(load_detector("yolox-nano")) == (
        "OnnxDetector('yolox-nano', 80 classes, input 416 × 416 px, head yolox)"
    )
