"""The zooming eye: what it shows, where boxes lie in the picture, what a border cuts."""

import numpy as np
import pytest
import torch
from PIL import Image

from semfov.errors import InputError
from semfov.sensor.glimpse import glimpse, windows_at
from semfov.zoom import ZoomEye


def test_canvas_is_the_antialiased_glimpse_inside_its_border(detector):
    image = torch.rand(3, 300, 420, generator=torch.Generator().manual_seed(0))
    eye = ZoomEye(detector)
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
    eye = ZoomEye(detector)
    view = eye.open(pixels)
    canvas, _ = eye.glimpse(view, view.lattice.fixations(view.lattice.actions[:1]))
    expected = np.asarray(Image.fromarray(pixels).resize((128, 96), Image.Resampling.BILINEAR))
    got = (canvas[0, :, :96] * 255).permute(1, 2, 0).numpy()
    assert np.abs(got - expected).max() <= 1
    assert float(canvas[0, :, 96:].abs().max()) == 0


@pytest.mark.parametrize("magnification", [0.5, 1.0])
def test_boxes_are_in_pixels_of_the_picture(detector, picture, magnification):
    eye = ZoomEye(detector)
    seen = eye.look(eye.open(picture), torch.tensor([[655.5, 335.5, magnification]]))
    red = seen.boxes[0][(seen.labels[0] == 1) & (seen.confidence[0] > 0.02)]
    assert len(red)
    covered = torch.cat([red[:, :2].amin(0), red[:, 2:].amax(0)])
    cell = 16 / magnification
    assert float((covered - torch.tensor([640.0, 320, 672, 352])).abs().max()) <= cell


def test_a_batch_equals_its_looks_one_by_one(detector, picture):
    eye = ZoomEye(detector)
    view = eye.open(picture)
    fixations = torch.tensor([[655.5, 335.5, 1.0], [159.5, 95.5, 0.5], [511.5, 383.5, 0.125]])
    together = eye.look(view, fixations)
    for number in range(3):
        alone = eye.look(view, fixations[number : number + 1])
        count = int(alone.count)
        assert count == int(together.count[number])
        torch.testing.assert_close(together.boxes[number, :count], alone.boxes[0, :count])
        torch.testing.assert_close(together.scores[number, :count], alone.scores[0, :count])


def test_boxes_cut_by_the_window_are_kept_dropped_or_made_background(detector, picture):
    fixation = torch.tensor([[640.0 - 64 + 8 - 0.5, 335.5, 1.0]])  # its window ends in the red square
    keep, drop, nothing = (ZoomEye(detector, cut=cut) for cut in ("keep", "drop", "background"))
    seen = keep.glance(keep.open(picture), fixation)
    assert bool(seen.cut.any())
    assert int(drop.look(drop.open(picture), fixation).count) == int(seen.detections.count) - int(seen.cut.sum())
    background = nothing.look(nothing.open(picture), fixation)
    assert float(background.confidence[seen.cut].max()) == 0
    torch.testing.assert_close(background.boxes, seen.detections.boxes)


def test_boxes_at_the_border_of_the_picture_do_not_count_as_cut(detector):
    image = torch.zeros(3, 256, 256)
    image[0, :32, :32] = 1
    eye = ZoomEye(detector)
    assert not bool(eye.glance(eye.open(image), torch.tensor([[63.5, 63.5, 1.0]])).cut.any())


def test_the_canvas_is_filled_beyond_the_picture(detector, picture):
    eye = ZoomEye(detector)
    canvas, frames = eye.glimpse(eye.open(picture), torch.tensor([[0.0, 0.0, 1.0]]))
    assert frames[0, :4].tolist() == [0, 0, 64, 64]
    assert float(canvas[0, :, :60, :60].abs().max()) == 0


def test_settings_include_the_treatment_of_cut_boxes(detector):
    assert ZoomEye(detector).settings() != ZoomEye(detector, cut="drop").settings()
    with pytest.raises(InputError, match="unknown treatment of cut boxes"):
        ZoomEye(detector, cut="hide")
    with pytest.raises(InputError, match="finest: expected a positive"):
        ZoomEye(detector, finest=0)
    eye = ZoomEye(detector)
    with pytest.raises(InputError, match="fixations: expected"):
        eye.look(eye.open(torch.zeros(3, 64, 64)), torch.zeros(1, 4))
    with pytest.raises(InputError, match="fixations: expected finite"):
        eye.look(eye.open(torch.zeros(3, 64, 64)), torch.full((1, 3), torch.nan))
    with pytest.raises(InputError, match="fixations: expected positive magnifications"):
        eye.look(eye.open(torch.zeros(3, 64, 64)), torch.tensor([[3.0, 4.0, -1.0]]))
