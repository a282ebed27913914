"""Large pictures read window by window, and their reduced copies: the same pixels of every source, in little memory."""

import logging
import os
import sys
import tracemalloc
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.nn import functional

from semfov import InputError, read_image
from semfov.data import decoded, images
from semfov.data.large import ArrayPicture, open_large
from semfov.data.rasters import RasterPicture
from semfov.data.tiff import TiffPicture
from semfov.data.windowed import LargePicture, resized
from tests.refusals import refused, unusable


def pixels(height=150, width=230, seed=0):
    return np.random.default_rng(seed).integers(256, size=(height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("large", [1 << 24, 1 << 15])  # pictures with more pixels are read from reduced copies
def test_a_picture_has_the_same_pixels_however_it_is_given(tmp_path, monkeypatch, large):
    monkeypatch.setattr("semfov.data.windowed._LARGE", large)
    smooth = Image.fromarray(pixels(8, 8)).resize((450, 330), Image.Resampling.BICUBIC)
    smooth.save(tmp_path / "a.jpg", quality=90)
    with Image.open(tmp_path / "a.jpg") as image:
        stored = image.convert("RGB")
    stored.save(tmp_path / "a.png")
    array = np.array(stored)
    np.save(tmp_path / "a.npy", array)
    tifffile.imwrite(tmp_path / "tiles.tif", array, tile=(64, 48), photometric="rgb", compression="zlib")
    tifffile.imwrite(tmp_path / "strips.tif", array, rowsperstrip=7, photometric="rgb")
    tensor = torch.from_numpy(array.copy()).permute(2, 0, 1)
    files = [tmp_path / name for name in ("a.jpg", "a.png", "tiles.tif")]
    sources = [stored, tensor, tensor / 255, np.load(tmp_path / "a.npy", mmap_mode="r"), str(tmp_path / "strips.tif")]
    for box in ((0, 0, 450, 330), (17, 33, 99, 120), (390, 100, 450, 330), (64, 64, 65, 65)):
        x1, y1, x2, y2 = box
        assert torch.equal(open_large(array).read(box), tensor[:, y1:y2, x1:x2])
        for source in (*files, *sources):
            picture = open_large(source)
            assert picture.size == (450, 330)
            assert picture.reduction(9) == (1 if large > 450 * 330 else 4)
            for reduction in (1, 8):
                assert torch.equal(picture.read(box, reduction), open_large(array).read(box, reduction))


def test_a_photograph_whose_decoding_was_interrupted_is_decoded_anew(tmp_path, monkeypatch):
    array = pixels(600, 20)
    Image.fromarray(array).save(tmp_path / "a.png")
    picture, over_white, seen = open_large(tmp_path / "a.png"), images._over_white, []

    def interrupted(rows):
        seen.append(rows)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return over_white(rows)

    monkeypatch.setattr(images, "_over_white", interrupted)
    monkeypatch.setattr(decoded, "ROWS_AT_ONCE", 100)
    with pytest.raises(KeyboardInterrupt):
        picture.pixels((0, 0, 20, 600))
    assert np.array_equal(picture.pixels((0, 0, 20, 600)), array)


@pytest.mark.parametrize("reader", [TiffPicture, RasterPicture])
def test_threads_read_windows_of_one_picture_at_once(tmp_path, reader):
    """Each gets the pixels of its window, and afterwards warnings and logs are what they were."""
    if reader is RasterPicture:
        pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    array, logs = pixels(512, 512), [logging.getLogger(name) for name in ("PIL", "tifffile")]
    tifffile.imwrite(tmp_path / "a.tif", array, tile=(32, 32), photometric="rgb", compression="zlib")
    picture, before = reader(tmp_path / "a.tif"), ([*warnings.filters], [log.level for log in logs])
    places = np.random.default_rng(1).integers(0, 380, size=(200, 2)).tolist()
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(8) as threads:
            windows = list(threads.map(lambda place: picture.pixels((*place, place[0] + 130, place[1] + 90)), places))
    finally:
        sys.setswitchinterval(usual)
    for (x, y), window in zip(places, windows, strict=True):
        assert np.array_equal(window, array[y : y + 90, x : x + 130])
    assert ([*warnings.filters], [log.level for log in logs]) == before


def test_rotated_photographs_are_read_upright(tmp_path):
    array = pixels()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(array).save(tmp_path / "turned.png", exif=exif)
    picture = open_large(tmp_path / "turned.png")
    assert picture.size == (150, 230)
    assert np.array_equal(picture.pixels((0, 0, 150, 230)), np.rot90(array, -1))


def test_windows_of_a_memory_mapped_file_need_little_memory(tmp_path):
    side = 6000
    mapped = np.lib.format.open_memmap(tmp_path / "large.npy", mode="w+", dtype=np.uint8, shape=(side, side, 3))
    mapped[2000:2100, 3000:3100] = 200
    picture = ArrayPicture(mapped)
    tracemalloc.start()
    window = picture.read((2900, 1900, 3316, 2316))
    overview = picture.read((0, 0, side, side), 8)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert overview.shape == (3, side // 8, side // 8)
    assert int(window.max()) == 200
    assert peak < 120e6 < side * side * 3 * 4


def test_tiles_are_decoded_one_at_a_time(tmp_path):
    array = np.zeros((4096, 4096, 3), np.uint8)
    array[1000:1100, 2000:2100] = 77
    tifffile.imwrite(tmp_path / "large.tif", array, tile=(256, 256), photometric="rgb", compression="zlib")
    del array
    picture = TiffPicture(tmp_path / "large.tif")
    tracemalloc.start()
    window = picture.read((1900, 900, 2316, 1316))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert int(window.sum()) == 77 * 3 * 100 * 100
    assert peak < 4e6


def test_unreadable_files_and_windows_outside_the_picture_are_refused(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    unusable("not an image in a format that is read", open_large, tmp_path / "a.jpg")
    unusable("no such file", open_large, tmp_path / "b.jpg")
    for suffix in ("jpg", "tif"):
        (tmp_path / f"folder.{suffix}").mkdir()
        unusable("expected a file, got a folder", open_large, tmp_path / f"folder.{suffix}")
        os.mkfifo(tmp_path / f"pipe.{suffix}")
        unusable("expected a file, got a pipe", open_large, tmp_path / f"pipe.{suffix}")
    refused("picture: expected", open_large, 3)
    refused("picture: expected bytes, 16-bit numbers or floats", open_large, np.zeros((4, 4, 3), np.int64))
    with pytest.raises(InputError, match="unknown order of channels 'bgra'; did you mean 'bgr'"):
        open_large(np.zeros((4, 4, 3), np.uint8), color="bgra")
    refused("box: expected a window inside 4 × 4 pixels", open_large(torch.zeros(3, 4, 4)).read, (0, 0, 5, 4))


@pytest.mark.parametrize("side", [2, 5000])
def test_a_reader_of_ones_own_that_gives_other_pixels_is_refused(side):
    class Own(LargePicture):
        size = (side, side)

        def pixels(self, box):
            return np.zeros((1, 1, 3), np.float32)

    refused(r"pixels: expected bytes of shape \(.*, 3\), got float32 of \(1, 1, 3\)", Own().read, (0, 0, side, side), 4)


def test_truncated_files_are_refused(tmp_path):
    Image.fromarray(pixels()).save(tmp_path / "a.jpg")
    tifffile.imwrite(tmp_path / "a.tif", pixels(), tile=(64, 48), photometric="rgb", compression="zlib")
    for name in ("a.jpg", "a.tif"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: len(whole) // 2])
        unusable(r"a\.(jpg|tif): .*cannot be", open_large(tmp_path / name).pixels, (0, 0, 230, 150))


def test_a_tiff_with_two_widths_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", pixels())
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        count = file.pages[0].tags["ImageWidth"].offset + 4
    content = bytearray((tmp_path / "a.tif").read_bytes())
    content[count] = 2
    (tmp_path / "a.tif").write_bytes(content)
    unusable(r"a\.tif: truncated, damaged", open_large, tmp_path / "a.tif")


@pytest.mark.parametrize("photometric", ["minisblack", "miniswhite", "rgb"])
def test_sixteen_bit_tiffs_are_scaled_by_their_white(tmp_path, photometric):
    """Tile by tile and as a whole, against the values that were written."""
    shape = (50, 70, 3) if photometric == "rgb" else (50, 70)
    array = np.random.default_rng(0).integers(65536, size=shape, dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", array, tile=(16, 32), photometric=photometric, compression="zlib")
    white = array.reshape(50, 70, -1) / 65535
    white = 1 - white if photometric == "miniswhite" else white
    got = open_large(tmp_path / "a.tif").pixels((3, 5, 60, 44))
    assert np.abs(got / 255 - white[5:44, 3:60]).max() <= 0.5 / 255 + 1e-6
    if photometric != "rgb":
        np.testing.assert_allclose(read_image(tmp_path / "a.tif")[0].numpy(), white[..., 0], atol=1e-6)


def test_a_tiff_is_read_by_pillow_where_tifffile_is_missing_or_leaves_it(tmp_path, monkeypatch):
    array = pixels()
    colours = Image.fromarray(array).quantize(16)
    colours.save(tmp_path / "palette.tif")
    expected = np.asarray(colours.convert("RGB"))
    assert np.array_equal(open_large(tmp_path / "palette.tif").pixels((0, 0, 230, 150)), expected)
    Image.fromarray(array).save(tmp_path / "packed.tif", compression="tiff_lzw")  # tifffile needs a codec for it
    assert np.array_equal(open_large(tmp_path / "packed.tif").pixels((0, 0, 230, 150)), array)
    tifffile.imwrite(tmp_path / "a.tif", array, photometric="rgb")
    monkeypatch.setitem(sys.modules, "tifffile", None)
    assert np.array_equal(open_large(tmp_path / "a.tif").pixels((0, 0, 230, 150)), array)
    unusable("pip install tifffile", TiffPicture, tmp_path / "a.tif")


def test_signed_numbers_of_eight_bits_need_their_black_and_white(tmp_path):
    values = np.arange(-128, 128, dtype=np.int8).reshape(16, 16)
    tifffile.imwrite(tmp_path / "a.tif", values)
    for read in (read_image, open_large):
        unusable(r"expected 8 (bits without a sign|or 16 bits, got int8)", read, tmp_path / "a.tif")
    shown = open_large(tmp_path / "a.tif", white=(-128, 127)).pixels((0, 0, 16, 16))
    assert np.array_equal(shown[..., 0].ravel(), np.arange(256))


@pytest.fixture
def strips(monkeypatch):
    """Small pictures are large, and are read in strips of 20 or 24 rows."""
    monkeypatch.setattr("semfov.data.windowed._STRIP", 4700)
    monkeypatch.setattr("semfov.data.windowed._LARGE", 4700)


class Counting(ArrayPicture):
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
    copies = ArrayPicture(array)
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
    picture = ArrayPicture(ramps(height, width))
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
    picture = ArrayPicture(np.full((height, width, 3), 9, np.uint8))
    window = picture.read((0, 0, width, height), 8)
    assert window.shape == (3, max(1, height // 8), max(1, width // 8))
    assert bool((window == 9).all())


def test_copies_are_made_once_and_each_pixel_is_read_about_once(strips):
    copies = Counting(pixels(128, 192))
    for reduction in (16, 4, 8, 16):
        copies.read((0, 0, 64, 64), reduction)
    assert 128 <= sum(copies.rows) <= 128 * 1.5
    assert max(copies.rows) <= 24 + 8


def test_small_pictures_are_read_as_they_are_and_a_tiff_is_reduced_like_an_array(strips, tmp_path):
    small, large = ArrayPicture(pixels(60, 70)), ArrayPicture(pixels(128, 192))
    assert [small.reduction(ratio) for ratio in (1, 9, 40)] == [1, 1, 1]
    assert [large.reduction(ratio) for ratio in (0.3, 1, 4, 5.9, 6, 17, 40)] == [1, 1, 1, 1, 4, 8, 16]
    assert small.read((0, 0, 70, 60), 4).shape == (3, 60, 70)
    assert large.read((10, 10, 20, 20), 2).shape == (3, 10, 10)
    array = pixels(128, 192)
    tifffile.imwrite(tmp_path / "a.tif", array, tile=(32, 32), photometric="rgb")
    box = (32, 16, 128, 112)
    assert torch.equal(TiffPicture(tmp_path / "a.tif").read(box, 8), ArrayPicture(array).read(box, 8))


def test_copies_of_very_large_pictures_begin_at_a_coarser_one(strips, monkeypatch):
    """Copies have at most 1600 pixels here."""
    monkeypatch.setattr("semfov.data.windowed._LARGEST", 1600)
    array = pixels(256, 384)
    picture = Counting(array)
    assert [picture.reduction(ratio) for ratio in (6, 11.9, 12, 24)] == [4, 4, 8, 16]
    assert torch.equal(
        picture.read((0, 0, 384, 256), 8), resized(torch.from_numpy(array).permute(2, 0, 1), (32, 48))[0]
    )
    assert max(picture.rows) < 256
    assert picture.read((0, 0, 384, 256), 16).shape == (3, 16, 24)
    assert {*picture._copies} == {8, 16}


def test_windows_finer_than_the_largest_copy_are_reduced_as_they_are_read(strips, monkeypatch):
    """They are what a copy would have, and no strip has more pixels than one of a copy."""
    array = pixels(256, 384)
    of_copy = ArrayPicture(array).read((0, 0, 384, 256), 4)
    monkeypatch.setattr("semfov.data.windowed._LARGEST", 1600)
    picture = Counting(array)
    for box in ((0, 0, 384, 256), (16, 8, 96, 72), (200, 100, 384, 256)):
        x1, y1, x2, y2 = (side // 4 for side in box)
        assert torch.equal(picture.read(box, 4), of_copy[:, y1:y2, x1:x2])
    assert not picture._copies
    assert max(picture.rows) < 256
    thin = ArrayPicture(np.full((1, 90_000, 3), 9, np.uint8))
    assert thin.read((89_990, 0, 90_000, 1), 4).unique().tolist() == [9]
