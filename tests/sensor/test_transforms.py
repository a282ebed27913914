"""Glimpses and views of panoramas in vmap, in an exported graph and on the device meta, as they are computed alone."""

import pytest
import torch

from semfov.errors import InputError
from semfov.sensor import glimpse, perspective
from semfov.sensor.glimpse import windows_at
from tests.small import rand

# Inside, larger than the picture, partly outside, far outside, small and enlarged, and with edges between pixels.
WINDOWS = torch.tensor(
    [
        [3.0, 4.0, 23.0, 19.0], [-30.0, -20.0, 70.0, 55.0], [-7.3, 11.1, 12.9, 31.7], [90.0, 80.0, 120.0, 99.0],
        [5.25, 6.5, 7.75, 8.25], [30.0, 20.0, 41.5, 33.25], [-60.0, 3.0, -10.0, 20.0], [0.0, 0.0, 40.0, 30.0],
    ]
)  # fmt: skip


@pytest.mark.parametrize("padding", ["zeros", "border", "fill"])
def test_glimpses_do_not_depend_on_the_way_they_are_computed(padding):
    image = rand(1, 3, 30, 40)
    options = {"padding_mode": padding, "fill_value": 0.3}
    alone = glimpse(image, WINDOWS[None], (16, 12), **options)
    mapped = torch.func.vmap(lambda box: glimpse(image, box[None, None], (16, 12), **options)[0, 0])(WINDOWS)
    torch.testing.assert_close(mapped, alone[0], atol=2e-6, rtol=0)
    slopes = torch.func.vmap(torch.func.grad(lambda box: glimpse(image, box[None, None], (16, 12), **options).sum()))
    for box, slope in zip(WINDOWS, slopes(WINDOWS), strict=True):
        own = box.clone().requires_grad_()
        (expected,) = torch.autograd.grad(glimpse(image, own[None, None], (16, 12), **options).sum(), own)
        torch.testing.assert_close(slope, expected, atol=2e-3, rtol=1e-3)


class Glimpses(torch.nn.Module):
    def forward(self, image, points, magnification):
        return glimpse(image, windows_at(points, magnification, (16, 12)), (16, 12))


class Views(torch.nn.Module):
    def forward(self, panorama, pose):
        return perspective(panorama, pose, (12, 8), antialias=False)


def test_an_exported_sensor_takes_other_points():
    sensor = Glimpses()
    image, points, magnification = rand(1, 3, 30, 40), torch.tensor([[[20.0, 15.0]]]), torch.tensor([[0.5]])
    graph = torch.export.export(sensor, (image, points, magnification)).module()
    for at, by in ((points, magnification), (torch.tensor([[[3.0, 29.0]]]), torch.tensor([[1.7]]))):
        torch.testing.assert_close(graph(image, at, by), sensor(image, at, by), atol=2e-6, rtol=0)
    panorama, pose = rand(1, 3, 16, 32), torch.tensor([[[30.0, 10.0, 60.0]]])
    views = Views()
    graph = torch.export.export(views, (panorama, pose)).module()
    other = torch.tensor([[[-170.0, 40.0, 90.0]]])
    torch.testing.assert_close(graph(panorama, other), views(panorama, other))


def test_shapes_are_known_without_values():
    image, panorama = torch.empty(2, 3, 30, 40, device="meta"), torch.empty(2, 3, 16, 32, device="meta")
    points, by = torch.empty(2, 5, 2, device="meta"), torch.empty(2, 5, device="meta")
    assert Glimpses()(image, points, by).shape == (2, 5, 3, 12, 16)
    assert Views()(panorama, torch.empty(2, 3, device="meta")).shape == (2, 3, 8, 12)


def test_views_in_vmap():
    panorama, poses = rand(1, 3, 16, 32), torch.tensor([[0.0, 0.0, 60.0], [170.0, 60.0, 90.0], [-20.0, -80.0, 30.0]])
    alone = perspective(panorama, poses[None], (12, 8), antialias=False)[0]
    view = torch.func.vmap(lambda pose: perspective(panorama, pose[None], (12, 8), antialias=False)[0])
    torch.testing.assert_close(view(poses), alone)
    with pytest.raises(InputError, match="antialias: expected False where the pose is not known"):
        torch.func.vmap(lambda pose: perspective(panorama, pose[None], (12, 8))[0])(poses)
