"""Darknet networks as PyTorch modules, built from the sections of a cfg."""

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
    """A network from the sections of a cfg, with random weights; `read_weights` loads trained weights.

    Supported layers are convolutional, maxpool, upsample, route, shortcut, yolo, and dropout, which does nothing.

    Args:
        sections: sections of the cfg, `[net]` first.

    Attributes:
        input_size: `(width, height)` of the input in the cfg.
        stride: both sides of an input must be multiples of this number.
        heads: the yolo layers, in order.
        sections: sections of the cfg.
        sources: for each layer, the layers that it reads; -1 is the image.
        steps: for each layer, the number of image pixels along one pixel of its output.

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
            got = f"[{sections[0].kind}]" if sections else "no sections"
            raise DataError(f"cfg: expected [net] as its first section, got {got}")
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
        # The last layer that reads each output, after which it is released; the network returns the maps of the heads.
        self._last_reader = {index: index for index in range(-1, len(self.layers))}
        self._last_reader |= {source: index for index, read in enumerate(self.sources) for source in read}
        self._last_reader |= {i: len(self.layers) for i, layer in enumerate(self.layers) if isinstance(layer, Head)}
        # The maps of the first layers are so large that a CPU computes a batch faster one image at a time.
        self._stem = next((index for index, shape in enumerate(builder.shapes) if shape.step >= 8), 0)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Compute the raw maps of the heads."""
        self.check_image(image)
        image = image.contiguous(memory_format=torch.channels_last)
        stem = self._stem if image.device.type == "cpu" and image.shape[0] > 1 else 0
        outputs = {-1: image}
        if stem:
            runs = [self.run({-1: single}, 0, stem) for single in image.split(1)]
            outputs = {index: torch.cat([run[index] for run in runs]) for index in runs[0]}
        outputs = self.run(outputs, stem, len(self.layers))
        return [outputs[index] for index, layer in enumerate(self.layers) if isinstance(layer, Head)]

    def features(self, image: Tensor) -> Tensor:
        """Compute the input of the last convolution before the first head, `(B, C, H', W')`."""
        self.check_image(image)
        head = next(index for index, layer in enumerate(self.layers) if layer is self.heads[0])
        last = self.sources[self.sources[head][0]][0]
        return self.run({-1: image.contiguous(memory_format=torch.channels_last)}, 0, last + 1)[last]

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
        """Run the layers from `start` to `stop - 1`.

        Args:
            outputs: outputs of earlier layers by layer number; -1 is the image. They may be overwritten.
            start: first layer to run.
            stop: the layer after the last one to run.

        Returns:
            The outputs by layer number that later layers read, and the maps of the heads.
        """
        outputs = dict(outputs)
        for index in range(start, stop):
            outputs[index] = self.layers[index](*(outputs[source] for source in self.sources[index]))
            outputs = {source: output for source, output in outputs.items() if self._last_reader[source] > index}
        return outputs
