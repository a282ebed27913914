import pytest
import torch
from torch import nn
from torchvision import models
from torchvision.models.detection import FCOS, FasterRCNN, RetinaNet
from torchvision.models.detection.anchor_utils import AnchorGenerator, DefaultBoxGenerator
from torchvision.models.detection.ssd import SSD
from torchvision.ops import MultiScaleRoIAlign, batched_nms, remove_small_boxes

from semfov import DataError, Selection, load_detector
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.torchvision import TorchvisionDetector, _output_count
from semfov.io.files import sha256
from tests.refusals import refused, unusable

NAMES = ("cat", "dog", "cup")
LITE = "ssdlite320_mobilenet_v3_large"
SMALL = {"min_size": 64, "max_size": 96}


class Backbone(nn.Module):
    """Two levels, at strides 8 and 16."""

    def __init__(self, out_channels: int | list[int]) -> None:
        super().__init__()
        self.out_channels = out_channels
        self.first, self.second = nn.Conv2d(3, 32, 8, 8), nn.Conv2d(32, 32, 3, 2, 1)

    def forward(self, image):
        first = self.first(image)
        return {"0": first, "1": self.second(first.relu())}


def anchors(*sizes):
    return AnchorGenerator(sizes, ((0.5, 1.0, 2.0),) * len(sizes))


MODELS = {
    "Faster R-CNN": lambda: FasterRCNN(
        Backbone(32),
        4,
        rpn_anchor_generator=anchors((16,), (32,)),
        box_roi_pool=MultiScaleRoIAlign(["0", "1"], 7, 2),
        rpn_post_nms_top_n_test=60,
        box_score_thresh=0.2,
        **SMALL,
    ),
    "RetinaNet": lambda: RetinaNet(
        Backbone(32), 4, anchor_generator=anchors((16,), (32,)), score_thresh=0.1, topk_candidates=30, **SMALL
    ),
    "FCOS": lambda: FCOS(
        Backbone(32),
        4,
        anchor_generator=AnchorGenerator(((8,), (16,)), ((1.0,),) * 2),
        score_thresh=0.1,
        topk_candidates=20,
        **SMALL,
    ),
    "SSD": lambda: SSD(
        Backbone([32, 32]), DefaultBoxGenerator([[2], [2, 3]]), (72, 56), 4, score_thresh=0.25, topk_candidates=50
    ),
}
NAMED = {
    "fasterrcnn_mobilenet_v3_large_320_fpn": SMALL | {"box_score_thresh": 0.2},
    "retinanet_resnet50_fpn_v2": SMALL | {"score_thresh": 0.1},
    LITE: {"score_thresh": 0.25},
}


def randomise_heads(model: nn.Module) -> nn.Module:
    """Randomise the heads of an untrained network, so that its scores differ between boxes."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "classification_head.cls_logits.bias" in name:
                # As after training with labels from 1: the sigmoid of output 0 stays near 0.
                parameter.copy_(torch.tensor([-50.0, 0, 0, 0]).repeat(len(parameter) // 4))
            elif "cls_logits" in name or "cls_score" in name or "bbox" in name:
                parameter.normal_(0, 0.1, generator=generator)
    return model.double()


def normalise(model: nn.Module) -> None:
    """Set the statistics of batch norm from noise; otherwise the features of an untrained network vanish."""
    for layer in model.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.train().reset_running_stats()
            layer.momentum = None
    model.head(list(model.backbone(noise(2, 3, 320, 320)).values()))
    model.eval()


@pytest.fixture(scope="module", params=MODELS)
def small(request: pytest.FixtureRequest) -> TorchvisionDetector:
    torch.manual_seed(0)
    return TorchvisionDetector(randomise_heads(MODELS[request.param]()), classes=NAMES)


def noise(*shape, seed=0):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def filtered(raw, model, rows_of_levels):
    """The filtering of the models, reimplemented for full score vectors: boxes, scores and labels of each image."""
    settings = model.roi_heads if isinstance(model, FasterRCNN) else model
    first = int(isinstance(model, FasterRCNN | SSD))
    for boxes, scores in raw:
        allowed = scores > settings.score_thresh
        allowed[:, :first] = False
        if isinstance(model, SSD):  # the best boxes of each class
            for label in range(scores.shape[1]):
                allowed[scores[:, label].argsort(descending=True)[model.topk_candidates :], label] = False
        elif not isinstance(model, FasterRCNN):  # the best pairs of box and class of each level
            for level in torch.arange(len(scores)).split(rows_of_levels):
                order = scores[level].flatten().argsort(descending=True)[model.topk_candidates :]
                allowed[level[order // scores.shape[1]], order % scores.shape[1]] = False
        rows, labels = allowed.nonzero(as_tuple=True)
        box = boxes[rows] if boxes.ndim == 2 else boxes[rows, labels]
        if isinstance(model, FasterRCNN):
            large = remove_small_boxes(box, 1e-2)
            rows, labels, box = rows[large], labels[large], box[large]
        score = scores[rows, labels]
        keep = batched_nms(box, score, labels, settings.nms_thresh)[: settings.detections_per_img]
        yield box[keep], score[keep], labels[keep]


def assert_equals_torchvision(detector, images):
    model, pixels = detector.model, []
    hook = model.backbone.register_forward_hook(
        lambda *call: pixels.append([level.shape[-2] * level.shape[-1] for level in call[2].values()])
    )
    with torch.no_grad():
        stock = model(list(images))
        canvas, placement = detector.fit(images)
        raw = detector.outputs(canvas)
    hook.remove()
    assert pixels[0] == pixels[1]  # the same padded input
    levels = []
    if isinstance(model, RetinaNet | FCOS):
        each = model.anchor_generator.num_anchors_per_location()[0]
        levels = [min(model.topk_candidates, each * count) for count in pixels[0]]
    assert sum(len(found["boxes"]) for found in stock) > 10
    for theirs, (boxes, scores, labels) in zip(stock, filtered(raw, model, levels), strict=True):
        torch.testing.assert_close(scores, theirs["scores"])
        assert torch.equal(labels, theirs["labels"])
        torch.testing.assert_close(placement.boxes_to_image(boxes), theirs["boxes"], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("size", [(70, 50), (48, 120), (200, 200)])
def test_boxes_equal_those_of_the_torchvision_model(small, size):
    assert_equals_torchvision(small, noise(2, 3, *size))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED)
def test_boxes_equal_those_of_the_published_architectures(name):
    torch.manual_seed(0)
    detector = TorchvisionDetector.load(name, weights=None, classes=NAMES, **NAMED[name])
    randomise_heads(detector.model)
    if name == LITE:
        normalise(detector.model)
    assert_equals_torchvision(detector, noise(1, 3, 70, 90))


def test_candidates_have_all_class_scores_before_any_threshold(small):
    canvas, _ = small.fit(noise(2, 3, 60, 80))
    found, raw = small.propose(canvas), small.outputs(canvas)
    for index, (boxes, scores) in enumerate(raw):
        count = len(scores)
        assert torch.equal(found.classes[index, :count], scores[:, 1:])
        assert not found.classes[index, count:].any()
        best = scores[:, 1:].argmax(-1) + 1
        own = boxes if boxes.ndim == 2 else torch.stack([box[k] for box, k in zip(boxes, best, strict=True)])
        assert torch.equal(found.boxes[index, :count], own)
        if small.background == "own":
            torch.testing.assert_close(scores.sum(-1), torch.ones(count, dtype=torch.float64))
            assert torch.equal(found.background[index, :count], scores[:, 0])
        else:
            assert found.background is None


def test_the_canvas_equals_the_output_of_the_transform(small):
    transform = small.model.transform
    for size in ((37, 91), (300, 20), (64, 64), (100, 101)):
        image = noise(1, 3, *size)
        expected, _ = transform([image[0]])
        canvas, placement = small.fit(image)
        rows, columns = expected.image_sizes[0]
        assert canvas.shape[-2:] == (rows, columns)
        torch.testing.assert_close(transform.normalize(canvas)[0], expected.tensors[0, :, :rows, :columns])
        corner = torch.tensor([0.0, 0.0, columns, rows], dtype=torch.float64)
        torch.testing.assert_close(placement.boxes_to_image(corner)[2:].tolist(), [float(n) for n in size[::-1]])


@pytest.fixture(scope="module")
def lite() -> TorchvisionDetector:
    torch.manual_seed(0)
    return TorchvisionDetector.load(LITE, weights=None, classes=NAMES)


def test_coco_classes_of_published_weights(monkeypatch):
    monkeypatch.setattr("semfov.detection.torchvision._download", lambda enum: "digest")
    enum = models.get_model_weights(LITE)
    network = models.get_model(LITE, weights=None, weights_backbone=None)
    monkeypatch.setattr(type(enum.DEFAULT), "get_state_dict", lambda *_, **__: network.state_dict())
    detector = load_detector(f"torchvision:{LITE}")
    assert detector.name == f"torchvision:{LITE}"
    assert detector.classes == COCO_CLASSES
    assert detector.digest == "digest"
    canvas = torch.rand(1, 3, 320, 320)
    _, scores = detector.outputs(canvas)[0]
    places = [i for i, name in enumerate(enum.COCO_V1.meta["categories"]) if name in COCO_CLASSES]
    assert scores.shape[-1] == 91
    assert torch.equal(detector.propose(canvas).classes[0], scores[:, places])


def test_weights_can_be_named_in_several_ways(monkeypatch):
    chosen = []

    def stop(enum):
        chosen.append(enum)
        raise DataError("stop")

    monkeypatch.setattr("semfov.detection.torchvision._download", stop)
    enum = models.get_model_weights(LITE)
    for weights in ("DEFAULT", "COCO_V1", f"{enum.__name__}.COCO_V1", enum.COCO_V1):
        unusable("stop", TorchvisionDetector.load, LITE, weights=weights)
    assert chosen == [enum.COCO_V1] * 4


class Unsafe:
    def __reduce__(self):
        return print, ("unpickled",)


def test_published_weights_are_verified_and_hold_only_tensors(monkeypatch, tmp_path):
    hub = tmp_path / "hub" / "checkpoints"
    hub.mkdir(parents=True)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    path = hub / models.get_model_weights(LITE).DEFAULT.url.split("/")[-1]
    torch.save({"a": torch.zeros(1)}, path)
    unusable("damaged", TorchvisionDetector.load, LITE)
    torch.save({"a": Unsafe()}, path)
    unusable("expected only tensors", TorchvisionDetector.load, LITE)


@pytest.mark.parametrize("kind", ["plain.pth", "nested.pth", "plain.safetensors"])
def test_weights_can_be_loaded_from_a_state_dict_file(lite, tmp_path, kind):
    path, state = tmp_path / kind, lite.model.state_dict()
    if kind.endswith(".pth"):
        torch.save({"model": state, "epoch": 3} if kind == "nested.pth" else state, path)
    else:
        from safetensors.torch import save_file

        save_file(state, path)
    detector = TorchvisionDetector.load(LITE, weights=path, classes=NAMES)
    assert detector.digest == sha256(path)
    loaded = detector.model.state_dict()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in state.items())


def test_missing_and_unsuitable_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(models, "get_model", lambda *_, **__: MODELS["SSD"]())
    unusable("no such file", TorchvisionDetector.load, LITE, weights=tmp_path / "missing.pth", classes=NAMES)
    for content in ({"a": torch.zeros(1)}, {"a": Unsafe()}, [1, 2]):
        torch.save(content, tmp_path / "other.pth")
        unusable(r"other\.pth", TorchvisionDetector.load, LITE, weights=tmp_path / "other.pth", classes=NAMES)


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_in_memory_is_a_detector(kind):
    model = randomise_heads(MODELS[kind]())
    detector = load_detector(model, classes=NAMES, limit=7)
    image = torch.rand(1, 3, 60, 80)
    other = TorchvisionDetector(model, classes=NAMES)
    other.selection = Selection(limit=7)
    assert torch.equal(detector(image).scores, other(image).scores)
    assert _output_count(model) == 4
    assert len(detector.digest) == 64
    refused("classes: expected the names of the model's outputs after the first", load_detector, model)


def test_models_may_have_other_outputs_and_sizes_and_propose_nothing():
    model = RetinaNet(Backbone(32), 91, anchor_generator=anchors((16,), (32,)), **SMALL)
    assert load_detector(model).classes == COCO_CLASSES
    model = RetinaNet(Backbone(32), 3, anchor_generator=anchors((16,), (32,)), **SMALL)
    detector = TorchvisionDetector(model, classes=NAMES, first=0)
    canvas = torch.rand(1, 3, 64, 64)
    assert torch.equal(detector.propose(canvas).classes[0], detector.outputs(canvas)[0][1])
    detector = TorchvisionDetector(MODELS["FCOS"](), classes=NAMES)
    assert detector.settings()["min_size"] == [64]
    assert detector.input_size == (96, 96)
    assert TorchvisionDetector(MODELS["SSD"](), classes=NAMES).input_size == (72, 56)
    model = MODELS["Faster R-CNN"]()
    model.rpn.score_thresh = 1.1
    found = TorchvisionDetector(model, classes=NAMES)(torch.rand(2, 3, 64, 64))
    assert found.boxes.shape == (2, 0, 4)
    assert found.scores.shape == (2, 0, 4)


def test_invalid_options_are_refused():
    for name, options, message in (
        ("retinanet_resnet50", {}, "did you mean"),
        (LITE, {"weights": "COCO_V2"}, "did you mean 'COCO_V1'"),
        (LITE, {"weights": None}, "classes: expected the names"),
        (LITE, {"weights": "DEFAULT", "classes": NAMES}, "classes: expected None"),
        ("fcos_resnet50_fpn", {"weights": None, "classes": NAMES, "colour": 1}, "colour"),
        (LITE, {"weights": None, "classes": NAMES, "first": 0}, "first"),
    ):
        refused(message, TorchvisionDetector.load, name, **options)
    refused("expected Faster R-CNN", TorchvisionDetector, nn.Linear(1, 1), classes=NAMES)
    detector = TorchvisionDetector(MODELS["FCOS"](), classes=NAMES[:2])
    refused("classes: expected 3 names", detector.propose, torch.rand(1, 3, 64, 64))
