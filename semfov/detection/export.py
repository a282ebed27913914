"""Export of Darknet detectors to ONNX, with decoded boxes, for `load_onnx` and for any other runtime.

python -m semfov.detection.export yolov3-tiny out.onnx
"""

import argparse
import json
from os import PathLike
from pathlib import Path

import torch

from semfov.detection.darknet_onnx import network_model
from semfov.detection.detector import Detector
from semfov.detection.onnx_file import METADATA_KEY, OnnxSettings
from semfov.detection.yolo import YoloV3
from semfov.errors import InputError, SemfovError
from semfov.io.files import write_bytes


def export_onnx(detector: Detector, path: str | PathLike[str], *, static: bool = False) -> None:
    """Write a Darknet detector as an ONNX model of all its boxes, with what `load_onnx` needs in its metadata.

    Args:
        detector: the detector.
        path: the ONNX file.
        static: whether the model takes one image at a time, of the detector's input size.

    Raises:
        InputError: it is no Darknet network.
    """
    if not isinstance(detector, YoloV3):
        raise InputError(f"detector: expected a Darknet network, got {type(detector).__name__}")
    model = network_model(detector.network, detector.name, detector.input_size if static else None)
    settings: OnnxSettings = {
        "name": detector.name,
        "head": "candidates",
        "classes": list(detector.classes),
        "input_size": list(detector.input_size),
        "background": detector.background,
        "preprocessing": {"fill": detector.fill},
    }
    if not static:
        settings["stride"] = detector.stride
    model.metadata_props.add(key=METADATA_KEY, value=json.dumps(settings))
    write_bytes(path, model.SerializeToString())


def _largest_difference(detector: Detector, path: str | PathLike[str]) -> float:
    """Find the largest difference from the export's outputs on a noise image, boxes as fractions of the canvas."""
    from semfov.detection.onnx import load_onnx

    exported = load_onnx(path)
    # Noise, as numbers that are equal would hide exchanged channels and sides.
    noise = torch.rand(1, 3, 480, 640, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = detector.propose(detector.fit(noise)[0])
        actual = exported.propose(exported.fit(noise)[0])
    side = max(detector.input_size)
    differences = [(expected.boxes / side - actual.boxes / side).abs().max()]
    differences.append((expected.classes - actual.classes).abs().max())
    if expected.objectness is not None and actual.objectness is not None:
        differences.append((expected.objectness - actual.objectness).abs().max())
    return max(map(float, differences))


def main() -> None:
    """Run the command line of the export."""
    from semfov.detection.load import load_detector

    parser = argparse.ArgumentParser(prog="python -m semfov.detection.export", description="Darknet detector to ONNX")
    parser.add_argument("detector", help="yolov3-tiny, yolov3, yolov3-spp, or the path of a cfg")
    parser.add_argument("output", type=Path, help="the ONNX file to write")
    parser.add_argument("--weights", help="weights file, for a cfg or instead of the published weights")
    parser.add_argument("--classes", help="text file with a class name on each line (default: COCO's)")
    parser.add_argument("--input-size", type=int, help="side of the canvas in pixels")
    parser.add_argument("--static", action="store_true", help="fix the batch to one image, and fix the image's size")
    arguments = parser.parse_args()
    try:
        detector = load_detector(
            arguments.detector,
            weights=arguments.weights,
            classes=arguments.classes,
            input_size=arguments.input_size,
            stride=None if arguments.static else 32,
            # With `auto` onnxruntime would compute it, too, and the export be compared with its own graph.
            runtime="torch",
        )
        export_onnx(detector, arguments.output, static=arguments.static)
        difference = _largest_difference(detector, arguments.output)
    except SemfovError as error:
        parser.exit(1, f"error: {error}\n")
    print(f"{arguments.output}: largest difference from the torch network {difference:.1e}")


if __name__ == "__main__":
    main()
