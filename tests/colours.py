"""A detector of coloured squares as a network in a file, and photographs of such squares with their annotations."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from tests import small

CLASSES = ("red", "green", "blue")
COLOURS = np.array([[210, 40, 40], [40, 190, 40], [50, 50, 210]], dtype=np.uint8)
SIDE = 64


def write_network(path: Path, bias: float = -4.0) -> Path:
    """Save a network that scores three colours in 8 × 8 squares of a canvas of 64 × 64 pixels."""
    from onnx import helper

    squares = SIDE // 8
    weight = 12 * (1.5 * np.eye(3) - 0.5)[:, :, None, None]
    y, x = np.mgrid[0:squares, 0:squares].reshape(2, -1) * 8
    constants = {
        "weight": weight.astype(np.float32),
        "bias": np.full(3, bias, dtype=np.float32),
        "shape": np.array([1, 3, -1]),
        "corners": np.stack([x, y, x + 8, y + 8], -1)[None].astype(np.float32),
    }
    nodes = [
        helper.make_node("AveragePool", ["images"], ["pooled"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Conv", ["pooled", "weight", "bias"], ["colour"]),
        helper.make_node("Sigmoid", ["colour"], ["scored"]),
        helper.make_node("Reshape", ["scored", "shape"], ["rows"]),
        helper.make_node("Transpose", ["rows"], ["classes"], perm=[0, 2, 1]),
        helper.make_node("Identity", ["corners"], ["boxes"]),
    ]
    outputs = {"boxes": [1, squares**2, 4], "classes": [1, squares**2, 3]}
    told = {"semfov": json.dumps({"classes": list(CLASSES)})}
    return small.write_network(path, nodes, {"images": [1, 3, SIDE, SIDE]}, outputs, constants, metadata=told)


def write_photographs(folder: Path, count: int = 20) -> Path:
    """Save photographs of coloured squares on noise, with boxes and a category that the detector does not know."""
    draw = np.random.default_rng(0)
    images, boxes = [], []
    for number in range(count):
        pixels = draw.integers(90, 160, (SIDE, SIDE, 3), dtype=np.uint8)
        for place in draw.permutation(64)[: draw.integers(2, 5)]:
            kind, x, y = int(draw.integers(0, 3)), 8 * int(place % 8), 8 * int(place // 8)
            pixels[y : y + 8, x : x + 8] = COLOURS[kind]
            boxes.append((number, kind + 1, [x, y, 8, 8]))
        Image.fromarray(pixels).save(folder / f"{number}.png")
        images.append({"id": number, "file_name": f"{number}.png", "width": SIDE, "height": SIDE})
    names = (*CLASSES, "sky")
    categories = [{"id": number + 1, "name": name} for number, name in enumerate(names)]
    boxes.append((0, 4, [0, 0, 60, 20]))
    annotations = [
        {"id": number, "image_id": image, "category_id": kind, "bbox": box}
        for number, (image, kind, box) in enumerate(boxes)
    ]
    path = folder / "instances.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations, "categories": categories}))
    return path


def write_home(folder: Path, count: int = 20) -> Path:
    """Save the network as `colours.onnx`, and photographs in a folder beside it; returns the folder of both."""
    write_network(folder / "colours.onnx")
    (folder / "photographs").mkdir()
    write_photographs(folder / "photographs", count)
    return folder


SMALL = [
    "--columns", "4", "--rows", "4", "--holdout", "4", "--steps", "120", "--fixations", "6",
    "--sensor.sigma", "60", "--sensor.growth", "1", "--workers", "1",
]  # fmt: skip
"""Settings of a small fit of everything to the photographs."""
