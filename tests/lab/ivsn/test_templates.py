"""Class templates, and attention accumulated over fixations, against loops and SciPy."""

import pytest
import torch
from scipy.spatial.distance import cosine

from eval.ivsn.attention import Attending, TemplateAttention
from eval.ivsn.templates import ClassTemplates, at_points
from semfov import DirichletBelief, Grid
from semfov.belief.observers import Semantic
from semfov.detection.placement import Placement, letterbox
from semfov.gaze.policies import Policy
from semfov.strategy import Strategy
from tests.refusals import refused

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
