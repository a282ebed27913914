"""Rasters that GDAL reads: the pixels of other readers, overviews where there are some, and refusals."""

import sys

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from semfov.data.large import _ArrayPicture, _RasterPicture, _TiffPicture, open_large, picture_size
from semfov.errors import DataError
from semfov.paths.georeference import georeference
from tests.data.test_large import pixels
from tests.refusals import refused, unusable


@pytest.fixture
def rasterio():
    return pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")


@pytest.fixture
def large(monkeypatch):
    """Small pictures are large."""
    monkeypatch.setattr("semfov.data.windowed._LARGE", 4700)


def write(rasterio, path, array, overviews=(), **options):
    """A GeoTIFF of an array `(H, W, bands)`, in blocks of 64 × 64 pixels."""
    height, width, count = array.shape
    shape = {"height": height, "width": width, "count": count, "dtype": array.dtype}
    place = {"crs": "EPSG:3857", "transform": rasterio.transform.Affine(0.5, 0.0, 1e6, 0.0, -0.5, 6e6)}
    blocks = {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate"}
    with rasterio.open(path, "w", driver="GTiff", **shape, **place, **{**blocks, **options}) as file:
        file.write(np.moveaxis(array, -1, 0))
        if overviews:
            file.build_overviews(list(overviews), rasterio.enums.Resampling.average)
    return path


@pytest.mark.parametrize("box", [(0, 0, 230, 150), (17, 33, 99, 120), (229, 149, 230, 150)])
def test_windows_have_the_pixels_of_the_array(rasterio, tmp_path, box):
    array = pixels()
    expected = _ArrayPicture(array).read(box)
    planes = write(rasterio, tmp_path / "planes.tif", array, interleave="band")
    wide = write(rasterio, tmp_path / "wide.tif", array.astype(np.uint16) * 257)
    for path in (planes, wide, write(rasterio, tmp_path / "copies.tif", array, (2, 4))):
        picture = _RasterPicture(path)
        assert picture.size == picture_size(path) == (230, 150)
        assert torch.equal(picture.read(box), expected)
    grey = _RasterPicture(write(rasterio, tmp_path / "grey.tif", array[..., :1]))
    assert torch.equal(grey.read(box), expected[:1].expand(3, -1, -1))


def test_channels_are_the_bands_with_their_names(rasterio, tmp_path):
    array = pixels()
    five = np.concatenate([array[..., :1] // 2, array[..., ::-1], array[..., :1] // 3], -1)
    path = write(rasterio, tmp_path / "five.tif", five)
    with rasterio.open(path, "r+") as file:
        meaning = rasterio.enums.ColorInterp
        file.colorinterp = meaning.undefined, meaning.blue, meaning.green, meaning.red, meaning.undefined
    for reader in (_RasterPicture, _TiffPicture):
        assert np.array_equal(reader(path).pixels((5, 6, 50, 40)), array[6:40, 5:50])


def test_coarse_windows_come_from_the_overviews(rasterio, large, tmp_path):
    """The overviews of this file are darker than its pixels, so that it is seen where windows come from."""
    array = np.full((256, 384, 3), 200, np.uint8)
    path = write(rasterio, tmp_path / "a.tif", array, (2, 4, 8))
    with rasterio.open(path, "r+", overview_level=1) as file:  # reduced by 4
        file.write(np.full((3, 64, 96), 50, np.uint8))
    picture = open_large(path)
    assert isinstance(picture, _RasterPicture)
    assert picture.reduction(6) == 4
    assert set(picture.read((64, 32, 192, 160), 4).flatten().tolist()) == {50}
    assert set(picture.read((64, 32, 192, 160), 8).flatten().tolist()) == {200}
    assert set(picture.read((64, 32, 192, 160)).flatten().tolist()) == {200}
    assert picture.read((1, 1, 9, 9), 4).shape == (3, 3, 3)


def test_coarse_windows_show_the_place_they_are_of(rasterio, large, tmp_path):
    down, across = np.indices((240, 250))
    array = np.stack([across, down, across], -1).astype(np.uint8)
    with_copies = open_large(write(rasterio, tmp_path / "a.tif", array, (2, 4, 8)))
    without = _RasterPicture(write(rasterio, tmp_path / "b.tif", array))
    for box in ((16, 8, 80, 72), (0, 0, 248, 240)):
        expected = _ArrayPicture(array).read(box, 8)
        assert torch.equal(without.read(box, 8), expected)
        assert int((with_copies.read(box, 8).int() - expected.int()).abs().max()) <= 2


def test_objects_of_a_mosaic_of_files_have_its_coordinates(rasterio, tmp_path):
    """Both files of the mosaic lie side by side, half a metre a pixel from 1,000 km east of Greenwich."""
    write(rasterio, tmp_path / "a.tif", pixels())
    sides = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="1">a.tif</SourceFilename><SourceBand>{{band}}</SourceBand>'
        '<SrcRect xOff="0" yOff="0" xSize="230" ySize="150"/>'
        f'<DstRect xOff="{230 * n}" yOff="0" xSize="230" ySize="150"/></SimpleSource>'
        for n in range(2)
    )
    bands = "".join(
        f'<VRTRasterBand dataType="Byte" band="{n}">{sides.format(band=n)}</VRTRasterBand>' for n in (1, 2, 3)
    )
    (tmp_path / "b.vrt").write_text(
        f'<VRTDataset rasterXSize="460" rasterYSize="150"><SRS>EPSG:3857</SRS>'
        f"<GeoTransform>1e6, 0.5, 0, 6e6, 0, -0.5</GeoTransform>{bands}</VRTDataset>"
    )
    picture = open_large(tmp_path / "b.vrt")
    assert picture.size == picture_size(tmp_path / "b.vrt") == (460, 150)
    assert np.array_equal(picture.pixels((220, 10, 240, 90)), np.tile(pixels(), (1, 2, 1))[10:90, 220:240])
    place = georeference(str(tmp_path / "b.vrt"))
    longitude = np.degrees((1_000_000 + 0.5 * 400) / 6378137.0)
    assert place(np.array([[400.0, 7.0]]))[0, 0] == pytest.approx(longitude, abs=1e-9)


def test_other_tiffs_are_read_as_before(rasterio, tmp_path):
    assert not isinstance(open_large(write(rasterio, tmp_path / "a.tif", pixels())), _RasterPicture)
    planes = write(rasterio, tmp_path / "b.tif", pixels(), interleave="band")
    assert np.array_equal(open_large(planes).pixels((5, 6, 50, 40)), pixels()[6:40, 5:50])


def test_what_is_no_picture_is_refused(rasterio, tmp_path):
    with pytest.raises(DataError, match=r"expected bands of 8 or 16 bits, got float32; give white="):
        _RasterPicture(write(rasterio, tmp_path / "a.tif", pixels().astype(np.float32)))
    palette = write(rasterio, tmp_path / "b.tif", pixels()[..., :1], photometric="palette")
    with rasterio.open(palette, "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0, 255), 1: (255, 0, 0, 255)})
    unusable("got a palette", _RasterPicture, palette)
    (tmp_path / "c.vrt").write_text("no raster")
    unusable("expected the XML text of a mosaic", open_large, tmp_path / "c.vrt")
    unusable("no such file", open_large, tmp_path / "d.jp2")
    copies = write(rasterio, tmp_path / "e.tif", pixels(), (2, 4))
    refused("box: expected a window inside 230 × 150 pixels", _RasterPicture(copies).read, (0, 0, 231, 150), 4)


def test_a_missing_rasterio_is_named(tmp_path, monkeypatch):
    """Only where there is no other reader: TIFFs with overviews are still read without it."""
    array = pixels()
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(array, tile=(64, 48), photometric="rgb")
        file.write(array[::2, ::2], tile=(64, 48), photometric="rgb", subfiletype=1)
    Image.fromarray(array).save(tmp_path / "a.vrt", "PNG")
    monkeypatch.setitem(sys.modules, "rasterio", None)
    unusable(r"pip install \"semfov\[geo\]\"", open_large, tmp_path / "a.vrt")
    assert np.array_equal(open_large(tmp_path / "a.tif").pixels((3, 4, 99, 80)), array[4:80, 3:99])
