"""Positions keep single precision, whatever the type of the pixels, the fixations or the boxes."""

import numpy as np
import pytest
import torch

from semfov import Foveation, Grid, foveate, merge_boxes
from semfov.data.inputs import as_positions
from semfov.detection.placement import Placement
from semfov.observation.matching import box_iou
from semfov.sensor import LogPolar, MultiScaleFovea, glimpse, perspective
from semfov.sensor.fovea import pixel_positions
from semfov.sensor.glimpse import window_around, windows_at
from tests.refusals import refused
from tests.small import rand

WIDE = 4096
GAZE = (3001.0, 9.0)
HALVES = pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])


def of_opened(sensor, name="look"):
    def look(image, gaze):
        return getattr(sensor, name)(sensor.open(image, torch.ones(2)), gaze.view(1, 2))

    return look


SENSORS = {
    "foveate": lambda image, gaze: foveate(image, gaze, sigma=3.0),
    "windows of one size": lambda image, gaze: foveate(image, gaze, sigma=6.0, growth=1.0),
    "several fixations": lambda image, gaze: foveate(image, gaze.view(1, 1, 2), sigma=3.0),
    "Foveation": of_opened(Foveation(3.0)),
    "LogPolar": LogPolar(6.0, 1.0),
    "LogPolar of a canvas": of_opened(LogPolar(6.0, 1.0)),
    "MultiScaleFovea": MultiScaleFovea(8, 3),
    "pictures": of_opened(MultiScaleFovea(8, 3), "picture"),
    "glimpse": lambda image, gaze: glimpse(image, windows_at(gaze.view(1, 2), torch.tensor([2.0]), (16, 12)), (16, 12)),
}


@HALVES
@pytest.mark.parametrize("name", SENSORS)
def test_views_of_half_precision_show_the_same_place(name, dtype):
    """Beside the same pixels in single precision; a place that is off by half a pixel changes noise as a whole."""
    image = rand(1, 3, 20, WIDE).to(dtype)
    expected = SENSORS[name](image.float(), torch.tensor(GAZE))
    view = SENSORS[name](image, torch.tensor(GAZE))
    assert view.dtype == dtype
    rounding = 8 * torch.finfo(dtype).eps
    torch.testing.assert_close(view.float(), expected, atol=rounding, rtol=0)


@pytest.mark.parametrize("has_gradients", [False, True])
@pytest.mark.parametrize("size", [(20, 600), (400, 500)], ids=str)
@pytest.mark.parametrize("name", SENSORS)
def test_automatic_mixed_precision_changes_no_view(name, size, has_gradients):
    """Half precision would lose the details that the sensor shows; of large pictures no view was made at all."""
    image = rand(1, 3, *size).requires_grad_(has_gradients)
    gaze = torch.tensor([301.0, 9.0])
    expected = SENSORS[name](image, gaze)
    with torch.autocast("cpu", torch.bfloat16):
        view = SENSORS[name](image, gaze)
    assert view.dtype == torch.float32
    torch.testing.assert_close(view, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", [torch.float64, torch.int64, torch.int16], ids=str)
@pytest.mark.parametrize("name", SENSORS)
def test_fixations_of_any_type(name, kind):
    image = rand(1, 3, 20, 600)
    gaze = torch.tensor([301, 9])
    assert torch.equal(SENSORS[name](image, gaze.to(kind)), SENSORS[name](image, gaze.float()))


@HALVES
def test_views_of_a_panorama_in_half_precision(dtype):
    panorama = rand(1, 3, 256, 512).to(dtype)
    pose = torch.tensor([[121.7, 33.3, 40.0]])
    expected = perspective(panorama.float(), pose, (40, 30), antialias=False)
    view = perspective(panorama, pose, (40, 30), antialias=False)
    torch.testing.assert_close(view.float(), expected, atol=8 * torch.finfo(dtype).eps, rtol=0)


ONE, OTHER = [3000.5, 2000.25, 3400.5, 2400.25], [3010.5, 2000.25, 3400.5, 2400.25]


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int32], ids=str)
def test_overlap_of_boxes_of_any_type(kind):
    """Areas of large boxes overflow in half precision and in whole numbers."""
    one, other = (torch.tensor([box]).to(kind) for box in (ONE, OTHER))
    wide = float(one[0, 2] - one[0, 0])
    exact = (float(other[0, 2]) - float(other[0, 0])) / wide if kind != torch.bfloat16 else None
    got = float(box_iou(one, other))
    assert got == pytest.approx(exact, abs=1e-6) if exact is not None else got > 0.9
    huge = torch.tensor([[0, 0, 60_000, 60_000], [0, 0, 60_000, 30_000]]).to(torch.int32)
    assert float(box_iou(huge, huge)[0, 1]) == 0.5
    merged = merge_boxes(torch.cat([one, other]), [0.9, 0.8], [1, 1])
    assert len(merged) == 1
    assert merged.boxes.dtype in (torch.float32, torch.float64)
    assert len(merge_boxes(torch.cat([one, other]).float().numpy(), [0.9, 0.8], [1, 1])) == 1


def test_boxes_without_area_and_reversed_boxes():
    point = [5.0, 5, 5, 5]
    assert merge_boxes([point, point, [5.0, 5, 5, 9]], [0.9, 0.8, 0.7], [1, 1, 1]).boxes.tolist() == [
        point,
        [5, 5, 5, 9],
    ]
    assert len(merge_boxes([point, point], [0.9, 0.8], [1, 2])) == 2
    for box in ([9.0, 5, 5, 9], [5.0, 9, 9, 5]):
        refused(r"boxes: expected \(x1, y1, x2, y2\) with x1 <= x2", merge_boxes, [box], [0.9], [1])
    assert float(box_iou(torch.tensor([[9.0, 5, 5, 9]]), torch.tensor([[5.0, 5, 9, 9]]))) == 0


@pytest.mark.parametrize("kind", [torch.float16, torch.float64, torch.int64, torch.int16], ids=str)
def test_cells_of_points_and_boxes_of_any_type(kind):
    """Cells of 42.5 pixels, whose size whole numbers cut and halves round."""
    grid = Grid(10, 10, (4096, 425))
    numbers = np.random.default_rng(0).integers(0, 425, (200, 4))
    values = torch.tensor(numbers).to(kind)
    low, high = torch.minimum(values[:, :2], values[:, 2:]), torch.maximum(values[:, :2], values[:, 2:]) + 1
    boxes, points = torch.cat([low, high], -1), values[:, :2]
    assert torch.equal(grid.cell_of(points), grid.cell_of(points.double()))
    for rule in ("overlap", "centre", "box_centre"):
        assert torch.equal(grid.footprint(boxes, rule), grid.footprint(boxes.float(), rule))
    assert torch.equal(
        grid.distance(points), grid.distance(points.to(torch.float64 if kind == torch.float64 else torch.float32))
    )
    near = grid.box_distance(boxes, points[0])
    torch.testing.assert_close(near.float(), grid.box_distance(boxes.double(), points[0].double()).float())


@pytest.mark.parametrize("kind", [torch.float16, torch.float64, torch.int64], ids=str)
def test_places_on_a_canvas_of_any_type(kind):
    placement = Placement((4096, 3072), (0.3125, 0.3125), (0, 160))
    points, boxes = torch.tensor([[3001, 1111]]).to(kind), torch.tensor([[31, 200, 1201, 777]]).to(kind)
    torch.testing.assert_close(placement.points_to_canvas(points).double(), placement.points_to_canvas(points.double()))
    torch.testing.assert_close(
        placement.boxes_to_image(boxes).double(), placement.boxes_to_image(boxes.double()), rtol=1e-6, atol=1e-3
    )
    around = window_around(boxes[0], (4096, 3072))
    torch.testing.assert_close(around.double(), window_around(boxes[0].double(), (4096, 3072)), rtol=1e-6, atol=1e-3)


def test_places_and_positions_are_not_rounded():
    assert pixel_positions(WIDE, WIDE, 0, "kornia").tolist() == list(range(WIDE))
    assert as_positions(torch.tensor([0.1], dtype=torch.float64)).dtype == torch.float64
    assert as_positions(torch.tensor([1]), torch.zeros(1, dtype=torch.float16)).dtype == torch.float32
