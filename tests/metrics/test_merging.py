"""The metrics of torchmetrics give what the functions give for all cases at once."""

import pytest
import torch

pytest.importorskip("torchmetrics")
from semfov.metrics.calibration import BinarySums
from semfov.metrics.merging import AreaUnderRoc, Reliability
from tests.refusals import refused


@pytest.fixture
def cases():
    generator = torch.Generator().manual_seed(0)
    probability = torch.rand(60, generator=generator)
    return probability, torch.rand(60, generator=generator) < probability


def merged(kind, parts):
    """The figure of several processes, each with its cases in batches, joined as a synchronisation joins them."""
    metrics = [kind() for _ in parts]
    for metric, part in zip(metrics, parts, strict=True):
        for score, outcome in zip(*(each.split(7) for each in part), strict=True):
            metric.update(score, outcome)
    for other in metrics[1:]:
        metrics[0].merge_state(other)
    return metrics[0].compute()


def test_area_equals_that_of_torchmetrics(cases):
    from torchmetrics.functional.classification import binary_auroc

    score, outcome = cases
    parts = list(zip(score.chunk(3), outcome.chunk(3), strict=True))
    torch.testing.assert_close(merged(AreaUnderRoc, parts), binary_auroc(score, outcome.long()))


def test_reliability_is_that_of_the_whole_sample(cases):
    score, outcome = cases
    parts = list(zip(score.chunk(2), outcome.chunk(2), strict=True))
    found, whole = merged(Reliability, parts), BinarySums.of(score, outcome)
    for name, value in found.items():
        assert float(value) == pytest.approx(getattr(whole, name), rel=1e-6)
    brier = float((score - outcome.float()).square().mean())
    assert float(found["brier"]) == pytest.approx(brier, rel=1e-5)
    area = AreaUnderRoc()
    area.update(torch.tensor([0.5]), torch.tensor([True]))
    refused("both true and false", area.compute)


def test_no_case_is_refused_by_name():
    area = AreaUnderRoc()
    with pytest.warns(UserWarning, match="before the ``update`` method"):
        refused("score: expected cases of both kinds, got none; call update first", area.compute)


def test_a_process_without_a_case_takes_part():
    """Both of two processes gather their states; one of them has none, and the figure is that of the other's cases."""
    states = [torch.tensor([0.9, 0.4, 0.4, 0.1]).double(), torch.tensor([True, True, False, False])]
    sent = []

    def gather(state, group):
        sent.append(state)
        return [states[len(sent) - 1], state]

    area = AreaUnderRoc(dist_sync_fn=gather, distributed_available_fn=lambda: True)
    with pytest.warns(UserWarning, match="before the ``update`` method"):
        assert float(area.compute()) == 0.875
    assert [(len(state), state.dtype) for state in sent] == [(0, each.dtype) for each in states]
