"""Random foveation against `foveate`, and as one of Kornia's augmentations."""

import copy
import math

import pytest
import torch
from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip
from torch.utils.data import DataLoader

import semfov.sensor
from semfov.sensor import RandomFoveation, foveate
from tests.refusals import refused
from tests.small import draw


@pytest.mark.parametrize("settings", [{}, {"levels": 3, "growth": 1.0, "convention": "opencv"}])
def test_view_is_foveated_at_the_drawn_fixations(settings, dtype, device):
    image = draw(3, 3, 40, 56, dtype=dtype, device=device)
    augment = RandomFoveation((5.0, 9.0), p=1.0, **settings)
    view = augment(image)
    gaze, sigma = augment._params["gaze"], augment._params["sigma"]
    assert gaze.shape == (3, 2)
    assert sigma.shape == (3,)
    assert len(gaze.unique(dim=0)) == len(sigma.unique()) == 3
    assert view.dtype == dtype
    assert view.device.type == device.type
    for b in range(3):
        one = foveate(image[b : b + 1], gaze[b].to(device), sigma=sigma[b].item(), **settings)
        torch.testing.assert_close(view[b : b + 1], one, rtol=0, atol=1e-6)


def test_fixations_and_widths_are_uniformly_distributed():
    augment = RandomFoveation((5.0, 9.0), p=1.0)
    torch.manual_seed(0)
    drawn = augment.forward_parameters(torch.Size([20000, 3, 30, 50]))
    for values, low, high in (
        (drawn["gaze"][:, 0], -0.5, 49.5),
        (drawn["gaze"][:, 1], -0.5, 29.5),
        (drawn["sigma"], 5.0, 9.0),
    ):
        # The Kolmogorov-Smirnov distance exceeds this bound for one seed in a million.
        share = ((values.double() - low) / (high - low)).sort().values
        assert 0 <= share[0] <= share[-1] <= 1
        distance = (share - (torch.arange(20000) + 0.5) / 20000).abs().max()
        assert distance < 2.7 / math.sqrt(20000)
    # Fixations and widths are not correlated.
    together = torch.corrcoef(torch.cat([drawn["gaze"], drawn["sigma"][:, None]], 1).T)
    assert (together - torch.eye(3)).abs().max() < 0.04


def test_views_are_the_same_on_a_batch_and_of_equal_parameters_or_seeds():
    image = draw(1, 3, 24, 32, dtype=torch.float32).expand(4, -1, -1, -1)
    augment = RandomFoveation((3.0, 30.0), same_on_batch=True, p=1.0)
    view = augment(image)
    assert len(augment._params["gaze"].unique(dim=0)) == len(augment._params["sigma"].unique()) == 1
    torch.testing.assert_close(view, view[:1].expand_as(view))
    image = draw(4, 3, 24, 32, dtype=torch.float32)
    augment = RandomFoveation((3.0, 30.0))
    torch.manual_seed(3)
    view = augment(image)
    params = copy.deepcopy(augment._params)
    assert not torch.equal(augment(image), view)
    assert torch.equal(augment(image, params=params), view)
    torch.manual_seed(3)
    assert torch.equal(RandomFoveation((3.0, 30.0))(image), view)


def test_the_given_share_of_images_is_foveated():
    image = draw(200, 1, 6, 7, dtype=torch.float32)
    assert torch.equal(RandomFoveation(1.0, p=0.0)(image), image)
    augment = RandomFoveation(1.0, p=0.3)
    torch.manual_seed(0)
    changed = (augment(image) != image).flatten(1).any(1)
    assert torch.equal(changed, augment._params["batch_prob"] > 0.5)
    assert 30 < changed.sum() < 90


def test_boxes_masks_and_keypoints_are_moved_only_by_a_flip_before_the_foveation(device):
    image, mask = draw(2, 3, 40, 56, device=device), (draw(2, 1, 40, 56, device=device) > 0.5).double()
    boxes = torch.tensor([[[3.0, 4.0, 20.0, 30.0], [0.0, 0.0, 55.0, 39.0]]], device=device).expand(2, 2, 4)
    points = 30 * draw(2, 5, 2, device=device, dtype=torch.float32)
    given, keys = (image.float(), boxes, mask.float(), points), ["input", "bbox_xyxy", "mask", "keypoints"]
    both = AugmentationSequential(RandomHorizontalFlip(p=1.0), RandomFoveation(6.0, p=1.0), data_keys=keys)
    view, *moved = both(*given)
    flipped, *expected = AugmentationSequential(RandomHorizontalFlip(p=1.0), data_keys=keys)(*given)
    for now, then in zip(moved, expected, strict=True):
        assert torch.equal(now, then)
    torch.testing.assert_close(view, foveate(flipped, both._params[1].data["gaze"].to(device), sigma=6.0))
    again, *_ = both(*given, params=both._params)
    assert torch.equal(again, view)


@pytest.mark.slow
def test_compiles_to_one_graph():
    image = draw(2, 3, 24, 32, dtype=torch.float32)
    augment = RandomFoveation((3.0, 30.0), levels=1, p=1.0)
    augment(image)
    params = copy.deepcopy(augment._params)
    torch.compiler.reset()
    compiled = torch.compile(augment, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(image, params=params), augment(image, params=params))


def test_one_image_is_augmented_alone_or_in_a_loader():
    for keepdim in [False, True]:
        image = draw(3, 24, 32, dtype=torch.float32)
        assert RandomFoveation(5.0, p=1.0, keepdim=keepdim)(image).shape == (image.shape if keepdim else (1, 3, 24, 32))
    augment = RandomFoveation(5.0, p=1.0, keepdim=True)
    loader = DataLoader([(augment(draw(3, 16, 20, dtype=torch.float32)), 0)] * 2, batch_size=2)
    assert next(iter(loader))[0].shape == (2, 3, 16, 20)


def test_bad_settings_and_names():
    for settings, message in [
        ({"sigma": 0.0}, "sigma: expected a positive number"),
        ({"sigma": (5.0, 4.0)}, "sigma: expected"),
        ({"sigma": math.inf}, "sigma: expected"),
        ({"sigma": math.nan}, "sigma: expected"),
        ({"levels": -1}, "levels: expected 0 or more"),
        ({"growth": 0.0}, "growth: expected a positive number"),
        ({"p": 1.5}, "p: expected a probability"),
        ({"convention": "korina"}, "did you mean 'kornia'"),
    ]:
        refused(message, RandomFoveation, **{"sigma": 3.0} | settings)
    with pytest.raises(AttributeError, match="RandomFixation"):
        _ = semfov.sensor.RandomFixation
