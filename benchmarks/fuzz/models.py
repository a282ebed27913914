"""Fuzz model files: valid files are read back bit for bit, damaged files are refused."""

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import DirichletStatistics, FovealObservationModel
from semfov.belief import TargetEvidence
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import read_cfg
from semfov.detection.darknet_weights import read_weights
from semfov.errors import DataError
from semfov.io.cached import read_tensors, write_tensors

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


def model_files(data: st.DataObject) -> str:
    """Observation models, statistics, target evidence and cached tensors: truncated, or with changed bits or bytes."""
    rng = draw_rng(data)
    name = choose(data, _SAVED, "file")
    save, load = _SAVED[name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "file.safetensors")
        save(path)
        whole = path.read_bytes()
        damage = choose(data, ("none", "cut", "longer", "bit", "bytes", "other kind", "text"), "damage")
        if damage == "other kind":
            other = choose(data, [kind for kind in _SAVED if kind != name], "other")
            _SAVED[other][0](path)
        else:
            path.write_bytes(changed(whole, damage, rng))
        result = attempt(lambda: load(path))
        if not failed(result):
            assert damage != "other kind"
            again = Path(folder, "again.safetensors")
            if name != "cached tensors":
                save(again)
                assert _content(load(again)) == _content(result), f"{name}: another one after {damage}"
    assert damage != "none" or not failed(result), result
    return outcome(result)


def darknet_files(data: st.DataObject) -> str:
    """Cfg and weights files of Darknet: a network that runs with finite outputs, or `DataError`."""
    rng = draw_rng(data)
    with tempfile.TemporaryDirectory() as folder:
        cfg, weights = Path(folder, "net.cfg"), Path(folder, "net.weights")
        lines = CFG.splitlines()
        damage = choose(data, ("none", "line", "bytes", "cut", "weights"), "damage")
        if damage == "line":
            junk = ["filters=0", "size=99999", "filters=-3", "stride=0", "groups=5", "[rnn]", "mask=9", "anchors=", "="]
            lines[data.draw(st.integers(0, len(lines) - 1), label="line")] = choose(data, junk, "junk")
        text = "\n".join(lines).encode()
        cfg.write_bytes(changed(text, damage, rng) if damage in ("bytes", "cut") else text)
        numbers = rng.random(4 * 7 + 7 * 3 * 9).astype("<f4")
        content = np.array([0, 2, 0, 0, 0], "<i4").tobytes() + numbers.tobytes()
        if damage == "weights":
            content = changed(content, choose(data, ("cut", "longer", "bytes"), "how"), rng)
        weights.write_bytes(content)

        def load() -> Darknet:
            network = Darknet(read_cfg(cfg))
            read_weights(network, weights)
            return network.eval()

        network = attempt(load)
    if failed(network):
        assert damage != "none", network
        return outcome(network)
    assert isinstance(network, Darknet)
    width, height = network.input_size
    if max(width, height) <= 64 and width % network.stride == 0 and height % network.stride == 0:
        with torch.no_grad():
            maps = network(torch.rand(1, network.channels, height, width))
        assert damage == "weights" or all(bool(torch.isfinite(m).all()) for m in maps)
    return "result"


def changed(content: bytes, damage: str, rng: np.random.Generator) -> bytes:
    """The contents of a file after the damage; they always differ from the original."""
    if damage == "cut":
        return content[: int(rng.integers(0, len(content)))]
    if damage == "longer":
        return content + rng.bytes(int(rng.integers(1, 50)))
    if damage == "text":
        return b"<html>404 Not Found</html>"
    if damage in ("bit", "bytes"):
        values = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(0, len(values), 1 if damage == "bit" else int(rng.integers(2, 9)))
        bits = rng.integers(1, 256, len(places)) if damage == "bytes" else 1 << rng.integers(8)
        values[places] ^= np.asarray(bits, np.uint8)
        return values.tobytes()
    return content


def _model() -> FovealObservationModel:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return FovealObservationModel.identity(["cup", "cat"], [0.2])


def _evidence() -> TargetEvidence:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return TargetEvidence(2, 2)


def _statistics() -> DirichletStatistics:
    return DirichletStatistics((2,), 3).update(torch.tensor([[0.2, 0.3, 0.5]]), torch.tensor([1]))


def _content(loaded: object) -> str:
    """All contents of a loaded file, as text."""
    if isinstance(loaded, tuple):
        statistics, record = loaded
        return f"{statistics.count.tolist()} {statistics.sums.tolist()} {record}"
    assert isinstance(loaded, FovealObservationModel | TargetEvidence)
    state = {name: tensor.tolist() for name, tensor in loaded.state_dict().items()}
    about = (loaded.classes, loaded.epsilon) if isinstance(loaded, FovealObservationModel) else loaded.widths
    return f"{state} {loaded.metadata} {about}"


def _load_cached(path: Path) -> object:
    tensors = read_tensors(path, "key")
    if tensors is None:
        raise DataError("cached tensors: missing or damaged")
    return tensors


_SAVED: dict[str, tuple[Callable[[Path], None], Callable[[Path], object]]] = {
    "observation model": (lambda path: _model().save(path), FovealObservationModel.from_pretrained),
    "statistics": (lambda path: _statistics().save(path), DirichletStatistics.load),
    "target evidence": (lambda path: _evidence().save(path), TargetEvidence.from_pretrained),
    "cached tensors": (lambda path: write_tensors(path, "key", {"a": torch.arange(9.0)}), _load_cached),
}
