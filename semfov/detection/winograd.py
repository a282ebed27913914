"""Winograd's minimal filtering: 3 x 3 convolutions with 2.25 or 4 times fewer multiplications."""

from typing import TypeGuard, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection.darknet_layers import ACTIVATIONS, Convolution
from semfov.errors import check, check_shape

# (B^T, G, A^T) of F(m x m, 3 x 3) by the side m of the output tile; Lavin and Gray 2016, section 4.
_TRANSFORMS: dict[int, tuple[list[list[float]], list[list[float]], list[list[float]]]] = {
    2: (
        [[1, 0, -1, 0], [0, 1, 1, 0], [0, -1, 1, 0], [0, 1, 0, -1]],
        [[1, 0, 0], [1 / 2, 1 / 2, 1 / 2], [1 / 2, -1 / 2, 1 / 2], [0, 0, 1]],
        [[1, 1, 1, 0], [0, 1, -1, -1]],
    ),
    4: (
        [
            [4, 0, -5, 0, 1, 0],
            [0, -4, -4, 1, 1, 0],
            [0, 4, -4, -1, 1, 0],
            [0, -2, -1, 2, 1, 0],
            [0, 2, -1, -2, 1, 0],
            [0, 4, 0, -5, 0, 1],
        ],
        [
            [1 / 4, 0, 0],
            [-1 / 6, -1 / 6, -1 / 6],
            [-1 / 6, 1 / 6, -1 / 6],
            [1 / 24, 1 / 12, 1 / 6],
            [1 / 24, -1 / 12, 1 / 6],
            [0, 0, 1],
        ],
        [[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]],
    ),
}


def winograd_kernel(weight: Tensor, tile: int = 2) -> Tensor:
    r"""Kernels in the transform domain, `U = G g G^T` (Lavin and Gray 2016, equation 8).

    Shape:
        - weight: `(O, I, 3, 3)`
        - output: `((tile + 2)^2, I, O)`, computed in float64
    """
    check_shape(weight, "weight", None, None, 3, 3)
    check(tile in _TRANSFORMS, "tile", "2 or 4", tile)
    g = torch.tensor(_TRANSFORMS[tile][1], dtype=torch.float64, device=weight.device)
    kernel = torch.einsum("ai,bj,ocij->abco", g, g, weight.double())
    return kernel.reshape(-1, weight.shape[1], weight.shape[0]).to(weight.dtype).contiguous()


def winograd_convolution(image: Tensor, kernel: Tensor, bias: Tensor) -> Tensor:
    r"""3 x 3 convolution with stride 1 and zero padding 1, `Y = A^T [U ⊙ (B^T d B)] A` summed over channels.

    The sum over channels is one matrix product per point of the transform domain. Differentiable.

    Args:
        image: `(B, I, H, W)`, fastest in channels-last memory.
        kernel: `((m + 2)^2, I, O)` from `winograd_kernel`; m is the side of an output tile, 2 or 4.
        bias: `(O,)`.

    Returns:
        `(B, O, H, W)` in channels-last memory.

    >>> image, weight = torch.rand(1, 2, 5, 5), torch.rand(3, 2, 3, 3)
    >>> direct = F.conv2d(image, weight, padding=1)
    >>> torch.allclose(winograd_convolution(image, winograd_kernel(weight), torch.zeros(3)), direct, atol=1e-5)
    True
    """
    batch, channels, height, width = image.shape
    side = round(kernel.shape[0] ** 0.5)
    tile = side - 2
    rows, columns = -(-height // tile), -(-width // tile)
    input_transform, output_transform = (image.new_tensor(_TRANSFORMS[tile][i]) for i in (0, 2))
    padded = F.pad(image.permute(0, 2, 3, 1), (0, 0, 1, columns * tile - width + 1, 1, rows * tile - height + 1))
    windows = padded.unfold(1, side, tile).unfold(2, side, tile).permute(4, 5, 0, 1, 2, 3)
    points = _kron(input_transform) @ windows.reshape(side * side, -1)
    products = points.view(side * side, -1, channels) @ kernel
    tiles = _kron(output_transform) @ products.view(side * side, -1)
    pixels = tiles.view(tile, tile, batch, rows, columns, -1).permute(2, 3, 0, 4, 1, 5)
    result = pixels.reshape(batch, rows * tile, columns * tile, -1)[:, :height, :width] + bias
    return result.permute(0, 3, 1, 2)


class WinogradConvolution(nn.Module):
    """`Convolution` by Winograd's algorithm: same numbers up to rounding, for inference on a CPU.

    Shape:
        - input: `(B, I, H, W)`
        - output: `(B, O, H, W)`
    """

    kernel: Tensor
    bias: Tensor

    def __init__(self, layer: Convolution, tile: int = 2) -> None:
        super().__init__()
        check(self.replaces(layer), "layer", "3 x 3, stride 1, padding 1, one group", layer)
        self.register_buffer("kernel", winograd_kernel(layer.weight.detach(), tile))
        self.register_buffer("bias", cast(Tensor, layer.bias).detach().clone())
        self.activation = layer.activation

    @staticmethod
    def replaces(layer: nn.Module) -> TypeGuard[Convolution]:
        """Whether the algorithm can compute `layer`."""
        return isinstance(layer, Convolution) and (
            (layer.kernel_size, layer.stride, layer.padding, layer.groups) == ((3, 3), (1, 1), (1, 1), 1)
        )

    def forward(self, image: Tensor) -> Tensor:
        """Convolve and activate."""
        return ACTIVATIONS[self.activation](winograd_convolution(image, self.kernel, self.bias))


def _kron(matrix: Tensor) -> Tensor:
    return torch.kron(matrix, matrix)
