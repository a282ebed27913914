import numpy as np
import pytest
import torch

from semfov.detection.darknet import ACTIVATIONS, MaxPool, Route, Shortcut, Upsample


def darknet_maxpool(image: np.ndarray, size: int, stride: int, padding: int) -> np.ndarray:
    """Darknet's loops over one channel, with its integer divisions."""
    height, width = image.shape
    rows, columns = (height + padding - size) // stride + 1, (width + padding - size) // stride + 1
    result = np.full((rows, columns), -np.inf)
    offset = -(padding // 2)
    for i in range(rows):
        for j in range(columns):
            for n in range(size):
                for m in range(size):
                    y, x = offset + i * stride + n, offset + j * stride + m
                    if 0 <= y < height and 0 <= x < width:
                        result[i, j] = max(result[i, j], image[y, x])
    return result


@pytest.mark.parametrize("shape", [(13, 10), (8, 7), (6, 6)])
@pytest.mark.parametrize(
    ("size", "stride", "padding"),
    [(2, 2, 1), (2, 1, 1), (5, 1, 4), (13, 1, 12), (3, 2, 2), (3, 2, 0), (2, 2, 0), (3, 1, 3)],
)
def test_maxpool_equals_darknets(shape, size, stride, padding):
    if min(shape) + padding < size:
        pytest.skip("no output")
    image = np.random.default_rng(0).normal(size=shape) - 5
    actual = MaxPool(size, stride, padding)(torch.from_numpy(image)[None, None])
    np.testing.assert_array_equal(actual[0, 0].numpy(), darknet_maxpool(image, size, stride, padding))


def test_activations_equal_their_formulas():
    x = torch.tensor([-2.0, 3.0])
    torch.testing.assert_close(ACTIVATIONS["leaky"](x.clone()), torch.tensor([-0.2, 3.0]))
    torch.testing.assert_close(ACTIVATIONS["relu"](x.clone()), torch.tensor([0.0, 3.0]))
    torch.testing.assert_close(ACTIVATIONS["logistic"](x), 1 / (1 + torch.exp(-x)))
    torch.testing.assert_close(ACTIVATIONS["swish"](x), x / (1 + torch.exp(-x)))
    torch.testing.assert_close(ACTIVATIONS["mish"](x), x * torch.tanh(torch.log(1 + torch.exp(x))))
    torch.testing.assert_close(ACTIVATIONS["linear"](x), x)


def test_upsample_repeats_pixels():
    image = torch.rand(1, 2, 3, 4)
    torch.testing.assert_close(Upsample(2)(image), image.repeat_interleave(2, 2).repeat_interleave(2, 3))


def test_route_concatenates_groups_of_channels():
    a, b = torch.rand(1, 4, 2, 2), torch.rand(1, 6, 2, 2)
    torch.testing.assert_close(Route()(a, b), torch.cat([a, b], 1))
    torch.testing.assert_close(Route(2, 1)(a, b), torch.cat([a[:, 2:], b[:, 3:]], 1))


def test_shortcut_does_not_change_its_inputs():
    a, b = torch.full((1, 1, 2, 2), -1.0), torch.zeros(1, 1, 2, 2)
    torch.testing.assert_close(Shortcut("leaky")(a, b), torch.full((1, 1, 2, 2), -0.1))
    assert a.unique().item() == -1
