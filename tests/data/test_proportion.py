"""Files take memory in proportion to their size, and one file has one answer; values that are no bytes are shown."""

import io
import struct
import sys
import tracemalloc
import zlib
from itertools import repeat

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from semfov import DataError, as_image, read_image
from semfov.agents.picture import OpenedPicture
from semfov.data.large import open_large, picture_size
from semfov.data.rasters import RasterPicture
from tests.data.test_large import pixels
from tests.refusals import refused, unusable


def whole(picture):
    return picture.read((0, 0, *picture.size)).numpy()


def pixels_of(picture):
    return picture.pixels((0, 0, *picture.size))


def fovea(path):
    return (read_image(path) * 255).round().to(torch.uint8).numpy()


def claims(path, width, height, bytes_of=b""):
    """A JPEG of a small picture whose header claims another size."""
    Image.fromarray(pixels(8, 8)).save(buffer := io.BytesIO(), "JPEG")
    content = bytearray(buffer.getvalue())
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    path.write_bytes(bytes(content) + bytes_of)
    return path


def test_a_jpeg_that_claims_more_than_its_file_may_hold(tmp_path):
    """All readers refuse it, before anything is decoded."""
    path = claims(tmp_path / "a.jpg", 9000, 9000)
    tracemalloc.start()
    for read in (read_image, as_image, lambda path: open_large(path).size):
        unusable(r"in proportion to the file, got 81,000,000 in [\d,]+ bytes", read, path)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()
    with pytest.raises(
        DataError, match=r"at most 178,956,970 pixels of a file.*, got more; convert it to a tiled TIFF"
    ):
        open_large(claims(tmp_path / "b.jpg", 20_000, 20_000))


@pytest.mark.parametrize("fill", [b"#" + b"x" * 2**16, b" " * 2**16, b"#\n" * 2**15])
@pytest.mark.parametrize("kind", ["P1", "P2", "P3", "P4", "P5", "P6"])
def test_heads_of_text_that_do_not_end_are_refused(tmp_path, kind, fill):
    """Pillow reads them byte by byte, at every opening."""
    path = tmp_path / "a.ppm"
    path.write_bytes(kind.encode() + b"\n8 " + fill + b"\n8 255\n" + b"0 " * 2000)
    for read in (read_image, lambda path: open_large(path).size):
        unusable(r"its size in the first 65,536 bytes, got longer comments", read, path)


@pytest.mark.parametrize(("kind", "mode"), [("P4", "1"), ("P5", "L"), ("P6", "RGB")])
@pytest.mark.parametrize("value", [0, 32, 255])
def test_heads_of_text_with_comments_are_read(tmp_path, kind, mode, value):
    """Whatever bytes follow them, also those of spaces."""
    path = tmp_path / "a.ppm"
    Image.new(mode, (800, 800), value if mode != "RGB" else (value,) * 3).save(path)
    content = path.read_bytes().replace(b"800 800", b"# 1 2 3\n800 # x\n800", 1)
    assert content.startswith(kind.encode())
    path.write_bytes(content)
    expected = np.asarray(Image.open(path).convert("RGB"))
    assert (whole(open_large(path)) == expected.transpose(2, 0, 1)).all()


def test_blank_pictures_are_in_proportion(tmp_path):
    Image.new("L", (6000, 4000), 255).save(tmp_path / "a.png", optimize=True)
    assert open_large(tmp_path / "a.png").size == (6000, 4000)
    assert read_image(tmp_path / "a.png").shape == (3, 4000, 6000)


@pytest.mark.parametrize("kind", ["inflates", "is stored"])
def test_a_tile_that_is_far_larger_than_its_pixels(tmp_path, kind, monkeypatch):
    """A sound TIFF of 64 × 64 pixels, whose only tile is replaced by one of a hundred million zeros."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels(64, 64), tile=(64, 64), compression="zlib", photometric="rgb")
    bomb = zlib.compress(bytes(60_000_000), 9 if kind == "inflates" else 1)
    bomb = bomb if kind == "inflates" else bomb + bytes(300_000)
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags
        places = {name: (tags[name].valueoffset, tags[name].dtype) for name in ("TileOffsets", "TileByteCounts")}
    for (at, dtype), value in zip(places.values(), (len(content), len(bomb)), strict=True):
        size = {3: 2, 4: 4, 16: 8}[int(dtype)]
        content[at : at + size] = value.to_bytes(size, "little") if size > 2 or value < 2**16 else b"\xff\xff"
    path.write_bytes(bytes(content) + bomb)
    monkeypatch.setattr("semfov.data.tiff._INFLATED", 100)
    tracemalloc.start()
    unusable(r"expected tiles of 12,288 bytes, got one that", open_large(path).read, (0, 0, 1, 1))
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


def test_a_tile_is_asked_once_how_far_it_inflates(tmp_path, monkeypatch):
    path = tmp_path / "a.tif"
    values = np.random.default_rng(0).integers(256, size=(64, 128, 3), dtype=np.uint8)
    tifffile.imwrite(path, values, tile=(64, 64), compression="zlib", photometric="rgb")
    asked = []

    def inflater():
        asked.append(1)
        return zlib.decompressobj()

    monkeypatch.setattr("semfov.data.tiff._INFLATED", 100)
    monkeypatch.setattr("semfov.data.tiff._INFLATERS", {8: inflater})
    picture = open_large(path)
    windows = [(0, 0, 128, 64), (10, 5, 50, 40), (30, 0, 90, 64), (0, 0, 128, 64)]
    for x1, y1, x2, y2 in windows:
        assert (picture.pixels((x1, y1, x2, y2)) == values[y1:y2, x1:x2]).all()
    assert len(asked) == 2  # tiles


def test_small_tiles_are_not_remembered(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels(64, 128), tile=(64, 64), compression="zlib", photometric="rgb")
    picture = open_large(path)
    picture.read((0, 0, 64, 64))
    assert picture._tiles._inflatable == set()


def test_a_tile_that_claims_more_than_is_stored(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((64, 64), np.uint8), tile=(64, 64), compression="zlib")
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        for name in ("TileWidth", "TileLength", "ImageWidth", "ImageLength"):
            tag = file.pages[0].tags[name]
            size = {3: 2, 4: 4}[int(tag.dtype)]
            content[tag.valueoffset : tag.valueoffset + size] = (32_768).to_bytes(size, "little")
    path.write_bytes(bytes(content))
    unusable(r"in proportion to the file, got 1,073,741,824 in \d+ bytes", open_large, path)
    path.write_bytes(bytes(content) + bytes(600_000))
    unusable("out of proportion", open_large(path).read, (0, 0, 1, 1))


@pytest.mark.parametrize("size", [(3, 40), (40, 3), (3, 3), (1, 5), (4, 1)])
@pytest.mark.parametrize("kind", ["png", "tif", "bmp"])
def test_narrow_pictures_of_files_are_not_ambiguous(tmp_path, size, kind):
    array = pixels(size[1], size[0])
    Image.fromarray(array).save(tmp_path / f"a.{kind}")
    for source in (tmp_path / f"a.{kind}", Image.fromarray(array)):
        assert np.array_equal((as_image(source) * 255).round().byte().permute(1, 2, 0).numpy(), array)
        assert open_large(source).size == picture_size(source) == size


def saved(path, mode="RGB", **options):
    picture = Image.fromarray(pixels(120, 90)).resize((90, 120)).convert(mode)
    picture.save(path, **options)
    return path


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "CMYK", "YCbCr", "P", "1", "I;16"])
@pytest.mark.parametrize("kind", ["tif", "png"])
def test_one_file_has_one_answer(tmp_path, mode, kind, monkeypatch):
    """By windows as by the fovea."""
    if kind == "png" and mode in ("CMYK", "YCbCr"):
        pytest.skip("PNG has no such colours")
    path = tmp_path / f"a.{kind}"
    if mode in ("RGBA", "LA"):
        picture = Image.fromarray(np.dstack([pixels(120, 90), pixels(120, 90, 1)[..., :1]]), "RGBA").convert(mode)
        picture.save(path)
    elif mode == "I;16":
        Image.fromarray(pixels(120, 90)[..., 0].astype(np.uint16) * 250).save(path)
    else:
        saved(path, mode)
    difference = np.abs(whole(open_large(path)).astype(int) - fovea(path).astype(int))
    assert difference.max() <= 1


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("photometric", ["rgb", "minisblack", "miniswhite"])
def test_turned_tiffs_have_one_answer(tmp_path, orientation, photometric):
    array = pixels(120, 90) if photometric == "rgb" else pixels(120, 90)[..., 0]
    tags = [(274, "H", 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", array, photometric=photometric, extratags=tags, rowsperstrip=16)
    picture = open_large(tmp_path / "a.tif")
    assert picture.size == ((90, 120) if orientation < 5 else (120, 90))
    assert np.array_equal(whole(picture), fovea(tmp_path / "a.tif"))


@pytest.mark.parametrize("extra", ["unassalpha", "assocalpha", "unspecified"])
def test_alpha_of_tiffs_read_by_windows(tmp_path, extra):
    """Blended with white, unless the fourth channel is no alpha."""
    array = np.dstack([pixels(120, 90), pixels(120, 90, 1)[..., :1]])
    if extra == "assocalpha":
        array[..., :3] = array[..., :3].astype(int) * array[..., 3:] // 255
    tifffile.imwrite(tmp_path / "a.tif", array, photometric="rgb", extrasamples=[extra], tile=(64, 64))
    share = array[..., 3:] / 255
    exact = {
        "unassalpha": array[..., :3] * share + 255 * (1 - share),
        "assocalpha": array[..., :3] + 255 * (1 - share),
        "unspecified": array[..., :3],
    }[extra]
    window = whole(open_large(tmp_path / "a.tif")).transpose(1, 2, 0)
    assert np.abs(window.astype(float) - exact).max() <= 1


def test_large_pictures_with_alpha_are_read_where_those_without_are(tmp_path, monkeypatch):
    """The limit of float pictures is not that of pictures that are read by windows."""
    monkeypatch.setattr("semfov.data.images.MAX_PIXELS", 5000)
    for mode in ("RGB", "RGBA", "P", "L"):
        path = saved(tmp_path / f"{mode}.png", mode)
        assert open_large(path).read((0, 0, 5, 5)).shape == (3, 5, 5)
        unusable(r"expected 1 to 5,000 pixels.*look at it by windows", read_image, path)


def test_jpeg_2000_is_read_without_rasterio(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    saved(tmp_path / "a.jp2")
    assert np.array_equal(whole(open_large(tmp_path / "a.jp2")), fovea(tmp_path / "a.jp2"))


@pytest.mark.parametrize("reader", ["fovea", "windows", "raster"])
def test_sixteen_bits_with_few_values_are_warned_of(tmp_path, reader, request):
    """Of 12 bits and of reflectances; those that use their range are read without a word, and so are blank ones."""
    if reader == "raster":
        pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    read = {"fovea": read_image, "windows": open_large, "raster": RasterPicture}[reader]
    grey = pixels(300, 400)[..., 0].astype(np.uint16)
    for factor, said in ((12, r"values from \d+ to 30\d\d of 16 bits"), (257, None), (0, None)):
        tifffile.imwrite(tmp_path / "a.tif", grey * factor, photometric="minisblack")
        if said is None:
            read(tmp_path / "a.tif")
        else:
            with pytest.warns(UserWarning, match=said):
                read(tmp_path / "a.tif")


def test_a_thumbnail_before_the_picture_is_not_the_picture(tmp_path):
    array = pixels(60, 80)
    for name, turn in (("a.tif", []), ("b.tif", [(274, "H", 1, 3, True)])):
        with tifffile.TiffWriter(tmp_path / name) as file:
            file.write(array[::8, ::8], photometric="rgb", subfiletype=1, extratags=turn)
            file.write(array, photometric="rgb", subfiletype=0, extratags=turn)
        want = np.moveaxis(np.rot90(array, 2) if turn else array, -1, 0)
        assert np.array_equal(whole(open_large(tmp_path / name)), want)
        assert np.array_equal(fovea(tmp_path / name), want)


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("suffix", ["tif", "dng", "NEF", "jpg"])
@pytest.mark.parametrize("photometric", [32803, 34892])
def test_raw_files_of_cameras_are_refused_and_no_thumbnail_is_shown(tmp_path, suffix, photometric, byteorder):
    """The raw page may be below a thumbnail, as most cameras write it, or the first one, as telephones do."""
    raw = np.zeros((60, 80) if photometric == 32803 else (60, 80, 3), np.uint16)
    pattern = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\0\1\1\2", True)]
    below = tmp_path / f"below.{suffix}"
    first = tmp_path / f"first.{suffix}"
    with tifffile.TiffWriter(below, byteorder=byteorder) as file:
        file.write(pixels(6, 8), photometric="rgb", subfiletype=1, subifds=1)
        file.write(raw, photometric=photometric, subfiletype=0, extratags=pattern)
    tifffile.imwrite(first, raw, photometric=photometric, extratags=pattern, byteorder=byteorder)
    for path in (below, first):
        for door in (read_image, open_large, picture_size):
            unusable(r"expected a picture, got the raw values of a camera .*; convert it to JPEG or TIFF", door, path)


def test_pages_below_a_picture_that_are_no_raw_ones_change_nothing(tmp_path):
    """Microscopes write reduced copies there."""
    array = pixels(60, 80)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(array, photometric="rgb", subifds=1)
        file.write(array[::2, ::2], photometric="rgb", subfiletype=1)
    want = np.moveaxis(array, -1, 0)
    assert np.array_equal(whole(open_large(tmp_path / "a.tif")), want)
    assert np.array_equal(fovea(tmp_path / "a.tif"), want)


def test_decoders_say_nothing_beside_our_words_and_what_nobody_would_turn_is_refused(tmp_path, caplog):
    tifffile.imwrite(tmp_path / "a.tif", pixels(6, 8)[..., 0], extratags=[(42113, "s", 0, "none", True)])
    open_large(tmp_path / "a.tif")
    many = np.zeros((6, 8, 300), np.uint8)
    tifffile.imwrite(tmp_path / "b.tif", many, photometric="minisblack", planarconfig="contig")
    with pytest.warns(UserWarning, match="of 300 bands without names"):
        open_large(tmp_path / "b.tif")
    (tmp_path / "c.tif").write_bytes(b"II*\0\x08\0\0\0")
    unusable("cannot be opened", open_large, tmp_path / "c.tif")
    assert not caplog.records
    tifffile.imwrite(tmp_path / "a.tif", pixels(6, 8), bigtiff=True, byteorder=">", extratags=[(274, "H", 1, 6, True)])
    unusable(r"truncated, damaged or of an unsupported kind.*\(as TIFF\)", open_large, tmp_path / "a.tif")


def test_the_alpha_of_16_bits_is_no_value_of_the_picture(tmp_path):
    values = np.dstack([pixels(60, 80).astype(np.uint16) * 4, np.full((60, 80), 65535, np.uint16)])
    tags = [(42113, "s", 0, "none", True)]  # a word where a number should be
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", extrasamples=[2], extratags=tags)
    with pytest.warns(UserWarning, match=r"values from \d+ to 10[12]\d of 16 bits"):
        open_large(tmp_path / "a.tif")
    assert whole(open_large(tmp_path / "a.tif", white="auto")).max() == 255


@pytest.mark.parametrize("planes", ["separate", "contig"])
def test_bands_without_colours_that_are_turned_are_refused(tmp_path, planes):
    """Pillow would read the first of them as grey, or none; the bands of an upright one are red, green and blue."""
    bands = np.moveaxis(pixels(6, 8), -1, 0) if planes == "separate" else pixels(6, 8)
    given = {"photometric": "minisblack", "planarconfig": planes, "extratags": [(274, "H", 1, 3, True)]}
    tifffile.imwrite(tmp_path / "a.tif", bands, **given)
    for read in (open_large, lambda path: OpenedPicture.of(path).image(torch.zeros(1))):
        unusable("expected orientation 1 of bands without colours, got 3 of 3 bands", read, tmp_path / "a.tif")


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
    got = pixels_of(open_large(tmp_path / "a.tif", white=white))
    assert np.abs(got.astype(int) - want).max() <= tolerance
    assert np.abs(pixels_of(open_large(values, white=white)).astype(int) - want).max() <= 1
    assert np.abs(as_image(values, white=white).permute(1, 2, 0).numpy() * 255 - want).max() <= 1
    seen = OpenedPicture.of(tmp_path / "a.tif", white=white).image(torch.zeros(1))[0].permute(1, 2, 0) * 255
    assert np.array_equal(seen.round().numpy().astype(np.uint8), got)


def test_pictures_that_pillow_reads_are_scaled_with_their_precision(tmp_path):
    values = np.linspace(100, 1100, 48 * 64).reshape(48, 64).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    want = torch.from_numpy(((values - 100.0) / 1000).astype(np.float32)).expand(3, -1, -1)
    assert torch.allclose(read_image(tmp_path / "a.png", white=(100, 1100)), want, atol=1e-6)
    assert np.array_equal(
        pixels_of(open_large(tmp_path / "a.png", white=(100, 1100)))[..., 0], expected(values, 100, 1100)
    )
    Image.fromarray(pixels()).save(tmp_path / "b.png")
    assert np.array_equal(pixels_of(open_large(tmp_path / "b.png", white=(50, 100))), expected(pixels(), 50, 100))


@pytest.mark.parametrize("layout", ["contig", "separate"])
def test_bands_are_chosen_by_their_numbers(tmp_path, layout):
    values = np.concatenate([pixels(), pixels(seed=1)[..., :2]], -1)
    stored = np.moveaxis(values, -1, 0) if layout == "separate" else values
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="minisblack", planarconfig=layout, tile=(64, 48))
    for bands in ((4, 3, 2), (5, 5, 1)):
        got = pixels_of(open_large(tmp_path / "a.tif", bands=bands))
        assert np.array_equal(got, values[..., [band - 1 for band in bands]])
    assert np.array_equal(pixels_of(open_large(tmp_path / "a.tif", bands=4)), values[..., [3, 3, 3]])
    with pytest.warns(UserWarning, match="of 5 bands without names 1, 2 and 3 are shown"):
        assert np.array_equal(pixels_of(open_large(tmp_path / "a.tif")), values[..., :3])
    refused("bands: expected numbers from 1 to 5", open_large, tmp_path / "a.tif", bands=6)


def test_a_file_is_read_as_a_whole_by_the_bands_that_are_chosen(tmp_path):
    values = np.concatenate([pixels(), pixels(seed=1)[..., :2]], -1)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", planarconfig="contig")
    for bands, places in (((4, 3, 2), [3, 2, 1]), (5, [4, 4, 4])):
        got = read_image(tmp_path / "a.tif", bands=bands)
        assert np.array_equal((got * 255).round().permute(1, 2, 0).numpy(), values[..., places])
    refused("bands: expected numbers from 1 to 5", read_image, tmp_path / "a.tif", bands=6)
    refused("bands: expected the number of a band", read_image, tmp_path / "a.tif", bands=(1, 2))
    refused("bands: expected None but for TIFFs", read_image, tmp_path / "a.png", bands=1)
    refused("bands: expected None for the pixels as they are stored", read_image, tmp_path / "a.tif", bands=1,
            oriented=False)  # fmt: skip


def test_no_data_are_no_values_of_a_range(tmp_path):
    values = np.full((96, 128), -9999, np.float32)
    values[:, 64:] = pixels(96, 64)[..., 0] / 10
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", extratags=[(42113, "s", 0, "-9999", True)])
    picture = open_large(tmp_path / "a.tif", white="auto")
    assert picture.nothing == (0, 0, 0)
    assert pixels_of(picture)[:, 64:].std() > 50


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


def test_a_tiff_of_very_many_pages_is_read_without_following_them(tmp_path, monkeypatch):
    """As many pages as take GDAL and Pillow most of a minute; all but the first say that they are reduced copies."""
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        writer.write(pixels(64, 48), photometric="rgb")
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        place = file.pages.first.offset
    (tags,) = struct.unpack_from("<H", content, place)
    last = place + 2 + 12 * tags
    fields = (254, 1), (256, 8), (257, 8), (273, 8), (279, 64)
    page = struct.pack("<H", len(fields)) + b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in fields)
    for _ in range(20_000):
        struct.pack_into("<I", content, last, len(content))
        content += page + bytes(4)
        last = len(content) - 4
    path.write_bytes(content)
    monkeypatch.setattr(RasterPicture, "__init__", lambda *_, **__: pytest.fail("GDAL lists all pages"))
    with pytest.warns(UserWarning, match="20001"):
        assert (whole(open_large(path)) == pixels(64, 48).transpose(2, 0, 1)).all()


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "grey"])
def test_pictures_of_16_bits_take_little_more_than_their_values(tmp_path, mode):
    """Decoded, they were copied as floats of 8 bytes a channel, several times."""
    channels = {"RGB": 3, "RGBA": 4, "grey": 1}[mode]
    array = np.random.default_rng(0).integers(0, 65_536, (1500, 1000, channels), dtype=np.uint16)
    path = tmp_path / "a.png"
    path.write_bytes(png16(array))
    picture = open_large(path)
    tracemalloc.start()
    shown = whole(picture)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 8 * array.shape[0] * array.shape[1]
    values = array.astype(np.float64) / 65_535
    colours = values[..., :3] * values[..., 3:] + 1 - values[..., 3:] if mode == "RGBA" else values
    assert abs(shown.transpose(1, 2, 0) - colours * 255).max() <= 0.5 + 1e-3


def png16(array):
    """Encode values of 16 bits as a PNG (W3C, 11.2.2)."""
    height, width, channels = array.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in array)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 3: 2, 4: 6}[channels], 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 1)) + chunk(b"IEND", b"")


def test_a_blank_tiled_tiff_is_looked_at_by_windows_as_the_message_says(tmp_path):
    """It takes next to nothing in the file; read as a whole it would take a gigabyte."""
    path = tmp_path / "blank.tif"
    tile = np.full((256, 256, 3), 200, np.uint8)
    side = 36 * 256
    layout = {"shape": (side, side, 3), "dtype": "uint8", "tile": (256, 256), "photometric": "rgb"}
    tifffile.imwrite(path, repeat(tile, 36**2), compression="zlib", **layout)
    with pytest.raises(DataError, match=r"in proportion to the file, got 9216 × 9216, .*; reduce it, or .* by windows"):
        read_image(path)
    assert (open_large(path).read((9000, 9000, 9216, 9216)) == 200).all()
