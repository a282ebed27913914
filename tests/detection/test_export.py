"""Detectors that are exported, and the page about detectors, whose snippets run and whose table is complete."""

import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from semfov import Detector, load_detector
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.darknet_onnx import _OUTPUTS
from semfov.detection.export import _largest_difference, export_onnx, main
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_heads import HEADS
from tests.refusals import refused, unusable


@pytest.mark.parametrize("static", [False, True])
def test_exported_model_equals_torch(make_small, tmp_path, static):
    detector = make_small(stride=None if static else 16)
    path = tmp_path / "small.onnx"
    export_onnx(detector, path, static=static)
    exported = load_onnx(path)
    assert exported.head == "candidates"
    image = torch.rand(2, 3, 50, 90, generator=torch.Generator().manual_seed(0))
    ours, theirs = detector.propose(detector.fit(image)[0]), exported.propose(exported.fit(image)[0])
    torch.testing.assert_close(theirs.boxes, ours.boxes, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(theirs.classes, ours.classes, rtol=0, atol=1e-5)
    torch.testing.assert_close(theirs.objectness, ours.objectness, rtol=0, atol=1e-5)
    assert _largest_difference(detector, path) <= 1e-4
    ours, theirs = detector(image), exported(image)
    assert ours.count.min() > 3
    torch.testing.assert_close(theirs.scores, ours.scores, rtol=0, atol=1e-4)
    torch.testing.assert_close(theirs.boxes, ours.boxes, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("activation", ["linear", "leaky", "relu", "mish", "swish", "logistic"])
def test_every_activation_can_be_exported(small_cfg, make_small, tmp_path, activation):
    small_cfg.write_text(small_cfg.read_text().replace("activation=leaky", f"activation={activation}"))
    detector = make_small()
    export_onnx(detector, tmp_path / "small.onnx")
    assert _largest_difference(detector, tmp_path / "small.onnx") <= 1e-4


def test_the_exported_model_contains_its_settings(make_small, tmp_path):
    import onnx

    detector = make_small(background="uniform", input_size=(96, 64))
    path = tmp_path / "small.onnx"
    export_onnx(detector, path)
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    assert [output.name for output in model.graph.output] == list(_OUTPUTS)
    exported = load_onnx(path)
    ours, theirs = (json.loads(json.dumps(each.settings())) for each in (detector, exported))
    shared = (ours.keys() & theirs.keys()) - {"digest"}
    assert {"name", "background", "input_size", "stride", "fill"} <= shared
    assert {key: theirs[key] for key in shared} == {key: ours[key] for key in shared}
    assert exported.classes == ("cat", "dog")


def test_other_detectors_and_unwritable_files_are_refused(make_small, tmp_path, make_onnx):
    other = load_onnx(make_onnx({"output0": np.ones((1, 84, 7), np.float32).swapaxes(1, 2)}), classes=("a", "b", "c"))
    refused("OnnxDetector", export_onnx, other, tmp_path / "out.onnx")
    (tmp_path / "file").write_text("")
    unusable("cannot write", export_onnx, make_small(), tmp_path / "file" / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()


@pytest.mark.parametrize("command", ["semfov.detection.export", "examples.export_look"])
def test_command_lines_refuse_a_missing_file_in_one_line(command, tmp_path, monkeypatch, capsys):
    words = ["export", "yolov3-tiny", str(tmp_path / "tiny.onnx"), "--weights", str(tmp_path / "no.weights")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(command).main()
    assert ended.value.code == 1
    assert re.fullmatch(r"error: .*no\.weights.*\n", capsys.readouterr().err)


@pytest.mark.slow
@pytest.mark.weights
def test_command_line_exports_an_equal_model(tiny_weights, tmp_path, monkeypatch, capsys):
    path = tmp_path / "tiny.onnx"
    monkeypatch.setattr(sys, "argv", ["export", "yolov3-tiny", str(path), "--weights", str(tiny_weights)])
    main()
    assert "largest difference" in capsys.readouterr().out
    detector, exported = load_detector("yolov3-tiny", weights=tiny_weights, runtime="torch"), load_detector(path)
    assert exported.classes == COCO_CLASSES
    assert exported.name == "yolov3-tiny"
    assert _largest_difference(detector, path) <= 1e-4


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
