"""Files that GDAL would read by their content: other files and addresses in them are never opened."""

import socket
import sys
import threading
import types
from xml.etree import ElementTree as XML
from xml.sax.saxutils import escape

import numpy as np
import pytest
import tifffile
from PIL import Image

from semfov import SemfovError, read_image
from semfov.data.gdal import _mosaic_text
from semfov.data.large import _RasterPicture, open_large, picture_size
from semfov.paths.georeference import georeference
from tests.data.test_large import pixels
from tests.data.test_raster import rasterio, write
from tests.refusals import unusable

__all__ = ["rasterio"]

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
        for read in (open_large, picture_size, read_image, _RasterPicture):
            if read is not _RasterPicture or suffix in (".tif", ".tiff", ".jp2", ".vrt"):
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
            unusable("with overviews of its own", _RasterPicture, path)
            mosaics = path.with_name("mosaic.vrt")
            mosaics.write_text(mosaic("photo.tif", size=(64, 64)))
            unusable(r"photo\.tif: expected a raster with overviews of its own", _RasterPicture, mosaics)
        else:
            picture = _RasterPicture(path)
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
def test_what_a_mosaic_may_not_name(private, text, refused):
    folder = private.parent / "public"
    Image.fromarray(pixels()).save(folder / "a.png")
    (folder / "link.png").symlink_to("../private/photo.png")
    for name, content in (
        ("text.tif", RAW),
        ("other.vrt", mosaic("a.png")),
        ("mosaic.vrt", text.replace("&amp;e;", "&e;")),
    ):
        (folder / name).write_text(content)
    unusable(refused, _mosaic_text, folder / "mosaic.vrt")


def test_a_mosaic_names_files_of_its_folder(private, monkeypatch):
    """By relative and absolute names, also from another folder of work; what describes it is left out."""
    folder = private.parent / "public"
    (folder / "below").mkdir()
    Image.fromarray(pixels()).save(folder / "below/a.png")
    monkeypatch.chdir(folder)
    more = '<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">../private/photo.png</MDI></Metadata>'
    for name, relative in (("below/a.png", 1), ("below/a.png", 0), (str(folder / "below/a.png"), 0)):
        (folder / "b.vrt").write_text(mosaic(name, relative, more=more))
        root = XML.fromstring(_mosaic_text(folder / "b.vrt"))
        assert [part.tag for part in root] == ["SRS", "VRTRasterBand"]
        (source,) = root.iter("SourceFilename")
        assert (source.text, source.attrib) == (str(folder / "below/a.png"), {"relativeToVRT": "0"})


def test_a_raster_has_its_driver_and_a_limit_of_size(tmp_path, monkeypatch):
    """With a stand-in for rasterio, which knows neither files nor drivers."""
    opened = []

    class Raster(types.SimpleNamespace):
        def tags(self, ns):
            return {}

        def close(self):
            opened.append("closed")

    def stand_in(source, driver):
        opened.append(driver)
        return Raster(width=2**31, height=2)

    class Env:
        def __init__(self, **settings):
            assert settings["GDAL_DISABLE_READDIR_ON_OPEN"] == "EMPTY_DIR"

        def __enter__(self):
            return self

        def __exit__(self, *error):
            return None

    monkeypatch.setitem(sys.modules, "rasterio", types.SimpleNamespace(open=stand_in, Env=Env))
    Image.fromarray(pixels()).save(tmp_path / "a.png")
    for name, driver in (("a.tif", "GTiff"), ("a.TIFF", "GTiff"), ("a.jp2", "JP2OpenJPEG"), ("a.vrt", "VRT")):
        (tmp_path / name).write_text(mosaic("a.png"))
        unusable(r"at most 1,048,576 pixels along a side, got 2147483648 × 2", _RasterPicture, tmp_path / name)
        assert opened.pop() == "closed"
        assert opened.pop() == driver
    assert not opened


def test_a_mosaic_of_two_thousand_million_pixels_is_refused(rasterio, tmp_path):
    Image.fromarray(pixels()).save(tmp_path / "a.png")
    path = tmp_path / "b.vrt"
    path.write_text(mosaic("a.png", size=(2_000_000_000, 2_000_000_000)))
    unusable("at most 1,048,576 pixels along a side", open_large, path)


def test_names_are_no_addresses(rasterio, private, monkeypatch):
    """Files whose names GDAL or rasterio would take for something else."""
    folder = private.parent / "public"
    monkeypatch.chdir(folder)
    for name in ("GTIFF_DIR:1:a.tif", "zip+file!a.tif", "a?b=c#d.tif", "gzip:a.tif"):
        write(rasterio, folder / name, pixels())
        assert _RasterPicture(name).size == (230, 150)
        assert georeference(name) is not None


@pytest.mark.parametrize("kind", ["eps", "pcx", "tga", "ico", "sgi", "dds"])
def test_pillow_reads_photographs_alone(tmp_path, kind):
    """Some other formats start programs or are made of other files."""
    path = tmp_path / "a.png"
    Image.fromarray(pixels()).save(path, kind)
    for read in (read_image, open_large, picture_size):
        unusable(r"not an image in a format that is read|cannot identify", read, path)
