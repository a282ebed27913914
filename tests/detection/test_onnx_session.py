import copy
import pickle

import numpy as np
import pytest
import torch

from semfov.detection.onnx import load_onnx
from semfov.detection.onnx_session import OnnxSession
from semfov.errors import DataError, InputError


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
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
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
    with pytest.raises(InputError, match="threads"):
        OnnxSession(path, threads=0)


def test_threads_do_not_spin_unless_asked(make_onnx):
    path = make_onnx({"a": values(1, 5, 4)})
    entry = "session.intra_op.allow_spinning"
    for spinning in (False, True):
        options = OnnxSession(path, spinning=spinning)._session.get_session_options()
        assert options.get_session_config_entry(entry) == str(int(spinning))


def test_inputs_for_image_size_and_scale_are_filled(make_onnx):
    extra = {"orig_target_sizes": (7, [1, 2]), "im_shape": (1, [1, 2]), "scale_factor": (1, [1, 2])}
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}, extra=extra))
    assert session(images(2))["a"].shape == (2, 5, 4)


def test_sessions_can_be_pickled_and_copied(make_onnx):
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}), threads=1)
    for twin in (pickle.loads(pickle.dumps(session)), copy.deepcopy(session)):
        assert twin.threads == 1
        assert torch.equal(twin(images(1))["a"], session(images(1))["a"])


def test_unused_inputs_cause_no_output(make_onnx, capfd):
    OnnxSession(make_onnx({"a": values(1, 5, 4)}, extra={"scale_factor": (1, [1, 2])}))(images(1))
    assert capfd.readouterr() == ("", "")


def test_unsuitable_files_and_inputs_are_refused(make_onnx, tmp_path):
    with pytest.raises(DataError, match=r"missing\.onnx': no such file"):
        OnnxSession(tmp_path / "missing.onnx")
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(make_onnx({"a": values(1, 5, 4)}).read_bytes()[:100])
    with pytest.raises(DataError, match=r"damaged\.onnx"):
        OnnxSession(damaged)
    with pytest.raises(InputError, match="mystery"):
        OnnxSession(make_onnx({"a": values(1, 5, 4)}, extra={"mystery": (1, [1, 2])}))
    session = OnnxSession(make_onnx({"a": values(1, 5, 4)}))
    with pytest.raises(InputError, match="at least one image"):
        session(images(1)[:0])
    with pytest.raises(DataError, match=r"model\.onnx: fails on images of shape \(1, 3, 64, 32\)"):
        session(images(1)[..., :32])


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_device_is_refused(make_onnx):
    with pytest.raises(InputError, match="CPUExecutionProvider"):
        OnnxSession(make_onnx({"a": values(1, 5, 4)}), device="cuda")


def test_execution_providers_are_chosen_by_name(make_onnx):
    path = make_onnx({"output": values(1, 84, 85)})
    wanted = [("CPUExecutionProvider", {"arena_extend_strategy": "kSameAsRequested"})]
    chosen, plain = load_onnx(path, providers=wanted), load_onnx(path)
    assert chosen.settings() == plain.settings() | {"providers": wanted}
    assert pickle.loads(pickle.dumps(chosen.session)).providers == tuple(wanted)
    canvas = images(1)
    assert torch.equal(chosen.propose(canvas).classes, plain.propose(canvas).classes)
    for missing in ([], ["CPUExecutionProvider", "NoSuchProvider"]):
        with pytest.raises(InputError, match=r"providers: expected some of .*CPUExecutionProvider, got (none|NoSuch)"):
            load_onnx(path, providers=missing)
