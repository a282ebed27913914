"""Published IVSN on VGG16 with random weights: against a loop over places and channels, with the paper's sizes."""

import pytest
import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional as F
from torchvision.models import vgg16

from eval.ivsn.published import IVSN
from tests.refusals import refused, unusable


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
