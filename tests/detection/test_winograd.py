import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F

from semfov.detection.darknet_layers import Convolution
from semfov.detection.winograd import WinogradConvolution, winograd_convolution, winograd_kernel
from semfov.errors import InputError

tiles = pytest.mark.parametrize("tile", [2, 4])


@tiles
@given(st.integers(1, 3), st.integers(1, 5), st.integers(1, 5), st.integers(1, 14), st.integers(1, 14))
def test_is_the_direct_convolution(tile, batch, inputs, outputs, height, width):
    image = torch.randn(batch, inputs, height, width, dtype=torch.float64)
    weight, bias = torch.randn(outputs, inputs, 3, 3, dtype=torch.float64), torch.randn(outputs, dtype=torch.float64)
    actual = winograd_convolution(image, winograd_kernel(weight, tile), bias)
    torch.testing.assert_close(actual, F.conv2d(image, weight, bias, padding=1), atol=1e-11, rtol=1e-11)


@tiles
def test_float32_error_is_small(tile):
    image, weight = torch.randn(1, 256, 20, 26), torch.randn(64, 256, 3, 3) / 48
    exact = F.conv2d(image.double(), weight.double(), padding=1)
    actual = winograd_convolution(image, winograd_kernel(weight, tile), torch.zeros(64))
    assert actual.is_contiguous(memory_format=torch.channels_last)
    assert float((actual - exact).abs().max()) < (1e-5 if tile == 2 else 2e-4)


@tiles
def test_gradients(tile):
    image = torch.randn(1, 2, 5, 6, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(3, 2, 3, 3, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x, w, b: winograd_convolution(x, winograd_kernel(w, tile), b), (image, weight, bias)
    )


@tiles
def test_layer(tile):
    layer = Convolution(4, 6, 3, padding=1, activation="leaky").double()
    image = torch.randn(2, 4, 7, 9, dtype=torch.float64)
    torch.testing.assert_close(WinogradConvolution(layer, tile)(image), layer(image))


def test_compiles_whole():
    layer = WinogradConvolution(Convolution(4, 6, 3, padding=1, activation="leaky"))
    image = torch.randn(1, 4, 8, 8)
    torch.testing.assert_close(torch.compile(layer, fullgraph=True, backend="eager")(image), layer(image))


@pytest.mark.parametrize(
    "layer",
    [
        Convolution(4, 4, 3, padding=0),
        Convolution(4, 4, 3, stride=2, padding=1),
        Convolution(4, 4, 1),
        Convolution(4, 4, 3, padding=1, groups=2),
    ],
)
def test_refuses_other_layers(layer):
    assert not WinogradConvolution.replaces(layer)
    with pytest.raises(InputError, match="layer: expected 3 x 3"):
        WinogradConvolution(layer)


def test_refuses_other_tiles():
    with pytest.raises(InputError, match="tile: expected 2 or 4, got 3"):
        winograd_kernel(torch.zeros(1, 1, 3, 3), 3)
