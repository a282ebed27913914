"""TIFFs and rasters, which are read window by window: by tifffile, by GDAL, or by Pillow where both leave them."""

import warnings
import weakref
from contextlib import suppress
from itertools import product
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.camera_raw import check_no_raw
from semfov.data.description import Description, as_rgb, named_colours
from semfov.data.gdal import Dataset, Raster, WindowOptions, raster_settings
from semfov.data.images import PhotographPicture, open_pillow, opening, quiet_decoders
from semfov.data.tiff import TiffPicture
from semfov.data.tiff_tags import JPEG, PALETTE, UPRIGHT, WHITE_IS_ZERO, YCBCR, TiffTags
from semfov.data.tone import Values, White
from semfov.data.vrt import Mosaic, open_raster
from semfov.data.windowed import RASTERS, Box, ChosenBands, LargePicture
from semfov.errors import DataError, check, check_data, needing
from semfov.io.files import check_regular

_TIFFS = (".tif", ".tiff")


class RasterPicture(LargePicture):
    """A raster that GDAL reads by windows, at low magnification from the file's overviews, if any.

    Private attributes: `_bands` has the numbers of the bands that are shown, one or three, from 1. `_is_masked` tells
    whether the file has a mask, or an alpha, of all bands.

    Raises:
        DataError: rasterio is not there, or the file is damaged or of a kind that is not read.
        InputError: it has no such band.
    """

    path: Path

    def __init__(self, path: str | PathLike[str], *, white: White | None = None, bands: ChosenBands = None) -> None:
        with needing("rasterio", path, '"semfov[geo]"', DataError):
            self._settings = raster_settings()
        self.path = Path(path)
        self._lock = Lock()  # GDAL's datasets are for one thread at a time
        with opening(self.path, "opened"), self._settings:
            self._file = open_raster(self.path)
        weakref.finalize(self, self._file.close)
        _check_kind(self._file, path, has_white=white is not None)
        self.size = self._file.width, self._file.height
        description = _describe(self.path, self._file)
        self._bands = description.shown_bands(bands)
        first = self._bands[0]
        self._has_overviews = bool(self._file.overviews(first))
        self._is_masked = "per_dataset" in {flag.name for flag in self._file.mask_flag_enums[first - 1]}
        nodata = self._file.nodatavals[first - 1]
        self._display = description.display(white, self._values, nodata)
        self.nothing = self._colour_of_nothing(nodata)

    def pixels(self, box: Box, reduction: int = 1) -> NDArray[np.uint8]:
        pixels = self._display.colours(self._values(box, reduction))
        if self._is_masked:
            pixels = self._display.over_white(pixels, self._mask(box, reduction))
        return as_rgb(pixels)

    def holds(self, box: Box) -> bool:
        if isinstance(self._file, Mosaic):  # which knows its sources
            return self._file.holds(box)
        if self._file.driver != "GTiff":
            return True
        x1, y1, x2, y2 = box
        height, width = self._file.block_shapes[0]
        rows = range(y1 // height, -(-y2 // height))
        columns = range(x1 // width, -(-x2 // width))
        # GDAL tells a size of blocks alone that are stored.
        names = (f"BLOCK_SIZE_{column}_{row}" for row, column in product(rows, columns))
        with self._lock:
            return any(self._file.get_tag_item(name, "TIFF", bidx=self._bands[0]) for name in names)

    def _reduced(self, box: Box, reduction: int) -> Tensor:
        """Read a window from the overviews of the file, or from a copy where it has none."""
        if not self._has_overviews:
            return super()._reduced(box, reduction)
        # Outwards to multiples of the reduction, so that neighbouring windows meet.
        left, top = (edge // reduction * reduction for edge in box[:2])
        right, bottom = (-(-edge // reduction) * reduction for edge in box[2:])
        width, height = self.size
        outwards = left, top, min(right, width), min(bottom, height)
        return torch.from_numpy(self.pixels(outwards, reduction)).permute(2, 0, 1)

    def _values(self, box: Box, reduction: int = 1) -> Values:
        """Read the values of the bands, `(h, w, C)`."""
        options = _window_options(box, reduction, len(self._bands))
        with self._lock, opening(self.path, "decoded"), self._settings:
            values = self._file.read(self._bands, **options)
        return np.moveaxis(values, 0, -1)

    def _mask(self, box: Box, reduction: int) -> NDArray[np.uint8]:
        """Read the mask of the bands, 255 where a pixel is there, `(h, w, 1)`."""
        options = _window_options(box, reduction, 1)
        with self._lock, opening(self.path, "decoded"), self._settings:
            mask = self._file.read_masks([self._bands[0]], **options)
        return np.moveaxis(mask, 0, -1)

    def _colour_of_nothing(self, nodata: float | None) -> tuple[int, int, int] | None:
        """Find the colour in which pixels without data are shown; None where the file does not tell them."""
        if self._is_masked:
            return 255, 255, 255
        if nodata is None:
            return None
        value = np.full((1,), nodata, self._file.dtypes[self._bands[0] - 1])
        grey = int(self._display.colours(value)[0])
        return grey, grey, grey


def _window_options(box: Box, reduction: int, bands: int) -> WindowOptions:
    """Write the arguments by which rasterio reads a window, reduced by a factor."""
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    x1, y1, x2, y2 = box
    height = -(-(y2 - y1) // reduction)
    width = -(-(x2 - x1) // reduction)
    window = Window(x1, y1, x2 - x1, y2 - y1)
    return {"window": window, "out_shape": (bands, height, width), "resampling": Resampling.average}


def _check_kind(file: Raster, path: str | PathLike[str], *, has_white: bool) -> None:
    """Raise `DataError` for a raster that is not shown; `has_white` if its values of black and white are stated."""
    is_palette = any(meaning.name == "palette" for meaning in file.colorinterp)
    check_data(not is_palette, path, "grey, RGB or bands", "a palette; convert it (gdal_translate)")
    kinds = {*file.dtypes}
    is_scaled = has_white and not any("complex" in kind for kind in kinds)
    got = f"{', '.join(sorted(kinds))}; give white='auto', or the values that are black and white"
    check_data(is_scaled or kinds <= {"uint8", "uint16"}, path, "bands of 8 or 16 bits", got)


def _describe(path: Path, file: Raster) -> Description:
    """Describe the values of a dataset of GDAL, or of a mosaic."""
    meanings = [meaning.name for meaning in file.colorinterp]
    numbers = {name: meanings.index(name) + 1 for name in meanings}
    # GDAL leaves two things to those who show a picture: TIFFs whose 0 is white, and colours that are multiplied.
    tags = _tags_of(path) if path.suffix.lower() in _TIFFS else TiffTags({})
    return Description(
        path=path,
        size=(file.width, file.height),
        count=file.count,
        colours=named_colours(numbers),
        alpha=numbers.get("alpha"),
        premultiplied=tags.is_premultiplied,
        white_is_zero=tags.photometric == WHITE_IS_ZERO,
        bits=_bits_of(file),
    )


def _bits_of(file: Raster) -> int | None:
    """Tell the bits of the values without a sign, as the file states them; None for numbers of other kinds."""
    kinds = {*file.dtypes}
    if not kinds <= {"uint8", "uint16"}:
        return None
    bits = 16 if "uint16" in kinds else 8
    if isinstance(file, Mosaic):  # of files that may differ
        return bits
    # GDAL has no type of 12 bits, and gives those of the next larger one.
    dataset = cast(Dataset, file)
    stated = dataset.tags(ns="IMAGE_STRUCTURE", bidx=1).get("NBITS", "")
    return min(int(stated), bits) if stated.isdecimal() and int(stated) else bits


def open_by_windows(
    path: str | PathLike[str], *, white: White | None = None, bands: ChosenBands = None
) -> LargePicture:
    """Open a file whose name is that of a TIFF or a raster (`BY_WINDOWS`).

    Args:
        path: the file.
        white: as for `semfov.read_image`.
        bands: numbers of the bands that are shown; None for those that the file names.

    Returns:
        The picture.

    Raises:
        DataError: no reader can read the file.
        InputError: it has no such bands.
    """
    if Path(path).suffix.lower() in RASTERS:
        return _open_raster(path, white, bands)
    return _open_tiff(path, white, bands)


def _open_raster(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """Open a raster by GDAL; JPEG 2000 by Pillow where rasterio is not there."""
    try:
        return RasterPicture(path, white=white, bands=bands)
    except DataError:
        if Path(path).suffix.lower() == ".jp2" and bands is None:
            with suppress(DataError):
                return PhotographPicture(path, white)
        raise


def _open_tiff(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """Open a TIFF by the first reader that has all of it: tifffile, GDAL or Pillow."""
    with quiet_decoders:
        check_no_raw(path)
    if _is_converted(path):
        expected = f"None for {path}, which is turned, or of other colours than grey and RGB"
        check(bands is None, "bands", expected, f"{bands}; convert it")
        return PhotographPicture(path, white)
    try:
        tiff = TiffPicture(path, white=white, bands=bands)
        if tiff.stands_alone():
            return tiff
    except DataError as refusal:
        picture = _open_otherwise(path, white, bands)
        if picture is None:
            raise refusal from None
        return picture
    # Reduced copies and masks are GDAL's.
    try:
        return RasterPicture(path, white=white, bands=bands)
    except DataError:
        if tiff.has_mask():
            warnings.warn(f'image {path}: its mask is not read; pip install "semfov[geo]"', stacklevel=2)
        return tiff


def _open_otherwise(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture | None:
    """Open a TIFF that tifffile leaves; None where no other reader can read it."""
    with suppress(DataError):
        return RasterPicture(path, white=white, bands=bands)
    if bands is None:
        with suppress(DataError):
            photograph = PhotographPicture(path, white)
            photograph.read((0, 0, 1, 1))  # raises where Pillow cannot decode it
            return photograph
    return None


def _is_converted(path: str | PathLike[str]) -> bool:
    """Tell whether a TIFF is turned, or of other colours than grey and RGB, which Pillow alone converts."""
    tags = _tags_of(path)
    is_turned = tags.orientation != UPRIGHT
    # Of others Pillow reads none, or the first band as grey.
    can_turn = tags.photometric > 1 or tags.samples <= 2
    got = f"{tags.orientation} of {tags.samples} bands; turn it upright"
    check_data(not is_turned or can_turn, f"image {Path(path)}", "orientation 1 of bands without colours", got)
    # tifffile gives the colours of JPEGs as RGB.
    is_rgb_of_jpeg = tags.photometric == YCBCR and tags.compression == JPEG
    return is_turned or (tags.photometric > PALETTE and not is_rgb_of_jpeg)


def _tags_of(path: str | PathLike[str]) -> TiffTags:
    """Read the tags of the first page of a TIFF; none where they cannot be read."""
    check_regular(path, f"image {Path(path)}")
    with quiet_decoders:
        # Decoders of damaged files raise errors of many kinds.
        with suppress(Exception), open_pillow(path) as image:
            return TiffTags.of_image(image)
        with suppress(Exception):
            import tifffile

            with tifffile.TiffFile(path, _multifile=False) as file:
                return TiffTags.of_page(file.pages.first)
    return TiffTags({})
