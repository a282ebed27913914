"""Darknet networks as torch modules, built from the sections of a cfg."""

import hashlib
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from semfov.detection.darknet_builder import Builder
from semfov.detection.darknet_config import Section
from semfov.detection.darknet_layers import Head
from semfov.detection.onnx_file import check_canvas
from semfov.errors import DataError, check, check_shape


class Darknet(nn.Module):
    """A network from the sections of a cfg, with random weights; `read_weights` gives it trained ones.

    Layers: convolutional, maxpool, upsample, route, shortcut, yolo, and dropout, which does nothing here.

    Attributes:
        input_size: `(width, height)` that the cfg asks for.
        stride: both sides of an input must be multiples of it.
        heads: the yolo layers, in order.
        sections: what it was built from.
        sources: for each layer the layers that it reads; -1 is the image.
        steps: for each layer, how many pixels of the image are one of its output.

    Shape:
        - input: `(B, C, H, W)`
        - output: for each head with A anchors and K classes a map `(B, A (5 + K), H', W')`

    >>> from semfov.detection.architectures import yolov3_tiny
    >>> [tuple(m.shape) for m in Darknet(yolov3_tiny())(torch.zeros(1, 3, 64, 96))]
    [(1, 255, 2, 3), (1, 255, 4, 6)]
    """

    def __init__(self, sections: Sequence[Section]) -> None:
        super().__init__()
        self.sections = tuple(sections)
        if not sections or sections[0].kind not in ("net", "network"):
            raise DataError("cfg: expected [net] as its first section")
        self.input_size = (sections[0].integer("width", 416), sections[0].integer("height", 416))
        self.channels = sections[0].integer("channels", 3)
        check_canvas(sections[0].where, self.input_size)
        builder = Builder(self.channels, self.input_size)
        self.layers = nn.ModuleList([builder.add(section) for section in sections[1:]])
        self.heads = [layer for layer in self.layers if isinstance(layer, Head)]
        if not self.heads:
            raise DataError(f"{sections[0].where}: expected at least one [yolo] section, got none")
        self.stride = max(-(-shape.step.numerator // shape.step.denominator) for shape in builder.shapes)
        self.sources = builder.sources
        self.steps = [shape.step for shape in builder.shapes]
        # The layer after which an output is needed no more; the maps of the heads are what the network returns.
        self._last_reader = {index: index for index in range(-1, len(self.layers))}
        self._last_reader |= {source: index for index, read in enumerate(self.sources) for source in read}
        self._last_reader |= {i: len(self.layers) for i, layer in enumerate(self.layers) if isinstance(layer, Head)}
        # The first layers have maps so large that a CPU is faster with one image of a batch after the other.
        self._stem = next((index for index, shape in enumerate(builder.shapes) if shape.step >= 8), 0)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Raw maps of the heads."""
        self.check_image(image)
        image = image.contiguous(memory_format=torch.channels_last)
        stem = self._stem if image.device.type == "cpu" and image.shape[0] > 1 else 0
        outputs = {-1: image}
        if stem:
            parts = [self.run({-1: part}, 0, stem) for part in image.split(1)]
            outputs = {index: torch.cat([part[index] for part in parts]) for index in parts[0]}
        outputs = self.run(outputs, stem, len(self.layers))
        return [outputs[index] for index, layer in enumerate(self.layers) if isinstance(layer, Head)]

    def features(self, image: Tensor) -> Tensor:
        """What the last convolution before the first head reads, `(B, C, H', W')`."""
        self.check_image(image)
        head = next(index for index, layer in enumerate(self.layers) if layer is self.heads[0])
        wanted = self.sources[self.sources[head][0]][0]
        return self.run({-1: image.contiguous(memory_format=torch.channels_last)}, 0, wanted + 1)[wanted]

    def cfg_digest(self) -> str:
        """sha256 of the sections."""
        cfg = repr([(section.kind, sorted(section.options.items())) for section in self.sections])
        return hashlib.sha256(cfg.encode()).hexdigest()

    def check_image(self, image: Tensor) -> None:
        """Raise `InputError` unless the network takes images of this shape."""
        check_shape(image, "image", None, self.channels, None, None)
        height, width = image.shape[-2:]
        fits = height % self.stride == 0 and width % self.stride == 0 and height * width > 0
        check(fits, "image", f"sides that are multiples of {self.stride}", f"{width} x {height}")

    def run(self, outputs: dict[int, Tensor], start: int, stop: int) -> dict[int, Tensor]:
        """Outputs that are read after layer `stop - 1`, from those that are read after layer `start - 1`.

        Args:
            outputs: by the number of their layer; -1 is the image. They may be overwritten.
            start: first layer to run.
            stop: the layer after the last one to run.

        Returns:
            Outputs by the number of their layer, the maps of the heads among them.
        """
        outputs = dict(outputs)
        for index in range(start, stop):
            outputs[index] = self.layers[index](*(outputs[source] for source in self.sources[index]))
            outputs = {source: output for source, output in outputs.items() if self._last_reader[source] > index}
        return outputs
