import copy
import hashlib
import os
import pickle
import sys

import pytest
import torch
from torch.autograd import forward_ad
from torch.func import functional_call, grad, jvp

from semfov import example
from semfov.detection.darknet_onnx import _VERSION, OnnxTwin, _exported, network_digest, network_model
from semfov.detection.load import load_yolo
from semfov.errors import InputError
from tests.refusals import refused


@pytest.fixture
def looks(monkeypatch):
    """Canvases that were given to onnxruntime."""
    seen = []
    call = OnnxTwin.__call__
    monkeypatch.setattr(OnnxTwin, "__call__", lambda self, *given: (seen.append(given[1]), call(self, *given))[1])
    return seen


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache for one test."""
    path = tmp_path / "cache"
    monkeypatch.setattr("semfov.detection.darknet_onnx.cache_folder", lambda: path)
    return path


def canvases(*size, seed=0, **options):
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed)).to(**options)


def same_as(network, canvas, found, side):
    with torch.no_grad():
        expected = network.propose(canvas)
    torch.testing.assert_close(found.boxes / side, expected.boxes / side, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.classes, expected.classes, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.objectness, expected.objectness, atol=1e-4, rtol=0)


@pytest.mark.parametrize("shape", [(1, 3, 32, 64), (1, 3, 64, 64), (3, 3, 16, 48)])
@pytest.mark.parametrize("runtime", ["auto", "onnxruntime"])
def test_onnxruntime_equals_torch(make_small, looks, shape, runtime):
    detector, canvas = make_small(runtime), canvases(*shape)
    same_as(make_small("torch"), canvas, detector.propose(canvas), 64)
    assert len(looks) == 1
    assert detector.settings()["runtime"] == "onnxruntime"


@pytest.mark.weights
def test_onnxruntime_equals_torch_with_published_weights(tiny_weights, looks):
    image = example("market")[None]
    detector = load_yolo("yolov3-tiny", weights=tiny_weights)
    network = load_yolo("yolov3-tiny", weights=tiny_weights, runtime="torch", dtype=torch.float64)
    canvas = detector.fit(image)[0]
    same_as(network.float(), canvas, detector.propose(canvas), 416)
    assert len(looks) == 1


def test_gradients_are_computed_by_torch(make_small, looks):
    detector = make_small("auto")
    canvas = canvases(1, 3, 32, 64).requires_grad_()
    detector.propose(canvas).classes.sum().backward()
    assert bool(canvas.grad.any())
    canvas = canvas.detach()
    detector.requires_grad_(True)
    assert detector.propose(canvas).classes.requires_grad
    assert not looks
    with torch.no_grad():
        detector.propose(canvas.requires_grad_())
    with torch.inference_mode():
        detector.propose(canvas)
    assert len(looks) == 2


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:FutureWarning")  # raised by jvp of torch
def test_forward_gradients_and_transforms_are_computed_by_torch(make_small, looks):
    detector, canvas = make_small("auto"), canvases(2, 3, 32, 64)
    tangent = torch.ones_like(canvas)
    with forward_ad.dual_level():
        dual = forward_ad.unpack_dual(detector.propose(forward_ad.make_dual(canvas, tangent)).classes).tangent
    assert bool(dual.any())
    torch.testing.assert_close(jvp(lambda x: detector.propose(x).classes, (canvas,), (tangent,))[1], dual)
    backward = grad(lambda x: detector.propose(x).classes.sum())(canvas)
    torch.testing.assert_close(backward.sum(), dual.sum(), rtol=1e-4, atol=0)
    assert not looks


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning", "ignore:.*torch.jit.trace")
def test_compiled_and_traced_graphs_use_torch(make_small, looks):
    detector, canvas = make_small("auto"), canvases(1, 3, 32, 64)
    compiled = torch.compile(lambda x: detector.propose(x).classes, fullgraph=True, backend="eager")(canvas)
    traced = torch.jit.trace(lambda x: detector.propose(x).classes, canvas, check_trace=False)(canvas)
    assert not looks
    for classes in (compiled, traced):
        torch.testing.assert_close(classes, make_small("torch").propose(canvas).classes)


def test_networks_of_other_precision_use_torch(make_small, looks):
    detector, canvas = make_small("auto"), canvases(1, 3, 32, 64)
    exact = detector.double().propose(canvas)
    assert exact.boxes.dtype == torch.float64
    assert detector.settings()["runtime"] == "torch"
    assert not looks
    found = detector.float().propose(canvas.double())
    assert found.boxes.dtype == torch.float32
    assert len(looks) == 1
    torch.testing.assert_close(found.classes.double(), exact.classes, atol=1e-5, rtol=0)


def test_other_devices_and_tensor_subclasses_use_torch(make_small, looks):
    class Marked(torch.Tensor):
        pass

    detector, canvas = make_small("auto"), canvases(1, 3, 32, 64)
    marked = detector.propose(canvas.as_subclass(Marked)).classes
    torch.testing.assert_close(marked.as_subclass(torch.Tensor), make_small("torch").propose(canvas).classes)
    assert detector.to("meta").propose(canvas.to("meta")).boxes.is_meta
    assert detector.settings()["runtime"] == "torch"
    assert not looks


def test_changed_weights_use_torch(make_small, looks):
    detector, network, canvas = make_small("auto"), make_small("torch"), canvases(1, 3, 32, 64)
    before = detector.propose(canvas).classes
    kept = copy.deepcopy(detector.state_dict())
    with torch.no_grad():
        for each in (detector, network):
            each.network.layers[0].weight.mul_(2)
    assert torch.equal(detector.propose(canvas).classes, network.propose(canvas).classes)
    assert detector.settings()["runtime"] == "torch"
    detector.load_state_dict(kept)
    assert torch.equal(detector.propose(canvas).classes, before)
    zeros = {name: torch.zeros_like(value) for name, value in detector.named_parameters()}
    with torch.no_grad():
        assert not torch.equal(functional_call(detector, zeros, canvas).scores, detector(canvas).scores)
    assert len(looks) == 3


def test_runtime_onnxruntime_refuses_what_it_does_not_support(make_small):
    canvas = canvases(1, 3, 32, 64)
    refused("runtime: expected 'auto' or 'torch' or 'onnxruntime', got 'onnx'", make_small, "onnx")
    with pytest.raises(InputError, match="runtime: expected 'auto' or 'torch' for gradients, got 'onnxruntime'"):
        make_small("onnxruntime").propose(canvas.clone().requires_grad_())
    with pytest.raises(InputError, match=r"'torch' for a network of torch.float64, got"):
        make_small("onnxruntime", dtype=torch.float64).propose(canvas)
    refused("'torch' for graphs that are traced", make_small("onnxruntime").propose, canvas.to("meta"))
    detector = make_small("onnxruntime")
    for size in ((3, 32, 60), (1, 32, 64)):
        refused("image: expected", detector.propose, torch.zeros(1, *size))
    detector.network.layers[0].weight.mul_(2)
    refused("'torch' for weights that were changed after loading, got", detector.propose, canvas)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda detector: pickle.loads(pickle.dumps(detector))])
def test_copies_give_the_same_outputs(make_small, looks, duplicate):
    detector, canvas = make_small("auto"), canvases(1, 3, 32, 64)
    classes = detector.propose(canvas).classes
    assert torch.equal(duplicate(detector).propose(canvas).classes, classes)
    assert len(looks) == 2


def test_outputs_do_not_depend_on_the_number_of_threads_or_the_batch(make_small, threads):
    canvas = canvases(3, 3, 64, 64)
    detector = make_small("auto")
    one, two = [detector.propose(canvas) for _ in threads()]
    assert torch.equal(one.classes, two.classes)
    alone = detector.propose(canvas[1:2])
    assert torch.equal(alone.classes[0], one.classes[1])
    assert torch.equal(alone.boxes[0], one.boxes[1])


def test_another_number_of_threads_or_process_opens_a_new_session(make_small, threads, monkeypatch):
    detector, canvas = make_small("auto"), canvases(1, 3, 32, 64)
    for number in threads():
        detector.propose(canvas)
        session = detector._twin._opened[()][1]
        assert session.threads == number
        detector.propose(canvas)
        assert detector._twin._opened[()][1] is session
    pid = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: pid + 1)
    detector.propose(canvas)
    assert detector._twin._opened[()][1] is not session


@pytest.mark.parametrize("damage", [b"", b"half", None])
def test_a_damaged_export_is_replaced(make_small, folder, damage):
    network = make_small("torch").network
    path = _exported(network, network_digest(network), folder)
    whole = path.read_bytes()
    content = whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:] if damage is None else damage
    path.write_bytes(content)
    assert _exported(network, network_digest(network), folder) == path
    assert path.read_bytes() == whole
    assert os.listdir(folder) == [path.name]


def test_every_network_and_version_has_its_own_export(make_small, folder, monkeypatch):
    network = make_small("torch").network
    path = _exported(network, network_digest(network), folder)
    assert path.name.split(".")[1] == hashlib.sha256(path.read_bytes()).hexdigest()
    written = path.stat().st_mtime_ns
    assert _exported(network, network_digest(network), folder).stat().st_mtime_ns == written
    monkeypatch.setattr("semfov.detection.darknet_onnx._VERSION", _VERSION + 1)
    assert _exported(network, network_digest(network), folder) != path
    assert network_digest(copy.deepcopy(network).double()) == network_digest(network)
    with torch.no_grad():
        network.layers[0].weight.mul_(2)
    assert _exported(network, network_digest(network), folder) != path
    assert len(os.listdir(folder)) == 3


def test_onnxruntime_works_without_a_writable_cache(make_small, folder, looks):
    folder.write_text("a file where the folder should be")
    canvas = canvases(1, 3, 32, 64)
    same_as(make_small("torch"), canvas, make_small("auto").propose(canvas), 64)
    assert len(looks) == 1


def test_only_the_first_call_needs_the_package_onnx(make_small, folder, monkeypatch):
    canvas = canvases(1, 3, 32, 64)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "onnx", None)
        with pytest.raises(ModuleNotFoundError, match="pip install onnx"):
            make_small("auto").propose(canvas)
    found = make_small("auto").propose(canvas)
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert torch.equal(make_small("auto").propose(canvas).classes, found.classes)


def test_exporting_does_not_change_random_state_or_depend_on_default_dtype(make_small, folder):
    detector, canvas = make_small("auto"), canvases(1, 3, 32, 64)
    torch.manual_seed(3)
    before = torch.get_rng_state()
    detector.propose(canvas)
    assert torch.equal(torch.get_rng_state(), before)
    whole = _exported(detector.network, network_digest(detector.network), folder / "exported").read_bytes()
    torch.set_default_dtype(torch.float64)
    try:
        assert network_model(detector.network, "darknet").SerializeToString() == whole
    finally:
        torch.set_default_dtype(torch.float32)


LOOK = """
import hashlib, os, torch, warnings
warnings.simplefilter("error")
os.environ["SEMFOV_CACHE"] = {cache!r}
from semfov.detection.load import load_yolo
torch.set_num_threads(1)
child = os.fork()
detector = load_yolo({cfg!r}, weights={weights!r}, classes=("cat", "dog"), stride=16, runtime="onnxruntime")
found = detector.propose(torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0)))
digest = hashlib.sha256(found.boxes.numpy().tobytes() + found.classes.numpy().tobytes()).hexdigest()
os.write(1, digest.encode() + b"\\n")  # the line of a process is written whole
if child:
    os.waitpid(child, 0)
"""


@pytest.mark.slow
def test_processes_can_export_at_the_same_time(fresh, small_cfg, small_weights, make_small, tmp_path):
    printed = fresh(LOOK.format(cache=str(tmp_path / "cold"), cfg=str(small_cfg), weights=str(small_weights)))
    found = make_small("auto").propose(canvases(1, 3, 64, 64))
    ours = hashlib.sha256(found.boxes.numpy().tobytes() + found.classes.numpy().tobytes()).hexdigest()
    assert printed.split() == [ours, ours]
    assert len(os.listdir(tmp_path / "cold" / "exported")) == 1


def test_a_change_of_the_graph_needs_a_new_version(make_small):
    """If the graph changes, increase VERSION and update the digest here."""
    from onnx.helper import get_attribute_value

    graph = network_model(make_small("torch").network, "darknet").graph
    nodes = "\n".join(
        f"{node.op_type} {[*node.input]} {[*node.output]} {[(a.name, get_attribute_value(a)) for a in node.attribute]}"
        for node in graph.node
    )
    assert (_VERSION, hashlib.sha256(nodes.encode()).hexdigest()[:12]) == (1, "9f909550f9c2")
