"""Whatever a raster holds, or lies beside it: no other file is opened, and no request is sent."""

import sys
from contextlib import suppress
from itertools import product

import numpy as np
import pytest
import tifffile
from PIL import Image

from benchmarks.fuzz.watch import listener, opened_files
from semfov import SemfovError, read_image
from semfov.data.large import open_large, picture_size
from semfov.data.rasters import RasterPicture
from semfov.data.sources import open_stream
from semfov.paths.georeference import georeference
from tests.refusals import unusable

rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs inotify")

SECRET = 201  # of all pixels of the other folder; no picture here has it
SIDE = 64


@pytest.fixture
def address():
    """Address of a server, and the requests that it got."""
    with listener() as heard:
        yield heard


@pytest.fixture
def folders(tmp_path):
    """A folder of pictures, and another one with a secret."""
    for name in ("public", "private"):
        (tmp_path / name).mkdir()
    tifffile.imwrite(tmp_path / "private/secret.tif", np.full((SIDE, SIDE, 3), SECRET, np.uint8), photometric="rgb")
    return tmp_path / "public", tmp_path / "private"


def mosaic(name, relative=0, more=""):
    rect = f'xOff="0" yOff="0" xSize="{SIDE}" ySize="{SIDE}"'
    bands = "".join(
        f'<VRTRasterBand dataType="Byte" band="{band}"><SimpleSource>'
        f'<SourceFilename relativeToVRT="{relative}">{name}</SourceFilename><SourceBand>{band}</SourceBand>'
        f"<SrcRect {rect}/><DstRect {rect}/></SimpleSource></VRTRasterBand>"
        for band in (1, 2, 3)
    )
    return f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">{more}{bands}</VRTDataset>'


def raw(name):
    bands = "".join(
        f'<VRTRasterBand dataType="Byte" band="{band}" subClass="VRTRawRasterBand"><SourceFilename relativetoVRT="0">'
        f"{name}</SourceFilename><PixelOffset>1</PixelOffset><LineOffset>{SIDE}</LineOffset></VRTRasterBand>"
        for band in (1, 2, 3)
    )
    return f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">{bands}</VRTDataset>'


def elsewhere(name):
    """Texts beside a raster by which it would have values, copies or a mask of elsewhere."""
    item = f'<MDI key="OVERVIEW_FILE">{name}</MDI>'
    return {
        "mosaic": mosaic(name),
        "raw": raw(name),
        "metadata": f'<PAMDataset><Metadata domain="OVERVIEWS">{item}</Metadata></PAMDataset>',
        "system": f"<PAMDataset><SRS>{name}</SRS></PAMDataset>",
    }


BESIDE = (
    *("{name}.ovr", "{name}.aux.xml", "{name}.msk", "{stem}.aux", "{stem}.wld", "{stem}.tfw", "{stem}.pgw"),
    *("{stem}.jgw", "{stem}.j2w", "{stem}.prj", "{stem}.tab", "{stem}.IMD", "{stem}.RPB", "{name}.ovr.aux.xml"),
    *(
        "{stem}_RPC.TXT",
        "{stem}.hdr",
        "{stem}.xml",
        "{stem}.rrd",
        "{stem}.json",
        "{stem}.txt",
        "{stem}.sub",
        "world.tfw",
    ),
    *("data.yaml", "classes.txt", "mine.json"),
)
HEADS = (
    *(b"", b"\x89PNG", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\0\x08\0\0\0", b"MM\0*"),
    *(b"BM", b"GIF89a", b"RIFF\0\0\0\0WEBP", b"P6\n"),
    *(b"II+\0\x08\0\0\0", b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP  \r\n\x87\n"),
)
SOURCES = ".tif", ".jp2", ".png", ".jpg"  # of mosaics
KINDS = *SOURCES, ".bmp", ".gif", ".webp", ".ppm"


def picture(path, comment=b""):
    array = np.full((SIDE, SIDE, 3), 60, np.uint8)
    array[: SIDE // 2] = 120
    options = {".jpg": {"comment": comment, "quality": 100}, ".png": {}, ".tif": {"description": comment}}
    Image.fromarray(array).save(path, **options.get(path.suffix, {}))
    return path


def look(path):
    """Read a picture by every door; the pixels of those that take it."""
    for door in (picture_size, lambda path: georeference(str(path))):
        with suppress(SemfovError):
            door(path)
    found = []
    doors = [read_image, open_large]
    if path.suffix in (".tif", ".jp2", ".vrt"):
        doors.append(RasterPicture)
    for door in doors:
        with suppress(SemfovError):
            opened = door(path)
            if door is read_image:
                found.append((opened * 255).round().byte().numpy())
            else:
                found.append(opened.read((0, 0, *opened.size)).numpy())
            if door is RasterPicture:
                found.append(np.moveaxis(opened.pixels((0, 0, *opened.size), 4), -1, 0))
    return found


def check_alone(folders, address, path, allowed, *, read=True):
    """Look at a picture; it is read (or refused), and of all files only those that it consists of are opened."""
    (public, private), (_, requests) = folders, address
    with opened_files(public, private) as names:
        found = look(path)
    assert names <= {path.name, *allowed}
    assert not requests
    assert bool(found) == read or not read
    for pixels in found:
        assert not (abs(pixels.astype(int) - SECRET) <= 3).any()


@pytest.mark.parametrize(("kind", "inside"), [*product(KINDS, [False]), *product(SOURCES, [True])], ids=str)
def test_nothing_beside_a_raster_is_opened(folders, address, kind, inside):
    public, private = folders
    path = picture(public / f"a{kind}")
    shown = path
    if inside:
        shown = public / "b.vrt"
        shown.write_text(mosaic(path.name, relative=1))
    for name in (private / "secret.tif", f"/vsicurl/{address[0]}/a.tif", address[0]):
        for text in elsewhere(name).values():
            for place in {path, shown}:
                for beside in BESIDE:
                    (public / beside.format(name=place.name, stem=place.stem)).write_text(text)
            check_alone(folders, address, shown, {path.name})


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("kind", [*KINDS, ".vrt"])
def test_a_head_is_no_picture(folders, address, kind, head):
    """A mosaic behind the first bytes of a picture, by itself and as a source; GDAL looks for one in a kilobyte."""
    public, private = folders
    for name in (private / "secret.tif", f"/vsicurl/{address[0]}/a.tif"):
        for text in (mosaic(name), raw(name)):
            path = public / f"a{kind}"
            path.write_bytes(head + text.encode())
            (public / "b.vrt").write_text(mosaic(path.name, relative=1))
            for shown in (path, public / "b.vrt"):
                check_alone(folders, address, shown, {path.name}, read=False)


@pytest.mark.parametrize("kind", SOURCES)
def test_what_is_written_in_a_picture_is_no_mosaic(folders, address, kind):
    """A sound picture with the text of a mosaic in its comment, in its metadata, or behind its end."""
    public, private = folders
    for name in (private / "secret.tif", f"/vsicurl/{address[0]}/a.tif"):
        path = picture(public / f"a{kind}", comment=mosaic(name).encode())
        content = path.read_bytes()
        if kind == ".png":
            content = content[:33] + b"\0\0\0\0tEXt" + mosaic(name).encode() + content[33:]
        path.write_bytes(content + mosaic(name).encode())
        (public / "b.vrt").write_text(mosaic(path.name, relative=1))
        for shown in (path, public / "b.vrt"):
            check_alone(folders, address, shown, {path.name}, read=kind != ".png")


def film(path):
    """Write a film of four frames."""
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV (pip install opencv-python-headless)")
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v")), 5, (64, 64)
    )
    for shade in (40, 60, 80, 100):
        writer.write(np.full((64, 64, 3), shade, np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize("kind", [".mp4", ".mkv", ".avi"])
def test_nothing_beside_a_film_is_opened(folders, address, kind):
    public, private = folders
    path = film(public / f"a{kind}")
    for beside in (*BESIDE, "{stem}.srt", "{stem}.idx", "{stem}.m3u8"):
        text = mosaic(private / "secret.tif")
        (public / beside.format(name=path.name, stem=path.stem)).write_text(text)
    with opened_files(public, private) as names:
        assert len([*open_stream(path).frames]) == 4
    assert names == {path.name}
    assert not address[1]


@pytest.mark.parametrize("kind", [".mp4", ".mkv", ".avi", ".gif"])
def test_a_text_with_the_name_of_a_film_opens_nothing(folders, address, kind):
    """Lists of films, a session of a stream, a place for subtitles: FFmpeg knows them by their content."""
    public, private = folders
    film(public / "beside.mp4")
    url, requests = address
    port = url.rpartition(":")[2]
    place = f"m=video {port} RTP/AVP 96\na=rtpmap:96 H264/90000\n"
    texts = [
        *(f"#EXTM3U\n#EXTINF:1,\n{name}\n" for name in (f"{url}/a.ts", private / "secret.tif")),
        *(f"ffconcat version 1.0\nfile '{name}'\n" for name in ("beside.mp4", f"{url}/a", private / "secret.tif")),
        f"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\n{place}",
        f"<?xml version='1.0'?><MPD><Period><BaseURL>{url}/a.mp4</BaseURL></Period></MPD>",
        "# VobSub index file, v7 (do not modify this line!)\nid: en, index: 0\n",
        mosaic(private / "secret.tif"),
    ]
    for text in texts:
        path = public / f"a{kind}"
        path.write_text(text)
        with opened_files(public, private) as names:
            unusable("a text, such as a playlist", open_stream, path)
        assert names == {path.name}
    assert not requests


def siblings(folders, url):
    """Other ways out of a folder: names of pictures, and what is in them."""
    public, private = folders
    secret, remote = private / "secret.tif", f"/vsicurl/{url}/a.tif"
    picture(public / "a.tif")
    (public / "link.tif").symlink_to(secret)
    (public / "folder").symlink_to(private)
    (public / "inner.vrt").write_text(mosaic(secret))
    source = f'<SimpleSource><SourceFilename relativeToVRT="0">{secret}</SourceFilename></SimpleSource>'
    band = '<VRTRasterBand dataType="Byte" band="1"{kind}>{more}</VRTRasterBand>'
    head = f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}"'

    def alone(more, kind="", dataset=""):
        return f"{head}{dataset}>{band.format(kind=kind, more=more)}</VRTDataset>"

    yield "nested.vrt", mosaic("inner.vrt", 1)
    yield "named.tif", mosaic("a.tif", 1)
    yield "up.vrt", mosaic("../private/secret.tif", 1)
    yield "round.vrt", mosaic("../public/../private/secret.tif", 1)
    yield "absolute.vrt", mosaic(secret)
    yield "link.vrt", mosaic("link.tif", 1)
    yield "folder.vrt", mosaic("folder/secret.tif", 1)
    yield "percent.vrt", mosaic("%2e%2e/private/secret.tif", 1)
    for number, name in enumerate(
        (
            *(remote, f"/vsizip/{private}/a.zip/secret.tif", f"/vsisubfile/0_99999,{secret}", "/vsistdin/"),
            *(f"GTIFF_DIR:1:{secret}", f"GTIFF_RAW:{secret}", f"vrt://{secret}", f"NETCDF:{secret}:a", f"PNG:{secret}"),
            *(f"{url}/a.tif", f"WMS:{url}", f"zip+file://{private}/a.zip!secret.tif", f"/vsicached?file={secret}"),
            *(f"file://{secret}", f"DERIVED_SUBDATASET:AMPLITUDE:{secret}", "a.tif\0../private/secret.tif"[:5] + "?x"),
        )
    ):
        for relative in (0, 1):
            yield f"name{number}{relative}.vrt", mosaic(str(name).replace("&", "&amp;").replace("<", "&lt;"), relative)
    yield "dataset.vrt", alone(f"<SourceDataset>{secret}</SourceDataset>", ' subClass="VRTWarpedRasterBand"')
    yield "warped.vrt", f'{head} subClass="VRTWarpedDataset"><GDALWarpOptions><SourceDataset>{secret}</SourceDataset>' \
        "</GDALWarpOptions></VRTDataset>"  # fmt: skip
    yield "pansharpened.vrt", f'{head} subClass="VRTPansharpenedDataset"><PansharpeningOptions><PanchroBand>' \
        f"<SourceFilename>{secret}</SourceFilename></PanchroBand></PansharpeningOptions></VRTDataset>"  # fmt: skip
    yield "processed.vrt", f'{head} subClass="VRTProcessedDataset"><Input><SourceFilename>{secret}</SourceFilename>' \
        "</Input></VRTDataset>"  # fmt: skip
    code = f"<PixelFunctionCode>open('{secret}')</PixelFunctionCode>"
    yield (
        "derived.vrt",
        alone(
            "<PixelFunctionLanguage>Python</PixelFunctionLanguage>" + code + source, ' subClass="VRTDerivedRasterBand"'
        ),
    )
    yield "group.vrt", f'{head}><Group name="/"><Array name="a"><Source><SourceFilename>{secret}</SourceFilename>' \
        "</Source></Array></Group></VRTDataset>"  # fmt: skip
    yield "overview.vrt", alone(f"<Overview><SourceFilename>{secret}</SourceFilename></Overview>")
    yield (
        "options.vrt",
        mosaic("a.tif", 1).replace("<SourceBand>", f"<OpenOptions><OOI>{secret}</OOI></OpenOptions><SourceBand>"),
    )
    yield (
        "mask.vrt",
        mosaic("a.tif", 1).replace(
            "</VRTDataset>", f"<MaskBand>{band.format(kind='', more=source)}</MaskBand></VRTDataset>"
        ),
    )
    yield "system.vrt", mosaic("a.tif", 1, f"<SRS>{private}/system.prj</SRS>")
    yield "system1.vrt", mosaic("a.tif", 1, f"<SRS>{url}</SRS>")
    yield (
        "points.vrt",
        mosaic("a.tif", 1, f'<GCPList Projection="{url}"><GCP Id="" Pixel="1" Line="1" X="1" Y="1"/></GCPList>'),
    )
    yield "entity.vrt", f'<!DOCTYPE x [<!ENTITY e SYSTEM "{secret}">]>' + mosaic("&e;", 1)
    yield "kernel.vrt", mosaic("a.tif", 1).replace("SimpleSource", "KernelFilteredSource")
    yield "complex.vrt", alone(source.replace("SimpleSource", "ComplexSource"))
    yield (
        "metadata.vrt",
        mosaic("a.tif", 1, f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{secret}</MDI></Metadata>'),
    )
    yield "service.tif", f"<GDAL_WMS><Service name='TMS'><ServerUrl>{url}</ServerUrl></Service></GDAL_WMS>"
    yield "index.vrt", f"<GDALTileIndexDataset><IndexDataset>{private}/a.gpkg</IndexDataset></GDALTileIndexDataset>"


def test_other_ways_out_of_a_folder(folders, address):
    public, _ = folders
    picture(public / "a.tif")
    count = 0
    for name, text in siblings(folders, address[0]):
        (public / name).write_text(text)
        check_alone(folders, address, public / name, {"a.tif", "inner.vrt"}, read=False)
        count += 1
    assert count >= 15


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("domain", ["OVERVIEWS", "IMAGE_STRUCTURE", "SUBDATASETS", "GEOLOCATION", "RPC", "xml:VRT", ""])
def test_metadata_of_a_tiff_lead_nowhere(folders, address, domain, bigtiff):
    """What GDAL keeps in a tag of a TIFF: items of every domain that name other files."""
    public, private = folders
    for name in (private / "secret.tif", f"/vsicurl/{address[0]}/a.tif"):
        keys = (
            "OVERVIEW_FILE",
            "MASK_OVERVIEW_FILE",
            "SUBDATASET_1_NAME",
            "X_DATASET",
            "Y_DATASET",
            "INTERNAL_MASK_FLAGS_1",
        )
        items = "".join(f'<Item name="{key}" domain="{domain}">{name}</Item>' for key in keys)
        tags = [(42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>", True)]
        array = np.full((SIDE, SIDE, 3), 60, np.uint8)
        path = public / "a.tif"
        tifffile.imwrite(path, array, tile=(16, 16), photometric="rgb", extratags=tags, bigtiff=bigtiff)
        (public / "b.vrt").write_text(mosaic("a.tif", relative=1))
        for shown in (path, public / "b.vrt"):
            check_alone(folders, address, shown, {"a.tif"}, read=False)


@pytest.mark.parametrize("name", ["../private/secret.tif", "beside.tif"])
def test_a_series_of_ome_opens_no_other_file(folders, address, name):
    """Its planes may be in files that it names."""
    public, _ = folders
    picture(public / "beside.tif")
    (public / "a.tif").write_bytes(b"")
    planes = f'<TiffData IFD="0" PlaneCount="3"><UUID FileName="{name}">urn:uuid:1</UUID></TiffData>'
    sizes = f'SizeX="{SIDE}" SizeY="{SIDE}" SizeC="3" SizeZ="1" SizeT="1"'
    pixels = f'<Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="uint8" {sizes}>{planes}</Pixels>'
    scheme = "http://www.openmicroscopy.org/Schemas/OME/2016-06"
    text = f'<?xml version="1.0"?><OME xmlns="{scheme}"><Image ID="Image:0">{pixels}</Image></OME>'
    array = np.full((SIDE, SIDE), 60, np.uint8)
    tifffile.imwrite(public / "a.tif", array, description=text, metadata=None)
    check_alone(folders, address, public / "a.tif", set())


@pytest.mark.parametrize("kind", ["mmstack", "ndtiff"])
def test_no_series_of_micro_manager_is_followed(folders, address, monkeypatch, kind):
    """tifffile finds its planes in files beside it, or by the names in an index beside it."""
    path = picture(folders[0] / "a.tif")
    monkeypatch.setattr(tifffile.TiffFile, f"is_{kind}", True)
    monkeypatch.setattr(tifffile.TiffFile, f"_series_{kind}", lambda _: pytest.fail("other files are opened"))
    check_alone(folders, address, path, set())


@pytest.mark.parametrize("kind", ["grids of a datum", "grids of a projection"])
def test_a_reference_system_opens_no_file(folders, kind):
    """PROJ would open the files of its grids."""
    public, private = folders
    picture(public / "a.tif")
    grid = private / "grid.gsb"
    grid.write_bytes(b"x" * 1000)
    datum = f',EXTENSION["PROJ4_GRIDS","{grid}"]' if kind == "grids of a datum" else ""
    more = "" if datum else f',EXTENSION["PROJ4","+proj=utm +zone=33 +ellps=bessel +nadgrids={grid} +units=m"]'
    geographic = (
        f'GEOGCS["g",DATUM["d",SPHEROID["s",6378137,298.25]{datum}],PRIMEM["Greenwich",0],UNIT["degree",0.0174]]'
    )
    parameters = "latitude_of_origin", "central_meridian", "scale_factor", "false_easting", "false_northing"
    given = "".join(f',PARAMETER["{name}",{value}]' for name, value in zip(parameters, (0, 15, 1, 0, 0), strict=True))
    system = f'PROJCS["x",{geographic},PROJECTION["Transverse_Mercator"]{given},UNIT["metre",1]{more}]'
    place = f"<SRS>{system}</SRS><GeoTransform>500000,1,0,5000000,0,-1</GeoTransform>"
    (public / "b.vrt").write_text(mosaic("a.tif", 1, place))
    words = f"ESRI PE String = {system}|"
    keys = [1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 32767, 3073, 34737, len(words), 0]
    tags = [(34735, "H", len(keys), keys, True), (34737, "s", 0, words, True)]
    tags += [(33550, "d", 3, (2.0, 2.0, 0.0), True), (33922, "d", 6, (0.0, 0.0, 0.0, 5e5, 5e6, 0.0), True)]
    tifffile.imwrite(public / "c.tif", np.zeros((4, 4), np.uint8), extratags=tags)
    for name, allowed in (("b.vrt", {"a.tif", "b.vrt"}), ("c.tif", {"c.tif"})):
        with opened_files(*folders) as names:
            unusable("a reference system that names no file", georeference, str(public / name))
            with suppress(SemfovError):
                open_large(public / name)
        assert names == allowed
