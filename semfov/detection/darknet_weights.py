"""Darknet weights files: a short header, then the raw float32 parameters of one convolution after the other."""

import hashlib
import struct
from os import PathLike
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_layers import Convolution
from semfov.errors import DataError
from semfov.io.files import check_regular

EPSILON = 1e-5
"""Constant ε that batch norm adds to the variance."""


@torch.no_grad()
def read_weights(network: Darknet, path: str | PathLike[str]) -> str:
    """Load the parameters in a weights file into a network, with batch norm folded in.

    The header of the file holds major version, minor version and revision as int32, then the number of images seen in
    training (uint64 since version 0.2, uint32 before). For each convolution of the cfg follow the bias, with batch norm
    also its scale, mean and variance, and the kernel `(O, I / groups, k, k)`. Batch norm is folded in float64:

        weight' = weight · γ / √(σ² + ε),   bias = β - μ γ / √(σ² + ε)

    Args:
        network: the network; its parameters are overwritten.
        path: the weights file.

    Returns:
        sha256 of the file.

    Raises:
        DataError: the file cannot be read, or its length or its numbers do not fit the network.
    """
    layers = [layer for layer in network.layers if isinstance(layer, Convolution)]
    check_regular(path, f"weights {str(path)!r}")
    try:
        length = Path(path).stat().st_size
        longest = 20 + 4 * sum(_count(layer) for layer in layers)
        # A longer file is refused below, so it is not read to its end.
        with Path(path).open("rb") as file:
            data = bytearray(file.read(longest + 1))
    except OSError as error:
        raise DataError(f"cannot read the weights {str(path)!r}: {error.strerror}") from error
    start = _header(data)
    needed = start + 4 * sum(_count(layer) for layer in layers)
    if length != needed or len(data) != needed:
        fault = "truncated" if length < needed else "too long"
        sizes = f"expected {needed} bytes for this network, got {length}"
        raise DataError(f"weights {str(path)!r}: {sizes}; the file is {fault}, or belongs to another network")
    numbers = torch.frombuffer(data, dtype=torch.float32, offset=start)
    if not bool(torch.isfinite(numbers).all()):
        raise DataError(
            f"weights {str(path)!r}: expected finite numbers, got NaN or infinite ones; the file is damaged or not a "
            f"weights file"
        )
    for layer in layers:
        numbers = _fill(layer, numbers, str(path))
    return hashlib.sha256(data).hexdigest()


def _header(data: bytearray) -> int:
    if len(data) < 12:
        return 20
    major, minor, _ = struct.unpack_from("<3i", data)
    return 20 if 10 * major + minor >= 2 and major < 1000 and minor < 1000 else 16


def _count(layer: Convolution) -> int:
    return layer.weight.numel() + layer.out_channels * (4 if layer.normalised else 1)


def _fill(layer: Convolution, numbers: Tensor, path: str) -> Tensor:
    """Load the first numbers into `layer`, and return the rest."""
    channels = layer.out_channels
    vectors = numbers[: channels * (4 if layer.normalised else 1)].view(-1, channels).double()
    weight = numbers[vectors.numel() : _count(layer)].view(layer.weight.shape).double()
    bias = vectors[0]
    if layer.normalised:
        _, scale, mean, variance = vectors
        if bool((variance < 0).any()):
            raise DataError(
                f"weights {path!r}: expected variances of at least 0, got negative ones; the file does not fit the cfg"
            )
        factor = scale / (variance + EPSILON).sqrt()
        weight, bias = weight * factor[:, None, None, None], bias - mean * factor
    layer.weight.copy_(weight)
    cast(Tensor, layer.bias).copy_(bias)
    return numbers[_count(layer) :]
