"""Models of evidence of both kinds: inputs of the networks that read several looks, and incomplete files."""

import math

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import nn

from semfov.belief.evidence import READOUT, blur, logarithm, nearness, network
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.target_evidence import TargetEvidence
from semfov.errors import DataError
from semfov.io.storage import write_file


class Recorder(nn.Module):
    """Records its inputs, one table for each of 8 episodes, and corrects every cell by 0.5."""

    def forward(self, inputs):
        self.read = inputs.unflatten(0, (8, -1))
        return inputs.new_full((*inputs.shape[:-1], 1), 0.5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_inputs_of_a_network_equal_a_reference_in_numpy(toy_map, gathered, reference, dtype, device):
    said = gathered(dtype=dtype)
    said = type(said)(*(getattr(said, name).to(device) for name in said.__dataclass_fields__))
    model, recorder = toy_map().to(device, dtype), Recorder()
    more = torch.arange(24.0, device=device).to(dtype)
    got = model.read_out(recorder, said.nearest, said, 6, more, 2 * more)
    torch.testing.assert_close(got, said.nearest + 0.5)
    assert recorder.read.shape == (8, 24, READOUT + 2)
    assert recorder.read.dtype == dtype
    for row in range(8):
        expected = reference.readout_features(
            *(reference.array(getattr(said, name)[row]) for name in ("nearest", "best", "mean", "distance")),
            float(said.looks[row]),
            float(model.prior[said.target[row]].detach()),
            6,
        )
        close = 1e-5 if dtype == torch.float32 else 1e-7
        np.testing.assert_allclose(reference.array(recorder.read[row, :, :READOUT]), expected, atol=close, rtol=close)
        assert torch.equal(recorder.read[row, :, READOUT:], torch.stack([more, 2 * more], -1))


@pytest.mark.parametrize("columns", [1, 2, 12, 24])
def test_inputs_of_a_network_on_grids_of_few_rows_or_columns(toy_map, gathered, reference, columns):
    said, model, recorder = gathered(), toy_map().double(), Recorder()
    model.read_out(recorder, said.nearest, said, columns)
    for row in range(8):
        rest = (reference.array(getattr(said, name)[row]) for name in ("nearest", "best", "mean", "distance"))
        prior = float(model.prior[said.target[row]].detach())
        expected = reference.readout_features(*rest, float(said.looks[row]), prior, columns)
        np.testing.assert_allclose(reference.array(recorder.read[row]), expected, atol=1e-7, rtol=1e-6)


def test_inputs_of_a_network_have_the_precision_of_the_evidence(toy_map, gathered):
    model, recorder, said = toy_map().bfloat16(), Recorder(), gathered(dtype=torch.bfloat16)
    assert model.read_out(recorder, said.nearest, said, 6).dtype == recorder.read.dtype == torch.bfloat16


@pytest.mark.parametrize("sigma", [0.3, 0.6, 1.5, 4.0])
@pytest.mark.parametrize("columns", [1, 2, 6, 8, 24])
def test_blur_matches_scipy(columns, sigma, device):
    values = torch.rand(3, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    got = blur(values.to(device), columns, sigma).cpu()
    assert got.shape == values.shape
    kernel = np.exp(-(np.arange(-3, 4) ** 2) / (2 * sigma**2))
    kernel /= kernel.sum()
    for image, blurred in zip(values.numpy(), got.numpy(), strict=True):
        table = image.reshape(-1, columns)
        filtered = scipy.ndimage.gaussian_filter(table, sigma, mode="constant", radius=3)
        correlated = scipy.ndimage.correlate(table, np.outer(kernel, kernel), mode="constant")
        np.testing.assert_allclose(blurred.reshape(table.shape), filtered, atol=1e-12)
        np.testing.assert_allclose(blurred.reshape(table.shape), correlated, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_nearness_falls_with_distance(dtype):
    distance = torch.tensor([0.0, 1 / 6, 1 / 3, 1.25, math.inf], dtype=dtype)
    got = nearness(distance)
    assert got.dtype == dtype
    assert got.tolist() == pytest.approx([math.exp(-6 * d) for d in distance.tolist()], rel=1e-6)
    assert got[-1] == 0


def test_logarithms_of_odds_are_finite():
    odds = torch.tensor([0.0, 1e-12, 1e-3, 0.5, 1.0, 80.0], dtype=torch.float64)
    expected = [math.log(value + 1e-3) / 2 + 1 for value in odds.tolist()]
    assert logarithm(odds).tolist() == pytest.approx(expected)
    assert bool(logarithm(odds).isfinite().all())


def test_networks_have_two_hidden_layers(reference):
    torch.manual_seed(0)
    made = network(5, 7).double()
    assert [layer.in_features for layer in made if isinstance(layer, nn.Linear)] == [5, 7, 7]
    inputs = torch.randn(4, 3, 5, dtype=torch.float64)
    np.testing.assert_allclose(
        reference.array(made(inputs))[..., 0], reference.run_network(made, inputs.numpy()), atol=1e-12
    )


@pytest.mark.parametrize("kind", [MapEvidence, TargetEvidence])
def test_all_classes_start_with_the_same_prior(kind):
    model = kind(4, 5, components=7)
    assert torch.equal(model.prior, torch.zeros(7))
    assert model.widths == (4, 5)
    assert model.metadata == {}
    features = torch.randn(2, 3, 10)
    assert model.evidence(features).shape == (2, 3)


# What is wrong with a file; the other lists are only about models of one kind.
DAMAGES = {
    "no components": lambda record, tensors: record.pop("components"),
    "no widths": lambda record, tensors: record.pop("widths"),
    "no metadata": lambda record, tensors: record.pop("metadata"),
    "classes": lambda record, tensors: record.update(components=9),
    "no number": lambda record, tensors: record.update(components="many"),
    "widths": lambda record, tensors: record.update(widths=[8, 7]),
    "one width": lambda record, tensors: record.update(widths=8),
    "no prior": lambda record, tensors: tensors.pop("prior"),
    "one tensor more": lambda record, tensors: tensors.update(more=torch.zeros(1)),
}
OF_MAPS = {
    "no emptiness": lambda record, tensors: tensors.pop("void.0.weight"),
    "no gain": lambda record, tensors: tensors.pop("worth.4.bias"),
}
OF_TARGETS = {
    "no thresholds": lambda record, tensors: record.pop("thresholds"),
    "half a threshold": lambda record, tensors: record.update(thresholds={"confirm": 0.5}),
    "no judge": lambda record, tensors: tensors.pop("judge.0.weight"),
    "no guide": lambda record, tensors: tensors.pop("guide.4.bias"),
}


@pytest.mark.parametrize(
    ("kind", "damage"),
    [(MapEvidence, name) for name in DAMAGES | OF_MAPS] + [(TargetEvidence, name) for name in DAMAGES | OF_TARGETS],
)
def test_incomplete_files_are_refused(tmp_path, kind, damage):
    """Among them files of earlier versions, without a prior or a network for presence."""
    model, path = kind(8, 6, components=4), tmp_path / "old.safetensors"
    record = {"kind": model.kind, "version": "0", **model._record(), "metadata": {}}
    tensors = {name: tensor.detach() for name, tensor in model.state_dict().items()}
    (DAMAGES | OF_MAPS | OF_TARGETS)[damage](record, tensors)
    write_file(path, tensors, record)
    named = "map" if kind is MapEvidence else "target"
    with pytest.raises(DataError, match=rf"old\.safetensors: not a complete model of {named} evidence"):
        kind.from_pretrained(path)
