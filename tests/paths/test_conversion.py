"""Objects of records in the formats of Supervision, torchvision, COCO and GeoJSON, read back by these packages."""

import contextlib
import io
import json
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import supervision
import tifffile
import torch
from PIL import Image
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torchvision.utils import draw_bounding_boxes

from semfov import Detections, Grid, InputError
from semfov.cli.formats import GeoJson
from semfov.data.large import open_large
from tests import small
from tests.refusals import refused, unusable

CLASSES = ("background", "person", "tvmonitor", "cup")


@pytest.fixture
def record():
    """One look of three objects of three classes, and one below the threshold."""
    boxes = torch.tensor([[[0.0, 0, 8, 9], [10, 10, 30, 40], [40, 5, 60.5, 20], [50, 40, 60, 50]]])
    scores = torch.zeros(1, 4, 4)
    for row, (label, score) in enumerate([(3, 0.9), (1, 0.8), (2, 0.4), (1, 0.2)]):
        scores[0, row, label], scores[0, row, 0] = score, 1 - score
    look = Detections(boxes, scores, torch.ones(1, 4, dtype=torch.bool))
    return small.scanpath(Grid(4, 3, (80, 60)), torch.tensor([0]), CLASSES, detections=(look,))


def test_supervision_counts_classes_from_0_and_has_their_names(record):
    found = record.to_supervision()
    assert isinstance(found, supervision.Detections)
    np.testing.assert_array_equal(found.xyxy, record.objects.boxes.numpy())
    assert found.class_id.tolist() == [2, 0, 1]
    assert found["class_name"].tolist() == ["cup", "person", "tvmonitor"]
    np.testing.assert_allclose(found.confidence, [0.9, 0.8, 0.4])
    assert (found["look"].tolist(), found["confirmed"].tolist()) == ([1] * 3, [False] * 3)
    # Its annotators write the names.
    blank = np.zeros((60, 80, 3), np.uint8)
    assert supervision.LabelAnnotator().annotate(supervision.BoxAnnotator().annotate(blank.copy(), found), found).any()
    assert len(found.with_nms()) == 3
    assert len(replace(record, score_threshold=0.95).to_supervision()) == 0


def test_labels_of_yolo_are_shares_and_crops_the_pixels_of_the_boxes(record):
    lines = [line.split() for line in record.to_yolo().splitlines()]
    assert [line[0] for line in lines] == ["2", "0", "1"]
    x, y, width, height = (float(share) for share in lines[2][1:])  # box 40, 5 to 60.5, 20 of 80 × 60 px
    np.testing.assert_allclose([x * 80, y * 60, width * 80, height * 60], [50.25, 12.5, 20.5, 15], atol=1e-4)
    picture = torch.randint(256, (3, 60, 80), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    crops = record.crops(picture)
    assert torch.equal(crops[2], picture[:, 5:20, 40:61])
    assert [tuple(crop.shape) for crop in crops] == [(3, 9, 8), (3, 30, 20), (3, 15, 21)]
    (middle,) = record.crops(picture, boxes=torch.tensor([[10.0, 20, 30, 90]]))
    assert torch.equal(middle, picture[:, 20:60, 10:30])
    refused("picture: expected the record's, 80 × 60 px", record.crops, picture[:, :30])
    refused("as the record does not come from a file, got None", record.crops)


def test_crops_of_a_file_show_the_values_and_bands_that_were_looked_at(record, tmp_path):
    values = np.random.default_rng(0).integers(0, 4096, (60, 80, 4), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", planarconfig="contig")
    opened = open_large(tmp_path / "a.tif", white=4095, bands=(4, 3, 2))
    replace(record, source=str(opened.path), shown=opened.shown).save(tmp_path / "a.safetensors")
    crops = type(record).load(tmp_path / "a.safetensors").crops()
    assert [*map(torch.equal, crops, record.crops(opened))] == [True] * 3
    expected = values[5:20, 40:61, [3, 2, 1]] * (255 / 4095)
    np.testing.assert_allclose(crops[2].permute(1, 2, 0).numpy(), expected, atol=0.51)


def test_torchvision_draws_them(record):
    found = record.to_torchvision()
    assert found["labels"].tolist() == [3, 1, 2]
    drawn = draw_bounding_boxes(torch.zeros(3, 60, 80, dtype=torch.uint8), found["boxes"], colors="white")
    assert drawn[:, 10, 10:30].eq(255).all()


@pytest.mark.parametrize("categories", [None, "file"])
def test_pycocotools_reads_the_results_with_the_ids_of_the_file(record, categories):
    """COCO's own ids (person 1, cup 47, tv 72), or those of a file that spells and orders the classes its own way."""
    given = [{"id": 7, "name": "Cup"}, {"id": 5, "name": "tv"}, {"id": 4, "name": "person"}, {"id": 1, "name": "gull"}]
    named = given if categories else None
    ids = {"cup": 7, "person": 4, "tvmonitor": 5} if categories else {"cup": 47, "person": 1, "tvmonitor": 72}
    results = record.to_coco(9, named)
    assert [each["category_id"] for each in results] == [ids[row["class"]] for row in record.object_rows()]
    truth = COCO()
    truth.dataset = {
        "info": {},
        "images": [{"id": 9, "width": 80, "height": 60}],
        "categories": [{"id": number, "name": name} for name, number in ids.items()],
        "annotations": [
            {"id": n, "image_id": 9, "iscrowd": 0, "category_id": ids[row["class"]],
             "bbox": [row["x1"], row["y1"], row["x2"] - row["x1"], row["y2"] - row["y1"]],
             "area": (row["x2"] - row["x1"]) * (row["y2"] - row["y1"])}
            for n, row in enumerate(record.object_rows(), 1)
        ],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        truth.createIndex()
        judge = COCOeval(truth, truth.loadRes(results), "bbox")
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    assert judge.stats[0] == pytest.approx(1)


def test_classes_without_a_category_are_refused(record):
    with pytest.raises(InputError, match="categories: expected a category for each class, got none for cup"):
        record.to_coco(1, [{"id": 1, "name": "person"}, {"id": 2, "name": "tv"}])
    assert len(replace(record, target=1).to_coco(1, [{"id": 1, "name": "person"}])) == 1
    own = replace(record, classes=("background", "gull", "tv", "cup"))
    refused(r"categories: expected those of the annotation file.*gull", own.to_coco)
    assert [each["category_id"] for each in own.to_coco(1, [11, 12, 13])] == [13, 11, 12]


def test_ids_of_numpy_become_plain_numbers(record):
    results = record.to_coco(np.int64(7), np.array([11, 12, 13]))
    assert results == json.loads(json.dumps(record.to_coco(7, [11, 12, 13])))
    assert record.to_coco("a7")[0]["image_id"] == "a7"
    for wrong in (7.5, None, True):
        refused("image_id: expected the whole number of an image", record.to_coco, wrong)
    refused("categories: expected whole numbers", record.to_coco, 7, [1.5, 2, 3])


def test_geojson_in_pixels_says_so(record, tmp_path):
    Image.new("RGB", (80, 60)).save(tmp_path / "plain.tif")
    for source in (None, "photo.jpg", str(tmp_path / "plain.tif")):
        collection = replace(record, source=source).to_geojson(tmp_path / "a.geojson")
        assert json.loads((tmp_path / "a.geojson").read_text()) == collection
        assert "y down" in collection["coordinates"]
    first, *_ = features = collection["features"]
    assert len(features) == 3
    ring = first["geometry"]["coordinates"][0]
    assert ring == [[0, 9], [8, 9], [8, 0], [0, 0], [0, 9]]
    assert first["properties"]["class"] == "cup"
    unusable("No such file", record.to_geojson, source=tmp_path / "none.tif")


def geotiff(path, crs, transform):
    """A picture of 80 × 60 px with a georeference."""
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    from rasterio.transform import Affine

    options = {"width": 80, "height": 60, "count": 3, "dtype": "uint8", "crs": crs, "transform": Affine(*transform)}
    with rasterio.open(path, "w", driver="GTiff", **options) as file:
        file.write(np.zeros((3, 60, 80), np.uint8))
    return path


def test_geojson_of_a_geotiff_has_its_coordinates(record, tmp_path):
    """Web Mercator has a closed form: longitude and latitude from metres by the exponential function."""
    file = geotiff(tmp_path / "a.tif", "EPSG:3857", (2.0, 0.0, 1_000_000.0, 0.0, -3.0, 6_000_000.0))
    collection = replace(record, source=str(file)).to_geojson()
    assert "WGS 84" in collection["coordinates"]
    ring = np.array(collection["features"][1]["geometry"]["coordinates"][0])
    x, y = np.array([[10, 40], [30, 40], [30, 10], [10, 10], [10, 40]]).T
    radius = 6378137.0
    longitude = np.degrees((1_000_000 + 2.0 * x) / radius)
    latitude = np.degrees(2 * np.arctan(np.exp((6_000_000 - 3.0 * y) / radius)) - np.pi / 2)
    np.testing.assert_allclose(ring, np.stack([longitude, latitude], -1), atol=1e-8)
    # Counterclockwise, as RFC 7946 asks.
    east, north = (ring[1:] - ring[:-1]).T
    assert (east[:-1] * north[1:] - east[1:] * north[:-1] > 0).all()


def test_a_system_without_a_place_gives_pixels_and_control_points_a_place(record, tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio (pip install semfov[geo])")
    from rasterio.control import GroundControlPoint
    from rasterio.errors import NotGeoreferencedWarning

    options = {"width": 80, "height": 60, "count": 3, "dtype": "uint8", "driver": "GTiff"}
    names = tmp_path / "system.tif", tmp_path / "points.tif"
    # A degree is ten pixels, from 10 east, 50 north.
    places = [(row, column, 10 + column / 10, 50 - row / 10) for row in (0, 60) for column in (0, 80)]
    for name, points in zip(names, ([], [GroundControlPoint(*place) for place in places]), strict=True):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            file = rasterio.open(name, "w", **options)
        with file:
            file.write(np.zeros((3, 60, 80), np.uint8))
            if points:
                file.gcps = points, "EPSG:4326"
            else:
                file.crs = "EPSG:4326"
    system, points = (replace(record, source=str(name)).to_geojson() for name in names)
    assert "pixels" in system["coordinates"]
    assert "WGS 84" in points["coordinates"]
    ring = points["features"][1]["geometry"]["coordinates"][0]
    np.testing.assert_allclose(ring[0], [11.0, 46.0], atol=1e-8)
    refused(r"out: expected pictures that all have .*points\.tif with one", GeoJson().check_files, [*names, None])
    GeoJson().check_files([names[0], None])


def test_a_georeference_needs_rasterio(record, tmp_path, monkeypatch):
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    tags = ImageFileDirectory_v2()
    tags[34735] = (1, 1, 0, 0)
    tags.tagtype[34735] = 3
    Image.new("RGB", (80, 60)).save(tmp_path / "a.tif", tiffinfo=tags)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    refused(r"pip install \"semfov\[geo\]\"", record.to_geojson, source=tmp_path / "a.tif")
