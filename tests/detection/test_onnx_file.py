"""ONNX files: settings, copies of other sizes, sessions; what is too large or no detector is refused."""

import copy
import json
import os
import pickle
import subprocess
import sys
import tracemalloc

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch.nn import functional as F
from torchvision.ops import box_iou

from semfov import InputError, example, load_detector
from semfov.detection import onnx as onnx_detector
from semfov.detection import onnx_session
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import _parse_cfg, read_cfg
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_decoding import rows_of_images
from semfov.detection.onnx_file import read_settings, with_input_size
from semfov.detection.onnx_session import OnnxSession
from semfov.errors import DataError, SemfovError
from tests.refusals import refused, unusable
from tests.small import write_network


def test_the_settings_file_overrides_the_metadata(tmp_path):
    inside = {"head": "yolox", "classes": ["a"], "preprocessing": {"scale": 1.0, "channels": "rgb"}}
    beside = {"head": "yolov5", "licence": "MIT\n\nPermission is", "preprocessing": {"scale": 255.0}}
    (tmp_path / "model.json").write_text(json.dumps(beside))
    assert read_settings(tmp_path / "model.onnx", {"semfov": json.dumps(inside)}) == {
        "head": "yolov5",
        "classes": ["a"],
        "licence": "MIT\n\nPermission is",
        "preprocessing": {"scale": 255.0, "channels": "rgb"},
    }


def test_numbers_are_names_and_words_that_yaml_changes_are_refused(make_onnx):
    """YAML reads the names `no` and `yes` as booleans; a name that is a number is meant as one."""
    values = {"output0": np.random.default_rng(0).random((1, 6, 84)).astype(np.float32)}
    assert load_detector(make_onnx(values, metadata={"names": "{0: 7, 1: 12}"})).classes == ("7", "12")
    path = make_onnx(values, metadata={"names": "{0: False, 1: 'cat'}"})
    refused(r"classes: expected names, got \[False\]; YAML reads no, off", load_detector, path)
    assert load_detector(path, classes=["no", "cat"]).classes == ("no", "cat")


def test_metadata_are_settings_where_their_form_is_known(tmp_path):
    assert read_settings(tmp_path / "model.onnx", {}) == {"preprocessing": {}}
    metadata = {"names": "{0: 'person', 1: 'dog'}", "imgsz": "[480, 640]", "stride": "32", "task": "detect"}
    found = read_settings(tmp_path / "model.onnx", metadata)
    assert found == {"classes": ["person", "dog"], "input_size": [640, 480], "preprocessing": {}}
    assert read_settings(tmp_path / "model.onnx", {"names": "person,dog"})["classes"] == ["person", "dog"]
    for names in ["{1: 'a'}", "{0: ", "3"]:
        assert read_settings(tmp_path / "model.onnx", {"names": names}) == {"preprocessing": {}}


def test_invalid_and_binary_settings_are_refused_with_the_name_of_the_file(tmp_path):
    for text, message in [
        ('{"head": ', "line 1"),
        ("[]", "an object"),
        ('{"preprocessing": 3}', "preprocessing: expected an object, got 3"),
        ('{"input_size": "416"}', "input_size: expected a list, got '416'"),
        ('{"classes": "cat, dog"}', "classes: expected a list"),
        ('{"logits": 1}', "logits: expected true or false"),
        ('{"heads": "yolox"}', "expected no other keys than name, head.*, got 'heads'"),
    ]:
        (tmp_path / "model.json").write_text(text)
        unusable(rf"model\.json.*{message}", read_settings, tmp_path / "model.onnx", {})
        unusable(rf"metadata of other\.onnx.*{message}", read_settings, tmp_path / "other.onnx", {"semfov": text})
    (tmp_path / "model.json").write_bytes(b"\x9f\xfe\x07\x9f")
    unusable("expected a file of text", read_settings, tmp_path / "model.onnx", {})


WEIGHT = np.random.default_rng(0).normal(size=(6, 3, 8, 8)).astype(np.float32)


@pytest.fixture(params=["initializer", "node"])
def shuffled(request, tmp_path, monkeypatch):
    """A convolution of stride 8 and a shuffle of its channels, exported for 64 x 64 pixels."""
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path / "cache"))
    shapes = {"apart": [1, 2, 3, 8, 8], "together": [1, -1, 8, 8], "cells": [1, 6, -1]}
    steps = [
        helper.make_node("Conv", ["image", "weight"], ["map"], strides=[8, 8]),
        helper.make_node("Reshape", ["map", "apart"], ["groups"]),
        helper.make_node("Transpose", ["groups"], ["mixed"], perm=[0, 2, 1, 3, 4]),
        helper.make_node("Reshape", ["mixed", "together"], ["joined"]),
        helper.make_node("Reshape", ["joined", "cells"], ["output"]),
    ]
    stored = {"weight": WEIGHT}
    if request.param == "node":
        steps = [
            helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(each)))
            for name, each in shapes.items()
        ] + steps
    else:
        stored |= shapes
    return write_network(
        tmp_path / "shuffled.onnx", steps, {"image": [1, 3, 64, 64]}, {"output": [1, 6, 64]}, stored, opset=13
    )


@pytest.mark.parametrize("canvas", [(64, 64), (96, 64), (32, 128)])
def test_a_resized_network_computes_the_same_convolution(shuffled, canvas):
    path = with_input_size(shuffled, canvas)
    image = torch.rand(1, 3, canvas[1], canvas[0], generator=torch.Generator().manual_seed(0))
    expected = F.conv2d(image, torch.from_numpy(WEIGHT), stride=8)[:, [0, 3, 1, 4, 2, 5]].flatten(2)
    torch.testing.assert_close(OnnxSession(path)(image)["output"], expected, rtol=1e-4, atol=1e-4)
    assert with_input_size(shuffled, canvas) == path
    assert (path == shuffled) == (canvas == (64, 64))


def test_copies_of_another_size_are_checked(shuffled):
    path = with_input_size(shuffled, (96, 96))
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert with_input_size(shuffled, (96, 96)).read_bytes() == content
    refused("input_size: expected multiples of 32 pixels", with_input_size, shuffled, (100, 64))


@pytest.mark.shared
@pytest.mark.parametrize("size", [416, 640])
def test_nanodet_plus_is_recognised_by_content_and_takes_other_sizes(shared, tmp_path, size, monkeypatch):
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path))
    file = tmp_path / "mine.onnx"
    file.write_bytes((shared / "weights" / "nanodet_plus_m_1.5x_416.onnx").read_bytes())
    detector = load_detector(file, input_size=size)
    named = load_detector("nanodet-plus-m-1.5x", weights=file, input_size=size)
    assert (detector.name, detector.digest) == (named.name, named.digest)
    assert detector.input_size == (size, size)
    picture = torch.rand(1, 3, 300, 400, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(detector(picture).scores, named(picture).scores)


def test_the_head_of_a_published_network_is_known_without_a_pass(tmp_path, monkeypatch):
    """It is the one that is found out for the same network in another file."""
    passes = []
    run = OnnxSession.__call__
    monkeypatch.setattr(OnnxSession, "__call__", lambda self, image: passes.append(image) or run(self, image))
    published = load_detector("yolox-nano")
    assert not passes
    graph = onnx.load(published.session.path)
    graph.producer_name = "another"
    onnx.save(graph, tmp_path / "copy.onnx")
    copied = load_detector(tmp_path / "copy.onnx", classes=published.classes)
    assert len(passes) == 1
    assert copied.head == published.head == "yolox"


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "file"), [("nanodet-plus-m-1.5x", "nanodet_plus_m_1.5x_416.onnx"), ("yolox-nano", "yolox_nano_416.onnx")]
)
def test_a_published_model_sees_the_same_objects_at_all_sizes(name, file, shared, tmp_path, monkeypatch):
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path))
    """The surest object of a photograph with a crowd is among those of the other sizes."""
    image = example("aeroplane")[None]
    boxes = []
    for size in (None, 160, 640):
        detector = load_detector(name, weights=shared / "weights" / file, input_size=size)
        found = detector(image)
        assert detector.input_size == (size or 416,) * 2
        assert detector.classes[found.labels[0, 0] - 1] == "person"
        boxes.append(found.boxes[0])
    for other in boxes[1:]:
        assert float(box_iou(boxes[0][:1], other).max()) > 0.7


def values(*shape):
    return np.random.default_rng(0).random(shape)


def expected(base, image):
    return base * image.double().mean((1, 2, 3)).sigmoid().numpy().reshape(-1, *[1] * (base.ndim - 1))


def images(count, dtype=torch.float32):
    return torch.rand(count, 3, 64, 64, dtype=dtype, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("batch", [1, 2, 3, "batch"])
@pytest.mark.parametrize("count", [1, 3, 4])
def test_batches_of_any_size_with_fixed_and_dynamic_models(make_onnx, batch, count):
    base = values(1, 5, 4)
    session = OnnxSession(make_onnx({"a": base, "b": base[..., 0]}, batch=batch))
    image = images(count)
    outputs = session(image)
    assert list(outputs) == ["a", "b"]
    np.testing.assert_allclose(outputs["a"].numpy(), expected(base, image), rtol=1e-5)
    np.testing.assert_allclose(outputs["b"].numpy(), expected(base[..., 0], image), rtol=1e-5)


@pytest.mark.parametrize("model", [np.float16, np.float32, np.float64])
def test_outputs_have_the_dtype_of_the_image(make_onnx, model, dtype):
    base = values(1, 5, 4)
    image = images(1, dtype)
    output = OnnxSession(make_onnx({"a": base}, dtype=model))(image)["a"]
    assert output.dtype == dtype
    np.testing.assert_allclose(output.numpy(), expected(base, image), rtol=1e-2 if model == np.float16 else 1e-5)


def test_sizes_metadata_and_threads(make_onnx):
    path = make_onnx({"a": values(1, 5, 4)}, dynamic=True, batch="n", metadata={"key": "value"}, producer="me")
    session = OnnxSession(path)
    assert session.shape == (None, 3, None, None)
    assert session.outputs == (("a", (None, 5, 4)),)
    assert session.metadata == {"key": "value"}
    assert session.producer == "me"
    assert session.threads == torch.get_num_threads()
    assert OnnxSession(path, threads=1).threads == 1
    refused("threads", OnnxSession, path, threads=0)


def test_threads_do_not_spin_unless_asked_and_sessions_are_copied(make_onnx):
    path = make_onnx({"a": values(1, 5, 4)})
    entry = "session.intra_op.allow_spinning"
    for spinning in (False, True):
        options = OnnxSession(path, spinning=spinning)._session.get_session_options()
        assert options.get_session_config_entry(entry) == str(int(spinning))
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}), threads=1)
    for twin in (pickle.loads(pickle.dumps(session)), copy.deepcopy(session)):
        assert twin.threads == 1
        assert torch.equal(twin(images(1))["a"], session(images(1))["a"])


def test_inputs_for_image_size_and_scale_are_filled_without_output(make_onnx, capfd):
    extra = {"orig_target_sizes": (7, [1, 2]), "im_shape": (1, [1, 2]), "scale_factor": (1, [1, 2])}
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}, extra=extra))
    assert session(images(2))["a"].shape == (2, 5, 4)
    OnnxSession(make_onnx({"a": values(1, 5, 4)}, extra={"scale_factor": (1, [1, 2])}))(images(1))
    assert capfd.readouterr() == ("", "")


def test_unsuitable_files_and_inputs_are_refused(make_onnx, tmp_path):
    unusable(r"missing\.onnx': no such file", OnnxSession, tmp_path / "missing.onnx")
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(make_onnx({"a": values(1, 5, 4)}).read_bytes()[:100])
    unusable(r"damaged\.onnx", OnnxSession, damaged)
    refused("mystery", OnnxSession, make_onnx({"a": values(1, 5, 4)}, extra={"mystery": (1, [1, 2])}))
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}))
    refused("at least one image", session, images(1)[:0])
    unusable(r"model\.onnx: fails on images of shape \(1, 3, 64, 32\)", session, images(1)[..., :32])


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_device_is_refused(make_onnx):
    refused("CPUExecutionProvider", OnnxSession, make_onnx({"a": values(1, 5, 4)}), device="cuda")


def test_execution_providers_are_chosen_by_name(make_onnx):
    path = make_onnx({"output": values(1, 84, 85) - 0.5 * (np.arange(85) < 4)})
    wanted = [("CPUExecutionProvider", {"arena_extend_strategy": "kSameAsRequested"})]
    chosen, plain = load_onnx(path, providers=wanted), load_onnx(path)
    assert chosen.settings() == plain.settings() | {"providers": wanted}
    assert pickle.loads(pickle.dumps(chosen.session)).providers == tuple(wanted)
    canvas = images(1)
    assert torch.equal(chosen.propose(canvas).classes, plain.propose(canvas).classes)
    for missing in ([], ["CPUExecutionProvider", "NoSuchProvider"]):
        with pytest.raises(InputError, match=r"providers: expected some of .*CPUExecutionProvider, got (none|NoSuch)"):
            load_onnx(path, providers=missing)


def open_ended(path, nodes, numbers, boxes):
    """A model of the family `candidates` with given steps to its boxes and scores."""
    return write_network(
        path, nodes, {"images": [1, 3, 64, 64]}, {"boxes": [1, boxes, 4], "scores": [1, boxes, 80]}, numbers
    )


@pytest.mark.parametrize(("count", "reason"), [(9, None), (11, "at most 10 boxes, got 11"), (9_000_000, "512 MiB")])
def test_the_number_of_boxes_may_depend_on_values_up_to_a_limit(tmp_path, monkeypatch, count, reason):
    monkeypatch.setattr(onnx_detector, "_MOST_BOXES", 10)
    shapes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Cast", ["mean"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Add", ["whole", "count"], ["boxes count"]),
    ]
    for name in ("boxes", "scores"):
        shapes.append(helper.make_node("Concat", ["one", "boxes count", f"{name} size"], [f"{name} shape"], axis=0))
        shapes.append(helper.make_node("ConstantOfShape", [f"{name} shape"], [name]))
    numbers = {"count": [count], "one": [1], "boxes size": [4], "scores size": [80]}
    path = open_ended(tmp_path / "model.onnx", shapes, numbers, None)
    if reason is None:
        assert load_detector(path).propose(torch.zeros(2, 3, 64, 64)).boxes.shape == (2, 9, 4)
    else:
        unusable(rf"model.*{reason}", lambda: load_detector(path).propose(torch.zeros(2, 3, 64, 64)))


ROWS = np.array([[4, 4, 20, 20, 0.9, 1], [30, 30, 50, 60, 0.8, 0], [2, 30, 10, 60, 0.7, 2]], np.float32)


def selecting(path, stored, shape, axis):
    """A model that returns as many of the stored rows as its brightest pixel says."""
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["brightest"], keepdims=0),
        helper.make_node("Cast", ["brightest"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Unsqueeze", ["whole", "first"], ["count"]),
        helper.make_node("Slice", ["stored", "first", "count", "axis"], ["output"]),
    ]
    numbers = {"stored": stored, "first": np.array([0]), "axis": np.array([axis])}
    names = {"names": "{0: 'cat', 1: 'dog', 2: 'cup'}"}
    return write_network(path, nodes, {"images": [1, 3, 64, 64]}, {"output": shape}, numbers, metadata=names)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.filterwarnings("ignore:.*selects boxes itself")
def test_each_image_of_a_batch_may_have_other_numbers_of_boxes(tmp_path, flat):
    """As rows of each image, or of all images together with the number of the image before the class and the score."""
    if flat:
        rows = np.insert(ROWS[:, [0, 1, 2, 3, 5, 4]], 0, 0, axis=1)
        path = selecting(tmp_path / "model.onnx", rows, [None, 7], 0)
    else:
        path = selecting(tmp_path / "model.onnx", ROWS[None], [1, None, 6], 1)
    detector = load_detector(path, head="end2end")
    counts = 2, 0, 3
    batch = torch.stack([torch.full((3, 64, 64), float(count)) for count in counts])
    found = detector.propose(batch)
    for image, count in enumerate(counts):
        assert found.boxes[image, :count].tolist() == ROWS[:count, :4].tolist()
        labels = found.classes[image].argmax(-1)[:count]
        assert labels.tolist() == ROWS[:count, 5].tolist()
        torch.testing.assert_close(found.classes[image].amax(-1)[:count], torch.from_numpy(ROWS[:count, 4]))
        assert found.classes[image, count:].sum() == 0
    alone = detector.propose(batch[2:])
    assert torch.equal(alone.boxes[0], found.boxes[2])


def test_rows_of_all_images_are_known_by_their_columns_and_name_their_image(tmp_path):
    rows = np.insert(ROWS[:, [0, 1, 2, 3, 5, 4]], 0, 0, axis=1)
    with pytest.warns(UserWarning, match="selects boxes itself"):
        assert load_detector(selecting(tmp_path / "model.onnx", rows, [None, 7], 0)).head == "end2end"
    of_both = torch.from_numpy(rows[[0, 1, 2, 0]])
    of_both[:, 0] = torch.tensor([1, 0, 1, 1])
    divided = rows_of_images(of_both, 3)
    assert divided.shape == (3, 3, 6)
    assert divided[1].tolist() == ROWS[[0, 2, 0]].tolist()
    assert divided[0].tolist() == [ROWS[1].tolist(), [0] * 6, [0] * 6]
    refused("rows: expected the number of an image, from 0 to 0, in the first column", rows_of_images, of_both, 1)


@pytest.mark.parametrize("nested", [False, True])
def test_a_loop_that_does_not_end_is_stopped(tmp_path, monkeypatch, nested):
    def value(name, kind=TensorProto.FLOAT, shape=(1, 9, 4)):
        return helper.make_tensor_value_info(name, kind, [*shape])

    again = [helper.make_node("Identity", ["go"], ["go on"]), helper.make_node("Identity", ["in"], ["out"])]
    body_inputs = [value("step", TensorProto.INT64, ()), value("go", TensorProto.BOOL, ()), value("in")]
    body = helper.make_graph(again, "body", body_inputs, [value("go on", TensorProto.BOOL, ()), value("out")])
    loop = helper.make_node("Loop", ["", "yes", "start"], ["boxes"], body=body)
    if nested:
        inner = helper.make_node("Loop", ["", "yes", "start"], ["inside"], body=body)
        branches = {
            f"{name}_branch": helper.make_graph([inner], name, [], [value("inside")]) for name in ("then", "else")
        }
        loop = helper.make_node("If", ["yes"], ["boxes"], **branches)
    numbers = {"yes": True, "start": np.ones((1, 9, 4), np.float32), "half": np.full((1, 9, 80), 0.5, np.float32)}
    path = open_ended(tmp_path / "model.onnx", [loop, helper.make_node("Identity", ["half"], ["scores"])], numbers, 9)
    monkeypatch.setattr(onnx_session, "_MOST_SECONDS", 0.6)
    unusable(r"model\.onnx: fails on images .* not done after 1 s, as with a loop", load_detector, path)


def test_the_reason_of_onnxruntime_is_not_cut_and_its_telemetry_is_off(tmp_path, make_onnx, monkeypatch):
    import onnxruntime

    off = []
    monkeypatch.setattr(onnxruntime, "disable_telemetry_events", lambda: off.append(True))
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}))
    assert off
    unusable(r"index: 3 Got: 32 Expected: 64", session, images(1)[..., :32])
    nodes = [helper.make_node("Identity", ["images"], ["boxes"]), helper.make_node("Unknown", ["images"], ["scores"])]
    long = tmp_path / ("long" * 40) / "model.onnx"
    long.parent.mkdir()
    unusable("Unknown", OnnxSession, open_ended(long, nodes, {}, 9))


@pytest.mark.lab
def test_onnxruntime_writes_nothing_about_the_machine(tmp_path):
    """In a process of its own: it writes while it is imported."""
    code = "from semfov.detection.onnx_program import runtime; runtime()"
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    subprocess.run([sys.executable, "-c", code], env={**environment, "HOME": str(tmp_path)}, check=True)
    assert not [path for path in tmp_path.rglob("*") if "onnxruntime" in str(path).lower()]


NET = "[net]\nwidth=32\nheight=32\nchannels=3\n"
HEAD = "[convolutional]\nfilters=7\nsize=1\n[yolo]\nmask=0\nanchors=4,6\nclasses=2\n"
DEEP = "".join("[convolutional]\nfilters=8000\nsize=3\npad=1\n" for _ in range(3))


@pytest.mark.parametrize(
    "cfg",
    [
        NET + "[convolutional]\nfilters=100000000\nsize=3\n" + HEAD,
        NET + DEEP + HEAD,
        NET + "[convolutional]\nfilters=21\nsize=99999\n" + HEAD,
        NET + "[maxpool]\nsize=99999\nstride=1\n" + HEAD,
        NET + "[convolutional]\nfilters=7\nsize=1\npadding=1000000000\n" + HEAD,
        NET + "[upsample]\nstride=10000\n" + HEAD,
        NET + "[upsample]\nstride=100\n[upsample]\nstride=100\n" + HEAD,
        NET + "[convolutional]\nfilters=4\nsize=1\n" + "[route]\nlayers=-1,-1,-1,-1\n" * 40 + HEAD,
        NET.replace("32", "99999999") + HEAD,
        NET.replace("channels=3", "channels=" + "9" * 400) + HEAD,
        NET + HEAD.replace("4,6", "nan,6"),
        NET + HEAD.replace("4,6", "inf,6"),
        NET + HEAD.replace("classes=2", "classes=1000000000"),
        NET + "[dropout]\n" * 5000 + HEAD,
    ],
)
def test_too_large_networks_are_refused_before_memory_is_allocated(cfg):
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            Darknet(_parse_cfg(cfg))
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 400
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


def test_pipes_and_too_long_files_are_refused(tmp_path):
    path = tmp_path / "long.cfg"
    path.write_text("#" * 2**21)
    unusable("at most", read_cfg, path)
    os.mkfifo(tmp_path / "pipe")
    network = Darknet(_parse_cfg(NET + HEAD))
    for read in (read_cfg, network.read_weights, OnnxSession):
        unusable("expected a file, got a pipe", read, tmp_path / "pipe")
    with (tmp_path / "sparse.weights").open("wb") as file:
        file.truncate(2**40)
    unusable("too long", network.read_weights, tmp_path / "sparse.weights")


def save(path, nodes, outputs, stored=None, *, image=(1, 3, 32, 32), **more):
    """Write a model with one image input."""
    return write_network(path, nodes, {"image": [*image]}, outputs, stored or {}, **more)


def test_boolean_and_scalar_outputs_are_refused_by_name(tmp_path):
    cast = helper.make_node("Cast", ["image"], ["label"], to=TensorProto.BOOL)
    with pytest.raises(InputError, match=r"output 'label': expected numbers, got tensor\(bool\)"):
        load_onnx(save(tmp_path / "flags.onnx", [cast], {"label": (TensorProto.BOOL, [1, 3, 32, 32])}))
    mean = helper.make_node("ReduceMean", ["image"], ["score"], keepdims=0)
    path = save(tmp_path / "scalar.onnx", [mean], {"score": []})
    refused(r"output 'score': expected a row for each of 1 images, got shape \(\)", load_onnx, path)


def test_rows_of_all_images_together_are_refused_with_a_remedy(tmp_path):
    """As YOLOv7's, Paddle's and torchvision's own selections return them, image by image in no dimension."""
    rows = helper.make_node("Reshape", ["image", "shape"], ["rows"])
    stored = {"shape": np.array([-1, 6])}
    path = save(tmp_path / "selected.onnx", [rows], {"rows": ["boxes", 6]}, stored)
    refused(r"'rows': expected a row for each of 1 images, got .*; export it without non-maximum", load_onnx, path)


def colour_network(path, shape, kind=TensorProto.FLOAT, order=(0, 1, 2, 3)):
    """Write a network that shows the pixels of 8 × 8 cells of 32 × 24 px as scores of three classes, at every level.

    `order` brings its input into (B, C, H, W); bytes are divided by 255.
    """
    steps = [
        helper.make_node("Cast", ["image"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("Div", ["numbers", "white"], ["fractions"]),
        helper.make_node("Transpose", ["fractions"], ["planes"], perm=list(order)),
        helper.make_node("AveragePool", ["planes"], ["cells"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Reshape", ["cells", "columns"], ["scores"]),
        helper.make_node("Concat", ["boxes", "scores"], ["output0"], axis=1),
    ]
    boxes = np.tile(np.array([16, 12, 8, 8], np.float32)[:, None], (1, 1, 12))
    white = 255 if kind == TensorProto.UINT8 else 1
    stored = {"boxes": boxes, "columns": np.array([1, 3, 12]), "white": np.float32(white)}
    return write_network(path, steps, {"image": (kind, shape)}, {"output0": [1, 7, 12]}, stored)


LAST = [0, 3, 1, 2]  # from channels in the last place


@pytest.mark.parametrize(
    ("shape", "kind", "order"),
    [
        ([1, 24, 32, 3], TensorProto.FLOAT, LAST),
        ([1, 3, 24, 32], TensorProto.UINT8, [0, 1, 2, 3]),
        ([1, 24, 32, 3], TensorProto.UINT8, LAST),
        (["images", "rows", "columns", 3], TensorProto.UINT8, LAST),
    ],
)
@pytest.mark.parametrize("colour", ["rgb", "bgr"])
def test_channels_may_come_last_and_pixels_may_be_bytes(tmp_path, shape, kind, order, colour):
    """Against the same network with planes of floats, and against the means of the pixels themselves."""
    options = {"head": "yolov8", "classes": ["red", "green", "blue"], "preprocessing": {"channels": colour}}
    usual = load_onnx(colour_network(tmp_path / "usual.onnx", [1, 3, 24, 32]), **options)
    other = load_onnx(colour_network(tmp_path / "other.onnx", shape, kind, order), input_size=(32, 24), **options)
    picture = torch.randint(256, (1, 3, 24, 32), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    means = F.avg_pool2d(picture / 255, 8).flatten(2).mT
    expected = means if colour == "rgb" else means.flip(-1)
    for canvas in (picture / 255, picture):
        propose = other.propose_bytes if canvas.dtype == torch.uint8 else other.propose
        torch.testing.assert_close(propose(canvas).classes, expected)
    assert usual.input_size == other.input_size
    torch.testing.assert_close(usual.propose(picture / 255).classes, other.propose(picture / 255).classes)
    torch.testing.assert_close(pickle.loads(pickle.dumps(other)).propose(picture / 255).classes, expected)


def test_a_network_of_bytes_takes_no_other_numbers(tmp_path):
    path = colour_network(tmp_path / "bytes.onnx", [1, 3, 24, 32], TensorProto.UINT8)
    options = {"head": "yolov8", "classes": ["red", "green", "blue"]}
    message = r"preprocessing: expected .*scale=255.* for bytes.onnx, which takes bytes, got .*scale=1,"
    refused(message, load_onnx, path, preprocessing={"scale": 1.0}, **options)


@pytest.mark.parametrize(("kind", "shape"), [(TensorProto.INT32, [1, 32, 32, 3]), (TensorProto.UINT8, [1, 1, 32, 32])])
def test_images_in_other_forms_are_refused_with_a_remedy(tmp_path, kind, shape):
    image = helper.make_tensor_value_info("image", kind, shape)
    cast = helper.make_node("Cast", ["image"], ["out"], to=TensorProto.FLOAT)
    graph = helper.make_graph([cast], "g", [image], [helper.make_tensor_value_info("out", TensorProto.FLOAT, shape)])
    opset = helper.make_opsetid("", 17)
    path = tmp_path / "other.onnx"
    path.write_bytes(helper.make_model(graph, opset_imports=[opset], ir_version=8).SerializeToString())
    refused(r"one input of floats or bytes, .*, got .*; export it with such an input", load_onnx, path)


@pytest.mark.parametrize("side", [100_000, 2**40])
def test_too_large_tensors_are_refused_before_memory_is_allocated(tmp_path, side):
    identity = helper.make_node("Identity", ["image"], ["out"])
    big = [1, 3, side, side]
    with pytest.raises(SemfovError, match="at most"):
        load_onnx(save(tmp_path / "canvas.onnx", [identity], {"out": big}, image=big))
    fill = helper.make_node("ConstantOfShape", ["shape"], ["out"])
    with pytest.raises(DataError, match=r"tensor 'out': expected at most"):
        load_onnx(save(tmp_path / "fill.onnx", [fill], {"out": None}, {"shape": [1, side, side]}))
    batch = [side, 3, 32, 32]
    with pytest.raises(SemfovError, match="at most"):
        load_onnx(save(tmp_path / "batch.onnx", [identity], {"out": batch}, image=batch))


def test_weights_outside_the_folder_of_the_model_are_refused(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(4))
    folder = tmp_path / "model"
    folder.mkdir()
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="../secret")
    add = helper.make_node("Add", ["image", "w"], ["out"])
    path = folder / "model.onnx"
    model = onnx.load(save(path, [add], {"out": [1, 3, 32, 32]}))
    model.graph.initializer.append(tensor)
    path.write_bytes(model.SerializeToString())
    unusable("leads out of it", load_onnx, path)


@pytest.mark.parametrize(
    "metadata",
    [
        {"names": "[" * 10_000},
        {"names": "{0: 'a\x00'}"},
        {"names": "{0: " + "9" * 10_000 + "}"},
        {"imgsz": "[" * 5000 + "]" * 5000},
        {"semfov": "[" * 100_000},
        {"semfov": '{"classes": [1, 2]}'},
        {"semfov": '{"classes": ["\\u0000"]}'},
        {"semfov": '{"input_size": [1e400, 2]}'},
        {"semfov": json.dumps({"surplus" * 1000: 1})},
        {"noise": "x" * 2**21},
    ],
)
def test_invalid_or_excessive_metadata_is_refused_in_one_line(tmp_path, metadata):
    reshape = helper.make_node("Reshape", ["image", "shape"], ["out"])
    path = save(tmp_path / "model.onnx", [reshape], {"out": [1, 384, 8]}, {"shape": [1, 384, 8]}, metadata=metadata)
    with pytest.raises(SemfovError) as caught:
        load_onnx(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_an_ordinary_network_is_accepted(tmp_path):
    with torch.random.fork_rng(devices=[]):
        network = Darknet(_parse_cfg(NET + HEAD))
    assert [tuple(each.shape) for each in network(torch.zeros(1, 3, 32, 32))] == [(1, 7, 32, 32)]
