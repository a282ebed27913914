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
"""Added to the variance by batch norm."""


@torch.no_grad()
def read_weights(network: Darknet, path: str | PathLike[str]) -> str:
    """Fill `network` with the parameters in a weights file, batch norm folded in, and return the file's sha256.

    Header: int32 major, minor and revision, then the number of images seen (uint64 from version 0.2 on, before that
    uint32). For each convolution of the cfg: bias; with batch norm also its scale, mean and variance; the kernel
    `(O, I / groups, k, k)`. Folding, in float64:

        weight · γ / √(σ² + ε),   bias = β - μ γ / √(σ² + ε)

    Raises:
        DataError: the file cannot be read, or its length or its numbers do not fit the network.
    """
    layers = [layer for layer in network.layers if isinstance(layer, Convolution)]
    check_regular(path, f"weights {str(path)!r}")
    try:
        length = Path(path).stat().st_size
        longest = 20 + 4 * sum(_count(layer) for layer in layers)
        # What is longer is refused below by what it says; that much is not worth reading.
        with Path(path).open("rb") as file:
            data = bytearray(file.read(longest + 1))
    except OSError as error:
        raise DataError(f"cannot read the weights {str(path)!r}: {error.strerror}") from error
    start = _header(data)
    needed = start + 4 * sum(_count(layer) for layer in layers)
    if length != needed or len(data) != needed:
        fault = "truncated" if length < needed else "too long"
        found = f"expected {needed} bytes for this network, got {length}"
        raise DataError(f"weights {str(path)!r}: {found}; {fault}, or of another network")
    numbers = torch.frombuffer(data, dtype=torch.float32, offset=start)
    if not bool(torch.isfinite(numbers).all()):
        raise DataError(f"weights {str(path)!r}: expected finite numbers, so the file is damaged or no weights file")
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
    """Take what belongs to `layer` from the front of `numbers` and return the rest."""
    channels = layer.out_channels
    vectors = numbers[: channels * (4 if layer.normalised else 1)].view(-1, channels).double()
    weight = numbers[vectors.numel() : _count(layer)].view(layer.weight.shape).double()
    bias = vectors[0]
    if layer.normalised:
        _, scale, mean, variance = vectors
        if bool((variance < 0).any()):
            raise DataError(f"weights {path!r}: expected variances from 0 up, so the file does not fit this cfg")
        factor = scale / (variance + EPSILON).sqrt()
        weight, bias = weight * factor[:, None, None, None], bias - mean * factor
    layer.weight.copy_(weight)
    cast(Tensor, layer.bias).copy_(bias)
    return numbers[_count(layer) :]
