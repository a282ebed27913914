"""The figures of the paper that show a photograph."""

from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from eval.figures import _FIGURES, _SAME_OBJECT, _FiguresConfig, ambiguous, figures
from semfov import Detections, FovealObservationModel
from semfov.observation.matching import box_iou
from semfov.runs.config import DetectorConfig, SensorConfig
from semfov.runs.setup import make_eye
from semfov.viz import save_figure
from tests.colours import CLASSES, write_network, write_photographs


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Figures of a photograph of coloured squares."""
    folder = tmp_path_factory.mktemp("figures")
    detector = DetectorConfig(str(write_network(folder / "colours.onnx")))
    write_photographs(folder, 1)
    settings = make_eye(detector, SensorConfig(name="published")).settings()
    alpha = 0.5 + torch.rand(4, 3, 4, generator=torch.Generator().manual_seed(0))
    FovealObservationModel(alpha, [0.2, 0.5], CLASSES, metadata=settings).save(folder / "observation.safetensors")
    return _FiguresConfig(
        picture=folder / "0.png",
        target="red",
        start=(0, 1),
        shifts=2,
        detector=detector,
        model=str(folder / "observation.safetensors"),
        grid=(3, 2),
        out=folder / "out",
    )


@pytest.mark.slow
def test_every_figure_is_drawn_or_said_to_be_missing(config, capsys, monkeypatch):
    monkeypatch.setattr("eval.figures.save_figure", partial(save_figure, dpi=50))
    figures(config)
    told = dict(line.split(": ") for line in capsys.readouterr().out.splitlines())
    assert list(told) == list(_FIGURES)
    for name, answer in told.items():
        if name == "ambiguities" and answer == "no object here changes its class":
            continue
        with Image.open(config.out / f"{name}.png") as picture:
            assert np.asarray(picture.convert("L")).std() > 5, name


def detections(draw, count):
    corner = 4 * torch.rand(1, count, 2, generator=draw)
    scores = torch.rand(1, count, 4, generator=draw)
    return Detections(torch.cat([corner, corner + 4], -1), scores / scores.sum(-1, True), torch.ones(1, count) > 0)


@pytest.mark.parametrize("seed", range(5))
def test_an_ambiguous_pair_is_the_surest_of_one_object_and_of_two_classes(seed):
    """Beside a search through all pairs."""
    draw = torch.Generator().manual_seed(seed)
    sharp, *looks = (detections(draw, count) for count in (4, 3, 0, 5))
    pairs = {}
    for number, look in enumerate(looks):
        for i in range(int(sharp.count)):
            for j in range(int(look.count)):
                same = float(box_iou(sharp.boxes[0, i : i + 1], look.boxes[0, j : j + 1])) >= _SAME_OBJECT
                if same and sharp.labels[0, i] != look.labels[0, j]:
                    pairs[number, i, j] = min(float(sharp.confidence[0, i]), float(look.confidence[0, j]))
    best = max(pairs, key=pairs.get)
    before, number, after = ambiguous(sharp, looks)
    assert number == best[0]
    assert torch.equal(before.boxes[0, 0], sharp.boxes[0, best[1]])
    assert torch.equal(after.boxes[0, 0], looks[number].boxes[0, best[2]])
    assert ambiguous(sharp, looks[1:2]) is None
