"""IVSN: class templates, their fit, attention over fixations, and the published network, against loops and SciPy."""

import json

import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.distance import cosine
from torch import nn
from torch.nn import functional as F
from torchvision.models import vgg16

from eval.ivsn import main as search
from eval.ivsn.attention import Attending, TemplateAttention
from eval.ivsn.fit import _objects_of, _TemplateSums, main
from eval.ivsn.published import IVSN
from eval.ivsn.templates import ClassTemplates, at_points
from semfov import DirichletBelief, EmbeddedScenes, Grid, load_detector
from semfov.belief.observers import Semantic
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import _yolov3_tiny
from semfov.detection.placement import Placement, letterbox
from semfov.gaze.policies import Policy
from semfov.strategy import Strategy
from tests.refusals import refused, unusable
from tests.small import Fixed

GRID = Grid(4, 3, (80, 60))


def make_templates(dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    templates, mean = (torch.randn(*size, generator=generator, dtype=torch.float64) for size in ((3, 5), (5,)))
    return ClassTemplates(templates.to(dtype), (mean / 10).to(dtype), ["a", "b", "c"])


def test_attention_is_the_cosine(dtype, device):
    model = make_templates(dtype).to(device)
    features = torch.randn(2, 5, 2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    got = model(features.to(device, dtype))
    assert got.dtype == dtype
    for batch, row, column in ((0, 0, 0), (1, 1, 2)):
        place = features[batch, :, row, column]
        centred = place / place.norm() - model.mean.double().cpu()
        for k in range(3):
            expected = 1 - cosine(centred.numpy(), model.templates[k].double().cpu().numpy())
            assert float(got[batch, k, row, column]) == pytest.approx(expected, abs=1e-5)


def test_points_of_the_image_are_sampled_on_the_letterboxed_canvas():
    """The image is a ramp, so the value at a point is its x-coordinate."""
    ramp = torch.linspace(0.5, 79.5, 80).expand(1, 3, 60, 80) / 80
    canvas, placement = letterbox(ramp, (160, 160))
    points = torch.tensor([[10.0, 20.0], [40.5, 30.0], [70.0, 50.0]])
    got = at_points(canvas[:, :1], points, placement, (160, 160))[0, 0]
    torch.testing.assert_close(got, (points[:, 0] + 0.5) / 80, rtol=0, atol=2e-3)
    # The same points on a map coarser than the canvas.
    coarse = torch.nn.functional.avg_pool2d(canvas[:, :1], 8)
    torch.testing.assert_close(at_points(coarse, points, placement, (160, 160))[0, 0], got, rtol=0, atol=5e-3)
    assert isinstance(placement, Placement)


def make_attention(dtype=torch.float64):
    return torch.randn(12, 3, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(dtype)


def uniform_beliefs(batch, dtype=torch.float64, device="cpu"):
    return DirichletBelief(torch.ones(batch, 12, 4, dtype=dtype, device=device))


def test_attention_over_several_looks_equals_the_loop(dtype, device):
    visited = torch.zeros(2, 12, dtype=torch.bool)
    visited[0, [0, 7, 11]] = visited[1, 4] = True
    target = torch.tensor([3, 1])
    attention = make_attention(dtype)
    value = TemplateAttention(target, attention, GRID, 0.2).to(device)
    got = value(uniform_beliefs(2, dtype, device), visited.to(device))
    assert got.dtype == dtype
    for episode in range(2):
        for x in range(12):
            total = weights = 0.0
            for f in visited[episode].nonzero()[:, 0].tolist():
                weight = min(1.0, float((1 - GRID.cell_distance[f, x] / 0.2).exp()))
                total += weight * float(attention[f, int(target[episode]) - 1, x])
                weights += weight
            assert float(got[episode, x]) == pytest.approx(total / weights, rel=1e-4, abs=1e-5)


def test_other_classes_and_invalid_arguments_are_refused():
    model = make_templates()
    model.metadata |= {"detector": {"name": "yolov3-tiny", "digest": "1"}}
    model.check_eye({"detector": model.metadata["detector"], "sensor": {}}, ["a", "b", "c"])
    refused("class", model.check_eye, {"detector": model.metadata["detector"], "sensor": {}}, ["a", "b", "d"])
    refused("templates", ClassTemplates, torch.zeros(2, 5), torch.zeros(5), ["a", "b", "c"])
    refused("features", make_templates(), torch.zeros(1, 4, 2, 2))
    for target in (0, 4):
        refused("target", TemplateAttention, target, make_attention(), GRID)
    for attention in (make_attention()[:5], make_attention()[..., :5]):
        refused(r"^attention:", TemplateAttention, 1, attention, GRID)
    refused(r"^fovea:", TemplateAttention, 1, make_attention(), GRID, 0.0)


def test_a_search_follows_the_attention_of_its_scene():
    strategy, attention = Strategy(Semantic(4), Policy("ivsn", fovea=0.2)), make_attention()
    candidate = Attending(strategy, attention=attention, fovea=0.2)
    visited = torch.zeros(1, 12, dtype=torch.bool)
    visited[0, 5] = True
    value = candidate.acquisition(torch.tensor([2]), GRID, torch.tensor([5]))(uniform_beliefs(1), visited)
    torch.testing.assert_close(value[0], attention[5, 1])
    refused("policy 'ivsn': expected a target", candidate.acquisition, None, GRID, torch.tensor([5]))
    refused("policy 'ivsn': expected attention of a scene", strategy.policy, 1, GRID)


def test_shipped_templates():
    model = ClassTemplates.from_pretrained("yolov3-tiny")
    assert model.metadata["detector"]["name"] == "yolov3-tiny"
    card = (model.shipped / "README.md").read_text(encoding="utf-8")
    assert f"{sum(model.metadata['counts']):,} objects" in card
    # The average object of a class matches the template of its own class best.
    average = (model.templates + model.mean)[:, :, None, None]
    assert torch.equal(model(average)[..., 0, 0].argmax(-1), torch.arange(80))


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
        "--detector.name", "yolov3-tiny",
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


@pytest.fixture(scope="module")
def ivsn():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return IVSN.vgg16(None)


def pictures(seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 3, 60, 80, generator=generator, dtype=dtype), torch.rand(1, 3, 20, 30, generator=generator)


@pytest.mark.slow
def test_attention_equals_the_loop_over_torchvisions_layers(ivsn):
    """Layer by layer in torchvision's network: 14 × 14 places for the image and one for the target."""
    network = vgg16(weights=None).features
    network.load_state_dict({**ivsn.features.state_dict()}, strict=True)
    image, target = pictures()
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])

    def prepared(pixels, side):
        small = F.interpolate(pixels, (side, side), mode="bilinear", align_corners=False)
        return (small - mean[:, None, None]) / deviation[:, None, None]

    with torch.no_grad():
        got = ivsn(image, target)[0]
        searched = network[:30](prepared(image, 224))[0]
        kernel = prepared(target, 28)
        for layer in network:
            kernel = F.max_pool2d(kernel, 2, 2, ceil_mode=True) if isinstance(layer, nn.MaxPool2d) else layer(kernel)
    assert searched.shape == (512, 14, 14)
    assert kernel.shape == (1, 512, 1, 1)
    assert got.shape == (14, 14)
    for row, column in ((0, 0), (3, 7), (13, 13)):
        total = sum(float(searched[c, row, column]) * float(kernel[0, c, 0, 0]) for c in range(512))
        assert float(got[row, column]) == pytest.approx(total, rel=1e-4, abs=1e-6)


def test_attention_is_largest_at_the_target(dtype, device):
    """With the identity as network, attention is largest where the colour is that of the target."""
    identity = IVSN(nn.Identity(), nn.Identity(), picture=8, target=1).to(device)
    image = torch.full((1, 3, 8, 8), 0.45, dtype=dtype, device=device)
    image[0, :, 2, 5] = torch.tensor([0.9, 0.1, 0.1], dtype=dtype)
    target = image[:, :, 2:3, 5:6]
    got = identity(image, target)
    assert got.dtype == dtype
    assert int(got.flatten().argmax()) == 2 * 8 + 5


@pytest.mark.slow
def test_weights_from_a_file(ivsn, tmp_path):
    save_file({f"features.{name}": value for name, value in ivsn.features.state_dict().items()}, tmp_path / "w")
    again = IVSN.vgg16(tmp_path / "w")
    image, target = pictures(1)
    with torch.no_grad():
        assert torch.equal(again(image, target), ivsn(image, target))
    save_file({"features.0.weight": torch.zeros(3)}, tmp_path / "part")
    (tmp_path / "damaged").write_bytes(b"\x00" * 9)
    for name in ("part", "damaged", "missing"):
        unusable(name, IVSN.vgg16, tmp_path / name)


def test_invalid_arguments_are_refused():
    identity = IVSN(nn.Identity(), nn.Identity(), picture=8, target=1)
    image, target = pictures()
    refused("image", identity, image[:, :2], target)
    refused("target", identity, image, target.expand(2, -1, -1, -1))
    refused("target's features", IVSN(nn.Identity(), nn.Identity(), picture=8, target=2), image, target)
    refused(r"access to its features.*fixed", Fixed().head_input, torch.zeros(1, 3, 32, 32))
