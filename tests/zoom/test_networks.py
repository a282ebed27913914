"""Small networks: each shortened computation against the plain one."""

import pytest
import torch

from semfov.zoom import GlimpseEvidence
from semfov.zoom.networks import features, neighbourhood_mean, small_network, square_mean, through


@pytest.mark.parametrize("shape", [(5,), (1, 5), (40, 5), (3, 6, 5), (2, 3, 6, 5)])
def test_a_network_called_layer_by_layer_equals_the_module(shape, device):
    torch.manual_seed(0)
    network, values = small_network(5, 16, 3).to(device), torch.randn(shape, device=device)
    expected = network(values)
    torch.testing.assert_close(through(network, values), expected)
    torch.testing.assert_close(through(network, values, slice(1, 2)), expected[..., 1:2])
    (gradient,) = torch.autograd.grad(through(network, values).sum(), network[0].weight)
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
def test_the_mean_along_both_axes_in_turn_is_that_over_the_square(side):
    values = torch.rand(2, 12, 10)
    torch.testing.assert_close(square_mean(values, side), neighbourhood_mean(values, side))
