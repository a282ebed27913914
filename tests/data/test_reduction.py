"""Reduced copies of large pictures: equal to resampling the whole picture, and read in the right place."""

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.nn import functional

from semfov.data.large import _ArrayPicture, _TiffPicture
from semfov.data.windowed import resized
from tests.data.test_large import pixels


@pytest.fixture
def strips(monkeypatch):
    """Small pictures are large, and are read in strips of 20 or 24 rows."""
    monkeypatch.setattr("semfov.data.windowed._STRIP", 4700)
    monkeypatch.setattr("semfov.data.windowed._LARGE", 4700)


class Counting(_ArrayPicture):
    """A picture that counts the rows of the windows that are read."""

    def __init__(self, array):
        super().__init__(array)
        self.rows = []

    def pixels(self, box):
        self.rows.append(box[3] - box[1])
        return super().pixels(box)


def ramps(height, width):
    """A picture whose pixels tell their own place, which symmetric filters keep."""
    down, across = np.indices((height, width)).clip(max=255)
    return np.stack([across, down, across], -1).astype(np.uint8)


@pytest.mark.parametrize("size", [(90, 128), (200, 130), (130, 200), (416, 416), (128, 300)])
def test_bytes_are_resampled_as_by_floats_and_as_by_pillow(size):
    """Each axis is rounded to bytes, so results may differ by one."""
    array = pixels(170, 230)
    got = resized(torch.from_numpy(array).permute(2, 0, 1), size)
    assert got.dtype == torch.uint8
    assert got.is_contiguous(memory_format=torch.channels_last)
    floats = torch.from_numpy(array).permute(2, 0, 1)[None].double()
    expected = functional.interpolate(floats, size, mode="bilinear", antialias=True)
    assert float((got.double() - expected).abs().max()) <= 1.01
    pillow = np.asarray(Image.fromarray(array).resize(size[::-1], Image.Resampling.BILINEAR)).astype(int)
    assert abs(got[0].permute(1, 2, 0).numpy().astype(int) - pillow).max() <= 2


def test_a_copy_made_in_strips_equals_the_whole_picture_reduced(strips):
    array = pixels(128, 192)
    copies = _ArrayPicture(array)
    quarter = resized(torch.from_numpy(array).permute(2, 0, 1), (32, 48))[0]
    assert torch.equal(copies.read((0, 0, 192, 128), 4), quarter)
    assert torch.equal(copies.read((16, 8, 96, 72), 4), quarter[:, 2:18, 4:24])
    eighth = resized(quarter, (16, 24))[0]
    assert torch.equal(copies.read((16, 8, 96, 72), 8), eighth[:, 1:9, 2:12])
    assert torch.equal(copies.read((17, 9, 90, 70), 8), eighth[:, 1:9, 2:12])


@pytest.mark.parametrize("shape", [(131, 190), (129, 193), (97, 254)])
def test_windows_of_copies_show_the_place_they_are_of(strips, shape):
    """Also where the sides of the picture are no multiples of the reduction."""
    height, width = shape
    picture = _ArrayPicture(ramps(height, width))
    assert picture.reduction(10.0) == 4
    for x1, y1, x2, y2 in ((0, 0, width // 8 * 8, height // 8 * 8), (16, 8, 80, 72)):
        window = picture.read((x1, y1, x2, y2), 8)
        expected = ramps(height, width)[y1:y2, x1:x2].reshape((y2 - y1) // 8, 8, (x2 - x1) // 8, 8, 3).mean((1, 3))
        assert np.abs(window.permute(1, 2, 0).numpy() - expected)[1:-1, 1:-1].max() <= 1
    for box in ((0, 0, width, height), (width - 1, height - 1, width, height), (0, 0, 1, 1)):
        assert min(picture.read(box, 8).shape) >= 1


@pytest.mark.parametrize("size", [(2, 4000), (4000, 2), (1, 9000)])
def test_thin_pictures_have_copies(strips, size):
    width, height = size
    picture = _ArrayPicture(np.full((height, width, 3), 9, np.uint8))
    window = picture.read((0, 0, width, height), 8)
    assert window.shape == (3, max(1, height // 8), max(1, width // 8))
    assert bool((window == 9).all())


def test_copies_are_made_once_and_each_pixel_is_read_about_once(strips):
    copies = Counting(pixels(128, 192))
    for reduction in (16, 4, 8, 16):
        copies.read((0, 0, 64, 64), reduction)
    assert 128 <= sum(copies.rows) <= 128 * 1.5
    assert max(copies.rows) <= 24 + 8


def test_small_pictures_and_fine_windows_are_read_as_they_are(strips):
    small, large = _ArrayPicture(pixels(60, 70)), _ArrayPicture(pixels(128, 192))
    assert [small.reduction(ratio) for ratio in (1, 9, 40)] == [1, 1, 1]
    assert [large.reduction(ratio) for ratio in (0.3, 1, 4, 5.9, 6, 17, 40)] == [1, 1, 1, 1, 4, 8, 16]
    assert small.read((0, 0, 70, 60), 4).shape == (3, 60, 70)
    assert large.read((10, 10, 20, 20), 2).shape == (3, 10, 10)


def test_a_tiff_is_reduced_like_an_array(strips, tmp_path):
    array = pixels(128, 192)
    tifffile.imwrite(tmp_path / "a.tif", array, tile=(32, 32), photometric="rgb")
    box = (32, 16, 128, 112)
    assert torch.equal(_TiffPicture(tmp_path / "a.tif").read(box, 8), _ArrayPicture(array).read(box, 8))


def test_copies_of_very_large_pictures_begin_at_a_coarser_one(strips, monkeypatch):
    """Copies have at most 1600 pixels here."""
    monkeypatch.setattr("semfov.data.windowed._LARGEST", 1600)
    array = pixels(256, 384)
    picture = Counting(array)
    assert [picture.reduction(ratio) for ratio in (6, 11.9, 12, 24)] == [1, 1, 8, 16]
    assert torch.equal(
        picture.read((0, 0, 384, 256), 8), resized(torch.from_numpy(array).permute(2, 0, 1), (32, 48))[0]
    )
    assert max(picture.rows) < 256
    assert picture.read((0, 0, 384, 256), 16).shape == (3, 16, 24)
    assert picture.read((8, 8, 40, 40), 4).shape == (3, 32, 32)
