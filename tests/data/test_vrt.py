"""Mosaics that are composed here have the values that GDAL's own reader gives."""

import warnings

import numpy as np
import pytest
from PIL import Image

from semfov.data.gdal import raster_settings
from semfov.data.images import quiet_decoders
from semfov.data.large import open_large
from semfov.data.vrt import Mosaic
from tests.data.test_large import pixels
from tests.refusals import unusable

rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")

WIDE, HIGH = 300, 200
WHOLE = 0, 0, WIDE, HIGH


def blocks(count=3, kind="uint8", most=255, seed=0):
    """Squares of eight pixels."""
    values = np.random.default_rng(seed).random((HIGH // 8, -(-WIDE // 8), count))
    return (np.kron(values, np.ones((8, 8, 1)))[:, :WIDE] * most).astype(kind)


def save(path, array, copies=(), mask=None, **options):
    shape = {"height": HIGH, "width": WIDE, "count": array.shape[2], "dtype": array.dtype}
    tiles = {"tiled": True, "blockxsize": 64, "blockysize": 64, "transform": rasterio.transform.Affine.scale(2.0)}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", driver="GTiff", **shape, **tiles, **options) as file,
    ):
        file.write(np.moveaxis(array, -1, 0))
        if mask is not None:
            file.write_mask(mask)
        if copies:
            file.build_overviews(list(copies), rasterio.enums.Resampling.average)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mosaics")
    save(folder / "a.tif", blocks(), (2, 4))
    save(folder / "b.tif", blocks(seed=1), (2, 4))
    save(folder / "wide.tif", blocks(kind="uint16", most=4000))
    save(folder / "floats.tif", blocks(kind="float32", most=9))
    holes = blocks(seed=2)
    holes[:, :50] = 0
    save(folder / "holes.tif", holes, nodata=0)
    mask = np.full((HIGH, WIDE), 255, np.uint8)
    mask[50:90, 60:100] = 0
    save(folder / "masked.tif", blocks(seed=3), mask=mask)
    for name in ("a.png", "a.jpg"):
        Image.fromarray(blocks(seed=4)).save(folder / name)
    Image.fromarray(blocks(seed=5)).quantize(64).save(folder / "palette.png")
    return folder


def rect(name, given):
    x, y, width, height = given
    return f'<{name} xOff="{x}" yOff="{y}" xSize="{width}" ySize="{height}"/>'


def source(name, band, seen=WHOLE, place=WHOLE, kind="SimpleSource", more="", given=""):
    rects = "" if seen is None else rect("SrcRect", seen) + rect("DstRect", place)
    file = f'<SourceFilename relativeToVRT="1">{name}</SourceFilename><SourceBand>{band}</SourceBand>'
    return f"<{kind}{given}>{file}{rects}{more}</{kind}>"


def mosaic(width, height, sources, kind="Byte", before="", after="", bands=3):
    text = "".join(
        f'<VRTRasterBand dataType="{kind}" band="{band}">{before}{sources(band)}</VRTRasterBand>'
        for band in range(1, bands + 1)
    )
    return f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">{text}{after}</VRTDataset>'


def one(*given, **options):
    return lambda band: source(given[0], band, *given[1:], **options)


def two(first, second):
    return lambda band: first(band) + second(band)


BESIDE, OVER, HALF = (WIDE, 0, WIDE, HIGH), (150, 60, WIDE, HIGH), (0, 0, 150, 100)
COMPLEX = "ComplexSource"
SCALED = "<ScaleOffset>-3.7</ScaleOffset><ScaleRatio>.07</ScaleRatio>"
COLOUR = "<ColorTableComponent>{}</ColorTableComponent>"
PLAIN = {
    "side by side": mosaic(600, 200, two(one("a.tif"), one("b.tif", WHOLE, BESIDE))),
    "one over another": mosaic(450, 260, two(one("a.tif"), one("b.tif", WHOLE, OVER))),
    "without rectangles": mosaic(300, 200, one("a.tif", None)),
    "a place that begins outside": mosaic(300, 200, one("a.tif", WHOLE, (-50, -20, WIDE, HIGH))),
    "a part that begins outside": mosaic(300, 200, one("a.tif", (-20, -10, 200, 100), (10, 10, 200, 100))),
    "twice as large": mosaic(600, 400, one("a.tif", WHOLE, (0, 0, 600, 400))),
    "larger and smooth": mosaic(600, 400, one("a.tif", WHOLE, (0, 0, 600, 400), given=' resampling="bilinear"')),
    "half as large": mosaic(150, 100, one("a.tif", WHOLE, HALF)),
    "averages": mosaic(150, 100, one("a.tif", WHOLE, HALF, kind="AveragedSource")),
    "photographs": mosaic(600, 200, two(one("a.png"), one("a.jpg", WHOLE, BESIDE))),
    "nothing": mosaic(450, 260, one("a.tif"), before="<NoDataValue>77</NoDataValue>"),
    "nothing, not told": mosaic(
        450, 260, one("a.tif"), before="<NoDataValue>77</NoDataValue><HideNoDataValue>1</HideNoDataValue>"
    ),
    "holes": mosaic(
        450, 260, two(one("a.tif"), one("holes.tif", WHOLE, OVER, COMPLEX, "<NODATA>0</NODATA>")),
        before="<NoDataValue>0</NoDataValue>",
    ),
    "holes of its own": mosaic(450, 260, two(one("a.tif"), one("b.tif", WHOLE, OVER, COMPLEX, "<NODATA>101</NODATA>"))),
    "scaled": mosaic(300, 200, one("wide.tif", kind=COMPLEX, more=SCALED)),
    "cut to bytes": mosaic(300, 200, one("wide.tif")),
    "16 bits": mosaic(300, 200, one("wide.tif"), "UInt16"),
    "floats": mosaic(300, 200, one("floats.tif"), "Float32"),
    "rounded": mosaic(300, 200, one("floats.tif")),
    "a table": mosaic(300, 200, one("a.tif", kind=COMPLEX, more="<LUT>0:0,100:200,255:255</LUT>")),
    "a mask of a source": mosaic(300, 200, one("masked.tif", kind=COMPLEX, more="<UseMaskBand>true</UseMaskBand>")),
    "a mask": mosaic(
        300, 200, one("masked.tif"),
        after=f'<MaskBand><VRTRasterBand dataType="Byte">{source("masked.tif", "mask,1")}</VRTRasterBand></MaskBand>',
    ),
    "colours of a palette": mosaic(
        300, 200, lambda band: source("palette.png", 1, kind=COMPLEX, more=COLOUR.format(band))
    ),
}  # fmt: skip


def opened(path):
    """A mosaic by our reader and by GDAL's."""
    with quiet_decoders, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Mosaic(path), rasterio.open(path, driver="VRT")


@pytest.mark.parametrize("text", PLAIN.values(), ids=PLAIN)
@pytest.mark.parametrize("window", [None, (17, 23, 101, 66)])
def test_a_mosaic_has_the_values_that_gdal_gives(folder, text, window):
    path = folder / "mosaic.vrt"
    path.write_text(text)
    with raster_settings():
        ours, theirs = opened(path)
        with theirs, ours:
            assert (ours.width, ours.height, ours.count) == (theirs.width, theirs.height, theirs.count)
            assert ours.dtypes == theirs.dtypes
            assert ours.nodatavals == theirs.nodatavals
            x, y, width, height = window or (0, 0, ours.width, ours.height)
            given = {
                "window": rasterio.windows.Window(x, y, width, height),
                "resampling": rasterio.enums.Resampling.average,
            }
            want = theirs.read(**given)
            assert np.array_equal(ours.read([1, 2, 3], out_shape=want.shape, **given), want)
            if "MaskBand" in text and "UseMaskBand" not in text:
                mask = theirs.read_masks([1], **given)
                assert np.array_equal(ours.read_masks([1], out_shape=mask.shape, **given), mask)


@pytest.mark.parametrize("name", ["side by side", "one over another", "a part that begins outside"])
def test_coarse_windows_are_as_near_to_averages_as_gdal_s(folder, name):
    """From overviews, by 8: places end within pixels."""
    path = folder / "coarse.vrt"
    path.write_text(PLAIN[name])
    with raster_settings():
        ours, theirs = opened(path)
        width, height = ours.width // 8 * 8, ours.height // 8 * 8
        window = rasterio.windows.Window(0, 0, width, height)
        given = {"window": window, "out_shape": (3, height // 8, width // 8)}
        given["resampling"] = rasterio.enums.Resampling.average
        full = theirs.read(window=window).astype(float)
        average = full.reshape(3, height // 8, 8, width // 8, 8).mean((2, 4))
        errors = [np.abs(each.read([1, 2, 3], **given) - average).mean() for each in (ours, theirs)]
        ours.close()
        theirs.close()
    assert errors[0] <= errors[1] * 1.2


def test_a_place_between_pixels_takes_the_nearest(folder):
    path = folder / "between.vrt"
    path.write_text(mosaic(500, 300, one("a.tif", WHOLE, (100.3, 50.7, WIDE, HIGH))))
    shown = open_large(path).pixels((0, 0, 500, 300))
    assert np.array_equal(shown[52:250, 101:399], blocks()[1:199, 1:299])
    assert not shown[:50].any()
    assert not shown[:, :100].any()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (mosaic(300, 200, one("a.tif")).replace("<DstRect", "<Dst"), "the kind 'Dst'"),
        (mosaic(300, 200, lambda band: source("a.tif", band).split("<DstRect")[0] + "</SimpleSource>"), "both SrcRect"),
        (mosaic(300, 200, lambda band: source("a.tif", 4)), "a band of a.tif from 1 to 3"),
        (mosaic(300, 200, one("a.tif"), "CFloat32"), "bands of Byte"),
        (mosaic(300, 200, one("a.tif", WHOLE, (0, 0, -5, 10))), "a width and a height of DstRect"),
        (mosaic(300, 200, one("a.tif", WHOLE, (0, 0, "x", 10))), "expected 1 numbers"),
        (mosaic(0, 200, one("a.tif")), "a width and a height"),
        (mosaic(300, 200, one("a.tif", given=' resampling="gauss"')), "a resampling of"),
        (mosaic(300, 200, one("a.tif", kind=COMPLEX, more="<Exponent>2</Exponent>")), "the kind 'Exponent'"),
        (mosaic(300, 200, lambda band: source("a.tif", band) * 70), "cover it at most 16 times"),
        (mosaic(300, 200, one("a.tif"), bands=0), "at least one band"),
        (mosaic(300, 200, lambda band: source("a.tif", band) * 11_000), "at most 32,768 sources, got 33,000"),
    ],
)
def test_what_a_mosaic_may_not_say(folder, text, said):
    (folder / "bad.vrt").write_text(text)
    unusable(said, open_large, folder / "bad.vrt")


def test_many_files_are_not_open_at_once(tmp_path):
    """More files than are kept open, of which each window opens what it shows."""
    sources = {}
    for number in range(80):
        Image.fromarray(pixels(8, 8, number)).save(tmp_path / f"{number}.png")
        sources[number] = (0, 0, 8, 8), (number * 8, 0, 8, 8)
    text = mosaic(640, 8, lambda band: "".join(source(f"{n}.png", band, *rects) for n, rects in sources.items()))
    (tmp_path / "a.vrt").write_text(text)
    picture = open_large(tmp_path / "a.vrt")
    want = np.concatenate([pixels(8, 8, number) for number in range(80)], 1)
    for _ in range(2):
        assert np.array_equal(picture.pixels((0, 0, 640, 8)), want)
    assert picture._file._open.cache_info().currsize <= 64
