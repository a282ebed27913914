"""Pictures whose values are no bytes: the values that are black and white, and the bands of files with many."""

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from semfov import as_image, read_image
from semfov.agents.picture import OpenedPicture
from semfov.data.large import open_large
from tests.data.test_large import pixels
from tests.refusals import refused, unusable


def whole(picture):
    return picture.pixels((0, 0, *picture.size))


def expected(values, low, high):
    return np.rint(np.clip((values.astype(float) - low) / (high - low), 0, 1) * 255).astype(np.uint8)


KINDS = {"u2": 3000, "i2": 3000, "f4": 40.0, "u4": 10**6, "f8": 1.0, "f2": 30.0}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("white", ["auto", (0.25, 0.5), 0.5])
def test_values_of_any_kind_are_shown_between_black_and_white(tmp_path, kind, white):
    """By windows, in a fovea, and as an array."""
    most = KINDS[kind]
    values = (pixels(96, 128)[..., 0] / 255 * most).astype(kind)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", tile=(32, 32))
    if white == "auto":
        low, high = np.percentile(values.astype(float), (1, 99))
    elif isinstance(white, tuple):
        low, high = white = tuple(each * most for each in white)
    else:
        low, high = 0, (white := white * most)
    want = expected(values, low, high)[..., None].repeat(3, -1)
    tolerance = 3 if white == "auto" else 1  # a file's percentiles are those of a sample
    got = whole(open_large(tmp_path / "a.tif", white=white))
    assert np.abs(got.astype(int) - want).max() <= tolerance
    assert np.abs(whole(open_large(values, white=white)).astype(int) - want).max() <= 1
    assert np.abs(as_image(values, white=white).permute(1, 2, 0).numpy() * 255 - want).max() <= 1
    seen = OpenedPicture.of(tmp_path / "a.tif", white=white).image(torch.zeros(1))[0].permute(1, 2, 0) * 255
    assert np.array_equal(seen.round().numpy().astype(np.uint8), got)


def test_pictures_that_pillow_reads_are_scaled_with_their_precision(tmp_path):
    values = np.linspace(100, 1100, 48 * 64).reshape(48, 64).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    want = torch.from_numpy(((values - 100.0) / 1000).astype(np.float32)).expand(3, -1, -1)
    assert torch.allclose(read_image(tmp_path / "a.png", white=(100, 1100)), want, atol=1e-6)
    assert np.array_equal(whole(open_large(tmp_path / "a.png", white=(100, 1100)))[..., 0], expected(values, 100, 1100))
    Image.fromarray(pixels()).save(tmp_path / "b.png")
    assert np.array_equal(whole(open_large(tmp_path / "b.png", white=(50, 100))), expected(pixels(), 50, 100))


@pytest.mark.parametrize("layout", ["contig", "separate"])
def test_bands_are_chosen_by_their_numbers(tmp_path, layout):
    values = np.concatenate([pixels(), pixels(seed=1)[..., :2]], -1)
    stored = np.moveaxis(values, -1, 0) if layout == "separate" else values
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="minisblack", planarconfig=layout, tile=(64, 48))
    for bands in ((4, 3, 2), (5, 5, 1)):
        got = whole(open_large(tmp_path / "a.tif", bands=bands))
        assert np.array_equal(got, values[..., [band - 1 for band in bands]])
    assert np.array_equal(whole(open_large(tmp_path / "a.tif", bands=4)), values[..., [3, 3, 3]])
    with pytest.warns(UserWarning, match="of 5 bands without names 1, 2 and 3 are shown"):
        assert np.array_equal(whole(open_large(tmp_path / "a.tif")), values[..., :3])
    refused("bands: expected numbers from 1 to 5", open_large, tmp_path / "a.tif", bands=6)


def test_no_data_are_no_values_of_a_range(tmp_path):
    values = np.full((96, 128), -9999, np.float32)
    values[:, 64:] = pixels(96, 64)[..., 0] / 10
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", extratags=[(42113, "s", 0, "-9999", True)])
    picture = open_large(tmp_path / "a.tif", white="auto")
    assert picture.nothing == (0, 0, 0)
    assert whole(picture)[:, 64:].std() > 50


def test_what_is_no_white_and_no_band_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.full((48, 64), 20.0, np.float32), photometric="minisblack")
    unusable("give white=", open_large, tmp_path / "a.tif")
    unusable("give white=", read_image, tmp_path / "a.tif")
    for white in (0, -3, (5, 5), (9, 2), (1, 2, 3), "bright", float("nan"), True):
        refused("white: expected", open_large, tmp_path / "a.tif", white=white)
    for bands in (0, (1, 2), (1, 2, 0), 1.5, True):
        refused("bands: expected", open_large, tmp_path / "a.tif", bands=bands)
    for white in (np.float32(40), np.int64(40), torch.tensor(40.0), np.array(40)):
        assert int(open_large(tmp_path / "a.tif", white=white).pixels((0, 0, 1, 1))[0, 0, 0]) == 128
    refused("bands: expected None but for TIFFs", open_large, np.zeros((4, 5, 3), np.uint8), bands=1)
