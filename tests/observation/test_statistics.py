"""Statistics of detections and of misses: counted in any order and split, as by loops."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from semfov import DirichletStatistics, InputError
from semfov.io.storage import write_file
from semfov.observation import FovealObservationModel, MissCounts
from tests.refusals import refused, unusable


def samples(count, components=5, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(count, components, generator=generator, dtype=torch.float64) ** 8
    scores[torch.rand(count, components, generator=generator) < 0.2] = 0.0
    scores[:, 0] += 1e-3
    scores = scores / scores.sum(-1, keepdim=True)
    labels = torch.randint(3, (count,), generator=generator)
    levels = torch.randint(2, (count,), generator=generator)
    return scores.to(dtype), labels, levels


def gather(scores, labels, levels):
    return DirichletStatistics((3, 2), scores.shape[-1]).update(scores, (labels, levels))


def test_statistics_match_numpy(dtype):
    scores, labels, levels = samples(300, dtype=dtype)
    kept = scores.clone()
    got = gather(scores, labels, levels)
    assert torch.equal(scores, kept)
    floored = np.maximum(scores.double().numpy(), 1e-6)
    floored = floored / floored.sum(1, keepdims=True)
    for k in range(3):
        for d in range(2):
            rows = floored[(labels == k).numpy() & (levels == d).numpy()]
            assert int(got.count[k, d]) == len(rows)
            np.testing.assert_allclose(got.mean_log[k, d], np.log(rows).mean(0), rtol=0, atol=2e-10)
            np.testing.assert_allclose(got.mean[k, d], rows.mean(0), rtol=0, atol=2e-10)
            np.testing.assert_allclose(got.variance[k, d], rows.var(0), rtol=0, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.lists(st.integers(0, 4), min_size=1, max_size=40), st.randoms())
def test_statistics_do_not_depend_on_the_order_or_split_of_samples(seed, shards, random):
    scores, labels, levels = samples(len(shards), seed=seed)
    whole = gather(scores, labels, levels)

    parts = []
    for shard in set(shards):
        rows = [i for i, s in enumerate(shards) if s == shard]
        random.shuffle(rows)
        part = DirichletStatistics((3, 2), 5)
        while rows:
            size = random.randint(1, len(rows))
            batch, rows = torch.tensor(rows[:size]), rows[size:]
            # Columns of a transposed copy: another memory layout, the same numbers.
            laid_out = scores[batch].t().contiguous().t()
            part.update(laid_out, labels[batch] * 2 + levels[batch])
        parts.append(part)
    random.shuffle(parts)
    while len(parts) > 1:
        first = parts.pop(random.randrange(len(parts)))
        parts[random.randrange(len(parts))].merge(first)
    assert parts[0] == whole


def test_sums_of_tables_are_pooled_and_cells_without_samples_have_no_mean():
    one, two = (gather(*samples(20, seed=seed)) for seed in (0, 1))
    before = gather(*samples(20, seed=1))
    one.merge(two)
    assert two == before
    assert one != two
    assert int(one.count.sum()) == 40
    scores, labels, levels = samples(200)
    pooled = gather(scores, labels, levels).sum(1)
    assert pooled == DirichletStatistics((3,), 5).update(scores, labels)
    assert gather(scores, labels, levels).sum(-2) == DirichletStatistics((2,), 5).update(scores, levels)
    empty = DirichletStatistics((2,), 3).update(torch.empty(0, 3), torch.empty(0, dtype=torch.int64))
    assert int(empty.count.sum()) == 0
    for mean in (empty.mean_log, empty.mean, empty.variance):
        assert bool(mean.isnan().all())


def test_files_are_exact_and_the_same_each_time(tmp_path):
    statistics = gather(*samples(100))
    statistics.save(tmp_path / "a.safetensors", shard=3, key="abc")
    statistics.save(tmp_path / "b.safetensors", shard=3, key="abc")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    loaded, record = DirichletStatistics.load(tmp_path / "a.safetensors")
    assert loaded == statistics
    assert (record["shard"], record["key"]) == (3, "abc")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.safetensors", "b.safetensors"]


def test_damaged_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "x.safetensors"
    unusable("no such file", DirichletStatistics.load, path)
    gather(*samples(10)).save(path)
    path.write_bytes(path.read_bytes()[:-50])
    unusable("not a readable", DirichletStatistics.load, path)
    write_file(path, {"count": torch.zeros(2)}, {"kind": "dirichlet-statistics", "epsilon": 1e-6, "fraction_bits": 32})
    unusable("matching shapes", DirichletStatistics.load, path)
    write_file(path, {}, {"kind": "something else"})
    unusable("something else", DirichletStatistics.load, path)
    count, sums = torch.zeros(2, dtype=torch.int64), torch.zeros(3, 2, 4, dtype=torch.int64)
    record = {"kind": "dirichlet-statistics", "epsilon": 1e-6, "fraction_bits": 20}
    write_file(path, {"count": count, "sums": sums}, record)
    unusable(r"2\^-32", DirichletStatistics.load, path)


GOOD = torch.tensor([[0.2, 0.3, 0.5]])
CELL = torch.tensor([0])


def test_bad_updates_and_other_tables_are_refused_and_change_nothing():
    for scores, index, named in [
        (torch.tensor([[0.2, torch.nan, 0.5]]), CELL, "scores"),
        (torch.tensor([[-0.2, 0.7, 0.5]]), CELL, "scores"),
        (torch.tensor([[0.2, 0.2, 0.2]]), CELL, "scores"),
        (torch.ones(1, 2) / 2, CELL, "scores"),
        (GOOD, torch.tensor([6]), "index"),
        (GOOD, torch.tensor([-1]), "index"),
        (GOOD, torch.tensor([0.0]), "index"),
        (GOOD, torch.tensor([0, 1]), "index"),
        (GOOD, (CELL, CELL, CELL), "index"),
        (GOOD, (CELL, CELL + 2), "index"),
    ]:
        statistics = DirichletStatistics((3, 2), 3)
        refused(named, statistics.update, scores, index)
        assert statistics == DirichletStatistics((3, 2), 3)
    for other in (
        DirichletStatistics((2,), 4),
        DirichletStatistics((3,), 3),
        DirichletStatistics((2,), 3, epsilon=1e-4),
    ):
        refused("other", DirichletStatistics((2,), 3).merge, other)


def test_too_many_samples_in_one_cell_are_refused():
    statistics = DirichletStatistics((1,), 2).update(torch.tensor([[1.0, 0.0]]), CELL)
    # Zeros have the largest logarithms; the sums must be correct up to the last merge that is accepted.
    with pytest.raises(InputError, match=r"at most 1.*samples"):  # noqa: PT012 (doubling is the point)
        for _ in range(40):
            statistics.merge(statistics)
    floored = np.log(1e-6 / (1 + 1e-6))
    np.testing.assert_allclose(statistics.mean_log[0, 1], floored, rtol=1e-9)
    assert int(statistics.count) > 1e8


def draw_looks(looks, seed=0):
    torch.manual_seed(seed)
    for _ in range(looks):
        yield torch.rand(12) < 0.4, torch.rand(4, 12) < 0.3, torch.randint(1, 4, (4,)), torch.randint(0, 3, (12,))


def test_counts_equal_a_loop_and_may_be_merged():
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
