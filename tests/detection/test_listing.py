"""What a detector shows is listed with the score that it shows, with every head and by every kind of look."""

import math
import re
from collections.abc import Callable

import numpy as np
import pytest
import torch
from PIL import Image
from torchvision.ops import nms

from semfov import ActivePerception, load_detector
from semfov.agents.windows import ZoomAgent
from semfov.cli.trial import try_detector
from semfov.detection import Detections, Detector
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_heads import HEADS
from semfov.paths import Record
from semfov.paths.look import detections_in_words
from semfov.settings import FindSettings
from semfov.zoom import WindowEye
from semfov.zoom.looks import Window
from tests.detection.test_conformance import ADAPTERS, photographs
from tests.detection.test_load import Cells
from tests.detection.test_transformers import MODELS as TRANSFORMERS
from tests.small import write_network

SIDE = 64
NAMES = tuple(f"class {number}" for number in range(80))
SHOWN = {3: 0.9, 7: 0.6, 11: 0.35, 40: 0.28}  # best class and score of each box; the last one is shown below .3
CELLS = {0: (1, 1), 1: (5, 1), 2: (1, 5), 3: (5, 5)}  # column and row at stride 8 of the middles of the boxes
REACH = 8.0  # from the middle of a box to its sides
OTHERS = 0.02  # score of every other class: shared out, 79 of them halve a good score and more


def class_scores(others: float = OTHERS) -> np.ndarray:
    """Scores `(4, 80)` of the boxes."""
    scores = np.full((4, 80), others)
    scores[range(4), [*SHOWN]] = [*SHOWN.values()]
    return scores


def middles(offset: float = 0.5) -> np.ndarray:
    """Middles `(4, 2)` of the boxes in pixels of the canvas."""
    return (np.array([*CELLS.values()]) + offset) * 8


def in_cells(rows: np.ndarray, count: int, empty: float = 0.0) -> np.ndarray:
    """Rows `(4, C)` at the cells of the boxes, among `count` cells of which the first 64 are at stride 8."""
    placed = np.full((count, rows.shape[1]), empty)
    for (column, row), values in zip(CELLS.values(), rows, strict=True):
        placed[8 * row + column] = values
    return placed


def logit(scores: np.ndarray) -> np.ndarray:
    return np.log(scores / (1 - scores))


def centres(unit: float = 1.0) -> np.ndarray:
    """Boxes `(4, 4)` as middles and sizes."""
    return np.concatenate([middles(), np.full((4, 2), 2 * REACH)], 1) / unit


def corners() -> np.ndarray:
    return np.concatenate([middles() - REACH, middles() + REACH], 1)


def with_objectness(boxes: np.ndarray) -> np.ndarray:
    """Rows `(4, 85)` whose objectness times the class is the score."""
    return np.concatenate([boxes, np.full((4, 1), 0.95), class_scores() / 0.95], 1)


def distances(bins: int) -> np.ndarray:
    """Distributions `(4, 4 · bins)` of the distances, all in the bin of one stride."""
    one = np.zeros((4, 4, bins))
    one[..., 1] = 60
    return one.reshape(4, -1)


def level_maps() -> dict[str, np.ndarray]:
    """A class and a distance map at strides 8 to 64."""
    found = {}
    for stride, count in ((8, 64), (16, 16), (32, 4), (64, 1)):
        classes, sides = np.zeros((count, 80)), np.zeros((count, 32))
        if stride == 8:
            classes, sides = in_cells(class_scores(), count), in_cells(distances(8), count)
        found |= {f"cls_pred_stride_{stride}": classes, f"dis_pred_stride_{stride}": sides}
    return found


def yolox() -> np.ndarray:
    offsets = np.concatenate([np.full((4, 2), 0.5), np.full((4, 2), math.log(2 * REACH / 8))], 1)
    rows = in_cells(with_objectness(offsets), 84)
    rows[-1, :2] = -1  # a cell without a box, whose numbers are no fractions of a canvas
    return rows


def softmax() -> dict[str, np.ndarray]:
    scores = class_scores(0.001)
    rest = 1 - scores.sum(1, keepdims=True)
    return {"logits": np.log(np.concatenate([scores, rest], 1)), "pred_boxes": centres(SIDE)}


def end2end() -> np.ndarray:
    best = np.array([[score, label] for label, score in SHOWN.items()])
    return np.concatenate([np.concatenate([corners(), best], 1), np.zeros((16, 6))])


def counted() -> dict[str, np.ndarray]:
    """Four boxes, and a fifth that is padding."""
    boxes = np.concatenate([corners(), [[8, 8, 48, 48]]])
    scores, labels = np.array([*SHOWN.values(), 0.99]), np.array([*SHOWN, 5])
    return {"num_dets": np.array([4]), "det_boxes": boxes, "det_scores": scores, "det_classes": labels}


OUTPUTS: dict[str, Callable[[], dict[str, np.ndarray]]] = {
    "candidates": lambda: {"boxes": corners(), "scores": class_scores()},
    "yolox": lambda: {"output": yolox()},
    "yolox-decoded": lambda: {"output": in_cells(with_objectness(centres()), 84)},
    "yolov5": lambda: {"output": in_cells(with_objectness(centres()), 84)},
    "yolov8": lambda: {"output0": in_cells(np.concatenate([centres(), class_scores()], 1), 84).T},
    "end2end": lambda: {"output0": end2end()},
    "picodet": level_maps,
    "nanodet": level_maps,
    "nanodet-plus": lambda: {"output": in_cells(np.concatenate([class_scores(), distances(8)], 1), 85)},
    "end2end-detr": lambda: {"labels": np.array([*SHOWN]), "boxes": corners(), "scores": np.array([*SHOWN.values()])},
    "end2end-nms": counted,
    "rfdetr": lambda: {"dets": centres(SIDE), "labels": logit(class_scores())},
    "detr": softmax,
    "rtdetr": lambda: {"logits": logit(class_scores()), "pred_boxes": centres(SIDE)},
}
"""Outputs of a network of each head that shows the same boxes in every picture."""


@pytest.fixture(params=sorted(HEADS))
def constant(request: pytest.FixtureRequest, tmp_path) -> Detector:
    """A detector of each head that shows the boxes in every picture, at the same places of its canvas."""
    from onnx import helper

    outputs = {
        name: values[None].astype(np.int64 if values.dtype == np.int64 else np.float32)
        for name, values in OUTPUTS[request.param]().items()
    }
    kinds = {name: helper.np_dtype_to_tensor_dtype(values.dtype) for name, values in outputs.items()}
    steps = [
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=[0, 1, 2, 3], keepdims=0),
        helper.make_node("Sub", ["mean", "mean"], ["nothing"]),
    ]
    for name, kind in kinds.items():
        steps.append(helper.make_node("Cast", ["nothing"], [f"{name}_nothing"], to=kind))
        steps.append(helper.make_node("Add", [f"{name}_values", f"{name}_nothing"], [name]))
    path = write_network(
        tmp_path / "constant.onnx",
        steps,
        {"images": [1, 3, SIDE, SIDE]},
        {name: (kinds[name], list(values.shape)) for name, values in outputs.items()},
        {f"{name}_values": values for name, values in outputs.items()},
    )
    return load_onnx(path, head=request.param, classes=NAMES)


EXPECTED = [(f"class {label}", pytest.approx(score, abs=0.01)) for label, score in SHOWN.items() if score >= 0.3]


def listed(record: Record, least: float = 0.3) -> list[tuple[str, float]]:
    """Class and score of the objects that a record lists."""
    return [(row["class"], row["score"]) for row in record.object_rows() if row["score"] >= least]


def picture(width: int = SIDE, height: int = SIDE) -> torch.Tensor:
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(0))


LOOKS = {
    "windows": lambda agent: agent.find_all(picture(), how="windows", passes=1),
    "a class": lambda agent: agent.find_all(picture(), ["class 3", "class 7", "class 11"], how="windows", passes=1),
    "fovea": lambda agent: agent.explore(picture(), how="fovea", shifts=0),
    "stream": lambda agent: agent.live(how="windows").step(picture()),
}


@pytest.mark.parametrize("how", LOOKS)
@pytest.mark.filterwarnings("ignore:.* selects boxes itself")
def test_a_head_is_listed_with_its_own_scores(constant, how):
    record = LOOKS[how](ActivePerception.raw(constant))
    assert listed(record) == EXPECTED
    seen = record.detections[0]
    assert sorted(seen.confidence[0].tolist(), reverse=True)[:3] == pytest.approx([0.9, 0.6, 0.35], abs=0.01)


@pytest.mark.filterwarnings("ignore:.* selects boxes itself")
def test_a_trial_has_the_scores_of_the_head_in_both_columns(constant, tmp_path, capsys):
    path = tmp_path / "picture.png"
    Image.new("RGB", (SIDE, SIDE), "grey").save(path)
    try_detector(ActivePerception.raw(constant), path)
    printed = capsys.readouterr().out
    shown = [score for score in SHOWN.values() if score >= 0.3]
    assert f"the bare detector shows {len(shown)} from 0.3 on, and semfov lists {len(shown)} of them" in printed
    rows = re.findall(r"^(class \d+) +(\S+) +(\S+) +", printed, re.M)
    assert rows == [(name, f"{score.expected:.2f}", f"{score.expected:.2f}") for name, score in EXPECTED]


@pytest.mark.filterwarnings("ignore:.* selects boxes itself")
def test_words_drawings_and_other_libraries_have_the_same_scores(constant, tmp_path):
    record = ActivePerception.raw(constant).find_all(picture(), "class 3", how="windows", passes=1)
    assert "class 3 0.90 in" in detections_in_words(record.detections[0], record.classes, target=4)
    assert detections_in_words(record.detections[0], record.classes).startswith("class 3 0.90, class 7 0.60")
    assert record.rows()[0]["score"] == pytest.approx(0.9, abs=0.01)
    found = record.page_data()["looks"][0]["detections"]
    assert [each["score"] for each in found[:2]] == pytest.approx([0.9, 0.6], abs=0.01)
    seen = record.detections[0]
    assert seen.to_torchvision()["scores"][:3].tolist() == pytest.approx([0.9, 0.6, 0.35], abs=0.01)
    there = seen.to_supervision(constant.classes)
    assert there.confidence[:3].tolist() == pytest.approx([0.9, 0.6, 0.35], abs=0.01)
    torch.testing.assert_close(Detections.from_supervision(there, 80).confidence, seen.confidence)
    record.save(tmp_path / "record.safetensors")
    loaded = type(record).load(tmp_path / "record.safetensors")
    assert torch.equal(loaded.detections[0].confidence, seen.confidence)


@pytest.mark.filterwarnings("ignore:.* selects boxes itself")
@pytest.mark.parametrize("how", ["windows", "fovea"])
def test_a_search_without_a_fit_finds_by_the_own_score(constant, how):
    agent, options = ActivePerception.raw(constant), {"how": how, **({"passes": 1} if how == "windows" else {})}
    assert agent.search(picture(), "class 7", **options).decision.outcome == "found"
    assert agent.search(picture(), "class 11", **options).decision.outcome == "undecided"
    assert agent.search(picture(), "class 11", confirm=0.3, **options).decision.outcome == "found"


@pytest.fixture(params=[*ADAPTERS, *TRANSFORMERS, "ultralytics"])
def random(request, tmp_path, make_small, make_onnx, monkeypatch) -> Detector:
    """A detector of each kind with random weights."""
    if request.param in ADAPTERS:
        return ADAPTERS[request.param].build(tmp_path, make_small, make_onnx)
    torch.manual_seed(0)
    if request.param == "ultralytics":
        monkeypatch.setattr(Cells, "__module__", "ultralytics.nn.tasks")
        return load_detector(Cells(), input_size=64)
    return load_detector(TRANSFORMERS[request.param]().eval(), processor={"size": {"height": 96, "width": 128}})


def test_every_detector_is_listed_with_its_own_scores(random):
    """Against torchvision's suppression of what the head proposes."""
    agent = ZoomAgent(WindowEye(random))
    image = photographs(1, *random.input_size[::-1])[0]
    record = agent.find_all(image, settings=FindSettings(passes=1, score_threshold=0.3))
    view = agent.eye.open(image)
    canvas, _ = agent.eye.glimpse(view, torch.tensor([Window.overview(view.lattice).fixation]))
    proposed = random.propose(canvas)
    own = proposed.classes[0].amax(-1) * (1 if proposed.objectness is None else proposed.objectness[0])
    boxes = proposed.boxes[0]
    some = ((boxes[:, 2:] > boxes[:, :2]).all(-1) & (own >= 0.3)).nonzero()[:, 0]
    expected = own[some[nms(boxes[some], own[some], 0.5)]]
    assert record.objects.scores.tolist() == pytest.approx(expected[: random.selection.limit].tolist(), abs=0.01)
