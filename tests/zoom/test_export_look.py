"""A look exported as one ONNX graph and run by onnxruntime, against the eye and the evidence of the export."""

import json
import warnings

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from examples.export_look import _LOOK_METADATA_KEY, export_look
from semfov import InputError, Selection, WindowEye
from semfov.detection.onnx import load_onnx
from semfov.observation.matching import box_iou
from semfov.zoom import GlimpseEvidence
from semfov.zoom.looks import LiveWindowLooks, Window

ort = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript", reason="torch exports ONNX with it")

pytestmark = pytest.mark.slow


class Cells(nn.Module):
    """A head like that of YOLOv5, `(B, N, 5 + 3)`: a box in every 8-px cell, scored by its share of each colour."""

    def forward(self, images: Tensor) -> Tensor:
        full = nn.functional.avg_pool2d(images, 8).flatten(2).transpose(1, 2)
        rows, columns = images.shape[-2] // 8, images.shape[-1] // 8
        y, x = torch.meshgrid(torch.arange(rows) * 8.0 + 4, torch.arange(columns) * 8.0 + 4, indexing="ij")
        place = torch.stack([x, y], -1).view(1, -1, 2).expand(len(images), -1, -1)
        size = 8 + 16 * full[..., :2]
        return torch.cat([place, size, full.amax(-1, keepdim=True), full], -1)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "cells.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the old exporter warns; many existing files were made with it
        torch.onnx.export(Cells(), torch.zeros(1, 3, 128, 128), path, dynamo=False, opset_version=12, verbose=False)
    return load_onnx(
        path, head="yolov5", classes=["red", "green", "blue"], preprocessing={"channels": "bgr", "scale": 1.0}
    )


@pytest.fixture
def colours():
    """1024 × 768 px of smooth colours, as bytes: no two boxes are alike."""
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 24, 32, generator=generator)
    smooth = nn.functional.interpolate(coarse, (768, 1024), mode="bicubic").clamp(0, 1)
    return (smooth[0].permute(1, 2, 0) * 255).round().byte().numpy()


SELECTION = Selection(threshold=0.3, iou=0.4, limit=40)


@pytest.fixture(scope="module")
def exported(network, tmp_path_factory):
    """A file with a look of the network with this selection."""
    path = tmp_path_factory.mktemp("exported") / "look.onnx"
    network.selection = SELECTION
    export_look(WindowEye(network), path, cells=16)
    return path


def run(path, picture, fixation):
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_outputs()]
    feed = {"picture": picture, "fixation": np.array(fixation, dtype=np.float32)}
    return dict(zip(names, map(torch.from_numpy, session.run(None, feed)), strict=True))


def compare(found, eye, picture, fixation, pixels, score):
    """Compare box by box; boxes with equal scores may be in any order."""
    view, at = eye.open(picture), torch.tensor([fixation])
    look = eye.detect(view, at)
    seen = look.detections
    assert len(found["boxes"]) == int(seen.mask.sum()) > 0
    match = box_iou(found["boxes"], seen.boxes[0]).argmax(-1)
    assert sorted(match.tolist()) == list(range(len(match)))
    torch.testing.assert_close(found["boxes"], seen.boxes[0, match], rtol=0, atol=pixels)
    torch.testing.assert_close(found["scores"], seen.scores[0, match], rtol=0, atol=score)
    assert torch.equal(found["cut"], look.cut[0, match])
    assert torch.equal(found["window"].double(), eye.glimpse(view, at)[1][0, :4].double())
    best = found["scores"][:, 1:].amax(-1)
    assert torch.equal(best, best.sort(descending=True).values)


# Native pixels are equal; resampled ones may differ by the rounding of a byte.
@pytest.mark.parametrize(
    ("fixation", "pixels", "score"),
    [
        ((511.5, 383.5, 1.0), 1e-3, 1e-6),  # native pixels
        ((20.0, 750.0, 1.0), 1e-3, 1e-6),  # at a corner, where the window is cut
        ((1060.0, -20.0, 1.0), 1e-3, 1e-6),  # outside the picture
        ((511.5, 383.5, 0.125), 2.0, 0.01),  # the whole picture, with grey above and below
        ((300.2, 400.7, 0.4), 0.5, 0.01),
        ((300.2, 400.7, 3.3), 0.1, 0.01),
    ],
)
def test_the_exported_look_detects_the_same_as_the_eye(network, exported, colours, fixation, pixels, score):
    network.selection = SELECTION
    eye = WindowEye(network)
    found = run(exported, colours, fixation)
    assert set(found) == {"boxes", "scores", "cut", "window"}
    assert (len(found["boxes"]) == SELECTION.limit) == (fixation[0] < 1000)
    compare(found, eye, colours, fixation, pixels, score)


def test_the_exported_look_takes_pictures_of_any_size_and_any_selection(network, colours, tmp_path):
    network.selection = Selection(threshold=0.3, iou=0.1, limit=1000, per_class=True)
    eye = WindowEye(network)
    export_look(eye, tmp_path / "look.onnx")
    for picture in map(np.ascontiguousarray, (colours[:300, :200], colours[::2, 100:])):
        found = run(tmp_path / "look.onnx", picture, (90.0, 90.0, 1.0))
        compare(found, eye, picture, (90.0, 90.0, 1.0), 1e-3, 1e-6)


@pytest.mark.lab
def test_the_exported_evidence_matches_the_model(detector, picture, tmp_path):
    """With a torch detector, in windows of 32 cells."""
    torch.manual_seed(3)
    evidence = GlimpseEvidence(3).eval().requires_grad_(False)
    # With equal parameters, a mix-up of them would not be noticed.
    for parameter in evidence.parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
    picture = (picture * 0.9 + 0.05 * torch.rand_like(picture)).clamp(0, 1)
    export_look(WindowEye(detector), tmp_path / "look.onnx", evidence)
    # At reduced resolution, and with native pixels.
    for finest in (1.0, 4.0):
        eye = WindowEye(detector, finest=finest)
        view = eye.open(picture)
        lattice = view.lattice
        level = lattice.levels - 3
        assert lattice.span(level) == 32
        # Around the red square.
        column, row = (int(middle / pitch) - 13 for middle, pitch in zip((656, 336), lattice.pitch, strict=True))
        window = Window.on(lattice, (level, column, max(row, 0)))
        gist = LiveWindowLooks(eye, view).see([window])[0].gist
        pixels = view.picture.pixels((0, 0, *view.picture.size))
        found = run(tmp_path / "look.onnx", pixels, window.fixation)
        assert gist.scores.shape[:2] == (32, 32)
        assert float(gist.scores.max()) > 0.1
        rates = torch.cat([evidence.survey.rates(gist), evidence.rates(gist, torch.arange(1, 4))])
        tolerance = 2e-5 if lattice.magnifications[level] == 1 else 0.005
        torch.testing.assert_close(found["rates"], rates, rtol=0, atol=tolerance)
        assert float(rates.std()) > 20 * tolerance


def test_the_file_records_its_settings_and_gives_no_boxes_without_objects(exported):
    found = run(exported, np.zeros((200, 300, 3), dtype=np.uint8), (100.0, 100.0, 1.0))
    assert found["boxes"].shape == (0, 4)
    assert found["scores"].shape == (0, 4)
    session = ort.InferenceSession(exported, providers=["CPUExecutionProvider"])
    metadata = json.loads(session.get_modelmeta().custom_metadata_map[_LOOK_METADATA_KEY])
    assert metadata == {"classes": ["red", "green", "blue"], "input_size": [128, 128], "cells": 16}


def test_bad_input(network, tmp_path):
    with pytest.raises(InputError, match="cells: expected a multiple of 8, got 12"):
        export_look(WindowEye(network), tmp_path / "look.onnx", cells=12)
    with pytest.raises(InputError, match="evidence: expected one for 3 classes, got 5"):
        export_look(WindowEye(network), tmp_path / "look.onnx", GlimpseEvidence(5))
    assert not list(tmp_path.iterdir())
