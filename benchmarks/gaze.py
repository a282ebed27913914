"""Cost of a prediction of where people look beside a plain loop: `python -m benchmarks.gaze`.

In the same repetition a plain loop of onnxruntime, OpenCV and NumPy computes the same density from the same maps of the
detector: resizing, the network, the readouts on the cells of the picture, the blur, and the centre bias. semfov also
compares the picture with those of the fit, and keeps a copy of it for figures.
"""

from collections.abc import Sequence
from dataclasses import asdict
from functools import cache

import cv2
import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray

from benchmarks.bare import Pixels
from benchmarks.machine import photograph
from benchmarks.tables import begin, command, number, page, spread, table, write
from benchmarks.timing import Spread, interleaved
from semfov.data.images import to_bytes
from semfov.detection.feature_maps import landmarks
from semfov.detection.load import load_detector
from semfov.detection.onnx import OnnxDetector
from semfov.detection.weights import fetch
from semfov.gaze.saliency import FixationDensity
from semfov.gaze.saliency.fixation_density import cells_of
from semfov.paths.gaze import GazePrediction

Map = NDArray[np.float32]

LIMIT = 1.2  # of the prediction by the loop

TEXT = """\
Written by `python -m benchmarks.gaze`. A photograph of 640 × 480 px that is in memory; the plain loop computes the same
density by onnxruntime, OpenCV and NumPy, and nothing else (`benchmarks/gaze.py`). Medians over repetitions; the ratio
with quartiles."""


class BareGaze:
    """Density of fixations from a detector's maps in a loop of onnxruntime, OpenCV and NumPy, for pictures of one size.

    Args:
        path: the ONNX file of the detector.
        detector: the same detector, which names its maps and says how pixels are scaled.
        model: the model of where people look.
        size: `(width, height)` of the pictures.
        threads: threads of onnxruntime.
    """

    def __init__(
        self,
        path: str,
        detector: OnnxDetector,
        model: FixationDensity,
        size: tuple[int, int],
        threads: int,
    ) -> None:
        graph = onnx.load(path)
        named = landmarks(detector.session.steps(detector.input_size))
        self._tensors = [named[layer] for layer in model.layers]
        known = {output.name for output in graph.graph.output}
        graph.graph.output.extend(onnx.ValueInfoProto(name=name) for name in self._tensors if name not in known)
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        self._session = ort.InferenceSession(graph.SerializeToString(), options, providers=["CPUExecutionProvider"])
        self._name = self._session.get_inputs()[0].name
        self._detector = detector
        self.size = size
        rows, columns = cells_of(size[::-1])
        self._cells = rows, columns
        self._read = [part.numpy().copy() for part in model.read.detach().split([*model.layers.values()], 1)]
        self._shift = model.shift.detach().numpy()[:, None, None]
        self._mix = model.mix.detach().numpy()
        self._mix_shift = model.mix_shift.detach().numpy()[..., None]
        self._out = model.out.detach().numpy()[:, None]
        self._blur = float(model.blur.detach().exp())
        self._centre = model.centre_bias(size[::-1]).detach().numpy()

    def __call__(self, picture: Pixels) -> Map:
        """Compute the density over the pixels of a picture."""
        canvas, corner, inside = self._canvas(picture)
        maps = self._session.run(self._tensors, {self._name: canvas})
        rows, columns = self._cells
        hidden = np.repeat(self._shift, rows * columns, 1).reshape(len(self._shift), rows, columns)
        for weights, values in zip(self._read, maps, strict=True):
            hidden += self._on_cells(weights, values[0], corner, inside)
        hidden = np.maximum(hidden, 0).reshape(len(self._mix), -1, rows * columns)
        hidden = np.maximum(self._mix @ hidden + self._mix_shift, 0)
        map = (self._out @ hidden).mean(0).reshape(rows, columns)
        log_density = cv2.GaussianBlur(map, (0, 0), self._blur) + self._centre
        density = np.exp(cv2.resize(log_density - log_density.max(), self.size, interpolation=cv2.INTER_LINEAR))
        return density / density.sum()

    def _canvas(self, picture: Pixels) -> tuple[Map, tuple[int, int], tuple[int, int]]:
        """Resize a picture into the input of the network; also its corner there, and its size."""
        settings = self._detector.preprocessing
        width, height = self._detector.input_size
        scale = min(width / self.size[0], height / self.size[1])
        inside = (width, height) if settings.stretch else (round(self.size[0] * scale), round(self.size[1] * scale))
        left = 0 if settings.corner else (width - inside[0]) // 2
        top = 0 if settings.corner else (height - inside[1]) // 2
        canvas = np.full((height, width, 3), round(255 * settings.fill), dtype=np.uint8)
        canvas[top : top + inside[1], left : left + inside[0]] = cv2.resize(picture, inside)
        mean = [255 * value / settings.scale for value in settings.mean]
        image = cv2.dnn.blobFromImage(canvas, settings.scale / 255, mean=mean, swapRB=settings.channels == "bgr")
        return image / np.array(settings.std, dtype=np.float32)[:, None, None], (left, top), inside

    def _on_cells(self, weights: Map, values: Map, corner: tuple[int, int], inside: tuple[int, int]) -> Map:
        """Convolve a map, and interpolate the result on the cells of the picture."""
        channels, height, width = values.shape
        units = (weights @ values.reshape(channels, -1)).reshape(-1, height, width)
        return (
            _line(self._cells[0], corner[1], inside[1], self._detector.input_size[1], height)
            @ units
            @ (_line(self._cells[1], corner[0], inside[0], self._detector.input_size[0], width).T)
        )


@cache
def _line(cells: int, start: int, inside: int, canvas: int, pixels: int) -> Map:
    """Make the matrix `(cells, pixels)` of linear interpolation along one side of a map."""
    centres = ((np.arange(cells) + 0.5) * inside / cells + start) * pixels / canvas - 0.5
    distance = np.abs(centres.clip(0, pixels - 1)[:, None] - np.arange(pixels))
    return np.maximum(1 - distance, 0).astype(np.float32)


DETECTORS = "yolox-nano", "nanodet-plus-m-1.5x"


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all detectors and write the table."""
    parser = command("benchmarks.gaze", __doc__, seconds=10.0)
    parser.add_argument("--weights", nargs="*", default=[], help="files of the detectors that are not downloaded")
    options = parser.parse_args(arguments)
    clock, about = begin(options)
    image = photograph()[0]
    picture: Pixels = to_bytes(image)
    size = (image.shape[-1], image.shape[-2])
    rows, figures = [], {}
    for name in DETECTORS:
        path = next((file for file in options.weights if name.replace("-", "_") in file.replace("-", "_")), None)
        detector = load_detector(name, weights=path)
        assert isinstance(detector, OnnxDetector)
        model = FixationDensity.for_detector(detector)
        loop = BareGaze(path or str(fetch(name)), detector, model, size, options.threads)

        def predict(detector: OnnxDetector = detector) -> torch.Tensor:
            return GazePrediction.of(detector, image).density

        def run_loop(loop: BareGaze = loop) -> Map:
            return loop(picture)

        # Bytes are resized by another rule than numbers.
        torch.testing.assert_close(predict(), torch.from_numpy(run_loop()), rtol=0.1, atol=1e-6)
        durations = interleaved({"ours": predict, "loop": run_loop}, options.seconds, clock)
        ratio = Spread.of([ours / theirs for ours, theirs in zip(durations["ours"], durations["loop"], strict=True)])
        whole = Spread.of(durations["ours"])
        alone = Spread.of(durations["loop"])
        rows.append([name, number(whole.middle), number(alone.middle), spread(ratio), str(LIMIT)])
        figures[name] = {"prediction": asdict(whole), "loop": asdict(alone), "ratio": asdict(ratio)}
        print(" | ".join(rows[-1]), flush=True)
    head = ["detector", "prediction, ms", "plain loop, ms", "prediction by loop", "at most"]
    text = page("Where people look", TEXT, about, table(head, rows))
    write(options.out, "gaze", text, {"machine": about, "milliseconds": figures})


if __name__ == "__main__":
    main()
