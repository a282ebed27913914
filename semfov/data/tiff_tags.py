"""The tags of a TIFF by their names, whichever library has read them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from PIL.Image import Image
    from tifffile import TiffPage

SUBFILE = 254
WIDTH = 256
HEIGHT = 257
BITS = 258
COMPRESSION = 259
PHOTOMETRIC = 262
ORIENTATION = 274
SAMPLES = 277
ROWS_PER_STRIP = 278
STRIP_BYTES = 279
TILE_WIDTH = 322
TILE_HEIGHT = 323
TILE_BYTES = 325
SUB_PAGES = 330
EXTRA_SAMPLES = 338
SAMPLE_FORMAT = 339
GDAL_METADATA = 42112
GDAL_NODATA = 42113

# Values of PHOTOMETRIC: what the numbers of a pixel stand for.
WHITE_IS_ZERO = 0
RGB = 2
PALETTE = 3
YCBCR = 6

# Values of EXTRA_SAMPLES: kinds of a further channel, of which two are an alpha.
PREMULTIPLIED = 1
UNASSOCIATED = 2

REDUCED = 1  # bits of SUBFILE: a reduced copy, and a mask, of another page
MASK = 4
UPRIGHT = 1  # of ORIENTATION
JPEG = 7  # of COMPRESSION
SIGNED = 2  # of SAMPLE_FORMAT
PLANES = 2  # planar configuration of channels that are stored one after the other


@dataclass(frozen=True)
class TiffTags:
    """The tags of a page of a TIFF.

    Attributes:
        values: by their numbers; none for a file that is no TIFF, or that no library reads.
    """

    values: Mapping[int, Any]

    @classmethod
    def of_image(cls, image: "Image") -> "TiffTags":
        """Read the tags of the current page of a Pillow image; empty if it is no TIFF."""
        return cls(getattr(image, "tag_v2", {}))

    @classmethod
    def of_page(cls, page: "TiffPage") -> "TiffTags":
        """Read the tags of a page of tifffile."""
        return cls({tag.code: tag.value for tag in page.tags.values()})

    @property
    def photometric(self) -> int:
        return self.values.get(PHOTOMETRIC, 1)

    @property
    def compression(self) -> int:
        return self.values.get(COMPRESSION, 1)

    @property
    def orientation(self) -> int:
        return self.values.get(ORIENTATION, UPRIGHT)

    @property
    def samples(self) -> int:
        """Channels of a pixel."""
        return self.values.get(SAMPLES, 1)

    @property
    def is_reduced(self) -> bool:
        """Whether the page is a reduced copy of another one, such as a thumbnail."""
        return bool(self.values.get(SUBFILE, 0) & REDUCED)

    @property
    def is_premultiplied(self) -> bool:
        """Whether colours are multiplied by an alpha already."""
        return PREMULTIPLIED in np.atleast_1d(self.values.get(EXTRA_SAMPLES, ()))

    @property
    def has_signed_bytes(self) -> bool:
        return SIGNED in self.values.get(SAMPLE_FORMAT, ()) and max(self.bits) == 8

    @property
    def bits(self) -> tuple[int, ...]:
        """Bits of each channel."""
        return self.values.get(BITS, (1,))

    def tile_bytes(self, size: tuple[int, int]) -> int:
        """Count the bytes of a decoded tile, or strip, of a page of `(width, height)` pixels."""
        width, height = size
        if TILE_WIDTH in self.values:
            pixels = math.prod((self.values[TILE_WIDTH], self.values[TILE_HEIGHT]))
        else:
            pixels = math.prod((width, self.values.get(ROWS_PER_STRIP, height)))
        return pixels * max(self.samples, len(self.bits)) * max(self.bits) // 8

    @property
    def stored_bytes(self) -> tuple[int, ...]:
        """Bytes in the file of each tile, or strip."""
        counts = TILE_BYTES if TILE_WIDTH in self.values else STRIP_BYTES
        return self.values.get(counts, ())
