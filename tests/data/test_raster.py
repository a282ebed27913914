"""Rasters that GDAL reads: the pixels of other readers, overviews, and refusals; what they name is never opened."""

import socket
import sys
import threading
from xml.sax.saxutils import escape

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from semfov import SemfovError, read_image
from semfov.data.large import ArrayPicture, open_large, picture_size
from semfov.data.rasters import RasterPicture
from semfov.data.tiff import TiffPicture
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


def empty(rasterio, path, side, block):
    """An open GeoTIFF in which no tile is stored until it is written."""
    return rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=3, dtype="uint8", tiled=True, blockxsize=block,
        blockysize=block, sparse_ok="true", compress="deflate", transform=rasterio.transform.Affine.scale(2.0),
    )  # fmt: skip


@pytest.mark.parametrize("box", [(0, 0, 230, 150), (17, 33, 99, 120), (229, 149, 230, 150)])
def test_windows_have_the_pixels_of_the_array(rasterio, tmp_path, box):
    array = pixels()
    expected = ArrayPicture(array).read(box)
    planes = write(rasterio, tmp_path / "planes.tif", array, interleave="band")
    wide = write(rasterio, tmp_path / "wide.tif", array.astype(np.uint16) * 257)
    for path in (planes, wide, write(rasterio, tmp_path / "copies.tif", array, (2, 4))):
        picture = RasterPicture(path)
        assert picture.size == picture_size(path) == (230, 150)
        assert torch.equal(picture.read(box), expected)
    grey = RasterPicture(write(rasterio, tmp_path / "grey.tif", array[..., :1]))
    assert torch.equal(grey.read(box), expected[:1].expand(3, -1, -1))


def test_channels_are_the_bands_with_their_names(rasterio, tmp_path):
    array = pixels()
    five = np.concatenate([array[..., :1] // 2, array[..., ::-1], array[..., :1] // 3], -1)
    path = write(rasterio, tmp_path / "five.tif", five)
    with rasterio.open(path, "r+") as file:
        meaning = rasterio.enums.ColorInterp
        file.colorinterp = meaning.undefined, meaning.blue, meaning.green, meaning.red, meaning.undefined
    for reader in (RasterPicture, TiffPicture):
        assert np.array_equal(reader(path).pixels((5, 6, 50, 40)), array[6:40, 5:50])


def test_coarse_windows_come_from_the_overviews(rasterio, large, tmp_path):
    """The overviews of this file are darker than its pixels, so that it is seen where windows come from."""
    array = np.full((256, 384, 3), 200, np.uint8)
    path = write(rasterio, tmp_path / "a.tif", array, (2, 4, 8))
    with rasterio.open(path, "r+", overview_level=1) as file:  # reduced by 4
        file.write(np.full((3, 64, 96), 50, np.uint8))
    picture = open_large(path)
    assert isinstance(picture, RasterPicture)
    assert picture.reduction(6) == 4
    assert set(picture.read((64, 32, 192, 160), 4).flatten().tolist()) == {50}
    assert set(picture.read((64, 32, 192, 160), 8).flatten().tolist()) == {200}
    assert set(picture.read((64, 32, 192, 160)).flatten().tolist()) == {200}
    assert picture.read((1, 1, 9, 9), 4).shape == (3, 3, 3)


def test_coarse_windows_show_the_place_they_are_of(rasterio, large, tmp_path):
    down, across = np.indices((240, 250))
    array = np.stack([across, down, across], -1).astype(np.uint8)
    with_copies = open_large(write(rasterio, tmp_path / "a.tif", array, (2, 4, 8)))
    without = RasterPicture(write(rasterio, tmp_path / "b.tif", array))
    for box in ((16, 8, 80, 72), (0, 0, 248, 240)):
        expected = ArrayPicture(array).read(box, 8)
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
    assert not isinstance(open_large(write(rasterio, tmp_path / "a.tif", pixels())), RasterPicture)
    planes = write(rasterio, tmp_path / "b.tif", pixels(), interleave="band")
    assert np.array_equal(open_large(planes).pixels((5, 6, 50, 40)), pixels()[6:40, 5:50])


def test_what_is_no_picture_is_refused(rasterio, tmp_path):
    with pytest.raises(DataError, match=r"expected bands of 8 or 16 bits, got float32; give white="):
        RasterPicture(write(rasterio, tmp_path / "a.tif", pixels().astype(np.float32)))
    palette = write(rasterio, tmp_path / "b.tif", pixels()[..., :1], photometric="palette")
    with rasterio.open(palette, "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0, 255), 1: (255, 0, 0, 255)})
    unusable("got a palette", RasterPicture, palette)
    (tmp_path / "c.vrt").write_text("no raster")
    unusable("expected the XML text of a mosaic", open_large, tmp_path / "c.vrt")
    unusable("no such file", open_large, tmp_path / "d.jp2")
    copies = write(rasterio, tmp_path / "e.tif", pixels(), (2, 4))
    refused("box: expected a window inside 230 × 150 pixels", RasterPicture(copies).read, (0, 0, 231, 150), 4)


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


SECRET = b"TOPSECRET" * 200
RAW = (
    '<VRTDataset rasterXSize="32" rasterYSize="32"><VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand">'
    '<SourceFilename relativetoVRT="{relative}">{name}</SourceFilename><ImageOffset>0</ImageOffset>'
    "<PixelOffset>1</PixelOffset><LineOffset>32</LineOffset></VRTRasterBand></VRTDataset>"
)
WMS = (
    '<GDAL_WMS><Service name="TMS"><ServerUrl>{name}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service><DataWindow>'
    "<UpperLeftX>-1</UpperLeftX><UpperLeftY>1</UpperLeftY><LowerRightX>1</LowerRightX><LowerRightY>-1</LowerRightY>"
    "<TileLevel>1</TileLevel><TileCountX>1</TileCountX><TileCountY>1</TileCountY></DataWindow>"
    "<Projection>EPSG:4326</Projection><BandsCount>3</BandsCount></GDAL_WMS>"
)


def mosaic(name, relative=1, size=(64, 48), kind="SimpleSource", more="", band="", system="EPSG:3857", source=""):
    width, height = size
    return (
        f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}"><SRS>{system}</SRS>{more}'
        f'<VRTRasterBand dataType="Byte" band="1"{band}><{kind}><SourceFilename relativeToVRT="{relative}">'
        f"{escape(name)}</SourceFilename>{source}<SourceBand>1</SourceBand></{kind}></VRTRasterBand></VRTDataset>"
    )


@pytest.fixture
def private(tmp_path):
    """A file of another folder than that of the pictures."""
    for name in ("private", "public"):
        (tmp_path / name).mkdir()
    (tmp_path / "private/secret.txt").write_bytes(SECRET)
    Image.fromarray(pixels()).save(tmp_path / "private/photo.png")
    return tmp_path / "private"


@pytest.fixture
def address():
    """Address of a server, and the requests that it got."""
    requests: list[bytes] = []
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        while True:
            try:
                client, _ = server.accept()
            except OSError:
                return
            with client:
                requests.append(client.recv(1000))
                client.sendall(b"HTTP/1.0 404 Not Found\r\n\r\n")

    threading.Thread(target=serve, daemon=True).start()
    yield f"http://127.0.0.1:{server.getsockname()[1]}", requests
    server.close()


@pytest.mark.parametrize("suffix", [".tif", ".tiff", ".jp2", ".png", ".jpg", ".vrt"])
@pytest.mark.parametrize("text", [RAW, WMS, mosaic], ids=["raw band", "map service", "mosaic"])
def test_text_is_no_photograph(rasterio, private, address, text, suffix):
    """What GDAL would read by its content is refused under every name, and nothing else is opened."""
    url, requests = address
    for name in (
        private / "secret.txt",
        private / "photo.png",
        url,
        f"/vsicurl/{url}/a.tif",
        f"/vsizip/{private}/a.zip",
    ):
        path = private.parent / f"public/photo{suffix}"
        path.write_text(text(str(name), 0) if text is mosaic else text.format(relative=0, name=name))
        for read in (open_large, picture_size, read_image, RasterPicture):
            if read is not RasterPicture or suffix in (".tif", ".tiff", ".jp2", ".vrt"):
                with pytest.raises(SemfovError):
                    read(path)
    assert not requests


@pytest.mark.parametrize("place", ["tag", "aux.xml", "ovr"])
def test_reduced_copies_are_those_of_the_file(rasterio, private, address, place):
    """A sound GeoTIFF may name another file, an address or a mosaic as its reduced copies."""
    url, requests = address
    raw = RAW.format(relative=0, name=private / "secret.txt")
    for name in (raw, f"/vsicurl/{url}/a.tif", str(private / "photo.png")):
        path = private.parent / "public/photo.tif"
        item = f'<Item name="OVERVIEW_FILE" domain="OVERVIEWS">{escape(name)}</Item>'
        tags = [(42112, "s", 0, f"<GDALMetadata>{item}</GDALMetadata>", True)] if place == "tag" else []
        array = np.full((64, 64), 7, np.uint8)
        tifffile.imwrite(path, array, tile=(64, 64), extratags=tags)
        if place == "aux.xml":
            key = f'<MDI key="OVERVIEW_FILE">{escape(name)}</MDI>'
            text = f'<PAMDataset><Metadata domain="OVERVIEWS">{key}</Metadata></PAMDataset>'
            path.with_name("photo.tif.aux.xml").write_text(text)
        elif place == "ovr":
            path.with_name("photo.tif.ovr").write_text(raw)
        if place == "tag":
            unusable("with overviews of its own", RasterPicture, path)
            mosaics = path.with_name("mosaic.vrt")
            mosaics.write_text(mosaic("photo.tif", size=(64, 64)))
            unusable(r"photo\.tif: expected a raster with overviews of its own", RasterPicture, mosaics)
        else:
            picture = RasterPicture(path)
            assert not picture._has_overviews
            assert picture.pixels((0, 0, 64, 64), 2).max() == picture.pixels((0, 0, 64, 64), 2).min() == 7
    assert not requests


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        (mosaic("../private/photo.png"), "in the folder of the mosaic or below"),
        (mosaic("link.png"), "in the folder of the mosaic or below"),
        (mosaic("/vsicurl/http://127.0.0.1/a.png", 0), "in the folder of the mosaic or below"),
        (mosaic("/vsizip/photo.zip/a.png", 1), "in the folder of the mosaic or below"),
        (mosaic(RAW, 1), "sources that are files"),
        (mosaic("http://127.0.0.1/a.png", 1), "sources that are files"),
        (mosaic("text.tif"), "TIFF, JPEG 2000, PNG or JPEG"),
        (mosaic("other.vrt"), "TIFF, JPEG 2000, PNG or JPEG"),
        (mosaic("a.png", band=' subClass="VRTRawRasterBand"'), "the kind 'VRTRawRasterBand'"),
        (mosaic("a.png", band=' SUBCLASS="VRTDerivedRasterBand"'), "the kind 'VRTDerivedRasterBand'"),
        (mosaic("a.png", kind="ArraySource"), "the kind 'ArraySource'"),
        (mosaic("a.png", kind="KernelFilteredSource"), "the kind 'KernelFilteredSource'"),
        (mosaic("a.png", more="<GDALWarpOptions/>"), "the kind 'GDALWarpOptions'"),
        (mosaic("a.png", more="<vrtrasterband/>"), "the kind 'vrtrasterband'"),
        (mosaic("a.png", source="<OpenOptions/>"), "the kind 'OpenOptions'"),
        (mosaic("a.png", source="<sourcefilename>../private/photo.png</sourcefilename>"), "the kind 'sourcefilename'"),
        (mosaic("a.png", system="http://127.0.0.1/a.prj"), "reference system"),
        (mosaic("a.png", system="../private/secret.txt"), "reference system"),
        (WMS, "expected a mosaic, a VRTDataset"),
        ("no XML", "expected the XML text of a mosaic"),
        ('<!DOCTYPE x [<!ENTITY e SYSTEM "../private/secret.txt">]>' + mosaic("a.png", system="&e;"), "XML text"),
    ],
)
def test_what_a_mosaic_may_not_name(rasterio, private, text, refused):
    folder = private.parent / "public"
    Image.fromarray(pixels()).save(folder / "a.png")
    (folder / "link.png").symlink_to("../private/photo.png")
    for name, content in (
        ("text.tif", RAW),
        ("other.vrt", mosaic("a.png")),
        ("mosaic.vrt", text.replace("&amp;e;", "&e;")),
    ):
        (folder / name).write_text(content)
    unusable(refused, open_large, folder / "mosaic.vrt")


def test_a_mosaic_names_files_of_its_folder(rasterio, private, monkeypatch):
    """By relative and absolute names, also from another folder of work; what describes it is left out."""
    folder = private.parent / "public"
    (folder / "below").mkdir()
    Image.fromarray(pixels()).save(folder / "below/a.png")
    monkeypatch.chdir(folder)
    more = '<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">../private/photo.png</MDI></Metadata>'
    for name, relative in (("below/a.png", 1), ("below/a.png", 0), (str(folder / "below/a.png"), 0)):
        (folder / "b.vrt").write_text(mosaic(name, relative, size=(230, 150), more=more))
        picture = open_large(folder / "b.vrt")
        assert np.array_equal(picture.pixels((0, 0, 230, 150))[..., 0], pixels()[..., 0])
    assert georeference(str(folder / "b.vrt")) is None  # a system without a place


def test_rasters_that_claim_more_than_they_hold(rasterio, tmp_path):
    """Two sides of 2^31 pixels, and a million squared in a kilobyte."""
    Image.fromarray(pixels()).save(tmp_path / "a.png")
    for size, said in (
        ((2_000_000_000, 2), "at most 1,048,576 pixels along a side"),
        ((10**6, 10**6), "in proportion"),
    ):
        (tmp_path / "b.vrt").write_text(mosaic("a.png", size=size))
        unusable(said, open_large, tmp_path / "b.vrt")
    empty(rasterio, tmp_path / "b.tif", 10**5, 4096).close()
    for reader in (open_large, RasterPicture):
        unusable(r"in proportion to the file, got 10,000,000,000 in [\d,]+ bytes", reader, tmp_path / "b.tif")


def test_names_are_no_addresses(rasterio, private, monkeypatch):
    """Files whose names GDAL or rasterio would take for something else."""
    folder = private.parent / "public"
    monkeypatch.chdir(folder)
    for name in ("GTIFF_DIR:1:a.tif", "zip+file!a.tif", "a?b=c#d.tif", "gzip:a.tif"):
        write(rasterio, folder / name, pixels())
        assert RasterPicture(name).size == (230, 150)
        assert georeference(name) is not None


@pytest.mark.parametrize("kind", ["eps", "pcx", "tga", "ico", "sgi", "dds"])
def test_pillow_reads_photographs_alone(tmp_path, kind):
    """Some other formats start programs or are made of other files."""
    path = tmp_path / "a.png"
    Image.fromarray(pixels()).save(path, kind)
    for read in (read_image, open_large, picture_size):
        unusable(r"not an image in a format that is read|cannot identify", read, path)
