"""A Darknet network in onnxruntime: exported once, kept in the cache, and run where no gradients are needed."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from semfov.detection import export_graph
from semfov.detection.darknet import Darknet
from semfov.detection.onnx_session import OnnxSession
from semfov.detection.scores import Candidates
from semfov.detection.weights import cache_folder
from semfov.errors import DataError, values_known
from semfov.io.files import replacing, sha256

Runtime = Literal["auto", "torch", "onnxruntime"]

RUNTIMES: tuple[Runtime, ...] = ("auto", "torch", "onnxruntime")


class OnnxTwin:
    """A Darknet network with decoded boxes, computed by onnxruntime on a CPU.

    The ONNX model is made when it is first needed (`exported`). A session has as many threads as torch has at that
    time. Every process opens its own session, because the threads of a pool do not survive a fork.

    Args:
        digest: `network_digest` of the network with its weights.
    """

    def __init__(self, digest: str) -> None:
        self.digest = digest
        self._versions: tuple[object, ...] | None = None
        self._same = False
        self._opened: tuple[tuple[int, int], OnnxSession] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return OnnxTwin, (self.digest,)

    def obstacle(self, network: Darknet) -> str | None:
        """The reason, in words, why onnxruntime cannot run the network as it is now; None if it can."""
        parameters = list(network.parameters())
        dtype, devices = parameters[0].dtype, {parameter.device.type for parameter in parameters}
        if devices != {"cpu"}:
            return f"a network on {', '.join(sorted(devices))}"
        if dtype != torch.float32:
            return f"a network of {dtype}"
        if network.channels != 3:
            return f"a network that takes {network.channels} channels"
        versions = tuple((p.data_ptr(), None if p.is_inference() else p._version) for p in parameters)
        if versions != self._versions:
            self._versions, self._same = versions, network_digest(network) == self.digest
        return None if self._same else "weights that were changed after loading"

    def obstacle_here(self, network: Darknet, canvas: Tensor) -> str | None:
        """The reason, in words, why onnxruntime cannot run the network on a canvas; None if it can."""
        if not values_known(canvas, *network.parameters()) or torch.jit.is_tracing():  # type: ignore[attr-defined]
            return "graphs that are traced, and function transforms"
        tensors = [canvas, *network.parameters()]
        if any(type(tensor) not in (Tensor, nn.Parameter) for tensor in tensors):
            return "subclasses of tensors"
        reverse = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
        if reverse or any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors):
            return "gradients"
        if canvas.device.type != "cpu":
            return f"a canvas on {canvas.device}"
        return self.obstacle(network)

    def __call__(self, network: Darknet, canvas: Tensor) -> Candidates:
        """Compute all boxes of all heads on a canvas `(B, 3, H, W)`, in float32, without gradients."""
        network.check_image(canvas)
        outputs = self._session(network)(canvas.float())
        return Candidates(outputs["boxes"], outputs["classes"], outputs["objectness"])

    def _session(self, network: Darknet) -> OnnxSession:
        key = (os.getpid(), torch.get_num_threads())
        if self._opened is None or self._opened[0] != key:
            self._opened = key, self._open(network)
        return self._opened[1]

    def _open(self, network: Darknet) -> OnnxSession:
        try:
            path = exported(network, cache_folder() / "exported")
        except DataError:  # the cache cannot be written to
            with tempfile.TemporaryDirectory() as folder:
                return OnnxSession(exported(network, Path(folder)), checked=False)
        return OnnxSession(path, checked=False)


def network_digest(network: Darknet) -> str:
    """Compute the sha256 of a network's cfg and of its parameters as float32."""
    digest = hashlib.sha256(network.cfg_digest().encode())
    for parameter in network.parameters():
        digest.update(parameter.detach().float().cpu().contiguous().numpy().data)
    return digest.hexdigest()


def exported(network: Darknet, folder: Path) -> Path:
    """Find the ONNX model of a network in a folder, and export it if it is missing.

    The name of the file contains a digest of the network and exporter, and the file's own sha256. A damaged file does
    not have this sha256 and is exported again. Files are written atomically, so several processes may do this at once.

    Args:
        network: the network.
        folder: the folder.

    Returns:
        The path of the model.

    Raises:
        DataError: the model cannot be written.
    """
    source = json.dumps([network_digest(network), export_graph.VERSION, torch.__version__])
    key = hashlib.sha256(source.encode()).hexdigest()[:16]
    whole = _whole(folder.glob(f"{key}.*.onnx"))
    if whole is not None:
        return whole
    content = export_graph.network_model(network, "darknet").SerializeToString()
    path = folder / f"{key}.{hashlib.sha256(content).hexdigest()}.onnx"
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return path


def _whole(paths: Iterable[Path]) -> Path | None:
    """The first file that can be read and whose sha256 is the one in its name."""
    for path in sorted(paths):
        with suppress(OSError):
            if sha256(path) == path.name.split(".")[1]:
                return path
    return None
