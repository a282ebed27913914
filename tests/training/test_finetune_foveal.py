"""`python -m train.finetune_foveal` as a user runs it: small, on the embedded scenes, with the real detector."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import onnx
import pytest
import torch

from semfov import load_detector
from semfov.experiments.looks import one_thread
from semfov.experiments.seeds import generator_for
from semfov.io.storage import read
from semfov.sensor import RandomFoveation
from semfov.training.foveal import KIND
from semfov.training.foveal_settings import FinetuneConfig
from semfov.training.foveal_views import Viewer
from train.finetune_foveal import main

pytestmark = [pytest.mark.weights, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
SMALL = [
    "--data.limit",
    "6",
    "--depth",
    "1",
    "--holdout",
    "3",
    "--batch",
    "4",
    "--epochs",
    "3",
    "--rates",
    "[1e-4,1e-3]",
    "--workers",
]
NAME = "yolov3-tiny-foveal"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A detector trained on two views of each of 4 embedded scenes, 2 held out."""
    out = tmp_path_factory.mktemp("tuned")
    threads = torch.get_num_threads()
    assert main([*SMALL, "1", "--out", str(out)]) == 0
    torch.set_num_threads(threads)
    return out


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    data = replace(FinetuneConfig().data, limit=2)
    return Viewer(FinetuneConfig(data=data, cache=tmp_path_factory.mktemp("cache")))


def weights(out):
    tensors, record = read(out / "training.safetensors", KIND)
    return tensors, record["history"]


def test_the_exported_file_gives_the_outputs_of_the_trained_heads(trained):
    """With the trained heads, the original network in torch gives the same outputs as the file."""
    torch_detector = load_detector("yolov3-tiny", runtime="torch")
    kept, _ = weights(trained)
    heads = {name: tensor for name, tensor in kept.items() if name.startswith("layers.")}
    assert set(heads) == {f"layers.{number}.{what}" for number in (15, 22) for what in ("weight", "bias")}
    image = torch.rand(2, 3, 120, 160, generator=torch.Generator().manual_seed(0))
    before = torch_detector.propose(torch_detector.fit(image)[0])
    torch_detector.network.load_state_dict(heads, strict=False)
    filed = load_detector(trained / f"{NAME}.onnx")
    ours, theirs = torch_detector.propose(torch_detector.fit(image)[0]), filed.propose(filed.fit(image)[0])
    for name in ("boxes", "classes", "objectness"):
        one, other = getattr(ours, name), getattr(theirs, name)
        torch.testing.assert_close(other, one, rtol=1e-4, atol=1e-4)
    assert (ours.objectness - before.objectness).abs().max() > 1e-3
    assert filed.name == NAME
    assert filed.classes == torch_detector.classes


def test_training_lowers_the_loss_on_its_own_views(trained):
    figures = json.loads((trained / "training.json").read_text())
    epochs = figures["epochs"]
    assert [epoch["trial"] for epoch in epochs] == [False, True, True, False]
    assert epochs[3]["training"] < epochs[1]["training"]
    assert figures["looking_seconds"] > 0
    assert weights(trained)[1] == epochs


def test_the_model_card_is_stored_in_the_file(trained):
    model = onnx.load(trained / f"{NAME}.onnx")
    card = {entry.key: entry.value for entry in model.metadata_props}["model_card"]
    base = load_detector("yolov3-tiny").digest
    for word in (base, "4 photographs with 2 random fixations", '"rates": [0.0001, 0.001]', '"sigma": 100'):
        assert word in card
    assert card in (trained / "report.md").read_text()


def test_stored_views_are_deleted_after_training(trained):
    assert not list((trained / "features").glob("*/*.safetensors"))


@pytest.mark.long
def test_weights_do_not_depend_on_the_number_of_workers(trained, tmp_path):
    assert main([*SMALL, "2", "--out", str(tmp_path)]) == 0
    for one, other in zip(weights(tmp_path)[0].items(), weights(trained)[0].items(), strict=True):
        assert one[0] == other[0]
        assert torch.equal(one[1], other[1])


@pytest.mark.parametrize(
    "until", [pytest.param("features/*/*.safetensors", marks=pytest.mark.long), "training.safetensors"]
)
def test_killed_training_resumes_with_the_same_weights(trained, tmp_path, kill_when, until):
    call = [sys.executable, "-m", "train.finetune_foveal", *SMALL, "1", "--out", str(tmp_path)]
    kill_when(call, lambda: list(tmp_path.glob(until)), cwd=ROOT)
    threads = torch.get_num_threads()
    assert main([*SMALL, "1", "--out", str(tmp_path)]) == 0
    torch.set_num_threads(threads)
    for name, tensor in weights(trained)[0].items():
        assert torch.equal(tensor, weights(tmp_path)[0][name]), name


def test_a_view_equals_that_of_the_eye_at_the_same_fixation(viewer):
    """The eye at the fixations drawn by the augmentation gives the same images and features."""
    scene = viewer.scenes[1]
    view = viewer.eye.open(scene.image)
    with one_thread():
        canvases = viewer.foveated(view.canvas, view.state, scene.id)
        again = viewer.foveated(view.canvas, view.state, scene.id)
        viewer.see(1)
    assert torch.equal(canvases, again)
    loaded, seconds = viewer.load(1)
    assert seconds > 0
    for number, canvas in enumerate(canvases):
        features = viewer.tail.features(canvas[None])
        for layer, tensor in features.items():
            torch.testing.assert_close(loaded.features[layer][number].float(), tensor[0], rtol=2e-3, atol=2e-3)
    with torch.random.fork_rng():
        torch.manual_seed(generator_for("foveation", 0, scene.id).initial_seed())
        augment = RandomFoveation(9.0, p=1.0)
        augment(view.canvas.repeat(2, 1, 1, 1))
    gaze = augment._params["gaze"]
    placement = view.placement
    fixations = (gaze + 0.5 - torch.tensor(placement.offset)) / torch.tensor(placement.scale) - 0.5
    torch.testing.assert_close(canvases, viewer.eye.foveated(view, fixations), rtol=0, atol=1e-4)
    assert (gaze[0] - gaze[1]).abs().max() > 1


def test_boxes_of_a_view_match_detections_on_the_canvas(viewer):
    with one_thread():
        viewer.see(0)
    loaded, _ = viewer.load(0)
    annotation = viewer.scenes.annotation(0)
    placement = viewer.eye.open(viewer.scenes[0].image).placement
    torch.testing.assert_close(placement.boxes_to_image(loaded.boxes[0]), annotation.boxes, rtol=1e-5, atol=1e-3)
    assert torch.equal(loaded.labels[1], annotation.labels)


def test_views_are_sharp_when_none_is_foveated(viewer):
    sharp = Viewer(replace(viewer.config, foveated=0.0))
    scene = sharp.scenes[0]
    view = sharp.eye.open(scene.image)
    assert torch.equal(sharp.foveated(view.canvas, view.state, scene.id), view.canvas.repeat(2, 1, 1, 1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--detector.name", "yolox-nano"], "unknown detector 'yolox-nano'"),
        (["--depth", "3"], "depth: expected no more than the number of consecutive convolutions before each head"),
        (["--holdout", "1"], "holdout: expected a whole number from 2"),
        (["--data.limit", "1"], "data: expected at least 2 photographs, one to train on and one to hold out, got 1"),
    ],
)
def test_errors_are_reported_in_one_line(arguments, message, tmp_path, capsys):
    assert main(["--data.limit", "1", "--workers", "1", "--out", str(tmp_path), *arguments]) == 1
    assert message in capsys.readouterr().err
