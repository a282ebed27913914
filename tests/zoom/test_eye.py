"""The eye for windows: what it shows, where boxes lie in the picture, what a border cuts."""

import numpy as np
import pytest
import torch
from PIL import Image

from semfov import InputError, WindowEye
from semfov.sensor.glimpse import glimpse, windows_at
from semfov.zoom.eye import BORDER
from tests.refusals import refused


def test_canvas_is_the_antialiased_glimpse_inside_its_border(detector):
    image = torch.rand(3, 300, 420, generator=torch.Generator().manual_seed(0))
    eye = WindowEye(detector)
    view = eye.open(image)
    fixation = torch.tensor([[199.5, 149.5, 0.64]])
    canvas, frames = eye.glimpse(view, fixation)
    box = windows_at(fixation[:, :2], fixation[:, 2], (128, 128))
    assert frames[0].tolist() == [100, 50, 300, 250, 0, 0, 128, 128]
    expected = glimpse((image * 255).round()[None] / 255, box, (128, 128))
    # Bytes are rounded once on the way.
    assert float((canvas - expected)[..., 3:-3, 3:-3].abs().max()) <= 1.01 / 255


def test_the_whole_picture_equals_a_resize_by_pillow(detector):
    pixels = np.random.default_rng(0).integers(256, size=(384, 512, 3), dtype=np.uint8)
    eye = WindowEye(detector)
    view = eye.open(pixels)
    canvas, _ = eye.glimpse(view, view.lattice.fixations(view.lattice.actions[:1]))
    expected = np.asarray(Image.fromarray(pixels).resize((128, 96), Image.Resampling.BILINEAR))
    got = (canvas[0, :, :96] * 255).permute(1, 2, 0).numpy()
    assert np.abs(got - expected).max() <= 1
    assert float(canvas[0, :, 96:].abs().max()) == 0


@pytest.mark.parametrize("magnification", [0.5, 1.0])
def test_boxes_are_in_pixels_of_the_picture(detector, picture, magnification):
    eye = WindowEye(detector)
    seen = eye.look(eye.open(picture), torch.tensor([[655.5, 335.5, magnification]]))
    red = seen.boxes[0][(seen.labels[0] == 1) & (seen.confidence[0] > 0.02)]
    assert len(red)
    covered = torch.cat([red[:, :2].amin(0), red[:, 2:].amax(0)])
    cell = 16 / magnification
    assert float((covered - torch.tensor([640.0, 320, 672, 352])).abs().max()) <= cell


def test_boxes_cut_by_the_window_are_kept_dropped_or_made_background(detector, picture):
    fixation = torch.tensor([[640.0 - 64 + 8 - 0.5, 335.5, 1.0]])  # its window ends in the red square
    keep, drop, nothing = (WindowEye(detector, cut=cut) for cut in ("keep", "drop", "background"))
    seen = keep.glance(keep.open(picture), fixation)
    assert bool(seen.cut.any())
    assert int(drop.look(drop.open(picture), fixation).count) == int(seen.detections.count) - int(seen.cut.sum())
    background = nothing.look(nothing.open(picture), fixation)
    assert float(background.confidence[seen.cut].max()) == 0
    torch.testing.assert_close(background.boxes, seen.detections.boxes)


def test_boxes_at_the_border_of_the_picture_do_not_count_as_cut(detector):
    image = torch.zeros(3, 256, 256)
    image[0, :32, :32] = 1
    eye = WindowEye(detector)
    assert not bool(eye.glance(eye.open(image), torch.tensor([[63.5, 63.5, 1.0]])).cut.any())


@pytest.mark.parametrize("fill", [0.0, 114 / 255, 0.5, 0.3])
def test_the_detector_gets_the_glimpse(detector, fill):
    """A padding that is no byte is kept, too."""
    detector.fill = fill
    canvases, propose = [], detector.propose
    detector.propose = lambda canvas: canvases.append(canvas) or propose(canvas)
    eye = WindowEye(detector)
    view = eye.open(torch.rand(3, 300, 420, generator=torch.Generator().manual_seed(0)))
    # Resampled, with padding, native pixels, enlarged.
    fixations = torch.tensor([[199.5, 149.5, 0.64], [0.0, 20.0, 0.5], [199.5, 149.5, 1.0], [30.0, 40.0, 2.0]])
    for some in (fixations, *fixations.split(1)):
        eye.look(view, some)
        canvas, _ = eye.glimpse(view, some)
        assert torch.equal(canvases[-1], canvas)
        assert canvas.is_contiguous()
        assert canvas.shape == (len(some), 3, 128, 128)
        assert 0.7 < float(canvas.max()) <= 1
    assert float(canvases[2][0, 0, 0, 0]) == pytest.approx(fill, abs=1e-7)


def test_windows_beside_the_picture_are_filled_and_show_its_nearest_pixel(detector, picture):
    eye = WindowEye(detector)
    canvas, frames = eye.glimpse(eye.open(picture), torch.tensor([[0.0, 0.0, 1.0]]))
    assert frames[0, :4].tolist() == [0, 0, 64, 64]
    assert float(canvas[0, :, :60, :60].abs().max()) == 0
    image = torch.rand(3, 60, 90, generator=torch.Generator().manual_seed(0))
    eye = WindowEye(detector)
    canvas, frames = eye.glimpse(eye.open(image), torch.tensor([[500.0, 400.0, 1.0], [-500.0, -400.0, 1.0]]))
    assert frames.tolist() == [[89, 59, 90, 60, 0, 0, 1, 1], [0, 0, 1, 1, 127, 127, 128, 128]]
    for number, (place, pixel) in enumerate((((0, 0), (59, 89)), ((127, 127), (0, 0)))):
        expected = torch.full((3, 128, 128), float(detector.fill))
        expected[:, *place] = (image[:, *pixel] * 255).round() / 255
        assert torch.equal(canvas[number], expected)


def test_detections_of_a_batch_equal_those_of_its_looks_one_by_one(detector, picture):
    eye = WindowEye(detector)
    view = eye.open(picture)
    fixations = torch.tensor([[655.5, 335.5, 1.0], [640.0 - 64 + 8 - 0.5, 335.5, 1.0], [511.5, 383.5, 0.125]])
    together = eye.glance(view, fixations)
    counts = set()
    for number in range(3):
        alone = eye.glance(view, fixations[number : number + 1])
        whole, one = together.detections, alone.detections
        found = int(one.count)
        assert found == int(whole.count[number]) > 0
        torch.testing.assert_close(whole.boxes[number, :found], one.boxes[0, :found])
        assert float(whole.boxes[number, found:].abs().sum()) == 0
        counts.add(found)
        assert torch.equal(together.cut[number, :found], alone.cut[0])
        assert not bool(together.cut[number, found:].any())
        assert torch.equal(together.windows[number], alone.windows[0])
    assert len(counts) > 1


def test_cut_boxes_are_those_that_reach_the_border_of_the_canvas_inside_the_picture(detector, picture):
    eye = WindowEye(detector)
    view = eye.open(picture)
    fixations = torch.tensor([[640.0 - 64 + 8 - 0.5, 335.5, 1.0], [60.0, 60.0, 1.0], [511.5, 383.5, 0.125]])
    seen = eye.glance(view, fixations)
    _, frames = eye.glimpse(view, fixations)
    wide, high = view.picture.size
    for number, (x1, y1, x2, y2, u1, _, u2, _) in enumerate(frames.tolist()):
        slack = BORDER * (x2 - x1) / (u2 - u1) + 1e-3
        for (a, b, c, d), kept, cut in zip(
            seen.detections.boxes[number].tolist(), seen.detections.mask[number], seen.cut[number], strict=True
        ):
            left, top, right, bottom = x1 and a <= x1 + slack, y1 and b <= y1 + slack, c >= x2 - slack, d >= y2 - slack
            assert bool(cut) == bool(kept and (left or top or (right and x2 < wide) or (bottom and y2 < high)))
    assert 0 < int(seen.cut.sum()) < int(seen.detections.count.sum())


def test_settings_include_the_treatment_of_cut_boxes(detector):
    assert WindowEye(detector).settings() != WindowEye(detector, cut="drop").settings()
    refused("unknown treatment of cut boxes", WindowEye, detector, cut="hide")
    refused("finest: expected a positive", WindowEye, detector, finest=0)
    eye = WindowEye(detector)
    refused("fixations: expected", eye.look, eye.open(torch.zeros(3, 64, 64)), torch.zeros(1, 4))
    refused("fixations: expected finite", eye.look, eye.open(torch.zeros(3, 64, 64)), torch.full((1, 3), torch.nan))
    with pytest.raises(InputError, match="fixations: expected positive magnifications"):
        eye.look(eye.open(torch.zeros(3, 64, 64)), torch.tensor([[3.0, 4.0, -1.0]]))
