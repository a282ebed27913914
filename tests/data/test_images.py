import io
import struct
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from semfov import DataError, read_image
from semfov.data.images import MAX_PIXELS, file_orientation, stored_boxes
from semfov.data.large import picture_size
from tests.refusals import unusable

# Four colours, one per quadrant, so that every rotation or mirroring is visible.
COLOURS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], dtype=np.uint8)
PICTURE = COLOURS.repeat(8, axis=0).repeat(12, axis=1)  # 16 high, 24 wide


def bits(image):
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


# Effect of each EXIF orientation: the standard gives the position of row 0 and column 0 of the stored pixels.
SHOWN = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: np.rot90,
}


@pytest.mark.parametrize("kind", ["png", "jpg", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_are_rotated_by_exif_orientation(tmp_path, orientation, kind):
    exif, path = oriented(orientation), tmp_path / f"a.{kind}"
    lossless = {"lossless": True} if kind == "webp" else {"quality": 100, "subsampling": 0} if kind == "jpg" else {}
    Image.fromarray(PICTURE).save(path, exif=exif, **lossless)
    shown = bits(read_image(path)).astype(int)
    expected = SHOWN[orientation](PICTURE).astype(int)
    assert shown.shape == expected.shape
    assert abs(shown - expected).max() <= 12
    if kind != "tif":  # Pillow rotates TIFF files itself
        assert abs(bits(read_image(path, oriented=False)).astype(int) - PICTURE).max() <= 12


def write_late(path, content):
    """Write a PNG with a chunk behind its pixels, of a kind and its content."""
    Image.fromarray(PICTURE).save(path)
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))
    png = path.read_bytes()
    end = png.rindex(b"IEND") - 4
    path.write_bytes(png[:end] + chunk + png[end:])


@pytest.mark.parametrize("name", ["chunk.png", "text.png"])
@pytest.mark.parametrize("orientation", range(2, 9))
def test_exif_data_behind_the_pixels_of_a_png_turn_it_for_every_reader(tmp_path, orientation, name):
    """The data are a chunk, or a text as ImageMagick writes it."""
    path = tmp_path / name
    exif = oriented(orientation).tobytes()
    text = b"tEXtRaw profile type exif\0\nexif\n%d\n%s\n" % (len(exif), exif.hex().encode())
    write_late(path, text if name == "text.png" else b"eXIf" + exif)
    expected = SHOWN[orientation](PICTURE)
    assert (bits(read_image(path)) == expected).all()
    assert (bits(read_image(path, oriented=False)) == PICTURE).all()
    assert file_orientation(path) == orientation
    assert picture_size(path) == (expected.shape[1], expected.shape[0])
    with Image.open(path) as image:
        image.load()
        assert picture_size(image) == (expected.shape[1], expected.shape[0])


def test_the_orientation_and_the_size_of_a_png_are_read_without_its_pixels(tmp_path, monkeypatch):
    write_late(tmp_path / "plain.png", b"tEXtComment\0by hand")
    Image.fromarray(PICTURE).save(tmp_path / "turned.png", exif=oriented(6))
    decoded = []
    monkeypatch.setattr(PngImageFile, "load", lambda image: decoded.append(image))
    paths = tmp_path / "plain.png", tmp_path / "turned.png"
    assert [file_orientation(path) for path in paths] == [1, 6]
    assert [picture_size(path) for path in paths] == [(24, 16), (16, 24)]
    assert decoded == []


@pytest.mark.parametrize("orientation", range(1, 9))
def test_boxes_of_an_upright_photograph_are_found_in_the_stored_one(tmp_path, orientation):
    stored = np.zeros((16, 24, 3), np.uint8)
    stored[2:5, 9:20] = 255
    Image.fromarray(stored).save(tmp_path / "a.png", exif=oriented(orientation))
    assert file_orientation(tmp_path / "a.png") == orientation
    shown = SHOWN[orientation](stored)[..., 0]
    rows = shown.any(1).nonzero()[0]
    columns = shown.any(0).nonzero()[0]
    box = torch.tensor([[columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]])
    assert stored_boxes(box, (shown.shape[1], shown.shape[0]), orientation).tolist() == [[9, 2, 20, 5]]


def oriented(number):
    exif = Image.Exif()
    exif[0x0112] = number
    return exif


@pytest.mark.parametrize(
    "exif",
    [oriented(0), oriented(9), oriented(65535), b"Exif\0\0MM\0*\xff\xff\xff\xff\0\1\2"],
    ids=["0", "9", "65535", "damaged"],
)
def test_unknown_orientations_and_damaged_exif_data_are_ignored(tmp_path, exif):
    Image.fromarray(PICTURE).save(tmp_path / "a.png", exif=exif)
    assert np.array_equal(bits(read_image(tmp_path / "a.png")), PICTURE)


GREY = np.arange(256, dtype=np.uint8).reshape(16, 16)
CHECKS = np.array([[0, 255], [255, 0]], np.uint8)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (Image.fromarray(GREY), GREY[..., None].repeat(3, -1)),
        (Image.fromarray(CHECKS).convert("1"), CHECKS[..., None].repeat(3, -1)),
        (Image.fromarray(PICTURE).quantize(4), PICTURE),
    ],
    ids=["grey", "bilevel", "palette"],
)
def test_images_of_other_modes_are_exact_in_three_channels(tmp_path, image, expected):
    image.save(tmp_path / "a.png")
    shown = read_image(tmp_path / "a.png").permute(1, 2, 0).numpy()
    assert np.array_equal(shown, expected.astype(np.float32) / 255)


def test_cmyk_jpeg(tmp_path):
    Image.new("CMYK", (8, 8), (0, 255, 255, 0)).save(tmp_path / "red.jpg", quality=100)
    assert abs(bits(read_image(tmp_path / "red.jpg")).astype(int) - (255, 0, 0)).max() <= 3
    Image.new("CMYK", (8, 8), (0, 0, 0, 255)).save(tmp_path / "black.tif")
    assert read_image(tmp_path / "black.tif").max() == 0


def test_transparent_pixels_are_blended_with_white(tmp_path):
    alpha = np.array([[0, 255, 128]], np.uint8)
    colour = np.zeros((1, 3, 3), np.uint8)
    colour[..., 0] = 200
    rgba = Image.fromarray(np.concatenate([colour, alpha[..., None]], -1))
    expected = 255 - (255 - colour[0].astype(float)) * alpha[0, :, None] / 255
    rgba.save(tmp_path / "rgba.png")
    assert abs(bits(read_image(tmp_path / "rgba.png"))[0] - expected).max() <= 1
    rgba.convert("LA").save(tmp_path / "la.png")
    grey = np.asarray(rgba.convert("L"))[0].astype(float)
    expected_grey = 255 - (255 - grey) * alpha[0] / 255
    assert abs(bits(read_image(tmp_path / "la.png"))[0, :, 0] - expected_grey).max() <= 1


def test_a_transparent_colour_is_white(tmp_path):
    for kind in ["png", "gif"]:
        image = Image.fromarray(np.array([[0, 1, 2]], np.uint8)).convert("P")
        image.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
        image.save(tmp_path / f"a.{kind}", transparency=1)
        assert bits(read_image(tmp_path / f"a.{kind}")).tolist() == [[[255, 0, 0], [255, 255, 255], [0, 0, 255]]]
    Image.fromarray(PICTURE).save(tmp_path / "a.png", transparency=(255, 0, 0))
    image = bits(read_image(tmp_path / "a.png"))
    assert (image[:8, :12] == 255).all()
    assert np.array_equal(image[8:], PICTURE[8:])


def test_sixteen_bits_keep_their_depth(tmp_path):
    for kind in ["png", "tif"]:
        grey = np.array([[0, 1, 255, 256, 40000, 65535]], np.uint16)
        Image.fromarray(grey).save(tmp_path / f"a.{kind}")
        image = read_image(tmp_path / f"a.{kind}")
        assert np.allclose(image[0].numpy(), grey / 65535, atol=1e-7)
        assert torch.equal(image[0], image[2])

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    row = b"\0" + np.array([[65535, 0, 32896], [0, 65535, 257]], ">u2").tobytes()
    header = struct.pack(">IIBBBBB", 2, 1, 16, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(row)) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(data)
    assert bits(read_image(tmp_path / "a.png")).tolist() == [[[255, 0, 128], [0, 255, 1]]]


def test_float_tiff(tmp_path):
    Image.fromarray(np.array([[0.0, 0.25, 1.0]], np.float32)).save(tmp_path / "a.tif")
    assert read_image(tmp_path / "a.tif")[0].tolist() == [[0.0, 0.25, 1.0]]
    Image.fromarray(np.array([[0.0, np.nan]], np.float32)).save(tmp_path / "b.tif")
    unusable(r"b\.tif: expected values from 0 to 1", read_image, tmp_path / "b.tif")
    Image.fromarray(np.array([[0, 70000]], np.int32)).save(tmp_path / "c.tif")
    unusable(r"c\.tif: expected values from 0 to 65535", read_image, tmp_path / "c.tif")


@pytest.mark.parametrize("kind", ["gif", "webp", "png"])
def test_the_first_frame_of_an_animation_is_read(tmp_path, kind):
    frames = [Image.new("RGB", (6, 4), colour) for colour in ("red", "blue", "lime")]
    lossless = {"lossless": True} if kind == "webp" else {}
    frames[0].save(tmp_path / f"a.{kind}", save_all=True, append_images=frames[1:], duration=50, **lossless)
    assert (bits(read_image(tmp_path / f"a.{kind}")) == (255, 0, 0)).all()


@pytest.mark.parametrize(
    ("kinds", "rare"),
    [(("jpg", "png", "bmp", "tif"), False), (("webp",), True), (("jp2",), True), (("avif",), True)],
)
def test_a_process_that_reads_a_photograph_imports_few_formats_and_reads_the_others(tmp_path, fresh, kinds, rare):
    """In processes of their own, since formats stay imported."""
    files = [str(tmp_path / f"photograph.{kind}") for kind in kinds]
    for file in files:
        Image.fromarray(PICTURE).save(file)
    code = f"""
import sys
from semfov import read_image
for path in {files}:
    print(tuple(read_image(path).shape), "PIL.PdfImagePlugin" in sys.modules)
"""
    assert fresh(code) == f"(3, 16, 24) {rare}\n" * len(files)


@pytest.mark.parametrize("size", [(1, 1), (1, 700), (20000, 3)])
def test_images_of_any_size_are_read(tmp_path, size):
    Image.new("RGB", size, "red").save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png").shape == (3, size[1], size[0])


@pytest.mark.parametrize("kind", ["jpg", "png", "gif", "webp", "tif"])
def test_truncated_files_are_refused(tmp_path, kind):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / f"a.{kind}")
    whole = (tmp_path / f"a.{kind}").read_bytes()
    (tmp_path / f"a.{kind}").write_bytes(whole[: len(whole) // 2])
    unusable(rf"a\.{kind}: (truncated, damaged|not an image)", read_image, tmp_path / f"a.{kind}")


@pytest.mark.parametrize("side", [9600, 60000])
def test_a_decompression_bomb_is_refused(tmp_path, side):
    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    data = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    idat = b"IDAT" + zlib.compress(b"\0" * 100)
    data += struct.pack(">I", len(idat) - 4) + idat + struct.pack(">I", zlib.crc32(idat))
    (tmp_path / "bomb.png").write_bytes(data)
    unusable(rf"bomb\.png: .*(in proportion to the file|{2 * MAX_PIXELS:,} pixels)", read_image, tmp_path / "bomb.png")


def samples():
    for kind in ("JPEG", "PNG", "GIF", "WEBP", "TIFF", "BMP"):
        stream = io.BytesIO()
        Image.fromarray(PICTURE).save(stream, kind)
        yield stream.getvalue()


@settings(max_examples=100, deadline=None)
@given(
    sample=st.sampled_from(list(samples())),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=6),
    keep=st.floats(0, 1),
)
def test_damaged_files_give_an_image_or_a_data_error(tmp_path_factory, sample, changes, keep):
    data = bytearray(sample[: max(1, round(keep * len(sample)))])
    for where, value in changes:
        data[int(where * len(data))] = value
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(data)
    try:
        image = read_image(path)
    except DataError as error:
        message = str(error)
    else:
        assert image.shape[0] == 3
        assert image.min() >= 0
        assert image.max() <= 1
        return
    assert str(path) in message
    assert "\n" not in message
