"""The product of what a picture's file may be: every reader shows what its numbers say."""

import itertools
import re
import sys
from contextlib import nullcontext

import numpy as np
import pytest
import tifffile

from semfov import read_image
from semfov.data import windowed
from semfov.data.large import open_large, picture_size
from tests.data.test_large import pixels
from tests.families import every_two
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


def shown(path, **given):
    """The bytes that windows and the fovea show of a file."""
    picture = open_large(path, **given)
    width, height = picture.size
    fovea = read_image(path, **given).permute(1, 2, 0).numpy() * 255
    return picture.pixels((0, 0, width, height)).astype(float), fovea


@pytest.mark.parametrize(("bits", "layout", "photometric", "copies", "alpha"), every_two(VARIANTS))
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


@pytest.mark.parametrize(
    ("bits", "copies", "photometric", "hidden"),
    every_two(itertools.product((8, 16), ((), (2, 4)), ("rgb", "minisblack", "miniswhite"), ("mask", "value"))),
)
def test_what_a_tiff_hides_has_one_answer(tmp_path, bits, copies, photometric, hidden):
    """A mask is white paper; a value without data is shown as it is, and `nothing` tells its colour."""
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    most, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    values = pixels(HIGH, WIDE)[..., : 3 if photometric == "rgb" else 1].astype(kind) * (most // 255)
    mask = np.full((HIGH, WIDE), 255, np.uint8)
    mask[40:90, 60:200] = 0
    if hidden == "value":
        values = np.where(mask[..., None] > 0, np.maximum(values, 1), 0).astype(kind)
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            tmp_path / "a.tif", "w", driver="GTiff", width=WIDE, height=HIGH, count=values.shape[-1], dtype=kind,
            tiled=True, blockxsize=64, blockysize=64, photometric=photometric,
            nodata=0 if hidden == "value" else None, transform=rasterio.transform.Affine.scale(2.0),
        ) as file,
    ):  # fmt: skip
        file.write(np.moveaxis(values, -1, 0))
        if hidden == "mask":
            file.write_mask(mask)
        if copies:
            file.build_overviews(copies)
    want = values / most * 255
    want = 255 - want if photometric == "miniswhite" else want
    want = np.where((mask[..., None] > 0) | (hidden == "value"), want, 255)
    for got in shown(tmp_path / "a.tif"):
        assert np.abs(got - want).max() <= 0.51
    nothing = 255 if hidden == "mask" or photometric == "miniswhite" else 0
    assert open_large(tmp_path / "a.tif").nothing == (nothing,) * 3


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


@pytest.mark.parametrize("bits", [2, 4, 10, 12, 14])
@pytest.mark.parametrize("kind", ["black is zero", "white is zero", "JPEG 2000"])
def test_the_largest_value_is_that_of_the_bits_that_a_file_states(tmp_path, bits, kind):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    values = (pixels(HIGH, WIDE)[..., 0].astype(np.uint16) << 8) >> (16 - bits)
    options = {"driver": "GTiff", "photometric": "miniswhite" if kind == "white is zero" else "minisblack"}
    if kind == "JPEG 2000":
        options = {"driver": "JP2OpenJPEG", "quality": 100, "reversible": "yes"}
    path = tmp_path / ("a.jp2" if kind == "JPEG 2000" else "a.tif")
    with rasterio.open(
        path, "w", width=WIDE, height=HIGH, count=1, dtype="uint8" if bits < 8 else "uint16", nbits=bits,
        transform=rasterio.transform.Affine.scale(2.0), **options,
    ) as file:  # fmt: skip
        file.write(values.astype(np.uint8 if bits < 8 else np.uint16), 1)
    want = values[..., None] * (255 / (2**bits - 1))
    for got in shown(path):
        assert np.abs(got - (255 - want if kind == "white is zero" else want)).max() <= 0.51
    if kind != "white is zero":
        for got in shown(path, white=2 ** (bits - 1)):
            assert np.abs(got - (2 * want * (1 - 0.5**bits)).clip(0, 255)).max() <= 0.51


@pytest.mark.parametrize("count", [1, 3])
def test_the_transparent_colour_of_16_bits_is_white(tmp_path, count):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    values = pixels(HIGH, WIDE)[..., :count].astype(np.uint16) * 257
    values[20:60, 30:90] = 4321
    # Of one channel alone, which is not transparent.
    values[60:70, 30:90, 0] = 4321 if count > 1 else 4322
    shape = {"width": WIDE, "height": HIGH, "count": count, "dtype": "uint16"}
    path = tmp_path / "a.png"
    transform = rasterio.transform.Affine.scale(2.0)
    with rasterio.open(path, "w", driver="PNG", nodata=4321, transform=transform, **shape) as file:
        file.write(np.moveaxis(values, -1, 0))
    assert b"tRNS" in path.read_bytes()
    is_transparent = (values == 4321).all(-1, keepdims=True)
    want = np.where(is_transparent, 255, np.broadcast_to(values / 257, (HIGH, WIDE, 3)))
    for got in shown(path):
        assert np.abs(got - want).max() <= 0.51


@pytest.mark.parametrize("axes", ["ZCYX", "CZYX", "TZCYX", "ZYX", "YX"])
@pytest.mark.parametrize("kind", ["OME", "ImageJ"])
def test_the_first_picture_of_a_stack_is_shown_with_all_its_channels(tmp_path, axes, kind):
    if kind == "ImageJ" and axes == "CZYX":
        pytest.skip("ImageJ has channels after planes")
    channels = np.moveaxis(pixels(HIGH, WIDE), -1, 0)
    stack = channels if "C" in axes else channels[0]
    want = pixels(HIGH, WIDE) if "C" in axes else pixels(HIGH, WIDE)[..., :1]
    others = len(axes) - 2 - ("C" in axes)
    for _ in range(others):
        stack = np.stack([stack, 255 - stack], int(axes.startswith("C")))
    path = tmp_path / ("a.ome.tif" if kind == "OME" else "a.tif")
    options = {"imagej": True} if kind == "ImageJ" else {"photometric": "minisblack"}
    tifffile.imwrite(path, stack, metadata={"axes": axes}, **options)
    said = pytest.warns(UserWarning, match=f"the first of {2**others} pictures") if others else nullcontext()
    with said:
        for got in shown(path):
            assert np.abs(got - want).max() < 1e-3


def test_channels_with_reduced_copies_are_colours(tmp_path):
    channels = np.moveaxis(pixels(HIGH, WIDE), -1, 0)
    with tifffile.TiffWriter(tmp_path / "a.ome.tif") as file:
        file.write(channels, metadata={"axes": "CYX"}, photometric="minisblack", subifds=1, tile=(64, 64))
        file.write(channels[:, ::2, ::2], subfiletype=1, photometric="minisblack", tile=(64, 64))
    for got in shown(tmp_path / "a.ome.tif"):
        assert np.abs(got - pixels(HIGH, WIDE)).max() < 1e-3


def test_percentiles_are_those_of_pixels_with_data(tmp_path):
    """In windows as in the fovea, whether floats have reduced copies or not."""
    values = pixels(HIGH, WIDE)[..., 0].astype(np.float32)
    values[:60] = -9999
    tags = [(42113, "s", 0, "-9999", True)]
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", extratags=tags)
    windows, fovea = shown(tmp_path / "a.tif", white="auto")
    assert np.abs(windows - fovea).max() < 1e-3
    assert abs(windows[60:].mean() - values[60:].mean()) < 3
    assert picture_size(tmp_path / "a.tif") == (WIDE, HIGH)


FOREIGN = {
    "JPEG XL": b"\xff\x0a" + bytes(40),
    "HEIC (`heif-convert": b"\0\0\0\x18ftypheic" + bytes(40),
    "PDF (`pdftoppm": b"%PDF-1.4",
    "a web page": b"<!DOCTYPE html><p>404</p>",
    "an empty file": b"",
    "OpenEXR": b"\x76\x2f\x31\x01" + bytes(40),
    "a pointer of Git LFS": b"version https://git-lfs.github.com/spec/v1\n",
}


@pytest.mark.parametrize("kind", FOREIGN)
@pytest.mark.parametrize("end", ["jpg", "tif"])
def test_files_of_other_kinds_are_refused_by_name(tmp_path, kind, end):
    (tmp_path / f"a.{end}").write_bytes(FOREIGN[kind])
    for read in (read_image, open_large, picture_size):
        unusable(
            rf"not an image in a format that is read .*, got {re.escape(kind)}.*; convert it",
            read,
            tmp_path / f"a.{end}",
        )


def test_more_than_8_bits_of_jpeg_2000_need_the_reader_that_keeps_them(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    shape = {"width": WIDE, "height": HIGH, "count": 1, "dtype": "uint16", "nbits": 12}
    shape |= {"quality": 100, "reversible": "yes", "transform": rasterio.transform.Affine.scale(2.0)}
    with rasterio.open(tmp_path / "a.jp2", "w", driver="JP2OpenJPEG", **shape) as file:
        file.write(pixels(HIGH, WIDE)[..., 0].astype(np.uint16) * 16, 1)
    (tmp_path / "a.j2k").write_bytes((tmp_path / "a.jp2").read_bytes())
    unusable(r"expected white=None beside more than 8 bits.*\.jp2", read_image, tmp_path / "a.j2k", white=4080)
    for got in shown(tmp_path / "a.jp2", white=4080):
        assert np.abs(got - pixels(HIGH, WIDE)[..., :1]).max() <= 0.51


def test_without_its_reader_a_mask_is_missed_with_a_word(tmp_path, monkeypatch):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    shape = {"width": WIDE, "height": HIGH, "count": 3, "dtype": "uint8", "photometric": "rgb"}
    shape["transform"] = rasterio.transform.Affine.scale(2.0)
    path = tmp_path / "a.tif"
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", driver="GTiff", **shape) as file:
        file.write(np.moveaxis(pixels(HIGH, WIDE), -1, 0))
        file.write_mask(np.zeros((HIGH, WIDE), np.uint8))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    for read in (open_large, read_image):
        with pytest.warns(UserWarning, match=r'its mask is not read; pip install "semfov\[geo\]"'):
            read(path)


def test_one_strip_that_takes_far_more_memory_than_its_file_is_refused(tmp_path):
    path = tmp_path / "a.tif"
    plain = np.zeros((9000, 9000, 3), np.uint8)
    tifffile.imwrite(path, plain, photometric="rgb", rowsperstrip=9000, compression="zlib")
    unusable("at most .* bytes, in proportion to the file, got 9000 × 9000", read_image, path)
    unusable("at most .* bytes, in proportion to the file, got 9000 × 9000", open_large(path).pixels, (0, 0, 9, 9))
