"""Fuzz model files: valid files are read back bit for bit, damaged files and impossible values are refused."""

import copy
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from benchmarks.fuzz.runner import Case, Draw, changed
from semfov import DirichletStatistics, FovealObservationModel
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import read_cfg
from semfov.errors import DataError
from semfov.io import storage
from semfov.io.pretrained import Pretrained
from semfov.io.storage import read_tensors, write_tensors
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds

CFG = """[net]
width=32
height=32
channels=3
[convolutional]
filters=7
size=3
stride=2
pad=1
batch_normalize=1
activation=leaky
[yolo]
mask=0
anchors=4,6
classes=2
"""


JUNK: list[Any] = [
    None, True, False, -1, 0, 1, 2, 3, 10**9, 10**400, 0.5, 1.5, -0.5, "", "x", "\0", [], [None], [1], [1, 2], [0.1],
    ["a", "b"], ["a", "a"], {}, {"a": 1}, {"confirm": 2, "stop_below": 0}, {"confirm": 0.5}, [[1, 2]], {"x": [1, "y"]},
]  # fmt: skip


def model_files(draw: Draw, folder: Path) -> Case:
    """Observation models, statistics and cached tensors: truncated, or with changed bits or bytes."""
    name = draw.choose(_SAVED, "file")
    save, load = _SAVED[name]
    path, again = folder / "file.safetensors", folder / "again.safetensors"
    save(path)
    damage = draw.choose(("none", "cut", "longer", "bit", "bytes", "other kind", "text"), "damage")
    if damage == "other kind":
        _SAVED[draw.choose([kind for kind in _SAVED if kind != name], "other")][0](path)
    else:
        path.write_bytes(changed(path.read_bytes(), damage, draw.rng))

    def check(loaded: object) -> None:
        if name != "cached tensors":
            save(again)
            assert _content(load(again)) == _content(loaded), f"{name}: another one after {damage}"

    return Case(lambda: load(path), check, may=damage != "none", must=damage == "other kind")


def darknet_files(draw: Draw, folder: Path) -> Case:
    """Cfg and weights files of Darknet: a network that runs with finite outputs, or `DataError`."""
    cfg, weights = folder / "net.cfg", folder / "net.weights"
    lines = CFG.splitlines()
    damage = draw.choose(("none", "line", "bytes", "cut", "weights"), "damage")
    if damage == "line":
        junk = ["filters=0", "size=99999", "filters=-3", "stride=0", "groups=5", "[rnn]", "mask=9", "anchors=", "="]
        lines[draw.integer(0, len(lines) - 1, "line")] = draw.choose(junk, "junk")
    text = "\n".join(lines).encode()
    cfg.write_bytes(changed(text, damage, draw.rng) if damage in ("bytes", "cut") else text)
    numbers = draw.rng.random(4 * 7 + 7 * 3 * 9).astype("<f4")
    content = np.array([0, 2, 0, 0, 0], "<i4").tobytes() + numbers.tobytes()
    if damage == "weights":
        content = changed(content, draw.choose(("cut", "longer", "bytes"), "how"), draw.rng)
    weights.write_bytes(content)

    def load() -> Darknet:
        network = Darknet(read_cfg(cfg))
        network.read_weights(weights)
        return network.eval()

    def check(network: Darknet) -> None:
        width, height = network.input_size
        if max(width, height) <= 64 and width % network.stride == 0 and height % network.stride == 0:
            with torch.no_grad():
                maps = network(torch.rand(1, network.channels, height, width))
            assert damage == "weights" or all(bool(torch.isfinite(m).all()) for m in maps)

    return Case(load, check, may=damage != "none", must=False)


def model_fields(draw: Draw, folder: Path) -> Case:
    """Models with a changed tensor or value, and a correct checksum: refused, or loaded exactly as the file says."""
    model = draw.choose((_model, _search_model), "model")()
    kind = type(model)
    tensors = {name: tensor.detach().clone() for name, tensor in model._tensors().items()}
    record = json.loads(json.dumps({"kind": kind.kind, "version": "0", **model._record(), "metadata": model.metadata}))
    damage = draw.choose(
        ("none", "number", "dtype", "shape", "missing", "more", "value", "absent", "unsigned"), "damage"
    )
    must = damage in ("dtype", "shape", "more", "unsigned")
    if damage in ("number", "dtype", "shape", "missing"):
        name = draw.choose(tensors, "tensor")
        must |= damage == "missing" and not kind.schema.tensors[name].optional
        tensors = _spoiled(draw, tensors, name, damage)
        must |= any(not bool(tensor.double().isfinite().all()) for tensor in tensors.values())
    elif damage == "more":
        tensors["more"] = torch.zeros(2)
    elif damage in ("value", "absent"):
        key = draw.choose([key for key in record if key != "kind"], "key")
        record[key] = copy.deepcopy(draw.choose(JUNK, "junk"))
        if damage == "absent":
            del record[key]
            must = key != "thresholds"
    path = folder / "model.safetensors"
    if damage == "unsigned":
        save_file(tensors, path, {"semfov": json.dumps(record)})
    else:
        storage.write_file(path, tensors, record)

    def check(loaded: Pretrained) -> None:
        kept = loaded._tensors()
        assert all(bool(tensor.isfinite().all()) for tensor in kept.values())
        for name, tensor in tensors.items():
            assert torch.equal(kept[name], tensor), name
        restored = json.loads(json.dumps({**loaded._record(), "metadata": loaded.metadata}))
        assert all(restored[key] == record[key] for key in restored if key in record), damage
        if isinstance(loaded, FovealObservationModel):
            assert 0 < float(loaded.tempering) <= 100
            assert loaded.miss_rate is None or bool(((loaded.miss_rate >= 0) & (loaded.miss_rate <= 1)).all())
            calibrated = loaded.calibrate(torch.tensor([0.2, 0.7, 0.1]), torch.tensor(0.1)).detach()
            assert bool(calibrated.isfinite().all())
            assert abs(float(calibrated.sum()) - 1) < 1e-4

    return Case(lambda: kind.from_pretrained(path), check, may=damage != "none", must=must)


def _spoiled(draw: Draw, tensors: dict[str, Tensor], name: str, damage: str) -> dict[str, Tensor]:
    tensor = tensors[name]
    if damage == "missing":
        return {key: value for key, value in tensors.items() if key != name}
    if damage == "number":
        number = draw.choose((torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1.5, 60.0, 200.0, 6e4, -6e4), "number")
        tensor.view(-1)[int(draw.rng.integers(tensor.numel()))] = number
    elif damage == "dtype":
        tensor = tensor.to(draw.choose((torch.bfloat16, torch.int64, torch.bool, torch.uint8, torch.int8), "dtype"))
    else:
        tensor = draw.choose((tensor[None].clone(), tensor.new_zeros(0), tensor.new_zeros(2, 3, 4, 5, 6)), "shape")
    return {**tensors, name: tensor}


def _model() -> FovealObservationModel:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return FovealObservationModel.identity(
            ["cup", "cat"],
            [0.2],
            expected=torch.full((3, 2, 3), 1 / 3),
            miss_rate=torch.full((3, 2), 0.25),
            tempering=0.5,
            metadata={"detector": {"name": "toy"}},
        )


def _search_model() -> FovealObservationModel:
    thresholds = Thresholds(0.75, stop_below=0.125, place=0.25)
    return FovealObservationModel.identity(
        ["cup", "cat"],
        [0.2],
        miss_odds=torch.full((3, 2), 0.01),
        refutation=0.9,
        presence=Presence(torch.tensor(-0.5), torch.tensor([0.75, 0.25]), torch.tensor([0.25, 0.5]), thresholds),
        metadata={"detector": {"name": "toy"}},
    )


def _statistics() -> DirichletStatistics:
    return DirichletStatistics((2,), 3).update(torch.tensor([[0.2, 0.3, 0.5]]), torch.tensor([1]))


def _content(loaded: object) -> str:
    """All contents of a loaded file, as text."""
    if isinstance(loaded, tuple):
        statistics, record = loaded
        return f"{statistics.count.tolist()} {statistics.sums.tolist()} {record}"
    assert isinstance(loaded, FovealObservationModel)
    state = {name: tensor.tolist() for name, tensor in loaded.state_dict().items()}
    return f"{state} {loaded.metadata} {loaded._record()}"


def _load_cached(path: Path) -> object:
    tensors = read_tensors(path, "key")
    if tensors is None:
        raise DataError("cached tensors: missing or damaged")
    return tensors


_SAVED: dict[str, tuple[Callable[[Path], None], Callable[[Path], object]]] = {
    "observation model": (lambda path: _search_model().save(path), FovealObservationModel.from_pretrained),
    "statistics": (lambda path: _statistics().save(path), DirichletStatistics.load),
    "cached tensors": (lambda path: write_tensors(path, "key", {"a": torch.arange(9.0)}), _load_cached),
}
