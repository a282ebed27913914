"""The snippets of docs/detectors.md run as printed, one after another, and its table of heads is complete."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from semfov import Detector
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_heads import HEADS

PAGE = (Path(__file__).parents[2] / "docs" / "detectors.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.slow
@pytest.mark.weights
def test_snippets_run_as_printed(tiny_weights, make_onnx, tmp_path, monkeypatch):
    from torchvision.models.detection import ssdlite320_mobilenet_v3_large

    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)).save("kitchen.jpg")
    make_onnx(
        {"output": np.random.default_rng(0).random((1, 84, 8)).astype(np.float32) - 0.5 * (np.arange(8) < 4)},
        file="mine.onnx",
    )
    model = ssdlite320_mobilenet_v3_large(weights=None, weights_backbone=None, num_classes=4)
    torch.save(model.state_dict(), "mine.pth")
    space: dict[str, object] = {}
    snippets = blocks("python")
    assert len(snippets) == 5
    image = torch.rand(1, 3, 48, 64)
    for snippet in snippets:
        exec(compile(snippet, "docs/detectors.md", "exec"), space)
        detector = space["detector"]
        assert isinstance(detector, Detector)
        found = detector(image)
        assert found.scores.shape[-1] == len(detector.classes) + 1
    assert detector.background == "uniform"
    assert detector.classes == COCO_CLASSES


def test_the_settings_file_of_a_model_is_valid(make_onnx):
    (text,) = blocks("json")
    path = make_onnx({"out": np.random.default_rng(0).random((1, 84, 8)).astype(np.float32)})
    path.with_suffix(".json").write_text(text)
    detector, written = load_onnx(path), json.loads(text)
    assert detector.head == written["head"]
    assert list(detector.classes) == written["classes"]
    assert detector.preprocessing.settings().items() >= written["preprocessing"].items()


def test_the_table_of_heads_is_complete_and_correct():
    rows = re.findall(r"^\| `([\w-]+)` \|.*\| (BGR|RGB) \| (.*) \| (.*) \| `(\w+)` \|$", PAGE, flags=re.MULTILINE)
    assert {row[0] for row in rows} == set(HEADS)
    for head, channels, values, fitted, background in rows:
        wanted = HEADS[head].preprocessing
        assert wanted.channels == channels.lower()
        assert (wanted.scale == 255) == ("255" in values)
        assert (wanted.std != (1.0, 1.0, 1.0)) == ("std" in values)
        assert wanted.stretch == ("stretch" in fitted)
        assert wanted.corner == ("corner" in fitted)
        assert HEADS[head].background == background
