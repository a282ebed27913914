"""Small networks: each shortened computation against the plain one."""

import pytest
import torch
from torch.nn import functional

from semfov.belief.evidence import neighbourhood_peak
from semfov.belief.evidence import network as small_network
from semfov.zoom import GlimpseEvidence
from semfov.zoom.evidence import _neighbourhood_mean, _through, features


@pytest.mark.parametrize("shape", [(5,), (1, 5), (40, 5), (3, 6, 5), (2, 3, 6, 5)])
def test_a_network_called_layer_by_layer_equals_the_module(shape, device):
    torch.manual_seed(0)
    network, values = small_network(5, 16, 3).to(device), torch.randn(shape, device=device)
    expected = network(values)
    torch.testing.assert_close(_through(network, values), expected)
    torch.testing.assert_close(_through(network, values, slice(1, 2)), expected[..., 1:2])


def test_a_network_called_layer_by_layer_has_the_gradient_of_the_module():
    torch.manual_seed(0)
    network, values = small_network(5, 16, 3), torch.randn(40, 5)
    (gradient,) = torch.autograd.grad(_through(network, values).sum(), network[0].weight)
    (wanted,) = torch.autograd.grad(network(values).sum(), network[0].weight)
    torch.testing.assert_close(gradient, wanted)


@pytest.mark.parametrize("known", [False, True])
def test_presence_equals_its_formula(known):
    """Term by term, with the modules of the networks."""
    torch.manual_seed(1)
    evidence = GlimpseEvidence(4, 8).eval().requires_grad_(False)
    scores, summary, steps = torch.rand(7, 4), torch.rand(7, 3) * 9, torch.randint(1, 4, (7,))
    before = torch.randn(7, 4) if known else None
    hints, crowd, octaves = features(scores), (summary + 0.01).log() / 3, steps - 1.5
    company = evidence.company(torch.cat([hints, crowd, octaves[:, None]], -1))
    told = evidence.presence(scores, summary, steps, None, before)
    for window in range(7):
        for kind in range(4):
            own, top = hints[window, kind], hints[window].max()
            memory = torch.tensor(0.0) if before is None else before[window, kind] / 3
            facts = [own, top, own - top, octaves[window], crowd[window, 2], memory, torch.tensor(float(known))]
            terms = evidence.slope[kind] * own + evidence.offset[kind] + company[window, kind]
            expected = terms + evidence.shape(torch.stack(facts))[0]
            torch.testing.assert_close(told[window, kind], expected)
    for kind in range(4):
        one = evidence.presence(scores, summary, steps, kind + 1, None if before is None else before[:, kind])
        torch.testing.assert_close(one, told[:, kind])


@pytest.mark.parametrize("side", [3, 9, 17])
@pytest.mark.parametrize("shape", [(2, 12, 10), (1, 1, 5), (4, 32, 32)])
def test_means_and_peaks_of_neighbourhoods_equal_pooling(side, shape, device):
    values = torch.randn(shape, device=device)
    settings = {"kernel_size": side, "stride": 1, "padding": side // 2}
    expected = functional.avg_pool2d(values[:, None], **settings)[:, 0]
    torch.testing.assert_close(_neighbourhood_mean(values, side), expected)
    expected = functional.max_pool2d(values[:, None], **settings)[:, 0]
    torch.testing.assert_close(neighbourhood_peak(values, side), expected, rtol=0, atol=0)
