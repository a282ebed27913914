"""The product of what a picture's file may be: every reader shows what its numbers say."""

import itertools

import numpy as np
import pytest
import tifffile

from semfov import read_image
from semfov.data import windowed
from semfov.data.large import open_large
from tests.data.test_large import pixels
from tests.refusals import unusable

HIGH, WIDE = 150, 230
LAYOUTS = {
    "tiles": {"tile": (64, 48), "compression": "zlib"},
    "strips": {"rowsperstrip": 17},
    "a strip": {"rowsperstrip": HIGH},
    "a packed strip": {"rowsperstrip": HIGH, "compression": "zlib"},
    "planes": {"planarconfig": "separate", "tile": (64, 48)},
    "planes of a strip": {"planarconfig": "separate", "rowsperstrip": HIGH},
}
VARIANTS = [
    (*given, alpha)
    for *given, alpha in itertools.product((8, 16), LAYOUTS, ("minisblack", "miniswhite", "rgb"), (0, 1), (None, 1, 2))
    if given[2] == "rgb" or (alpha is None and "planes" not in given[1])
]


@pytest.mark.parametrize(("bits", "layout", "photometric", "copies", "alpha"), VARIANTS)
def test_a_tiff_has_one_answer(tmp_path, bits, layout, photometric, copies, alpha):
    """Black and white, colours, an alpha that is multiplied already (1) or not (2), with reduced copies or without."""
    if copies:
        pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    most, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    values = pixels(HIGH, WIDE).astype(kind) * (most // 255)
    if photometric != "rgb":
        values = values[..., 0]
    want = values / most
    if photometric == "miniswhite":
        want = 1 - want
    options = {"photometric": photometric, **LAYOUTS[layout]}
    if alpha is not None:
        share = pixels(HIGH, WIDE, 1)[..., :1].astype(kind) * (most // 255)
        if alpha == 1:
            values = (values.astype(np.int64) * share // most).astype(kind)
            want = values / most + 1 - share / most
        else:
            want = want * share / most + 1 - share / most
        values = np.concatenate([values, share], -1)
        options["extrasamples"] = [alpha]
    stored = np.moveaxis(values, -1, 0) if "planes" in layout else values
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(stored, **options)
        if copies:
            options["rowsperstrip" if "rowsperstrip" in options else "tile"] = HIGH if "strip" in layout else (64, 48)
            half = stored[:, ::2, ::2] if "planes" in layout else stored[::2, ::2]
            file.write(half, subfiletype=1, **options)
    want = np.broadcast_to(want if want.ndim == 3 else want[..., None], (HIGH, WIDE, 3)) * 255
    picture = open_large(tmp_path / "a.tif")
    whole = picture.pixels((0, 0, WIDE, HIGH))
    assert np.abs(whole - want).max() <= 1.01
    assert np.array_equal(picture.pixels((33, 21, 120, 149)), whole[21:149, 33:120])
    fovea = read_image(tmp_path / "a.tif").permute(1, 2, 0).numpy() * 255
    assert np.abs(fovea - want).max() <= 1.01


@pytest.mark.parametrize("copies", [(), (2, 4)])
def test_a_mask_in_a_tiff_is_white(tmp_path, copies):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    array = pixels(HIGH, WIDE)
    mask = np.full((HIGH, WIDE), 255, np.uint8)
    mask[40:90, 60:200] = 0
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            tmp_path / "a.tif", "w", driver="GTiff", width=WIDE, height=HIGH, count=3, dtype="uint8", tiled=True,
            blockxsize=64, blockysize=64, photometric="rgb", transform=rasterio.transform.Affine.scale(2.0),
        ) as file,
    ):  # fmt: skip
        file.write(np.moveaxis(array, -1, 0))
        file.write_mask(mask)
        if copies:
            file.build_overviews(copies)
    want = np.where(mask[..., None] > 0, array, 255)
    picture = open_large(tmp_path / "a.tif")
    assert np.array_equal(picture.pixels((0, 0, WIDE, HIGH)), want)
    assert np.array_equal((read_image(tmp_path / "a.tif").permute(1, 2, 0).numpy() * 255).round(), want)
    assert picture.nothing == (255, 255, 255)


@pytest.mark.parametrize("kind", ["OME", "ImageJ"])
@pytest.mark.parametrize("bits", [8, 16])
def test_pages_that_are_channels(tmp_path, kind, bits):
    """Three are red, green and blue; of more a warning tells which are shown, and `bands` chooses."""
    values = np.moveaxis(pixels(HIGH, WIDE), -1, 0).astype(f"uint{bits}") * (1 if bits == 8 else 257)
    path = tmp_path / ("a.ome.tif" if kind == "OME" else "a.tif")
    options = {"imagej": True} if kind == "ImageJ" else {"photometric": "minisblack"}
    tifffile.imwrite(path, values, metadata={"axes": "CYX"}, **options)
    picture = open_large(path)
    assert np.array_equal(picture.pixels((3, 4, 200, 99)), pixels(HIGH, WIDE)[4:99, 3:200])
    assert np.array_equal((read_image(path).permute(1, 2, 0).numpy() * 255).round(), pixels(HIGH, WIDE))
    tifffile.imwrite(path, np.concatenate([values, values[:1]]), metadata={"axes": "CYX"}, **options)
    with pytest.warns(UserWarning, match="of 4 bands without names 1, 2 and 3 are shown"):
        open_large(path)
    chosen = open_large(path, bands=(4, 3, 2)).pixels((0, 0, WIDE, HIGH))
    assert np.array_equal(chosen, pixels(HIGH, WIDE)[..., [0, 2, 1]])


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize("kind", ["png", "ppm"])
def test_sixteen_bits_a_channel(tmp_path, kind, count):
    """Of photographs, too: by `white` exactly, and with a warning where few of their values are used."""
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    if kind == "ppm" and count in (2, 4):
        pytest.skip("PPM has no alpha")
    values = pixels(HIGH, WIDE).astype(np.uint16)[..., : 1 if count < 3 else 3] * 16
    stored = values
    if count in (2, 4):
        stored = np.concatenate([values, np.full((HIGH, WIDE, 1), 65535, np.uint16)], -1)
    path = tmp_path / f"a.{kind}"
    if kind == "png":
        shape = {"width": WIDE, "height": HIGH, "count": count, "dtype": "uint16"}
        with rasterio.open(path, "w", driver="PNG", transform=rasterio.transform.Affine.scale(2.0), **shape) as file:
            file.write(np.moveaxis(stored, -1, 0))
        path.with_name("a.png.aux.xml").unlink()
    else:
        path.write_bytes(f"P{6 if count == 3 else 5}\n{WIDE} {HIGH}\n65535\n".encode() + stored.astype(">u2").tobytes())
    want = np.broadcast_to(values / 4080, (HIGH, WIDE, 3))
    exact = read_image(path, white=4080).permute(1, 2, 0).numpy()
    assert np.abs(exact - want).max() < 1e-6
    assert np.abs(open_large(path, white=4080).pixels((0, 0, WIDE, HIGH)) - want * 255).max() <= 0.51
    for read in (read_image, lambda path: open_large(path).read((0, 0, 5, 5))):
        with pytest.warns(UserWarning, match=r"values from 0 to 4080 of 16 bits.* white=4080"):
            read(path)


def test_the_largest_value_of_a_ppm_is_white(tmp_path):
    values = pixels(HIGH, WIDE).astype(np.uint16) * 16
    path = tmp_path / "a.ppm"
    path.write_bytes(b"P6\n# 12 bits\n%d %d\n4080\n" % (WIDE, HIGH) + values.astype(">u2").tobytes())
    assert np.allclose(read_image(path).permute(1, 2, 0).numpy(), values / 4080, atol=1e-6)
    path.write_bytes(path.read_bytes()[:-100])
    unusable("truncated", read_image, path)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_a_strip_is_not_decoded_for_each_window(tmp_path, compression, monkeypatch):
    """One strip for the whole picture is read row by row, or decoded once."""
    tifffile.imwrite(tmp_path / "a.tif", pixels(900, 800), photometric="rgb", rowsperstrip=900, compression=compression)
    picture = open_large(tmp_path / "a.tif")
    read, tiles = [], type(picture._tiles)
    stored = tiles.read_bytes
    monkeypatch.setattr(tiles, "read_bytes", lambda self, at, count: read.append(count) or stored(self, at, count))
    for top in range(0, 900, 90):
        assert np.array_equal(picture.pixels((50, top, 150, top + 90)), pixels(900, 800)[top : top + 90, 50:150])
    assert sum(read) <= 2 * 900 * 800 * 3


@pytest.mark.parametrize("nodata", [None, 7])
def test_what_a_tiff_does_not_store_is_without_data(tmp_path, nodata):
    tags = [] if nodata is None else [(42113, "s", 0, str(nodata), True)]
    tiles = (tile for tile in [np.full((16, 16), 99, np.uint8), None, None, None])
    tifffile.imwrite(
        tmp_path / "a.tif", tiles, shape=(32, 32), dtype=np.uint8, tile=(16, 16), extratags=tags, compression="zlib",
        photometric="minisblack",
    )  # fmt: skip
    picture = open_large(tmp_path / "a.tif")
    assert picture.pixels((0, 0, 32, 32))[..., 0].flatten().tolist().count(nodata or 0) == 3 * 256
    assert picture.holds((0, 0, 16, 32))
    assert not picture.holds((16, 0, 32, 32))


@pytest.mark.parametrize("kept", ["both ends", "a few", "all", "one"])
def test_a_reduced_copy_of_what_is_stored_is_that_of_the_whole_picture(tmp_path, kept, monkeypatch):
    """However the picture is cut into blocks: its twin stores all tiles."""
    monkeypatch.setattr(windowed, "_LARGE", 0)
    monkeypatch.setattr(windowed, "_STRIP", 1 << 13)
    monkeypatch.setattr(windowed, "_PIECE", 16)
    side, grid = 256, np.indices((16, 16))
    stored = {
        "both ends": (grid[1] == 0) | (grid[1] == 15),
        "a few": np.random.default_rng(0).random((16, 16)) < 0.1,
        "all": np.ones((16, 16), np.bool_),
        "one": np.zeros((16, 16), np.bool_),
    }[kept]
    stored[0, 0] = True  # tifffile learns from the first tile what the others are
    values = pixels(side, side)[..., 0] * np.kron(stored, np.ones((16, 16), np.uint8))
    cut = values.reshape(16, 16, 16, 16).swapaxes(1, 2).reshape(-1, 16, 16)
    tiles = (tile if is_stored else None for tile, is_stored in zip(cut, stored.flat, strict=True))
    options = {"tile": (16, 16), "photometric": "minisblack", "shape": (side, side), "dtype": np.uint8}
    tifffile.imwrite(tmp_path / "sparse.tif", tiles, **options)
    tifffile.imwrite(tmp_path / "whole.tif", iter(cut), **options)
    sparse, whole = (open_large(tmp_path / f"{name}.tif").read((0, 0, side, side), 4) for name in ("sparse", "whole"))
    assert sparse.shape == (3, 64, 64)
    assert np.array_equal(sparse, whole)


@pytest.mark.parametrize("kind", ["webp", "lerc", "12 bits", "zstd"])
def test_compressions_that_gdal_has(tmp_path, kind):
    """Read by windows as by the fovea, though Pillow and `tifffile` have no decoder of some of them."""
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    values, options = pixels(HIGH, WIDE), {"compress": kind}
    if kind == "webp":
        options["webp_lossless"] = "yes"
    elif kind == "12 bits":
        values, options = values.astype(np.uint16) * 16, {"nbits": 12, "compress": "deflate"}
    path = tmp_path / "a.tif"
    try:
        with rasterio.open(
            path, "w", driver="GTiff", width=WIDE, height=HIGH, count=3, dtype=values.dtype, photometric="rgb",
            transform=rasterio.transform.Affine.scale(2.0), **options,
        ) as file:  # fmt: skip
            file.write(np.moveaxis(values, -1, 0))
    except rasterio.errors.RasterioError:
        pytest.skip(f"GDAL has no {kind}")
    white = 4080 if kind == "12 bits" else None
    assert np.array_equal(open_large(path, white=white).pixels((0, 0, WIDE, HIGH)), pixels(HIGH, WIDE))
    fovea = read_image(path, white=white).permute(1, 2, 0).numpy() * 255
    assert np.array_equal(fovea.round(), pixels(HIGH, WIDE))
