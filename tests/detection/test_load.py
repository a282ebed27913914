import pytest
import torch
from torch import nn
from torchvision.ops import box_iou

from semfov import ActivePerception, DataError, InputError
from semfov.data.examples import example_scene
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.load import _detector_name, check_detector, load_detector
from semfov.detection.yolo import _RUNTIMES
from tests.refusals import refused, unusable


def test_cfg_weights_and_options(small_cfg, small_weights, tmp_path):
    names = tmp_path / "pets.names"
    names.write_text("cat\n\ndog\n")
    options = {"weights": small_weights, "classes": names, "stride": None}
    detector = load_detector(small_cfg, **options, input_size=96, background="none", iou=0.4, limit=3, per_class=True)
    assert (detector.name, detector.classes, len(detector.digest)) == ("small", ("cat", "dog"), 64)
    assert (detector.input_size, detector.background) == ((96, 96), "none")
    assert detector.settings()["selection"] == {"threshold": 0.02, "iou": 0.4, "limit": 3, "per_class": True}
    assert not detector.training
    assert not any(parameter.requires_grad for parameter in detector.parameters())
    assert load_detector(str(small_cfg), **options).input_size == (64, 32)
    image = torch.rand(1, 3, 64, 96)
    exact = load_detector(small_cfg, **options, dtype=torch.float64).propose(image)
    assert exact.boxes.dtype == torch.float64
    for runtime in _RUNTIMES:
        proposed = load_detector(small_cfg, **options, runtime=runtime).propose(image)
        torch.testing.assert_close(proposed.boxes.double(), exact.boxes, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        ("yolov3-tiny", {"treshold": 0.1}, "treshold: .* for yolov3-tiny.*; did you mean threshold="),
        ("yolov3-tiny", {"processor": {}}, "processor: .* for yolov3-tiny, got an unknown one; known: weights"),
        ("yolox-nano", {"runtime": "torch"}, "runtime: .* for yolox-nano"),
        ("mine.onnx", {"inputsize": 320}, "inputsize: .* for mine.onnx, .*; did you mean input_size="),
        ("torchvision:ssd300_vgg16", {"revision": "main"}, "revision: .* for torchvision:ssd300_vgg16"),
        ("hf:owner/name", {"proccessor": {}}, "proccessor: .* for hf:owner/name, .*; did you mean processor="),
        (torch.nn.Linear, {}, "detector: expected a model of torchvision, transformers or Ultralytics"),
    ],
)
def test_options_that_a_detector_does_not_have_are_refused_before_it_is_loaded(model, options, said):
    model = model if isinstance(model, str) else model(1, 1)
    refused(f"^{said}", load_detector, model, **options)


def test_class_names_keep_the_order_of_the_scores(small_cfg, small_weights):
    def classes(given):
        return load_detector(small_cfg, weights=small_weights, stride=None, classes=given).classes

    for given in (["cat", "dog"], "cat, dog", {1: "dog", 0: "cat"}, {"0": "cat", "1": "dog"}):
        assert classes(given) == ("cat", "dog")
    for given, said in (({"cat", "dog"}, "got a set, which has no order"), ({1: "cat", 2: "dog"}, "numbers from 0")):
        refused(f"classes: expected names in the order of the scores.*{said}", classes, given)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("yolov8n", r"expected an ONNX file of yolov8n, got its name; export it with: yolo export model=yolov8n.pt"),
        ("yolo11x-seg", "yolo export model=yolo11x-seg.pt"),
        ("model.tflite", "expected an ONNX file, a Darknet cfg or a name, got model.tflite; export the model to ONNX"),
        ("https://example.org/a.onnx", "expected a file on this machine, or a name, got https://example.org/a.onnx"),
    ],
)
def test_what_newcomers_name_is_refused_with_the_remedy(name, said):
    refused(said, load_detector, name)
    with pytest.raises(InputError, match="device: expected a device of PyTorch, such as cpu or cuda, got 'gpu'"):
        load_detector("yolov3-tiny", device="gpu")


def test_missing_and_unsuitable_files_names_and_modules_are_refused(small_cfg, small_weights, tmp_path):
    refused(r"expected a cfg and its weights", load_detector, "x.weights")
    refused("weights: expected the path", load_detector, small_cfg)
    unusable(r"missing.cfg: no such file", load_detector, tmp_path / "missing.cfg", weights="x")
    unusable(r"expected 248007048 bytes .* got", load_detector, "yolov3", weights=small_weights)
    refused("classes: expected 2 names, got 80", load_detector, small_cfg, weights=small_weights, stride=None)
    with pytest.raises(DataError, match=r"missing\.names: no such file"):
        load_detector(small_cfg, weights=small_weights, classes=tmp_path / "missing.names")
    for name in ["yolov3-tinny", "nothing"]:
        refused(f"unknown detector '{name}'; .*yolov3-tiny", load_detector, name)
    for name in ("", "."):
        refused("detector: expected a name or a file, got '", load_detector, name)
    refused(r"torchvision, transformers or Ultralytics, got torch\.nn.*Linear", load_detector, nn.Linear(1, 1))


def test_coco_classes_equal_those_of_the_annotations(shared):
    import json

    annotations = json.loads((shared / "coco/annotations/instances_eval300.json").read_text())
    names = [entry["name"] for entry in sorted(annotations["categories"], key=lambda entry: entry["id"])]
    assert list(COCO_CLASSES) == names


@pytest.fixture(scope="module")
def tiny(tiny_weights):
    return load_detector("yolov3-tiny", weights=tiny_weights)


@pytest.mark.weights
@pytest.mark.parametrize("name", ["aeroplane", "lifeboat", "beach"])
def test_recognises_people_in_photographs(tiny, name):
    scene = example_scene(name, ["person"])
    found = tiny(scene.image[None])
    assert COCO_CLASSES[int(found.labels[0, 0]) - 1] == "person"
    assert float(found.confidence[0, 0]) > 0.7
    assert float(box_iou(found.boxes[0, :1], scene.boxes).max()) > 0.5


@pytest.mark.weights
@pytest.mark.parametrize("runtime", ["torch", "onnxruntime"])
def test_one_thread_is_reproducible_and_two_threads_agree_with_it(tiny_weights, threads, runtime):
    """One thread repeats its result to the bit; two threads agree up to rounding, as they split matrix products."""
    detector = load_detector("yolov3-tiny", weights=tiny_weights, runtime=runtime)
    image = torch.rand(1, 3, 240, 320, generator=torch.Generator().manual_seed(1))
    (one, again), (two, _) = [[detector.propose(detector.fit(image)[0]) for _ in range(2)] for _ in threads()]
    assert torch.equal(one.boxes, again.boxes)
    assert torch.equal(one.classes, again.classes)
    torch.testing.assert_close(two.boxes, one.boxes, atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(two.classes, one.classes, atol=1e-5, rtol=1e-4)


def test_a_detector_is_returned_as_it_is_and_names_have_any_case(small_cfg, small_weights):
    detector = load_detector(small_cfg, weights=small_weights, classes=["cat", "dog"])
    assert load_detector(detector) is detector
    assert ActivePerception.raw(detector).eye.detector is detector
    with pytest.raises(InputError, match="options: expected none for a detector that is made already, got threshold"):
        load_detector(detector, threshold=0.1)
    assert _detector_name("YOLOv3-Tiny") == "yolov3-tiny"
    assert _detector_name("Torchvision:FCOS_resnet50_fpn") == "torchvision:fcos_resnet50_fpn"
    assert _detector_name("HF:Owner/Name") == "hf:Owner/Name"
    assert _detector_name("Folder/Net.cfg") == "Folder/Net.cfg"


@pytest.mark.parametrize("load", [load_detector, check_detector])
@pytest.mark.parametrize("name", ["mine.pt", "folder/mine.pth"])
def test_pickles_are_refused_with_the_command_that_exports_them(load, name):
    refused(rf"yolo export model={name} format=onnx .*;.*weights='{name}'", load, name)


@pytest.mark.parametrize("load", [load_detector, check_detector])
def test_the_onnx_file_beside_a_pickle_is_named(load, tmp_path):
    (tmp_path / "mine.onnx").touch()
    refused(rf"give '{tmp_path}/mine.onnx', which lies beside it, or export", load, str(tmp_path / "mine.pt"))


class Cells(nn.Module):
    """The columns of YOLOv8 for two classes: a box in the middle of each cell of 32 pixels, with its colour as scores.

    In evaluation such a network returns its maps too.
    """

    def __init__(self) -> None:
        super().__init__()
        self.names = {0: "red", 1: "green"}
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, image):
        scores = nn.functional.avg_pool2d(image * self.scale, 32)[:, :2]
        rows, columns = scores.shape[-2:]
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        centre = torch.stack([x, y])[None].expand(len(image), -1, -1, -1) * 32 + 16
        boxes = torch.cat([centre, torch.full_like(centre, 20)], 1)
        return torch.cat([boxes, scores], 1).flatten(2), [scores]


class Wrapper(nn.Module):
    """The object around a network that `ultralytics.YOLO` makes."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.model = network


@pytest.fixture
def cells(monkeypatch):
    monkeypatch.setattr(Cells, "__module__", "ultralytics.nn.tasks")
    monkeypatch.setattr(Wrapper, "__module__", "ultralytics.engine.model")
    return Cells()


def test_networks_of_ultralytics(cells):
    image = torch.zeros(1, 3, 64, 64)
    image[:, 0, :32, 32:] = 0.9
    image[:, 1, 32:, :32] = 0.7
    image.requires_grad_()
    detector = load_detector(Wrapper(cells), input_size=64, threshold=0.1)
    assert (detector.classes, len(detector.digest)) == (("red", "green"), 64)
    found = detector(image)
    torch.testing.assert_close(found.boxes[0], torch.tensor([[38.0, 6.0, 58.0, 26.0], [6.0, 38.0, 26.0, 58.0]]))
    torch.testing.assert_close(found.scores[0], torch.tensor([[0.1, 0.9, 0.0], [0.3, 0.0, 0.7]]))
    found.scores[..., 1:].amax(-1).sum().backward()
    assert image.grad is not None
    assert load_detector(cells).digest == detector.digest
    with pytest.raises(InputError, match=r"all class scores of each box, \(B, 7, N\), got \(1, 6, 400\)"):
        load_detector(cells, classes=["red", "green", "blue"])(torch.rand(1, 3, 64, 64))
