"""Small ONNX files that ask for much are refused before, or stopped while; what is counted is what a pass takes."""

import io
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from operator import attrgetter

import numpy as np
import onnx
import onnx.inliner
import pytest
import torch
from onnx import TensorProto, numpy_helper

from semfov import load_detector
from semfov.detection import onnx_session
from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_budget import _SURE_NUMBERS, _SURE_PRODUCTS, Budget
from semfov.detection.onnx_check import _NodeCounter, check_file
from semfov.detection.onnx_program import _answer_with_description, open_session
from semfov.detection.onnx_session import OnnxSession
from semfov.detection.weights import fetch
from semfov.errors import DataError
from tests.detection.hostile_models import HOSTILE, node, write
from tests.refusals import unusable
from tests.small import write_network

LOAD_ALL = """
import gc, json, os, resource, sys
from pathlib import Path

import onnx, onnxruntime, torch

from semfov.detection import onnx_session
from semfov.errors import DataError

OnnxSession = onnx_session.OnnxSession
for path in sorted(Path(sys.argv[1]).iterdir()):
    onnx_session._MOST_SECONDS = 10.0 if path.stem == "functions that end" else 0.5
    if os.fork():
        os.wait()
        continue
    told = None
    session = None
    try:
        session = OnnxSession(path)
        session(torch.rand(1, 3, 64, 64))
    except DataError as error:
        told = str(error)
    del session  # the memory of its process is known when it has ended
    gc.collect()
    kilobytes = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(json.dumps([path.stem, told, kilobytes]), flush=True)
    os._exit(0)
"""


@pytest.mark.slow
def test_small_files_that_ask_for_much_are_refused_within_a_gigabyte(tmp_path):
    for name in HOSTILE:
        write(tmp_path / f"{name}.onnx", name)
    assert max(path.stat().st_size for path in tmp_path.iterdir()) < 400_000
    done = subprocess.run([sys.executable, "-c", LOAD_ALL, tmp_path], capture_output=True, text=True, check=True)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert {name for name, _, _ in lines} == HOSTILE.keys()
    # Others end within half a second where the processor is fast.
    assert "functions that end" in {name for name, told, _ in lines if told is None}
    reasons = ("at most", "not done after", "need more than")
    assert [told for _, told, _ in lines if told and not any(reason in told for reason in reasons)] == []
    assert max(kilobytes for _, _, kilobytes in lines) < 2**20


def test_a_model_of_very_many_stored_tensors_is_refused(tmp_path):
    path = write(tmp_path / "model.onnx", "functions that end")
    model = onnx.load(path)
    one = numpy_helper.from_array(np.ones(1, np.float32))
    model.graph.initializer.extend([one] * 2**16)
    onnx.save(model, str(path))
    unusable("at most 65,536 stored tensors, got 65,5", check_file, path)


@pytest.mark.parametrize("part", ["functions", "graph.input", "graph.output"])
def test_a_model_of_very_many_parts_is_refused_before_they_are_read(tmp_path, part, monkeypatch):
    path = write(tmp_path / "model.onnx", "functions that end")
    model = onnx.load(path)
    entries = attrgetter(part)(model)
    entries.extend([entries[0]] * 2**13)
    onnx.save(model, str(path))
    monkeypatch.setattr(onnx.inliner, "inline_local_functions", None)
    monkeypatch.setattr(onnx.shape_inference, "infer_shapes", None)
    unusable("functions, got 8,19|inputs and outputs, got 8,19", check_file, path)


def test_own_functions_are_counted_as_what_they_call_and_must_end(tmp_path):
    path = write(tmp_path / "model.onnx", "functions that end")
    assert not check_file(path)
    assert load_onnx(path).propose(torch.rand(1, 3, 64, 64)).boxes.shape == (1, 10, 4)
    model = onnx.load(path)
    model.functions[0].node[0].op_type, model.functions[0].node[0].domain = "F2", "own"
    onnx.save(model, str(path))
    unusable("functions that end, got 'F[012]', which calls itself", check_file, path)


def test_functions_that_call_each_other_far_down_are_counted(tmp_path):
    """Releases of ONNX that put more than a hundred in each other leave the depth to Python's own."""
    model = onnx.load(write(tmp_path / "model.onnx", "functions that end"))
    model.graph.node[0].op_type = "F599"
    del model.functions[1:]
    for i in range(1, 600):
        body = [node(f"F{i - 1}", "x", "y", domain="own")]
        model.functions.append(onnx.helper.make_function("own", f"F{i}", ["x"], ["y"], body, model.opset_import))
    nodes = len(model.graph.node) - 1 + len(model.functions[0].node)
    assert _NodeCounter(model, "model").count(model.graph.node) == nodes


def test_a_model_that_memory_does_not_hold_is_told():
    class Model(np.ndarray):
        def tobytes(self):
            raise MemoryError

    sink = io.BytesIO()
    assert _answer_with_description({"opening": {}}, [np.zeros(1).view(Model)], sink) is None
    assert json.loads(sink.getvalue())["error"] == "MemoryError"


@pytest.mark.parametrize("place", ["../other/weights.bin", "/etc/hostname", "missing.bin", "*/_ORT_MEM_ADDR_/*"])
def test_weights_lie_in_files_of_the_folder(tmp_path, place):
    """onnxruntime takes a place of this name with a star for an address in its own memory."""
    (tmp_path / "other").mkdir()
    (tmp_path / "other/weights.bin").write_bytes(bytes(4096))
    (tmp_path / "model").mkdir()
    path = write(tmp_path / "model/model.onnx", "tiled")
    model = onnx.load(path)
    for tensor in model.graph.initializer:
        if tensor.name == "rows":
            tensor.ClearField("raw_data")
            tensor.data_location = TensorProto.EXTERNAL
            for key, value in {"location": place, "offset": "0", "length": "240"}.items():
                tensor.external_data.add(key=key, value=value)
    onnx.save(model, str(path))
    unusable("leads out of it|no such file|without \\*", check_file, path)
    if "*" in place:
        (tmp_path / "model/*/_ORT_MEM_ADDR_").mkdir(parents=True)
        (tmp_path / "model" / place).write_bytes(bytes(240))
        unusable("a name without \\*", check_file, path)


def budget(tmp_path, nodes, stored, outputs=None):
    path = write_network(tmp_path / "model.onnx", nodes, {"images": [1, 3, 64, 64]}, outputs or {"out": None}, stored)
    return Budget.of(onnx.load(path), (64, 64), "model")


def test_bytes_are_those_of_the_tensors_that_are_there_at_once(tmp_path):
    """Of a chain two maps at a time, beside the input; of a short cut one more; what follows from stored ones stays."""
    size = 3 * 64 * 64 * 4
    chain = [node("Relu", "images", "a"), node("Relu", "a", "b"), node("Relu", "b", "c"), node("Relu", "c", "out")]
    assert budget(tmp_path, chain, {}).bytes() == 3 * size
    cut = [*chain[:3], node("Add", "a c", "out")]
    assert budget(tmp_path, cut, {}).bytes() == 4 * size
    fixed = [node("Sin", "line", "s"), node("Cos", "s", "t"), node("Add", "images t", "out")]
    assert budget(tmp_path, fixed, {"line": np.zeros((3, 64, 64), np.float32)}).bytes() == 4 * size


def test_work_is_the_multiplications_of_the_same_operations_in_torch(tmp_path):
    from torch.utils.flop_counter import FlopCounterMode

    image, weight, turned = torch.rand(1, 3, 64, 64), torch.rand(8, 3, 3, 3), torch.rand(3, 5, 2, 2)
    matrix = torch.rand(64, 7)
    with FlopCounterMode(display=False) as counted:
        torch.conv2d(image, weight, stride=2)
        torch.conv_transpose2d(image, turned, stride=2)
        image @ matrix
    nodes = [
        node("Conv", "images weight", "a", strides=[2, 2]),
        node("ConvTranspose", "images turned", "b", strides=[2, 2]),
        node("MatMul", "images matrix", "c"),
    ]
    stored = {"weight": weight.numpy(), "turned": turned.numpy(), "matrix": matrix.numpy()}
    found = budget(tmp_path, nodes, stored, dict.fromkeys("abc"))
    assert sum(map(found._products, nodes)) == counted.get_total_flops() // 2
    sums = node("Einsum", "images matrix", "d", equation="bchw,wk->bchk")
    assert budget(tmp_path, [sums], stored, {"d": None})._products(sums) == 3 * 64 * 64 * 7


def test_what_a_file_states_of_its_sizes_is_not_believed(tmp_path):
    path = write(tmp_path / "model.onnx", "stated")
    assert check_file(path)


def test_a_canvas_is_in_proportion_to_the_files_of_a_model_of_any_size(make_onnx):
    values = {"output0": np.random.default_rng(0).random((1, 6, 84)).astype(np.float32)}
    path = make_onnx(values, dynamic=True)
    load_detector(path, head="yolov8", classes=["a", "b"], input_size=(640, 640))
    unusable("bytes of tensors together.*smaller input_size", load_detector, path, head="yolov8", input_size=9000)


@pytest.mark.parametrize("tensors", [None, 2**29])
def test_only_models_whose_work_is_known_are_folded(make_onnx, monkeypatch, tensors):
    import onnxruntime

    asked = []
    make = onnxruntime.InferenceSession

    def session(*given, **options):
        asked.append(options.get("disabled_optimizers"))
        return make(*given, **options)

    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    path = str(make_onnx({"a": np.zeros((1, 5, 4), np.float32)}))
    opening = {"path": path, "folder": "", "threads": 1, "spinning": False, "tensors": tensors, "process": None}
    open_session({**opening, "providers": ["CPUExecutionProvider"]})
    assert asked == [tensors and ["ConstantFolding"]]


def slow_where_white(path, batch=1):
    """Write a model with one product of whole numbers, which takes far longer for white pictures than a pass may."""
    nodes = [
        node("ReduceMax", "images", "most", keepdims=0),
        node("Mul", "most largest", "side"),
        node("Cast", "side", "whole", to=TensorProto.INT64),
        node("Add", "whole one", "length"),
        node("Concat", "length length", "sides", axis=0),
        node("ConstantOfShape", "sides", "square", value=numpy_helper.from_array(np.array([1]))),
        node("MatMul", "square square", "product"),
        node("ReduceMax", "product", "greatest", keepdims=0),
        node("Cast", "greatest", "number", to=TensorProto.FLOAT),
        node("Div", "number number", "unit"),
        node("Mul", "unit rows", "out"),
    ]
    stored = {"largest": np.float32(4000), "one": [1], "rows": np.full((batch, 10, 6), 0.5, np.float32)}
    return write_network(path, nodes, {"images": [batch, 3, 64, 64]}, {"out": [batch, 10, 6]}, stored)


def test_a_model_whose_work_is_unknown_runs_in_a_process_that_ends(tmp_path, monkeypatch):
    """Its file is found again from another folder."""
    monkeypatch.setattr(onnx_session, "_MOST_SECONDS", 1.0)
    slow_where_white(tmp_path / "model.onnx")
    monkeypatch.chdir(tmp_path)
    session = OnnxSession("model.onnx")
    assert session.open_ended
    black, white = torch.zeros(1, 3, 64, 64), torch.ones(1, 3, 64, 64)
    assert session(black)["out"].eq(0.5).all()
    first = session._session._process
    monkeypatch.chdir("/")
    unusable("not done after 1 s", session, white)
    assert first.poll() is not None
    assert session(black)["out"].eq(0.5).all()
    assert session.steps((64, 64))
    assert pickle.loads(pickle.dumps(session))(black)["out"].eq(0.5).all()


def test_a_pass_has_time_for_each_image_of_a_fixed_batch(tmp_path):
    session = OnnxSession(slow_where_white(tmp_path / "model.onnx", batch=4))
    session._session._seconds = 0.25
    unusable("not done after 1 s", session, torch.ones(1, 3, 64, 64))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no forks")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_has_a_process_and_turns_of_its_own(tmp_path):
    """It is made while a thread waits for a pass, which goes on."""
    session = OnnxSession(slow_where_white(tmp_path / "model.onnx"))
    model = session._session
    feeds = [{"images": np.full((1, 3, 64, 64), value, np.float32)} for value in (0, 1)]
    model._seconds = 1.5
    told = []

    def wait():
        with pytest.raises(DataError) as caught:
            model.run(["out"], feeds[1])
        told.append(str(caught.value))

    thread = threading.Thread(target=wait)
    thread.start()
    while not model._turn.locked():
        thread.join(0.01)
    child = os.fork()
    if not child:
        signal.alarm(30)  # ends what waits for ever
        code = 1
        with suppress(BaseException):
            model._seconds = 10.0
            code = int(not (model.run(["out"], feeds[0])[0] == 0.5).all())
        os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    thread.join()
    assert told == ["not done after 2 s, as with a loop that does not end"]


@pytest.mark.parametrize(
    ("nodes", "stored", "is_open"),
    [
        ([node("Resize", "images empty scales", "out", mode="linear")], {"scales": [1, 1, 2, 2]}, False),
        ([node("Resize", "images empty scales", "out", mode="cubic")], {"scales": [1, 1, 2, 2]}, True),
        ([node("Cast", "images", "out", to=TensorProto.FLOAT)], {}, False),
        ([node("Cast", "images", "text", to=TensorProto.STRING), node("Cast", "text", "out", to=1)], {}, True),
        ([node("Einsum", "images images", "out", equation="bchw,bcwk->bchk")], {}, False),
        ([node("Einsum", "images images images", "out", equation="bchw,bcwk,bckl->bchl")], {}, True),
        ([node("LpPool", "images", "out", kernel_shape=[3, 3])], {}, True),
        ([node("NonZero", "images", "out")], {}, True),
    ],
)
def test_operations_whose_time_follows_from_sizes_are_told_from_others(tmp_path, nodes, stored, is_open):
    kinds = {"scales": np.float32}
    values = {name: np.array(value, kinds[name]) for name, value in stored.items()}
    found = budget(tmp_path, nodes, {**values, "empty": np.zeros(0, np.float32)})
    assert found.is_open(1000) == is_open


def test_long_passes_and_many_nodes_are_open_ended(tmp_path):
    few = [node("Relu", f"t{i}" if i else "images", f"t{i + 1}") for i in range(100)]
    few[-1].output[0] = "out"
    assert not budget(tmp_path, few, {}).is_open(0)
    many = [node("Relu", f"t{i}" if i else "images", f"t{i + 1}") for i in range(5000)]
    many[-1].output[0] = "out"
    assert budget(tmp_path, many, {}).is_open(0)
    wide = [node("Pad", "images pads", "room"), node("MaxPool", "room", "out", kernel_shape=[1500, 1500])]
    assert budget(tmp_path, wide, {"pads": [0, 0, 1500, 1500, 0, 0, 1500, 1500]}).is_open(0)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["yolox_nano_416", "picodet_s_416_coco", "nanodet_plus_m_1.5x_416"])
def test_shipped_detectors_are_far_below_the_limits(shared, name):
    path = shared / "weights" / f"{name}.onnx"
    assert not check_file(path)
    found = Budget.of(onnx.load(path), (416, 416), name)
    assert found.bytes() < 2**27 / 4
    stored = path.stat().st_size
    assert sum(map(found._products, found.graph.node)) < _SURE_PRODUCTS.of(stored) / 4
    assert sum(map(found._numbers, found.graph.node)) < _SURE_NUMBERS.of(stored) / 2


def test_a_published_file_keeps_within_its_budget_and_is_not_read_twice(fresh):
    # Its check is left out when it is loaded, so this is where it is made.
    assert not check_file(fetch("yolox-nano"))
    code = "import sys, semfov; semfov.load_detector('yolox-nano'); print('onnx' in sys.modules)"
    assert fresh(code) == "False\n"


def test_another_file_under_a_published_name_is_checked(tmp_path, monkeypatch):
    path = tmp_path / "other.onnx"
    path.write_bytes(fetch("yolox-nano").read_bytes() + b"\0")
    checked = []
    monkeypatch.setattr(onnx_session, "check_file", lambda path: checked.append(path) or False)
    with suppress(DataError):
        load_onnx("yolox-nano", weights=path)
    assert checked == [path]
