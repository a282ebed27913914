"""`python -m eval.ivsn.fit`: its sums against loops, and templates of embedded scenes used in a search."""

import json

import pytest
import torch

from eval.ivsn import main as search
from eval.ivsn.fit import _objects_of, _TemplateSums, main
from eval.ivsn.templates import ClassTemplates
from semfov import EmbeddedScenes, load_detector
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import _yolov3_tiny
from tests.refusals import refused
from tests.small import Fixed


def test_features_are_the_input_of_the_last_convolution():
    """Read by a hook on that layer."""
    torch.manual_seed(0)
    network = Darknet(_yolov3_tiny()).eval()
    head = list(network.layers).index(network.heads[0])
    seen = []
    network.layers[head - 1].register_forward_pre_hook(lambda _, read: seen.append(read[0]))
    image = torch.rand(2, 3, 64, 96)
    with torch.no_grad():
        network(image)
        features = network.features(image)
    assert features.shape == (2, 512, 2, 3)
    # The first layers process one image at a time in a full pass, so rounding differs.
    torch.testing.assert_close(features, seen[0], rtol=1e-4, atol=1e-5)
    refused("image", network.features, torch.rand(1, 3, 30, 30))


def test_templates_from_sums_equal_means():
    generator = torch.Generator().manual_seed(0)
    sums, everything, objects, labels = _TemplateSums(3, 4), [], [], []
    for count in (2, 0, 3):
        features = torch.randn(4, 2, 5, generator=generator)
        some, theirs = torch.randn(count, 4, generator=generator), torch.randint(1, 3, (count,), generator=generator)
        sums.update(features, some, theirs)
        everything.append(features.flatten(1).t())
        objects.append(some)
        labels.append(theirs)
    templates, mean = sums.templates()
    torch.testing.assert_close(mean, torch.cat(everything).mean(0))
    for k in (1, 2):
        mine = torch.cat(objects)[torch.cat(labels) == k]
        torch.testing.assert_close(templates[k - 1], mine.mean(0) - mean)
    assert torch.equal(templates[2], torch.zeros(4))


@pytest.mark.weights
def test_features_of_objects_are_taken_at_their_centres():
    detector = load_detector("yolov3-tiny")
    scenes = EmbeddedScenes(detector.classes, count=1)
    features, objects, labels = _objects_of(detector, scenes, 0)
    assert torch.equal(labels, scenes.annotation(0).labels)
    assert objects.shape == (len(labels), len(features))
    canvas, placement = detector.fit(scenes[0].image[None])
    step = canvas.shape[-1] / features.shape[-1]
    for box, found in zip(scenes.annotation(0).boxes, objects, strict=True):
        centre = placement.points_to_canvas(((box[:2] + box[2:]) / 2 - 0.5)[None])[0]
        near = ((centre + 0.5) / step - 0.5).round().long()
        own = features[:, near[1].clamp(0, features.shape[1] - 1), near[0].clamp(0, features.shape[2] - 1)]
        others = (features.flatten(1).t() @ found).sort().values
        # The centre is between four positions; the nearest of them is among the four most similar.
        assert float(own @ found) >= float(others[-4])


@pytest.mark.slow
@pytest.mark.weights
def test_a_run_writes_templates_that_a_search_uses(tmp_path, capsys):
    assert main(["--data.limit", "6", "--holdout", "3", "--out", str(tmp_path)]) == 0
    path = tmp_path / "yolov3-tiny.safetensors"
    model = ClassTemplates.from_pretrained(path)
    assert sum(model.metadata["counts"]) > 4
    areas = json.loads((tmp_path / "areas.json").read_text())
    assert f"{areas['mean']:.3f}" in (tmp_path / "report.md").read_text()
    assert 0.5 < areas["mean"] <= 1
    run = [
        "--data.limit", "1", "--belief.columns", "4", "--belief.rows", "3", "--protocol.starts", "2",
        "--protocol.shifts", "4", "--policies", "[ivsn,random]", "--workers", "1", "--scanpaths", "0",
        "--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "out"), "--templates", str(path),
    ]  # fmt: skip
    assert search(run) == 0
    records = [json.loads(line) for line in (tmp_path / "out/episodes.jsonl").read_text().splitlines()]
    assert {record["policy"] for record in records} == {"ivsn", "random"}
    assert all(len(set(record["cells"])) == len(record["cells"]) for record in records)
    capsys.readouterr()
    assert search([*run[:-1], str(tmp_path / "none")]) == 1
    assert "no such file" in capsys.readouterr().err


def test_a_detector_without_access_to_its_features_is_refused():
    refused(r"access to its features.*fixed", Fixed().head_input, torch.zeros(1, 3, 32, 32))
