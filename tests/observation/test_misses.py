"""Miss counts against a loop over cells, and rates against their formula."""

import torch

from semfov.observation import FovealObservationModel, MissCounts
from tests.refusals import refused


def draw_looks(looks, seed=0):
    torch.manual_seed(seed)
    for _ in range(looks):
        yield torch.rand(12) < 0.4, torch.rand(4, 12) < 0.3, torch.randint(1, 4, (4,)), torch.randint(0, 3, (12,))


def test_counts_equal_a_loop():
    counts, missed, total = MissCounts(4, 3), torch.zeros(4, 3), torch.zeros(4, 3)
    for detected, objects, labels, level in draw_looks(5):
        counts.update(detected, objects, labels, level)
        for cell in range(12):
            there = set(labels[objects[:, cell]].tolist()) or {0}
            for label in there:
                total[label, level[cell]] += 1
                missed[label, level[cell]] += not detected[cell]
    assert counts.total.tolist() == total.long().tolist()
    assert counts.missed.tolist() == missed.long().tolist()


def test_merged_counts_equal_the_counts_of_all_looks():
    parts = [MissCounts(4, 3).update(*look) for look in draw_looks(6)]
    whole = MissCounts(4, 3)
    for look in draw_looks(6):
        whole.update(*look)
    merged = MissCounts.merge(reversed(parts), 4, 3)
    assert torch.equal(merged.missed, whole.missed)
    assert torch.equal(merged.total, whole.total)


def test_rates_shrink_towards_the_rate_of_all_objects():
    counts = MissCounts(3, 2)
    counts.total[:] = torch.tensor([[100, 0], [40, 8], [0, 2]])
    counts.missed[:] = torch.tensor([[90, 0], [10, 6], [0, 2]])
    rates = counts.rates(shrinkage=10)
    pooled = torch.tensor([11 / 42, 9 / 12])
    torch.testing.assert_close(rates[0], torch.tensor([91 / 102, 1 / 2]))
    torch.testing.assert_close(rates[1], (torch.tensor([10.0, 6.0]) + 10 * pooled) / torch.tensor([50.0, 18.0]))
    torch.testing.assert_close(rates[2], (torch.tensor([0.0, 2.0]) + 10 * pooled) / torch.tensor([10.0, 12.0]))
    assert bool(((MissCounts(3, 2).rates() > 0) & (MissCounts(3, 2).rates() < 1)).all())


def test_the_likelihood_of_a_miss_is_the_rate_at_its_level():
    rates = torch.rand(3, 2)
    model = FovealObservationModel.identity(["cup", "cat"], [0.2], miss_rate=rates)
    distance = torch.tensor([[0.1, 0.3]])
    torch.testing.assert_close(model.miss_likelihood(distance), rates.t()[None])
    refused("miss_rate", FovealObservationModel.identity(["cup"], [0.2]).miss_likelihood, distance)
    refused("miss_rate", FovealObservationModel.identity, ["cup"], [0.2], miss_rate=rates)
