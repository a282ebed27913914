"""A small Darknet network with every kind of layer, and weights files for it."""

import struct
from pathlib import Path

import numpy as np
import pytest

SMALL_CFG = """
[net]
width=64
height=32
channels=3
# training only
batch=8

[convolutional]
batch_normalize=1
filters=8
size=3
stride=1
pad=1
activation=leaky

[maxpool]
size=2
stride=2

[convolutional]
batch_normalize=1
filters=12
size=3
stride=2
pad=1
activation=leaky

[convolutional]
batch_normalize=1
filters=12
size=3
groups=3
stride=1
pad=1
activation=mish

[shortcut]
from=-2
activation=linear

[maxpool]
size=2
stride=1

[maxpool]
size=5
stride=1

[route]
layers=-1,-2,4

[route]
layers=-1
groups=2
group_id=1

[convolutional]
filters=14
size=1
stride=2
pad=1
activation=linear

[yolo]
mask=1,2
anchors=4,6, 8,10, 20,12
classes=2

[route]
layers=-4

[convolutional]
batch_normalize=1
filters=6
size=1
pad=0
padding=0
activation=relu

[upsample]
stride=2

[route]
layers=-1, 1

[convolutional]
filters=7
size=3
pad=1
activation=linear

[yolo]
mask=0
anchors=4,6, 8,10, 20,12
classes=2
"""

# Filters, inputs per group, kernel side, batch norm: of each convolution of SMALL_CFG, in order.
SMALL_CONVOLUTIONS = [(8, 3, 3, 1), (12, 8, 3, 1), (12, 4, 3, 1), (14, 18, 1, 0), (6, 18, 1, 1), (7, 14, 3, 0)]


def darknet_bytes(
    convolutions: list[tuple[int, int, int, int]], seed: int = 0, version: tuple[int, int] = (0, 2)
) -> bytes:
    """A weights file with random parameters, written as Darknet does."""
    generator = np.random.default_rng(seed)
    header = struct.pack("<3iQ" if version >= (0, 2) else "<3iI", *version, 0, 12345)
    parts = []
    for filters, inputs, side, normalised in convolutions:
        parts.append(generator.normal(0, 0.5, filters))
        if normalised:
            parts.append(generator.uniform(0.5, 2, filters))
            parts.append(generator.normal(0, 0.5, filters))
            parts.append(generator.uniform(0.1, 3, filters))
        parts.append(generator.normal(0, 1 / np.sqrt(inputs * side * side), filters * inputs * side * side))
    return header + b"".join(part.astype("<f4").tobytes() for part in parts)


@pytest.fixture
def small_cfg(tmp_path: Path) -> Path:
    path = tmp_path / "small.cfg"
    path.write_text(SMALL_CFG)
    return path


@pytest.fixture
def small_weights(tmp_path: Path) -> Path:
    path = tmp_path / "small.weights"
    path.write_bytes(darknet_bytes(SMALL_CONVOLUTIONS))
    return path


@pytest.fixture(scope="session")
def tiny_weights() -> Path:
    """The published weights of YOLOv3-tiny."""
    from semfov.detection.weights import fetch
    from semfov.errors import DataError

    try:
        return fetch("yolov3-tiny")
    except DataError as error:
        pytest.skip(str(error))
