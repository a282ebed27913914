import hashlib

import numpy as np
import pytest

from semfov.detection.darknet import Darknet, read_weights
from semfov.detection.darknet_config import read_cfg
from semfov.errors import DataError


@pytest.fixture
def network(small_cfg) -> Darknet:
    return Darknet(read_cfg(small_cfg))


def test_digest(network, write_weights):
    path = write_weights()
    assert read_weights(network, path) == hashlib.sha256(path.read_bytes()).hexdigest()


def test_batch_norm_is_folded(network, write_weights):
    path = write_weights()
    read_weights(network, path)
    numbers = np.fromfile(path, "<f4", offset=20).astype(np.float64)
    shift, scale, mean, variance = numbers[:32].reshape(4, 8)
    kernel = numbers[32 : 32 + 8 * 27].reshape(8, 3, 3, 3)
    factor = scale / np.sqrt(variance + 1e-5)
    layer = network.layers[0]
    np.testing.assert_allclose(layer.weight.detach(), kernel * factor[:, None, None, None], rtol=1e-6)
    np.testing.assert_allclose(layer.bias.detach(), shift - mean * factor, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-4], "truncated"),
        (lambda data: data[:10], "truncated"),
        (lambda data: b"", "truncated"),
        (lambda data: data + bytes(4), "too long"),
        (lambda data: b"<html>" + data, "too long"),
        (lambda data: data[:-4] + np.float32(np.nan).tobytes(), "finite numbers"),
        (lambda data: data[: 20 + 24 * 4] + np.full(8, -1, "<f4").tobytes() + data[20 + 32 * 4 :], "variances"),
    ],
)
def test_refuses_damaged_files_with_an_error_of_one_line(network, write_weights, damage, message):
    path = write_weights()
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError) as caught:
        read_weights(network, path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refuses_a_missing_file(network, tmp_path):
    with pytest.raises(DataError, match=r"cannot read the weights .*missing"):
        read_weights(network, tmp_path / "missing.weights")
