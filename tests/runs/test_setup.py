"""What a run is made of: eyes and scenes by their settings, and policies by their names."""

import json
from dataclasses import replace
from itertools import combinations
from typing import get_args

import pytest
from PIL import Image

from eval.explore.run import ExploreConfig
from eval.search.run import SearchConfig
from semfov import ActivePerception, CocoScenes, DataError
from semfov.errors import InputError
from semfov.gaze.acquisition.base import Task
from semfov.gaze.policies import policy_names
from semfov.runs.command import run_command
from semfov.runs.config import DataConfig, DetectorConfig, PolicyConfig, SensorConfig
from semfov.runs.presets import _WORDS, label, presets, resolve
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


@pytest.mark.parametrize("sensor", ["published", "published-narrow"])
def test_published_means_the_same_for_sensor_model_and_agent(sensor):
    """A run with a published sensor that names no model has the eye and the model of the published agent."""
    eye, agent = make_eye(DetectorConfig(), SensorConfig(sensor)), ActivePerception.published(sensor=sensor)
    model = make_observation(None, eye)
    assert observation_name(eye) == f"yolox-nano-{sensor}"
    assert eye.settings() == agent.eye.settings()
    assert model.digest() == agent.searching.observer.observation.digest()


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({}, "yolox-nano"),
        ({"sigma": 50}, "yolox-nano"),
        ({"name": "published", "sigma": 80}, "yolox-nano-sharp"),
        ({"name": "published", "growth": 2}, "yolox-nano"),
        ({"name": "published", "reference": 320}, "yolox-nano-sharp"),
        ({"growth": 1}, "yolox-nano-published"),
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
    with pytest.raises(DataError, match="none among 4"):
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
    for content, told in ((None, "no such file"), (b"\xff\xfe\x00", "expected a file of text")):
        listed = photographs / "ids.txt"
        if content is not None:
            listed.write_bytes(content)
        data = DataConfig(root=photographs, annotations=photographs / "cups.json", ids=listed)
        unusable(rf"ids\.txt: {told}", make_scenes, data, ("cup",))


TASKS = get_args(Task)
ALIASES = {
    "search": {
        "recommended": "non-predictive-learned",
        "published": "predictive-calibrated",
        "maximum-a-posteriori-raw": "non-predictive-raw",
        "maximum-a-posteriori-calibrated": "non-predictive-calibrated",
        "maximum-a-posteriori-learned": "non-predictive-learned",
    },
    "exploration": {"recommended": "closer-look-learned", "published": "kl-calibrated"},
}

# One change each; together they cover every allowed word of every setting.
CHANGES = [
    {"tempering": 0.25},
    {"tempering": 0.5},
    {"tempering": 1.0},
    {"misses": True},
    {"misses": False},
    {"samples": 4},
    *({name: word} for name, words in _WORDS.items() if name != "scores" for word in get_args(words)),
]


def test_names_give_policy_scores_and_saliency():
    assert resolve("predictive-calibrated", "search") == PolicyConfig("predictive", "calibrated")
    assert resolve("place-information-raw", "search") == PolicyConfig("place-information", "raw")
    assert resolve("entropy-limit-learned", "search") == PolicyConfig("entropy-limit", "learned")
    assert resolve("vocus2", "search") == PolicyConfig("saliency", saliency="vocus2")
    assert resolve("expected-accuracy-raw", "exploration") == PolicyConfig("expected-accuracy")
    assert resolve("itti-koch-calibrated", "exploration") == PolicyConfig(
        "saliency", "calibrated", saliency="itti-koch"
    )
    assert resolve("recommended", "search") == PolicyConfig("non-predictive", "learned")
    assert resolve("recommended", "exploration") == PolicyConfig("closer-look", "learned")
    assert resolve("published", "search") == PolicyConfig("predictive", "calibrated")
    assert resolve("published", "exploration") == PolicyConfig("kl", "calibrated")


@pytest.mark.parametrize("task", TASKS)
def test_every_policy_has_a_preset_with_its_name(task):
    made = {preset.policy for preset in presets(task).values()}
    assert made == {*policy_names(task)}
    for name, preset in presets(task).items():
        assert resolve(name, task) == resolve(preset, task) == preset
    for name in presets(task):
        assert label(name, task) == ALIASES[task].get(name, name)


@pytest.mark.parametrize("task", TASKS)
def test_labels_are_unique(task):
    """Two policies with the same label would be merged in the tables of a run."""
    several = [{}, *CHANGES, *({**one, **other} for one, other in combinations(CHANGES, 2))]
    made = set()
    for preset in presets(task).values():
        for change in several:
            try:
                made.add(resolve(replace(preset, **change), task))
            except InputError:
                continue
    labels = {label(policy, task) for policy in made}
    assert len(labels) == len(made)
    assert labels >= {label(name, task) for name in presets(task)}


def test_labels_list_the_differences_from_a_preset():
    central = PolicyConfig("non-predictive", tempering=0.25, footprint="box_centre")
    assert label(central, "search") == "non-predictive-raw, tempering 0.25, footprint box_centre"
    everything = PolicyConfig("predictive", "calibrated", 1.0, "soft", "closest", True, "vocus2", 9)
    expected = "predictive-calibrated, tempering 1, footprint soft, memory closest, misses, saliency vocus2, samples 9"
    assert label(everything, "search") == expected
    assert label(PolicyConfig("saliency", saliency="itti-koch", misses=False), "search") == "itti-koch, misses false"
    assert label(PolicyConfig("kl", saliency="itti-koch"), "exploration") == "kl-raw, saliency itti-koch"


def test_unknown_names_and_settings_are_refused_with_a_suggestion():
    for choice, task, suggested in [
        ("predicitve-raw", "search", "predictive-raw"),
        ("non-predictive-lerned", "search", "non-predictive-learned"),
        ("recomended", "exploration", "recommended"),
        ("random", "exploration", "random-raw"),
        (PolicyConfig("predictiv"), "search", "predictive"),
        (PolicyConfig("closer-lok"), "exploration", "closer-look"),
        (PolicyConfig("kl", memory="closets"), "exploration", "closest"),
        (PolicyConfig("kl", footprint="box-centre"), "exploration", "box_centre"),
        (PolicyConfig("kl", saliency="vocus"), "exploration", "vocus2"),
        (PolicyConfig("kl", "calibratd"), "exploration", "calibrated"),
    ]:
        for call in (resolve, label):
            refused(f"did you mean '{suggested}'", call, choice, task)
    for task, settings, told in [
        ("search", {"policy": "kl"}, "policy"),
        ("exploration", {"policy": "non-predictive"}, "policy"),
        *((task, {"policy": "saliency"}, "^saliency: .*vocus2, itti-koch") for task in TASKS),
        *(
            ("exploration", {"policy": "kl", "tempering": wrong}, "^tempering: expected a number above 0")
            for wrong in (0.0, -0.5, float("nan"))
        ),
        # Without scores in use, its label would be the same as with raw scores.
        ("search", {"policy": "random", "scores": "calibrated"}, "^scores: .*'random'"),
        ("search", {"policy": "predictive", "scores": "learned"}, "^scores: .*'predictive'"),
        ("search", {"policy": "saliency", "scores": "calibrated", "saliency": "vocus2"}, "^scores: .*'saliency'"),
        # It has a belief of its own, not the map.
        *(
            ("search", {"policy": "non-predictive", "scores": "learned", name: value}, f"^{name}: .*'learned'")
            for name, value in (("tempering", 0.25), ("footprint", "soft"), ("memory", "all"), ("misses", True))
        ),
    ]:
        with pytest.raises(InputError, match=told):
            resolve(PolicyConfig(**settings), task)


def parsed(config, *arguments):
    """The policies that a command line gives."""
    got = []
    assert run_command(got.append, config, "Policies.", arguments) == 0
    (settings,) = got
    return settings.policies


MAPPING = "[{policy: non-predictive, tempering: 0.25}, random]"


def test_a_policy_can_be_a_mapping(tmp_path):
    assert parsed(SearchConfig, "--policies", MAPPING) == (PolicyConfig("non-predictive", tempering=0.25), "random")
    given = "[recommended, {policy: kl, scores: calibrated, memory: closest, misses: true}]"
    expected = "recommended", PolicyConfig("kl", "calibrated", memory="closest", misses=True)
    assert parsed(ExploreConfig, "--policies", given) == expected
    path = tmp_path / "run.yaml"
    path.write_text(f"policies: {MAPPING}\n")
    assert parsed(SearchConfig, "--config", str(path)) == (PolicyConfig("non-predictive", tempering=0.25), "random")
    path.write_text("policies:\n- policy: saliency\n  saliency: vocus2\n- kl-raw\n")
    assert parsed(ExploreConfig, "--config", str(path)) == (PolicyConfig("saliency", saliency="vocus2"), "kl-raw")


@pytest.mark.parametrize("config", [SearchConfig, ExploreConfig])
def test_settings_that_a_run_wrote_can_be_read_back(config, tmp_path):
    policies = (PolicyConfig("random", saliency="vocus2"), *config().policies)
    path = tmp_path / "config.yaml"
    path.write_text(replace(config(), policies=policies).yaml())
    assert parsed(config, "--config", str(path)) == policies


BAD = {
    "temperring": "{policy: non-predictive, temperring: 0.25}",
    "tempering": "{policy: non-predictive, tempering: cold}",
    "scores": "{policy: non-predictive, scores: cooked}",
    "policy": "{tempering: 0.25}",
}


@pytest.mark.parametrize("wrong", BAD)
def test_an_invalid_mapping_is_refused(wrong, tmp_path, capsys):
    """On the command line the parser may read such a mapping as text, which is then an unknown name."""

    def run(config):
        for choice in config.policies:
            resolve(choice, "search")

    path = tmp_path / "run.yaml"
    path.write_text(f"policies:\n- {BAD[wrong]}\n")
    for given in (["--config", str(path)], ["--policies", f"[random, {BAD[wrong]}]"]):
        try:
            code = run_command(run, SearchConfig, "Policies.", given)
        except SystemExit as stopped:
            code = stopped.code
        assert code == 2 or (code == 1 and given[0] == "--policies")
        error = capsys.readouterr().err
        assert "policies" in error
        assert wrong in error
