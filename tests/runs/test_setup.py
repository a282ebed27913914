"""From settings to scenes and sensors."""

import json

import pytest
from PIL import Image

from semfov import ActivePerception, CocoScenes, DataError
from semfov.runs.command import run_command
from semfov.runs.config import DataConfig, DetectorConfig, SensorConfig
from semfov.runs.setup import make_eye, make_observation, make_scenes, observation_name
from tests.refusals import refused, unusable


@pytest.mark.parametrize(
    ("settings", "sigma", "growth", "fovea"),
    [
        ({}, 100, 2, 100 / 640),
        ({"name": "published"}, 100, 1, 100 / 640),
        ({"name": "published-narrow"}, 50, 1, 50 / 640),
        ({"name": "published-narrow", "sigma": 80}, 80, 1, 80 / 640),
        ({"name": "gradual", "growth": 1.5}, 100, 1.5, 100 / 640),
        ({"name": "published", "sigma": 50, "reference": 320}, 50, 1, 50 / 320),
    ],
)
def test_a_sensor_is_chosen_by_name_and_may_be_changed(settings, sigma, growth, fovea):
    config = SensorConfig(**settings)
    sensor = config.make()
    assert (float(sensor.sigma), sensor.growth, sensor.levels) == pytest.approx((sigma, growth, 5))
    assert config.fovea == pytest.approx(fovea)
    assert SensorConfig(levels=3, convention="opencv").make().convention == "opencv"


@pytest.mark.weights
@pytest.mark.parametrize("sensor", ["published", "published-narrow"])
def test_published_means_the_same_for_sensor_model_and_agent(sensor):
    """A run with a published sensor that names no model has the eye and the model of the published agent."""
    eye, agent = make_eye(DetectorConfig(), SensorConfig(sensor)), ActivePerception.published(sensor=sensor)
    model = make_observation(None, eye)
    assert observation_name(eye) == f"yolov3-tiny-{sensor}"
    assert eye.settings() == agent.eye.settings()
    assert model.digest() == agent.searching.observer.observation.digest()


@pytest.mark.weights
@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({}, "yolov3-tiny"),
        ({"sigma": 50}, "yolov3-tiny"),
        ({"name": "published", "sigma": 80}, "yolov3-tiny-sharp"),
        ({"name": "published", "growth": 2}, "yolov3-tiny"),
        ({"name": "published", "reference": 320}, "yolov3-tiny-sharp"),
        ({"growth": 1}, "yolov3-tiny-published"),
    ],
)
def test_a_sensor_that_is_not_published_has_a_model_of_our_own(settings, name):
    assert observation_name(make_eye(DetectorConfig(), SensorConfig(**settings))) == name


def test_an_unknown_sensor_gets_a_suggestion(capsys):
    refused("did you mean 'published", SensorConfig(name="publishd").make)
    with pytest.raises(SystemExit):
        run_command(print, SensorConfig, "Sensors.", ["--name", "publishd"])
    assert "published-narrow" in capsys.readouterr().err


@pytest.fixture
def photographs(tmp_path):
    """Four photographs with a cup each, and their annotations."""
    images = [{"id": n, "file_name": f"{n}.png", "width": 40, "height": 30} for n in (3, 14, 15, 92)]
    boxes = [{"id": n, "image_id": n, "category_id": 1, "bbox": [4, 4, 8, 8]} for n in (3, 14, 15, 92)]
    for image in images:
        Image.new("RGB", (40, 30), "grey").save(tmp_path / image["file_name"])
    content = {"images": images, "annotations": boxes, "categories": [{"id": 1, "name": "cup"}]}
    (tmp_path / "cups.json").write_text(json.dumps(content))
    return tmp_path


def choose(photographs, **settings):
    return CocoScenes(photographs, photographs / "cups.json", ("cup",), min_instances=1, **settings)


@pytest.mark.parametrize("ids", [[92, 3], ["92", "3"], {3, 92}, (3, 3, 92)], ids=str)
def test_photographs_are_chosen_by_their_ids(photographs, ids):
    """Ids may be numbers or text, in any order; scenes are sorted by id."""
    scenes = choose(photographs, ids=ids)
    assert scenes.ids == [3, 92]
    assert [scene.name for scene in scenes] == ["3.png", "92.png"]


def test_selections_apply_in_order_and_have_their_fingerprint(photographs):
    assert choose(photographs, ids=[15, 92, 14], limit=2).ids == [14, 15]
    assert choose(photographs).ids == choose(photographs, ids=None).ids == [3, 14, 15, 92]
    with pytest.raises(DataError, match="none of 4 images"):
        CocoScenes(photographs, photographs / "cups.json", ("cup",), min_instances=2, ids=[14])
    every, some, same = (choose(photographs, ids=ids).fingerprint for ids in (None, [3, 14], ["14", "3"]))
    assert some == same != every
    assert choose(photographs, ids=[3, 14, 15, 92]).fingerprint == every


def test_ids_are_read_from_a_file(photographs):
    listed = photographs / "ids.txt"
    listed.write_text("92\n\n14\n")
    data = DataConfig(root=photographs, annotations=photographs / "cups.json", ids=listed, min_instances=1)
    assert make_scenes(data, ("cup",)).ids == [14, 92]
    listed.write_text("92\n65\n")
    unusable("each of 2 ids, got none for 1 of them: 65", make_scenes, data, ("cup",))


def test_ids_that_are_missing_or_cannot_be_read_are_named(photographs):
    with pytest.raises(DataError, match=r"cups\.json: expected .* each of 3 ids, got none for 2 of them: 16, 7;"):
        choose(photographs, ids=[7, 14, 16])
    with pytest.raises(DataError, match="each of 9 ids, got none for 9 of them: 100, 101, 102, 103, 104, …"):
        choose(photographs, ids=range(100, 109))
    for content in [None, b"\xff\xfe\x00"]:
        listed = photographs / "ids.txt"
        if content is not None:
            listed.write_bytes(content)
        data = DataConfig(root=photographs, annotations=photographs / "cups.json", ids=listed)
        unusable(r"ids\.txt: expected a text file with one id per line", make_scenes, data, ("cup",))
