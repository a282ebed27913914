"""From settings to scenes and sensors, and from names of policies to how they search."""

import json

import pytest
import torch
from PIL import Image

from eval.command import run_command
from eval.config import BeliefConfig, DataConfig, SensorConfig
from eval.protocol import Searcher
from eval.setup import (
    belief_of,
    in_context,
    make_scenes,
    make_searcher,
    needs_context,
    needs_model,
    needs_target,
    saliency_of,
    saliency_policies,
    split_policy,
)
from semfov import CocoScenes, DirichletBelief, FovealObservationModel, Grid
from semfov.belief import ContextObserver, ContextPrior, SemanticObserver
from semfov.errors import DataError, InputError
from semfov.gaze import search_policy
from semfov.gaze.acquisition import (
    ExpectedAccuracy,
    NeighbourhoodPosterior,
    PredictedTargetPosterior,
    SaliencyPrior,
    Static,
    TargetPosterior,
)


@pytest.fixture
def model():
    return FovealObservationModel.identity(["cup", "cat"], [0.2], miss_rate=torch.full((3, 2), 0.5))


def test_names_tell_policy_mode_and_variants():
    assert split_policy("predictive-calibrated+soft+tempered", "search") == ("predictive", True)
    assert split_policy("target-evidence", "search") == ("target-evidence", False)
    assert split_policy("learned-raw", "search") == ("learned-raw", False)
    assert not needs_model(("learned-raw",), "search")
    assert split_policy("expected-accuracy-raw", "exploration") == ("expected-accuracy", False)
    changed = belief_of("non-predictive-raw+central+closest", BeliefConfig(prior=0.3))
    assert (changed.footprint, changed.memory, changed.prior) == ("box_centre", "closest", 0.3)
    assert belief_of("non-predictive-raw", BeliefConfig()) == BeliefConfig()
    with pytest.raises(InputError, match="did you mean 'tempered'"):
        belief_of("non-predictive-raw+temperd", BeliefConfig())
    with pytest.raises(InputError, match="did you mean"):
        split_policy("predictiv-raw", "search")


def test_a_model_is_needed_to_predict_to_calibrate_and_for_misses():
    assert not needs_model(("random", "target-evidence", "non-predictive-raw+soft"), "search")
    assert needs_model(("non-predictive-raw+misses",), "search")
    assert needs_model(("non-predictive-calibrated",), "search")
    assert needs_model(("predictive-raw",), "search")
    with pytest.raises(InputError, match="policies"):
        needs_model((), "search")


def test_searchers_are_made_as_named(model):
    searcher = make_searcher("predictive-raw+misses+tempered", "search", BeliefConfig(), 3, model)
    assert searcher.observer.misses is not None
    assert searcher.observer.observation is None
    assert searcher.observer.tempering == 0.25
    grid = Grid(4, 3, (40, 30))
    assert isinstance(searcher.policy(1, grid), PredictedTargetPosterior)
    explorer = make_searcher("expected-accuracy-calibrated+misses", "exploration", BeliefConfig(), 3, model)
    assert explorer.observer.observation is model
    assert isinstance(explorer.policy(None, grid), ExpectedAccuracy)
    with pytest.raises(InputError, match="misses"):
        make_searcher("random", "search", BeliefConfig(misses=True), 3, None)


def test_context_is_added_where_a_policy_asks_for_it():
    weights = {"evidence": (0.5, 0.25), "map": (1.0, 2.0)}
    prior = ContextPrior(["cup", "cat"], torch.zeros(3, 2, 2), torch.zeros(3, 3, 1), [], weights=weights)
    plain = SemanticObserver(3)
    assert needs_context(("random", "target-evidence+context"), BeliefConfig())
    assert needs_context(("target-evidence",), BeliefConfig(context="place"))
    assert not needs_context(("target-evidence", "non-predictive-raw+soft"), BeliefConfig())
    assert needs_target(("target-evidence+context",), "search")
    assert in_context("non-predictive-raw", "search", plain, BeliefConfig(), prior) is plain
    for ending, expected in {"context": (1.0, 2.0), "place": (1.0, 0.0), "cooccurrence": (0.0, 2.0)}.items():
        observer = in_context(f"non-predictive-raw+{ending}", "search", plain, BeliefConfig(), prior)
        assert isinstance(observer, ContextObserver)
        assert observer.weights == expected
    with pytest.raises(InputError, match="probability of the target"):
        in_context("predictive-raw+context", "search", plain, BeliefConfig(), prior)
    with pytest.raises(InputError, match="probability of the target"):
        in_context("random-raw+context", "exploration", plain, BeliefConfig(), prior)


def test_saliency_may_follow_a_policy():
    for kind, policy in (("search", "non-predictive-raw"), ("search", "target-evidence"), ("exploration", "kl-raw")):
        assert saliency_of(policy, kind) is None
        assert saliency_of(f"{policy}+vocus2", kind) == "vocus2"
        assert saliency_of(f"{policy}+tempered+itti-koch", kind) == "itti-koch"
        assert split_policy(f"{policy}+vocus2", kind) == split_policy(policy, kind)
    changed = belief_of("non-predictive-raw+vocus2+tempered", BeliefConfig())
    assert changed == belief_of("non-predictive-raw+tempered", BeliefConfig())
    with pytest.raises(InputError, match="did you mean 'vocus2'"):
        belief_of("non-predictive-raw+vocus", BeliefConfig())


def test_a_run_needs_every_saliency_model_once():
    searches = (
        "vocus2",
        "random",
        "predictive-raw+vocus2",
        "target-evidence+itti-koch",
        "predictive-calibrated+vocus2",
    )
    assert saliency_policies(searches, "search") == ["vocus2", "itti-koch"]
    assert saliency_policies(("vocus2-raw", "vocus2-calibrated"), "exploration") == ["vocus2"]
    assert saliency_policies(("kl-raw", "closer-look-raw+mild"), "exploration") == []


def test_what_a_policy_needs_does_not_hang_on_saliency():
    for policy in ("non-predictive-raw", "predictive-raw", "target-evidence"):
        assert needs_model((f"{policy}+vocus2",), "search") == needs_model((policy,), "search")
        assert needs_target((f"{policy}+vocus2",), "search") == needs_target((policy,), "search")


@pytest.mark.parametrize("rows", [1, 12], ids=["of the picture", "from every cell"])
def test_saliency_takes_a_policys_place_or_stands_beside_it(rows):
    grid, cell, visited = Grid(4, 3, (40, 30)), torch.tensor([5, 0]), torch.zeros(2, 12, dtype=torch.bool)
    table = torch.rand(rows, 12, generator=torch.Generator().manual_seed(0))
    seen = table[cell] if rows > 1 else table.expand(2, -1)
    belief = DirichletBelief(0.5 + torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1)))
    alone = Searcher(SemanticObserver(3), search_policy("random"), table).acquisition(1, grid, cell)
    assert isinstance(alone, Static)
    torch.testing.assert_close(alone(belief, visited), seen)
    beside = Searcher(SemanticObserver(3), search_policy("non-predictive"), table, 0.4).acquisition(1, grid, cell)
    assert isinstance(beside, SaliencyPrior)
    raised = seen + 1e-3 * seen.amax(-1, keepdim=True)
    expected = belief.probability(1).log() + 0.4 * (raised / raised.sum(-1, keepdim=True)).log()
    torch.testing.assert_close(beside(belief, visited), expected)
    plain = Searcher(SemanticObserver(3), search_policy("non-predictive")).acquisition(1, grid, cell)
    assert isinstance(plain, TargetPosterior)


def test_neighbours_come_from_a_predicted_map(model):
    assert needs_model(("neighbourhood-raw",), "search")
    searcher = make_searcher("neighbourhood-raw", "search", BeliefConfig(), 3, model)
    assert isinstance(searcher.policy(1, Grid(4, 3, (40, 30))), NeighbourhoodPosterior)
    with pytest.raises(InputError, match="observation model"):
        make_searcher("neighbourhood-raw", "search", BeliefConfig(), 3, None)


def test_divergence_is_from_the_prior_of_the_run(model):
    explorer = make_searcher("kl-raw", "exploration", BeliefConfig(prior=0.25), 3, model)
    assert explorer.policy(None, Grid(4, 3, (40, 30))).prior == explorer.observer.prior == 0.25


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
def test_a_sensor_is_known_by_name_and_may_be_changed(settings, sigma, growth, fovea):
    config = SensorConfig(**settings)
    sensor = config.make()
    assert (float(sensor.sigma), sensor.growth, sensor.levels) == pytest.approx((sigma, growth, 5))
    assert config.fovea == pytest.approx(fovea)
    assert SensorConfig(levels=3, convention="opencv").make().convention == "opencv"


def test_an_unknown_sensor_is_told(capsys):
    with pytest.raises(InputError, match="did you mean 'published"):
        SensorConfig(name="publishd").make()
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
    """Numbers or text, in any order; the order of scenes is that of the ids."""
    scenes = choose(photographs, ids=ids)
    assert scenes.ids == [3, 92]
    assert [scene.name for scene in scenes] == ["3.png", "92.png"]


def test_other_selections_follow_that_by_ids(photographs):
    assert choose(photographs, ids=[15, 92, 14], limit=2).ids == [14, 15]
    assert choose(photographs).ids == choose(photographs, ids=None).ids == [3, 14, 15, 92]
    with pytest.raises(DataError, match="none of 4 images"):
        CocoScenes(photographs, photographs / "cups.json", ("cup",), min_instances=2, ids=[14])


def test_the_fingerprint_tells_which_photographs(photographs):
    every, some, same = (choose(photographs, ids=ids).fingerprint for ids in (None, [3, 14], ["14", "3"]))
    assert some == same != every
    assert choose(photographs, ids=[3, 14, 15, 92]).fingerprint == every


def test_missing_ids_are_named(photographs):
    with pytest.raises(DataError, match=r"cups\.json: 2 of 3 ids are not in it: 16, 7$"):
        choose(photographs, ids=[7, 14, 16])
    with pytest.raises(DataError, match="9 of 9 ids are not in it: 100, 101, 102, 103, 104, …"):
        choose(photographs, ids=range(100, 109))


def test_ids_are_read_from_a_file(photographs):
    listed = photographs / "ids.txt"
    listed.write_text("92\n\n14\n")
    data = DataConfig(root=photographs, annotations=photographs / "cups.json", ids=listed, min_instances=1)
    assert make_scenes(data, ("cup",)).ids == [14, 92]
    listed.write_text("92\n65\n")
    with pytest.raises(DataError, match="1 of 2 ids are not in it: 65"):
        make_scenes(data, ("cup",))


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"], ids=["missing", "not text"])
def test_a_list_of_ids_that_cannot_be_read_is_named(photographs, content):
    listed = photographs / "ids.txt"
    if content is not None:
        listed.write_bytes(content)
    data = DataConfig(root=photographs, annotations=photographs / "cups.json", ids=listed)
    with pytest.raises(DataError, match=r"ids\.txt: cannot be read"):
        make_scenes(data, ("cup",))
