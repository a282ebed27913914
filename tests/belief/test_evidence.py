"""Models of evidence of both kinds: inputs of the networks that read several looks."""

import math

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import nn

from semfov import MapEvidence, TargetEvidence
from semfov.belief.evidence import READOUT, blur, logarithm, nearness, network
from tests.belief import reference


class Recorder(nn.Module):
    """Records its inputs, one table for each of 8 episodes, and corrects every cell by 0.5."""

    def forward(self, inputs):
        self.read = inputs.unflatten(0, (8, -1))
        return inputs.new_full((*inputs.shape[:-1], 1), 0.5)


@pytest.mark.parametrize("columns", [1, 2, 6, 12, 24])
def test_inputs_of_a_network_equal_a_reference_in_numpy(toy_map, gathered, dtype, device, columns):
    said = gathered(dtype=dtype)
    said = type(said)(*(each.to(device) for each in said))
    model, recorder = toy_map().to(device, dtype), Recorder()
    more = torch.arange(24.0, device=device).to(dtype)
    got = model.read_out(recorder, said.nearest, said, columns, more, 2 * more)
    torch.testing.assert_close(got, said.nearest + 0.5)
    assert recorder.read.shape == (8, 24, READOUT + 2)
    assert recorder.read.dtype == dtype
    for row in range(8):
        expected = reference.readout_features(
            *(reference.array(getattr(said, name)[row]) for name in ("nearest", "best", "mean", "distance")),
            float(said.looks[row]),
            float(model.prior[said.target[row]].detach()),
            columns,
        )
        close = 1e-5 if dtype == torch.float32 else 1e-7
        np.testing.assert_allclose(reference.array(recorder.read[row, :, :READOUT]), expected, atol=close, rtol=close)
        assert torch.equal(recorder.read[row, :, READOUT:], torch.stack([more, 2 * more], -1))


def test_inputs_of_a_network_have_the_precision_of_the_evidence(toy_map, gathered):
    model, recorder, said = toy_map().bfloat16(), Recorder(), gathered(dtype=torch.bfloat16)
    assert model.read_out(recorder, said.nearest, said, 6).dtype == recorder.read.dtype == torch.bfloat16


@pytest.mark.parametrize("sigma", [0.3, 0.6, 1.5, 4.0])
@pytest.mark.parametrize("columns", [1, 2, 6, 8, 24])
def test_blur_matches_scipy(columns, sigma, device):
    values = torch.rand(3, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    got = blur(values.to(device), columns, sigma).cpu()
    assert got.shape == values.shape
    for image, blurred in zip(values.numpy(), got.numpy(), strict=True):
        table = image.reshape(-1, columns)
        filtered = scipy.ndimage.gaussian_filter(table, sigma, mode="constant", radius=3)
        np.testing.assert_allclose(blurred.reshape(table.shape), filtered, atol=1e-12)


def test_nearness_and_logarithms_of_odds_follow_their_formulas(dtype):
    distance = torch.tensor([0.0, 1 / 6, 1 / 3, 1.25, math.inf], dtype=dtype)
    got = nearness(distance)
    assert got.dtype == dtype
    assert got.tolist() == pytest.approx([math.exp(-6 * d) for d in distance.tolist()], rel=1e-6)
    assert got[-1] == 0
    odds = torch.tensor([0.0, 1e-12, 1e-3, 0.5, 1.0, 80.0], dtype=torch.float64)
    expected = [math.log(value + 1e-3) / 2 + 1 for value in odds.tolist()]
    assert logarithm(odds).tolist() == pytest.approx(expected)
    assert bool(logarithm(odds).isfinite().all())


def test_networks_have_two_hidden_layers():
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
