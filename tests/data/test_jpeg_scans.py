"""Scans of a JPEG: each is a pass over all pixels, so that a small file of many would not end."""

import io

import numpy as np
import pytest
from PIL import Image

from semfov import as_image, read_image
from semfov.data.jpeg_scans import MOST_SCANS
from semfov.data.large import open_large
from tests.data.test_large import pixels
from tests.refusals import unusable

SCAN, END = b"\xff\xda", b"\xff\xd9"


def encoded(**options):
    Image.fromarray(pixels(64, 48)).save(buffer := io.BytesIO(), "JPEG", **options)
    return buffer.getvalue()


def of_scans(number, **options):
    """A JPEG whose last scan is repeated, which changes nothing in the picture, until there is a number of scans."""
    content = encoded(progressive=True, **options)
    last = content[content.rindex(SCAN) : -len(END)]
    return content[: -len(END)] + last * (number - content.count(SCAN)) + END


@pytest.mark.parametrize("color", ["RGB", "L", "CMYK"])
def test_a_jpeg_of_too_many_scans_is_refused_by_every_reader(tmp_path, color):
    path = tmp_path / "a.jpg"
    content = of_scans(MOST_SCANS + 1)
    if color != "RGB":
        Image.fromarray(pixels(64, 48)).convert(color).save(buffer := io.BytesIO(), "JPEG", progressive=True)
        one = buffer.getvalue()
        content = one[:-2] + one[one.rindex(SCAN) : -2] * MOST_SCANS + END
    path.write_bytes(content)
    words = f"a.jpg: expected at most {MOST_SCANS} scans of a JPEG, got more; replace it"
    for read in (read_image, as_image, lambda path: open_large(path).read((0, 0, 8, 8))):
        unusable(words, read, path)
    unusable("scans", as_image, Image.open(io.BytesIO(content)))


def test_other_jpegs_are_read_as_pillow_reads_them(tmp_path):
    """Many scans; and two bytes like the mark of a scan in segments, in a thumbnail and behind the end."""
    thumbnail = encoded(progressive=True)
    exif = Image.Exif()
    exif[0x010E] = "a" * 9
    for content in (
        encoded(),
        of_scans(MOST_SCANS),
        encoded(comment=SCAN * 200),
        encoded(exif=exif.tobytes() + thumbnail + SCAN * 200),
        encoded() + SCAN * 200,
        encoded(restart_marker_blocks=1, comment=SCAN * 200),
        of_scans(30, comment=SCAN * 200) + of_scans(90),
    ):
        path = tmp_path / "a.jpg"
        path.write_bytes(content)
        expected = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
        assert (open_large(path).read((0, 0, 48, 64)).permute(1, 2, 0).numpy() == expected).all()


def test_a_picture_that_is_decoded_already_is_not_read_again(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(of_scans(MOST_SCANS + 1))
    with Image.open(path) as image:
        image.load()
    assert as_image(image).shape == (3, 64, 48)
