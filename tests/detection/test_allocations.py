"""Untrusted files cannot allocate excessive memory, and files that are not detectors are refused by name."""

import json
import os
import tracemalloc

import onnx
import pytest
import torch
from onnx import TensorProto, helper

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import _parse_cfg, read_cfg
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_session import OnnxSession
from semfov.errors import DataError, InputError, SemfovError
from tests.refusals import refused, unusable
from tests.small import write_network

NET = "[net]\nwidth=32\nheight=32\nchannels=3\n"
HEAD = "[convolutional]\nfilters=7\nsize=1\n[yolo]\nmask=0\nanchors=4,6\nclasses=2\n"
DEEP = "".join("[convolutional]\nfilters=8000\nsize=3\npad=1\n" for _ in range(3))


@pytest.mark.parametrize(
    "cfg",
    [
        NET + "[convolutional]\nfilters=100000000\nsize=3\n" + HEAD,
        NET + DEEP + HEAD,
        NET + "[convolutional]\nfilters=21\nsize=99999\n" + HEAD,
        NET + "[maxpool]\nsize=99999\nstride=1\n" + HEAD,
        NET + "[convolutional]\nfilters=7\nsize=1\npadding=1000000000\n" + HEAD,
        NET + "[upsample]\nstride=10000\n" + HEAD,
        NET + "[upsample]\nstride=100\n[upsample]\nstride=100\n" + HEAD,
        NET + "[convolutional]\nfilters=4\nsize=1\n" + "[route]\nlayers=-1,-1,-1,-1\n" * 40 + HEAD,
        NET.replace("32", "99999999") + HEAD,
        NET.replace("channels=3", "channels=" + "9" * 400) + HEAD,
        NET + HEAD.replace("4,6", "nan,6"),
        NET + HEAD.replace("4,6", "inf,6"),
        NET + HEAD.replace("classes=2", "classes=1000000000"),
        NET + "[dropout]\n" * 5000 + HEAD,
    ],
)
def test_too_large_networks_are_refused_before_memory_is_allocated(cfg):
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            Darknet(_parse_cfg(cfg))
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 400
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


def test_pipes_and_too_long_files_are_refused(tmp_path):
    path = tmp_path / "long.cfg"
    path.write_text("#" * 2**21)
    unusable("at most", read_cfg, path)
    os.mkfifo(tmp_path / "pipe")
    network = Darknet(_parse_cfg(NET + HEAD))
    for read in (read_cfg, network.read_weights, OnnxSession):
        unusable("expected a file, got a pipe", read, tmp_path / "pipe")
    with (tmp_path / "sparse.weights").open("wb") as file:
        file.truncate(2**40)
    unusable("too long", network.read_weights, tmp_path / "sparse.weights")


def save(path, nodes, outputs, stored=None, *, image=(1, 3, 32, 32), **more):
    """Write a model with one image input."""
    return write_network(path, nodes, {"image": [*image]}, outputs, stored or {}, **more)


def test_integer_and_scalar_outputs_are_refused_by_name(tmp_path):
    cast = helper.make_node("Cast", ["image"], ["label"], to=TensorProto.INT64)
    with pytest.raises(InputError, match=r"output 'label': expected floating-point numbers, got tensor\(int64\)"):
        load_onnx(save(tmp_path / "integers.onnx", [cast], {"label": (TensorProto.INT64, [1, 3, 32, 32])}))
    mean = helper.make_node("ReduceMean", ["image"], ["score"], keepdims=0)
    path = save(tmp_path / "scalar.onnx", [mean], {"score": []})
    refused(r"output 'score': expected a row for each of 1 images, got shape \(\)", load_onnx, path)


@pytest.mark.parametrize("side", [100_000, 2**40])
def test_too_large_tensors_are_refused_before_memory_is_allocated(tmp_path, side):
    identity = helper.make_node("Identity", ["image"], ["out"])
    big = [1, 3, side, side]
    with pytest.raises(SemfovError, match="at most"):
        load_onnx(save(tmp_path / "canvas.onnx", [identity], {"out": big}, image=big))
    fill = helper.make_node("ConstantOfShape", ["shape"], ["out"])
    with pytest.raises(DataError, match=r"tensor 'out': expected at most"):
        load_onnx(save(tmp_path / "fill.onnx", [fill], {"out": None}, {"shape": [1, side, side]}))
    batch = [side, 3, 32, 32]
    with pytest.raises(SemfovError, match="at most"):
        load_onnx(save(tmp_path / "batch.onnx", [identity], {"out": batch}, image=batch))


def test_weights_outside_the_folder_of_the_model_are_refused(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(4))
    folder = tmp_path / "model"
    folder.mkdir()
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="../secret")
    add = helper.make_node("Add", ["image", "w"], ["out"])
    path = folder / "model.onnx"
    model = onnx.load(save(path, [add], {"out": [1, 3, 32, 32]}))
    model.graph.initializer.append(tensor)
    path.write_bytes(model.SerializeToString())
    unusable("leads out of it", load_onnx, path)


@pytest.mark.parametrize(
    "metadata",
    [
        {"names": "[" * 10_000},
        {"names": "{0: 'a\x00'}"},
        {"names": "{0: " + "9" * 10_000 + "}"},
        {"imgsz": "[" * 5000 + "]" * 5000},
        {"semfov": "[" * 100_000},
        {"semfov": '{"classes": [1, 2]}'},
        {"semfov": '{"classes": ["\\u0000"]}'},
        {"semfov": '{"input_size": [1e400, 2]}'},
        {"semfov": json.dumps({"surplus" * 1000: 1})},
        {"noise": "x" * 2**21},
    ],
)
def test_invalid_or_excessive_metadata_is_refused_in_one_line(tmp_path, metadata):
    reshape = helper.make_node("Reshape", ["image", "shape"], ["out"])
    path = save(tmp_path / "model.onnx", [reshape], {"out": [1, 384, 8]}, {"shape": [1, 384, 8]}, metadata=metadata)
    with pytest.raises(SemfovError) as caught:
        load_onnx(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_an_ordinary_network_is_accepted(tmp_path):
    with torch.random.fork_rng(devices=[]):
        network = Darknet(_parse_cfg(NET + HEAD))
    assert [tuple(each.shape) for each in network(torch.zeros(1, 3, 32, 32))] == [(1, 7, 32, 32)]
