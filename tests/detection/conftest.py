"""Fixtures: a small Darknet network with every kind of layer, weights files for it, and ONNX models."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from semfov import load_detector
from semfov.detection.yolo import YoloV3
from tests.small import write_network

SMALL_CFG = """
[net] width=64 height=32 channels=3 batch=8
[convolutional] batch_normalize=1 filters=8 size=3 stride=1 pad=1 activation=leaky
[maxpool] size=2 stride=2
[convolutional] batch_normalize=1 filters=12 size=3 stride=2 pad=1 activation=leaky
[convolutional] batch_normalize=1 filters=12 size=3 groups=3 stride=1 pad=1 activation=mish
[shortcut] from=-2 activation=linear
[maxpool] size=2 stride=1
[maxpool] size=5 stride=1
[route] layers=-1,-2,4
[route] layers=-1 groups=2 group_id=1
[convolutional] filters=14 size=1 stride=2 pad=1 activation=linear
[yolo] mask=1,2 anchors=4,6,8,10,20,12 classes=2
[route] layers=-4
[convolutional] batch_normalize=1 filters=6 size=1 pad=0 padding=0 activation=relu
[upsample] stride=2
[route] layers=-1,1
[convolutional] filters=7 size=3 pad=1 activation=linear
[yolo] mask=0 anchors=4,6,8,10,20,12 classes=2
""".replace(" ", "\n")
"""A network with every kind of layer, one a line; `batch` is for training only."""

# Filters, inputs per group, kernel side and batch norm of each convolution of SMALL_CFG, in order.
SMALL_CONVOLUTIONS = [(8, 3, 3, 1), (12, 8, 3, 1), (12, 4, 3, 1), (14, 18, 1, 0), (6, 36, 1, 1), (7, 14, 3, 0)]


@pytest.fixture
def small_cfg(tmp_path: Path) -> Path:
    """Cfg of a network of 17 layers, 6 of them convolutions."""
    path = tmp_path / "small.cfg"
    path.write_text(SMALL_CFG)
    return path


@pytest.fixture
def write_weights(tmp_path: Path) -> Callable[..., Path]:
    """Writes random weights for `small_cfg` as Darknet does."""

    def write(version: tuple[int, int] = (0, 2), seed: int = 0) -> Path:
        generator = np.random.default_rng(seed)
        parts = []
        for filters, inputs, side, normalised in SMALL_CONVOLUTIONS:
            parts.append(generator.normal(0, 0.5, filters))
            if normalised:
                parts += [generator.uniform(0.5, 2, filters), generator.normal(0, 0.5, filters)]
                parts.append(generator.uniform(0.1, 3, filters))
            parts.append(generator.normal(0, 1 / np.sqrt(inputs * side * side), filters * inputs * side * side))
        header = struct.pack("<3iQ" if version >= (0, 2) else "<3iI", *version, 0, 12345)
        path = tmp_path / "small.weights"
        path.write_bytes(header + np.concatenate(parts).astype("<f4").tobytes())
        return path

    return write


@pytest.fixture
def small_weights(write_weights: Callable[..., Path]) -> Path:
    """Random weights for `small_cfg`."""
    return write_weights()


@pytest.fixture
def make_small(small_cfg: Path, small_weights: Path) -> Callable[..., YoloV3]:
    """Loads the network of `small_cfg` with random weights."""

    def make(runtime: str = "torch", **options: object) -> YoloV3:
        settings = {"weights": small_weights, "classes": ("cat", "dog"), "stride": 16, "runtime": runtime}
        detector = load_detector(small_cfg, **{**settings, **options})
        assert isinstance(detector, YoloV3)
        return detector

    return make


@pytest.fixture
def threads() -> Callable[[], Iterator[int]]:
    """Yields 1 and 2 after setting that number of threads."""

    def numbers() -> Iterator[int]:
        for number in (1, 2):
            torch.set_num_threads(number)
            yield number

    return numbers


@pytest.fixture(scope="session")
def exports(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for exported networks instead of the user's cache."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _export_to_temporary_folder(monkeypatch: pytest.MonkeyPatch, exports: Path) -> None:
    monkeypatch.setattr("semfov.detection.darknet_onnx.cache_folder", lambda: exports)


@pytest.fixture(scope="session")
def tiny_weights() -> Path:
    """The published weights of YOLOv3-tiny."""
    from semfov.detection.weights import fetch
    from semfov.errors import DataError

    try:
        return fetch("yolov3-tiny")
    except DataError as error:
        pytest.skip(str(error))


@pytest.fixture
def make_onnx(tmp_path: Path):
    """Writes ONNX models whose outputs are given arrays `(1, ...)` times sigmoid(mean of the input image)."""
    return lambda outputs, **options: write_onnx(tmp_path / options.pop("file", "model.onnx"), outputs, **options)


def write_onnx(
    path: Path,
    outputs: dict[str, np.ndarray],
    *,
    size: tuple[int, int] = (64, 64),
    image: str = "images",
    batch: int | str = 1,
    dynamic: bool = False,
    extra: dict[str, tuple[int, list[int]]] | None = None,
    metadata: dict[str, str] | None = None,
    producer: str = "pytorch",
    dtype: type = np.float32,
) -> Path:
    from onnx import helper

    kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    sides = ["height", "width"] if dynamic else [size[1], size[0]]
    inputs = {image: (kind, [batch, 3, *sides]), **(extra or {})}
    nodes = [
        helper.make_node("ReduceMean", [image], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Sigmoid", ["mean"], ["gain"]),
    ]
    written, stored = {}, {}
    for name, values in outputs.items():
        stored |= {f"{name}_shape": np.array([-1] + [1] * (values.ndim - 1)), f"{name}_values": values.astype(dtype)}
        nodes.append(helper.make_node("Reshape", ["gain", f"{name}_shape"], [f"{name}_gain"]))
        nodes.append(helper.make_node("Mul", [f"{name}_values", f"{name}_gain"], [name]))
        written[name] = kind, [batch, *([None] * (values.ndim - 1) if dynamic else values.shape[1:])]
    return write_network(path, nodes, inputs, written, stored, metadata=metadata, producer=producer)
